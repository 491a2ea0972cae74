//! Whatever a plan says works comes up on ideal hosts: proposals, divided cycles, and files with slots of all kinds.

use std::sync::LazyLock;

use proptest::prelude::*;

use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;
use tests::seeds;
use tools::plan::{Plan, propose};
use tools::scenario::{Scenario, Source, Uniform};
use tools::sim::{self, Options};

/// Cycles that are looked at once all are locked.
const CYCLES: i64 = 20;
const MEGA: u64 = 1_000_000;
static SEED: LazyLock<u64> = LazyLock::new(|| seeds::one("proposals"));

fn uniform(stations: usize, cycle: i64, guard: Option<i64>, payload: usize, mbits: u64) -> Uniform {
    Uniform {
        stations,
        cycle: Span::from_nanos(cycle),
        duration: Span::from_millis(100_000),
        payload,
        rate: Rate::from_bits_per_second(mbits * MEGA),
        guard: guard.map(Span::from_nanos),
        seed: *SEED,
        vnic: None,
    }
}

/// Whether the plan lets it work; if so it is run, and all is well.
fn works(scenario: Scenario) -> bool {
    if !Plan::of(&scenario, None).works() {
        return false;
    }
    let scenario = Scenario { duration: scenario.cycle * CYCLES, ..scenario };
    let what = || format!("{} stations, cycle {}", scenario.stations.len(), scenario.cycle);
    let ended = sim::run(&scenario, &Options::default()).unwrap_or_else(|why| panic!("{}: {why}", what()));
    let figures = &ended.figures.figures;
    assert!(figures.verdict.ok && figures.frames_seen > 0, "{}: {:?}", what(), figures.verdict);
    true
}

#[test]
fn proposals_that_work_lock() {
    let mut ran = 0;
    for stations in [2, 3, 4, 5, 8, 17, 64] {
        for guard in [100, 10_000, 12_100, 20_000, 50_000, 1_000_000] {
            for (payload, mbits) in [(46, 1_000), (64, 100), (1_500, 1_000), (64, 10)] {
                let asked = uniform(stations, 0, Some(guard), payload, mbits);
                ran += usize::from(works(propose::shortest(&asked).unwrap()));
            }
        }
    }
    assert_eq!(ran, 7 * 4 * 4, "all but those whose guard band clocks take whole");
}

#[test]
fn short_cycles_that_work_lock() {
    let (mut ran, mut refused) = (0, 0);
    for stations in 2..=5 {
        for cycle in (20_000..=60_000).step_by(500).chain(50_600..=50_700) {
            match uniform(stations, cycle, None, 46, 1_000).scenario() {
                Ok(scenario) => ran += usize::from(works(scenario)),
                Err(_) => refused += 1,
            }
        }
    }
    assert!(ran > 100 && refused > 100, "{ran}, {refused}");
}

/// A network with slots of all kinds, whose frames are on their way for so long.
fn network(cycle: i64, way: i64, backup: bool, slots: &[(i64, u32, i64)]) -> String {
    let station = |(n, &(offset, period, second)): (usize, &(i64, u32, i64))| {
        let role = match n {
            0 => "role = \"master\"",
            1 if backup => "role = \"backup\"\nbackup = \"14us\"",
            _ => "role = \"slave\"",
        };
        let first = format!("{{ id = 0, offset = \"{offset}us\", phase = \"1/{period}\" }}");
        let second =
            if second > 0 { format!(", {{ id = 2, offset = \"{second}us\" }}") } else { String::new() };
        format!("[[station]]\nname = \"s{n}\"\n{role}\nslots = [{first}{second}]\n")
    };
    let stations: String = slots.iter().enumerate().map(station).collect();
    format!(
        "cycle = \"{cycle}us\"\nsync_window = \"5us\"\nguard = \"12100ns\"\n[medium]\npropagation = \"{way}ns\"\n{stations}"
    )
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn files_that_work_lock(
        cycle in 25i64..220,
        way in prop_oneof![Just(500i64), 0i64..60_000],
        backup in any::<bool>(),
        slots in proptest::collection::vec((5i64..200, 1u32..4, prop_oneof![Just(0i64), 5i64..200]), 2..5),
    ) {
        let text = network(cycle, way, backup, &slots);
        if let Ok(scenario) = Source::new("net.toml", &text).parse() {
            works(scenario);
        }
    }
}
