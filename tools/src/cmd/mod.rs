//! One module per verb: from arguments to the thing done.

pub mod account;
mod delivery;
pub mod doctor;
pub mod dump;
pub mod find_min_cycle;
pub mod interface;
pub mod jitter;
pub mod lab;
pub mod lab_run;
pub mod lab_up;
pub mod manual;
pub mod package;
pub mod ping;
pub mod plan;
pub mod pool;
pub mod route;
pub mod router;
pub mod schedule;
pub mod sim;
mod sim_seeds;
pub mod slot;
pub mod stat;
pub mod station;
pub mod tdma;
pub mod token;
pub mod vnic;
mod waits;

use std::io::{ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use serde::Serialize;

use self::delivery::Delivery;
use crate::remedy::explained;
use crate::report::document::{Document, Documents, Kind};
use crate::report::draft::{can_be_written, is_standard_output};
use crate::report::screen::WIDTH_MIN;
use crate::report::verdict::{Interrupted, Word};
use crate::ring::{self, RingFigures};

/// Columns of a report when the terminal does not say.
const WIDTH: usize = 100;

/// Whose fault a failure is, which the exit status tells.
#[derive(Debug)]
pub enum Failure {
    /// Bad usage or configuration, or a host that does not let us: status 2.
    Usage(anyhow::Error),
    /// It ran, and something was not as it should be: status 1.
    Run(anyhow::Error),
    /// Somebody ended it before there was anything to report: status 130.
    Interrupted(anyhow::Error),
    /// A command to be run in a lab could not be: the status that env(1) has for it.
    Command(u8, anyhow::Error),
}

impl Failure {
    /// The process's exit status.
    pub fn status(&self) -> u8 {
        match self {
            Failure::Usage(_) => 2,
            Failure::Run(_) => 1,
            Failure::Interrupted(_) => Word::Interrupted.exit_status(),
            Failure::Command(status, _) => *status,
        }
    }
    /// What to tell the user.
    pub fn error(&self) -> &anyhow::Error {
        match self {
            Failure::Usage(error) | Failure::Run(error) => error,
            Failure::Interrupted(error) | Failure::Command(_, error) => error,
        }
    }

    fn into_error(self) -> anyhow::Error {
        match self {
            Failure::Usage(error) | Failure::Run(error) => error,
            Failure::Interrupted(error) | Failure::Command(_, error) => error,
        }
    }

    /// Of a lab: this one, but that it was interrupted is nobody's fault.
    fn of_lab(error: anyhow::Error, otherwise: impl Fn(anyhow::Error) -> Failure) -> Failure {
        if error.is::<Interrupted>() { Failure::Interrupted(error) } else { otherwise(error) }
    }
}

/// Tells of a ring's run on the screen, and in files that were asked for.
fn tell_of_ring(
    figures: &RingFigures,
    title: &str,
    json: Option<&PathBuf>,
    html: Option<&PathBuf>,
    pcap: Option<&PathBuf>,
) -> Result<u8, Failure> {
    let mut delivery = Delivery::begin(&ring::render(figures, screen_width()), &[json, html, pcap]);
    delivery.json(json, figures);
    delivery.text(html, || ring::page(title, figures));
    delivery.end(&figures.verdict)
}

/// Prints something as JSON or in words.
fn print<T: Kind>(json: bool, what: &T, words: impl Fn(&T) -> String) -> anyhow::Result<()> {
    say(&in_words(json, what, words)?)
}

fn in_words<T: Kind>(json: bool, what: &T, words: impl Fn(&T) -> String) -> anyhow::Result<String> {
    Ok(if json { pretty(&Document::of(what))? } else { words(what) })
}

/// Prints some of one kind as JSON or in words.
fn print_all<T: Kind>(json: bool, all: &[T], words: impl Fn(&[T]) -> String) -> anyhow::Result<()> {
    say(&if json { pretty(&Documents(all))? } else { words(all) })
}

fn pretty(documents: &impl Serialize) -> anyhow::Result<String> {
    Ok(serde_json::to_string_pretty(documents)? + "\n")
}

/// A document in one line, for what is told one after the other.
fn in_line(documents: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string(documents).map(|line| line + "\n").context("JSON").map_err(Failure::Run)
}

/// Writes to standard output. Whoever closed it does not want to read the rest; whoever has no room for it wanted to.
fn say(text: &str) -> anyhow::Result<()> {
    let mut output = std::io::stdout().lock();
    match output.write_all(text.as_bytes()).and_then(|()| output.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(anyhow!("cannot write to standard output: {error}"))
        }
        _ => Ok(()),
    }
}

/// Columns of a report: the terminal's, but not too few.
fn screen_width() -> usize {
    let said = std::env::var("COLUMNS").ok().and_then(|columns| columns.parse().ok());
    said.unwrap_or(WIDTH).max(WIDTH_MIN)
}

/// A file that cannot be written is better known before the run than after it.
fn writable(path: &Path) -> anyhow::Result<()> {
    if is_standard_output(path) {
        return Ok(());
    }
    can_be_written(path).map_err(explained).with_context(|| format!("{} cannot be written", path.display()))
}

/// The same of several, each another, and none of them what is read.
fn all_writable(outputs: &[Option<&PathBuf>], input: Option<&Path>) -> anyhow::Result<()> {
    let outputs: Vec<&Path> = outputs.iter().flatten().map(|path| path.as_path()).collect();
    for (i, path) in outputs.iter().enumerate() {
        ensure!(
            !input.is_some_and(|input| is_same(path, input)),
            "{} is what is read: write to another file",
            path.display()
        );
        ensure!(
            !outputs[..i].iter().any(|other| is_same(path, other)),
            "{} is written twice: each output needs a file of its own",
            path.display()
        );
        writable(path)?;
    }
    Ok(())
}

/// Whether both are one file, under whichever names; what is no file, as /dev/null is none, is not spoilt by it.
fn is_same(one: &Path, other: &Path) -> bool {
    match (std::fs::metadata(one), std::fs::metadata(other)) {
        (Ok(a), Ok(b)) => a.is_file() && (a.dev(), a.ino()) == (b.dev(), b.ino()),
        (Err(_), Err(_)) => std::path::absolute(one).ok() == std::path::absolute(other).ok(),
        _ => false,
    }
}

/// What a report is called: by its scenario's file, without the way to it.
fn title(file: &Path) -> String {
    file.file_name().unwrap_or(file.as_os_str()).to_string_lossy().into_owned()
}
