//! `rtnet station`: what it refuses, and two of them on one medium.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tools::lab::namespace::{Namespace, Segment};

use crate::{as_root, rtnet};

const A: [u8; 6] = [2, 0, 0, 0, 0, 0xa];
const B: [u8; 6] = [2, 0, 0, 0, 0, 0xb];
/// Long enough for a loaded machine, and never waited for in full when all is well.
const PATIENCE: Duration = Duration::from_secs(20);

/// Two namespaces on one segment, with the interface `rt0` each.
struct Medium {
    a: Namespace,
    b: Namespace,
    _segment: Segment,
}

impl Medium {
    fn new() -> Self {
        let (a, b) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&a, "port0", "rt0", A).unwrap();
        segment.attach(&b, "port1", "rt0", B).unwrap();
        Self { a, b, _segment: segment }
    }
}

/// A station in the foreground; killed when the test is done with it.
struct Station {
    child: Child,
    lines: Receiver<String>,
}

impl Station {
    fn start(namespace: &Namespace, arguments: &[&str]) -> Self {
        let mut command = rtnet();
        command.arg("station").args(arguments).stdout(Stdio::piped()).stderr(Stdio::inherit());
        let mut child = namespace.run(move || command.spawn()).unwrap().unwrap();
        let (told, lines) = channel();
        let output = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || output.lines().map_while(Result::ok).try_for_each(|line| told.send(line)));
        Self { child, lines }
    }

    /// Reads until a line that holds `text`.
    fn wait_for(&self, text: &str) -> String {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no line with '{text}'"));
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
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
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
    if !as_root("without_privileges_one_line_says_what_to_do") {
        return;
    }
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
}

#[test]
fn a_slave_joins_a_master_and_notices_its_end() {
    if !as_root("a_slave_joins_a_master_and_notices_its_end") {
        return;
    }
    let medium = Medium::new();
    let cycle = ["--interface", "rt0", "--master", "--cycle", "5ms", "--name", "join-master"];
    let master = Station::start(&medium.a, &cycle);
    master.wait_for("master_active");
    let slave = Station::start(
        &medium.b,
        &["--interface", "rt0", "--slave", "--rounds", "10", "--slot", "0=1ms", "--name", "join-slave"],
    );
    let locked = slave.wait_for("locked, cycle");
    assert!(locked.contains("of 5ms"), "{locked}");
    drop(master);
    slave.wait_for("sync_lost");
    assert_eq!(slave.end(), Some(0), "told to end");
}

#[test]
fn a_second_master_refuses_to_start_and_names_the_first() {
    if !as_root("a_second_master_refuses_to_start_and_names_the_first") {
        return;
    }
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
    if !as_root("a_running_station_refuses_slots_of_its_own_that_clash") {
        return;
    }
    let medium = Medium::new();
    let name = format!("clash-{}", std::process::id());
    let options = ["--interface", "rt0", "--master", "--cycle", "5ms", "--slot", "0=200us", "--name", &name];
    let master = Station::start(&medium.a, &options);
    master.wait_for("master_active");
    let set = |slot: &str| asked(&["slot", "-S", &name, "set", slot]);
    for (slot, expected) in [
        (
            "2=205us",
            "slot 0 and slot 2 overlap: 200us + frame 12.304us = 212.304us, but slot 2 begins at 205us",
        ),
        ("0=20us", "slot 0 begins at 20us, inside the sync window of 50us; let it begin"),
        ("2=4990us", "slot 2 ends after the cycle: 4.99ms + frame 12.304us = 5.002304ms, the cycle is 5ms"),
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
    assert!(message.contains("ends after the cycle") && message.contains("the cycle is 2ms"), "{message}");
}

#[test]
fn a_name_is_taken_once() {
    if !as_root("a_name_is_taken_once") {
        return;
    }
    let medium = Medium::new();
    let options = ["--interface", "rt0", "--slave", "--rounds", "0", "--name", "taken-once"];
    let first = Station::start(&medium.a, &options);
    first.wait_for("Ctrl-C ends it");
    let mut second = rtnet();
    second.arg("station").args(options);
    let message = refused(&output_in(&medium.b, second));
    let taken = format!("the name 'taken-once' is taken by process {}", first.child.id());
    assert!(message.contains(&taken), "{message}");
    // A name goes with its process, however that ends.
    drop(first);
    let third = Station::start(&medium.b, &options);
    third.wait_for("Ctrl-C ends it");
}
