use super::*;

fn frame(station: usize, cycle: u32, error: i64) -> OnAir {
    let author = Some(Author { station, cycle, slot: Some(0) });
    let at = Span::from_micros(100) + Span::from_nanos(error);
    OnAir { author, at, air: Span::from_nanos(700), error: Some(Span::from_nanos(error)) }
}

fn fault(kind: FindingKind, span: i64) -> Fault {
    let author = Author { station: 0, cycle: 0, slot: Some(0) };
    Fault {
        kind: FaultKind::Found(kind),
        authors: [Some(author), None],
        span: Span::from_nanos(span),
        cause: None,
    }
}

fn numbers(cycles: &[Captured]) -> Vec<u32> {
    cycles.iter().map(|captured| captured.cycle).collect()
}

#[test]
fn of_a_long_run_the_worst_cycles_are_kept_worst_first_and_nothing_else() {
    let mut captures = Captures::of(4);
    let n = 20_000;
    for cycle in 1..=n {
        captures.frame(cycle, frame(0, cycle, 0));
        if cycle % 100 == 0 {
            captures.fault(cycle, fault(FindingKind::OutOfSlot, cycle.into()));
        }
    }
    let Finished { worst, ordinary, faulty, .. } = captures.finish();
    let expected: Vec<u32> = (0..WORST_MAX as u32).map(|i| n - 100 * i).collect();
    assert_eq!((numbers(&worst), faulty), (expected, 200));
    assert_eq!(ordinary.map(|ordinary| ordinary.cycle), Some(1));
}

#[test]
fn what_is_found_later_is_of_its_cycle_unless_that_is_long_ago() {
    let mut captures = Captures::of(1_000);
    let recent = captures.recent.len() as u32;
    assert_eq!(recent, RECENT.0 as u32);
    for cycle in 0..recent {
        captures.frame(cycle, frame(0, cycle, 0));
    }
    captures.fault(0, fault(FindingKind::SlotMissed, 0));
    captures.frame(recent, frame(0, recent, 0));
    captures.fault(0, fault(FindingKind::Overlap, 1));
    let Finished { worst, faulty, .. } = captures.finish();
    assert_eq!((numbers(&worst), worst[0].faults.len(), faulty), (vec![0], 1, 1));
    assert_eq!(worst[0].frames, [frame(0, 0, 0)]);
}

#[test]
fn a_kind_of_which_there_are_many_hides_no_other() {
    let mut captures = Captures::of(4);
    for cycle in 0..300 {
        captures.fault(cycle, fault(FindingKind::Overlap, 1_000 - i64::from(cycle)));
    }
    captures.fault(300, fault(FindingKind::SlotMissed, 0));
    captures.fault(301, fault(FindingKind::SyncGap, 0));
    let worst = numbers(&captures.finish().worst);
    assert_eq!(worst, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 301, 300]);
}

#[test]
fn cycle_numbers_go_round() {
    let mut captures = Captures::of(4);
    for cycle in [u32::MAX - 1, u32::MAX, 0, 1] {
        captures.frame(cycle, frame(0, cycle, 0));
        captures.fault(cycle, fault(FindingKind::SlotMissed, 0));
    }
    assert_eq!(numbers(&captures.finish().worst), [u32::MAX - 1, u32::MAX, 0, 1]);
}

#[test]
fn a_babbler_takes_no_more_room_than_a_cycle_has() {
    let mut captures = Captures::of(4);
    for _ in 0..FRAMES_MAX + 10 {
        captures.frame(7, frame(0, 7, 0));
        captures.fault(7, fault(FindingKind::Overlap, 1));
    }
    let worst = captures.finish().worst;
    assert_eq!((worst[0].frames.len(), worst[0].more, worst[0].faults.len()), (FRAMES_MAX, 10, FAULTS_MAX));
}

#[test]
fn the_spread_of_a_cycle_is_between_its_own_frames() {
    let mut captures = Captures::of(4);
    for (cycle, errors) in [(1, [-300, 500]), (2, [0, 100])] {
        (0..).zip(errors).for_each(|(station, error)| captures.frame(cycle, frame(station, cycle, error)));
    }
    // One alone has none, and one of another cycle is not its.
    captures.frame(3, frame(0, 3, 9_000));
    captures.frame(3, frame(1, 2, 0));
    assert_eq!(captures.finish().spread, Largest { span: Some(Span::from_nanos(800)), n: 2 });
}
