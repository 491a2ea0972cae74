mod believed;
mod held_up;
mod periods;
mod schedules;
mod sockets;
mod strays;

use rtmac::tdma::schedule::Rate;
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Opportunity, Service};
use rtnet::time::Instant;
use rtnet::wire::ethernet::Address;

use super::*;
use crate::judge::delivery::Heard;
use crate::report::figures::Role;
use crate::scenario::Uniform;
use crate::station::traffic::{Traffic, TrafficPlan};
use rtnet::clock::EmulatedClock;
use rtnet::time::Offset;

const CYCLE: u64 = 1_000_000;
const FIRST: u32 = 10;
const CYCLES: u32 = 5;

/// An observer of two stations whose clocks are the true one.
struct Bench {
    scenario: Scenario,
    analysis: Analysis,
    traffic: Vec<Traffic>,
}

impl Bench {
    fn new() -> Self {
        Self::of(|_| ())
    }

    fn of(change: impl FnOnce(&mut Scenario)) -> Self {
        let scenario = Uniform {
            stations: 2,
            cycle: Span::from_millis(1),
            duration: Span::from_millis(5),
            payload: 64,
            rate: Rate::from_bits_per_second(100_000_000),
            guard: None,
            seed: 1,
            vnic: None,
        };
        let mut scenario = scenario.scenario().unwrap().with_ideal_clocks();
        change(&mut scenario);
        let master = TrueMaster { clock: EmulatedClock::default(), epoch: Offset::default() };
        let mut analysis = Analysis::new(&scenario, master);
        analysis.begin(FIRST, CYCLES);
        let traffic = (0..2).map(|station| {
            let plan = TrafficPlan {
                station,
                source: scenario.address(usize::from(station)),
                destination: Address::default(),
                from: 1 - station,
                payload: 64,
                from_payload: 64,
                first: 0,
            };
            Traffic::new(plan, Default::default())
        });
        Self { traffic: traffic.collect(), scenario, analysis }
    }

    fn sync(&mut self, cycle: u32, late: i64) {
        self.sync_from(Address::default(), cycle, late);
    }

    fn sync_from(&mut self, from: Address, cycle: u32, late: i64) {
        self.sync_that_says(None, from, cycle, late);
    }

    fn sync_that_says(&mut self, status: Option<Status>, from: Address, cycle: u32, late: i64) {
        let start = u64::from(cycle) * CYCLE;
        let sched = GlobalTime::from_nanos(start);
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, from, &mut frame);
        status.iter().for_each(|status| status.write(&mut frame));
        self.analysis.frame(start.wrapping_add_signed(late), &frame);
    }

    fn data(&mut self, station: usize, cycle: u32, late: i64) {
        self.data_by_a_line_off(station, cycle, 0, late);
    }

    /// A frame of a station whose own time line is wrong.
    fn data_by_a_line_off(&mut self, station: usize, cycle: u32, off: i64, late: i64) {
        let offset = self.scenario.stations[station].slots[0].offset;
        let begin = (u64::from(cycle) * CYCLE + offset.nanos() as u64).wrapping_add_signed(off);
        let slot = Opportunity {
            channel: 0,
            cycle,
            begin: Instant::from_nanos(begin),
            scheduled: GlobalTime::from_nanos(begin),
            non_rt: None,
        };
        let mut made: Option<Buf> = None;
        self.traffic[station].fill(&slot, None, &mut |frame, _, _| {
            made = Some(frame);
            Ok(())
        });
        self.analysis.frame(begin.wrapping_add_signed(late), &made.unwrap());
    }

    /// The cycles of the window and one more, with `change` in the place of what ought to happen in cycle 12.
    fn run(mut self, change: impl Fn(&mut Bench)) -> Analysis {
        for cycle in FIRST..=FIRST + CYCLES {
            if cycle == 12 {
                change(&mut self);
                continue;
            }
            self.sync(cycle, 0);
            self.data(0, cycle, 0);
            self.data(1, cycle, 0);
        }
        self.analysis.finish();
        self.analysis
    }
}

fn found(analysis: &Analysis) -> Vec<(u32, FindingKind, Option<usize>)> {
    analysis
        .findings
        .iter()
        .map(|f| (f.cycle, f.kind, f.authors.into_iter().flatten().next_back().map(|author| author.station)))
        .collect()
}

