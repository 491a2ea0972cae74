//! `rtnet station`: what it refuses, two of them on one medium, and what becomes of them when that fails.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use tools::lab::namespace::{Namespace, Segment};

use crate::host::{shared, unique};
use crate::program::copy_program;
use crate::rtnet;

const A: [u8; 6] = [2, 0, 0, 0, 0, 0xa];
pub const B: [u8; 6] = [2, 0, 0, 0, 0, 0xb];
/// Long enough for a loaded machine, and never waited for in full when all is well.
pub const PATIENCE: Duration = Duration::from_secs(20);

/// Two namespaces on one segment, with the interface `rt0` each.
pub struct Medium {
    pub a: Namespace,
    pub b: Namespace,
    pub segment: Segment,
}

impl Medium {
    pub fn new() -> Self {
        Self::of("rt0")
    }

    /// With interfaces of this name.
    pub fn of(interface: &str) -> Self {
        let (a, b) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&a, "port0", interface, A).unwrap();
        segment.attach(&b, "port1", interface, B).unwrap();
        Self { a, b, segment }
    }

    /// Cuts the wire at a port, or joins it again.
    pub fn set_port(&self, port: &str, up: bool) {
        set(self.segment.namespace(), port, up);
    }
}

/// Sets an interface up or down.
pub fn set(namespace: &Namespace, interface: &str, up: bool) {
    let mut netlink = namespace.netlink().unwrap();
    let index = netlink.link_index(interface).unwrap();
    if up { netlink.set_up(index).unwrap() } else { netlink.set_down(index).unwrap() }
}

/// A station in the foreground; told to end, or killed, when the test is done with it.
pub struct Station {
    pub child: Child,
    /// What it says, on whichever output.
    lines: Receiver<String>,
}

impl Station {
    pub fn start(namespace: &Namespace, arguments: &[&str]) -> Self {
        let mut command = rtnet();
        command.arg("station").args(arguments);
        Self::run_after(namespace, command, || ())
    }

    /// As this command starts it, from a thread that does `first` before.
    pub fn run_after(namespace: &Namespace, mut command: Command, first: impl FnOnce() + Send) -> Self {
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let spawn = move || {
            first();
            command.spawn()
        };
        Self::of(namespace.run(spawn).unwrap().unwrap())
    }

    /// A station of a lab, which this thread stands for: the kernel kills the station when the thread that has started it ends.
    pub fn of_lab(namespace: &Namespace, arguments: &[&str]) -> Self {
        let station = rtnet();
        let mut command = Command::new("nsenter");
        command.arg(format!("--net={}", namespace.path().display())).arg(station.get_program());
        command.arg("station").args(arguments);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        Self::of(child.unwrap())
    }

    fn of(mut child: Child) -> Self {
        let (told, lines) = channel();
        pass_on(child.stdout.take().unwrap(), told.clone());
        pass_on(child.stderr.take().unwrap(), told);
        Self { child, lines }
    }

    /// A master of a cycle of 5 ms in `a`.
    pub fn master(medium: &Medium, name: &str) -> Self {
        // A core that was idle for a cycle is late more often than the usual window of 50 us bears: one sync in ten was
        // skipped, and two in a row are a loss of sync.
        let room = ["--sync-window", "800us", "--name", name];
        let role = ["--interface", "rt0", "--master", "--cycle", "5ms"];
        let master = Self::start(&medium.a, &[&role[..], &room].concat());
        master.wait_for("master_active");
        master
    }

    /// A slave of it in `b`, locked.
    pub fn slave(medium: &Medium, name: &str) -> Self {
        let role = ["--interface", "rt0", "--slave", "--rounds", "10", "--slot", "0=1ms", "--name", name];
        let slave = Self::start(&medium.b, &role);
        slave.wait_for("locked, cycle");
        slave
    }

    /// A slave in a namespace where no master is.
    pub fn slave_of_nobody(namespace: &Namespace, name: &str) -> Self {
        let slave =
            Self::start(namespace, &["--interface", "rt0", "--slave", "--slot", "0=1ms", "--name", name]);
        slave.wait_for("Ctrl-C ends it");
        slave
    }

