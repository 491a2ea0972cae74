//! What a plan says is so: schedules that it accepts keep their frames apart within the bounds that it states, and
//! those that it refuses do not.

use rtmac::tdma::schedule::Rate;
use rtnet::discipline::Discipline;
use rtnet::sim::{Host, Latency, Medium, Random};
use rtnet::time::Span;
use tests::networks::{Lab, Plan as Network};
use tools::plan::{Plan, STAMP_ERROR, propose};
use tools::scenario::{Scenario, Source, Uniform};

use crate::cases;

const CASES: u64 = 300;
/// Those that are watched, behind those in which all calibrate.
const CYCLES: u64 = 200;
/// Of each slave's calibration.
const ROUNDS: u32 = 5;
/// From the end of the sync window to the first slot.
const AFTER_SYNC: Span = Span::from_micros(100);
/// What the arithmetic of time lines rounds, and the plan's does not.
const ROUNDING: i64 = 20;

/// Stations whose slots lie side by side, with no more between them than the guard band, at the begin of a cycle that
/// may be much longer.
fn packed(random: &mut Random, seed: u64) -> Scenario {
    let network = Uniform {
        stations: random.between(3, 8) as usize,
        cycle: Span::ZERO,
        duration: Span::from_millis(1_000),
        payload: random.between(46, 600) as usize,
        rate: Rate::from_bits_per_second([10, 100, 1_000][random.below(3) as usize] * 1_000_000),
        guard: Some(Span::from_micros(random.between(16, 200))),
        seed,
        vnic: None,
    };
    let mut scenario = propose::shortest(&network).expect("there is room in some cycle");
    // Whoever keeps its slot for 100 ms is as good at 1 s, which takes ten times as long to try.
    let longest = Span::from_millis(100).nanos() / scenario.cycle.nanos();
    scenario.cycle = scenario.cycle * random.between(1, longest.max(1));
    scenario.cycle = scenario.cycle.max(Span::from_micros(500));
    // The frame of no slot is chosen before the cycle's sync has come.
    let behind = scenario.sync_window + AFTER_SYNC - scenario.stations[0].slots[0].offset;
    for slot in scenario.stations.iter_mut().flat_map(|station| &mut station.slots) {
        slot.offset = slot.offset + behind;
    }
    scenario.cycle = scenario.cycle + AFTER_SYNC;
    scenario
}

/// As its file is read.
fn read(scenario: &Scenario) -> Result<Scenario, String> {
    Source::new("net.toml", &propose::file(scenario)).parse().map_err(|error| error.to_string())
}

fn settled(network: &Network) -> Lab {
    let mut lab = network.build();
    lab.run_until_locked();
    lab
}

/// When the next cycle starts, in true time.
fn next_sync(lab: &Lab) -> u64 {
    let master = lab.network.member(0);
    let last = master.clock.truth(master.station.discipline().time().start);
    let cycle = lab.plan.cycle().nanos() as u64;
    last + (lab.network.now() - last).next_multiple_of(cycle)
}

