//! The wires of a lab, to which something happens while a station is away.

use std::fs::{self, File};
use std::process::{Child, Stdio};

use nix::sched::{CloneFlags, setns};
use serde_json::Value;
use tempfile::TempDir;
use tools::lab::netlink::Netlink;

use crate::host::{is_sound, network, shared};
use crate::lab::{eventually, is_there, running};
use crate::rtnet;

/// Three stations that are soon calibrated, and behind them what happens.
const STATIONS: &str = r#"
[[station]]
name = "master"
role = "master"
rounds = 10
[[station]]
name = "slave1"
role = "slave"
rounds = 10
[[station]]
name = "slave2"
role = "slave"
rounds = 10
"#;

const LOSSY_AND_UNPLUGGED: [&str; 2] = [
    r#"
cycle = "4ms"
duration = "7s"
max_miss = "100%"
"#,
    r#"
[[event]]
at = "500ms"
wire = { stations = "slave2", direction = "in", lose_data = "50%" }
for = "5500ms"
[[event]]
at = "1s"
kill = "slave2"
[[event]]
at = "2s"
unplug = "slave2"
for = "2500ms"
[[event]]
at = "3s"
restart = "slave2"
[expect]
overlaps = 0
unexplained = 0
"#,
];

const CHANGING: [&str; 2] = [
    r#"
cycle = "2ms"
duration = "4s"
"#,
    r#"
[[event]]
at = "0s"
wire = { direction = "in", corrupt = "5%" }
for = "3500ms"
[expect]
overlaps = 0
unexplained = 0
"#,
];

/// A run of a lab, while something is done to it.
struct Run {
    lab: Child,
    /// For its report.
    dir: TempDir,
}

impl Run {
    fn of([network, events]: [&str; 2]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("network.toml");
        fs::write(&file, [network, STATIONS, events].concat()).unwrap();
        let mut command = rtnet();
        command.args(["lab", "run"]).arg(&file).arg("--json").arg(dir.path().join("report.json"));
        let lab = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        Self { lab, dir }
    }

    /// Its exit status, what it says, and its report; `None` if this host does not let a lab impair its wires.
    fn end(self, test: &str) -> Option<(Option<i32>, String, Value)> {
        let output = self.lab.wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        if text.contains("wires lose nothing, and none is cut off") {
            crate::host::skip(test, &text);
            return None;
        }
        let report = fs::read(self.dir.path().join("report.json")).unwrap();
        Some((output.status.code(), text, crate::schema::read(&report)))
    }
}

/// Takes an interface away from a namespace.
fn remove(interface: &str, namespace: &File) {
    let remove = || {
        setns(namespace, CloneFlags::CLONE_NEWNET).unwrap();
        let mut netlink = Netlink::open().unwrap();
        let index = netlink.link_index(interface).unwrap();
        netlink.delete_link(index).unwrap();
    };
    // It never comes back.
    std::thread::scope(|scope| scope.spawn(remove).join().unwrap());
}

#[test]
fn a_sync_that_is_changed_on_its_way_silences_nobody_without_a_cause() {
    let name = "a_sync_that_is_changed_on_its_way_silences_nobody_without_a_cause";
    network(name, || {
        let Some((_, text, report)) = Run::of(CHANGING).end(name) else { return };
        assert_eq!(report["unexplained"], 0, "{text}");
        // Of 175 syncs that are changed most are refused at once, for one reason or another: for this one some 20 to 40.
        let refused = |station: usize| report["per_station"][station]["refusals"].as_object().unwrap();
        let syncs = |station| refused(station)["implausible_sync"].as_u64().unwrap();
        assert!(syncs(1) + syncs(2) >= 10, "{text}");
        assert!(report["causes"]["sync_lost_or_late"].as_u64() >= Some(5), "{text}");
    });
}

#[test]
fn a_station_whose_interface_went_while_it_was_dead_comes_back_to_its_wire_as_it_is_by_then() {
    let name = "a_station_whose_interface_went_while_it_was_dead_comes_back_to_its_wire_as_it_is_by_then";
    shared(name, || {
        let mut run = Run::of(LOSSY_AND_UNPLUGGED);
        let is_slave2 = |pid: &i32| {
            let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap();
            line.contains(r#""name":"slave2""#)
        };
        let slave2 = running(&mut run.lab, 3).into_iter().find(is_slave2).unwrap();
        let namespace = File::open(format!("/proc/{slave2}/ns/net")).unwrap();
        eventually("it is killed", || !is_there(slave2));
        remove("rt0", &namespace);

        let Some((status, text, report)) = run.end(name) else { return };
        assert!(is_sound(name, status, &report["verdict"]), "{text}");
        let of_slave2 = |what: &str| report["per_station"][2][what].as_u64().unwrap();
        let missed = of_slave2("slots_missed");
        assert!(missed >= 860, "dead, and then without a carrier, for 875 cycles: {missed}");
        // Half of 300, for it has to calibrate first; and it counts from its first frame on.
        let lost = of_slave2("frames_lost");
        assert!(lost >= 80, "its wire still loses half of what comes: {lost} {text}");
    });
}
