//! A report on its way: to the screen first, and then into files. What cannot be written is told, and keeps nothing else.

use std::io::{ErrorKind, Write};
use std::path::PathBuf;

use anyhow::anyhow;

use super::{Failure, pretty, say};
use crate::report::document::{Document, Kind};
use crate::report::draft::{is_standard_output, write_json, write_text};
use crate::report::verdict::Verdict;

/// A report that is on the screen.
#[must_use]
pub(super) struct Delivery {
    unwritten: Vec<anyhow::Error>,
}

impl Delivery {
    /// Shows it: on standard output, or, if one of these files is that, on standard error.
    pub fn begin(screen: &str, files: &[Option<&PathBuf>]) -> Self {
        let is_taken = files.iter().flatten().any(|path| is_standard_output(path));
        let shown = if is_taken { complain(screen) } else { say(screen) };
        Self { unwritten: shown.err().into_iter().collect() }
    }

    /// Of what was shown otherwise.
    pub fn after(shown: anyhow::Result<()>) -> Self {
        Self { unwritten: shown.err().into_iter().collect() }
    }

    /// As JSON, if there is to be such a file.
    pub fn json(&mut self, path: Option<&PathBuf>, report: &impl Kind) {
        let Some(path) = path else { return };
        self.note(if is_standard_output(path) {
            pretty(&Document::of(report)).and_then(|text| say(&text))
        } else {
            write_json(path, report)
        });
    }

    /// As text, if there is to be such a file.
    pub fn text(&mut self, path: Option<&PathBuf>, text: impl FnOnce() -> String) {
        let Some(path) = path else { return };
        self.note(if is_standard_output(path) { say(&text()) } else { write_text(path, &text()) });
    }

    /// What else went wrong.
    pub fn unwritten(&mut self, errors: impl IntoIterator<Item = anyhow::Error>) {
        self.unwritten.extend(errors);
    }

    /// The exit status: that of the verdict, if all is written.
    pub fn end(self, verdict: &Verdict) -> Result<u8, Failure> {
        self.end_with(verdict.exit_status())
    }

    /// The same, of what has no verdict.
    pub fn end_with(mut self, status: u8) -> Result<u8, Failure> {
        let last = self.unwritten.pop();
        self.unwritten.iter().for_each(|error| {
            let _ = writeln!(std::io::stderr(), "rtnet: {error:#}");
        });
        last.map_or(Ok(status), |error| Err(Failure::Run(error)))
    }

    fn note(&mut self, written: anyhow::Result<()>) {
        self.unwritten.extend(written.err());
    }
}

/// Writes to standard error what is for the screen.
fn complain(text: &str) -> anyhow::Result<()> {
    match std::io::stderr().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(anyhow!("cannot write to standard error: {error}"))
        }
        _ => Ok(()),
    }
}
