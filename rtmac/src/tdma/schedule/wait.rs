//! How long what is queued waits for its slot, and what comes back for the other's.
//!
//! ```text
//!     chosen          chosen                       asked right after a choice: the worst; right before one: the best
//!   lead |  slot    lead |  slot
//! --|----|--[#]-------|--|--[#]----------------    who asks
//!             \  way               /
//! -------------►---|--lead--[#]---  way            who answers: its first turn whose frame is chosen later
//! ```

use rtnet::time::Span;

use super::{Slot, gcd};

/// Between what and what a time is, on hosts that are never late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wait {
    /// Asked right before the frame of a turn is chosen.
    pub best: Span,
    /// Asked right behind that, and in the worst of the cycles.
    pub worst: Span,
}

/// From when a frame is queued, as the most urgent, to when it begins in its slot, whose frames are chosen `lead` before. Where
/// others are joint with that slot it is less.
pub fn wait(cycle: Span, slot: &Slot, lead: Span) -> Wait {
    Wait { best: lead, worst: lead + cycle * i64::from(slot.period) }
}

/// From when a question is queued for the slot `asks` to when the answer that is sent in `answers` has come. Each frame
/// is on its way so long, from its slot's begin to its receive stamp.
pub fn round_trip(cycle: Span, asks: &Slot, answers: &Slot, lead: Span, ways: [Span; 2]) -> Wait {
    let [there, back] = ways;
    // Cycles from the one of the question until the slot of the answer comes late enough, whatever its phase.
    let behind = asks.offset + there + lead - answers.offset;
    let least = (behind.nanos().max(0) as u64).div_ceil(cycle.nanos() as u64) as u32;
    // Further ones until it is used: for a question in the cycles `phase` of `period`, every so many of these are met.
    let met = gcd(asks.period, answers.period);
    let phase = u64::from(asks.phase) + u64::from(least);
    let first = (u64::from(answers.phase % met) + u64::from(met) - phase % u64::from(met)) % u64::from(met);
    let last = first + u64::from(answers.period - met);
    let turned =
        |further: u64| cycle * (i64::from(least) + further as i64) + answers.offset - asks.offset + back;
    let asked = wait(cycle, asks, lead);
    Wait { best: asked.best + turned(first), worst: asked.worst + turned(last) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CYCLE: Span = Span::from_micros(1_000);
    const LEAD: Span = Span::from_micros(50);
    const WAY: Span = Span::from_micros(3);

    fn slot(offset: i64, phase: u32, period: u32) -> Slot {
        let offset = Span::from_micros(offset);
        Slot { owner: "a".into(), id: 0, offset, phase, period, size: 1500 }
    }

    fn micros(wait: Wait) -> [i64; 2] {
        [wait.best, wait.worst].map(|span| span.nanos() / 1_000)
    }

    #[test]
    fn a_frame_waits_for_the_lead_at_the_least_and_for_a_period_more_at_the_most() {
        assert_eq!(micros(wait(CYCLE, &slot(300, 0, 1), LEAD)), [50, 1_050]);
        assert_eq!(micros(wait(CYCLE, &slot(300, 2, 5), LEAD)), [50, 5_050]);
    }

    #[test]
    fn an_answer_comes_in_the_same_cycle_where_its_slot_is_a_lead_and_a_way_behind_the_question() {
        let ways = [WAY; 2];
        let trip = |answers| micros(round_trip(CYCLE, &slot(100, 0, 1), &slot(answers, 0, 1), LEAD, ways));
        assert_eq!(trip(400), [50 + 300 + 3, 1_050 + 300 + 3]);
        assert_eq!(trip(153), [50 + 53 + 3, 1_050 + 53 + 3], "just in time");
        assert_eq!(trip(152), [50 + 1_052 + 3, 1_050 + 1_052 + 3], "too late: a cycle more");
        assert_eq!(trip(60), [50 + 960 + 3, 1_050 + 960 + 3], "its slot is before the question's");
    }

    #[test]
    fn slots_of_some_cycles_meet_by_their_phases() {
        let trip = |asks: (u32, u32), answers: (u32, u32)| {
            let (asks, answers) = (slot(100, asks.0, asks.1), slot(400, answers.0, answers.1));
            micros(round_trip(CYCLE, &asks, &answers, LEAD, [Span::ZERO; 2]))
        };
        assert_eq!(trip((0, 1), (0, 4)), [350, 1_350 + 3_000], "any cycle may be asked in");
        assert_eq!(trip((1, 4), (1, 4)), [350, 4_350], "always the same one");
        assert_eq!(trip((2, 4), (1, 4)), [350 + 3_000, 4_350 + 3_000], "always the one before the next");
        assert_eq!(trip((0, 4), (1, 6)), [350 + 1_000, 4_350 + 5_000], "one or three or five cycles later");
    }

    /// As stations do it, cycle after cycle, asked at every microsecond at which something changes.
    fn played(asks: &Slot, answers: &Slot, ways: [Span; 2]) -> Wait {
        let begins = |slot: &Slot, n: u32| CYCLE * i64::from(slot.phase + n * slot.period) + slot.offset;
        let next = |slot: &Slot, queued: Span| {
            (0..).map(|n| begins(slot, n)).find(|&begin| begin - LEAD >= queued).unwrap()
        };
        let trip = |asked: Span| next(answers, next(asks, asked) + ways[0]) + ways[1] - asked;
        let chosen = (0..60).map(|n| begins(asks, n) - LEAD);
        let best = chosen.clone().map(trip).min().unwrap();
        // A frame that is queued in the very instant of a choice may be too late for it.
        let nano = Span::from_nanos(1);
        let worst = chosen.map(|chosen| trip(chosen + nano) + nano).max().unwrap();
        Wait { best, worst }
    }

    proptest! {
        #[test]
        fn a_round_trip_is_what_stations_need_for_it(
            (offsets, periods, phases) in ([0i64..900, 0i64..900], [1u32..7, 1u32..7], [0u32..100, 0u32..100]),
            ways in [0i64..1_500, 0i64..1_500],
        ) {
            let slot = |n: usize| slot(60 + offsets[n], phases[n] % periods[n], periods[n]);
            let ways = ways.map(Span::from_micros);
            prop_assert_eq!(round_trip(CYCLE, &slot(0), &slot(1), LEAD, ways), played(&slot(0), &slot(1), ways));
        }
    }
}