#[test]
fn a_frame_in_a_cycle_without_its_slots_turn_is_out_of_slot() {
    let by_turns = |scenario: &mut Scenario| {
        let slot = &mut scenario.stations[1].slots[0];
        (slot.phase, slot.period) = (0, 2);
    };
    let analysis = Bench::of(by_turns).run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 0);
        bench.data(1, 12, 0);
    });
    let odd = |cycle| (cycle, FindingKind::OutOfSlot, Some(1));
    assert_eq!(found(&analysis), [odd(11), odd(13)]);
    assert_eq!((analysis.stations[1].frames, analysis.stations[1].stray), (3, 2));
}

#[test]
fn when_all_is_well_nothing_is_found() {
    let analysis = Bench::new().run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 0);
        bench.data(1, 12, 0);
    });
    assert_eq!(found(&analysis), []);
    assert!(analysis.is_complete());
    assert_eq!((analysis.syncs, analysis.cycles()), (5, 5));
    assert_eq!((analysis.expected(1), analysis.stations[1].frames), (5, 5));
    assert_eq!(analysis.stations[1].slot_error.max(), 0);
}

#[test]
fn what_is_missing_is_found_by_cycle_and_station() {
    let analysis = Bench::new().run(|bench| bench.data(0, 12, 0));
    let missing = [(12, FindingKind::SyncGap, Some(0)), (12, FindingKind::SlotMissed, Some(1))];
    assert_eq!(found(&analysis), missing);
    assert_eq!((analysis.expected(1), analysis.stations[1].frames), (5, 4));
}

#[test]
fn a_sync_that_is_missing_is_of_who_gave_the_time_before() {
    let mut bench = Bench::of(|scenario| scenario.stations[1].role = Role::Backup);
    let [primary, backup] = [0, 1].map(|station| bench.scenario.address(station));
    for (from, cycle) in [(primary, 9), (primary, 10), (backup, 12), (backup, 14), (primary, 15)] {
        bench.sync_from(from, cycle, 0);
    }
    let gaps = found(&bench.analysis).into_iter().filter(|&(_, kind, _)| kind == FindingKind::SyncGap);
    assert_eq!(gaps.map(|(cycle, _, by)| (cycle, by)).collect::<Vec<_>>(), [(11, Some(0)), (13, Some(1))]);
}

#[test]
fn a_slot_missed_to_the_end_is_found_too() {
    let mut bench = Bench::new();
    for cycle in FIRST..=FIRST + CYCLES {
        bench.sync(cycle, 0);
        bench.data(0, cycle, 0);
    }
    bench.analysis.finish();
    let missed: Vec<_> = (FIRST..FIRST + CYCLES).map(|c| (c, FindingKind::SlotMissed, Some(1))).collect();
    assert_eq!(found(&bench.analysis), missed);
}

#[test]
fn frames_that_leave_their_slot_or_overlap_are_found() {
    // Two stations: slots of 437.5 us, so a guard band of 429.34 us and 35.78 us of it for the clocks.
    let shifted = |first: i64, second: i64| {
        Bench::new().run(move |bench| {
            bench.sync(12, 0);
            bench.data(0, 12, first);
            bench.data(1, 12, second);
        })
    };
    let late = |by| shifted(by, 0);
    assert_eq!(found(&shifted(0, -35_770)), []);
    assert_eq!(found(&shifted(0, -35_790)), [(12, FindingKind::OutOfSlot, Some(1))]);
    assert_eq!(found(&late(393_500)), []);
    assert_eq!(found(&late(393_600)), [(12, FindingKind::OutOfSlot, Some(0))]);
    let both = [(12, FindingKind::OutOfSlot, Some(0)), (12, FindingKind::Overlap, Some(1))];
    assert_eq!(found(&late(432_000)), both);
}

#[test]
fn the_frame_that_ends_latest_is_known() {
    let analysis = Bench::new().run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 437_400);
        bench.data(1, 12, 0);
    });
    // It leaves the air a hundred nanoseconds before the end of its slot of 437.5 us, and its own 8.16 us later.
    assert_eq!((analysis.latest.value(), analysis.latest.cycle()), (Some(8_060), Some(12)));
    let latest_sync = Bench::new().run(|bench| bench.sync(12, 120_000)).latest.value().unwrap();
    assert!(latest_sync > 0, "{latest_sync}");
}

