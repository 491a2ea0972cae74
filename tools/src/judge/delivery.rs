//! What was on the medium and never reached its receiver. Senders number their frames; the observer knows
//! which numbers passed, a receiver knows from where to where it heard how many.

use std::ops::Range;

use rtnet::clock::True;

use crate::station::traffic::{Arrived, Came, Newest, SKIPPED};

/// Gaps that are kept; what is missing in later ones counts as lost.
const GAPS_MAX: usize = 1_000_000;

/// What a receiver heard of its sender: of the usual frames, or of those that it queues at one priority.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// How many frames.
    pub received: u64,
    /// The numbers of the first and the last.
    pub range: Option<(u64, u64)>,
    /// Whether it has begun to hear while the sender sent already.
    pub anew: bool,
}

/// What is known of such frames at their receiver.
#[derive(Clone, Debug, Default)]
pub struct Delivery {
    /// Those that came.
    pub heard: Heard,
    /// Those that were lost as the scenario says, or by a cut wire.
    pub meant: Meant,
}

impl Heard {
    /// What has arrived.
    pub fn of(Arrived { received, missing, first }: Arrived, anew: bool) -> Self {
        let range = (received > 0).then(|| (first, first + received + missing - 1));
        Self { received, range, anew }
    }

    /// Of that, only what has one of these numbers: all but so many frames.
    pub fn within(self, numbers: Range<u64>, all_but: u64) -> Self {
        let clipped = |(first, last): (u64, u64)| (first.max(numbers.start), last.min(numbers.end - 1));
        let range = self.range.map(clipped).filter(|(first, last)| first <= last);
        Self { received: self.received.saturating_sub(all_but), range, ..self }
    }
}

/// Frames that were lost on purpose on their way to a receiver.
#[derive(Clone, Debug, Default)]
pub struct Meant {
    /// Their numbers: first and how many, in order.
    runs: Vec<(u64, u64)>,
    /// So many more, whichever they are.
    others: u64,
}

impl Meant {
    /// None is.
    pub const NONE: Self = Self { runs: Vec::new(), others: 0 };
    /// These, and so many more, whichever.
    pub fn and_any(self, frames: u64) -> Self {
        Self { others: self.others.saturating_add(frames), ..self }
    }

    /// One was lost.
    pub fn note(&mut self, number: u64) {
        let is_full = self.runs.len() == GAPS_MAX;
        match self.runs.last_mut() {
            Some((first, n)) if *first + *n == number => *n += 1,
            _ if is_full => self.others = self.others.saturating_add(1),
            // One that was longer on its way may be lost behind later ones.
            _ => {
                let place = self.runs.partition_point(|&(first, _)| first < number);
                self.runs.insert(place, (number, 1));
            }
        }
    }

    fn between(&self, from: u64, to: u64) -> u64 {
        self.others.saturating_add(self.runs.iter().map(|&run| common(run, from, to)).sum())
    }
}

/// What the observer saw of one sender, or of what it queues at one priority.
#[derive(Debug, Default)]
pub struct Passed {
    newest: Newest,
    range: Option<(u64, u64)>,
    /// Numbers between, that were not seen: first and how many, in order.
    gaps: Vec<(u64, u64)>,
    /// The first and the last number of the cycles that count.
    counted: Option<(u64, u64)>,
}

impl Passed {
    /// A frame passed, in a cycle that counts or not.
    pub fn note(&mut self, number: u64, at: True, counts: bool) {
        // What a receiver does not believe is not believed here.
        match self.newest.note(number, Some(at)) {
            None => return,
            Some(Came::Behind(step)) => {
                if step > 1 && self.gaps.len() < GAPS_MAX {
                    self.gaps.push((number - step + 1, step - 1));
                }
                self.range = Some((self.range.map_or(number, |(first, _)| first), number));
            }
            Some(Came::Late) => self.close_gap(number),
        }
        if counts {
            let (from, to) = self.counted.unwrap_or((number, number));
            self.counted = Some((from.min(number), to.max(number)));
        }
    }

    /// A number that others have overtaken is not missing any more. It is one of the newest.
    fn close_gap(&mut self, number: u64) {
        let around = |&(begin, n): &(u64, u64)| (begin..begin + n).contains(&number);
        let Some(place) = self.gaps.iter().rposition(around) else { return };
        let (begin, n) = self.gaps[place];
        let parts = [(begin, number - begin), (number + 1, begin + n - number - 1)];
        self.gaps.splice(place..=place, parts.into_iter().filter(|&(_, n)| n > 0));
    }

    /// How many frames the receiver did not get: of those that count, and of all within what it heard.
    pub fn lost(&self, heard: &Heard) -> u64 {
        self.judged(heard).map_or(0, |(from, to)| self.passed(from, to).saturating_sub(heard.received))
    }

