use rtnet::sim::{Joint, Latency};

use super::*;
use crate::scenario::{Direction, Happening, Relation, Scenario, Wandering, Wire};

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
    Source::new("net.toml", &format!("{NETWORK}{more}")).parse()
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
    assert_eq!(conditions.joint, Joint::Switch { latency, queue: 64 });
    let arm = 1;
    assert_eq!(conditions.host(arm).wake, Latency::Uniform(Span::from_micros(1), Span::from_micros(3)));
    assert_eq!(conditions.host(0).stall_ppm, 7);
    let wandering = Wandering { every: Span::from_millis(100), step_ppb: 100, within_ppb: 2_000 };
    assert_eq!(conditions.wanders, [(0, wandering)]);
    let Wire { stations, direction, effects } = &conditions.wires[0];
    assert_eq!((&stations[..], *direction), (&[arm][..], Direction::In));
    assert_eq!(
        (effects.lose_control_ppm, effects.lose_data_ppm, effects.corrupt_ppm),
        (Some(5), Some(10_000), None),
        "what is said of one kind counts there"
    );
    let [stop, clock] = &conditions.events[..] else { panic!() };
    assert_eq!(stop.what, Happening::Stop(vec![arm, 0], Span::from_millis(50)));
    assert_eq!((stop.times, stop.every, stop.place.line), (3, Span::from_millis(100), 24));
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
    refused(&event("kill = \"leg\""), "net.toml:15:8: there is no station 'leg': there are arm, master");
    refused(&event(""), "net.toml:13:1: an event is one thing: kill, restart, start, stop,");
    refused(&event("kill = \"arm\"\nrestart = \"arm\""), "net.toml:13:1: an event is one thing");
    refused(
        &event("stop = \"arm\""),
        "net.toml:13:1: this lasts for some time: say how long, as in for = \"50ms\"",
    );
    refused(&event("kill = \"arm\"\nfor = \"1s\""), "net.toml:16:7: this takes no time: leave out for");
    refused(&event("kill = \"arm\"\ntimes = 3"), "net.toml:16:9: what happens several times says how often");
    refused(
        &event("inject = \"ff\""),
        "net.toml:15:10: a frame to inject is 14 to 1514 bytes as hexadecimal digits",
    );
    refused(
        &event("clock = { drift_ppm = 2000.0 }"),
        "net.toml:15:23: a clock off by 2000 ppm: at most 1000 ppm",
    );
    refused(&event("explode = \"arm\""), "unknown field `explode`");
    refused(&event("kill = []"), "net.toml:15:8: no station is named");
    refused(&event("kill = 5"), "a station's name, or a list of names");
    refused(
        &event("clock = { stations = \"arm\" }"),
        "a clock is set by a step of at most 3600s, a drift_ppm or a wander",
    );
    refused(
        &event("clock = { wander = { step_ppm = 0.1, within_ppm = 2000.0 } }"),
        "net.toml:15:51: a clock that wanders by 2000 ppm: from 0 to 1000",
    );
    refused(&event("clock = { step = \"180min\" }"), "a clock is set by a step of at most 3600s");
    refused(
        &event("kill = \"arm\"\ntimes = 12\nevery = \"1000000s\""),
        "net.toml:17:9: 11000000s: nothing lasts, or comes later, than 3600s",
    );
    let babble = "babble = { station = \"arm\", every = \"1us\" }\nfor = \"3s\"";
    refused(&event(babble), "more than 1000000 frames");
    refused(
        "[[event]]\nat = \"50s\"\nkill = \"arm\"\n",
        "net.toml:13:1: over after 50s, and the measurement lasts 10s",
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
        "net.toml:17:1: at once with the unplug of line 13: when one of them is over, so is the other",
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
    refused(again, "net.toml:18:9: it would begin again before it is over");
}

#[test]
fn a_medium_a_host_or_a_wire_that_cannot_be_is_refused_where_it_stands() {
    refused(
        "[medium]\njoint = \"hub\"\nqueue = 3\n",
        "net.toml:15:9: only a switch has a latency and a queue",
    );
    refused("[medium]\njoint = \"ring\"\n", "unknown variant `ring`");
    refused(
        "[host]\nwake = \"gamma 3us\"\n",
        "net.toml:14:8: 'gamma 3us' is no distribution: write \"constant T\"",
    );
    refused(
        "[host]\nwake = \"uniform 3us 1us\"\n",
        "net.toml:14:8: the first of the two times must be the shorter one",
    );
    refused("[host]\nwake = \"constant 3\"\n", "net.toml:14:8: '3' has no unit that is known here");
    refused("[host]\nlate = \"recorded nowhere.json\"\n", "net.toml:14:8: nowhere.json cannot be read");
    refused("[[wire]]\nlose = \"half\"\n", "'half' does not begin with a number: write for example 1%");
    refused("[[wire]]\nlose = \"101%\"\n", "'101%' is no share");
    refused("[[wire]]\nstations = [\"arm\", \"leg\"]\n", "net.toml:14:20: there is no station 'leg'");
}

#[test]
fn what_nobody_measures_is_refused_with_what_can_be_expected() {
    refused(
        "[expect]\nhappiness = 3\n",
        "net.toml:14:1: nothing is called 'happiness': expect overlaps, out_of_slot,",
    );
    refused(
        "[expect]\noverlaps = \"few\"\n",
        "net.toml:14:12: 'few' is no count: write for example 0, \"<= 2\"",
    );
    refused(
        "[expect]\ncollisions = 0\n",
        "net.toml:14:14: collisions: this medium has none; see joint of [medium]",
    );
    refused("[expect]\noverlaps = 0.5\n", "a count, a text like");
    let of_one = NETWORK.replace("slots_missed = \"<= 3\"", "overlaps = 0");
    let error = Source::new("net.toml", &of_one).parse().unwrap_err().to_string();
    assert!(
        error.contains("net.toml:7:12: nothing of a station is called 'overlaps': expect slots_missed"),
        "{error}"
    );
}

