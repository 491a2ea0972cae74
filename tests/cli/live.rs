//! Labs that stay: asked, changed, abused and taken down.

use std::fs::File;
use std::io::Read;
use std::os::fd::{AsFd, AsRawFd};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use nix::fcntl::{Flock, FlockArg};
use nix::ifaddrs::getifaddrs;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sched::{CloneFlags, setns};
use nix::sys::socket::{MsgFlags, sendto};
use serde_json::Value;
use socket2::{Domain, Socket, Type};
use tools::control::REQUEST_AT_MOST;

use crate::cell::{Cell, json, text, wait_until};
use crate::host::{network, shared, stop, unique};
use crate::program::copy_program;
use crate::rtnet;

/// What a command that is refused says: one line.
fn refusal(output: &Output) -> String {
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert_eq!(message.lines().count(), 1, "{message}");
    message
}

#[test]
fn a_lab_is_stood_up_looked_at_changed_and_taken_down() {
    shared("a_lab_is_stood_up_looked_at_changed_and_taken_down", || {
        let cell = Cell::up("looked");
        wait_until("slave2 is locked", || cell.station("slave2")["standing"]["state"] == "locked");
        let station = cell.station("slave2");
        assert_eq!(station["role"], "slave");
        assert_eq!(station["slots"][0]["offset_ns"], 1_600_000);

        let refused = refusal(&cell.slot("slave2", &["set", "0=2800us"]));
        assert!(refused.contains("overlap") && refused.contains("slave3"), "{refused}");
        let refused = refusal(&cell.slot("slave2", &["set", "0=1600us,size=50"]));
        assert!(refused.contains("a size of 50 is not within 64"), "{refused}");
        let refused = refusal(&cell.slot("slave2", &["remove", "0"]));
        assert!(refused.contains("only one of a slave"), "{refused}");
        let refused = refusal(&cell.slot("slave9", &["list"]));
        assert!(
            refused.contains("there is no station") && refused.contains(&cell.place("slave1")),
            "{refused}"
        );

        let set = cell.slot("slave2", &["set", "0=2ms", "--json"]);
        assert_eq!(set.status.code(), Some(0), "{}", text(&set.stderr));
        assert_eq!(cell.slot("slave2", &["set", "3=2650us,phase=2/4,size=100"]).status.code(), Some(0));
        std::thread::sleep(Duration::from_secs(1));
        let slots = json(rtnet().args(["slot", "-S", &cell.place("slave2"), "list", "--json"]));
        assert_eq!((&slots[0]["offset_ns"], &slots[1]["offset_ns"]), (&2_000_000.into(), &2_650_000.into()));
        assert!(slots[1]["sent"].as_u64().unwrap() > 0, "the new slot is used: {slots:#}");
        assert_eq!(cell.slot("slave2", &["remove", "3"]).status.code(), Some(0));

        let mut exec = rtnet();
        exec.args(["lab", "exec", &cell.place("slave1"), "--", "cat", "/proc/self/net/dev"]);
        let interfaces = text(&exec.output().unwrap().stdout);
        assert!(interfaces.contains("rt0:") && !interfaces.contains("br0"), "{interfaces}");

        let pids: Vec<u64> = cell.status()["stations"].as_array().unwrap().iter().map(pid).collect();
        assert_eq!(pids.len(), 4);
        let account = cell.down();
        assert_eq!(account["unexplained"], 0, "{account:#}");
        assert_eq!(account["frames_lost"], 0, "{account:#}");
        assert!(pids.iter().all(|pid| !Path::new(&format!("/proc/{pid}")).exists()), "no process is left");
    });
}

fn pid(station: &Value) -> u64 {
    station["pid"].as_u64().unwrap()
}

