//! Programs that are killed in the middle of sending and receiving, beside others that go on.

use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::*;
use crate::host::figure;

/// Set for a process that is to be a program which is killed: of which station, and which one it is.
const VICTIM_OF: &str = "RTNET_VICTIM_OF";
/// Programs that are killed, unless RTNET_VICTIMS says otherwise.
const KILLS: u64 = 40;
/// Where what they send is read.
const READ_AT: u16 = 36_001;
/// What a program says once it has sent and received; the test harness, whose output it shares, never does.
const BEGUN: u8 = b'!';
/// Of one of their datagrams: who sent it, and which one it is.
const HEAD: usize = 16;
const LONGEST: u64 = 3_000;
/// Reasons to refuse what is no frame, packet or datagram.
const MALFORMED: [&str; 9] = [
    "runt",
    "truncated",
    "ip_version",
    "ip_header_length",
    "ip_checksum",
    "ip_length",
    "ip_fragment",
    "udp_length",
    "udp_checksum",
];

#[test]
fn programs_killed_while_they_send_and_receive_leave_nothing_and_harm_nobody() {
    are_killed("programs_killed_while_they_send_and_receive_leave_nothing_and_harm_nobody", NOMAC, 1);
}

#[test]
fn programs_killed_beside_time_slots_leave_nothing_and_harm_nobody() {
    are_killed("programs_killed_beside_time_slots_leave_nothing_and_harm_nobody", TDMA, 4);
}

/// Kills programs one after the other, each up to 10 ms after it has begun, or so many times that.
fn are_killed(test: &str, shares: Shares, slower: u64) {
    if let Ok(victim) = std::env::var(VICTIM_OF) {
        let (station, number) = victim.split_once(' ').unwrap();
        be_a_victim(station, number.parse().unwrap());
    }
    network(test, || {
        let kills = std::env::var("RTNET_VICTIMS").map_or(KILLS, |kills| kills.parse().unwrap());
        let medium = Medium::new();
        let [(a, _first), (b, _second)] = stations(&medium, shares);
        until_heard(&a, &b);
        let mut beside = Beside::new(&a, &b);
        let before = [at_rest(&a), at_rest(&b)];
        for number in 1..=kills {
            let (mut victim, mut says) = victim(&b, number, test);
            let deadline = Instant::now() + PATIENCE;
            while !has_begun(&mut says) {
                assert!(Instant::now() < deadline, "{number}: {:#} {:#}", stat(&a), stat(&b));
                beside.go_on();
            }
            // It is in the middle of it: at which moment, chance says.
            let until = Instant::now() + Duration::from_micros(slower * (number * 7_919 % 10_000));
            while Instant::now() < until {
                beside.go_on();
            }
            assert_eq!(victim.0.try_wait().unwrap(), None, "{number}: it still runs");
            victim.0.kill().unwrap();
            assert_eq!(victim.0.wait().unwrap().signal(), Some(9));
        }
        beside.until([&a, &b], &before);
        let (at_a, at_b) = (stat(&a), stat(&b));
        for shown in [&at_a["refused"], &at_b["refused"], &at_b["loopback"]] {
            for malformed in MALFORMED {
                assert_eq!(shown[malformed], 0, "{malformed}: {shown:#}");
            }
        }
        for shown in [&at_a["stack"], &at_b["stack"]] {
            assert_eq!(shown["checksums_tolerated"], 0, "{shown:#}");
        }
        // A host that stands still while others send loses frames before any station sees them.
        let full =
            [&at_a, &at_b].map(|stat| stat["port"]["socket_full"].as_u64().unwrap()).iter().sum::<u64>();
        let Beside { exchanged, lost, readers, .. } = beside;
        assert!(lost == 0 || full > 0, "{lost} lost: {at_a:#} {at_b:#}");
        let read = readers.map(|reader| (reader.read, reader.senders));
        figure(
            test,
            &format!(
                "{kills} programs killed, beside {exchanged} round trips of others, {lost} of them lost; the host dropped {full} \
                 frames; of {} programs {} datagrams were read at the other station, of {} programs {} at their own",
                read[0].1, read[0].0, read[1].1, read[1].0
            ),
        );
        // Now and then one is killed before anything of it has left, or the reader has no buffer for it.
        assert!(read.iter().all(|&(_, senders)| senders >= kills * 3 / 4), "{read:?} of {kills}");
    });
}

/// Programs that are not killed: their round trips, and who reads what victims send.
struct Beside {
    ask: UdpSocket,
    echo: UdpSocket,
    readers: [Reader; 2],
    exchanged: u64,
    lost: u64,
}

impl Beside {
    fn new(a: &str, b: &str) -> Self {
        let (ask, echo) = (attach(a), bound(b, 36_000));
        // Nobody else's datagrams come to it.
        ask.connect(Some(to(AT_B, 36_000))).unwrap();
        let readers = [a, b].map(|station| Reader {
            socket: bound(station, READ_AT),
            last: (0, 0),
            read: 0,
            senders: 0,
        });
        Self { ask, echo, readers, exchanged: 0, lost: 0 }
    }

    fn go_on(&mut self) {
        self.lost += u64::from(!exchange(&self.ask, &self.echo, self.exchanged));
        self.exchanged += 1;
        self.readers.iter_mut().for_each(Reader::read_some);
    }

