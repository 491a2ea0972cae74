//! What a station may do once it runs, and what becomes of it, or of a lab, where the host gives it less.

use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use caps::{CapSet, Capability};

use crate::cell::{Cell, STATIONS};
use crate::host::{figure, shared, skip, unique};
use crate::program::copy_program;
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

/// Of a thread: what it can do now, could take, could pass on, and would pass on.
const SETS: [&str; 4] = ["CapEff", "CapPrm", "CapInh", "CapAmb"];

/// Threads of a process, and which of their sets of capabilities are not empty: a thread's name, and what is left to it.
fn capabilities(pid: u32) -> (usize, Vec<String>) {
    let threads: Vec<_> = fs::read_dir(format!("/proc/{pid}/task")).unwrap().flatten().collect();
    let left = |thread: &fs::DirEntry| {
        // One that has just ended has none.
        let status = fs::read_to_string(thread.path().join("status")).unwrap_or_default();
        let lines = || status.lines().filter_map(|line| line.split_once(":\t"));
        let name = lines().find(|(key, _)| *key == "Name").map_or("", |(_, name)| name);
        let some = lines().filter(|(set, bits)| SETS.contains(set) && bits.contains(|bit| bit != '0'));
        some.map(|(set, bits)| format!("{name}: {set} {bits}")).collect::<Vec<_>>()
    };
    (threads.len(), threads.iter().flat_map(left).collect())
}

#[track_caller]
pub fn assert_gives_up_all(pid: u32) -> usize {
    assert_keeps(pid, &[], 2)
}

/// Waits until its threads, so many at the least, have these and no others: how many threads there are.
#[track_caller]
fn assert_keeps(pid: u32, kept: &[&str], least: usize) -> usize {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let (threads, left) = capabilities(pid);
        // The real-time thread is there from the set-up on.
        if left == kept && threads >= least {
            return threads;
        }
        assert!(Instant::now() < deadline, "still in vain: {threads} threads, {left:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn no_thread_of_a_running_station_keeps_a_capability() {
    shared("no_thread_of_a_running_station_keeps_a_capability", || {
        let (_, left) = capabilities(std::process::id());
        assert!(!left.is_empty(), "a process that has some is seen to");
        let medium = Medium::new();
        let master = Station::master(&medium, &unique("bare"));
        let threads = assert_gives_up_all(master.child.id());
        figure("threads_of_a_station_without_any_capability", &threads.to_string());
    });
}

#[test]
fn no_thread_of_a_labs_stations_keeps_a_capability() {
    shared("no_thread_of_a_labs_stations_keeps_a_capability", || {
        let cell = Cell::up("bare");
        for station in STATIONS {
            let pid = cell.station(station)["pid"].as_u64().unwrap();
            assert_gives_up_all(pid as u32);
        }
    });
}

#[test]
fn the_thread_behind_a_vnic_keeps_what_devices_need_and_no_other_thread_anything() {
    shared("the_thread_behind_a_vnic_keeps_what_devices_need_and_no_other_thread_anything", || {
        let medium = Medium::new();
        let name = unique("admin");
        let options =
            ["--interface", "rt0", "--discipline", "nomac", "--vnic", "10.1.0.1/24", "--name", &name];
        let station = Station::start(&medium.a, &options);
        station.wait_for("Ctrl-C ends it");
        // CAP_NET_ADMIN is the twelfth; what it may take is what it has.
        let kept = ["vnic: CapPrm 0000000000001000", "vnic: CapEff 0000000000001000"];
        assert_keeps(station.child.id(), &kept, 3);
        // It does with it what it has it for, and has no more afterwards.
        for order in [&["set", "--mtu", "900", "--address", "10.1.0.9/24"][..], &["down"], &["up"]] {
            let output = rtnet().args(["vnic", "-S", &name]).args(order).output().unwrap();
            assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        }
        assert_keeps(station.child.id(), &kept, 3);
    });
}

#[test]
fn a_station_that_may_lock_no_memory_says_so_in_one_line_and_runs() {
    shared("a_station_that_may_lock_no_memory_says_so_in_one_line_and_runs", || {
        let medium = Medium::new();
        let name = unique("unlocked");
        let mut limited = Command::new("sh");
        limited.args(["-c", "ulimit -l 64; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_rtnet"), "station"]);
        limited.args(["--interface", "rt0", "--master", "--cycle", "5ms", "--name", &name]);
        let station = Station::run_after(&medium.a, limited, || {
            // Who has it is not bound by the limit. Of the thread that starts the station only.
            caps::drop(None, CapSet::Bounding, Capability::CAP_IPC_LOCK).unwrap();
        });
        let lines = station.lines_until("master_active");
        let said: Vec<_> = lines.iter().filter(|line| line.contains("mlockall")).collect();
        assert_eq!(said.len(), 1, "{lines:?}");
        assert!(
            said[0].contains("pages may be swapped out (raise RLIMIT_MEMLOCK, `ulimit -l`)"),
            "{lines:?}"
        );
        let status = crate::station::status(&name);
        let host = status["host"].as_array().unwrap();
        assert!(host.iter().any(|line| line.as_str().unwrap().starts_with("mlockall: ")), "{host:?}");
        assert_eq!(station.end(), Some(0));
    });
}

