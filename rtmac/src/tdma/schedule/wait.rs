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
use rtnet::wire::ethernet;

use super::{Rate, Slot, Turns, gcd};

/// Between what and what a time is, on hosts that are never late.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wait {
    /// Asked right before the frame of a turn is chosen.
    pub best: Span,
    /// Asked right behind that, and in the worst of the cycles.
    pub worst: Span,
}

/// From when a frame is queued, as the most urgent, to when it begins in its slot, whose frames are chosen `lead` before. Where
/// others are joint with that slot it is less: see [`worst_wait`].
pub fn wait(cycle: Span, slot: &Slot, lead: Span) -> Wait {
    Wait { best: lead, worst: lead + cycle * i64::from(slot.period) }
}

/// The longest that a frame takes from being handed over to the end of its transmission, if it is the first of its queue: for
/// the longest time between two turns of the slots that take from that queue (one, or those joint with it), for the `lead`
/// before a slot at which its frame is chosen, and for its time on the air, of the largest that fits. It is reached by a frame that
/// is handed over in the instant of a choice, where turns are further apart than the lead.
///
/// It says nothing of frames that are ahead in the queue, each of which takes a turn; of turns that are missed, or given to
/// calibration; of hosts: how late in its slot a station sends, up to the slot's `latest`, and what the receiver's takes to hear of it.
///
/// `None` for no slots.
///
/// ```
/// use rtmac::tdma::schedule::{Rate, Slot, worst_wait};
/// use rtnet::time::Span;
///
/// let us = Span::from_micros;
/// let slot = |id, offset| Slot { owner: "arm".into(), id, offset: us(offset), phase: 0, period: 1, size: 1500 };
/// let rate = Rate::from_bits_per_second(1_000_000_000);
/// let air = Span::from_nanos(12_304);
///
/// // In cycles of 1 ms with a slot each it is a cycle; with a second one, joint, the longer of the times between.
/// let worst = |slots: &[Slot]| worst_wait(us(1_000), slots, us(50), rate);
/// assert_eq!(worst(&[slot(0, 100)]), Some(us(1_050) + air));
/// assert_eq!(worst(&[slot(0, 100), slot(2, 400)]), Some(us(750) + air));
/// ```
pub fn worst_wait(cycle: Span, slots: &[Slot], lead: Span, rate: Rate) -> Option<Span> {
    let largest = slots.iter().map(|slot| slot.size).max()?;
    Some(longest_between(cycle, slots)? + lead + rate.air_time(largest + ethernet::HEADER_LEN))
}

/// The longest time from one turn's begin to the next one's, of any of these slots. Where their periods let that repeat only after
/// more cycles than are looked through it is the shortest of those, which none exceeds.
pub fn longest_between(cycle: Span, slots: &[Slot]) -> Option<Span> {
    let shortest = || slots.iter().map(|slot| cycle * i64::from(slot.period.max(1))).min();
    Turns::of(cycle, slots).map(|turns| turns.longest_between()).or_else(shortest)
}

/// From when a question is queued for the slot `asks` to when the answer that is sent in `answers` has come. Each frame
/// is on its way so long, from its slot's begin to its receive stamp.
pub fn round_trip(cycle: Span, asks: &Slot, answers: &Slot, lead: Span, ways: [Span; 2]) -> Wait {
    let [there, back] = ways;
    // Cycles from the one of the question until the slot of the answer comes late enough, whatever its phase.
    let behind = asks.offset + there + lead - answers.offset;
    let least = (behind.nanos().max(0) as u64).div_ceil(cycle.nanos() as u64) as u32;
    // Further ones until it is used: for a question in the cycles `phase` of `period`, every so many of these are met.
    let met = gcd(asks.period.into(), answers.period.into());
    let phase = u64::from(asks.phase) + u64::from(least);
    let first = (u64::from(answers.phase) % met + met - phase % met) % met;
    let last = first + u64::from(answers.period) - met;
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
    fn of_joint_slots_the_longest_time_between_two_turns_counts_over_all_cycles() {
        let between = |slots: &[Slot]| longest_between(CYCLE, slots).map(|span| span.nanos() / 1_000);
        assert_eq!(between(&[]), None);
        assert_eq!(between(&[slot(300, 4, 5)]), Some(5_000));
        assert_eq!(between(&[slot(300, 0, 1), slot(500, 0, 1)]), Some(800));
        // 0 and 3 of 6, and 1 of 4: at 0, 1, 3, 5, 6, 9, 12.
        assert_eq!(between(&[slot(300, 0, 3), slot(300, 1, 4)]), Some(3_000));
        assert_eq!(between(&[slot(300, 0, 4), slot(400, 2, 4)]), Some(2_100));
        // It would take minutes until that repeats.
        assert_eq!(between(&[slot(300, 0, 65_535), slot(400, 1, 65_536)]), Some(65_535_000));
    }

    /// How long until a turn begins whose frame is not chosen yet, at every moment right behind a choice.
    fn waited(slots: &[Slot]) -> Span {
        let all = (0..400u32).flat_map(|cycle| {
            let used = slots.iter().filter(move |slot| cycle % slot.period == slot.phase);
            used.map(move |slot| CYCLE * i64::from(cycle) + slot.offset)
        });
        let mut begins: Vec<Span> = all.collect();
        begins.sort_unstable();
        // From the first turn to the last, which is no longer than any other time between two.
        begins.windows(2).map(|pair| pair[1] - (pair[0] - LEAD)).max().unwrap()
    }

    proptest! {
        #[test]
        fn a_frame_waits_no_longer_than_it_is_said_and_so_long_right_behind_a_choice(
            drawn in prop::collection::vec((0i64..900, 1u32..7, 0u32..100), 1..4),
        ) {
            let slots: Vec<_> =
                drawn.iter().map(|&(offset, period, phase)| slot(60 + offset, phase % period, period)).collect();
            let rate = Rate::from_bits_per_second(1_000_000_000);
            let air = rate.air_time(1_500 + ethernet::HEADER_LEN);
            prop_assert_eq!(worst_wait(CYCLE, &slots, LEAD, rate), Some(waited(&slots) + air));
            if let [only] = &slots[..] {
                prop_assert_eq!(wait(CYCLE, only, LEAD).worst + air, waited(&slots) + air);
            }
        }
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
