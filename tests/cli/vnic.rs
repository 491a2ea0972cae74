//! VNICs: what Linux does through the tunnel, what becomes of their devices, and that real-time never notices.

mod alone;
mod behind;
mod device;
mod flood;
mod held_back;
mod options;
mod packets;
mod proxied;
mod replayed;
mod seen;
mod transfers;

use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rtnet::wire::ethernet::EtherType;
use serde_json::Value;

use crate::cell::{Cell, text, wait_until};
use crate::host::{again, skip};
use crate::rtnet;

/// Four stations with a slot 1 for the tunnel in each cycle.
const TUNNEL: &str = include_str!("vnic/tunnel.toml");
/// Its cycles.
const CYCLES_A_SECOND: u64 = 250;
/// What goes through the devices of a lab: Ethernet frames, or packets of IP.
const MODES: [&str; 2] = ["tap", "tun"];
/// The largest inner payload.
const MTU: usize = 1_496;
/// ETH_P_ALL: a socket hears every frame.
const EVERY: EtherType = EtherType(3);
/// Longer than anything takes but a large transfer.
const PATIENCE: Duration = Duration::from_secs(60);

/// Attempts of 2 s each: together as long as a busy kernel may take to end a station.
const ASKED_AT_MOST: u32 = 15;

/// A lab of `file` in this mode.
fn lab(what: &str, file: &str, mode: &str) -> Cell {
    let file = file.replacen("cycle = ", &format!("vnic_mode = \"{mode}\"\ncycle = "), 1);
    Cell::with(&format!("{what}-{mode}"), |_| file)
}

/// A network whose tunnels are tried by ping, as nearly all of these are: its slots are as far apart as on a shared core.
fn shared(test: &str, body: impl Fn()) {
    if are_there(test, &[("ping", "iputils-ping")]) {
        crate::host::shared(test, body);
    }
}

/// The same where they are nearer.
fn network(test: &str, body: impl Fn()) {
    if are_there(test, &[("ping", "iputils-ping")]) {
        crate::host::network(test, body);
    }
}

/// The same where programs flood or fill the tunnel: they have other cores than the lab's.
fn alone(test: &str, body: impl Fn()) {
    if are_there(test, &[("ping", "iputils-ping")]) {
        crate::host::alone(test, body);
    }
}

/// A program in a station's namespace: its process is the program's.
fn program(cell: &Cell, station: &str, words: &[&str]) -> Command {
    let mut command = rtnet();
    command.args(["lab", "exec", &cell.place(station), "--"]).args(words);
    command
}

/// What a program in a station's namespace says, once it has ended well.
fn said(cell: &Cell, station: &str, words: &[&str]) -> String {
    let output = program(cell, station, words).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{words:?}: {}{}", text(&output.stdout), text(&output.stderr));
    text(&output.stdout)
}

/// `rtnet vnic` of a lab's station.
fn vnic(cell: &Cell, station: &str, arguments: &[&str]) -> Output {
    vnic_of(&cell.place(station), arguments)
}

/// A kernel that is busy with the devices of other tests may take longer than a control thread waits. The request is
/// repeated then, as the refusal advises, and a line says so.
fn vnic_of(station: &str, arguments: &[&str]) -> Output {
    let ask = || rtnet().args(["vnic", "-S", station]).args(arguments).output().unwrap();
    for _ in 1..ASKED_AT_MOST {
        let output = ask();
        if !text(&output.stderr).contains("has not answered within 2s: ask how it is, and again") {
            return output;
        }
        again("request_to_a_vnic", &format!("{arguments:?} of {station} was not answered within 2s"));
    }
    ask()
}

/// As its station shows it.
fn status(cell: &Cell, station: &str) -> Value {
    status_of(&cell.place(station))
}

fn status_of(station: &str) -> Value {
    crate::schema::read(done(vnic_of(station, &["status", "--json"])))
}

/// Does what is asked, or the test fails.
#[track_caller]
fn done(output: Output) -> String {
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    text(&output.stdout)
}

/// What is said in one line where something is refused.
#[track_caller]
fn refused(output: Output) -> String {
    let message = text(&output.stderr);
    assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
    message
}

fn answers(cell: &Cell, from: &str, ip: &str) -> bool {
    let output = program(cell, from, &["ping", "-c", "1", "-W", "1", ip]).output().unwrap();
    output.status.success()
}

/// Waits until it does: a host may be busy.
#[track_caller]
fn assert_answers(cell: &Cell, from: &str, ip: &str) {
    wait_until(&format!("{ip} answers {from}"), || answers(cell, from, ip));
}

/// Whether all these are installed; says aloud which are not.
pub fn are_there(test: &str, tools: &[(&str, &str)]) -> bool {
    let found = |tool: &str| {
        let paths = std::env::var_os("PATH").unwrap_or_default();
        std::env::split_paths(&paths).any(|path| path.join(tool).is_file())
    };
    let missing = tools.iter().find(|(tool, _)| !found(tool));
    missing.iter().for_each(|(tool, package)| skip(test, &format!("no {tool}: apt-get install {package}")));
    missing.is_none()
}

/// A program that runs until the test is done with it.
struct Running(Child);

impl Running {
    fn start(mut command: Command) -> Self {
        Self(command.spawn().unwrap())
    }

    /// A server in a station's namespace, once it listens at this port.
    fn server(cell: &Cell, station: &str, port: u16, mut command: Command) -> Self {
        command.stdin(Stdio::null()).stderr(Stdio::null());
        let server = Self::start(command);
        // State 0A is LISTEN.
        let listens = |line: &str| {
            let mut words = line.split_whitespace().skip(1);
            words.next().is_some_and(|local| local.ends_with(&format!(":{port:04X}")))
                && words.nth(1) == Some("0A")
        };
        wait_until(&format!("something listens at {port}"), || {
            let all = said(cell, station, &["cat", "/proc/net/tcp", "/proc/net/tcp6"]);
            all.lines().any(listens)
        });
        server
    }

    /// Waits for its end.
    #[track_caller]
    fn ended(&mut self, patience: Duration) {
        let deadline = Instant::now() + patience;
        loop {
            if let Some(status) = self.0.try_wait().unwrap() {
                return assert!(status.success(), "{status}");
            }
            assert!(Instant::now() < deadline, "it still runs");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Bytes that repeat nowhere, the same each time.
fn bytes(count: usize) -> Vec<u8> {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut all = Vec::with_capacity(count + 8);
    while all.len() < count {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        all.extend_from_slice(&state.to_le_bytes());
    }
    all.truncate(count);
    all
}
