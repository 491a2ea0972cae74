//! Which cycle to try next. Pure: it is told what came of each run.
//!
//! ```text
//!            gallop: GALLOP rungs at a time             bisect                prove
//! start ── holds ──► shorter ... until one does not ──► between the two ──► the shortest that held ── holds ──► found
//!   └───── not ────► longer  ... until one holds ───────────┘                 └─ not: 1, 1, 2, 4, 8 rungs longer,
//!                                                                                until one holds; then between the two
//! ```
//!
//! A run that decides nothing is repeated. After [`TRIES`] such attempts the search ends without an answer.

use super::answer::{Purpose, Run};

/// Attempts at a run until it decides. If half of all attempts decide nothing, one run in 32 stays undecided.
pub const TRIES: usize = 5;

/// Rungs of the ladder at a time, until the answer lies between two: 1.5 times as long, or as short.
const GALLOP: usize = 4;
/// How many rungs longer the next proof is after one that failed: where a host that stops threads now and then proves one at
/// all is found in few proofs, and only then how short it may be.
const STEPS: [usize; 5] = [1, 1, 2, 4, 8];

/// Searches among so many rungs: the answer, if any holds, and what came of every run.
pub fn search<E>(
    (rungs, start): (usize, usize),
    mut run: impl FnMut(usize, Purpose) -> Result<Run, E>,
) -> Result<(Option<usize>, Vec<Run>), E> {
    let mut search = Search::new(rungs, start);
    let mut runs = Vec::new();
    loop {
        let (rung, purpose) = match search.next() {
            Next::Trial(rung) => (rung, Purpose::Trial),
            Next::Proof(rung) => (rung, Purpose::Proof),
            Next::Found(rung) => return Ok((Some(rung), runs)),
            Next::NotFound | Next::Inconclusive => return Ok((None, runs)),
        };
        let run = run(rung, purpose)?;
        search.tell(run.holds);
        runs.push(run);
    }
}

/// What is to be done next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// A short run with the cycle of this rung.
    Trial(usize),
    /// A long one.
    Proof(usize),
    /// This one is proven, and none shorter is.
    Found(usize),
    /// None is.
    NotFound,
    /// No attempt at a run decided; there were [`TRIES`].
    Inconclusive,
}

/// A search on a ladder of so many rungs, the shortest cycle at 0.
#[derive(Debug)]
pub struct Search {
    rungs: usize,
    /// The longest that is known not to hold.
    fails: Option<usize>,
    /// The shortest that held a trial.
    holds: Option<usize>,
    next: Next,
    /// Attempts at the next run that decided nothing.
    undecided: usize,
    /// The longest whose proof failed, and how many have.
    unproven: Option<usize>,
    failed_proofs: usize,
    /// The shortest whose proof held.
    proven: Option<usize>,
}

impl Search {
    /// Begins at a rung.
    pub fn new(rungs: usize, start: usize) -> Self {
        let next = if rungs == 0 { Next::NotFound } else { Next::Trial(start.min(rungs - 1)) };
        Self {
            rungs,
            fails: None,
            holds: None,
            next,
            undecided: 0,
            unproven: None,
            failed_proofs: 0,
            proven: None,
        }
    }

    /// What to do.
    pub fn next(&self) -> Next {
        self.next
    }

    /// Takes whether the run held. `None`: it decided nothing, and is repeated.
    pub fn tell(&mut self, held: Option<bool>) {
        let Some(held) = held else {
            self.undecided += 1;
            if self.undecided == TRIES {
                self.next = Next::Inconclusive;
            }
            return;
        };
        self.undecided = 0;
        self.next = match self.next {
            Next::Trial(rung) => {
                if held {
                    self.holds = Some(rung)
                } else {
                    self.fails = Some(rung)
                };
                self.after_trial()
            }
            Next::Proof(rung) => {
                if held {
                    self.proven = Some(rung)
                } else {
                    self.unproven = Some(rung);
                    self.failed_proofs += 1;
                };
                self.after_proof()
            }
            ended => ended,
        };
    }

