//! The examples of `rtnet`, beside a lab whose stations have addresses.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::cell::Cell;
use crate::host::network;
use crate::rtnet;
use crate::station::PATIENCE;

const LAB: &str = include_str!("addresses.toml");
const LEG: &str = "10.0.0.7";
const EXAMPLES: [&str; 5] = ["udp_echo", "rtt", "raw_packets", "wait_on_cycle", "big_datagrams"];

/// The directory of the examples. `cargo test --workspace` has built them; a single test binary has not.
fn built() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let profile = test.parent().and_then(Path::parent).expect("PROFILE/deps/TEST");
    let as_tested = if profile.ends_with("release") { "release" } else { "test" };
    let mut build = Command::new(env!("CARGO"));
    build
        .args(["build", "--quiet", "--workspace", "--examples", "--profile", as_tested, "--target-dir"])
        .arg(profile.parent().unwrap());
    assert!(build.current_dir(env!("CARGO_MANIFEST_DIR")).status().unwrap().success());
    profile.join("examples")
}

/// One that runs, killed when dropped; what it says on either output is in a file.
struct Example {
    name: String,
    child: Child,
    said: PathBuf,
    _dir: tempfile::TempDir,
}

impl Example {
    fn start(built: &Path, name: &str, arguments: &[&str]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let said = dir.path().join("said");
        let file = File::create(&said).unwrap();
        let mut command = Command::new(built.join(name));
        command.args(arguments).stdin(Stdio::null()).stdout(file.try_clone().unwrap()).stderr(file);
        Self { name: name.to_owned(), child: command.spawn().unwrap(), said, _dir: dir }
    }

    fn said(&self) -> String {
        std::fs::read_to_string(&self.said).unwrap()
    }

    fn wait_for(&self, text: &str) {
        let deadline = Instant::now() + PATIENCE;
        while !self.said().contains(text) {
            assert!(Instant::now() < deadline, "{} says nothing of '{text}': {}", self.name, self.said());
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Its exit status, and all that it has said.
    fn ended(mut self) -> (Option<i32>, String) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return (status.code(), self.said());
            }
            assert!(Instant::now() < deadline, "{} does not end: {}", self.name, self.said());
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Example {
    fn drop(&mut self) {
        // Ended already, where all went well.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn to_leg(port: u16) -> String {
    format!("{LEG}:{port}")
}

#[test]
fn the_examples_work_beside_a_lab_and_end_when_their_station_is_killed() {
    let test = "the_examples_work_beside_a_lab_and_end_when_their_station_is_killed";
    network(test, || {
        let built = built();
        let cell = Cell::with("examples", |_| LAB.to_owned());
        let (arm, leg) = (cell.place("arm"), cell.place("leg"));
        let start = |name, arguments: &[&str]| Example::start(&built, name, arguments);

        let echo = start("udp_echo", &[&leg]);
        echo.wait_for("echoes what comes to port 36000");
        let (status, said) = start("rtt", &[&arm, &to_leg(36_000), "50"]).ended();
        assert_eq!(status, Some(0), "{said}");
        assert!(said.starts_with("50 round trips, ") && said.contains("lost: min "), "{said}");
        let whole = start("big_datagrams", &[&leg]);
        let big = start("big_datagrams", &[&arm, &to_leg(37_000)]);
        whole.wait_for("65507 bytes, as they were sent");
        let heard = start("raw_packets", &[&leg]);
        let raw = start("raw_packets", &[&arm, "ff:ff:ff:ff:ff:ff"]);
        heard.wait_for("02:00:00:00:00:02 says: number ");
        let (status, said) = start("wait_on_cycle", &[&arm, "100"]).ended();
        assert_eq!((status, said.matches(" ns of global time, woken ").count()), (Some(0), 10), "{said}");

        // Who waits for a cycle that does not come is told, too.
        let of_leg = [echo, whole, heard];
        let rtt = start("rtt", &[&arm, &to_leg(36_001), "1000000"]);
        let output = rtnet().args(["tdma", "-S", &arm, "detach"]).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let waits = start("wait_on_cycle", &[&arm]);
        std::thread::sleep(Duration::from_millis(200));
        for station in ["arm", "leg"] {
            let pid = cell.station(station)["pid"].as_i64().unwrap() as i32;
            kill(Pid::from_raw(pid), Signal::SIGKILL).unwrap();
        }
        for (examples, place) in [(Vec::from(of_leg), &leg), (vec![rtt, big, raw, waits], &arm)] {
            for example in examples {
                let name = example.name.clone();
                let (status, said) = example.ended();
                let last = said.lines().last().unwrap_or_default();
                assert_eq!(status, Some(1), "{name}: {said}");
                assert!(last.contains(&format!("station '{place}'")), "{name}: {said}");
                assert!(last.contains("has ended") && last.contains("start it"), "{name}: {said}");
            }
        }
    });
}

#[test]
fn the_examples_say_what_is_wrong_with_their_station_and_their_arguments() {
    let built = built();
    let ended = |name, arguments: &[&str]| Example::start(&built, name, arguments).ended();
    for name in EXAMPLES {
        let (status, said) = ended(name, &[]);
        assert_eq!((status, said.starts_with(&format!("usage: {name} STATION"))), (Some(1), true), "{said}");
        let to = if name == "rtt" { "10.0.0.1:7" } else { "7" };
        let arguments = if matches!(name, "udp_echo" | "rtt") {
            &["nosuch/station", to][..]
        } else {
            &["nosuch/station"]
        };
        let (status, said) = ended(name, arguments);
        let why = "station 'nosuch/station' does not run, or has ended (ENODEV): start it";
        assert_eq!((status, said.contains(why)), (Some(1), true), "{name}: {said}");
    }
    for (name, arguments, why) in [
        ("udp_echo", &["x", "port"][..], "'port' is no PORT"),
        ("rtt", &["x", "10.0.0.1"], "'10.0.0.1' is no ADDRESS:PORT, as 10.0.0.2:36000"),
        ("rtt", &["x", "10.0.0.1:7", "0"], "'0' is no COUNT"),
        ("wait_on_cycle", &["x", "soon"], "'soon' is no OFFSET_US"),
    ] {
        let (status, said) = ended(name, arguments);
        assert_eq!((status, said.contains(why)), (Some(1), true), "{name}: {said}");
    }
}
