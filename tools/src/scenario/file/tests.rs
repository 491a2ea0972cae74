use super::*;
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
    Source { file: "net.toml", text }.parse()
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
        (("cycle = \"1ms\"", "cycle = \"1\""), "line 2"),
        (("\"1ms\"", "\"200s\""), "net.toml:2: a cycle of 200s: no slave follows one outside 1us to 100s"),
        (("rate =", "rat ="), "unknown field `rat`"),
        (("\"500us\"", "\"105us\""), "net.toml:8: slot 0 of master and slot 0 of arm overlap: 100us"),
        (("\"500us\"", "\"999us\""), "net.toml:8: slot 0 of arm ends after the cycle"),
        (
            ("\"500us\"", "\"20us\""),
            "net.toml:8: slot 0 of arm begins at 20us, inside the sync window of 50us",
        ),
        (("\"2/2\"", "\"3/2\""), "net.toml:8: '3/2' is no phase"),
        (
            ("\"2/2\"", "\"2/1025\""),
            "net.toml:8: slot 0: a slave calibrates in its first slot, and no master promises a reply 1025 cycles",
        ),
        (("size = 100", "size = 60"), "net.toml:8: a size of 60 must hold the payload of 64"),
        (("\"slave\"", "\"master\""), "net.toml:10: 'master' is a second master beside 'arm'"),
        (("role = \"master\"", "role = \"slave\""), "no station has the role"),
        (("name = \"arm\"", "name = \"master\""), "net.toml:11: the name 'master' is taken"),
    ];
    for ((from, to), expected) in cases {
        let error = refused(from, to);
        assert!(error.contains(expected), "{to}: {error}");
    }
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
        ("priority = 30", "net.toml:10: priority 30: they go from 0, the most urgent, to 29"),
        ("priority = 3\nburst = 0", "net.toml:10: 0 frames every 4ms: 1 to 1000 are queued at a time"),
        ("priority = 3\npayload = 101", "a payload of 101 does not fit slot 0: give that a size of 101"),
        ("priority = 3\nslot = 2", "net.toml:10: the station has no slot 2"),
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
    assert!(twice.contains("net.toml:13: a second traffic of priority 3"), "{twice}");
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
            "net.toml:5: slot 0: a slave calibrates in its first slot, and no master promises",
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
        assert!(error.starts_with("net.toml:14: ") && error.contains(why), "{slot}: {error}");
    }
}