#[test]
fn a_slot_moves_a_hundred_times_and_no_frame_is_lost() {
    shared("a_slot_moves_a_hundred_times_and_no_frame_is_lost", || {
        let cell = Cell::up("moved");
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        let begun = cell.status()["cycles"].as_u64().unwrap();
        for turn in 0..100 {
            let offset = if turn % 2 == 0 { "0=2300us" } else { "0=1600us" };
            let set = cell.slot("slave2", &["set", offset]);
            assert_eq!(set.status.code(), Some(0), "{}", text(&set.stderr));
        }
        // The lab counts a missed slot two seconds later.
        wait_until("it had one turn a cycle, wherever its slot was, and none twice", || {
            let status = cell.status();
            let count = |name: &str| status["stations"][2][name].as_u64().unwrap();
            let turns = count("frames_seen") + count("slots_missed");
            turns.abs_diff(status["cycles"].as_u64().unwrap()) <= 1
        });
        let counters = cell.station("slave2")["counters"].clone();
        assert_eq!(counters["returned_dropped"].as_u64().unwrap_or(0), 0, "its queue kept all: {counters}");
        let account = cell.down();
        assert_eq!(account["unexplained"], 0, "{account:#}");
        assert_eq!(account["frames_lost"], 0, "{account:#}");
        let cycles = account["cycles"].as_u64().unwrap() - begun;
        assert!(cycles >= 100, "each change had a cycle of its own: {cycles}");
    });
}