    /// Waits for its end: its exit status.
    pub fn ended(&mut self) -> Option<ExitStatus> {
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
    pub fn wait_for(&self, text: &str) -> String {
        self.lines_until(text).pop().unwrap()
    }

    /// Reads until a line that holds `text`, which is the last.
    pub fn lines_until(&self, text: &str) -> Vec<String> {
        let deadline = Instant::now() + PATIENCE;
        let mut lines = Vec::new();
        while !lines.last().is_some_and(|line: &String| line.contains(text)) {
            let patience = deadline.saturating_duration_since(Instant::now());
            let line = self.lines.recv_timeout(patience);
            lines.push(line.unwrap_or_else(|_| panic!("no line with '{text}': {lines:?}")));
        }
        lines
    }

    /// Tells it to end, as Ctrl-C does; its exit status.
    pub fn end(mut self) -> Option<i32> {
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

pub fn status(name: &str) -> Value {
    let output = rtnet().args(["tdma", "-S", name, "status", "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    crate::schema::read(&output.stdout)
}

/// The first status of a station of which this holds.
pub fn wait_until(what: &str, name: &str, holds: impl Fn(&Value) -> bool) -> Value {
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

pub fn is(link: &'static str, state: &'static str) -> impl Fn(&Value) -> bool {
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
    shared("without_privileges_one_line_says_what_to_do", || {
        // The binary's folder need not be open to others.
        let dir = tempfile::tempdir().unwrap();
        let binary = dir.path().join("rtnet");
        copy_program(env!("CARGO_BIN_EXE_rtnet"), &binary);
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
    shared("a_slave_joins_a_master_and_notices_its_end", || {
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
    shared("a_second_master_refuses_to_start_and_names_the_first", || {
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
pub fn asked(arguments: &[&str]) -> Result<(), String> {
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
    shared("a_running_station_refuses_slots_of_its_own_that_clash", || {
        let medium = Medium::new();
        let name = unique("clash");
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
        let remove = |id: &str| asked(&["slot", "-S", &name, "remove", id]);
        set("5=3ms,phase=1/2,joint=3").unwrap();
        assert!(remove("3").unwrap_err().contains("slot 5 is joined to slot 3"));
        assert!(set("3=2ms,joint=5").unwrap_err().contains("slot 3 cannot be joined to slot 5"));
        set("3=2ms,phase=2/2,size=100").unwrap();
        wait_until("slot 5 follows", &name, |status| {
            let five = status["slots"].as_array().unwrap().last().unwrap();
            (&five["size"], &five["joint"], &five["period"]) == (&100.into(), &3.into(), &2.into())
        });
        remove("5").unwrap();
        assert!(remove("1").unwrap_err().contains("slot 1 is another name of slot 0"));
        remove("2").unwrap();
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
    shared("who_is_to_be_master_beside_another_is_told_and_master_once_that_is_gone", || {
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
    shared("a_name_is_taken_once", || {
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
        assert_eq!(third.end(), Some(0));
        let left = std::fs::read_dir("/run/rtnet").unwrap().flatten();
        let left: Vec<_> =
            left.filter(|file| file.file_name().to_string_lossy().contains("taken-once")).collect();
        assert!(left.is_empty(), "{left:?}");
    });
}

#[test]
fn a_station_without_a_name_has_its_interfaces_unless_that_is_taken() {
    shared("a_station_without_a_name_has_its_interfaces_unless_that_is_taken", || {
        let interface = format!("n{}", std::process::id());
        let medium = Medium::of(&interface);
        let options = ["--interface", &interface, "--slave", "--rounds", "0"];
        let first = Station::start(&medium.a, &options);
        first.wait_for("Ctrl-C ends it");
        let pid = first.child.id();
        let it = wait_until("it has looked around", &interface, |status| status["link"] == "up");
        assert_eq!((&it["name"], &it["pid"]), (&interface.as_str().into(), &pid.into()));
        let second = Station::start(&medium.b, &options);
        let line = second.wait_for("nothing can be asked of this station, nor changed: ");
        assert!(line.contains(&format!("the name '{interface}' is taken by process {pid}: ")), "{line}");
        assert!(line.contains("choose another --name"), "the remedy: {line}");
        assert_eq!(second.end(), Some(0), "it ran all the same");
    });
}
