//! What sockets of programs take of their host: memory that nobody can make a hole in, descriptors; and where there is less.

use std::fs;
use std::net::SocketAddrV4;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use caps::{CapSet, Capability};
use nix::errno::Errno;
use nix::sys::resource::{Resource, setrlimit};
use rtnet::api::{Station as Attached, UdpSocket, memory, segment};

use crate::host::{figure, shared, skip, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station, status};

/// Set for a process that is to be a program which may lock no memory.
const POOR_AT: &str = "RTNET_POOR_AT";
const IP: &str = "10.0.0.1";

fn named(what: &str) -> String {
    unique(&format!("limits-{what}"))
}

/// A station with sockets whose process may have as much, and which keeps no right to more.
fn limited(medium: &Medium, name: &str, limit: &str, rights: &'static [Capability]) -> Station {
    let mut command = Command::new("sh");
    let line = format!("{limit}; exec \"$0\" \"$@\"");
    command.args(["-c", &line, env!("CARGO_BIN_EXE_rtnet"), "station", "--interface", "rt0"]);
    command.args(["--discipline", "direct", "--name", name, "--ip", "10.0.0.1/24"]);
    let station = Station::run_after(&medium.a, command, || {
        for &right in rights {
            caps::drop(None, CapSet::Bounding, right).unwrap();
        }
    });
    station.wait_for("Ctrl-C ends it");
    station
}

fn station(medium: &Medium, name: &str) -> Station {
    limited(medium, name, "true", &[])
}

fn open(name: &str) -> std::io::Result<UdpSocket> {
    Attached::named(name)?.udp()
}

/// Lines about memory that sockets share.
fn told_of_holes(name: &str) -> Vec<String> {
    let host = status(name)["host"].as_array().unwrap().clone();
    host.iter()
        .filter_map(|line| line.as_str().map(str::to_owned))
        .filter(|line| line.starts_with("memfd_secret"))
        .collect()
}

fn secret_mappings(pid: u32) -> usize {
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap();
    maps.lines().filter(|line| line.contains("secretmem")).count()
}

#[test]
fn sockets_of_a_station_without_rights_have_memory_in_which_nobody_makes_holes() {
    let test = "sockets_of_a_station_without_rights_have_memory_in_which_nobody_makes_holes";
    shared(test, || {
        if let Some(why) = memory::why_not_whole(segment::bytes()) {
            return skip(test, &format!("no secret memory: {why}"));
        }
        let (medium, name) = (Medium::new(), named("few"));
        let station = limited(&medium, &name, "ulimit -l 8192", &[Capability::CAP_IPC_LOCK]);
        let sockets: Vec<_> = (0..8).map(|_| open(&name).unwrap()).collect();
        assert_eq!((secret_mappings(station.child.id()), told_of_holes(&name)), (sockets.len(), Vec::new()));
        if !caps::has_cap(None, CapSet::Effective, Capability::CAP_SYS_RESOURCE).unwrap() {
            return skip(test, "needs CAP_SYS_RESOURCE to raise the limit of what is locked");
        }
        let (medium, name) = (Medium::new(), named("secret"));
        // The usual limit: what is locked at the start alone is more.
        let station = limited(&medium, &name, "ulimit -l 8192", &[]);
        let sockets: Vec<_> = (0..64).map(|_| open(&name).unwrap()).collect();
        assert_eq!((secret_mappings(station.child.id()), told_of_holes(&name)), (sockets.len(), Vec::new()));
        assert_eq!(open(&name).err().and_then(|error| error.raw_os_error()), Some(Errno::EAGAIN as i32));
    });
}

#[test]
fn a_station_that_may_lock_no_more_shares_memory_with_holes_and_says_so_once() {
    let test = "a_station_that_may_lock_no_more_shares_memory_with_holes_and_says_so_once";
    shared(test, || {
        let (medium, name) = (Medium::new(), named("holes"));
        let rights = &[Capability::CAP_IPC_LOCK, Capability::CAP_SYS_RESOURCE];
        let station = limited(&medium, &name, "ulimit -l 64", rights);
        assert_eq!(told_of_holes(&name), [""; 0], "nobody has opened a socket");
        let _sockets = [open(&name).unwrap(), open(&name).unwrap()];
        let told = told_of_holes(&name);
        assert_eq!((secret_mappings(station.child.id()), told.len()), (0, 1), "{told:?}");
        assert!(told[0].contains("hold the station up") && told[0].contains('('), "{told:?}");
    });
}