#[test]
fn a_frame_of_somebody_else_overlaps_too() {
    let analysis = Bench::new().run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 0);
        let on_air = 12 * CYCLE + bench.scenario.stations[0].slots[0].offset.nanos() as u64 + 1_000;
        bench.analysis.frame(on_air, &[0x02; 60]);
        bench.data(1, 12, 0);
    });
    assert_eq!(found(&analysis), [(12, FindingKind::Overlap, Some(0))]);
}

#[test]
fn a_slave_that_sends_though_two_syncs_are_missing_is_found() {
    let mut bench = Bench::new();
    for cycle in FIRST..=FIRST + CYCLES {
        if ![12, 13].contains(&cycle) {
            bench.sync(cycle, 0);
        }
        bench.data(0, cycle, 0);
        bench.data(1, cycle, 0);
    }
    bench.analysis.finish();
    let gaps = [12, 13].map(|cycle| (cycle, FindingKind::SyncGap, Some(0)));
    let mut all = vec![(13, FindingKind::WithoutSync, Some(1))];
    all.extend(gaps);
    assert_eq!(found(&bench.analysis), all, "12 is bridged, and the master needs none");
}

#[test]
fn a_station_that_fell_silent_is_found_while_it_is_so() {
    let mut bench = Bench::new();
    for cycle in FIRST..FIRST + CYCLES {
        bench.sync(cycle, 0);
        bench.data(0, cycle, 0);
        if cycle < 12 {
            bench.data(1, cycle, 0);
        }
    }
    bench.analysis.look_back(1, 13);
    assert_eq!(found(&bench.analysis), [(12, FindingKind::SlotMissed, Some(1))]);
    // That it was taken away in 14 does not excuse what was before.
    assert_eq!(bench.analysis.pass_over(1, 14, 15), 1);
    let missed = [12, 13].map(|cycle| (cycle, FindingKind::SlotMissed, Some(1)));
    assert_eq!(found(&bench.analysis), missed);
}

#[test]
fn a_station_in_time_by_its_own_wrong_line_is_not_in_its_slot() {
    let analysis = Bench::new().run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 0);
        bench.data_by_a_line_off(1, 12, 395_000, 0);
    });
    assert_eq!(found(&analysis), [(12, FindingKind::OutOfSlot, Some(1))]);
    assert_eq!(analysis.stations[1].slot_error.max(), 395_000);
}

#[test]
fn a_sync_that_tells_another_grid_is_found() {
    let analysis = Bench::new().run(|bench| {
        let (xmit, sched) = (GlobalTime::from_nanos(12 * CYCLE), GlobalTime::from_nanos(12 * CYCLE + 50));
        let mut frame = Pool::new(1).take().unwrap();
        let sync = Message::Sync { cycle: 12, xmit, sched };
        sync.write(Address::BROADCAST, Address::default(), &mut frame);
        bench.analysis.frame(12 * CYCLE, &frame);
        bench.data(0, 12, 0);
        bench.data(1, 12, 0);
    });
    assert_eq!(found(&analysis), [(12, FindingKind::OutOfSlot, Some(0))]);
}

#[test]
fn a_late_sync_or_a_second_one_is_found() {
    let with = |late: i64, twice: bool| {
        Bench::new().run(move |bench| {
            bench.sync(12, late);
            if twice {
                bench.sync(12, late + 10_000);
            }
            bench.data(0, 12, 0);
            bench.data(1, 12, 0);
        })
    };
    assert_eq!(found(&with(118_000, false)), []);
    // It is still on the air when the master's slot begins.
    let both = [(12, FindingKind::OutOfSlot, Some(0)), (12, FindingKind::Overlap, Some(0))];
    assert_eq!(found(&with(118_500, false)), both);
    assert_eq!(found(&with(0, true)), [(12, FindingKind::Repeated, Some(0))]);
}

