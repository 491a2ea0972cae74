use proptest::prelude::*;
use rtnet::time::Span;

use super::super::Slot;
use super::*;

const CYCLE: Span = Span::from_micros(1_000);
const LEAD: Span = Span::from_micros(50);

fn turns(slots: &[(i64, u32, u32)]) -> Turns {
    let slot = |&(offset, phase, period): &(i64, u32, u32)| {
        let offset = Span::from_micros(offset);
        Slot { owner: "arm".into(), id: 0, offset, phase, period, size: 1500 }
    };
    Turns::of(CYCLE, &slots.iter().map(slot).collect::<Vec<_>>()).unwrap()
}

fn demand(every_us: i64, burst: u32) -> Demand {
    Demand { every: Span::from_micros(every_us), burst }
}

fn micros(turns: &Turns, demands: &[Demand]) -> Option<i64> {
    worst_queueing(turns, LEAD, demands).map(|wait| wait.nanos() / 1_000)
}

#[test]
fn a_frame_alone_waits_as_long_as_turns_are_apart_and_a_burst_for_as_many() {
    let every_cycle = turns(&[(300, 0, 1)]);
    assert_eq!(micros(&every_cycle, &[demand(1_000, 1)]), Some(1_050));
    assert_eq!(micros(&every_cycle, &[demand(10_000, 4)]), Some(4_050));
    assert_eq!(micros(&turns(&[(300, 1, 4)]), &[demand(10_000, 2)]), Some(8_050));
    // Two in each cycle, 200 us and 800 us apart: the longer one is missed first, or the shorter.
    let two = turns(&[(300, 0, 1), (500, 0, 1)]);
    assert_eq!(micros(&two, &[demand(10_000, 1)]), Some(850));
    assert_eq!(micros(&two, &[demand(10_000, 3)]), Some(1_850));
}

#[test]
fn what_is_more_urgent_goes_before_also_what_is_queued_meanwhile() {
    let every_cycle = turns(&[(300, 0, 1)]);
    // Urgent ones at 0, 1.5, 3, 4.5 ms take turns 1, 2, 4, 5; the third own frame leaves in turn 9, with those at 6, 7.5.
    let (urgent, own) = (demand(1_500, 1), demand(100_000, 3));
    assert_eq!(micros(&every_cycle, &[urgent, own]), Some(9_050));
    assert_eq!(most_waiting(&every_cycle, &[urgent, own]), Some(4));
    // The first has left, but others of the same demand have come to wait behind it.
    assert_eq!(micros(&every_cycle, &[demand(4_000, 2), demand(2_500, 1)]), Some(3_050));
}

#[test]
fn what_wants_more_turns_than_there_are_waits_for_ever() {
    let every_cycle = turns(&[(300, 0, 1)]);
    let (half, rest) = (demand(2_000, 1), demand(1_999, 1));
    assert_eq!((load(&every_cycle, &[half]), load(&every_cycle, &[half, half])), (0.5, 1.0));
    assert_eq!(micros(&every_cycle, &[half, half]), Some(2_050));
    assert_eq!(micros(&every_cycle, &[half, rest]), None);
    assert_eq!(most_waiting(&every_cycle, &[half, rest]), None);
    assert_eq!(micros(&every_cycle, &[]), None);
}

/// What comes of it, turn by turn: the longest that an own frame waits from its moment, and the most that wait.
fn played(turns: &Turns, missed: usize, phases: &[Span], demands: &[Demand]) -> (Span, u64) {
    let mut waiting: Vec<(usize, Span)> = Vec::new();
    let mut next: Vec<Span> = phases.to_vec();
    let (mut longest, mut most) = (Span::ZERO, 0);
    for turn in 1..400 {
        let chosen = turns.after(missed, turn);
        for (i, of) in demands.iter().enumerate() {
            // A moment that is that of a choice is too late for it.
            while next[i] < chosen {
                waiting.extend((0..of.burst).map(|_| (i, next[i])));
                next[i] = next[i] + of.every;
            }
        }
        waiting.sort_unstable();
        most = most.max(waiting.len() as u64);
        if waiting.is_empty() {
            continue;
        }
        let (whose, queued) = waiting.remove(0);
        if whose + 1 == demands.len() {
            longest = longest.max(chosen + LEAD - queued);
        }
    }
    (longest, most)
}

proptest! {
    #[test]
    fn a_frame_waits_so_long_if_all_are_queued_right_behind_a_choice_and_never_longer(
        slots in prop::collection::vec((60i64..900, 0u32..100, 1u32..5), 1..3),
        drawn in prop::collection::vec((100i64..20_000, 1u32..4), 1..4),
        phases in prop::collection::vec(0i64..20_000, 4),
        start in 0usize..100,
    ) {
        let slots: Vec<_> = slots.iter().map(|&(offset, phase, period)| (offset, phase % period, period)).collect();
        let turns = turns(&slots);
        let demands = |times| drawn.iter().map(move |&(every, burst)| demand(every * times, burst)).collect::<Vec<_>>();
        // Demands are stretched to leave a tenth of the turns free: close to full load, a queue empties later than this test plays.
        let demands = demands(1 + (load(&turns, &demands(1)) / 0.9) as i64);
        let said = (worst_queueing(&turns, LEAD, &demands).unwrap(), most_waiting(&turns, &demands).unwrap());

        let at_once = vec![Span::ZERO; demands.len()];
        let all = (0..turns.count()).map(|missed| played(&turns, missed, &at_once, &demands));
        let reached = all.reduce(|a, b| (a.0.max(b.0), a.1.max(b.1))).unwrap();
        prop_assert_eq!(reached, said);

        let phases: Vec<_> = phases[..demands.len()].iter().map(|&us| Span::from_micros(us)).collect();
        let by_chance = played(&turns, start % turns.count(), &phases, &demands);
        prop_assert!(by_chance.0 <= said.0 && by_chance.1 <= said.1, "{:?} of {:?}", by_chance, said);
    }
}
