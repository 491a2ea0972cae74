//! What many runs have shown, as the JSON report names it. It is the same however many ran at once.

use serde::Serialize;

use super::tally::{Row, Worst};
use super::{Seeds, Subject, Tally};
use crate::report::document::document;

/// The report of many runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct SeedsReport {
    /// The first seed of each file.
    pub first_seed: u64,
    /// The last seed of each file, which was run, too.
    pub last_seed: u64,
    /// Runs that have ended.
    pub runs: u64,
    /// Those of them that are as expected.
    pub met: u64,
    /// And those that are not.
    pub failed: u64,
    /// Whether there were to be more.
    pub interrupted: bool,
    /// By file, in the order in which they were named.
    pub files: Vec<OfFile>,
}

document!(SeedsReport, "sim-seeds", seeds_report_has_its_schema);

/// The runs of a file.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct OfFile {
    /// Its name, as it was given.
    pub file: String,
    /// Runs that have ended.
    pub runs: u64,
    /// Those of them that are as expected.
    pub met: u64,
    /// And those that are not.
    pub failed: u64,
    /// Each of those.
    pub failures: Vec<Failed>,
    /// The worst that was found of each expectation, in the order of the file.
    pub expectations: Vec<WorstFound>,
    /// The worst that was found of other figures; a time is in nanoseconds.
    pub figures: Vec<WorstFound>,
}

/// A run that failed.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Failed {
    /// Its seed.
    pub seed: u64,
    /// Why.
    pub reasons: Vec<String>,
    /// What shows it.
    pub command: String,
}

/// The worst value of an expectation or of a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct WorstFound {
    /// The expectation, as in `takeover_cycles <= 1`, or the figure's name.
    pub what: String,
    /// The line of the file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub line: Option<usize>,
    /// The station, if not all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub station: Option<String>,
    /// The priority, if not all that a station sends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub priority: Option<u8>,
    /// In how many runs it was not as expected.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub not_met: Option<u64>,
    /// The worst value: a count, or nanoseconds; none if there was nothing to measure.
    pub worst: Option<i64>,
    /// The same in words.
    pub shown: String,
    /// The lowest seed that has it; none if no run has.
    pub seed: Option<u64>,
    /// Whether every run has it.
    pub in_all: bool,
}

impl SeedsReport {
    /// Of these files and their runs. `command` says how a run of a file with a seed is repeated.
    pub fn new(
        seeds: Seeds,
        files: &[(&Subject, &Tally)],
        interrupted: bool,
        command: impl Fn(&str, u64) -> String,
    ) -> Self {
        let files: Vec<OfFile> =
            files.iter().map(|(subject, tally)| OfFile::new(&subject.file, tally, &command)).collect();
        let sum = |of: fn(&OfFile) -> u64| files.iter().map(of).sum();
        Self {
            first_seed: seeds.first(),
            last_seed: seeds.last(),
            runs: sum(|of| of.runs),
            met: sum(|of| of.met),
            failed: sum(|of| of.failed),
            interrupted,
            files,
        }
    }
}

impl OfFile {
    fn new(file: &str, tally: &Tally, command: impl Fn(&str, u64) -> String) -> Self {
        let failure = |(&seed, reasons): (&u64, &Vec<String>)| Failed {
            seed,
            reasons: reasons.clone(),
            command: command(file, seed),
        };
        let rows = tally.rows.iter().zip(&tally.worst).zip(&tally.not_met);
        let found = rows.map(|((row, worst), &not_met)| WorstFound::new(row, *worst, not_met));
        let (expectations, figures) = found.partition(|found| found.line.is_some());
        let (runs, failed) = (tally.runs(), tally.failed.len() as u64);
        Self {
            file: file.to_owned(),
            runs,
            met: runs - failed,
            failed,
            failures: tally.failed.iter().map(failure).collect(),
            expectations,
            figures,
        }
    }
}

impl WorstFound {
    fn new(row: &Row, worst: Option<Worst>, not_met: u64) -> Self {
        let Row { what, line, station, priority, .. } = row.clone();
        Self {
            what,
            line,
            station,
            priority,
            not_met: line.map(|_| not_met),
            worst: worst.and_then(|worst| worst.value),
            shown: worst.map_or("-".to_owned(), |worst| row.show(worst.value)),
            seed: worst.map(|worst| worst.seed),
            in_all: worst.is_some_and(|worst| worst.is_of_all),
        }
    }
}
