//! When the slots that take from one queue have their turns.

use rtnet::time::Span;

use super::{Slot, gcd};

/// Cycles until the turns of joint slots repeat that are looked through.
const CYCLES_AT_MOST: u64 = 1 << 16;

/// The turns of the slots that take from one queue, one slot or those joint with it, from the first cycle until they repeat.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Turns {
    /// In order, from the start of cycle 0; at least one.
    begins: Vec<Span>,
    /// After which they repeat.
    round: Span,
}

impl Turns {
    /// `None` without slots, and where they repeat only after more than 65 536 cycles.
    pub fn of(cycle: Span, slots: &[Slot]) -> Option<Self> {
        let period = |slot: &Slot| u64::from(slot.period.max(1));
        let cycles = slots.iter().map(period).try_fold(1, |all: u64, one| {
            Some(all / gcd(all, one) * one).filter(|&common| common <= CYCLES_AT_MOST)
        })?;
        let turns = |slot: &Slot| {
            let (phase, offset, every) = (u64::from(slot.phase) % period(slot), slot.offset, period(slot));
            (0..cycles / every).map(move |n| cycle * (phase + n * every) as i64 + offset)
        };
        let mut begins: Vec<Span> = slots.iter().flat_map(turns).collect();
        begins.sort_unstable();
        (!begins.is_empty()).then_some(Self { begins, round: cycle * cycles as i64 })
    }

    /// How many there are until they repeat.
    pub fn count(&self) -> usize {
        self.begins.len()
    }

    /// After how long they repeat.
    pub fn round(&self) -> Span {
        self.round
    }

    /// From the begin of one of them to that of the `n`th behind it.
    pub fn after(&self, turn: usize, n: u64) -> Span {
        let (count, place) = (self.begins.len() as u64, turn as u64 + n);
        self.round * (place / count) as i64 + self.begins[(place % count) as usize] - self.begins[turn]
    }

    /// The longest from when a question is queued for these turns, in the instant of a choice, to when the answer that
    /// is sent in one of `answers` has come. Each frame is on its way so long; frames are chosen `lead` before they
    /// leave, and nobody takes any time.
    ///
    /// `None` where both together repeat only after more than 65 536 turns.
    pub fn worst_round_trip(&self, answers: &Turns, lead: Span, ways: [Span; 2]) -> Option<Span> {
        let [there, back] = ways;
        let [own, theirs] = [self.round, answers.round].map(|round| round.nanos() as u64);
        let rounds = theirs / gcd(own, theirs);
        let turns = rounds.checked_mul(self.count() as u64).filter(|&turns| turns <= CYCLES_AT_MOST)?;
        let trip = |missed: u64| {
            let (round, place) = (missed / self.count() as u64, (missed % self.count() as u64) as usize);
            let asked = self.round * round as i64 + self.begins[place];
            let came = asked + self.after(place, 1) + there;
            answers.next(came + lead) - asked + lead + back
        };
        (0..turns).map(trip).max()
    }

    /// The first begin that is not before `at`, which is not before cycle 0.
    fn next(&self, at: Span) -> Span {
        let round = self.round * (at.nanos() / self.round.nanos());
        let place = self.begins.partition_point(|&begin| round + begin < at);
        match self.begins.get(place) {
            Some(&begin) => round + begin,
            None => round + self.round + self.begins[0],
        }
    }

    /// The longest time from one turn's begin to the next one's.
    pub fn longest_between(&self) -> Span {
        (0..self.count()).map(|turn| self.after(turn, 1)).max().unwrap_or(self.round)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{Slot, round_trip};
    use super::*;

    const CYCLE: Span = Span::from_micros(1_000);
    const LEAD: Span = Span::from_micros(50);

    fn slot(offset: i64, phase: u32, period: u32) -> Slot {
        let offset = Span::from_micros(offset);
        Slot { owner: "arm".into(), id: 0, offset, phase: phase % period, period, size: 1500 }
    }

    fn turns(slots: &[Slot]) -> Turns {
        Turns::of(CYCLE, slots).unwrap()
    }

    #[test]
    fn turns_are_counted_from_any_of_them_over_the_end_of_a_round() {
        let turns = turns(&[slot(300, 1, 2), slot(500, 0, 1)]);
        let begins = [500, 1_300, 1_500].map(Span::from_micros);
        assert_eq!(turns, Turns { begins: begins.to_vec(), round: CYCLE * 2 });
        let after = |turn, n| turns.after(turn, n).nanos() / 1_000;
        assert_eq!(
            [after(0, 1), after(0, 2), after(0, 3), after(2, 1), after(1, 7)],
            [800, 1_000, 2_000, 1_000, 4_200]
        );
    }

    #[test]
    fn slots_that_meet_too_seldom_and_none_are_no_turns() {
        assert_eq!(Turns::of(CYCLE, &[slot(300, 0, 65_535), slot(400, 1, 65_536)]), None);
        assert_eq!(Turns::of(CYCLE, &[]), None);
    }

    #[test]
    fn an_answer_may_leave_in_any_of_joint_slots() {
        let trip = |answers: &[Slot]| {
            let trip = turns(&[slot(100, 0, 1)]).worst_round_trip(&turns(answers), LEAD, [Span::ZERO; 2]);
            trip.map(|trip| trip.nanos() / 1_000)
        };
        assert_eq!(trip(&[slot(60, 0, 1)]), Some(50 + 1_000 + 960));
        assert_eq!(trip(&[slot(60, 0, 1), slot(400, 0, 1)]), Some(50 + 1_000 + 300));
        assert_eq!(trip(&[slot(60, 0, 1), slot(400, 0, 2)]), Some(50 + 1_000 + 960));
    }

    proptest! {
        #[test]
        fn of_single_slots_it_is_what_is_said_of_those(
            (offsets, periods, phases) in ([0i64..900, 0i64..900], [1u32..7, 1u32..7], [0u32..100, 0u32..100]),
            ways in [0i64..1_500, 0i64..1_500],
        ) {
            let [asks, answers] = [0, 1].map(|n| slot(60 + offsets[n], phases[n], periods[n]));
            let ways = ways.map(Span::from_micros);
            let single = round_trip(CYCLE, &asks, &answers, LEAD, ways).worst;
            prop_assert_eq!(turns(&[asks]).worst_round_trip(&turns(&[answers]), LEAD, ways), Some(single));
        }
    }
}
