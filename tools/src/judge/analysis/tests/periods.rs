//! How regular syncs are: what was missing is in the same figures.

use proptest::prelude::*;

use super::*;
use crate::observe::tally::Tally;
use crate::observe::watch::Watch;
use crate::report::histogram::Summary;

/// What the report of a run says, and what an observer says who saw the same frames: of syncs that were so late each, or were
/// skipped.
fn seen_by_both(late: &[Option<u64>]) -> [Summary; 2] {
    let mut bench = Bench::new();
    bench.analysis.begin(FIRST, late.len() as u32);
    let (mut watch, mut tally) = (Watch::default(), Tally::new(bench.scenario.rate));
    for (late, cycle) in late.iter().zip(FIRST..) {
        let Some(late) = late else { continue };
        let (start, mut frame) = (u64::from(cycle) * CYCLE, Pool::new(1).take().unwrap());
        let sched = GlobalTime::from_nanos(start);
        Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, Address::default(), &mut frame);
        bench.analysis.frame(start + late, &frame);
        let sight = watch.frame(Some(start + late), &frame, frame.len());
        tally.frame(Some(start + late), frame.len(), &sight);
    }
    bench.analysis.finish();
    [bench.analysis.sync_period.summary(), tally.sync_period.summary()]
}

#[test]
fn skipped_syncs_are_gaps_of_their_length() {
    let mut late = vec![Some(0); 40];
    (late[5], late[6]) = (Some(90_000), Some(5_000));
    (late[10], late[20], late[21], late[22]) = (None, None, None, None);
    for summary in seen_by_both(&late) {
        assert_eq!((summary.n, summary.min, summary.max), (33, Some(-85_000), Some(90_000)));
        assert_eq!((summary.gaps, summary.longest_gap_ns), (Some(2), Some(4_000_000)));
        assert_eq!(summary.n + summary.gaps.unwrap(), 36 - 1, "each sync but the first ends one of them");
    }
}

#[test]
fn a_run_that_ends_without_syncs_has_a_gap_up_to_its_end() {
    let mut bench = Bench::new();
    (FIRST..FIRST + 3).for_each(|cycle| bench.sync(cycle, 0));
    bench.analysis.advance_to(FIRST + CYCLES);
    bench.analysis.finish();
    let summary = bench.analysis.sync_period.summary();
    assert_eq!((summary.n, summary.gaps, summary.longest_gap_ns), (2, Some(1), Some(3_000_000)));
}

#[test]
fn who_looked_away_has_a_gap_without_a_length() {
    let mut bench = Bench::new();
    bench.sync(FIRST, 0);
    bench.analysis.lose_sight();
    (FIRST + 1..FIRST + 5).for_each(|cycle| bench.sync(cycle, 0));
    bench.analysis.finish();
    let summary = bench.analysis.sync_period.summary();
    assert_eq!((summary.n, summary.gaps, summary.longest_gap_ns), (3, Some(1), None));
}

proptest! {
    #[test]
    fn a_report_and_an_observer_of_the_same_frames_agree(
        late in prop::collection::vec(prop::option::weighted(0.9, 0..990_000u64), 3..100),
    ) {
        let late = [&[Some(0), Some(0)], &late[..], &[Some(0)]].concat();
        let [report, observer] = seen_by_both(&late);
        prop_assert_eq!(report, observer);
    }
}
