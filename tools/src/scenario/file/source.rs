//! A file as text: where in it something stands, and what is said of what cannot be there.

use std::fmt;
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;

/// No scenario, and nothing that one refers to, is larger: whatever is, is not meant, or has no end.
pub const READ_AT_MOST: u64 = 16 << 20;

/// Of a message, at most so many characters from its begin, and from its end.
const HEAD: usize = 400;
const TAIL: usize = 150;
/// Of a line that is shown, around the place that is meant.
const SHOWN: usize = 80;

/// A file that is no network: where, what, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It cannot be read.
    #[error("{0}: {1}")]
    Unreadable(String, std::io::Error),
    /// It is not TOML, and nobody knows where not.
    #[error("{0}: {1}")]
    Nowhere(String, String),
    /// What it says cannot be.
    #[error("{file}:{place}: {what}")]
    Impossible {
        /// Which file.
        file: String,
        /// Where.
        place: Place,
        /// What, and what to do.
        what: String,
    },
}

/// A place in a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The line, from 1.
    pub line: usize,
    /// The column, in characters, from 1.
    pub column: usize,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.line, self.column)
    }
}

/// Reads a text that has an end: also from a pipe, but not for ever.
pub fn read_text(path: &Path) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?.take(READ_AT_MOST + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > READ_AT_MOST {
        let what = format!("more than {} MiB, which nothing is that is read here", READ_AT_MOST >> 20);
        return Err(std::io::Error::new(std::io::ErrorKind::FileTooLarge, what));
    }
    String::from_utf8(bytes).map_err(|error| {
        let sound = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = sound.iter().filter(|&&byte| byte == b'\n').count() + 1;
        let column = String::from_utf8_lossy(sound.rsplit(|&byte| byte == b'\n').next().unwrap_or(&[]));
        let what = format!("line {line}, column {}: this is no text in UTF-8", column.chars().count() + 1);
        std::io::Error::new(std::io::ErrorKind::InvalidData, what)
    })
}

/// The text of a file, and its name for messages.
#[derive(Debug)]
pub struct Source<'a> {
    /// What to call it.
    pub file: &'a str,
    /// What it says.
    pub text: &'a str,
    /// Where each of its lines begins.
    begins: Vec<usize>,
}

impl<'a> Source<'a> {
    /// A text, and what to call it.
    pub fn new(file: &'a str, text: &'a str) -> Self {
        let behind = text.bytes().enumerate().filter(|&(_, byte)| byte == b'\n').map(|(at, _)| at + 1);
        Self { file, text, begins: std::iter::once(0).chain(behind).collect() }
    }

    /// What stands there cannot be.
    pub(super) fn impossible(&self, at: usize, what: impl ToString) -> FileError {
        self.refused(self.place(at), what)
    }

    /// The same, of a place that is known already.
    pub(super) fn refused(&self, place: Place, what: impl ToString) -> FileError {
        FileError::Impossible { file: self.file.into(), place, what: legible(&what.to_string()) }
    }

    /// What the language says, and what it says it of.
    pub(super) fn no_toml(&self, error: &toml::de::Error) -> FileError {
        let what = legible(error.message());
        let Some(span) = error.span() else {
            // It says nothing else of a key of too many parts.
            let what = what.replace("recursion limit", "a key of more parts, a.b.c, than are read");
            return FileError::Nowhere(self.file.into(), what);
        };
        let (file, place) = (self.file.into(), self.place(span.start));
        FileError::Impossible { file, place, what: format!("{what}\n{}", self.excerpt(span)) }
    }

    /// The line and the column of a byte of the text.
    pub(super) fn place(&self, at: usize) -> Place {
        let line = self.begins.partition_point(|&begin| begin <= at);
        let column = self.text[self.begins[line - 1]..self.text.floor_char_boundary(at)].chars().count() + 1;
        Place { line, column }
    }

    /// The line of it, or as much of that as fits, with marks below what is meant.
    fn excerpt(&self, span: Range<usize>) -> String {
        let Place { line, column } = self.place(span.start);
        let text = self.text[self.begins[line - 1]..].lines().next().unwrap_or("");
        let skipped = (column - 1).saturating_sub(SHOWN / 2);
        let shown: String = text.chars().skip(skipped).take(SHOWN).map(visible).collect();
        let before = column - 1 - skipped;
        let room = shown.chars().count().saturating_sub(before).max(1);
        let until = self.text.floor_char_boundary(span.end).max(span.start);
        let meant =
            self.text.get(span.start..until).map_or(1, |meant| meant.chars().take(room).count()).max(1);
        let (number, marks) = (line.to_string(), " ".repeat(before) + &"^".repeat(meant));
        let margin = " ".repeat(number.len());
        format!("{margin} |\n{number} | {shown}\n{margin} | {marks}")
    }
}

/// A terminal is told nothing by what it shows.
fn visible(character: char) -> char {
    if character.is_control() { ' ' } else { character }
}

/// No more than can be read, in one line.
fn legible(what: &str) -> String {
    let all: String = what.trim_end().chars().map(visible).collect();
    let length = all.chars().count();
    if length <= HEAD + TAIL {
        return all;
    }
    let part = |from, n| all.chars().skip(from).take(n).collect::<String>();
    part(0, HEAD) + " ... " + &part(length - TAIL, TAIL)
}