#[test]
fn what_a_plan_accepts_never_overlaps_within_the_bounds_that_it_states() {
    let (mut frames, mut least_ppb) = (0, i64::MAX);
    let seeds = cases("accepted", CASES);
    for &seed in &seeds {
        let mut random = Random::new(seed);
        let scenario = read(&packed(&mut random, seed)).expect("it has room");
        let plan = Plan::of(&scenario, None);
        assert!(plan.works(), "seed {seed}: {:?}", plan.refused);
        least_ppb = least_ppb.min(plan.guard.drift_ppb);

        let drift = plan.guard.drift_ppb;
        let drifts: Vec<i64> = scenario
            .stations
            .iter()
            .map(|_| if random.happens(500_000) { random.between(-drift, drift) } else { drift })
            .collect();
        // Neighbours run apart as fast as they may, or as it comes.
        let drifts = move |id: usize| if id.is_multiple_of(2) { drifts[id] } else { -drifts[id] };
        let medium = Medium {
            rate: scenario.rate.bits_per_second(),
            lose_control_ppm: random.between(0, 100_000) as u32,
            lose_data_ppm: random.between(0, 100_000) as u32,
            ..Medium::default()
        };
        let sends = STAMP_ERROR - medium.propagation;
        let host = Host {
            // What is later than that is not sent at all.
            late: Latency::Uniform(Span::ZERO, Span::from_nanos(plan.guard.lateness_ns) * 2),
            send: Latency::Uniform(Span::ZERO, sends),
            ..Host::IDEAL
        };
        let network = Network { medium, ..Network::of_scenario(scenario.clone()) }
            .with_drift(drifts)
            .with_rounds(ROUNDS)
            .on(host);
        let mut lab = network.build();
        lab.run_cycles(CYCLES + 60_000_000 / scenario.cycle.nanos() as u64);
        let judge = lab.judge();
        assert_eq!(judge.overlaps, [], "seed {seed}: {plan:?}");
        frames += judge.data.iter().sum::<u64>();
    }
    assert!(frames > 50_000 || (seeds.len() as u64) < CASES, "only {frames} frames");
    println!(
        "FIGURE plans: {frames} frames without an overlap; clocks that run apart by {least_ppb} ppb and more"
    );
}

#[test]
fn what_a_plan_refuses_overlaps_by_as_much_within_those_bounds() {
    for seed in cases("refused", CASES) {
        let mut random = Random::new(seed);
        let mut scenario = packed(&mut random, seed);
        // Slots are no further apart than they must be: one of them begins too early.
        let [first, second] = [1, 2].map(|id| &scenario.stations[id].slots[0]);
        let (air, apart) =
            (scenario.schedule().air_time(&scenario.schedule().slots[0]), second.offset - first.offset);
        let spare = apart - air - scenario.guard;
        let early = spare + Span::from_nanos(random.between(ROUNDING, scenario.guard.nanos()));
        scenario.stations[2].slots[0].offset = second.offset - early;

        let refused = read(&scenario).expect_err("it is no network");
        let [a, b] = [1, 2].map(|id| &scenario.stations[id]);
        let sum = format!(
            "slot 0 of {} and slot 0 of {} overlap: {} + frame {air} + guard band {} = {}, but {} begins at {}",
            a.name,
            b.name,
            a.slots[0].offset,
            scenario.guard,
            a.slots[0].offset + air + scenario.guard,
            b.name,
            b.slots[0].offset
        );
        assert!(refused.contains(&sum), "seed {seed}: {refused}");

        // The earlier one is late, its clock behind and the other's ahead, by no more than they may be: until the other
        // begins in the middle of its frame, or by all that the guard band absorbs.
        let gap = b.slots[0].offset - a.slots[0].offset - air;
        let shift = (gap + air / 2).min(scenario.guard);
        let share = scenario.clock_share().min(shift / 2);
        let late = Latency::Constant(shift - share * 2);
        assert!(shift - share * 2 <= scenario.latest());
        let network = Network::of_scenario(scenario.clone()).with_drift(|_| 0).with_rounds(ROUNDS);
        let mut lab = settled(&network);
        assert_eq!(lab.judge().overlaps, [], "seed {seed}: as long as nobody is late or wrong");
        lab.network.run_until(next_sync(&lab) + 10_000);
        lab.network.member_mut(1).host = Host { late: late.clone(), ..Host::IDEAL }.into();
        for (id, by) in [(1, share * -1), (2, share)] {
            let clock = lab.network.member(id).clock.stepped(by);
            lab.network.set_clock(id, clock);
        }
        lab.run_cycles(3);
        assert_ne!(
            lab.judge().overlaps,
            [],
            "seed {seed}: {early} too early, {shift} of {}, {late:?}, {share}: {:?}",
            scenario.guard,
            scenario.schedule().slots
        );
    }
}
