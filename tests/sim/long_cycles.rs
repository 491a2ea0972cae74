//! Cycles that are longer than those of a machine: the drift of the clocks is known all the same.

use rtnet::discipline::SyncState;
use rtnet::sim::StationId;
use rtnet::time::Span;
use tests::networks::{Lab, Plan};
use tests::seeds;
use tools::scenario::Source;

const LENGTHS: [i64; 4] = [31, 50, 100, 1_000];

fn drift(id: StationId) -> i64 {
    12_345 * (id as i64 - 1)
}

fn lab(millis: i64, rounds: u32) -> Lab {
    let mut options = Plan::lab_options(3);
    options.cycle = Span::from_millis(millis);
    let mut lab = Plan::of(&options).with_drift(drift).with_rounds(rounds).build();
    lab.run_until_locked();
    lab
}

/// How fast each slave's clock gains on the master's is known to some parts in 10^9.
fn check_drift(lab: &Lab, millis: i64) {
    for id in 1..3 {
        let status = lab.status(id);
        assert_eq!((status.state, status.settled), (SyncState::Locked, true), "{millis} ms, station {id}");
        let found = status.drift_ppb.expect("known by now");
        let gains = drift(id) - drift(0);
        assert!((found - gains).abs() <= 5, "{millis} ms, station {id}: {found}, not {gains}");
        // A slot's begin is counted from its cycle's on the slave's clock: off by what that gains in a cycle at the most. A
        // round's delay by half of that, for its reply comes a cycle later; without rounds by a frame's way, 500 ns.
        let off = Span::from_nanos(gains.abs() * millis * 3 / 2 / 1_000 + 600);
        assert!(lab.line_error(id).abs() < off, "{millis} ms: {}, not {off}", lab.line_error(id));
    }
}

#[test]
fn drift_is_known_from_calibration_at_any_cycle_length() {
    for millis in LENGTHS {
        let mut lab = lab(millis, 50);
        lab.run_cycles(5);
        check_drift(&lab, millis);
    }
}

/// Slots of the cycle in which the last calibration reply comes are neither missed nor late.
#[test]
fn stations_that_join_miss_none_of_their_slots() {
    let text = "cycle = \"50ms\"\n[[station]]\nname = \"master\"\nrole = \"master\"\nslots = [{ id = 0, offset = \"1ms\" }]\n\
                [[station]]\nname = \"arm\"\nrole = \"slave\"\nrounds = 10\nslots = [{ id = 0, offset = \"20ms\" }, { id = 1, offset = \"23ms\" }]\n";
    seeds::each(10, move |seed| {
        let scenario = Source::new("net.toml", text).parse().unwrap().with_seed(seed);
        let mut lab = Plan::of_scenario(scenario).build();
        lab.run_until_locked();
        lab.run_cycles(50);
        for id in 0..2 {
            let status = lab.status(id);
            assert_eq!((status.state, status.counters.overruns), (SyncState::Locked, 0), "station {id}");
            assert!(status.counters.frames_sent > 40, "station {id}");
        }
    });
}

#[test]
fn drift_is_known_from_syncs_at_any_cycle_length() {
    for millis in LENGTHS {
        // Eight windows of two seconds, and one that had begun.
        let cycles = 18_000 / millis as u64 + 2;
        let mut lab = lab(millis, 0);
        lab.run_cycles(cycles);
        check_drift(&lab, millis);
    }
}
