//! Which schedule frames are judged by.

use rtmac::wire::change::{ScheduleId, State};

use super::*;

const NEXT: ScheduleId = ScheduleId { number: 1, sum: 0x1234 };
const OLD: ScheduleId = ScheduleId { number: 0, sum: 0 };

/// Two stations that will have one another's slots from cycle 12 on, as all know since cycle 10.
struct Changing {
    bench: Bench,
}

impl Changing {
    fn new() -> Self {
        let mut changing = Self { bench: Bench::new() };
        let slots = changing.turned();
        let cycle = changing.bench.scenario.cycle;
        changing.bench.analysis.may_switch(NEXT.sum, Known { cycle, slots });
        for cycle in [10, 11] {
            changing.sync(cycle, State::Sealed, OLD);
            changing.both(cycle);
        }
        changing
    }

    fn turned(&self) -> Vec<Vec<crate::scenario::SlotPlan>> {
        self.bench.scenario.stations.iter().rev().map(|station| station.slots.clone()).collect()
    }

    fn sync(&mut self, cycle: u32, state: State, oper: ScheduleId) {
        let status = Status { oper, admin: NEXT, activation: 12, state, is_sure: true };
        self.bench.sync_that_says(Some(status), Address::default(), cycle, 0);
    }

    fn both(&mut self, cycle: u32) {
        let mut stations = [0, 1];
        stations.sort_by_key(|&station| self.bench.scenario.stations[station].slots[0].offset);
        stations.iter().for_each(|&station| self.bench.data(station, cycle, 0));
    }

    /// From now on they send in one another's slots.
    fn turn(&mut self) {
        let slots = self.turned();
        let stations = self.bench.scenario.stations.iter_mut();
        stations.zip(slots).for_each(|(station, slots)| station.slots = slots);
    }

    /// All that was found, at the end.
    fn found(&mut self) -> Vec<(u32, FindingKind, Option<usize>)> {
        self.bench.analysis.finish();
        found(&self.bench.analysis)
    }
}

#[test]
fn a_schedule_that_is_sealed_is_in_use_though_the_synchronisation_of_its_first_cycle_is_missing() {
    let mut changing = Changing::new();
    changing.turn();
    // Who gives the time sends in its slots, though its Synchronisation was too late to be sent.
    changing.bench.data(0, 12, 0);
    for cycle in [13, 14, 15] {
        changing.sync(cycle, State::Switched, NEXT);
        changing.both(cycle);
    }
    let gaps = [(12, FindingKind::SyncGap, Some(0)), (12, FindingKind::SlotMissed, Some(1))];
    assert_eq!(changing.found(), gaps);
    let analysis = &mut changing.bench.analysis;
    assert!(analysis.changes() == 1 && analysis.take_switch().is_some());
}

#[test]
fn one_that_is_sealed_and_then_not_used_is_not_judged_by() {
    let mut changing = Changing::new();
    for cycle in 12..=15 {
        changing.sync(cycle, State::Cancelled, OLD);
        changing.both(cycle);
    }
    assert_eq!(changing.found(), []);
    let analysis = &mut changing.bench.analysis;
    assert!(analysis.changes() == 0 && analysis.take_switch().is_none());
}

#[test]
fn who_leaves_before_the_first_cycle_of_a_schedule_that_is_sealed_is_not_waited_for_in_either() {
    let mut changing = Changing::new();
    changing.bench.analysis.timetable.leave(1, 11);
    for cycle in [12, 13, 14, 15] {
        changing.sync(cycle, State::Switched, NEXT);
        if cycle == 12 {
            changing.turn();
        }
        changing.bench.data(0, cycle, 0);
    }
    let timetable = &changing.bench.analysis.timetable;
    assert_eq!((timetable.count(1, 8, 20), timetable.count(0, 8, 20)), (3, 12));
    assert_eq!(changing.found(), []);
}