    /// Goes on until all pools are as they were before: sockets of those who were killed are closed, and all buffers are home.
    fn until(&mut self, stations: [&str; 2], before: &[Pools; 2]) {
        let deadline = Instant::now() + PATIENCE;
        while stations.map(pools) != *before {
            assert!(Instant::now() < deadline, "{:#?}, and before {before:#?}", stations.map(pools));
            self.readers.iter_mut().for_each(Reader::read_some);
            std::thread::sleep(Duration::from_millis(20));
        }
        assert!(exchange(&self.ask, &self.echo, self.exchanged));
    }
}

/// Reads what victims send.
struct Reader {
    socket: UdpSocket,
    /// Who sent the last one, and which one it was.
    last: (u64, u64),
    read: u64,
    senders: u64,
}

impl Reader {
    /// Each as it was sent, and in that order; some may be missing.
    fn read_some(&mut self) {
        let mut room = [0; LONGEST as usize + 1];
        for _ in 0..64 {
            let Ok(received) = self.socket.receive_with(&mut room, Flags::DONTWAIT) else { return };
            let read = check(&room[..received.len]);
            assert!(read > self.last, "{read:?} came behind {:?}", self.last);
            self.senders += u64::from(read.0 != self.last.0);
            self.last = read;
            self.read += 1;
        }
    }
}

/// A pool: its name, its buffers, and those of them that are there.
type Pools = Vec<(String, u64, u64)>;

/// All pools of a station.
fn pools(name: &str) -> Pools {
    let output = rtnet().args(["pool", "-S", name, "--json"]).output().unwrap();
    let shown = crate::schema::read(&output.stdout);
    let count = |pool: &Value, of: &str| pool[of].as_u64().unwrap();
    let of = |pool: &Value| {
        (pool["pool"].as_str().unwrap().to_owned(), count(pool, "capacity"), count(pool, "free"))
    };
    shown.as_array().unwrap().iter().map(of).collect()
}

/// The same once all buffers are home.
fn at_rest(name: &str) -> Pools {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let pools = pools(name);
        if pools.iter().all(|(_, capacity, free)| free == capacity) {
            return pools;
        }
        assert!(Instant::now() < deadline, "{pools:#?}");
        std::thread::sleep(Duration::from_millis(20));
    }
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

/// A program that would go on for ever: it is killed also where the test fails before.
struct Victim(Child);

impl Drop for Victim {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Another process of this very test, and what it says.
fn victim(station: &str, number: u64, test: &str) -> (Victim, ChildStdout) {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", &format!("programs::killed::{test}"), "--nocapture"]);
    command.env(VICTIM_OF, format!("{station} {number}")).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut victim = command.spawn().unwrap();
    let says = victim.stdout.take().unwrap();
    (Victim(victim), says)
}

/// Whether it has sent and received. Waits for nothing.
fn has_begun(says: &mut ChildStdout) -> bool {
    let mut fds = [PollFd::new(says.as_fd(), PollFlags::POLLIN)];
    if poll(&mut fds, PollTimeout::ZERO).unwrap() == 0 {
        return false;
    }
    let mut said = [0; 256];
    let len = says.read(&mut said).unwrap();
    assert!(len > 0, "it ended by itself");
    said[..len].contains(&BEGUN)
}

/// Sends to itself and to others and receives, until it is killed.
fn be_a_victim(station: &str, number: u64) -> ! {
    let socket = attach(station);
    let itself = to(AT_B, socket.local_addr().unwrap().port());
    let (mut room, mut last) = ([0; LONGEST as usize + 1], (number, 0));
    for n in 1.. {
        let sent = datagram(number, n);
        for to in [to(AT_A, READ_AT), to(AT_B, READ_AT), itself] {
            // Full: it goes on with the next.
            let _ = socket.send_to(&sent, to);
        }
        if let Ok(received) = socket.receive_with(&mut room, Flags::DONTWAIT) {
            let heard = check(&room[..received.len]);
            assert!(heard > last, "its own, in order: {heard:?} behind {last:?}");
            if last.1 == 0 {
                std::io::stdout().write_all(&[BEGUN]).and_then(|()| std::io::stdout().flush()).unwrap();
            }
            last = heard;
        }
    }
    unreachable!("nobody counts so far")
}

/// What a victim sends: each another length, and every byte is known of it.
fn datagram(victim: u64, n: u64) -> Vec<u8> {
    let len = HEAD as u64 + n * 37 % (LONGEST - HEAD as u64);
    let content = (HEAD as u64..len).map(|at| (n * 31 + victim + at) as u8);
    [victim.to_be_bytes(), n.to_be_bytes()].concat().into_iter().chain(content).collect()
}

/// Who sent it, and which one it is, as it was sent.
fn check(received: &[u8]) -> (u64, u64) {
    let number = |at: usize| u64::from_be_bytes(received[at..at + 8].try_into().unwrap());
    assert!(received.len() >= HEAD, "{received:?}");
    let (victim, n) = (number(0), number(8));
    assert!(received == datagram(victim, n), "{n} of {victim} came as {received:?}");
    (victim, n)
}
