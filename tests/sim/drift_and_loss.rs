//! Clocks 100 ppm off in either direction, one Synchronisation in a hundred lost at each station, in a lab
//! whose frames are so large that hardly more than the guard band is left between them:
//! `lab run --stations 8 --cycle 1ms --rate 100M --payload 1440 --guard 504ns`. The last slot ends with the cycle.

use rtmac::tdma::HOLDOVER_CYCLES;
use rtmac::tdma::schedule::{Rate, Uncertainty, guard_band};
use rtnet::sim::{Host, Latency, Medium, StationId};
use rtnet::time::Span;
use tests::networks::{Lab, Plan};
use tests::seeds;
use tools::scenario::Uniform;

const STATIONS: usize = 8;
const DRIFT_PPB: i64 = 100_000;
/// With this, the slots of such a lab leave 510 ns between frames, 6 ns more than the guard band that is computed.
const PAYLOAD: usize = 1_440;
/// And with this 270 ns, 18 ns more than half of it.
const PAYLOAD_OF_HALF: usize = 1_443;

fn computed_guard() -> Span {
    guard_band(Uncertainty {
        drift_ppb: DRIFT_PPB,
        cycle: Span::from_millis(1),
        holdover: HOLDOVER_CYCLES as u32,
        lateness: Span::ZERO,
        stamp_error: Span::ZERO,
    })
}

/// A lab with this guard band, in which so many Synchronisations in a million are not heard.
fn lab(guard: Span, payload: usize, seed: u64, lose_control_ppm: u32) -> Plan {
    let rate = Rate::from_bits_per_second(100_000_000);
    let guard = Some(guard);
    let plan = Plan::of(&Uniform { payload, rate, guard, seed, ..Plan::lab_options(STATIONS) });
    let medium = Medium { lose_control_ppm, ..plan.medium };
    Plan { medium, ..plan }
}

/// A slow neighbour is late just before a fast one is early; the master drifts too.
fn alternating(id: StationId) -> i64 {
    if id.is_multiple_of(2) { DRIFT_PPB } else { -DRIFT_PPB }
}

fn run(guard: Span, payload: usize, cycles: u64) -> Lab {
    let mut lab = lab(guard, payload, seeds::one("drift_and_loss"), 10_000).with_drift(alternating).build();
    lab.run_cycles(cycles);
    lab
}

#[test]
fn a_million_cycles_with_the_computed_guard_band_have_no_overlap() {
    let lab = run(computed_guard(), PAYLOAD, 1_000_000);
    assert_eq!(lab.network.traffic().overlaps, 0);
    let judge = lab.judge();
    assert!(judge.faults.is_empty(), "{:?}", judge.faults);
    assert!(judge.data.iter().all(|&sent| sent > 990_000), "and everybody was there: {:?}", judge.data);
    assert!(lab.network.traffic().lost > 7 * 9_500, "and Synchronisations were lost");
    println!("smallest gap {:?}", lab.network.traffic().smallest_gap);
}

#[test]
fn half_of_that_guard_band_is_not_enough() {
    let lab = run(computed_guard() / 2, PAYLOAD_OF_HALF, 100_000);
    assert!(lab.network.traffic().overlaps > 0, "smallest gap {:?}", lab.network.traffic().smallest_gap);
}

#[test]
fn the_guard_band_is_tight() {
    // For who calibrates too shortly to know the rate of the clocks from it.
    let mut lab = lab(computed_guard(), PAYLOAD, seeds::one("tight"), 10_000)
        .with_drift(alternating)
        .with_rounds(5)
        .build();
    lab.run_cycles(100_000);
    let gap = lab.network.traffic().smallest_gap.expect("frames were sent");
    let guard = lab.plan.scenario.guard;
    assert_eq!(guard.nanos(), 504);
    assert!(gap < guard / 4, "{gap} of {guard} were never needed");
}

#[test]
fn it_is_wide_enough_whichever_stations_are_fast_and_which_are_slow() {
    for fast in 0..1u32 << STATIONS {
        let drift = |id| if fast >> id & 1 == 1 { DRIFT_PPB } else { -DRIFT_PPB };
        let plan = lab(computed_guard(), PAYLOAD, fast.into(), 100_000).with_drift(drift);
        let mut lab = plan.with_rounds(10).build();
        lab.run_cycles(500);
        assert_eq!(lab.network.traffic().overlaps, 0, "{fast:08b}");
        assert!(lab.judge().data.iter().all(|&sent| sent > 300), "{fast:08b}: {:?}", lab.judge().data);
    }
}

/// What a station's clock gains on the master's in truth, in parts per 10^9 of the master's.
fn gains(drift: impl Fn(StationId) -> i64, id: StationId) -> i64 {
    (drift(id) - drift(0)) * 1_000_000_000 / (1_000_000_000 + drift(0))
}

#[test]
fn every_slave_finds_out_how_far_its_clock_drifts() {
    let drift = |id: StationId| 12_345 * (id as i64 - 3);
    let mut lab = lab(computed_guard(), PAYLOAD, seeds::one("drift"), 10_000).with_drift(drift).build();
    lab.run_until_locked();
    lab.run_cycles(1_000);
    for id in 1..STATIONS {
        let found = lab.status(id).drift_ppb.expect("known by now");
        assert!((found - gains(drift, id)).abs() <= 5, "station {id}: {found}, not {}", gains(drift, id));
    }
}

/// Largest error of the drift of a settled station, in parts per 10^9.
const CLEAR: i64 = 2_000;

#[test]
fn on_a_busy_host_too() {
    let busy = Host { send: Latency::Uniform(Span::ZERO, Span::from_micros(8)), ..Host::VIRTUAL_MACHINE };
    seeds::each(20, move |seed| {
        let options = Uniform { seed, ..Plan::lab_options(STATIONS) };
        let mut lab = Plan::of(&options).with_drift(alternating).on(busy.clone()).build();
        lab.run_until_locked();
        // An outage of the master begins another line, whose drift is not known at first.
        let mut clear = [0; STATIONS];
        for _ in 0..10_000 {
            lab.run_cycles(1);
            for (id, clear) in clear.iter_mut().enumerate().skip(1) {
                let status = lab.status(id);
                let Some(found) = status.drift_ppb.filter(|_| status.settled) else { continue };
                let error = found - gains(alternating, id);
                assert!(error.abs() <= CLEAR, "station {id}: {found}, not {}", gains(alternating, id));
                *clear += 1;
            }
        }
        assert!(clear[1..].iter().all(|&cycles| cycles > 0), "in so many cycles it is clear: {clear:?}");
    });
}
