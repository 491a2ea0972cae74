use super::*;
use crate::control::ScheduleSaid;
use crate::scenario::{DelayName, Measure, SlotPlan, StationPlan};
use crate::station::traffic::Flow;

const GOOD: &str = r#"
cycle = "1ms"
rate = "100M"

[[station]]
name = "arm"
role = "slave"
slots = [{ id = 0, offset = "500us", phase = "2/2", size = 100 }]

[[station]]
name = "master"
role = "master"
clock = { offset = "-120ms", drift_ppm = 12.5 }
slots = [{ id = 0, offset = "100us" }]
"#;

fn parse(text: &str) -> Result<Scenario, FileError> {
    Source::new("net.toml", text).parse()
}

fn refused(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from));
    parse(&GOOD.replace(from, to)).unwrap_err().to_string()
}

#[test]
fn a_file_says_everything_per_station() {
    let network = parse(GOOD).unwrap();
    let [master, arm] = &network.stations[..] else { panic!() };
    assert_eq!(
        (master.role, master.clock_offset, master.clock_drift_ppb),
        (Role::Master, Span::from_millis(-120), 12_500)
    );
    let offset = Span::from_micros(500);
    assert_eq!(arm.slots, [SlotPlan { id: 0, offset, phase: 1, period: 2, size: 100, joint: None }]);
    let guarded = GOOD.replace("rate =", "slot_guard = \"kernel\"\nrate =");
    assert_eq!(parse(&guarded).unwrap().slot_guard, SlotGuard::Kernel);
    let without_a_filter = GOOD.replace("rate =", "servo = \"none\"\nrate =");
    let servos = [GOOD, &without_a_filter].map(|text| parse(text).unwrap().servo);
    assert_eq!(servos, [ServoName::Linear, ServoName::None]);
    let by_median = GOOD.replace("rate =", "delay = \"median\"\nrate =");
    assert_eq!([GOOD, &by_median].map(|text| parse(text).unwrap().delay), [None, Some(DelayName::Median)]);
    // The closest: 100 us, (78 + 24) bytes of 80 ns, 500 us.
    assert_eq!(network.guard.nanos(), 400_000 - 8_160);
}

#[test]
fn without_slots_the_cycle_is_divided_evenly() {
    let text = GOOD.lines().filter(|line| !line.starts_with("slots")).collect::<Vec<_>>().join("\n");
    let network = parse(&text).unwrap();
    let offsets: Vec<_> = network.stations.iter().map(|station| station.slots[0].offset.nanos()).collect();
    assert_eq!(offsets, [562_500, 125_000], "in the order of the file; the master is listed first");
}

#[test]
fn what_cannot_be_names_file_line_and_remedy() {
    let cases = [
        (("cycle = \"1ms\"", "cycle = \"1\""), "net.toml:2:9: '1' has no unit"),
        (("\"1ms\"", "\"200s\""), "net.toml:2:9: a cycle of 200s: no slave follows one outside 1us to 100s"),
        (("rate =", "rat ="), "unknown field `rat`"),
        (("\"500us\"", "\"105us\""), "net.toml:8:10: slot 0 of master and slot 0 of arm overlap: 100us"),
        (("\"500us\"", "\"999us\""), "net.toml:8:10: slot 0 of arm ends after the cycle"),
        (
            ("\"500us\"", "\"20us\""),
            "net.toml:8:10: slot 0 of arm begins at 20us, inside the sync window of 50us",
        ),
        (("\"2/2\"", "\"3/2\""), "net.toml:8:46: '3/2' is no phase"),
        (
            ("\"2/2\"", "\"2/1025\""),
            "net.toml:8:10: slot 0: a slave calibrates in its first slot, and no master promises a reply 1025 cycles",
        ),
        (("size = 100", "size = 60"), "net.toml:8:60: a size of 60 must hold the payload of 64"),
        (("\"slave\"", "\"master\""), "net.toml:10:1: 'master' is a second master beside 'arm'"),
        (("role = \"master\"", "role = \"slave\""), "no station has the role"),
        (("name = \"arm\"", "name = \"master\""), "net.toml:11:8: the name 'master' is taken"),
    ];
    for ((from, to), expected) in cases {
        let error = refused(from, to);
        assert!(error.contains(expected), "{to}: {error}");
    }
}

