//! A slave that hears its master no more: how long it goes on, and how far off it is then.

use rtmac::tdma::SlaveConfig;
use rtnet::discipline::SyncState;
use rtnet::sim::{Host, Latency, StationId};
use rtnet::time::Span;
use tests::networks::{Lab, Plan};
use tests::seeds;
use tools::scenario::{ServoName, Uniform};

const SLAVES: [StationId; 3] = [1, 2, 3];
/// Cycles without a master.
const ALONE: u32 = 500;
/// Cycles that a slave bridges. An outage of 4 ms just before may cost it four syncs more, and one is under way.
const HOLDOVER: u32 = ALONE + 5;
/// Largest error bound after that if the drift is not known: 200 ppm, and the delay of the last syncs.
const UNKNOWN: Span = Span::from_micros(160);

/// A network whose slaves bridge so many cycles, on such hosts, locked for so many cycles.
fn locked(plan: Plan, holdover: u32, host: Host, cycles: u64) -> Lab {
    let plan = Plan { follow: SlaveConfig { holdover, ..plan.follow }, ..plan.on(host) };
    let mut lab = plan.build();
    lab.run_until_locked();
    lab.run_cycles(cycles);
    lab
}

/// A slow clock beside a fast one, up to 100 ppm off.
fn drifts(id: StationId) -> i64 {
    [-90_000, 100_000, -40_000, 7_000][id]
}

fn plan(seed: u64) -> Plan {
    Plan::of(&Uniform { seed, ..Plan::lab_options(4) }).with_drift(drifts)
}

/// Lets all slaves be without their master for so long, and tells by how much each was off at most, and how far it said
/// that it might be off in the end.
fn worst_in_holdover(lab: &mut Lab, seed: u64) -> Vec<(Span, Span)> {
    lab.network.cut_off(&SLAVES);
    let mut worst = vec![(Span::ZERO, Span::ZERO); 4];
    for cycle in 0..ALONE {
        lab.run_cycles(1);
        for id in SLAVES {
            let (status, error) = (lab.status(id), lab.line_error(id).abs());
            let bound = status.error_bound.expect("it follows, and has calibrated");
            assert!(error <= bound, "seed {seed}, station {id}, cycle {cycle}: {error} off, not {bound}");
            let holds = matches!(status.state, SyncState::Holdover | SyncState::Locked);
            assert!(holds, "seed {seed}, station {id}, cycle {cycle}: {:?}", status.state);
            worst[id] = (worst[id].0.max(error), bound);
        }
    }
    assert!(SLAVES.into_iter().all(|id| lab.state(id) == SyncState::Holdover), "to the end");
    worst
}

#[test]
fn in_holdover_a_slave_is_never_further_off_than_it_says() {
    let noisy = Host { send: Latency::Uniform(Span::ZERO, Span::from_micros(8)), ..Host::VIRTUAL_MACHINE };
    for (host, rounds, cycles, most) in [
        // The drift is known, by calibration or by the line.
        (Host::IDEAL, 100, 0, Span::from_micros(20)),
        (Host::IDEAL, 5, 1_100, Span::from_micros(5)),
        (Host::VIRTUAL_MACHINE, 100, 3_000, Span::from_micros(10)),
        (noisy.clone(), 100, 3_000, Span::from_micros(40)),
        // The first lines are short: what they say of the drift is little sure.
        (noisy.clone(), 5, 520, Span::from_micros(60)),
        // Nothing is known of it: 200 ppm.
        (Host::IDEAL, 5, 0, Span::from_micros(125)),
        (noisy, 5, 0, UNKNOWN),
    ] {
        let first = seeds::one("holdover");
        let kept = seeds::kept("holdover::in_holdover_a_slave_is_never_further_off_than_it_says");
        let in_each = (first..first + 5).chain(kept).flat_map(|seed| {
            let mut lab = locked(plan(seed).with_rounds(rounds), HOLDOVER, host.clone(), cycles);
            worst_in_holdover(&mut lab, seed).split_off(1)
        });
        let mut bounds: Vec<Span> = in_each.map(|(_, bound)| bound).collect();
        bounds.sort_unstable();
        // An outage of a busy host may begin a new line just before, whose drift is not known.
        let (middle, last) = (bounds[bounds.len() / 2], bounds[bounds.len() - 1]);
        let is_sharp = middle <= most && last <= if host == Host::IDEAL { most } else { UNKNOWN };
        assert!(is_sharp, "{rounds} rounds, seeds from {first}: {bounds:?} say nothing");
    }
}

#[test]
fn without_a_filter_it_is_not_either() {
    seeds::each(5, |seed| {
        let noisy =
            Host { send: Latency::Uniform(Span::ZERO, Span::from_micros(8)), ..Host::VIRTUAL_MACHINE };
        let mut plan = plan(seed);
        plan.scenario.servo = ServoName::None;
        let mut lab = locked(plan, HOLDOVER, noisy, 1_000);
        let worst = worst_in_holdover(&mut lab, seed);
        assert!(worst[1].0 > Span::from_micros(80), "190 ppm for half a second: {}", worst[1].0);
    });
}

#[test]
fn as_many_cycles_are_bridged_as_configured_and_no_more() {
    for holdover in [0, 1, 5, 100] {
        let mut lab = locked(plan(seeds::one("bridged")), holdover, Host::IDEAL, 1_000);
        lab.judge_from_here();
        lab.network.cut_off(&SLAVES);
        lab.run_cycles(200);
        let bridged = u64::from(holdover);
        assert_eq!(&lab.judge().data[1..], [bridged; 3], "{holdover}");
        assert!(SLAVES.into_iter().all(|id| lab.state(id) == SyncState::Lost));
        assert_eq!(lab.judge().data[0], 200, "the master goes on");
        lab.network.cut_off(&[]);
        lab.run_cycles(10);
        assert!(
            SLAVES.into_iter().all(|id| lab.state(id) == SyncState::Locked),
            "{holdover}: the line was good"
        );
        assert!(lab.judge().overlaps.is_empty());
    }
}