#[test]
fn a_sync_that_newer_ones_have_overtaken_sets_nothing_back() {
    let mut bench = Bench::new();
    for cycle in (FIRST..=FIRST + CYCLES).filter(|&cycle| cycle != 11) {
        if cycle != 14 {
            bench.sync(cycle, 0);
        }
        bench.data(0, cycle, 0);
        bench.data(1, cycle, 0);
        if cycle == 13 {
            bench.sync(11, 2 * CYCLE as i64 + 900_000);
        }
    }
    bench.analysis.finish();
    let mut found = found(&bench.analysis);
    found.retain(|(.., kind, _)| *kind != FindingKind::SlotMissed);
    let late = [FindingKind::OutOfSlot, FindingKind::Repeated].map(|kind| (11, kind, Some(0)));
    let gaps = [11, 14].map(|cycle| (cycle, FindingKind::SyncGap, Some(0)));
    assert_eq!(found, [gaps[0], late[0], late[1], gaps[1]], "13 bridges 14");
}

#[test]
fn what_nobody_looked_at_is_missed_but_no_finding() {
    let mut bench = Bench::new();
    for cycle in FIRST..=FIRST + CYCLES {
        match cycle {
            11 => bench.analysis.lose_sight(),
            12 => {}
            _ => {
                bench.sync(cycle, 0);
                bench.data(0, cycle, 0);
                if cycle != 14 {
                    bench.data(1, cycle, 0);
                }
            }
        }
    }
    bench.analysis.finish();
    assert_eq!(found(&bench.analysis), [(14, FindingKind::SlotMissed, Some(1))]);
    assert_eq!((bench.analysis.expected(0), bench.analysis.stations[0].frames), (5, 3));
}

#[test]
fn what_is_passed_over_is_missed_but_counted_elsewhere() {
    let mut bench = Bench::new();
    bench.sync(FIRST, 0);
    bench.data(0, FIRST, 0);
    bench.data(1, FIRST, 0);
    // Nobody is there in cycles 11 to 13.
    assert_eq!(bench.analysis.pass_over(1, 11, 14), 3);
    assert_eq!((bench.analysis.pass_over(0, 11, 14), bench.analysis.pass_over_syncs(11, 14)), (3, 3));
    assert_eq!((bench.analysis.pass_over(1, 11, 14), bench.analysis.pass_over_syncs(11, 14)), (0, 0), "once");
    bench.sync(14, 0);
    bench.data(1, 14, 0);
    bench.analysis.advance_to(FIRST + CYCLES);
    bench.analysis.finish();
    assert_eq!(found(&bench.analysis), [(14, FindingKind::SlotMissed, Some(0))]);
    assert_eq!((bench.analysis.expected(1), bench.analysis.stations[1].frames), (5, 2));
    let summary = bench.analysis.sync_period.summary();
    assert_eq!(
        (summary.n, summary.gaps, summary.longest_gap_ns),
        (0, Some(1), Some(4_000_000)),
        "no neighbours"
    );
}

#[test]
fn who_looks_away_after_the_end_forgets_nothing() {
    let mut bench = Bench::new();
    for cycle in (FIRST..=FIRST + CYCLES).filter(|&cycle| cycle != 12) {
        bench.sync(cycle, 0);
        bench.data(0, cycle, 0);
        bench.data(1, cycle, 0);
    }
    bench.analysis.lose_sight();
    bench.analysis.finish();
    assert_eq!(bench.analysis.findings.len(), 3, "cycle 12, to which nobody kept");
}

#[test]
fn what_comes_after_an_early_end_does_not_count() {
    let mut bench = Bench::new();
    for cycle in [FIRST, FIRST + 1] {
        bench.sync(cycle, 0);
        bench.data(0, cycle, 0);
        bench.data(1, cycle, 0);
    }
    bench.analysis.end();
    bench.sync(FIRST + 2, 0);
    bench.data(1, FIRST + 2, 0);
    bench.analysis.finish();
    assert_eq!(found(&bench.analysis), []);
    // The second cycle had begun when it ended.
    assert_eq!((bench.analysis.expected(1), bench.analysis.stations[1].frames), (2, 2));
    let heard = Heard { anew: false, received: 2, range: Some((0, 1)) };
    assert_eq!(bench.analysis.stations[1].passed.lost(&heard), 0);
}

#[test]
fn after_a_step_of_the_wall_clock_nothing_is_compared_across_it() {
    let analysis = Bench::new().run(|bench| {
        bench.sync(12, 0);
        bench.analysis.frame(u64::MAX - 5, &[0; 60]);
        bench.analysis.lose_sight();
        bench.data(0, 12, 0);
        bench.data(1, 12, 0);
    });
    assert_eq!(found(&analysis), []);
}
