//! `rtnet station`: what it refuses, and two of them on one medium.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

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
fn a_slave_joins_a_master_and_notices_its_end() {
    let Some(_alone) = as_root("a_slave_joins_a_master_and_notices_its_end") else { return };
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
}

#[test]
fn a_second_master_refuses_to_start_and_names_the_first() {
    let Some(_alone) = as_root("a_second_master_refuses_to_start_and_names_the_first") else { return };
    let medium = Medium::new();
    let master = Station::start(&medium.a, &["--interface", "rt0", "--master", "--cycle", "5ms"]);
    master.wait_for("master_active");
    let mut second = rtnet();
    second.args(["station", "--interface", "rt0", "--master", "--cycle", "5ms"]);
    let message = refused(&output_in(&medium.b, second));
    assert!(message.contains("another master (02:00:00:00:00:0a) is active on this medium"), "{message}");
    assert!(message.contains("--slave"), "the remedy: {message}");
}

#[test]
fn a_name_is_taken_once() {
    let Some(_alone) = as_root("a_name_is_taken_once") else { return };
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