#[test]
fn a_program_that_may_lock_no_more_is_told_so_and_what_to_do() {
    let test = "a_program_that_may_lock_no_more_is_told_so_and_what_to_do";
    if let Ok(name) = std::env::var(POOR_AT) {
        setrlimit(Resource::RLIMIT_MEMLOCK, 65_536, 65_536).unwrap();
        caps::drop(None, CapSet::Effective, Capability::CAP_IPC_LOCK).unwrap();
        panic!("TOLD {}", open(&name).map(drop).unwrap_err());
    }
    shared(test, || {
        if let Some(why) = memory::why_not_whole(segment::bytes()) {
            return skip(test, &format!("no secret memory: {why}"));
        }
        let (medium, name) = (Medium::new(), named("poor"));
        // One that locks nothing else has secret memory whatever its limit is.
        let _station = limited(&medium, &name, "true", &[Capability::CAP_IPC_LOCK]);
        let mut program = Command::new(std::env::current_exe().unwrap());
        program.args(["--exact", &format!("program_limits::{test}"), "--nocapture"]).env(POOR_AT, &name);
        let output = program.stdin(Stdio::null()).output().unwrap();
        let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        let told = said.lines().find(|line| line.contains("TOLD")).unwrap_or_else(|| panic!("{said}"));
        assert!(told.contains("this program may lock no more (raise RLIMIT_MEMLOCK, `ulimit -l`"), "{told}");
    });
}

/// What a station counts on when it refuses programs for want of descriptors.
#[test]
fn a_socket_of_a_program_takes_five_descriptors_of_its_station() {
    shared("a_socket_of_a_program_takes_five_descriptors_of_its_station", || {
        let (medium, name) = (Medium::new(), named("five"));
        let station = station(&medium, &name);
        let path = format!("/proc/{}/fd", station.child.id());
        let open_files = || fs::read_dir(&path).unwrap().count();
        // Until those that asked, and what went along with an answer, are gone.
        let settled = |expected: usize| {
            let deadline = Instant::now() + PATIENCE;
            while open_files() != expected {
                assert!(Instant::now() < deadline, "{} open, not {expected}", open_files());
                std::thread::sleep(Duration::from_millis(5));
            }
        };
        let before = open_files();
        let sockets: Vec<_> = (0..8).map(|_| open(&name).unwrap()).collect();
        settled(before + 5 * sockets.len());
        drop(sockets);
        settled(before);
    });
}

#[test]
fn a_station_that_may_open_few_files_refuses_programs_that_are_too_many_and_goes_on() {
    shared("a_station_that_may_open_few_files_refuses_programs_that_are_too_many_and_goes_on", || {
        let (medium, name) = (Medium::new(), named("files"));
        let _station = limited(&medium, &name, "ulimit -n 128; ulimit -Sn 32", &[]);
        let mut sockets = Vec::new();
        let refused = loop {
            match open(&name) {
                Ok(socket) => sockets.push(socket),
                Err(error) => break error,
            }
            assert!(sockets.len() < 64, "there are as many descriptors");
        };
        // The soft limit was raised to the hard one, half of which is for other things.
        assert_eq!((refused.raw_os_error(), sockets.len()), (Some(Errno::EMFILE as i32), 12), "{refused}");
        let pools = rtnet().args(["pool", "-S", &name, "--json"]).output().unwrap();
        let pools = crate::schema::read(&pools.stdout);
        assert_eq!(pools.as_array().unwrap().len(), 3 + sockets.len(), "nothing is left of who was refused");
        sockets.clear();
        let deadline = Instant::now() + PATIENCE;
        while open(&name).is_err() {
            assert!(Instant::now() < deadline, "there is room again");
            std::thread::sleep(Duration::from_millis(5));
        }
    });
}

/// Pages that a station's real-time thread had to wait for since it was there; `None`: it is not yet.
fn faults(pid: u32) -> Option<u64> {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap().flatten();
    let mut stat = tasks.map(|task| fs::read_to_string(task.path().join("stat")).unwrap_or_default());
    let its = stat.find(|stat| stat.contains("(real-time)"))?;
    its.rsplit(')').next()?.split_whitespace().nth(7)?.parse().ok()
}

/// The same once it has been there for a while: at its start it locks everything that there is.
fn faults_at_the_start(pid: u32) -> u64 {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let before = faults(pid);
        std::thread::sleep(Duration::from_millis(200));
        match faults(pid) {
            Some(faults) if before == Some(faults) => return faults,
            _ => assert!(Instant::now() < deadline, "it stays as it is"),
        }
    }
}

#[test]
fn the_real_time_thread_waits_for_no_page_of_what_programs_bring() {
    let test = "the_real_time_thread_waits_for_no_page_of_what_programs_bring";
    shared(test, || {
        let (medium, name) = (Medium::new(), named("faults"));
        let station = station(&medium, &name);
        let pid = station.child.id();
        let before = faults_at_the_start(pid);
        let mut room = vec![0; 65_507];
        let mut exchanged = 0;
        for _ in 0..8 {
            let own = Attached::named(&name).unwrap().udp_with(1_024).unwrap();
            own.set_timeout(Some(PATIENCE));
            let to = SocketAddrV4::new(IP.parse().unwrap(), own.local_addr().unwrap().port());
            for len in [64, 1_472, 65_507] {
                own.send_to(&room[..len], to).unwrap();
                exchanged += own.receive(&mut room).unwrap().whole;
            }
            // As much as the socket has buffers for, and rings room.
            (0..1_024).for_each(|_| drop(own.send_to(&[1; 64], to)));
            own.set_timeout(Some(Duration::from_millis(50)));
            while own.receive(&mut room).is_ok_and(|received| received.whole == 64) {
                exchanged += 64;
            }
        }
        for verb in ["pool", "stat"] {
            assert!(rtnet().args([verb, "-S", &name]).output().unwrap().status.success());
        }
        let after = faults(pid).unwrap();
        figure(test, &format!("{} pages for {exchanged} bytes", after - before));
        assert_eq!(after - before, 0);
    });
}

