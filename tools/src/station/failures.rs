//! Frames that the kernel refuses, for a person: one line when it begins, one when it is over.

use std::collections::BTreeMap;
use std::io;

/// Runs of failed sends. A station whose interface is down has one in each of its slots.
#[derive(Debug, Default)]
pub struct Failures {
    /// Those under way, by error number.
    runs: BTreeMap<i32, Run>,
    /// Frames sent by the first snapshot without a failure since the last one.
    sent: Option<u64>,
}

#[derive(Debug)]
struct Run {
    frames: u64,
    last: u32,
}

impl Failures {
    /// Takes in a failure; a line if it is the first of its kind.
    pub fn note(&mut self, cycle: u32, errno: i32) -> Option<String> {
        self.sent = None;
        let run = self.runs.entry(errno).or_insert(Run { frames: 0, last: cycle });
        (run.frames, run.last) = (run.frames + 1, cycle);
        (run.frames == 1)
            .then(|| format!("cycle {cycle}: send_failed: {}", io::Error::from_raw_os_error(errno)))
    }

    /// The station has sent so many frames altogether, by a snapshot behind which there was no failure. Lines, if that
    /// tells that it sends again.
    pub fn sent(&mut self, frames: u64) -> Vec<String> {
        // Which frames of the first such snapshot were sent before the last failure, nobody knows.
        if frames > *self.sent.get_or_insert(frames) { self.over() } else { Vec::new() }
    }

    /// Lines about all that is under way, which ends.
    pub fn over(&mut self) -> Vec<String> {
        // Of a single one all is said.
        let runs = std::mem::take(&mut self.runs).into_iter().filter(|(_, run)| run.frames > 1);
        let line = |(errno, Run { frames, last }): (i32, Run)| {
            let why = io::Error::from_raw_os_error(errno);
            format!("cycle {last}: send_failed: the last of {frames}: {why}")
        };
        runs.map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ENETDOWN: i32 = 100;
    const ENOBUFS: i32 = 105;

    #[test]
    fn a_run_of_failed_sends_is_two_lines() {
        let mut failures = Failures::default();
        let first = failures.note(7, ENETDOWN).unwrap();
        assert!(first.starts_with("cycle 7: send_failed: Network is down"), "{first}");
        for cycle in 8..1_000 {
            assert_eq!(failures.note(cycle, ENETDOWN), None);
            // A frame that was sent before the next failure, or between two.
            assert!(failures.sent(cycle.into()).is_empty());
        }
        assert!(failures.sent(999).is_empty(), "nothing was sent since");
        let over = failures.sent(1_000);
        assert!(over[0].starts_with("cycle 999: send_failed: the last of 993: Network is down"), "{over:?}");
        assert!(failures.sent(2_000).is_empty() && failures.over().is_empty(), "and no more");
        assert!(failures.note(2_000, ENETDOWN).is_some(), "the next one is a run of its own");
    }

    #[test]
    fn two_kinds_in_turns_are_two_lines_each() {
        let mut failures = Failures::default();
        let told = |errno| move |failures: &mut Failures, cycle| failures.note(cycle, errno).is_some();
        let (down, full) = (told(ENETDOWN), told(ENOBUFS));
        let lines = (0..100).filter(|&cycle| down(&mut failures, cycle) | full(&mut failures, cycle)).count();
        assert_eq!((lines, failures.over().len()), (1, 2));
    }
}