#[test]
fn a_detached_station_is_silent_and_joins_again() {
    shared("a_detached_station_is_silent_and_joins_again", || {
        let cell = Cell::up("detached");
        let tdma = |arguments: &[&str]| {
            let output =
                rtnet().args(["tdma", "-S", &cell.place("slave3")]).args(arguments).output().unwrap();
            assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        };
        for (station, role) in [("slave3", &["master", "--cycle", "4ms"][..]), ("master", &["detach"])] {
            let refused = rtnet().args(["tdma", "-S", &cell.place(station)]).args(role).output().unwrap();
            assert!(refusal(&refused).contains("master"), "a lab keeps its master");
        }
        tdma(&["detach"]);
        let station = cell.station("slave3");
        assert_eq!(station["role"], "detached");
        let sent = station["counters"]["frames_sent"].as_u64();
        std::thread::sleep(Duration::from_millis(300));
        assert_eq!(cell.station("slave3")["counters"]["frames_sent"].as_u64(), sent);
        tdma(&["slave", "--rounds", "5"]);
        wait_until("it is locked again", || cell.station("slave3")["standing"]["state"] == "locked");
        wait_until("it sends again", || cell.station("slave3")["counters"]["frames_sent"].as_u64() > sent);
        std::thread::sleep(Duration::from_millis(200));
        let account = cell.down();
        assert_eq!((&account["unexplained"], &account["frames_lost"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn a_station_that_was_stopped_says_that_it_was_preempted() {
    shared("a_station_that_was_stopped_says_that_it_was_preempted", || {
        use nix::sys::signal::{Signal, kill};
        let cell = Cell::up("stopped");
        let slave = nix::unistd::Pid::from_raw(pid(&cell.station("slave2")) as i32);
        for millis in [1, 5, 50, 200].into_iter().cycle().take(20) {
            stop(slave);
            std::thread::sleep(Duration::from_millis(millis));
            kill(slave, Signal::SIGCONT).unwrap();
            std::thread::sleep(Duration::from_millis(30));
        }
        let count = |cause: &str| cell.station("slave2")["misses"]["causes"][cause].as_u64().unwrap_or(0);
        // In 1.3 s it was stopped through more than 200 of its slots.
        wait_until("they are told of", || count("preempted") + count("stalled_in_send") > 200);
        let worst = &cell.station("slave2")["misses"]["worst"];
        assert!(
            worst.as_array().unwrap().len() == 10 && worst[0]["late_ns"].as_u64() > Some(100_000_000),
            "{worst:#}"
        );
        wait_until("it is locked again", || cell.station("slave2")["standing"]["state"] == "locked");
        let account = cell.down();
        assert_eq!((&account["unexplained"], &account["frames_lost"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn hostile_clients_are_refused_and_disturb_nobody() {
    network("hostile_clients_are_refused_and_disturb_nobody", || {
        let cell = Cell::up("hostile");
        abuse(&cell, "slave1", br#"{"set_slot":{"id":0,"offset_ns":1,"phase":0,"period":0,"size":9}}"#);
        let of_slave = br#"{"set_slot":{"station":"slave1","slot":{"id":0,"offset_ns":1,"size":9}}}"#;
        // The lab's own socket is served by the thread that watches the medium.
        abuse(&cell, "", of_slave);

        let station = cell.station("slave1");
        let state = station["standing"]["state"].as_str().unwrap();
        assert!(["locked", "holdover"].contains(&state), "{state}: a busy host may skip a sync");
        let control = &station["control"];
        assert_eq!((&control["too_long"], &control["not_taken"]), (&1.into(), &1.into()), "{control}");
        // When all 1000 silent clients hang up, 64 may still be clients, and 129 may wait to be let in.
        assert!(control["evicted"].as_u64().unwrap() >= 1_000 - 64 - 129, "{control}");
        let account = cell.down();
        assert_eq!((&account["unexplained"], &account["not_judged"]), (&0.into(), &0.into()), "{account:#}");
    });
}

/// What no client would send, and more of it than anybody would. `whole` is a request that is refused.
fn abuse(cell: &Cell, socket: &str, whole: &[u8]) {
    let whole = [br#"{"version":1,"body":"#, whole, b"}"].concat();
    let mut packets: Vec<Vec<u8>> = (1..whole.len()).map(|end| whole[..end].to_vec()).collect();
    packets.extend([
        br#"{"version":7,"body":"status"}"#.to_vec(),
        br#"{"version":1,"body":"reboot"}"#.to_vec(),
        whole,
        vec![0xff; 1024],
    ]);
    let mut client = cell.connect(socket);
    let answered = |client: &mut Socket| -> Value {
        let mut reply = [0; 4096];
        let length = client.read(&mut reply).unwrap();
        serde_json::from_slice(&reply[..length]).unwrap()
    };
    for packet in packets {
        client.send(&packet).unwrap();
        let reply = answered(&mut client);
        assert!(reply["body"]["refused"].is_string(), "{}: {reply}", text(&packet));
    }
    // Too long: told so, and hung up on.
    client.send(&vec![b' '; REQUEST_AT_MOST + 1]).unwrap();
    let reply = answered(&mut client);
    assert!(
        reply["body"]["refused"].as_str().unwrap().contains(&format!("{REQUEST_AT_MOST} bytes at most")),
        "{reply}"
    );
    assert!(matches!(client.read(&mut [0; 16]), Ok(0) | Err(_)));

    // One that asks and never reads, and a thousand that say nothing.
    let deaf = cell.connect(socket);
    deaf.set_nonblocking(true).unwrap();
    let is_hung_up = || {
        let mut fds = [PollFd::new(deaf.as_fd(), PollFlags::empty())];
        poll(&mut fds, PollTimeout::ZERO).unwrap() > 0
    };
    let deadline = Instant::now() + Duration::from_secs(20);
    while !is_hung_up() {
        // Its queue may be full until the next is looked at.
        let _ = deaf.send_with_flags(br#"{"version":1,"body":"status"}"#, nix::libc::MSG_NOSIGNAL);
        assert!(Instant::now() < deadline, "it is never hung up on");
    }
    let _silent: Vec<Socket> = (0..1_000).map(|_| cell.connect(socket)).collect();
}

/// A lab takes 15 % of a core at least: this many exceed the 80 % that labs may take together.
const LABS_AT_MOST: usize = 6;

#[test]
fn labs_that_together_would_be_throttled_share_a_core() {
    let test = "labs_that_together_would_be_throttled_share_a_core";
    network(test, || {
        let up = |name: &str| {
            let name = unique(name);
            let mut command = rtnet();
            command.args(["lab", "up", "--stations", "4", "--cycle", "600us", "--name", &name]);
            let output = command.output().unwrap();
            (Cell { name }, output)
        };
        let mut labs = Vec::new();
        // Each takes 15 to 49 % of the core: it depends on the lead.
        while labs.len() < LABS_AT_MOST {
            let (lab, output) = up("part");
            labs.push(lab);
            let said = text(&output.stderr);
            // It need not become locked: the test reads its message.
            if said.contains("% of cpu") && said.contains("they run without it") {
                return;
            }
            if output.status.code() != Some(0) {
                return crate::host::skip(test, "this host does not hold a cycle of 600us");
            }
        }
        panic!("{LABS_AT_MOST} labs share a core with SCHED_FIFO");
    });
}

#[test]
fn an_ordinary_user_keeps_a_lab_up() {
    shared("an_ordinary_user_keeps_a_lab_up", || {
        use std::os::unix::fs::PermissionsExt;
        use std::os::unix::process::CommandExt;
        // Neither the binary's folder nor ours is open to others.
        let dir = tempfile::tempdir().unwrap();
        let binary = dir.path().join("rtnet");
        copy_program(env!("CARGO_BIN_EXE_rtnet"), &binary);
        std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o777)).unwrap();
        let runtime = dir.path().join("runtime");
        let nobody = |arguments: &[&str]| {
            let mut command = Command::new(&binary);
            command.args(arguments).uid(65_534).gid(65_534).current_dir("/").env("XDG_RUNTIME_DIR", &runtime);
            command.output().unwrap()
        };
        let up = nobody(&["lab", "up", "--stations", "2", "--cycle", "20ms"]);
        if text(&up.stderr).contains("takes root or a user namespace") {
            crate::host::skip("an_ordinary_user_keeps_a_lab_up", &text(&up.stderr));
            return;
        }
        assert_eq!(up.status.code(), Some(0), "{}", text(&up.stderr));
        let exec = nobody(&["lab", "exec", "slave1", "--", "cat", "/proc/self/net/dev"]);
        let slot = nobody(&["slot", "-S", "lab/slave1", "list"]);
        // It is the only lab of this user.
        let status = nobody(&["tdma", "-S", "slave1", "status"]);
        // Root is another user, and has other labs.
        let of_root = rtnet().args(["lab", "status", "lab"]).output().unwrap();
        // One that is still coming up keeps no other from going down.
        let place = runtime.join("rtnet").join("coming-up");
        let coming_up = hold(&place, 65_534);
        let status_of_it = nobody(&["lab", "status", "coming-up"]);
        let status_of_all = nobody(&["lab", "status"]);
        let all_but_it = nobody(&["lab", "down", "--all"]);
        drop(coming_up);
        let rest = nobody(&["lab", "down", "--all"]);
        assert!(text(&exec.stdout).contains("rt0:"), "{}", text(&exec.stderr));
        assert!(text(&slot.stdout).contains("offset"), "{}", text(&slot.stderr));
        assert!(text(&status.stdout).contains("SCHED_FIFO: EPERM"), "what it lacks is told");
        assert_eq!(of_root.status.code(), Some(2));
        for refused in [&status_of_it, &status_of_all, &all_but_it].map(refusal) {
            assert!(refused.contains("lab 'coming-up' is coming up: ask again"), "{refused}");
        }
        assert!(
            text(&status_of_all.stdout).contains("lab 'lab': 2 stations"),
            "{}",
            text(&status_of_all.stdout)
        );
        assert!(text(&all_but_it.stdout).contains("lab 'lab': 2 stations"), "{}", text(&all_but_it.stdout));
        assert!(text(&rest.stderr).contains("was dead already"), "{}", text(&rest.stderr));
        assert_eq!(rest.status.code(), Some(3), "{}{}", text(&rest.stdout), text(&rest.stderr));
        assert_eq!(std::fs::read_dir(runtime.join("rtnet")).unwrap().count(), 0, "nothing is left");
    });
}

/// Holds a lab's name, as somebody's lab does before its socket is there.
fn hold(place: &Path, uid: u32) -> Flock<File> {
    std::fs::create_dir(place).unwrap();
    let lock = File::create(place.join(".lock")).unwrap();
    for path in [place, &place.join(".lock")] {
        std::os::unix::fs::chown(path, Some(uid), Some(uid)).unwrap();
    }
    Flock::lock(lock, FlockArg::LockExclusiveNonblock).map_err(|(_, error)| error).unwrap()
}

#[test]
fn a_lab_whose_program_was_replaced_starts_its_stations_anew() {
    shared("a_lab_whose_program_was_replaced_starts_its_stations_anew", || {
        let cell = Cell { name: unique("replaced") };
        let dir = tempfile::tempdir().unwrap();
        let binary = dir.path().join("rtnet");
        copy_program(env!("CARGO_BIN_EXE_rtnet"), &binary);
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli/cell.toml");
        let mut up = Command::new(&binary);
        let up = up
            .args(["lab", "up", "--max-miss", "100%", "--name", &cell.name, "--"])
            .arg(file)
            .output()
            .unwrap();
        assert_eq!(up.status.code(), Some(0), "{}", text(&up.stderr));
        std::fs::remove_file(&binary).unwrap();
        std::fs::write(&binary, "another one").unwrap();
        cell.restart("slave1");
        let new = pid(&cell.station("slave1"));
        assert_eq!(std::fs::read_to_string(format!("/proc/{new}/comm")).unwrap(), "rtnet\n");
        assert_eq!(cell.down()["unexplained"], 0);
    });
}

#[test]
fn a_lab_that_is_interrupted_while_it_comes_up_is_not_left_behind() {
    shared("a_lab_that_is_interrupted_while_it_comes_up_is_not_left_behind", || {
        use nix::sys::signal::{Signal, kill};
        let cell = Cell { name: unique("given-up") };
        let place = Path::new("/run/rtnet").join(&cell.name);
        // Calibration takes 200 cycles, four seconds: long enough for a busy host to ask how it stands meanwhile.
        for pause in [300, 0] {
            let mut up = rtnet();
            up.args(["lab", "up", "--stations", "2", "--cycle", "20ms", "--name", &cell.name]);
            let mut up = up.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
            wait_until("it has begun", || place.join("slave1.sock").exists());
            let status = rtnet().args(["lab", "status", &cell.name]).output().unwrap();
            assert!(refusal(&status).contains("is coming up: ask again"), "{}", text(&status.stderr));
            std::thread::sleep(Duration::from_millis(pause));
            // Whoever runs this test in the background has it ignore Ctrl-C's signal.
            kill(nix::unistd::Pid::from_raw(up.id() as i32), Signal::SIGTERM).unwrap();
            assert!(!up.wait().unwrap().success(), "it was not up yet");
            wait_until("nothing is left", || !place.exists());
        }
    });
}

#[test]
fn a_lab_that_was_killed_leaves_its_name_to_the_next() {
    shared("a_lab_that_was_killed_leaves_its_name_to_the_next", || {
        let cell = Cell::up("killed");
        let status = cell.status();
        let taken = rtnet().args(["lab", "up", "--name", &cell.name]).output().unwrap();
        assert!(refusal(&taken).contains(&format!("taken by process {}", pid(&status))));

        let keeper = nix::unistd::Pid::from_raw(pid(&status) as i32);
        nix::sys::signal::kill(keeper, nix::sys::signal::Signal::SIGKILL).unwrap();
        let stations = status["stations"].as_array().unwrap();
        // The last of its threads gives back the name.
        let gone = |of: &Value| match std::fs::read_dir(format!("/proc/{}/task", pid(of))) {
            Ok(threads) => threads.flatten().all(|thread| !thread.path().join("ns/net").exists()),
            Err(error) => error.kind() == std::io::ErrorKind::NotFound,
        };
        wait_until("it is gone, and its stations with it", || gone(&status) && stations.iter().all(gone));
        let refused = refusal(&rtnet().args(["lab", "status", &cell.name]).output().unwrap());
        assert!(refused.contains("does not run any more"), "{refused}");

        let next = Cell::named(cell.name.clone(), |text| text);
        assert_eq!(next.down()["unexplained"], 0);
        let again = rtnet().args(["lab", "down", &cell.name]).output().unwrap();
        assert!(refusal(&again).contains("there is no lab"));
    });
}

#[test]
fn what_other_programs_send_in_a_station_does_not_reach_the_medium() {
    const FRAMES: u64 = 200;
    shared("what_other_programs_send_in_a_station_does_not_reach_the_medium", || {
        let cell = Cell::up("others");
        let namespace = format!("/proc/{}/ns/net", pid(&cell.station("slave1")));
        let left = std::thread::spawn(move || {
            setns(File::open(namespace).unwrap(), CloneFlags::CLONE_NEWNET).unwrap();
            let socket = Socket::new(Domain::PACKET, Type::RAW, None).unwrap();
            let rt0 = getifaddrs().unwrap().find(|found| found.interface_name == "rt0");
            let rt0 = *rt0.unwrap().address.unwrap().as_link_addr().unwrap();
            let mut frame = [0xff; 60];
            frame[6..14].copy_from_slice(&[2, 0, 0, 0, 0, 9, 0x88, 0xb5]);
            let send = |_: &u64| sendto(socket.as_raw_fd(), &frame, &rt0, MsgFlags::empty()).is_ok();
            (0..FRAMES).filter(send).count()
        });
        let left = left.join().unwrap();
        let is_guarded = cell.status()["stations"][1]["guard"] == "kernel";
        wait_until("they are told of", || {
            let standing = &cell.station("slave1")["standing"];
            standing["refusals"]["others_kept_off"].as_u64() == is_guarded.then_some(FRAMES)
        });
        if is_guarded {
            assert_eq!(left, 0);
            let account = cell.down();
            assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()));
        }
    });
}
