//! What a scenario loses on purpose excuses just that.

use tools::report::figures::Figures;
use tools::scenario::Source;
use tools::sim::{self, Options};

fn run(text: &str) -> Figures {
    let scenario = Source { file: "lossy.toml", text }.parse().unwrap();
    sim::run(&scenario, &Options::default()).unwrap().figures.figures
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
