//! Clocks 100 ppm off in either direction, one Synchronisation in a hundred lost at each station, and
//! frames of full size back to back but for the guard band.

use rtmac::tdma::HOLDOVER_CYCLES;
use rtmac::tdma::schedule::{Uncertainty, guard_band};
use rtnet::sim::Medium;
use rtnet::time::Span;
use tests::networks::{Lab, Plan};

const STATIONS: usize = 5;
const DRIFT_PPB: i64 = 100_000;

fn computed_guard() -> Span {
    guard_band(Uncertainty {
        drift_ppb: DRIFT_PPB,
        cycle: Span::from_millis(1),
        holdover: HOLDOVER_CYCLES as u32,
        lateness: Span::ZERO,
        stamp_error: Span::ZERO,
    })
}

/// A slow neighbour is late just before a fast one is early; the master drifts too.
fn run(guard: Span, cycles: u64, seed: u64) -> Lab {
    let plan = Plan::at_the_end(STATIONS, guard);
    let medium = Medium { lose_control_ppm: 10_000, ..plan.medium };
    let drift_ppb = vec![DRIFT_PPB, -DRIFT_PPB, DRIFT_PPB, -DRIFT_PPB, DRIFT_PPB];
    let mut lab = Plan { medium, drift_ppb, seed, ..plan }.build();
    lab.run_cycles(cycles);
    lab
}

#[test]
fn a_million_cycles_with_the_computed_guard_band_have_no_overlap() {
    let lab = run(computed_guard(), 1_000_000, 3);
    assert_eq!(lab.network.traffic().overlaps, 0);
    let judge = lab.judge();
    assert!(judge.faults.is_empty(), "{:?}", judge.faults);
    assert!(judge.data.iter().all(|&sent| sent > 990_000), "and everybody was there: {:?}", judge.data);
    assert!(lab.network.traffic().lost > 4 * 9_500, "and Synchronisations were lost");
    println!("smallest gap {:?}", lab.network.traffic().smallest_gap);
}

#[test]
fn half_of_that_guard_band_is_not_enough() {
    let lab = run(computed_guard() / 2, 100_000, 3);
    assert!(lab.network.traffic().overlaps > 0, "smallest gap {:?}", lab.network.traffic().smallest_gap);
}

#[test]
fn the_guard_band_is_tight() {
    let lab = run(computed_guard(), 100_000, 3);
    let gap = lab.network.traffic().smallest_gap.expect("frames were sent");
    assert!(gap < computed_guard() / 4, "{gap} of {} were never needed", computed_guard());
}

#[test]
fn it_is_wide_enough_whichever_stations_are_fast_and_which_are_slow() {
    for fast in 0..1u32 << STATIONS {
        let drift = |i| if fast >> i & 1 == 1 { DRIFT_PPB } else { -DRIFT_PPB };
        let plan = Plan::at_the_end(STATIONS, computed_guard());
        let medium = Medium { lose_control_ppm: 100_000, ..plan.medium };
        let drift_ppb = (0..STATIONS).map(drift).collect();
        let mut lab = Plan { medium, drift_ppb, seed: fast.into(), ..plan }.build();
        lab.run_cycles(3_000);
        assert_eq!(lab.network.traffic().overlaps, 0, "{fast:05b}");
    }
}