#[test]
fn what_a_program_sends_without_a_slot_is_refused_at_once_where_no_master_is_heard() {
    let test = "what_a_program_sends_without_a_slot_is_refused_at_once_where_no_master_is_heard";
    shared(test, || {
        let (medium, name) = (Medium::new(), named("waiting"));
        let options =
            ["--interface", "rt0", "--slave", "--slot", "0=1ms", "--name", &name, "--ip", "10.0.0.1/24"];
        let route = ["--route", "10.0.0.2=02:00:00:00:00:0b"];
        let station = Station::start(&medium.a, &[&options[..], &route].concat());
        station.wait_for("Ctrl-C ends it");
        let socket = open(&name).unwrap();
        socket.set_channel(2);
        let to = SocketAddrV4::new([10, 0, 0, 2].into(), 7);
        let mut took = Vec::new();
        for _ in 0..20 {
            let begun = Instant::now();
            // The first that is refused is told of at the next.
            let refused = loop {
                if let Err(error) = socket.send_to(b"now", to) {
                    break error;
                }
                assert!(begun.elapsed() < PATIENCE, "it is looked at");
                std::thread::sleep(Duration::from_micros(200));
            };
            assert_eq!(refused.raw_os_error(), Some(Errno::EAGAIN as i32), "{refused}");
            took.push(begun.elapsed());
        }
        let output = rtnet().args(["stat", "-S", &name, "--json"]).output().unwrap();
        let shown = crate::schema::read(&output.stdout);
        let own = shown["sockets"].as_object().unwrap().values().next().unwrap();
        assert!(own["refused_no_slot"].as_u64() >= Some(20), "{shown:#}");
        assert_eq!(own["refused_no_slot"], own["refused"], "{shown:#}");
        took.sort();
        figure(test, &format!("refused after {:?}, half of them", took[took.len() / 2]));
        assert!(took[took.len() / 2] < Duration::from_millis(20), "it is rung for: {took:?}");
    });
}

#[test]
fn tables_and_pools_are_as_large_as_was_said_at_the_start() {
    shared("tables_and_pools_are_as_large_as_was_said_at_the_start", || {
        let (medium, name) = (Medium::new(), named("sizes"));
        let options =
            ["--interface", "rt0", "--discipline", "direct", "--name", &name, "--ip", "10.0.0.1/24"];
        let tables = ["--hosts", "2", "--networks", "1", "--fragment-timeout", "50ms"];
        let pools =
            ["--socket-buffers", "5", "--receive-buffers", "40", "--icmp-buffers", "3", "--arp-buffers", "9"];
        let station = Station::start(&medium.a, &[&options[..], &tables, &pools].concat());
        station.wait_for("Ctrl-C ends it");
        let _socket = open(&name).unwrap();
        let json = |verb: &[&str]| -> serde_json::Value {
            let output =
                rtnet().args([verb[0], "-S", &name]).args(&verb[1..]).arg("--json").output().unwrap();
            crate::schema::read(&output.stdout)
        };
        let shown = json(&["pool"]);
        let capacities: Vec<_> =
            shown.as_array().unwrap().iter().filter_map(|pool| pool["capacity"].as_u64()).collect();
        assert_eq!(capacities, [40, 3, 9, 5], "{shown:#}");
        let add = |ip: &str| {
            let mac = "02:00:00:00:00:09";
            rtnet().args(["route", "-S", &name, "add", ip, mac]).output().unwrap()
        };
        assert!(["10.0.0.2", "10.0.0.3"].iter().all(|ip| add(ip).status.success()));
        let full = String::from_utf8(add("10.0.0.4").stderr).unwrap();
        let remedy = "delete one (`rtnet route del`), or start the station with a larger one (`rtnet station --hosts`, \
                      `--networks`; ";
        assert!(full.contains(&format!("host routes is full: it takes 2; {remedy}")), "{full}");
        let network =
            |to: &str| rtnet().args(["route", "-S", &name, "add", to, "via", "10.0.0.2"]).output().unwrap();
        assert!(network("10.1.0.0/16").status.success());
        let full = network("10.2.0.0/16");
        assert_eq!(full.status.code(), Some(2));
        let full = String::from_utf8(full.stderr).unwrap();
        assert!(full.contains(&format!("network routes is full: it takes 1; {remedy}")), "{full}");
        let routes = json(&["route", "list"]);
        assert_eq!(
            (&routes["hosts_at_most"], &routes["networks_at_most"]),
            (&2.into(), &1.into()),
            "{routes:#}"
        );
    });
}
