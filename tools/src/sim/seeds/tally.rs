//! All runs of a file: how many are as expected, and the worst value of each expectation and figure.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use rtnet::time::Span;

use super::{Run, Seeds};
use crate::sim::expect::NEVER;

/// An expectation or a figure of which the worst value is kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// The expectation, or the figure's name.
    pub what: String,
    /// The line of the file; none of a figure that the file expects nothing of.
    pub line: Option<usize>,
    /// The station, if not all.
    pub station: Option<String>,
    /// The priority, if not all that a station sends.
    pub priority: Option<u8>,
    /// Which value is the worst.
    pub worse: Worse,
    /// Whether it is a time, not a count.
    pub is_time: bool,
}

/// Which of two values is the worse.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Worse {
    /// The higher one.
    More,
    /// The lower one.
    Less,
    /// The one that is further from this.
    Further(i64),
}

impl Row {
    /// A figure of which more is worse.
    pub(super) fn figure(name: &str, is_time: bool) -> Self {
        let (line, station, priority, worse) = (None, None, None, Worse::More);
        Self { what: name.to_owned(), line, station, priority, worse, is_time }
    }

    /// A value in words.
    pub fn show(&self, value: Option<i64>) -> String {
        match value {
            None => "nothing".to_owned(),
            Some(NEVER) => "never".to_owned(),
            Some(value) if self.is_time => Span::from_nanos(value).to_string(),
            Some(value) => value.to_string(),
        }
    }

    /// Higher is worse. An expectation of which nothing was found is worst of all.
    fn badness(&self, value: Option<i64>) -> Option<i128> {
        let value = match value {
            Some(value) => i128::from(value),
            None => return self.line.map(|_| i128::MAX),
        };
        Some(match self.worse {
            Worse::More => value,
            Worse::Less => -value,
            Worse::Further(from) => (value - i128::from(from)).abs(),
        })
    }
}

/// The worst value of a row so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Worst {
    badness: i128,
    /// The value.
    pub value: Option<i64>,
    /// The lowest of the seeds that found it.
    pub seed: u64,
    /// Whether all runs found it.
    pub is_of_all: bool,
}

/// What is known of all runs of a file, in whatever order they ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Tally {
    /// The rows.
    pub rows: Vec<Row>,
    /// The worst of each row; none if no run had a value.
    pub worst: Vec<Option<Worst>>,
    /// How many runs were not as each row expects.
    pub not_met: Vec<u64>,
    /// Why runs failed, by seed.
    pub failed: BTreeMap<u64, Vec<String>>,
    seeds: Seeds,
    done: Vec<bool>,
}

impl Tally {
    /// Of no run yet.
    pub fn new(rows: Vec<Row>, seeds: Seeds) -> Self {
        let (worst, not_met, done) = (vec![None; rows.len()], vec![0; rows.len()], vec![false; seeds.len()]);
        Self { rows, worst, not_met, failed: BTreeMap::new(), seeds, done }
    }

    /// A run has ended.
    pub fn note(&mut self, seed: u64, run: Run) {
        let done = self.runs();
        self.done[(seed - self.seeds.first()) as usize] = true;
        for (i, &(value, holds)) in run.found.iter().enumerate() {
            self.not_met[i] += u64::from(!holds);
            if let Some(badness) = self.rows[i].badness(value) {
                // A run that had no value before this one has found something else.
                let is_of_all = self.worst[i].is_none() && done == 0;
                self.worst[i] = Some(worse(self.worst[i], Worst { badness, value, seed, is_of_all }));
            }
        }
        if !run.reasons.is_empty() {
            self.failed.insert(seed, run.reasons);
        }
    }

    /// How many runs have ended.
    pub fn runs(&self) -> u64 {
        self.done.iter().filter(|done| **done).count() as u64
    }

    /// Each seed, and whether its run has ended.
    pub fn seeds(&self) -> impl Iterator<Item = (u64, bool)> {
        self.seeds.iter().zip(self.done.iter().copied())
    }
}

fn worse(before: Option<Worst>, new: Worst) -> Worst {
    let Some(before) = before else { return new };
    let key = |of: &Worst| (of.badness, Reverse(of.seed));
    let is_of_all = before.is_of_all && before.value == new.value;
    Worst { is_of_all, ..if key(&new) > key(&before) { new } else { before } }
}
