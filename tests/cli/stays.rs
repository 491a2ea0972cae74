//! A lab that stays is independent of its caller, and its stations are not of it.

use std::fs;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nix::fcntl::{Flock, FlockArg};
use nix::sys::signal::{SigSet, Signal, kill};
use nix::unistd::{Pid, getsid};
use serde_json::Value;

use crate::cell::{json, status, text};
use crate::host::{network, shared, stop, unique};
use crate::lab::{eventually, is_there, running, stations_of};
use crate::rtnet;

const NETWORK: [&str; 4] = ["--stations", "2", "--cycle", "10ms"];

/// A lab of two stations, which is taken down at the end of its test.
pub struct Pair {
    pub name: String,
}

impl Pair {
    pub fn up(what: &str) -> Self {
        Self::up_by(what, |name| {
            let mut command = rtnet();
            command.args(["lab", "up", "--name", name]).args(NETWORK);
            command
        })
    }

    /// By the command that is made for its name.
    pub fn up_by(what: &str, command: impl FnOnce(&str) -> Command) -> Self {
        let pair = Self { name: unique(what) };
        let output = command(&pair.name).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(text(&output.stdout).contains("is up: 2 stations"), "{}", text(&output.stdout));
        pair
    }

    pub fn keeper(&self) -> i32 {
        pid(&status(&self.name)["pid"])
    }

    pub fn stations(&self) -> Vec<i32> {
        status(&self.name)["stations"].as_array().unwrap().iter().map(|of| pid(&of["pid"])).collect()
    }

    /// Its keeper, and its stations.
    fn all(&self) -> Vec<i32> {
        [vec![self.keeper()], self.stations()].concat()
    }

    pub fn place(&self, station: &str) -> String {
        format!("{}/{station}", self.name)
    }

    pub fn exec(&self, arguments: &[&str]) -> Command {
        let mut command = rtnet();
        command.args(["lab", "exec", &self.place("slave1"), "--"]).args(arguments);
        command
    }

    pub fn directory(&self) -> PathBuf {
        Path::new("/run/rtnet").join(&self.name)
    }
}

impl Drop for Pair {
    fn drop(&mut self) {
        if self.directory().exists() {
            let _ = rtnet().args(["lab", "down", &self.name]).output();
        }
    }
}

fn pid(of: &Value) -> i32 {
    of.as_i64().unwrap() as i32
}

pub fn signal(pid: i32, signal: Signal) {
    kill(Pid::from_raw(pid), signal).unwrap();
}

fn link(pid: i32, file: &str) -> PathBuf {
    fs::read_link(format!("/proc/{pid}/{file}")).unwrap()
}

/// The files that its descriptors lead to.
fn descriptors(pid: i32) -> Vec<PathBuf> {
    let all = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().flatten();
    all.filter_map(|entry| fs::read_link(entry.path()).ok()).collect()
}

/// A line of what the kernel tells of it, as a number.
fn number(pid: i32, line: &str, radix: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let value = status.lines().find_map(|of| of.strip_prefix(line)).unwrap();
    u64::from_str_radix(value.trim(), radix).unwrap()
}

#[test]
fn lab_that_stays_holds_no_directory_of_its_caller() {
    shared("lab_that_stays_holds_no_directory_of_its_caller", || {
        let dir = tempfile::tempdir().unwrap();
        let below = dir.path().join("below");
        fs::create_dir(&below).unwrap();
        let scenario = "cycle = \"10ms\"\nnetwork = \"10.0.0.0/24\"\npackages = true\npackage_priorities = \"urgent.toml\"\n\
                        router = \"127.0.0.1:9\"\nrouter_keys = \"keys/client\"\n\
                        [[station]]\nname = \"master\"\nrole = \"master\"\n[[station]]\nname = \"slave1\"\nrole = \"slave\"\n";
        fs::write(below.join("net.toml"), scenario).unwrap();
        fs::write(below.join("urgent.toml"), "").unwrap();
        let made = rtnet().args(["router", "keys"]).arg(below.join("keys")).output().unwrap();
        assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
        let pair = Pair::up_by("held", |name| {
            let mut command = rtnet();
            command.args([
                "lab",
                "up",
                "below/net.toml",
                "--name",
                name,
                "--json",
                "end.json",
                "-w",
                "frames.pcapng",
            ]);
            command.current_dir(dir.path());
            command
        });
        // A process that comes later has what the first was given, too.
        let restarted = rtnet().args(["lab", "restart", &pair.place("slave1")]).output().unwrap();
        assert_eq!(restarted.status.code(), Some(0), "{}", text(&restarted.stderr));
        let held = |pid: i32| descriptors(pid).into_iter().filter(|path| path.starts_with(dir.path()));
        for pid in pair.all() {
            assert_eq!(link(pid, "cwd"), Path::new("/"));
            let held: Vec<PathBuf> = held(pid).collect();
            let is_capture = |path: &PathBuf| path.to_string_lossy().contains("frames.pcapng");
            assert!(held.iter().all(is_capture), "nothing but the capture: {held:?}");
        }
        assert!(dir.path().join("frames.pcapng").exists(), "it is where it was asked for");
        let _ = rtnet().args(["lab", "down", &pair.name]).current_dir("/").output().unwrap();
        assert!(dir.path().join("end.json").exists(), "it is where it was asked for");
    });
}

