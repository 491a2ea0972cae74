//! Masters die, at every step of a change, and frames are lost meanwhile: one schedule is in use at any time, and all have the
//! same in the end.

use super::*;

/// From the proposal to well behind the activation cycle.
const STEPS: u64 = 80;
/// Where in a cycle of 2 ms a master dies: before its Synchronisation, behind it, behind a part of a schedule, in the slots.
const WITHIN: [u64; 4] = [1_990_000, 4_000, 30_000, 900_000];

struct Killing {
    backups: usize,
    cycle: Span,
    /// Control and other frames that are lost, in a million.
    loss: u32,
    returns: bool,
}

impl Killing {
    /// The master dies so long after the proposal; what is in use in the end.
    fn at(&self, after: u64) -> usize {
        let first = plan(self.backups);
        let second = turned(&first, self.cycle);
        let mut changing = Changing::running(first, second);
        changing.lose(self.loss);
        changing.propose(Some(Activation::Soon)).unwrap();
        let now = changing.lab.network.now();
        changing.lab.network.run_until(now + after);
        changing.lab.network.stop(0);
        if self.returns {
            let (cycle, at) = (changing.schedules[0].cycle(), changing.lab.network.now() + 60_123_456);
            changing.run_cycles(30);
            changing.lab.add(0, Some(cycle), at);
        }
        changing.run_cycles(150);
        changing.lose(0);
        changing.run_cycles(500);
        let situation = format!("killed after {} us", after / 1_000);
        let watch = changing.watch.borrow();
        watch.check(&situation);
        let alive = if self.returns { 1..STATIONS + 1 } else { 1..STATIONS };
        let in_use: Vec<u16> = alive.map(|id| changing.in_use(id)).collect();
        let all = || (0..in_use.len()).map(|i| (changing.change(i + 1), changing.lab.status(i + 1).mastery));
        assert!(
            in_use.iter().all(|number| *number == in_use[0]),
            "{situation}: {:#?}",
            all().collect::<Vec<_>>()
        );
        if self.backups > 0 {
            assert_eq!(watch.last_used(), Some(usize::from(in_use[0])), "{situation}");
            let last = *watch.data.keys().next_back().unwrap() - 1;
            assert!(watch.data[&last].len() >= STATIONS - 1, "{situation}: all that live send");
        }
        in_use[0].into()
    }

    /// At every step; how often the old one, and the new one, was in use in the end.
    fn everywhere(&self, every: u64) -> [usize; 2] {
        let mut ends = [0; 2];
        let cycle = 2_000_000;
        for step in (0..STEPS).step_by(every as usize) {
            for within in WITHIN {
                ends[self.at(step * cycle + within)] += 1;
            }
        }
        assert!(ends[0] > 0 && ends[1] > 0, "both are possible: {ends:?}");
        ends
    }
}

#[test]
fn a_master_that_dies_at_any_step_leaves_one_schedule_where_backups_take_over() {
    Killing { backups: 2, cycle: Span::from_millis(2), loss: 0, returns: false }.everywhere(1);
}

#[test]
fn so_it_does_where_the_cycle_changes_its_length() {
    Killing { backups: 1, cycle: Span::from_micros(2_500), loss: 0, returns: false }.everywhere(1);
}

#[test]
fn so_it_does_where_frames_are_lost() {
    Killing { backups: 2, cycle: Span::from_micros(2_500), loss: 50_000, returns: false }.everywhere(1);
}

#[test]
fn a_master_that_dies_and_returns_follows_what_is_in_use_then() {
    Killing { backups: 1, cycle: Span::from_micros(2_500), loss: 0, returns: true }.everywhere(2);
}

#[test]
fn without_a_backup_nobody_sends_in_either_once_the_master_is_dead() {
    let killing = Killing { backups: 0, cycle: Span::from_millis(2), loss: 0, returns: false };
    killing.everywhere(2);
}
