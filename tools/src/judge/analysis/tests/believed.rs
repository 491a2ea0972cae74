//! Forged frames: a cycle number goes no further than time has passed.

use proptest::prelude::*;

use super::*;

const STRANGER: Address = Address([2, 0, 0, 0, 9, 9]);
const RUN: u32 = 200;

/// A frame that somebody forges: when, as whom, of which cycle, and for when it says that it was scheduled.
#[derive(Clone, Debug)]
struct Forged {
    at: True,
    as_whom: usize,
    cycle: u32,
    sched: u64,
}

fn forged() -> impl Strategy<Value = Forged> {
    let at = u64::from(FIRST) * CYCLE..u64::from(FIRST + RUN) * CYCLE;
    let near = (FIRST..FIRST + RUN + 3, -3..4i32).prop_map(|(cycle, by)| cycle.wrapping_add_signed(by));
    let cycle = prop_oneof![near, any::<u32>(), (0..8u32).prop_map(|back| u32::MAX - back)];
    (at, 0..3usize, cycle, any::<u64>()).prop_map(|(at, as_whom, cycle, sched)| Forged {
        at,
        as_whom,
        cycle,
        sched,
    })
}

/// What is on the medium.
enum Frame {
    Sync(u32),
    Data(usize, u32),
    ForgedSync(Forged),
    ForgedData(Forged),
}

/// A network that does all it has to, and what somebody forges meanwhile: Synchronisations, and test traffic.
fn run(syncs: Vec<Forged>, data: Vec<Forged>) -> Analysis {
    let mut bench = Bench::of(|scenario| scenario.stations[1].role = Role::Backup);
    let of = [bench.scenario.address(0), bench.scenario.address(1), STRANGER];
    let offsets = [0, 1].map(|station| bench.scenario.stations[station].slots[0].offset.nanos());
    bench.analysis.begin(FIRST, RUN);
    let mut all: Vec<(True, Frame)> = Vec::new();
    for cycle in FIRST..=FIRST + RUN {
        let start = u64::from(cycle) * CYCLE;
        all.push((start, Frame::Sync(cycle)));
        all.extend([0, 1].map(|station| (start + offsets[station] as u64, Frame::Data(station, cycle))));
    }
    all.extend(syncs.into_iter().map(|forged| (forged.at, Frame::ForgedSync(forged))));
    all.extend(data.into_iter().map(|forged| (forged.at, Frame::ForgedData(forged))));
    all.sort_by_key(|(at, _)| *at);
    // Traffic is made once for a turn: a forged frame of the turn that was last takes no other's place.
    let mut made = [None; 2];
    let mut is_new = |station: usize, cycle| made[station].replace(cycle) != Some(cycle);
    for (at, frame) in all {
        match frame {
            Frame::Sync(cycle) => bench.sync_from(of[0], cycle, 0),
            Frame::Data(station, cycle) if is_new(station, cycle) => bench.data(station, cycle, 0),
            Frame::ForgedSync(Forged { as_whom, cycle, sched, .. }) => {
                let (sched, mut frame) = (GlobalTime::from_nanos(sched), Pool::new(1).take().unwrap());
                let message = Message::Sync { cycle, xmit: sched, sched };
                message.write(Address::BROADCAST, of[as_whom], &mut frame);
                bench.analysis.frame(at, &frame);
            }
            Frame::ForgedData(Forged { as_whom, cycle, .. }) if is_new(as_whom % 2, cycle) => {
                let station = as_whom % 2;
                let begin = i64::from(cycle) * CYCLE as i64 + offsets[station];
                bench.data(station, cycle, at as i64 - begin);
            }
            Frame::Data(..) | Frame::ForgedData(_) => {}
        }
    }
    bench.analysis.finish();
    bench.analysis
}

fn count(analysis: &Analysis, kinds: &[FindingKind]) -> u64 {
    analysis.findings.iter().filter(|of| kinds.contains(&of.kind)).count() as u64
}

