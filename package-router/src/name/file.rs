//! Files that speak of mailboxes: where in one something is wrong, what, and what to do.

use core::fmt::Display;

use serde::de::DeserializeOwned;
use toml::de::DeTable;
use toml::{Spanned, de};

/// Of a message, at most so many characters.
const LEGIBLE: usize = 600;

/// A file that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{file}:{line}:{column}: {what}")]
pub struct FileError {
    /// Which.
    pub file: String,
    /// Where: the line, from 1.
    pub line: usize,
    /// The column, in characters, from 1.
    pub column: usize,
    /// What is wrong there, and what to do.
    pub what: String,
}

/// The text of a file, and what to call it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Source<'a> {
    /// What to call it.
    pub file: &'a str,
    /// What it says.
    pub text: &'a str,
}

impl<'a> Source<'a> {
    /// Its tables.
    pub fn tables(&self) -> Result<Spanned<DeTable<'a>>, FileError> {
        DeTable::parse(self.text).map_err(|error| self.no_toml(&error))
    }

    /// What its tables say.
    pub fn read<T: DeserializeOwned>(&self, tables: Spanned<DeTable<'a>>) -> Result<T, FileError> {
        T::deserialize(de::Deserializer::from(tables)).map_err(|error| self.no_toml(&error))
    }

    /// What stands at a byte of the text cannot be.
    pub fn wrong(&self, at: usize, what: impl Display) -> FileError {
        let before = &self.text[..self.text.floor_char_boundary(at)];
        let line_begin = before.rfind('\n').map_or(0, |newline| newline + 1);
        FileError {
            file: self.file.into(),
            line: self.line(at),
            column: before[line_begin..].chars().count() + 1,
            what: legible(&what.to_string()),
        }
    }

    /// The line of a byte of the text.
    pub fn line(&self, at: usize) -> usize {
        let before = &self.text.as_bytes()[..at.min(self.text.len())];
        before.iter().filter(|&&byte| byte == b'\n').count() + 1
    }

    fn no_toml(&self, error: &de::Error) -> FileError {
        self.wrong(error.span().map_or(0, |span| span.start), error.message())
    }
}

/// In one line, no longer than can be read, and nothing in it that a terminal would obey.
fn legible(what: &str) -> String {
    let mut shown: String =
        what.trim_end().chars().map(|c| if c.is_control() { ' ' } else { c }).take(LEGIBLE + 1).collect();
    if let Some((end, _)) = shown.char_indices().nth(LEGIBLE) {
        shown.replace_range(end.., " ...");
    }
    shown
}
