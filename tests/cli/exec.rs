//! `rtnet lab exec`: what it runs sees the station's interfaces, ends with the lab, and says how it ended.

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use nix::sys::signal::Signal;

use crate::cell::text;
use crate::host::{shared, skip, unique};
use crate::lab::{eventually, is_there};
use crate::program::copy_program;
use crate::rtnet;
use crate::schema;
use crate::stays::{Pair, signal};

/// A process that this test has started, and its descendants that it has printed.
struct Started {
    child: Child,
    pids: Vec<i32>,
}

impl Started {
    /// The processes of a command that prints their numbers in one line.
    fn of(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let pids: Vec<i32> = line.split_whitespace().map(|pid| pid.parse().unwrap()).collect();
        assert!(!pids.is_empty() && pids.iter().copied().all(is_there), "{line:?}");
        Self { child, pids }
    }

    fn is_gone(&mut self) -> bool {
        let _ = self.child.try_wait();
        !self.pids.iter().copied().any(is_there)
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        for pid in self.pids.drain(..).filter(|&pid| is_there(pid)) {
            signal(pid, Signal::SIGKILL);
        }
        let _ = self.child.wait();
    }
}

/// Prints its number, and goes on.
const PLAIN: &str = "echo $$; exec sleep 1000";
/// The same with one that has left its session, and whose parent has gone.
const DAEMON: &str = "setsid sh -c 'echo $$; exec sleep 1000' & exit";
/// One that SIGTERM does not end.
const STUBBORN: &str = "trap '' TERM; echo $$; while :; do sleep 1; done";

fn sh(pair: &Pair, script: &str) -> Started {
    Started::of(pair.exec(&["sh", "-c", script]))
}

/// One in a network namespace of its own.
fn bystander() -> Started {
    let mut command = Command::new("unshare");
    command.args(["--net", "sh", "-c", PLAIN]);
    Started::of(command)
}

#[test]
fn lab_down_ends_what_exec_started_and_names_it() {
    shared("lab_down_ends_what_exec_started_and_names_it", || {
        let pair = Pair::up("guests");
        let mut guests = [PLAIN, DAEMON, STUBBORN].map(|script| sh(&pair, script));
        // One is stopped, and one has come to a station by another way.
        signal(guests[0].pids[0], Signal::SIGSTOP);
        let mut other = Command::new("nsenter");
        other.args(["-t", &pair.stations()[0].to_string(), "-n", "sh", "-c", PLAIN]);
        let (mut other, mut bystander) = (Started::of(other), bystander());
        let output = rtnet().args(["lab", "down", &pair.name, "--json"]).output().unwrap();
        let account = schema::read(&output.stdout);
        let notes = account[0]["notes"].to_string();
        let ended: Vec<i32> = guests.iter().chain([&other]).flat_map(|of| of.pids.clone()).collect();
        for pid in &ended {
            assert!(notes.contains(&format!("{pid} (")), "{pid}: {notes}");
        }
        assert!(notes.contains("(sleep 1000)") && notes.contains("ended with the lab"), "{notes}");
        eventually("they are gone", || guests.iter_mut().all(Started::is_gone) && other.is_gone());
        assert!(!bystander.is_gone(), "it is in no namespace of the lab");
    });
}

#[test]
fn interrupted_lab_ends_what_exec_started() {
    shared("interrupted_lab_ends_what_exec_started", || {
        let pair = Pair::up("broken");
        let mut guest = sh(&pair, DAEMON);
        let keeper = pair.keeper();
        signal(keeper, Signal::SIGINT);
        eventually("its keeper ends", || !is_there(keeper));
        assert!(guest.is_gone());
    });
}

#[test]
fn dead_labs_guests_end_with_what_is_left_of_it() {
    shared("dead_labs_guests_end_with_what_is_left_of_it", || {
        let pair = Pair::up("died");
        let [mut first, mut bystander] = [sh(&pair, DAEMON), bystander()];
        signal(pair.keeper(), Signal::SIGKILL);
        let down = rtnet().args(["lab", "down", &pair.name]).output().unwrap();
        let said = text(&down.stderr);
        assert_eq!(down.status.code(), Some(3), "{said}");
        assert!(
            said.contains("dead already") && said.contains(&format!("{} (sleep 1000)", first.pids[0])),
            "{said}"
        );
        eventually("it is gone", || first.is_gone());
        // The next of that name does it, too.
        let name = pair.name.clone();
        let up = || {
            let mut command = rtnet();
            command.args(["lab", "up", "--stations", "2", "--cycle", "10ms", "--name", &name]);
            command.output().unwrap()
        };
        assert_eq!(up().status.code(), Some(0));
        let mut second = sh(&pair, PLAIN);
        signal(pair.keeper(), Signal::SIGKILL);
        let again = up();
        assert_eq!(again.status.code(), Some(0), "{}", text(&again.stderr));
        eventually("it is gone", || second.is_gone());
        let mut third = sh(&pair, PLAIN);
        assert!(!third.is_gone() && !bystander.is_gone());
    });
}