proptest! {
    /// What a forged Synchronisation makes is counted by forged frames, never by cycles.
    #[test]
    fn forged_syncs_make_no_misses(syncs in prop::collection::vec(forged(), 0..60)) {
        let n = syncs.len() as u64;
        let analysis = run(syncs, Vec::new());
        prop_assert_eq!(analysis.cycles(), RUN);
        prop_assert_eq!(count(&analysis, &[FindingKind::SyncGap, FindingKind::SlotMissed]), 0);
        prop_assert_eq!([0, 1].map(|station| analysis.expected(station)), [u64::from(RUN); 2]);
        // Two for the moment, one for the number; and it may overlap a frame, and be overlapped.
        prop_assert!(analysis.findings.len() as u64 <= 5 * n, "{:?}", analysis.findings);
        prop_assert_eq!(analysis.findings_dropped, 0);
        let Masters { takeover_cycles, rival_cycles, .. } = analysis.masters;
        prop_assert!(takeover_cycles <= RUN && rival_cycles <= RUN);
        prop_assert!(analysis.doubted.named().values().sum::<u64>() <= 2 * n);
    }

    /// A forged frame of a station takes the place of that one's own, which is the only one that is missed for it.
    #[test]
    fn forged_data_misses_no_more_turns_than_passed(
        syncs in prop::collection::vec(forged(), 0..20),
        data in prop::collection::vec(forged(), 0..60),
    ) {
        let analysis = run(syncs, data);
        prop_assert_eq!(analysis.cycles(), RUN);
        prop_assert!(count(&analysis, &[FindingKind::SlotMissed]) <= 2 * u64::from(RUN));
        prop_assert_eq!((count(&analysis, &[FindingKind::SyncGap]), analysis.findings_dropped), (0, 0));
        for station in 0..2 {
            prop_assert_eq!(analysis.expected(station), u64::from(RUN));
        }
    }
}

#[test]
fn a_sync_of_the_far_future_is_one_frame_out_of_slot() {
    for by in [2, 1_000, 1 << 30, i32::MAX as u32] {
        let at = 12 * CYCLE + 300_000;
        let analysis = run(vec![Forged { at, as_whom: 0, cycle: 12 + by, sched: at }], Vec::new());
        assert_eq!(found(&analysis), [(12, FindingKind::OutOfSlot, None)], "{by}");
        assert_eq!(analysis.doubted.named(), BTreeMap::from([("cycle_ahead".to_owned(), 1)]));
        assert_eq!(analysis.stations[0].stray, 1);
    }
}

#[test]
fn a_sync_of_long_ago_does_not_set_the_count_back() {
    let cycle = FIRST + 20;
    let at = u64::from(FIRST + 150) * CYCLE + 300_000;
    let sched = u64::from(cycle) * CYCLE;
    let analysis = run(vec![Forged { at, as_whom: 0, cycle, sched }], Vec::new());
    assert_eq!(count(&analysis, &[FindingKind::SyncGap, FindingKind::SlotMissed]), 0);
    assert_eq!(analysis.doubted.named(), BTreeMap::from([("cycle_behind".to_owned(), 1)]));
}

#[test]
fn syncs_go_on_by_a_clock_set_back_until_all_have_heard() {
    let mut bench = Bench::new();
    let master = bench.scenario.address(0);
    (FIRST..12).for_each(|cycle| bench.sync_from(master, cycle, 0));
    let clock = bench.analysis.truth().clock;
    for by in [-5, 2] {
        bench.analysis.set_clock(0, clock.stepped(Span::from_millis(by)));
        bench.sync_from(master, 12, 0);
        bench.sync_from(master, 13, 0);
        assert_eq!(bench.analysis.current(), Some(13), "set by {by}");
    }
    // It is 13.5 now, or 15.5 by its clock.
    bench.sync_from(master, 17, -3_500_000);
    assert_eq!(bench.analysis.current(), Some(13), "by no clock that there was is it that one");
    bench.sync_from(master, 16, -2_500_000);
    assert_eq!(bench.analysis.current(), Some(16));
}
