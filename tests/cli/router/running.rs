//! A router that runs as long as a test needs it.

use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::Duration;

use serde_json::Value;

use crate::cell::{json, wait_until};
use crate::host::unique;
use crate::rtnet;
use crate::station::PATIENCE;

/// The begin of the line of a router on a kernel without landlock.
pub const NO_LANDLOCK: &str = "rtnet: landlock: ";

/// A router on a port of its own; killed when dropped.
pub struct Router {
    pub name: String,
    pub child: Child,
    pub at: SocketAddr,
    /// Its other addresses.
    pub also: Vec<SocketAddr>,
    /// Where its figures are, if it has any.
    pub figures: Option<SocketAddr>,
    /// Whether the kernel keeps it from files and ports that it does not need.
    pub is_confined: bool,
    /// Lines of its standard error.
    pub said: Receiver<String>,
}

impl Router {
    pub fn start(what: &str, arguments: &[&str]) -> Self {
        Self::start_by(rtnet(), what, arguments)
    }

    /// By a command that ends with the program.
    pub fn start_by(mut command: Command, what: &str, arguments: &[&str]) -> Self {
        let name = unique(what);
        command.args(["router", "--name", &name]).args(arguments).stderr(Stdio::piped());
        if arguments.is_empty() {
            command.args(["--listen", "127.0.0.1:0"]);
        }
        let mut child = command.spawn().unwrap();
        let said = lines(child.stderr.take().unwrap());
        let at = SocketAddr::from(([0, 0, 0, 0], 0));
        let mut router = Self { name, child, at, also: Vec::new(), figures: None, is_confined: true, said };
        router.begun();
        router
    }

    /// Reads its first lines: where its figures are, if anywhere, and where it listens.
    fn begun(&mut self) {
        while let Ok(line) = self.said.recv_timeout(PATIENCE) {
            if let Some((_, all)) = line.rsplit_once("listens at ") {
                self.also = all.split(", ").map(|at| at.parse().unwrap()).collect();
                self.at = self.also.remove(0);
                return;
            }
            if line.starts_with(NO_LANDLOCK) {
                self.is_confined = false;
                continue;
            }
            let at = line.rsplit_once("http://").and_then(|(_, at)| at.strip_suffix("/metrics"));
            self.figures = Some(at.unwrap_or_else(|| panic!("{line}")).parse().unwrap());
        }
        panic!("it says nothing of where it listens");
    }

    /// Waits until it says something.
    pub fn wait_for(&self, words: &str) {
        while !self
            .said
            .recv_timeout(PATIENCE)
            .unwrap_or_else(|_| panic!("it never says '{words}'"))
            .contains(words)
        {}
    }

    pub fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.at).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        stream
    }

    pub fn status(&self) -> Value {
        json(rtnet().args(["router", "status", &self.name, "--json"]))
    }

    pub fn clients(&self) -> usize {
        self.status()["clients"].as_array().unwrap().len()
    }
}

/// Waits until a station has joined its router.
pub fn has_joined(station: &str) {
    wait_until("it has joined its router", || {
        let shown = rtnet().args(["stat", "-S", station, "--json"]).output().unwrap().stdout;
        serde_json::from_slice(&shown).is_ok_and(|shown: Value| shown["tcp"]["connected"] == true)
    });
}

/// The lines of a program's output, as they come.
fn lines(output: ChildStderr) -> Receiver<String> {
    let (to, lines) = channel();
    thread::spawn(move || {
        // A test that has ended waits for no more of them.
        BufReader::new(output).lines().map_while(Result::ok).all(|line| to.send(line).is_ok());
    });
    lines
}

impl Drop for Router {
    fn drop(&mut self) {
        // Gone already where a test has ended it.
        let _ = self.child.kill();
        let _ = self.child.wait();
        forget(&self.name);
    }
}

/// Removes the socket and the lock of a router that was killed: the next of its name, which would take them over, never comes here.
pub fn forget(name: &str) {
    for end in ["", ".lock"] {
        // One that has ended by itself has removed them.
        let _ = std::fs::remove_file(format!("/run/rtnet/.router-{name}{end}"));
    }
}
