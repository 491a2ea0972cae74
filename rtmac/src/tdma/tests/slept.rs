//! Who sleeps through slots, or hears of its Synchronisations too late, tells of each.

use super::*;

#[test]
fn a_slot_that_was_silent_because_syncs_came_late_says_so() {
    let mut slave = locked_slave();
    assert!(slave.next_transmission(at(4_400)).is_none());
    let [overrun, silent] = told(&mut slave)[..] else { panic!() };
    assert_eq!(
        overrun,
        (3, EventKind::Overrun, Span::from_micros(980)),
        "its slot was allowed, but it slept"
    );
    assert_eq!(silent, (4, EventKind::SlotSilent, Span::ZERO));
    hear_syncs(&mut slave, 3..=5);
    let late = [(3, Span::from_micros(1_400)), (4, Span::from_micros(400))];
    assert_eq!(told(&mut slave), late.map(|(cycle, by)| (cycle, EventKind::SyncLate, by)));
    assert_eq!(slave.status().counters.syncs_late, 2, "that of cycle 5 was in time");
    hear_syncs(&mut slave, 6..=1_005);
    assert_eq!(slave.silent, None, "nor is any that comes when numbers have started over");
}

#[test]
fn who_slept_through_slots_whose_syncs_came_has_overrun_them() {
    let mut slave = locked_slave();
    hear_syncs(&mut slave, 3..=5);
    // The newest was held up on its way.
    let sched = GlobalTime::from_nanos(6_000_000);
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle: 6, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
    slave.on_frame(Some(at(6_450)), frame);
    assert!(slave.next_transmission(at(6_500)).is_none());
    let kinds: Vec<_> = told(&mut slave).iter().map(|&(cycle, kind, _)| (cycle, kind)).collect();
    let overrun = |cycle| (cycle, EventKind::Overrun);
    assert_eq!(kinds, [(6, EventKind::TimeStep), overrun(3), overrun(4), overrun(5), overrun(6)]);
}

#[test]
fn who_slept_while_the_line_moved_has_overrun_the_slots_of_the_old_one() {
    let mut slave = locked_slave();
    // Two syncs of a master that has moved its cycles by as much, some cycles apart: a new line begins.
    for cycle in [3, 7] {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000 + 50_000);
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
        slave.on_frame(Some(at(u64::from(cycle) * 1_000 + 50)), frame);
    }
    slave.next_transmission(at(7_100));
    let kinds: Vec<_> = told(&mut slave).iter().map(|&(cycle, kind, _)| (cycle, kind)).collect();
    let overrun = |cycle| (cycle, EventKind::Overrun);
    assert_eq!(kinds, [(3, EventKind::TimeStep), overrun(3), overrun(4), overrun(5), overrun(6)]);
}

#[test]
fn who_slept_until_its_line_was_too_old_tells_of_every_slot_and_that_it_has_none() {
    let mut slave = locked_slave();
    slave.on_timeout(at(4_500));
    assert_eq!(slave.time().state, SyncState::Lost);
    told(&mut slave);
    slave.on_timeout(at(1_500_100));
    assert_eq!(slave.next_deadline(), None);
    let told = told(&mut slave);
    assert_eq!(told[0].1, EventKind::LineGivenUp);
    let overrun =
        told[1..].iter().filter(|&&(_, kind, _)| kind == EventKind::Overrun).map(|&(cycle, ..)| cycle);
    assert!(overrun.eq(3..=1_499), "{told:?}");
}

#[test]
fn who_becomes_something_else_while_it_calibrates_has_missed_no_turns() {
    let mut slave = Tdma::new(&with_slots(5, &[(0, 1), (2, 1)])).unwrap();
    hear_syncs(&mut slave, 1..=500);
    told(&mut slave);
    slave.command(at(500_100), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    assert_eq!((slave.status().counters.slots_silent, told(&mut slave)), (0, vec![]));
}

#[test]
fn who_becomes_something_else_after_a_long_sleep_tells_of_the_last_turns_only() {
    let mut slave = locked_slave();
    slave.command(at(100_000_100), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    let turns = slave.status().counters.slots_silent;
    assert_eq!((told(&mut slave).len(), turns), (10_000, 99_998), "each that is told of takes its time");
}

#[test]
fn who_slept_for_an_hour_goes_through_few_of_its_jobs_and_counts_all() {
    let mut master = active_master();
    told(&mut master);
    let hour = 3_600_000_000;
    assert!(master.next_transmission(at(hour + 900)).is_none());
    let Counters { syncs_skipped, overruns, .. } = master.status().counters;
    assert_eq!((syncs_skipped, overruns), (3_599_997, 3_599_997), "one of each in every cycle");
    assert_eq!(
        (told(&mut master).len(), master.status().events_lost),
        (10_002, 0),
        "and those of this cycle"
    );
    assert_eq!(sent_next(&mut master), at(hour + 1_000), "on the grid that it had");
    assert_eq!(master.status().cycle, 3_599_998);
}

#[test]
fn who_finds_another_line_after_a_long_sleep_tells_of_the_first_turns_only() {
    let mut slave = locked_slave();
    for cycle in 1..=2 {
        let sched = GlobalTime::from_nanos(100_000_000_000 + cycle * 1_000_000);
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle: 7_000_000 + cycle as u32, xmit: sched, sched }.write(
            Address::BROADCAST,
            OTHER,
            &mut frame,
        );
        slave.on_frame(Some(at(100_000_000 + cycle * 1_000)), frame);
    }
    assert_eq!(slave.status().counters.overruns, 9_999, "of 100 000");
}

#[test]
fn a_switch_counts_no_turns_that_have_not_come() {
    for ahead in [1 << 30, i32::MAX as u32 - 5] {
        let mut slave = locked_slave();
        hear_syncs(&mut slave, 3..=5);
        slave.leave_until(5 + ahead, at(5_500));
        // Those of cycles 3 to 5, and of the next one, which may be about to begin.
        assert_eq!(slave.status().counters.slots_silent, 4, "{ahead} ahead");
    }
}
