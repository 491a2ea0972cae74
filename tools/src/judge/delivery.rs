//! What was on the medium and never reached its receiver. Senders number their frames; the observer knows
//! which numbers passed, a receiver knows from where to where it heard how many.

use crate::station::traffic::step;

/// Gaps that are kept; what is missing in later ones counts as lost.
const GAPS_MAX: usize = 1_000_000;
/// More than a sender sends within what a capture ring holds back.
pub const BEYOND: u64 = 10_000;

/// What a receiver heard of its sender.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// How many frames.
    pub received: u64,
    /// The numbers of the first and the last.
    pub range: Option<(u64, u64)>,
    /// Whether it has begun to hear while the sender sent already.
    pub anew: bool,
}

/// What the observer saw of one sender.
#[derive(Debug, Default)]
pub struct Passed {
    range: Option<(u64, u64)>,
    /// Numbers between, that were not seen: first and how many, in order.
    gaps: Vec<(u64, u64)>,
    /// The first and the last number of the cycles that count.
    counted: Option<(u64, u64)>,
}

impl Passed {
    /// A frame passed, in a cycle that counts or not.
    pub fn note(&mut self, number: u64, counts: bool) {
        // What a receiver does not believe is not believed here.
        let Some(step) = step(self.range.map(|(_, last)| last), number) else { return };
        if step > 1 && self.gaps.len() < GAPS_MAX {
            self.gaps.push((number - step + 1, step - 1));
        }
        self.range = Some((self.range.map_or(number, |(first, _)| first), number));
        if counts {
            self.counted = Some((self.counted.map_or(number, |(from, _)| from), number));
        }
    }

    /// How many frames the receiver did not get: of those that count, and of all within what it heard.
    pub fn lost(&self, heard: &Heard) -> u64 {
        let Some((from, to)) = self.counted else { return 0 };
        // One that has come anew and heard nothing yet cannot say since when it listens.
        let Some((first, last)) = heard.range.or((!heard.anew).then_some((from, to))) else { return 0 };
        // One that has come anew could not hear what passed before its first.
        let from = if heard.anew { first } else { first.min(from) };
        self.passed(from, last.max(to)).saturating_sub(heard.received)
    }

    /// A number that the sender has not come to yet, however much of it has not been seen yet.
    pub fn beyond(&self) -> u64 {
        self.range.map_or(0, |(_, last)| last + BEYOND)
    }

    /// How many frames with these numbers were on the medium.
    fn passed(&self, from: u64, to: u64) -> u64 {
        let Some((first, last)) = self.range else { return 0 };
        let (from, to) = (from.max(first), to.min(last));
        let missing = |&(begin, n): &(u64, u64)| {
            let end = begin + n;
            end.min(to + 1).saturating_sub(begin.max(from))
        };
        (to + 1).saturating_sub(from) - self.gaps.iter().map(missing).sum::<u64>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers 0 to 99, of which 30, 31 and 60 were never sent; 20 to 79 count.
    fn passed() -> Passed {
        let mut passed = Passed::default();
        let numbers = (0..100).filter(|number| ![30, 31, 60].contains(number));
        numbers.for_each(|number| passed.note(number, (20..80).contains(&number)));
        passed
    }

    #[track_caller]
    fn lost(received: u64, range: Option<(u64, u64)>, expected: u64) {
        assert_eq!(passed().lost(&Heard { received, range, anew: false }), expected);
    }

    #[test]
    fn what_was_never_sent_is_not_lost() {
        lost(97, Some((0, 99)), 0);
        lost(77, Some((10, 89)), 0);
    }

    #[test]
    fn frames_lost_between_before_and_behind_what_was_heard_are_lost() {
        lost(95, Some((0, 99)), 2);
        // 20 to 24 came too early for it, though they count; and the last five that count never came.
        lost(47, Some((25, 74)), 10);
        lost(0, None, 57);
    }

    #[test]
    fn what_passed_before_a_receiver_came_anew_is_not_lost() {
        let lost = |received, range| passed().lost(&Heard { received, range, anew: true });
        assert_eq!(lost(29, Some((50, 79))), 0);
        assert_eq!(lost(27, Some((50, 79))), 2, "30 numbers, one of which was never sent");
        assert_eq!(lost(19, Some((50, 69))), 10, "the last ten never came");
        assert_eq!(lost(0, None), 0, "nobody knows since when it listens");
    }

    #[test]
    fn a_forged_number_from_far_away_changes_nothing() {
        let mut passed = passed();
        passed.note(1 << 40, true);
        passed.note(u64::MAX, true);
        passed.note(40, true);
        passed.note(100, true);
        assert_eq!(passed.lost(&Heard { received: 97, range: Some((0, 99)), anew: false }), 1);
    }
}
