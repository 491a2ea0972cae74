//! Programs that have sockets of a running station: they exchange datagrams, die, and find the station gone.

mod killed;

use std::net::SocketAddrV4;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use rtnet::api::{Station as Attached, UdpSocket};
use rtnet::socket::{Flags, Sender};
use serde_json::Value;

use crate::host::{network, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

const A: &str = "02:00:00:00:00:0a";
const B: &str = "02:00:00:00:00:0b";
const AT_A: &str = "10.0.0.1";
const AT_B: &str = "10.0.0.2";

/// How two stations share the medium: what is said of each.
type Shares = [&'static [&'static str]; 2];
/// At once.
const NOMAC: Shares = [&["--discipline", "nomac"], &["--discipline", "nomac"]];
/// At once, without ever sleeping.
const BUSY: Shares = [&["--discipline", "nomac", "--scheduling", "busy"]; 2];
/// In slots, one each in a cycle of a millisecond.
const TDMA: Shares = [
    &["--master", "--cycle", "1ms", "--slot", "0=300us"],
    &["--slave", "--rounds", "10", "--slot", "0=600us", "--holdover", "20"],
];

/// Two stations that know each other, and share the medium so.
fn stations(medium: &Medium, [of_a, of_b]: Shares) -> [(String, Station); 2] {
    let own = |name: &str, ip: &str, other: String, shares: &[&str]| {
        [&["--interface", "rt0", "--name", name, "--ip", ip, "--route", &other][..], shares]
            .concat()
            .into_iter()
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let start = |namespace, arguments: Vec<String>| {
        Station::start(namespace, &arguments.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let (a, b) = (named("a"), named("b"));
    let first = start(&medium.a, own(&a, "10.0.0.1/24", format!("{AT_B}={B}"), of_a));
    let second = start(&medium.b, own(&b, "10.0.0.2/24", format!("{AT_A}={A}"), of_b));
    [(a, first), (b, second)]
}

/// Attaches as soon as the station is there.
fn attach(name: &str) -> UdpSocket {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match Attached::named(name).and_then(|station| station.udp()) {
            Ok(socket) => {
                socket.set_timeout(Some(Duration::from_secs(1)));
                return socket;
            }
            Err(error) if Instant::now() > deadline => panic!("{name}: {error}"),
            Err(_) => std::thread::sleep(Duration::from_millis(5)),
        }
    }
}

fn bound(name: &str, port: u16) -> UdpSocket {
    let socket = attach(name);
    socket.bind(SocketAddrV4::new([0, 0, 0, 0].into(), port)).unwrap();
    socket
}

fn to(ip: &str, port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(ip.parse().unwrap(), port)
}

fn number<T>(result: std::io::Result<T>) -> Errno {
    Errno::from_raw(result.err().and_then(|error| error.raw_os_error()).expect("it fails"))
}

/// Everything that a station counts.
fn stat(name: &str) -> Value {
    let output = rtnet().args(["stat", "-S", name, "--json"]).output().unwrap();
    crate::schema::read(&output.stdout)
}

/// How often a station's real-time thread has gone to sleep by itself.
fn slept(station: &Station) -> u64 {
    let threads = std::fs::read_dir(format!("/proc/{}/task", station.child.id())).unwrap();
    let read = |path: std::path::PathBuf, file| std::fs::read_to_string(path.join(file)).unwrap_or_default();
    let thread =
        threads.map(|thread| thread.unwrap().path()).find(|path| read(path.clone(), "comm") == "real-time\n");
    let status = read(thread.expect("it has one"), "status");
    let count = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
    count.and_then(|count| count.trim().parse().ok()).expect("the kernel counts them")
}

#[test]
fn a_station_that_never_sleeps_echoes_and_serves_programs() {
    network("a_station_that_never_sleeps_echoes_and_serves_programs", || {
        let medium = Medium::new();
        let [(a, busy), (b, other)] = stations(&medium, BUSY);
        let (ask, echo) = (attach(&a), bound(&b, 36_000));
        let (before, asleep) = (slept(&busy), Instant::now());
        let mut room = [0; 8];
        for n in 0..200u64 {
            ask.send_to(&n.to_be_bytes(), to(AT_B, 36_000)).unwrap();
            let asked = echo.receive(&mut room).unwrap();
            let Sender::Udp(from) = asked.from else { panic!("{asked:?}") };
            echo.send_to(&room[..asked.len], from).unwrap();
            ask.receive(&mut room).unwrap();
            assert_eq!(u64::from_be_bytes(room), n);
        }
        let ping = rtnet().args(["ping", "-S", &a, "-c", "3", "-i", "20ms", AT_B]).output().unwrap();
        assert_eq!(ping.status.code(), Some(0), "{}", String::from_utf8_lossy(&ping.stderr));
        // Whoever waits for a millisecond at a time sleeps about a thousand times a second.
        std::thread::sleep(Duration::from_millis(300));
        let (slept, for_ms) = (slept(&busy) - before, asleep.elapsed().as_millis() as u64);
        assert!(slept < for_ms / 10, "it slept {slept} times in {for_ms} ms");
        drop(other);
    });
}

#[test]
fn programs_of_two_stations_exchange_datagrams_over_the_medium() {
    network("programs_of_two_stations_exchange_datagrams_over_the_medium", || {
        let medium = Medium::new();
        let [(a, first), (b, second)] = stations(&medium, NOMAC);
        let (ask, echo) = (attach(&a), bound(&b, 36_000));
        ask.extend(40).unwrap();
        echo.extend(40).unwrap();
        let mut room = vec![0; 65_507];
        for len in [0, 1, 64, 1472, 1473, 20_000, 65_507] {
            let sent: Vec<u8> = (0..len).map(|n| (n % 251) as u8).collect();
            ask.send_to(&sent, to(AT_B, 36_000)).unwrap();
            let received = echo.receive(&mut room).unwrap();
            assert_eq!((received.whole, &room[..received.len]), (len, &sent[..]));
            assert!(received.rx.is_some(), "the kernel has stamped it");
            let Sender::Udp(from) = received.from else { panic!("{received:?}") };
            echo.send_to(&sent, from).unwrap();
            assert_eq!(ask.receive(&mut room).unwrap().whole, len);
        }
        drop(second);
        let gone = Instant::now() + PATIENCE;
        while number(echo.receive_with(&mut room, Flags::DONTWAIT)) != Errno::ENODEV {
            assert!(Instant::now() < gone, "a station that is gone is no device any more");
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(number(echo.receive(&mut room)), Errno::ENODEV);
        drop(first);
    });
}

#[test]
fn programs_attach_again_once_a_station_that_was_gone_has_been_started_anew() {
    network("programs_attach_again_once_a_station_that_was_gone_has_been_started_anew", || {
        let (medium, name) = (Medium::new(), named("anew"));
        let ip = format!("{AT_A}/24");
        let options = ["--interface", "rt0", "--discipline", "nomac", "--name", &name, "--ip", &ip];
        let station = Attached::named(&name).unwrap();
        let mut of_before: Vec<UdpSocket> = Vec::new();
        for is_killed in [false, true, false] {
            let mut process = Station::start(&medium.a, &options);
            let socket = bound(&name, 36_000);
            for earlier in &of_before {
                assert_eq!(number(earlier.receive(&mut [])), Errno::ENODEV, "of another one");
            }
            socket.send_to(b"to itself", to(AT_A, 36_000)).unwrap();
            assert_eq!(socket.receive(&mut [0; 20]).unwrap().len, 9);
            if is_killed {
                process.child.kill().unwrap();
                process.child.wait().unwrap();
            } else {
                process.end();
            }
            assert_eq!(number(socket.receive(&mut [])), Errno::ENODEV);
            assert_eq!(number(station.udp()), Errno::ENODEV, "there is none");
            of_before.push(socket);
        }
    });
}

/// Waits until what one sends comes to the other: with slots, both must have found into the cycle.
fn until_heard(a: &str, b: &str) {
    let (from, at) = (attach(a), bound(b, 35_999));
    at.set_timeout(Some(Duration::from_millis(20)));
    let deadline = Instant::now() + PATIENCE;
    let mut room = [0; 8];
    loop {
        let _ = from.send_to(b"there?", to(AT_B, 35_999));
        if let Ok(received) = at.receive(&mut room) {
            let Sender::Udp(asked) = received.from else { panic!("{received:?}") };
            let _ = at.send_to(b"here", asked);
            from.set_timeout(Some(Duration::from_millis(100)));
            if from.receive(&mut room).is_ok() {
                return;
            }
        }
        assert!(Instant::now() < deadline, "they do not hear each other: {:#} {:#}", stat(a), stat(b));
    }
}

/// A name that no other test's station has.
fn named(station: &str) -> String {
    unique(&format!("program-{station}"))
}