#[test]
fn exec_shows_the_stations_interfaces_in_sys() {
    shared("exec_shows_the_stations_interfaces_in_sys", || {
        let pair = Pair::up("sys");
        let list = |path: &str| text(&pair.exec(&["ls", path]).output().unwrap().stdout);
        let interfaces = list("/sys/class/net");
        let names: Vec<&str> =
            interfaces.split_whitespace().filter(|name| *name != "bonding_masters").collect();
        assert_eq!(names, ["lo", "rt0"]);
        assert_eq!(list("/sys/class/net/rt0/address"), "/sys/class/net/rt0/address\n");
        let own = text(&Command::new("ls").arg("/sys/fs/cgroup").output().unwrap().stdout);
        assert_eq!(list("/sys/fs/cgroup"), own, "what is mounted there stays");
        let mounts = || fs::read_to_string("/proc/self/mountinfo").unwrap();
        assert!(!mounts().contains("rtnet-"), "outside nothing has changed");
    });
}

/// A copy of the program that everybody may execute, and a run directory of user nobody.
fn for_nobody(dir: &Path) -> impl Fn(&[&str]) -> Command {
    let (copy, runtime) = (dir.join("rtnet-copy"), dir.join("run"));
    copy_program(env!("CARGO_BIN_EXE_rtnet"), &copy);
    fs::set_permissions(dir, fs::Permissions::from_mode(0o755)).unwrap();
    fs::create_dir(&runtime).unwrap();
    std::os::unix::fs::chown(&runtime, Some(65_534), Some(65_534)).unwrap();
    move |arguments| {
        let mut command = Command::new(&copy);
        command.args(arguments).uid(65_534).gid(65_534).env("XDG_RUNTIME_DIR", &runtime).current_dir("/");
        command
    }
}

#[test]
fn ordinary_users_exec_shows_interfaces_and_ends_with_its_lab() {
    let test = "ordinary_users_exec_shows_interfaces_and_ends_with_its_lab";
    shared(test, || {
        let dir = tempfile::tempdir().unwrap();
        let (run, name) = (for_nobody(dir.path()), unique("nobody"));
        let up = run(&["lab", "up", "--stations", "2", "--cycle", "20ms", "--name", &name]).output().unwrap();
        if up.status.code() == Some(2) && text(&up.stderr).contains("user namespace") {
            return skip(test, &text(&up.stderr));
        }
        assert_eq!(up.status.code(), Some(0), "{}", text(&up.stderr));
        let place = format!("{name}/slave1");
        let exec = |script: &str| run(&["lab", "exec", &place, "--", "sh", "-c", script]);
        let listed = exec("ls /sys/class/net").output().unwrap();
        let (interfaces, why) = (text(&listed.stdout), text(&listed.stderr));
        assert!(
            interfaces.contains("rt0") || why.contains("/sys shows the host's interfaces"),
            "{interfaces}{why}"
        );
        let mut guest = Started::of(exec(DAEMON));
        let down = run(&["lab", "down", &name, "--json"]).output().unwrap();
        assert!(text(&down.stdout).contains("(sleep 1000)"), "{}", text(&down.stderr));
        eventually("it is gone", || guest.is_gone());
    });
}

#[test]
fn exec_ends_with_the_status_of_its_command() {
    shared("exec_ends_with_the_status_of_its_command", || {
        let pair = Pair::up("status");
        let dir = tempfile::tempdir().unwrap();
        let file = |name: &str, content: &str, mode: u32| {
            let path = dir.path().join(name);
            fs::write(&path, content).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            path.to_str().unwrap().to_owned()
        };
        let closed = file("closed", "#!/bin/sh\n", 0o644);
        let uninterpreted = file("uninterpreted", "#!/nosuch/interpreter\n", 0o755);
        let below_file = format!("{closed}/x");
        let cases: [(&[&str], i32, &str); 8] = [
            (&["true"], 0, ""),
            (&["sh", "-c", "exit 3"], 3, ""),
            (&["sh", "-c", "exit 127"], 127, ""),
            (&["nosuch-command"], 127, "not installed"),
            (&[&uninterpreted], 127, "interpreter"),
            (&[&closed], 126, "chmod +x"),
            (&["/"], 126, "directory"),
            (&[&below_file], 126, "no program"),
        ];
        for (command, status, said) in cases {
            let output = pair.exec(command).output().unwrap();
            let message = text(&output.stderr);
            assert_eq!(output.status.code(), Some(status), "{command:?}: {message}");
            assert!(message.contains(said), "{command:?}: {message}");
        }
        let killed = pair.exec(&["sh", "-c", "kill -9 $$"]).status().unwrap();
        assert_eq!(killed.signal(), Some(9), "a shell shows 137");
        let output = rtnet().args(["lab", "exec", "nosuch/slave1", "--", "true"]).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{}", text(&output.stderr));
    });
}
