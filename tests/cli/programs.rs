//! Programs that have sockets of a running station: they exchange datagrams, die, and find the station gone.

use std::net::SocketAddrV4;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use rtnet::api::{Station as Attached, UdpSocket};
use rtnet::socket::{Flags, Sender};
use serde_json::Value;

use crate::host::{figure, network};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

const A: &str = "02:00:00:00:00:0a";
const B: &str = "02:00:00:00:00:0b";
const AT_A: &str = "10.0.0.1";
const AT_B: &str = "10.0.0.2";
/// Set for a process that is to be a program which is killed.
const VICTIM_OF: &str = "RTNET_VICTIM_OF";
/// Programs that are killed, unless RTNET_VICTIMS says otherwise.
const KILLS: usize = 40;

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

/// What `rtnet pool` says of a station's sockets.
fn sockets(name: &str) -> Vec<Value> {
    let output = rtnet().args(["pool", "-S", name, "--json"]).output().unwrap();
    let shown: Value = serde_json::from_slice(&output.stdout).unwrap();
    let pools = shown["pools"].as_array().or(shown.as_array()).unwrap_or_else(|| panic!("{shown:#}")).clone();
    pools.into_iter().filter(|pool| pool["pool"].as_str().unwrap().starts_with("udp")).collect()
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

#[test]
fn programs_killed_while_they_send_and_receive_leave_nothing_and_harm_nobody() {
    are_killed("programs_killed_while_they_send_and_receive_leave_nothing_and_harm_nobody", NOMAC, 1);
}

#[test]
fn programs_killed_beside_time_slots_leave_nothing_and_harm_nobody() {
    are_killed("programs_killed_beside_time_slots_leave_nothing_and_harm_nobody", TDMA, 4);
}

/// Kills programs one after the other, each after up to 20 ms, or so many times that.
fn are_killed(test: &str, shares: Shares, slower: u64) {
    if let Ok(name) = std::env::var(VICTIM_OF) {
        be_a_victim(&name);
    }
    network(test, || {
        let kills = std::env::var("RTNET_VICTIMS").map_or(KILLS, |kills| kills.parse().unwrap());
        let medium = Medium::new();
        let [(a, _first), (b, _second)] = stations(&medium, shares);
        until_heard(&a, &b);
        let (ask, echo) = (attach(&a), bound(&b, 36_000));
        // A victim sends to whatever port it has itself.
        ask.connect(Some(to(AT_B, 36_000))).unwrap();
        let (mut exchanged, mut lost) = (0u64, 0u64);
        for kill in 0..kills {
            let mut victim = victim(&b, test);
            // It is in the middle of it from some moment on: which one, chance says.
            let until =
                Instant::now() + Duration::from_micros(slower * (4_000 + (kill as u64 * 7_919) % 16_000));
            while Instant::now() < until {
                lost += u64::from(!exchange(&ask, &echo, exchanged));
                exchanged += 1;
            }
            victim.kill().unwrap();
            victim.wait().unwrap();
        }
        let deadline = Instant::now() + PATIENCE;
        while sockets(&b).len() > 1 {
            assert!(Instant::now() < deadline, "all are closed: {:?}", sockets(&b));
            std::thread::sleep(Duration::from_millis(20));
        }
        assert!(exchange(&ask, &echo, exchanged));
        let left = sockets(&b);
        assert_eq!((&left[0]["free"], &left[0]["dropped"]), (&left[0]["capacity"], &0.into()), "{left:#?}");
        let (at_a, at_b) = (stat(&a), stat(&b));
        for malformed in ["ip_length", "ip_checksum", "udp_length", "udp_checksum", "truncated"] {
            let refused = at_a["refused"][malformed].as_u64().unwrap_or(0);
            assert_eq!(refused, 0, "{malformed}: {at_a:#}");
        }
        // A host that stands still while others send loses frames before any station sees them.
        let dropped_by_host = [&at_a, &at_b].map(|stat| stat["port"]["socket_full"].as_u64().unwrap_or(0));
        assert!(lost == 0 || dropped_by_host.iter().sum::<u64>() > 0, "{lost} lost: {at_a:#} {at_b:#}");
        figure(
            test,
            &format!(
                "{kills} programs killed, beside {exchanged} round trips of others, {lost} of them lost; the host dropped \
                 {} frames",
                dropped_by_host.iter().sum::<u64>()
            ),
        );
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

/// Everything that a station counts.
fn stat(name: &str) -> Value {
    let output = rtnet().args(["stat", "-S", name, "--json"]).output().unwrap();
    serde_json::from_slice(&output.stdout).unwrap()
}

/// One round trip of programs that are not killed; `false`: a frame of it was lost.
fn exchange(ask: &UdpSocket, echo: &UdpSocket, number: u64) -> bool {
    ask.send_to(&number.to_be_bytes(), to(AT_B, 36_000)).unwrap();
    let Some(from) = hear(echo, number) else { return false };
    echo.send_to(&number.to_be_bytes(), from).unwrap();
    hear(ask, number).is_some()
}

/// Waits for this number; what is left of earlier ones is passed over.
fn hear(socket: &UdpSocket, number: u64) -> Option<SocketAddrV4> {
    let mut room = [0; 64];
    loop {
        let received = match socket.receive(&mut room) {
            Err(error) if error.raw_os_error() == Some(Errno::ETIMEDOUT as i32) => return None,
            other => other.unwrap(),
        };
        let Sender::Udp(from) = received.from else { panic!("{received:?}") };
        let heard = u64::from_be_bytes(room[..received.len].try_into().expect("as it was sent"));
        assert!(heard <= number, "as it was sent");
        if heard == number {
            return Some(from);
        }
    }
}

/// Another process of this very test.
fn victim(station: &str, test: &str) -> Child {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", &format!("programs::{test}"), "--nocapture"]).env(VICTIM_OF, station);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Sends and receives to itself and to others, until it is killed.
fn be_a_victim(station: &str) -> ! {
    let socket = attach(station);
    let port = socket.local_addr().unwrap().port();
    let mut room = [0; 4_000];
    loop {
        for ip in [AT_A, AT_B] {
            // Full, or refused for lack of a socket there: it tries again.
            let _ = socket.send_to(&[0x5a; 3_000], to(ip, port));
        }
        let _ = socket.receive_with(&mut room, Flags::DONTWAIT);
    }
}

/// A name that no other test's station has.
fn named(station: &str) -> String {
    format!("program-{station}-{}", std::process::id())
}