    /// How many of them were meant to be lost.
    pub fn meant(&self, heard: &Heard, meant: &Meant) -> u64 {
        self.judged(heard).map_or(0, |(from, to)| meant.between(from, to)).min(self.lost(heard))
    }

    /// The first and the last number that the receiver should have got.
    fn judged(&self, heard: &Heard) -> Option<(u64, u64)> {
        let (from, to) = self.counted?;
        // One that has come anew and heard nothing yet cannot say since when it listens.
        let (first, last) = heard.range.or((!heard.anew).then_some((from, to)))?;
        // One that has come anew could not hear what passed before its first.
        let from = if heard.anew { first } else { first.min(from) };
        Some((from, last.max(to)))
    }

    /// A number that the sender has not come to yet, however much of it has not been seen yet.
    pub fn beyond(&self) -> u64 {
        self.range.map_or(0, |(_, last)| last + SKIPPED)
    }

    /// The number behind the last one that was on the medium.
    pub fn next(&self) -> u64 {
        self.range.map_or(0, |(_, last)| last + 1)
    }

    /// How many frames with these numbers were on the medium.
    fn passed(&self, from: u64, to: u64) -> u64 {
        let Some((first, last)) = self.range else { return 0 };
        let (from, to) = (from.max(first), to.min(last));
        (to + 1).saturating_sub(from) - self.gaps.iter().map(|&gap| common(gap, from, to)).sum::<u64>()
    }
}

/// How many of so many numbers from a first on are within these.
fn common((first, n): (u64, u64), from: u64, to: u64) -> u64 {
    (first + n).min(to + 1).saturating_sub(first.max(from))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: True = 7;

    /// Numbers 0 to 99, of which 30, 31 and 60 were never sent; 20 to 79 count.
    fn passed() -> Passed {
        let mut passed = Passed::default();
        let numbers = (0..100).filter(|number| ![30, 31, 60].contains(number));
        numbers.for_each(|number| passed.note(number, NOW, (20..80).contains(&number)));
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
    fn what_was_lost_before_the_begin_and_behind_the_end_does_not_count() {
        let heard = |received, range| Heard { received, range, anew: false };
        let lost = |heard: Heard, all_but| passed().lost(&heard.within(20..80, all_but));
        // Of 0 to 19 and of 80 to 99 every second one was lost.
        assert_eq!(lost(heard(77, Some((0, 98))), 20), 0);
        assert_eq!(lost(heard(75, Some((0, 98))), 20), 2);
        assert_eq!(lost(heard(10, Some((0, 18))), 10), 57, "all since");
        assert_eq!(heard(5, Some((0, 9))).within(10..u64::MAX, 5), heard(0, None));
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
    fn what_was_overtaken_is_not_lost_if_it_came() {
        let mut passed = Passed::default();
        for number in [0, 1, 5, 6, 3, 2, 7, 4, 9, 4] {
            passed.note(number, NOW, number != 9);
        }
        let lost = |received, range| passed.lost(&Heard { received, range, anew: false });
        assert_eq!((lost(9, Some((0, 9))), lost(8, Some((0, 9))), lost(5, Some((3, 7)))), (0, 1, 3));
    }

    #[test]
    fn only_what_the_receiver_should_have_got_was_meant_to_be_lost() {
        let mut meant = Meant::default();
        // All that passed before it came, and two later, of which the first was on its way for longer.
        (0..50).chain([71, 70]).for_each(|number| meant.note(number));
        let of = |received, anew, meant: &Meant| {
            let heard = Heard { received, range: Some((50, 79)), anew };
            (passed().lost(&heard), passed().meant(&heard, meant))
        };
        assert_eq!(of(26, true, &meant), (3, 2), "of 29, three; what was before was not for it");
        assert_eq!(of(29, true, &meant), (0, 0), "nothing is lost that came");
        assert_eq!(of(27, false, &meant), (30, 30), "28 of those that count were before its first");
        assert_eq!(of(26, true, &Meant::NONE.and_any(2)), (3, 2));
        assert_eq!(of(26, true, &Meant::NONE.and_any(9)), (3, 3));
        assert_eq!(of(26, true, &meant.and_any(1)), (3, 3), "for either reason");
    }

    #[test]
    fn a_forged_number_from_far_away_changes_nothing() {
        let mut passed = passed();
        passed.note(1 << 40, NOW, true);
        passed.note(u64::MAX, NOW, true);
        passed.note(40, NOW, true);
        passed.note(100, NOW, true);
        assert_eq!(passed.lost(&Heard { received: 97, range: Some((0, 99)), anew: false }), 1);
    }
}
