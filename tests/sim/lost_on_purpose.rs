//! What a scenario loses on purpose excuses just that.

use tests::seeds;
use tools::report::figures::Figures;
use tools::scenario::Source;
use tools::sim::{self, Options, SimFigures};

fn run(text: &str) -> Figures {
    run_to_the_end(text).figures
}

fn run_to_the_end(text: &str) -> SimFigures {
    let scenario = Source::new("lossy.toml", text).parse().unwrap().with_seed(seeds::one("lossy.toml"));
    sim::run(&scenario, &Options::default()).unwrap().figures
}

#[test]
fn in_a_network_that_is_cut_each_part_is_judged_by_its_own_master() {
    let network = r#"
cycle = "2ms"
duration = "2s"
[[station]]
name = "primary"
role = "master"
[[station]]
name = "backup"
role = "backup"
backup = "100us"
[[station]]
name = "slave2"
role = "slave"
[[station]]
name = "slave3"
role = "slave"
[[event]]
at = "500ms"
cut = ["backup", "slave3"]
for = "1s"
# Slots are those of the primary. Two clocks of 50 ppm run apart by 0.2 us a cycle: after 192 of the 500 cycles by more than the
# 38.4 us that slots leave for clocks. In the others, and in 20 until all are locked again, backup sends two frames and slave3 one.
[expect]
out_of_slot = "<= 984"
# At most 3 cycles have two masters. In each, three frames of the second one's part meet at most two others.
overlaps = "<= 18"
rival_cycles = "<= 3"
"#;
    let away = r#"
[[event]]
at = "1s"
unplug = "backup"
for = "100ms"
"#;
    let figures = run(network);
    assert_eq!((figures.unexplained, figures.slots_missed, figures.verdict.reasons), (0, 0, vec![]));
    let figures = run(&format!("{network}{away}"));
    assert!(figures.per_station[3].slots_missed >= 45, "{}", figures.per_station[3].slots_missed);
    assert_eq!((figures.unexplained, figures.per_station[2].slots_missed), (0, 0), "{:?}", figures.misses);
}

#[test]
fn what_was_lost_on_purpose_before_a_restart_excuses_nothing_that_is_lost_after_it() {
    let figures = run(r#"
cycle = "1ms"
duration = "4s"
[[station]]
name = "master"
role = "master"
[[station.traffic]]
priority = 3
every = "3ms"
burst = 2
[[station]]
name = "slave1"
role = "slave"
[[station]]
name = "slave2"
role = "slave"
[[event]]
at = "100ms"
wire = { stations = "slave1", direction = "in", lose_data = "50%" }
for = "500ms"
[[event]]
at = "1s"
restart = "slave1"
[[event]]
at = "3s"
stop = "slave1"
for = "100ms"
"#);
    let slave = &figures.per_station[1];
    // Its card takes 32 frames of the 200 that come meanwhile, of which every other is a sync.
    assert!((80..=90).contains(&slave.frames_lost), "{}", slave.frames_lost);
    assert_eq!(slave.lost_on_purpose, 0);
    let queued = &figures.queueing[0];
    assert!(queued.lost >= 40 && queued.lost_on_purpose == 0, "{queued:?}");
    assert!(
        figures.verdict.reasons.iter().any(|why| why.contains("did not receive")),
        "{:?}",
        figures.verdict
    );
}

/// Three stations, one second, and what is said of their wires.
fn three_stations(wires: &str) -> SimFigures {
    const STATIONS: &str = r#"
cycle = "1ms"
rate = "100M"
duration = "1s"
[[station]]
name = "master"
role = "master"
rounds = 20
slots = [{ id = 0, offset = "800us" }]
[[station]]
name = "slave1"
role = "slave"
rounds = 20
slots = [{ id = 0, offset = "300us" }]
[[station]]
name = "slave2"
role = "slave"
rounds = 20
slots = [{ id = 0, offset = "500us" }]
"#;
    run_to_the_end(&format!("{STATIONS}{wires}"))
}

#[test]
fn a_wire_of_which_something_else_is_said_later_loses_as_before() {
    let lost = |wires: &str| {
        let figures = three_stations(wires).figures;
        assert_eq!(figures.frames_lost, figures.lost_on_purpose, "{wires}");
        figures.per_station.iter().map(|station| station.frames_lost).collect::<Vec<_>>()
    };
    let all = "[[wire]]\ndirection = \"in\"\nlose_data = \"100%\"\n";
    assert_eq!(lost(all), [1_000, 1_000, 1_000]);
    let slow = "[[wire]]\nstations = \"slave1\"\ndelay = \"constant 1us\"\n";
    assert_eq!(lost(&format!("{all}{slow}")), [1_000, 1_000, 1_000]);
    let spared = "[[wire]]\nstations = \"slave1\"\nlose = \"0%\"\n";
    assert_eq!(lost(&format!("{all}{spared}")), [1_000, 0, 1_000], "the same is said otherwise");
    let event = |what: &str| format!("[[event]]\nat = \"200ms\"\nwire = {{ {what} }}\nfor = \"500ms\"\n");
    let slow = event("stations = \"slave1\", delay = \"constant 1us\"");
    assert_eq!(lost(&format!("{all}{slow}")), [1_000, 1_000, 1_000]);
    let spared = event("stations = \"slave2\", lose_data = \"0%\"");
    assert_eq!(lost(&format!("{all}{spared}")), [1_000, 1_000, 500], "until that is over");
}

#[test]
fn only_frames_of_the_measurement_count_as_lost() {
    let half = "[[wire]]\nstations = \"slave1\"\ndirection = \"in\"\nlose_data = \"50%\"\n";
    // Where frames are long on their way, those of the cycle before come when the measurement has begun.
    for (wires, is_late) in [(half.to_owned(), false), (format!("{half}delay = \"constant 300us\"\n"), true)]
    {
        let SimFigures { figures, simulation } = three_stations(&wires);
        let slave = &figures.per_station[1];
        assert_eq!(slave.frames_lost, slave.lost_on_purpose, "{is_late}: {:?}", figures.verdict);
        // What a wire loses it loses at once, also in the few cycles behind the last.
        let behind = simulation.lost - slave.frames_lost;
        // Half of 1000, with a deviation of 16; 9 of those.
        assert!((356..=644).contains(&slave.frames_lost) && behind <= 4, "{is_late}: {}", slave.frames_lost);
    }
}
