//! `rtnet station`: what it refuses, two of them on one medium, and what becomes of them when that fails.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use rtnet::live::clock::monotonic;
use serde_json::Value;
use tools::lab::namespace::{Namespace, Segment};
use tools::station::link::{LabOptions, Report};

use crate::host::network;
use crate::rtnet;

const A: [u8; 6] = [2, 0, 0, 0, 0, 0xa];
const B: [u8; 6] = [2, 0, 0, 0, 0, 0xb];
/// Long enough for a loaded machine, and never waited for in full when all is well.
const PATIENCE: Duration = Duration::from_secs(20);

/// Two namespaces on one segment, with the interface `rt0` each.
struct Medium {
    a: Namespace,
    b: Namespace,
    segment: Segment,
}

impl Medium {
    fn new() -> Self {
        let (a, b) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&a, "port0", "rt0", A).unwrap();
        segment.attach(&b, "port1", "rt0", B).unwrap();
        Self { a, b, segment }
    }

    /// Cuts the wire at a port, or joins it again.
    fn set_port(&self, port: &str, up: bool) {
        set(self.segment.namespace(), port, up);
    }
}

/// Sets an interface up or down.
fn set(namespace: &Namespace, interface: &str, up: bool) {
    let mut netlink = namespace.netlink().unwrap();
    let index = netlink.link_index(interface).unwrap();
    if up { netlink.set_up(index).unwrap() } else { netlink.set_down(index).unwrap() }
}

/// A station in the foreground; told to end, or killed, when the test is done with it.
struct Station {
    child: Child,
    /// What it says, on whichever output.
    lines: Receiver<String>,
}

impl Station {
    fn start(namespace: &Namespace, arguments: &[&str]) -> Self {
        let mut command = rtnet();
        command.arg("station").args(arguments);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = namespace.run(move || command.spawn()).unwrap().unwrap();
        let (told, lines) = channel();
        pass_on(child.stdout.take().unwrap(), told.clone());
        pass_on(child.stderr.take().unwrap(), told);
        Self { child, lines }
    }

    /// A master of a cycle of 5 ms in `a`.
    fn master(medium: &Medium, name: &str) -> Self {
        let cycle = ["--interface", "rt0", "--master", "--cycle", "5ms", "--name", name];
        let master = Self::start(&medium.a, &cycle);
        master.wait_for("master_active");
        master
    }

    /// A slave of it in `b`, locked.
    fn slave(medium: &Medium, name: &str) -> Self {
        let role = ["--interface", "rt0", "--slave", "--rounds", "10", "--slot", "0=1ms", "--name", name];
        let slave = Self::start(&medium.b, &role);
        slave.wait_for("locked, cycle");
        slave
    }

    /// Waits for its end: its exit status.
    fn ended(&mut self) -> Option<ExitStatus> {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(status) = self.child.try_wait().unwrap() {
                return Some(status);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        None
    }

    /// Kills it, so that it cannot tidy up.
    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Reads until a line that holds `text`.
    fn wait_for(&self, text: &str) -> String {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let patience = deadline.saturating_duration_since(Instant::now());
            let line = self.lines.recv_timeout(patience).unwrap_or_else(|_| panic!("no line with '{text}'"));
            if line.contains(text) {
                return line;
            }
        }
    }

    /// Tells it to end, as Ctrl-C does; its exit status.
    fn end(mut self) -> Option<i32> {
        kill(Pid::from_raw(self.child.id() as i32), Signal::SIGINT).unwrap();
        self.child.wait().unwrap().code()
    }
}

impl Drop for Station {
    fn drop(&mut self) {
        // One that has ended by itself is not told again: its number may be another's.
        if let Ok(None) = self.child.try_wait() {
            let _ = kill(Pid::from_raw(self.child.id() as i32), Signal::SIGTERM);
            if self.ended().is_none() {
                self.kill();
            }
        }
    }
}

