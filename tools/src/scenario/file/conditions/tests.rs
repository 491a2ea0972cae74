use super::*;
use crate::scenario::{Happening, Relation, Scenario};

const NETWORK: &str = r#"cycle = "1ms"

[[station]]
name = "arm"
role = "slave"
host = { wake = "uniform 1us 3us" }
expect = { slots_missed = "<= 3" }

[[station]]
name = "master"
role = "master"
clock = { drift_ppm = 1.0, wander = { step_ppm = 0.1, within_ppm = 2.0 } }
"#;

fn parse(more: &str) -> Result<Scenario, FileError> {
    Source { file: "net.toml", text: &format!("{NETWORK}{more}") }.parse()
}

/// What is said of a file that cannot be, with what stands in line 13 and behind.
#[track_caller]
fn refused(more: &str, expected: &str) {
    let error = parse(more).unwrap_err().to_string();
    assert!(error.contains(expected), "{more}\n{error}");
}

#[test]
fn everything_is_read_and_stations_are_numbered_with_the_master_first() {
    let conditions = parse(
        r#"[medium]
joint = "switch"
latency = "2us"
[host]
wake = "exponential 13us"
stalls = { ppm = 7, longest = "3ms" }
[[wire]]
stations = "arm"
direction = "in"
lose = "1%"
lose_control = "5ppm"
[[event]]
at = "2s"
times = 3
every = "100ms"
stop = ["arm", "master"]
for = "50ms"
[[event]]
at = "1s"
clock = { stations = "arm", step = "-5ms", drift_ppm = 20.0, wander = { step_ppm = 0.1, within_ppm = 2.0 } }
[expect]
overlaps = 0
sync_error = "< 20us"
"#,
    )
    .unwrap()
    .conditions;
    let latency = Span::from_micros(2);
    assert_eq!(conditions.joint, Joint::Switch { latency, queue: QUEUE });
    let arm = 1;
    assert_eq!(conditions.host(arm).wake, Latency::Uniform(Span::from_micros(1), Span::from_micros(3)));
    assert_eq!(conditions.host(0).stall_ppm, 7);
    let wandering = Wandering { every: WANDER_EVERY, step_ppb: 100, within_ppb: 2_000 };
    assert_eq!(conditions.wanders, [(0, wandering)]);
    let Wire { stations, direction, link } = &conditions.wires[0];
    assert_eq!((&stations[..], *direction), (&[arm][..], Direction::In));
    assert_eq!(
        (link.lose_control_ppm, link.lose_data_ppm),
        (5, 10_000),
        "what is said of one kind counts there"
    );
    let [stop, clock] = &conditions.events[..] else { panic!() };
    assert_eq!(stop.what, Happening::Stop(vec![arm, 0], Span::from_millis(50)));
    assert_eq!((stop.times, stop.every, stop.line), (3, Span::from_millis(100), 24));
    assert_eq!(clock.what, Happening::Clock(vec![arm], Span::from_millis(-5), Some(20_000), Some(wandering)));
    let read: Vec<_> =
        conditions.expectations.iter().map(|e| (e.measure, e.station, e.relation, e.limit)).collect();
    let expected = [
        (Measure::SlotsMissed, Some(arm), Relation::AtMost, 3),
        (Measure::Overlaps, None, Relation::Equal, 0),
        (Measure::SyncError, None, Relation::Less, 20_000),
    ];
    assert_eq!(read, expected);
}

#[test]
fn what_cannot_happen_names_file_line_and_remedy() {
    let event = |what: &str| format!("[[event]]\nat = \"1s\"\n{what}\n");
    refused(&event("kill = \"leg\""), "net.toml:15: there is no station 'leg': there are arm, master");
    refused(&event(""), "net.toml:13: an event is one thing: kill, restart, start, stop,");
    refused(&event("kill = \"arm\"\nrestart = \"arm\""), "net.toml:13: an event is one thing");
    refused(
        &event("stop = \"arm\""),
        "net.toml:13: this lasts for some time: say how long, as in for = \"50ms\"",
    );
    refused(&event("kill = \"arm\"\nfor = \"1s\""), "net.toml:13: this takes no time: leave out for");
    refused(&event("kill = \"arm\"\ntimes = 3"), "net.toml:13: what happens several times says how often");
    refused(&event("inject = \"ff\""), "a frame to inject is 14 to 1514 bytes as hexadecimal digits");
    refused(
        &event("clock = { drift_ppm = 2000.0 }"),
        "net.toml:15: a clock off by 2000 ppm: at most 1000 ppm",
    );
    refused(&event("explode = \"arm\""), "unknown field `explode`");
    refused(&event("kill = []"), "net.toml:15: no station is named");
    refused(&event("kill = 5"), "a station's name, or a list of names");
    refused(
        &event("clock = { stations = \"arm\" }"),
        "a clock is set by a step of at most 3600s, a drift_ppm or a wander",
    );
    refused(
        &event("clock = { wander = { step_ppm = 0.1, within_ppm = 2000.0 } }"),
        "net.toml:15: a clock that wanders by 2000 ppm: from 0 to 1000",
    );
    refused(&event("clock = { step = \"180min\" }"), "a clock is set by a step of at most 3600s");
    refused(
        &event("kill = \"arm\"\ntimes = 12\nevery = \"1000000s\""),
        "nothing lasts, or comes later, than 3600s",
    );
    let babble = "babble = { station = \"arm\", every = \"1us\" }\nfor = \"3s\"";
    refused(&event(babble), "more than 1000000 frames");
    refused(
        "[[event]]\nat = \"50s\"\nkill = \"arm\"\n",
        "net.toml:13: over after 50s, and the measurement lasts 10s",
    );
    refused("[[event]]\nat = \"soon\"\nkill = \"arm\"\n", "'soon' does not begin with a number");
}