#[test]
fn a_list_of_expectations_is_each_of_them() {
    let expecting = |figure: &str| parse(&format!("{GOOD}\n[expect]\nout_of_slot = {figure}\n"));
    let all = expecting("[\">= 1\", \"<= 8\"]").unwrap().conditions.expectations;
    let all: Vec<String> = all.iter().map(ToString::to_string).collect();
    assert_eq!(all, ["out_of_slot >= 1", "out_of_slot <= 8"]);
    let error = expecting("[]").unwrap_err().to_string();
    assert!(error.contains("an empty list expects nothing of out_of_slot: write for example"), "{error}");
}

#[test]
fn traffic_is_read_most_urgent_first_and_what_cannot_be_of_it_is_refused_where_it_stands() {
    let with =
        |more: &str| {
            parse(&GOOD.replace(
                "[[station]]\nname = \"master\"",
                &format!("{more}\n[[station]]\nname = \"master\""),
            ))
        };
    let traffic = |what: &str| format!("[[station.traffic]]\nevery = \"4ms\"\n{what}\n");
    let backlog = traffic("priority = 20\nburst = 8\npayload = 100\nexpect = { queueing_p99 = \"< 9ms\" }");
    let network = with(&(backlog + &traffic("priority = 3"))).unwrap();
    let flow = |priority, burst, payload| Flow { priority, every_ns: 4_000_000, burst, payload, slot: 0 };
    assert_eq!(network.stations[1].flows, [flow(3, 1, 64), flow(20, 8, 100)]);
    let expected = &network.conditions.expectations[0];
    assert_eq!(
        (expected.measure, expected.station, expected.priority),
        (Measure::QueueingP99, Some(1), Some(20))
    );
    let plan = network.flow_plan(network.receiver(1));
    assert_eq!((plan.flows, plan.from), (vec![], network.stations[1].flows.clone()));
    for (what, why) in [
        ("priority = 30", "net.toml:10:1: priority 30: they go from 0, the most urgent, to 29"),
        ("priority = 3\nburst = 0", "net.toml:10:1: 0 frames every 4ms: 1 to 1000 are queued at a time"),
        ("priority = 3\npayload = 101", "a payload of 101 does not fit slot 0: give that a size of 101"),
        ("priority = 3\nslot = 2", "net.toml:10:1: the station has no slot 2"),
        (
            "priority = 3\nexpect = { overlaps = 0 }",
            "nothing of traffic is called 'overlaps': expect frames_seen, queueing",
        ),
        ("priority = 3\noften = 2", "unknown field `often`"),
    ] {
        let error = with(&traffic(what)).unwrap_err().to_string();
        assert!(error.contains(why), "{what}: {error}");
    }
    let twice = with(&(traffic("priority = 3") + &traffic("priority = 3"))).unwrap_err().to_string();
    assert!(twice.contains("net.toml:13:1: a second traffic of priority 3"), "{twice}");
    let divided: String =
        GOOD.lines().filter(|line| !line.starts_with("slots")).map(|line| line.to_owned() + "\n").collect();
    let divided = parse(&(divided + &traffic("priority = 3\npayload = 700"))).unwrap();
    assert_eq!(divided.stations[0].slots[0].size, 700, "as large as need be");
}

#[test]
fn backups_are_read_and_what_cannot_be_of_them_is_refused() {
    let network = |backup: &str, role: &str, slots: &str| {
        format!(
            "cycle = \"2ms\"\n[[station]]\nname = \"m\"\nrole = \"master\"\n{slots}\
             [[station]]\nname = \"b\"\nrole = \"{role}\"\n{backup}{slots2}",
            slots2 = slots.replace("300us", "900us")
        )
    };
    let slots = "slots = [{ id = 0, offset = \"300us\" }]\n";
    let read = parse(&network("backup = \"100us\"\n", "backup", slots)).unwrap();
    assert_eq!(
        (read.stations[1].role, read.stations[1].backup),
        (Role::Backup, Some(Span::from_micros(100)))
    );
    let divided = parse(&network("backup = \"100us\"\n", "backup", "")).unwrap();
    assert_eq!(
        (divided.sync_window, divided.stations[0].slots[0].offset),
        (Span::from_micros(50), Span::from_micros(150))
    );
    for (backup, role, slots, why) in [
        ("", "backup", slots, "a backup says when it sends"),
        ("backup = \"100us\"\n", "slave", slots, "and nobody else does"),
        ("backup = \"60us\"\n", "backup", slots, "backup b sends 60us after a cycle's start"),
        (
            "backup = \"100us\"\n",
            "backup",
            "slots = [{ id = 0, offset = \"300us\", phase = \"1/1025\" }]\n",
            "net.toml:5:10: slot 0: a slave calibrates in its first slot, and no master promises",
        ),
        ("backup = \"280us\"\n", "backup", slots, "slot 0 of m begins at 300us, but backup b may send"),
    ] {
        let refused = parse(&network(backup, role, slots)).unwrap_err().to_string();
        assert!(refused.contains(why), "{refused}");
    }
}