#[test]
fn lab_that_stays_holds_nothing_else_of_its_caller() {
    shared("lab_that_stays_holds_nothing_else_of_its_caller", || {
        let dir = tempfile::tempdir().unwrap();
        let lock = dir.path().join("lock");
        // The caller waits for the end of its output, of which 7 and 8 are copies.
        let begin = "exec 9>\"$0\" 8>&2 7>&1; trap '' HUP INT TERM CHLD; umask 0777; exec \"$@\"";
        let blocked = SigSet::from_iter([Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP]);
        blocked.thread_block().unwrap();
        let pair = Pair::up_by("alone", |name| {
            let mut command = Command::new("sh");
            command.args(["-c", begin]).arg(&lock).arg(env!("CARGO_BIN_EXE_rtnet"));
            command.args(["lab", "up", "--name", name]).args(NETWORK);
            command
        });
        blocked.thread_unblock().unwrap();
        let file = fs::File::options().write(true).open(&lock).unwrap();
        assert!(Flock::lock(file, FlockArg::LockExclusiveNonblock).is_ok(), "nobody has it");
        let (keeper, own) = (pair.keeper(), getsid(None).unwrap());
        let null = Path::new("/dev/null");
        for pid in pair.all() {
            assert!(!descriptors(pid).contains(&lock));
            let session = getsid(Some(Pid::from_raw(pid))).unwrap();
            assert_eq!(session, Pid::from_raw(keeper));
            assert_ne!(session, own);
            assert_eq!(number(pid, "SigBlk:", 16), 0);
            assert_eq!(number(pid, "Umask:", 8), 0o077);
            eventually("nobody reads its errors", || link(pid, "fd/2") == null);
            signal(pid, Signal::SIGHUP);
        }
        assert!((0..=2).all(|of| link(keeper, &format!("fd/{of}")) == null));
        let stations = pair.stations();
        assert!(stations.iter().chain([&keeper]).all(|&pid| is_there(pid)), "SIGHUP ends none");
        signal(keeper, Signal::SIGTERM);
        eventually("its keeper heeds what its caller ignored", || !is_there(keeper));
        assert!(!pair.directory().exists() && !stations.into_iter().any(is_there));
    });
}

#[test]
fn lab_that_stays_opens_its_files_to_no_other_writer() {
    shared("lab_that_stays_opens_its_files_to_no_other_writer", || {
        let pair = Pair::up_by("umask", |name| {
            let mut command = Command::new("sh");
            command.args(["-c", "umask 0; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_rtnet")]);
            command.args(["lab", "up", "--name", name]).args(NETWORK);
            command
        });
        assert!(pair.all().into_iter().all(|pid| number(pid, "Umask:", 8) == 0o022));
        let status = json(rtnet().args(["tdma", "-S", &pair.place("slave1"), "status", "--json"]));
        assert_eq!(status["standing"]["state"], "locked");
    });
}

#[test]
fn killed_keeper_leaves_no_stopped_station() {
    shared("killed_keeper_leaves_no_stopped_station", || {
        let pair = Pair::up("orphaned");
        let (keeper, stations) = (pair.keeper(), pair.stations());
        stations.iter().for_each(|&pid| stop(Pid::from_raw(pid)));
        signal(keeper, Signal::SIGKILL);
        eventually("its stations are gone", || !stations.iter().copied().any(is_there));
        let down = rtnet().args(["lab", "down", &pair.name]).output().unwrap();
        assert_eq!(down.status.code(), Some(3), "{}", text(&down.stderr));
        assert!(!pair.directory().exists());
    });
}

#[test]
fn killed_run_leaves_no_stopped_station() {
    network("killed_run_leaves_no_stopped_station", || {
        let mut command = rtnet();
        command.args(["lab", "run", "--duration", "60s"]).args(NETWORK);
        let mut lab = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let stations = running(&mut lab, 2);
        stations.iter().for_each(|&pid| stop(Pid::from_raw(pid)));
        lab.kill().unwrap();
        lab.wait().unwrap();
        eventually("its stations are gone", || !stations.iter().copied().any(is_there));
    });
}

#[test]
fn killed_search_and_ring_leave_no_stopped_station() {
    network("killed_search_and_ring_leave_no_stopped_station", || {
        let ring = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli/plan.in/ring.toml");
        let ring = ring.to_str().unwrap();
        for arguments in
            [&["find-min-cycle", "--stations", "2"][..], &["lab", "run", ring, "--duration", "60s"]]
        {
            let mut command = rtnet();
            command.args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).process_group(0);
            let mut lab = command.spawn().unwrap();
            // A process with a real-time thread has asked for its bond before.
            let has_begun = |&pid: &i32| {
                let threads = fs::read_dir(format!("/proc/{pid}/task"));
                threads.is_ok_and(|threads| threads.count() > 1)
            };
            let mut stations = Vec::new();
            eventually("a station runs", || {
                stations = stations_of(lab.id());
                !stations.is_empty() && stations.iter().all(has_begun)
            });
            // Some may end by themselves: a search goes on.
            for &pid in &stations {
                let _ = kill(Pid::from_raw(pid), Signal::SIGSTOP);
            }
            lab.kill().unwrap();
            lab.wait().unwrap();
            eventually("its stations are gone", || !stations.iter().copied().any(is_there));
        }
    });
}