fn pass_on(output: impl Read + Send + 'static, to: Sender<String>) {
    let mut lines = BufReader::new(output).lines().map_while(Result::ok);
    std::thread::spawn(move || lines.try_for_each(|line| to.send(line)));
}

fn status(name: &str) -> Value {
    let output = rtnet().args(["tdma", "-S", name, "status", "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The first status of a station of which this holds.
fn wait_until(what: &str, name: &str, holds: impl Fn(&Value) -> bool) -> Value {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let status = status(name);
        if holds(&status) {
            return status;
        }
        assert!(Instant::now() < deadline, "in vain: {what}: {status:#}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn is(link: &'static str, state: &'static str) -> impl Fn(&Value) -> bool {
    move |status| status["link"] == link && status["standing"]["state"] == state
}

fn output_in(namespace: &Namespace, mut command: Command) -> Output {
    namespace.run(move || command.output()).unwrap().unwrap()
}

fn refused(output: &Output) -> String {
    assert!(!output.status.success());
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[test]
fn an_interface_that_does_not_exist_is_named_with_those_there_are() {
    let output =
        rtnet().args(["station", "--interface", "nosuch0", "--slave", "--rounds", "0"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let message = refused(&output);
    assert!(message.contains("there is no interface 'nosuch0' here; there are: ") && message.contains("lo"));
}

#[test]
fn without_privileges_one_line_says_what_to_do() {
    use std::os::unix::fs::PermissionsExt;
    use std::os::unix::process::CommandExt;
    network("without_privileges_one_line_says_what_to_do", || {
        // The binary's folder need not be open to others.
        let dir = tempfile::tempdir().unwrap();
        let binary = dir.path().join("rtnet");
        std::fs::copy(env!("CARGO_BIN_EXE_rtnet"), &binary).unwrap();
        std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
        let medium = Medium::new();
        let mut nobody = Command::new(&binary);
        nobody.args(["station", "--interface", "rt0", "--slave", "--rounds", "0"]);
        nobody.uid(65_534).gid(65_534).current_dir("/");
        let output = output_in(&medium.a, nobody);
        let message = refused(&output);
        assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
        assert!(message.contains("'rt0' (run as root, or give CAP_NET_RAW)"), "{message}");
    });
}

#[test]
fn a_slave_joins_a_master_and_notices_its_end() {
    network("a_slave_joins_a_master_and_notices_its_end", || {
        let medium = Medium::new();
        let master = Station::master(&medium, "join-master");
        let slave = Station::start(
            &medium.b,
            &["--interface", "rt0", "--slave", "--rounds", "10", "--slot", "0=1ms", "--name", "join-slave"],
        );
        let locked = slave.wait_for("locked, cycle");
        assert!(locked.contains("of 5ms"), "{locked}");
        drop(master);
        slave.wait_for("sync_lost");
        assert_eq!(slave.end(), Some(0), "told to end");
    });
}

#[test]
fn a_second_master_refuses_to_start_and_names_the_first() {
    network("a_second_master_refuses_to_start_and_names_the_first", || {
        let medium = Medium::new();
        let master = Station::start(&medium.a, &["--interface", "rt0", "--master", "--cycle", "5ms"]);
        master.wait_for("master_active");
        let mut second = rtnet();
        second.args(["station", "--interface", "rt0", "--master", "--cycle", "5ms"]);
        let output = output_in(&medium.b, second);
        assert_eq!(output.status.code(), Some(1), "it ran: the help says so");
        let message = refused(&output);
        assert!(message.contains("another master (02:00:00:00:00:0a) is active on this medium"), "{message}");
        assert!(message.contains("--slave"), "the remedy: {message}");
    });
}

/// What is asked of a running station: refused in one line, which is returned, or done.
fn asked(arguments: &[&str]) -> Result<(), String> {
    let output = rtnet().args(arguments).output().unwrap();
    if output.status.success() {
        return Ok(());
    }
    let message = refused(&output);
    assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
    Err(message)
}

#[test]
fn a_running_station_refuses_slots_of_its_own_that_clash() {
    network("a_running_station_refuses_slots_of_its_own_that_clash", || {
        let medium = Medium::new();
        let name = format!("clash-{}", std::process::id());
        let options =
            ["--interface", "rt0", "--master", "--cycle", "5ms", "--slot", "0=200us", "--name", &name];
        let master = Station::start(&medium.a, &options);
        master.wait_for("master_active");
        let set = |slot: &str| asked(&["slot", "-S", &name, "set", slot]);
        for (slot, expected) in [
            (
                "2=205us",
                "slot 0 and slot 2 overlap: 200us + frame 12.304us = 212.304us, but slot 2 begins at 205us",
            ),
            ("0=20us", "slot 0 begins at 20us, inside the sync window of 50us; let it begin"),
            (
                "2=4990us",
                "slot 2 ends after the cycle: 4.99ms + frame 12.304us = 5.002304ms, the cycle is 5ms",
            ),
        ] {
            let message = set(slot).unwrap_err();
            assert!(message.contains(expected) && message.contains("knows only its own slots"), "{message}");
        }
        // What was set a moment ago is known, and what was refused is not there.
        set("2=2ms,phase=1/2").unwrap();
        set("3=2ms,phase=2/2").unwrap();
        assert!(set("4=2ms,phase=1/4").unwrap_err().contains("slot 2 and slot 4 overlap"));
        asked(&["slot", "-S", &name, "remove", "2"]).unwrap();
        set("4=2ms,phase=1/4").unwrap();
        let message = asked(&["tdma", "-S", &name, "master", "--cycle", "2ms"]).unwrap_err();
        assert!(
            message.contains("ends after the cycle") && message.contains("the cycle is 2ms"),
            "{message}"
        );
        let done = rtnet().args(["slot", "-S", &name, "set", "4=3ms"]).output().unwrap();
        let done = String::from_utf8(done.stdout).unwrap();
        assert!(done.contains("other stations' slots it does not know"), "{done}");
        assert_eq!(status(&name)["slots"].as_array().unwrap().last().unwrap()["period"], 4, "as it was");
    });
}

#[test]
fn who_is_to_be_master_beside_another_is_told_and_master_once_that_is_gone() {
    network("who_is_to_be_master_beside_another_is_told_and_master_once_that_is_gone", || {
        let medium = Medium::new();
        let (first, second) =
            (Station::master(&medium, "first-master"), Station::slave(&medium, "second-master"));
        let ask = ["tdma", "-S", "second-master", "master", "--cycle", "5ms"];
        let output = rtnet().args(ask).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        let message = refused(&output);
        assert!(message.contains("makes way for another master (02:00:00:00:00:0a)"), "{message}");
        assert!(message.contains("`rtnet tdma -S second-master slave`"), "the remedy: {message}");
        first.end();
        let output = rtnet().args(ask).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        let done = String::from_utf8(output.stdout).unwrap();
        assert!(done.contains("second-master: master of a cycle of 5ms, from cycle "), "{done}");
        let master = status("second-master");
        assert_eq!((&master["role"], &master["standing"]["state"]), (&"master".into(), &"locked".into()));
        drop(second);
    });
}

#[test]
fn a_name_is_taken_once() {
    network("a_name_is_taken_once", || {
        let medium = Medium::new();
        let options = ["--interface", "rt0", "--slave", "--rounds", "0", "--name", "taken-once"];
        let mut first = Station::start(&medium.a, &options);
        first.wait_for("Ctrl-C ends it");
        let mut second = rtnet();
        second.arg("station").args(options);
        let message = refused(&output_in(&medium.b, second));
        let taken = format!("the name 'taken-once' is taken by process {}", first.child.id());
        assert!(message.contains(&taken), "{message}");
        // A name goes with its process, however that ends.
        first.kill();
        let third = Station::start(&medium.b, &options);
        third.wait_for("Ctrl-C ends it");
    });
}

#[test]
fn a_slave_whose_carrier_is_lost_and_back_follows_again() {
    network("a_slave_whose_carrier_is_lost_and_back_follows_again", || {
        let medium = Medium::new();
        let (_master, slave) =
            (Station::master(&medium, "carrier-master"), Station::slave(&medium, "carrier-slave"));
        medium.set_port("port1", false);
        let cut = wait_until("it is cut off", "carrier-slave", is("no carrier", "lost"));
        assert_eq!(
            (&cut["counters"]["carrier_lost"], &cut["standing"]["link"]),
            (&1.into(), &"no carrier".into())
        );
        slave.wait_for("carrier-slave: the interface 'rt0' has no carrier: look at the cable");
        let words = rtnet().args(["tdma", "-S", "carrier-slave", "status"]).output().unwrap();
        let words = String::from_utf8(words.stdout).unwrap();
        assert!(words.contains(", no carrier), process") && words.contains("carrier_lost 1"), "{words}");

        medium.set_port("port1", true);
        let back = wait_until("it follows again", "carrier-slave", is("up", "locked"));
        assert_eq!((&back["pid"], &back["counters"]["carrier_lost"]), (&cut["pid"], &1.into()));
        slave.wait_for("the interface 'rt0' has its carrier again");
        let master = status("carrier-master");
        assert_eq!((&master["link"], &master["counters"]["carrier_lost"]), (&"up".into(), &0.into()));
    });
}

#[test]
fn a_master_whose_interface_is_down_for_a_while_goes_on_without_a_flood_of_lines() {
    network("a_master_whose_interface_is_down_for_a_while_goes_on_without_a_flood_of_lines", || {
        let medium = Medium::new();
        let (master, _slave) =
            (Station::master(&medium, "down-master"), Station::slave(&medium, "down-slave"));
        set(&medium.a, "rt0", false);
        wait_until("its slave has lost it", "down-slave", is("up", "lost"));
        let failed = |status: &Value| status["counters"]["send_failed"].as_u64().unwrap_or(0);
        let down =
            wait_until("syncs fail", "down-master", |master| master["link"] == "down" && failed(master) > 50);
        set(&medium.a, "rt0", true);
        wait_until("its slave follows again", "down-slave", is("up", "locked"));
        let up = wait_until("it sends again", "down-master", |master| {
            master["counters"]["syncs_sent"].as_u64() > down["counters"]["syncs_sent"].as_u64()
        });
        assert_eq!(
            (&up["link"], &up["pid"], &up["counters"]["carrier_lost"]),
            (&"up".into(), &down["pid"], &1.into())
        );
        master.wait_for("send_failed: Network is down");
        let mut lines = Vec::new();
        while !lines.last().is_some_and(|line: &String| line.contains("send_failed: the last of")) {
            lines.push(master.wait_for(""));
        }
        assert!(
            lines.iter().any(|line| line.contains("'rt0' is down: bring it up with `ip link set rt0 up`"))
        );
        assert!(lines.iter().any(|line| line.contains("has its carrier again")), "{lines:?}");
        let failures = lines.iter().filter(|line| line.contains("send_failed")).count();
        assert_eq!(failures, 1, "{lines:?}");
    });
}

#[test]
fn a_slave_whose_interface_is_renamed_goes_on_under_the_new_name() {
    network("a_slave_whose_interface_is_renamed_goes_on_under_the_new_name", || {
        let medium = Medium::new();
        let (_master, slave) =
            (Station::master(&medium, "renamed-master"), Station::slave(&medium, "renamed-slave"));
        let mut netlink = medium.b.netlink().unwrap();
        let index = netlink.link_index("rt0").unwrap();
        netlink.set_down(index).unwrap();
        netlink.rename(index, "rt9").unwrap();
        netlink.set_up(index).unwrap();
        slave.wait_for("renamed-slave: the interface 'rt0' is called 'rt9' now");
        let renamed = wait_until("it follows again", "renamed-slave", is("up", "locked"));
        assert_eq!((&renamed["interface"], &renamed["counters"]["renamed"]), (&"rt9".into(), &1.into()));
    });
}

#[test]
fn a_station_whose_interface_is_gone_ends_with_a_clear_line_and_the_others_go_on() {
    network("a_station_whose_interface_is_gone_ends_with_a_clear_line_and_the_others_go_on", || {
        let elsewhere = Namespace::new().unwrap();
        let removed = |medium: &mut Medium| medium.segment.detach("port1").unwrap();
        let move_rt0 = |from: &Namespace, to: &Namespace| {
            let mut netlink = from.netlink().unwrap();
            let index = netlink.link_index("rt0").unwrap();
            netlink.move_to(index, to.fd()).unwrap();
        };
        let moved = |medium: &mut Medium| move_rt0(&medium.b, &elsewhere);
        // It is there, by the same name and index, and yet not what the station's sockets were bound to.
        let back = |medium: &mut Medium| {
            let elsewhere = Namespace::new().unwrap();
            move_rt0(&medium.b, &elsewhere);
            move_rt0(&elsewhere, &medium.b);
        };
        let ways: [&dyn Fn(&mut Medium); 3] = [&removed, &moved, &back];
        for away in ways {
            let mut medium = Medium::new();
            let (_master, mut slave) =
                (Station::master(&medium, "gone-master"), Station::slave(&medium, "gone-slave"));
            away(&mut medium);
            assert_eq!(slave.ended().and_then(|status| status.code()), Some(1));
            let line = slave.wait_for("rtnet: ");
            assert!(
                line.contains("the interface 'rt0' is gone: it was removed, or moved to another"),
                "{line}"
            );
            assert!(line.contains("start the station again"), "the remedy: {line}");
            let syncs = |master: &Value| master["counters"]["syncs_sent"].as_u64();
            let before = status("gone-master");
            assert_eq!((&before["link"], &before["standing"]["state"]), (&"up".into(), &"locked".into()));
            wait_until("the master goes on", "gone-master", |master| syncs(master) > syncs(&before));
        }
    });
}

#[test]
fn a_lab_is_told_when_its_stations_carrier_is_lost_and_back_and_when_it_cannot_go_on() {
    network("a_lab_is_told_when_its_stations_carrier_is_lost_and_back_and_when_it_cannot_go_on", || {
        let mut medium = Medium::new();
        let lab = LabOptions {
            station: 0,
            name: "told".into(),
            control: None,
            anchor: 0,
            offset_ns: 0,
            drift_ppb: 0,
            epoch: 0,
            destination: B,
            from: 1,
            payload: 46,
            from_payload: 46,
            step_limit_ns: 100_000,
            resume: None,
            first: 0,
        };
        let lab = serde_json::to_string(&lab).unwrap();
        let mut station =
            Station::start(&medium.a, &["--interface", "rt0", "--master", "--cycle", "5ms", "--lab", &lab]);
        let report = |station: &Station, of: &str| -> Report {
            serde_json::from_str(&station.wait_for(&format!("{{\"{of}\":"))).unwrap()
        };
        let Report::Standing(standing) = report(&station, "standing") else { panic!("asked for by name") };
        assert_eq!(standing.link, "up");
        let mut last = 0;
        for up in [false, true] {
            medium.set_port("port0", up);
            let Report::Link { at, carrier } = report(&station, "link") else { panic!("asked for by name") };
            assert_eq!(carrier, up);
            assert!(last < at && at < monotonic(), "seen to be otherwise at {last} and {at}");
            last = at;
        }
        medium.segment.detach("port0").unwrap();
        let Report::Failed(why) = report(&station, "failed") else { panic!("asked for by name") };
        assert!(why.contains("'rt0' is gone"), "{why}");
        assert_eq!(station.ended().and_then(|status| status.code()), Some(1));
    });
}