#[test]
fn what_means_nothing_is_refused_where_it_stands_with_what_does() {
    for (more, expected) in [
        (
            "[host]\noutages = { ppm = 2000000, longest = \"1ms\" }\n",
            "net.toml:14:19: 2000000 of a million: 0 to 1000000",
        ),
        (
            "[host]\nstalls = { ppm = 1, longest = \"9999min\" }\n",
            "net.toml:14:31: 599940s: nothing takes longer than 3600s",
        ),
        (
            "[medium]\njoint = \"switch\"\nqueue = 0\n",
            "net.toml:15:9: a queue of 0 frames: a port holds 1 to 100000",
        ),
        ("[medium]\npropagation = \"61min\"\n", "net.toml:14:15: 3660s: nothing takes longer than 3600s"),
        ("[[wire]]\n", "net.toml:13:1: a wire that does nothing to a frame: say lose, lose_control,"),
        ("[[wire]]\nstations = \"arm\"\n", "net.toml:13:1: a wire that does nothing"),
        ("[[wire]]\nreorder_by = \"1ms\"\n", "net.toml:13:1: a wire that does nothing"),
        (
            "[[wire]]\nlose = \"1%\"\nreorder_by = \"1ms\"\n",
            "net.toml:15:14: nothing is reordered by that time",
        ),
        (
            "[[wire]]\nreorder = \"1%\"\nreorder_by = \"10000000s\"\n",
            "net.toml:15:14: 10000000s: nothing takes longer than 3600s",
        ),
        (
            "[[wire]]\nlose_data = \"0.00001%\"\n",
            "net.toml:14:13: '0.00001%' is less than 1ppm, the least there is: write 0% or 1ppm",
        ),
        ("[expect]\noverlaps = -1\n", "net.toml:14:12: '-1': overlaps is never below 0: expect 0 or more"),
        ("[expect]\nsync_error = \"< -5us\"\n", "net.toml:14:14: '< -5us': sync_error is never below 0"),
        ("[expect]\noverlaps = \"< 0\"\n", "net.toml:14:12: '< 0': overlaps is never below 0"),
    ] {
        refused(more, expected);
    }
    assert!(parse("[expect]\nlatest_frame = \"< -5us\"\n").is_ok(), "before its slot's end");
    assert!(parse("[[wire]]\nlose = \"0%\"\n").is_ok(), "said, and be it nothing");
}

#[test]
fn an_event_that_cannot_be_names_what_of_it_and_the_bound() {
    let event = |what: &str| format!("[[event]]\nat = \"1s\"\n{what}\n");
    for (what, expected) in [
        (
            "kill = \"arm\"\ntimes = 4294967295\nevery = \"1ns\"",
            "net.toml:16:9: 4294967295 times: 1 to 1000000",
        ),
        (
            "kill = \"arm\"\nevery = \"1ms\"",
            "net.toml:16:9: what happens once is not repeated: say how many times",
        ),
        ("kill = [\"arm\", \"leg\"]", "net.toml:15:16: there is no station 'leg'"),
        ("cut = [\"arm\", \"master\"]\nfor = \"1ms\"", "net.toml:15:7: all stations are on one side"),
        (
            "start = \"master\"",
            "net.toml:15:9: 'master' is the master: nothing is measured before all are locked",
        ),
        (
            "wire = { stations = \"arm\" }\nfor = \"1ms\"",
            "net.toml:15:8: a wire that does nothing to a frame",
        ),
        (
            "clock = { wander = { step_ppm = 0.1, within_ppm = 1.0, every = \"1ns\" } }",
            "net.toml:15:64: a clock that changes its rate every 1ns: every 10us to 3600s; no station looks at it",
        ),
    ] {
        refused(&event(what), expected);
    }
    refused(
        "[[event]]\nat = \"-1s\"\nkill = \"arm\"\n",
        "net.toml:14:6: '-1s' is out of range: it must be 0s or more,",
    );
}

#[test]
fn a_section_is_found_where_it_stands_not_where_its_name_is_written_first() {
    let text =
        format!("# see [medium] and wander below\n{NETWORK}[medium]\njoint = \"hub\"\nlatency = \"1us\"\n");
    let error = Source::new("net.toml", &text).parse().unwrap_err().to_string();
    assert!(error.starts_with("net.toml:16:11: only a switch"), "{error}");
    let text = format!("# wander\n{}", NETWORK.replace("within_ppm = 2.0", "within_ppm = -2.0"));
    let error = Source::new("net.toml", &text).parse().unwrap_err().to_string();
    assert!(error.starts_with("net.toml:13:68: a clock that wanders by -2 ppm"), "{error}");
}

#[test]
fn the_wrong_brackets_are_told_of_in_words_of_the_file() {
    refused(
        "[event]\nat = \"1s\"\n",
        "net.toml:13:2: there may be more than one event: it is written [[event]]",
    );
    refused(
        "[wire]\nlose = \"1%\"\n",
        "net.toml:13:2: there may be more than one wire: it is written [[wire]]",
    );
    refused(
        "[[medium]]\njoint = \"hub\"\n",
        "net.toml:13:3: there is only one medium: it is written [medium]",
    );
    let text = NETWORK.replace("[[station]]\nname = \"arm\"", "[station]\nname = \"arm\"");
    let error = Source::new("net.toml", &text).parse().unwrap_err().to_string();
    assert!(error.contains("it is written [[station]]") || error.contains("duplicate key"), "{error}");
}