/// Runs the command as nobody in a user namespace which lets nobody make another one, as some hosts do: the
/// host's own settings stay as they are. An error where root may not do that.
fn without_user_namespaces(arguments: &[&str]) -> io::Result<Output> {
    let dir = tempfile::tempdir().unwrap();
    let binary = dir.path().join("rtnet");
    copy_program(env!("CARGO_BIN_EXE_rtnet"), &binary);
    fs::set_permissions(dir.path(), fs::Permissions::from_mode(0o755)).unwrap();
    // Who enters has no capability there before a second `exec` as its root.
    let forbid = "echo 0 > /proc/sys/user/max_user_namespaces && cd / && exec \"$@\"";
    let mut command = Command::new("unshare");
    command.args(["--user", "sh", "-c", "read go; exec sh -c \"$0\" \"$@\"", forbid, "sh"]);
    command.args(["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]);
    command.arg(&binary).args(arguments);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn()?;
    let its = |file: &str| format!("/proc/{}/{file}", child.id());
    let own = fs::read_link("/proc/self/ns/user")?;
    let deadline = Instant::now() + PATIENCE;
    while fs::read_link(its("ns/user"))? == own {
        assert!(Instant::now() < deadline, "in vain: it has a namespace");
        std::thread::sleep(Duration::from_millis(5));
    }
    for map in ["uid_map", "gid_map"] {
        fs::write(its(map), "0 0 65536\n")?;
    }
    child.stdin.take().unwrap().write_all(b"go\n")?;
    child.wait_with_output()
}

#[test]
fn where_user_namespaces_are_forbidden_one_line_names_the_setting() {
    let name = "where_user_namespaces_are_forbidden_one_line_names_the_setting";
    shared(name, || {
        let limit = || fs::read_to_string("/proc/sys/user/max_user_namespaces");
        let Ok(before) = limit() else { return skip(name, "this kernel has no user namespaces") };
        if !["unshare", "setpriv"].iter().all(|tool| Command::new(tool).arg("--version").output().is_ok()) {
            return skip(name, "needs unshare and setpriv");
        }
        let output = match without_user_namespaces(&["lab", "run", "--duration", "1s"]) {
            Ok(output) => output,
            Err(error) => return skip(name, &format!("no user namespace to forbid them in: {error}")),
        };
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{said}");
        assert!(said.contains("takes root or a user namespace of one's own"), "{said}");
        assert!(said.contains("user.max_user_namespaces is 0: raise it"), "{said}");
        let output = without_user_namespaces(&["doctor", "--duration", "1s"]).unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        assert_eq!(output.status.code(), Some(0), "it tells what it can: {said}");
        assert!(
            said.contains("user namespaces: for ordinary users: user.max_user_namespaces is 0"),
            "{said}"
        );
        assert!(said.contains("to improve: labs need network namespaces"), "{said}");
        assert_eq!(limit().unwrap(), before, "the host is as it was");
    });
}