#[test]
fn events_of_one_kind_that_would_end_each_other_are_refused() {
    let events = |first: &str, second: &str| {
        let event = |at: &str, what: &str| format!("[[event]]\nat = \"{at}\"\n{what}\nfor = \"1s\"\n");
        event("1s", first) + &event("1500ms", second)
    };
    let arm = "unplug = \"arm\"";
    refused(
        &events(arm, arm),
        "net.toml:17: at once with the unplug of line 13: when one of them is over, so is the other",
    );
    refused(&events("cut = \"arm\"", "cut = \"master\""), "at once with the cut of line 13");
    refused(
        &events("wire = { lose = \"1%\" }", "wire = { stations = \"arm\", lose = \"2%\" }"),
        "with the wire",
    );
    assert!(parse(&events(arm, "unplug = \"master\"")).is_ok(), "of another station");
    assert!(parse(&events(arm, "wire = { lose = \"1%\" }")).is_ok(), "of another kind");
    assert!(parse(&events(arm, arm).replace("1500ms", "2s")).is_ok(), "one behind the other");
    let again = "[[event]]\nat = \"1s\"\nunplug = \"arm\"\nfor = \"300ms\"\ntimes = 5\nevery = \"100ms\"\n";
    refused(again, "net.toml:13: it would begin again before it is over");
}

#[test]
fn a_medium_a_host_or_a_wire_that_cannot_be_is_refused_where_it_stands() {
    refused("[medium]\njoint = \"hub\"\nqueue = 3\n", "net.toml:13: only a switch has a latency and a queue");
    refused("[medium]\njoint = \"ring\"\n", "unknown variant `ring`");
    refused(
        "[host]\nwake = \"gamma 3us\"\n",
        "net.toml:14: 'gamma 3us' is no distribution: write \"constant T\"",
    );
    refused(
        "[host]\nwake = \"uniform 3us 1us\"\n",
        "net.toml:14: the first of the two times must be the shorter one",
    );
    refused("[host]\nwake = \"constant 3\"\n", "net.toml:14: '3' has no unit that is known here");
    refused("[host]\nlate = \"recorded nowhere.json\"\n", "net.toml:14: nowhere.json cannot be read");
    refused("[[wire]]\nlose = \"half\"\n", "'half' does not begin with a number: write for example 1%");
    refused("[[wire]]\nlose = \"101%\"\n", "'101%' is no share");
    refused("[[wire]]\nstations = [\"arm\", \"leg\"]\n", "net.toml:14: there is no station 'leg'");
}

#[test]
fn what_nobody_measures_is_refused_with_what_can_be_expected() {
    refused(
        "[expect]\nhappiness = 3\n",
        "net.toml:14: nothing is called 'happiness': expect overlaps, out_of_slot,",
    );
    refused(
        "[expect]\noverlaps = \"few\"\n",
        "net.toml:14: 'few' is no count: write for example 0, \"<= 2\"",
    );
    refused(
        "[expect]\ncollisions = 0\n",
        "net.toml:14: collisions: this medium has none; see joint of [medium]",
    );
    refused("[expect]\noverlaps = 0.5\n", "a count, or a text like");
    let of_one = NETWORK.replace("slots_missed = \"<= 3\"", "overlaps = 0");
    let error = Source { file: "net.toml", text: &of_one }.parse().unwrap_err().to_string();
    assert!(
        error.contains("net.toml:7: nothing of a station is called 'overlaps': expect slots_missed"),
        "{error}"
    );
}
