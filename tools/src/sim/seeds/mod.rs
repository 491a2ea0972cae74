//! One scenario with many seeds: what holds for one seed has to hold for all.
//!
//! ```text
//!   subject: a file ──run(seed)──► run: reasons, a value for each row ──► tally: met, failed, the worst of each row
//!   pool: runs on threads                                                └─► report ─► screen, JSON, JUnit
//! ```

mod pool;
mod report;
mod screen;
mod subject;
mod tally;

use std::fmt;
use std::str::FromStr;

pub use pool::{start, usual_jobs};
pub use report::{Failed, OfFile, SeedsReport, WorstFound};
pub use screen::{progress, render};
pub use subject::{Run, Subject};
pub use tally::Tally;

/// So many runs of a file at once: all that is known of them is kept until the end.
pub const MOST_SEEDS: u64 = 100_000;

/// A range of seeds, both ends included; never empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seeds {
    first: u64,
    last: u64,
}

/// Why a text names no seeds.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SeedsError {
    /// It is no range.
    #[error("'{0}' names no seeds: write the first and the last, as in 1..20, or one, as in 7")]
    Unreadable(String),
    /// There is nothing in it.
    #[error("{last} is less than {first}: write the lower seed first, as in {last}..{first}")]
    Empty {
        /// The first seed of the text.
        first: u64,
        /// And its last.
        last: u64,
    },
    /// There is too much in it.
    #[error("{0} are {count} seeds, more than the {MOST_SEEDS} that are run at once: run parts of it", count = u128::from(.0.span()) + 1)]
    TooMany(Seeds),
}

impl Seeds {
    /// How many there are.
    // It is never empty.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(self) -> usize {
        self.span() as usize + 1
    }

    /// All of them, in order.
    pub fn iter(self) -> impl Iterator<Item = u64> {
        self.first..=self.last
    }

    /// The first one.
    pub fn first(self) -> u64 {
        self.first
    }

    /// The last one.
    pub fn last(self) -> u64 {
        self.last
    }

    fn span(self) -> u64 {
        self.last - self.first
    }
}

impl FromStr for Seeds {
    type Err = SeedsError;

    fn from_str(text: &str) -> Result<Self, SeedsError> {
        let (first, last) = text.split_once("..").unwrap_or((text, text));
        let number = |number: &str| number.parse().map_err(|_| SeedsError::Unreadable(text.to_owned()));
        let (first, last) = (number(first)?, number(last)?);
        if last < first {
            return Err(SeedsError::Empty { first, last });
        }
        let seeds = Seeds { first, last };
        if seeds.span() >= MOST_SEEDS { Err(SeedsError::TooMany(seeds)) } else { Ok(seeds) }
    }
}

impl fmt::Display for Seeds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.first == self.last {
            write!(f, "{}", self.first)
        } else {
            write!(f, "{}..{}", self.first, self.last)
        }
    }
}

#[cfg(test)]
mod tests;
