//! One module per verb: from arguments to the thing done.

pub mod account;
pub mod doctor;
pub mod dump;
pub mod jitter;
pub mod lab;
pub mod lab_run;
pub mod lab_up;
pub mod manual;
pub mod sim;
pub mod slot;
pub mod station;
pub mod tdma;

use std::path::Path;

use anyhow::Context;
use serde::Serialize;

use crate::report::screen::WIDTH_MIN;

/// Columns of a report when the terminal does not say.
const WIDTH: usize = 100;

/// Whose fault a failure is, which the exit status tells.
#[derive(Debug)]
pub enum Failure {
    /// Bad usage or configuration, or a host that does not let us: status 2.
    Usage(anyhow::Error),
    /// It ran, and something was not as it should be: status 1.
    Run(anyhow::Error),
}

impl Failure {
    /// The process's exit status.
    pub fn status(&self) -> u8 {
        match self {
            Failure::Usage(_) => 2,
            Failure::Run(_) => 1,
        }
    }
    /// What to tell the user.
    pub fn error(&self) -> &anyhow::Error {
        match self {
            Failure::Usage(error) | Failure::Run(error) => error,
        }
    }
}

/// Prints something as JSON or in words. Whoever closed our output does not want to read the rest.
fn print<T: Serialize>(json: bool, what: &T, words: impl Fn(&T) -> String) -> anyhow::Result<()> {
    let text = if json { serde_json::to_string_pretty(what)? + "\n" } else { words(what) };
    let _ = std::io::Write::write_all(&mut std::io::stdout(), text.as_bytes());
    Ok(())
}

/// Columns of a report: the terminal's, but not too few.
fn screen_width() -> usize {
    let said = std::env::var("COLUMNS").ok().and_then(|columns| columns.parse().ok());
    said.unwrap_or(WIDTH).max(WIDTH_MIN)
}

/// A file that cannot be written is better known before the run than after it.
fn writable(path: &Path) -> anyhow::Result<()> {
    let open = std::fs::File::options().append(true).create(true).open(path);
    open.with_context(|| format!("{} cannot be written", path.display())).map(drop)
}

fn write_json(path: &Path, report: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(report)?;
    text.push('\n');
    std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))
}