    fn after_trial(&self) -> Next {
        match (self.fails, self.holds) {
            (Some(fails), Some(holds)) if holds - fails > 1 => Next::Trial(fails + (holds - fails) / 2),
            (_, Some(0)) | (Some(_), Some(_)) => Next::Proof(self.holds.unwrap_or(0)),
            (None, Some(holds)) => Next::Trial(holds.saturating_sub(GALLOP)),
            (Some(fails), None) if fails + 1 < self.rungs => {
                Next::Trial((fails + GALLOP).min(self.rungs - 1))
            }
            (_, None) => Next::NotFound,
        }
    }

    fn after_proof(&self) -> Next {
        match (self.unproven, self.proven) {
            (Some(unproven), Some(proven)) if proven - unproven > 1 => {
                Next::Proof(unproven + (proven - unproven) / 2)
            }
            (_, Some(proven)) => Next::Found(proven),
            (Some(unproven), None) if unproven + 1 < self.rungs => {
                let step = STEPS.get(self.failed_proofs - 1);
                step.map_or(Next::NotFound, |step| Next::Proof((unproven + step).min(self.rungs - 1)))
            }
            (_, None) => Next::NotFound,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The answer, and how many trials and proofs it took.
    fn searched(
        rungs: usize,
        start: usize,
        holds: impl Fn(usize) -> bool,
        proves: impl Fn(usize) -> bool,
    ) -> (Next, usize, usize) {
        let mut search = Search::new(rungs, start);
        let (mut trials, mut proofs) = (0, 0);
        loop {
            match search.next() {
                Next::Trial(rung) => {
                    trials += 1;
                    search.tell(Some(holds(rung)));
                }
                Next::Proof(rung) => {
                    proofs += 1;
                    search.tell(Some(proves(rung)));
                }
                ended => return (ended, trials, proofs),
            }
        }
    }

    #[test]
    fn the_shortest_that_holds_is_found_wherever_it_is_and_in_few_runs() {
        for (rungs, start, shortest) in
            (1..60).flat_map(|rungs| (0..rungs).flat_map(move |s| (0..rungs).map(move |at| (rungs, s, at))))
        {
            let (found, trials, proofs) =
                searched(rungs, start, |rung| rung >= shortest, |rung| rung >= shortest);
            assert_eq!((found, proofs), (Next::Found(shortest), 1), "{rungs} {start}");
            assert!(trials <= start.abs_diff(shortest).div_ceil(GALLOP) + 4, "{trials}");
        }
    }

    #[test]
    fn what_is_not_proven_is_proven_with_the_shortest_longer_cycle_that_is() {
        for proven in 20..=36 {
            let (found, _, proofs) = searched(50, 25, |rung| rung >= 20, |rung| rung >= proven);
            let steps = [20, 21, 22, 24, 28, 36];
            let at = steps.iter().position(|&rung| rung >= proven).unwrap();
            // Up to the first that is proven, and then between it and the last that is not.
            let between = if at == 0 { 0 } else { (steps[at] - steps[at - 1]).ilog2() as usize };
            assert_eq!((found, proofs), (Next::Found(proven), at + 1 + between), "{proven}");
        }
        // Tried: 25, 21, 17, 19, 20.
        assert_eq!(searched(50, 25, |rung| rung >= 20, |_| false), (Next::NotFound, 5, 6));
        // The end of the ladder is the end.
        assert_eq!(searched(22, 21, |rung| rung >= 20, |_| false).0, Next::NotFound);
    }

    #[test]
    fn a_host_that_holds_nothing_is_told_so_and_so_is_one_with_no_rung() {
        assert_eq!(searched(50, 25, |_| false, |_| true).0, Next::NotFound);
        assert_eq!(searched(1, 0, |_| false, |_| true), (Next::NotFound, 1, 0));
        assert_eq!(searched(0, 0, |_| true, |_| true), (Next::NotFound, 0, 0));
    }

    #[test]
    fn run_that_decides_nothing_is_repeated_then_ends_the_search() {
        let mut search = Search::new(10, 0);
        for held in [None, None, None, None, Some(true), None, None, None, None] {
            assert!(matches!(search.next(), Next::Trial(0) | Next::Proof(0)), "{:?}", search.next());
            search.tell(held);
        }
        assert_eq!(search.next(), Next::Proof(0), "tries are counted for each run");
        search.tell(None);
        assert_eq!(search.next(), Next::Inconclusive);
    }
}