#[test]
fn joint_slots_are_read_in_any_order_and_what_cannot_be_joined_is_refused_where_it_stands() {
    let with = |more: &str| {
        parse(&GOOD.replace(
            "slots = [{ id = 0, offset = \"100us\"",
            &format!("slots = [{more}\n{{ id = 0, offset = \"100us\""),
        ))
    };
    let chain =
        with(r#"{ id = 3, offset = "700us", joint = 2 }, { id = 2, offset = "300us", joint = 0 },"#).unwrap();
    let joints: Vec<_> = chain.stations[0].slots.iter().map(|slot| (slot.id, slot.joint)).collect();
    assert_eq!(joints, [(3, Some(0)), (2, Some(0)), (0, None)], "one queue");
    for (slot, why) in [
        (
            r#"{ id = 2, offset = "300us", joint = 1 },"#,
            "slot 2 cannot be joined to slot 1: that is not defined",
        ),
        (r#"{ id = 2, offset = "300us", joint = 2 },"#, "slot 2 cannot be joined to slot 2: that would take"),
        (
            r#"{ id = 2, offset = "300us", size = 100, joint = 0 },"#,
            "slot 2 cannot be joined to slot 0: it takes 100 bytes, slot 0 64",
        ),
        (r#"{ id = 2, offset = "505us", joint = 0 },"#, "slot 0 of arm and slot 2 of master overlap"),
    ] {
        let error = with(slot).unwrap_err().to_string();
        assert!(error.starts_with("net.toml:14:10: ") && error.contains(why), "{slot}: {error}");
    }
}

#[test]
fn a_backup_that_is_in_the_way_of_all_slots_names_its_line_and_its_bound() {
    let network = |backup: &str| {
        format!(
            "cycle = \"1ms\"\n[[station]]\nname = \"m\"\nrole = \"master\"\n[[station]]\nname = \"b\"\n\
             role = \"backup\"\nbackup = \"{backup}\"\n"
        )
    };
    for (backup, expected) in [
        (
            "2s",
            "net.toml:8:10: backup b sends 2s after a cycle's start, and a cycle lasts 1ms: let it send before",
        ),
        (
            "990us",
            "net.toml:8:10: 2 slots do not fit a cycle of 1ms behind a backup that sends 990us after its start: they take \
             51.632us with the sync window; let it send 948.368us after it, or earlier",
        ),
        ("60us", "net.toml:8:10: backup b sends 60us after a cycle's start, but looks before"),
    ] {
        let error = parse(&network(backup)).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{error}");
    }
    assert!(parse(&network("948368ns")).is_ok());
}

#[test]
fn a_sync_window_holds_a_sync_at_the_mediums_rate() {
    let slow =
        GOOD.replace("100M", "10M").replace("\"100us\"", "\"400us\"").replace("\"500us\"", "\"700us\"");
    let network = parse(&slow).unwrap();
    let air = network.rate.air_time(0);
    assert_eq!(
        (air.nanos(), network.sync_window),
        (67_200, Span::from_micros(125)),
        "an eighth of the cycle"
    );
    let longer = slow.replace("\"1ms\"", "\"10ms\"");
    assert_eq!(
        parse(&longer).unwrap().sync_window,
        air * 4,
        "a sync that begins in three quarters ends in it"
    );
    let short = parse(&slow.replace("rate =", "sync_window = \"67199ns\"\nrate =")).unwrap_err().to_string();
    let expected =
        "net.toml:3:15: a sync window of 67.199us: at this rate a sync is on the air for 67.2us; make it";
    assert!(short.starts_with(expected), "{short}");
    assert!(parse(&slow.replace("rate =", "sync_window = \"67200ns\"\nrate =")).is_ok());
}

#[test]
fn who_could_never_calibrate_is_told_by_how_long_a_frame_may_be_on_its_way() {
    let with = |propagation: &str, more: &str| {
        parse(&format!("{GOOD}[medium]\npropagation = \"{propagation}\"\n{more}"))
    };
    let error = with("1ms", "").unwrap_err().to_string();
    let expected = "net.toml:16:15: a frame is on its way for 1ms: 'arm' would never be locked, since it calibrates in its \
                    slot 0, every 2ms, and a round takes that way forth and back; let it be less than 1ms";
    assert_eq!(error, expected);
    assert!(with("999us", "").is_ok());
    assert!(with("400us", "joint = \"switch\"\nlatency = \"300us\"\n").is_err(), "to it and from it");
    let without = GOOD.replace("role = \"slave\"", "role = \"slave\"\nrounds = 0");
    assert!(parse(&format!("{without}[medium]\npropagation = \"1ms\"\n")).is_ok(), "who does not calibrate");
}

#[test]
fn names_no_lab_could_use_are_refused_in_files() {
    let names =
        ["", " ", "left arm", r"a\nb\u001b[31m", "a/b", "..", ".a", "-a", "k\u{f6}rper", "a.sock", "a.lock"];
    for name in names.map(str::to_owned).into_iter().chain(["x".repeat(33)]) {
        let error = refused("name = \"arm\"", &format!("name = \"{name}\""));
        let named = error.strip_prefix("net.toml:6:8: '").unwrap_or_else(|| panic!("{error}"));
        assert!(
            named.contains("' is no name: use letters A to Z, digits, ") && !error.contains('\u{1b}'),
            "{error}"
        );
    }
    for name in ["a", "Arm", "0", "a-b_c.d", &"x".repeat(32)] {
        assert!(parse(&GOOD.replace("name = \"arm\"", &format!("name = \"{name}\""))).is_ok(), "{name}");
    }
}

#[test]
fn more_stations_than_memory_are_refused() {
    let station = |n| format!("[[station]]\nname = \"s{n}\"\nrole = \"slave\"\n");
    let many: String = (0..10_000).map(station).collect();
    let error = parse(&format!("{GOOD}{many}")).unwrap_err().to_string();
    assert!(error.starts_with("net.toml:30009:1: 10002 stations: there must be 2 to 10000;"), "{error}");
}

#[test]
fn a_message_shows_the_place_and_no_more_of_a_line_than_a_screen_holds() {
    let error = parse(&format!("cycle = \"1ms\"\nx = [{}\n\"\u{1b}[31m\", !]\n", "1, ".repeat(30)));
    let error = error.unwrap_err().to_string();
    assert!(error.starts_with("net.toml:3:") && !error.contains('\u{1b}'), "{error:?}");
    let huge = "a".repeat(1_000_000);
    for text in
        [format!("{GOOD}x = \"{huge}\"\n"), format!("{GOOD}{huge} = 1\n"), format!("x = {huge}"), huge]
    {
        let error = parse(&text).unwrap_err().to_string();
        assert!(
            error.len() < 1_000 && error.starts_with("net.toml:"),
            "{} bytes, {:.200}",
            error.len(),
            error
        );
    }
    let shifted = parse(&format!("{}x = !", "a = 1, ".repeat(30))).unwrap_err().to_string();
    assert!(shifted.lines().all(|line| line.len() < 100), "{shifted}");
    let deep = parse(&format!("{}b = 1\n", "a.".repeat(20_000))).unwrap_err().to_string();
    assert_eq!(deep, "net.toml: a key of more parts, a.b.c, than are read");
}

#[test]
fn columns_are_counted_in_characters() {
    let error = parse("cycle = \"µ\" # \"\nx = {y = \"µµµ\", z = !}").unwrap_err().to_string();
    assert!(error.starts_with("net.toml:2:21: "), "{error}");
}

#[test]
fn a_file_without_an_end_is_refused_not_read_until_memory_is_full() {
    let error = load(Path::new("/dev/zero")).unwrap_err().to_string();
    assert_eq!(error, "/dev/zero: more than 16 MiB, which nothing is that is read here");
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("net.toml");
    std::fs::write(&path, b"cycle = \"1ms\"\nname = \"\xe9\"\n").unwrap();
    let error = load(&path).unwrap_err().to_string();
    assert!(error.ends_with("net.toml: line 2, column 9: this is no text in UTF-8"), "{error}");
    let recorded = crate::report::recorded::load(Path::new("/dev/zero")).unwrap_err();
    assert_eq!(
        format!("{recorded:#}"),
        "/dev/zero cannot be read: more than 16 MiB, which nothing is that is read here"
    );
}

/// Three stations whose master stands second, with something at the top and something in the first.
fn with_addresses(top: &str, first: &str) -> Result<Scenario, FileError> {
    parse(&format!(
        "cycle = \"1ms\"\n{top}\n[[station]]\nname = \"arm\"\nrole = \"slave\"\n{first}\n[[station]]\nname = \"m\"\n\
         role = \"master\"\n[[station]]\nname = \"leg\"\nrole = \"slave\"\n"
    ))
}

#[test]
fn stations_of_a_network_have_addresses_by_their_places_or_their_own_and_room_in_their_slots() {
    let of = |top: &str, first: &str| {
        let scenario = with_addresses(top, first).unwrap();
        let ip = |station: &StationPlan| station.ip.map(|own| format!("{}/{}", own.ip, own.prefix));
        let all = scenario.stations.iter().map(|station| (ip(station), station.slots[0].size));
        all.collect::<Vec<_>>()
    };
    let with = |ip: &str, size| (Some(ip.to_owned()), size);
    let network = "network = \"10.0.0.0/24\"";
    let by_place = [with("10.0.0.1/24", 1_500), with("10.0.0.2/24", 1_500), with("10.0.0.3/24", 1_500)];
    assert_eq!(of(network, ""), by_place);
    for own in ["10.0.0.7", "10.0.0.7/24"] {
        assert_eq!(of(network, &format!("ip = \"{own}\""))[1], with("10.0.0.7/24", 1_500));
    }
    // Who has none has no sockets.
    assert_eq!(of("", "ip = \"172.16.0.1\""), [(None, 64), with("172.16.0.1/16", 1_500), (None, 64)]);
    assert_eq!(of("", ""), [(None, 64), (None, 64), (None, 64)]);
    let short = parse(&GOOD.replace("rate =", "network = \"10.0.0.0/30\"\nrate =")).unwrap();
    assert_eq!(
        (short.stations[0].slots[0].size, short.stations[1].slots[0].size),
        (1_500, 100),
        "as it says"
    );
}

#[test]
fn addresses_that_cannot_be_name_line_and_remedy() {
    let network = "network = \"10.0.0.0/24\"";
    for (top, first, expected) in [
        ("network = \"10.0.0.1/24\"", "", "net.toml:2:11: '10.0.0.1/24' is no IPv4 address or network"),
        (
            "network = \"10.0.0.4/31\"",
            "",
            "net.toml:2:11: 10.0.0.4/31 has addresses for 0 stations, and there are 3: write network = \"10.0.0.0/29\"",
        ),
        ("network = \"10.0.0.0/30\"", "", "net.toml:2:11: 10.0.0.0/30 has addresses for 2 stations"),
        ("network = \"127.0.0.0/8\"", "", "net.toml:2:11: '127.0.0.2/8' is a loopback address"),
        (network, "ip = \"10.0.1.7/24\"", "net.toml:6:6: 10.0.1.7/24 is none of the network 10.0.0.0/24"),
        (network, "ip = \"10.0.0.7/16\"", "net.toml:6:6: 10.0.0.7/16 is none of the network 10.0.0.0/24"),
        (network, "ip = \"10.0.0.255\"", "net.toml:6:6: '10.0.0.255/24' is the broadcast address"),
        ("", "ip = \"10.0.0\"", "net.toml:6:6: '10.0.0' is no IPv4 address: write an address of one station"),
        (
            network,
            "ip = \"10.0.0.3\"",
            "net.toml:6:6: 'arm' and 'leg' would both have the address 10.0.0.3: give one of them another",
        ),
        (
            "guard = \"310us\"\nnetwork = \"10.0.0.0/24\"",
            "",
            "net.toml:1:9: 3 slots do not fit a cycle of 1ms",
        ),
    ] {
        let error = with_addresses(top, first).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{top} {first}: {error}");
    }
    let full = with_addresses("guard = \"310us\"\nnetwork = \"10.0.0.0/24\"", "").unwrap_err().to_string();
    assert!(full.contains("with an address hold 1500 bytes: give all slots a size"), "{full}");
}

#[test]
fn one_station_is_a_schedule_but_no_network() {
    let alone = "cycle = \"50ms\"\n[[station]]\nname = \"m\"\nrole = \"master\"\nslots = [{ id = 0, offset = \"10ms\" }]\n";
    let error = Source::new("net.toml", alone).parse().unwrap_err().to_string();
    assert_eq!(error, "net.toml:2:1: there must be 2 stations or more, and there are 1: add a [[station]]");
    let schedule = Source::new("net.toml", alone).parse_schedule().unwrap();
    let book = ScheduleSaid::of(&schedule, |id| schedule.address(id).to_string()).book().unwrap();
    assert_eq!((book.cycle(), book.planned().len()), (Span::from_millis(50), 1));
}
