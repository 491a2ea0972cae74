//! Programs and two stations that hear each other, in threads of one process.

// Programs wait, and stations take their turns, in real time.
#![allow(clippy::disallowed_methods)]

mod errors;
mod gone;
mod hostile;

use std::io::{ErrorKind, Read};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use socket2::{Domain, SockAddr, Socket, Type};

use super::client::{PacketSocket, Station, UdpSocket};
use super::door::{self, Attached, Door};
use super::handshake::{Answer, Ask};
use super::line::Lines;
use crate::ip::StackConfig;
use crate::ip::route::Interface;
use crate::ip::tests::End;
use crate::live::{Bells, Visitor};
use crate::queue::Priority;
use crate::socket::{Flags, LinkMode, LinkType, Sender};
use crate::time::Instant;
use crate::wire::ethernet::{Address, EtherType};

/// As long as anything may take on a host that has other things to do.
const PATIENCE: Duration = Duration::from_secs(20);
const IP: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(10, 0, 0, 2)];

fn address(station: usize) -> Address {
    Address([2, 0, 0, 0, 0, 1 + station as u8])
}

/// One station: what its control thread and its real-time thread do, in turns.
struct Site {
    end: End,
    door: Door,
    listener: Socket,
    programs: Vec<(Socket, Option<Attached>)>,
}

/// Two stations that a thread keeps going.
struct Pair {
    stations: [Station; 2],
    seen: Arc<Seen>,
    stop: Arc<AtomicBool>,
    held: Arc<Mutex<()>>,
    thread: Option<JoinHandle<[Site; 2]>>,
    _scratch: tempfile::TempDir,
}

/// What the thread shows of the second station.
#[derive(Default)]
struct Seen {
    sockets: AtomicU64,
    wakes: AtomicU64,
    nonsense: AtomicU64,
    free: AtomicU64,
    turns: AtomicU64,
}

impl Site {
    fn new(number: usize, path: &PathBuf) -> Self {
        let interface = Interface { address: address(number), ip: IP[number], prefix: 24 };
        let mut end = End::above(StackConfig::new(interface), vec![Box::new(Lines::new(64))]);
        end.knows(IP[1 - number], address(1 - number));
        let listener = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        listener.bind(&SockAddr::unix(path).unwrap()).unwrap();
        listener.listen(16).unwrap();
        listener.set_nonblocking(true).unwrap();
        Self { end, door: Door::new(Bells::new().unwrap()), listener, programs: Vec::new() }
    }

    fn admit(&mut self) {
        while let Ok((program, _)) = self.listener.accept() {
            program.set_nonblocking(true).unwrap();
            self.programs.push((program, None));
        }
        let Self { end, door, programs, .. } = self;
        programs.retain_mut(|(program, attached)| serve(end, door, program, attached));
    }

    fn turn(&mut self, heard: &mut Vec<Vec<u8>>, now: u64) {
        for bytes in heard.drain(..) {
            let _ = self.end.hears(&bytes);
        }
        self.end.stack.poll(Instant::from_nanos(now), &mut self.end.queue);
    }
}

/// `false`: the program has gone.
fn serve(end: &mut End, door: &mut Door, program: &Socket, attached: &mut Option<Attached>) -> bool {
    let mut packet = [0; 64];
    let mut from = program;
    let len = match from.read(&mut packet) {
        Ok(len) if len > 0 => len,
        Err(error) if error.kind() == ErrorKind::WouldBlock => return true,
        _ => {
            if let Some(attached) = attached.take() {
                let mut visit = door.leave(attached);
                visit.visit(&mut end.stack, &mut end.queue);
                door.finish(visit);
            }
            return false;
        }
    };
    let (answer, opened) = match door.prepare(Ask::parse(&packet[..len]).unwrap(), attached.as_ref()) {
        Ok(mut visit) => {
            visit.visit(&mut end.stack, &mut end.queue);
            door.finish(visit)
        }
        Err(answer) => (answer, None),
    };
    // Who has hung up meanwhile is not told.
    let _ = door::reply(program, &answer, opened.as_ref().map(|(_, descriptors)| descriptors));
    if let Some((now_attached, _)) = opened {
        *attached = Some(now_attached);
    }
    true
}

impl Pair {
    fn new() -> Self {
        let scratch = tempfile::tempdir().unwrap();
        let paths = [0, 1].map(|n| scratch.path().join(format!("{n}.sock")));
        let (seen, stop, held) =
            (Arc::<Seen>::default(), Arc::<AtomicBool>::default(), Arc::<Mutex<()>>::default());
        let sites = [0, 1].map(|n| Site::new(n, &paths[n]));
        let of_thread = (seen.clone(), stop.clone(), held.clone());
        let thread = std::thread::spawn(move || run(sites, &of_thread.0, &of_thread.1, &of_thread.2));
        let stations = paths.each_ref().map(Station::at);
        Self { stations, seen, stop, held, thread: Some(thread), _scratch: scratch }
    }

    /// A socket of each, the second bound to port 36 000.
    fn sockets(&self) -> [UdpSocket; 2] {
        let sockets = self.stations.each_ref().map(|station| station.udp().unwrap());
        sockets[1].bind(any(36_000)).unwrap();
        sockets.iter().for_each(|socket| socket.set_timeout(Some(PATIENCE)));
        sockets
    }

    /// Waits until something holds of what is seen of the second station.
    fn until(&self, what: &str, holds: impl Fn(&Seen) -> bool) {
        let begun = std::time::Instant::now();
        while !holds(&self.seen) {
            assert!(begun.elapsed() < PATIENCE, "{what}");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn end(&mut self) {
        drop(self.stopped());
    }

    /// As if the stations were killed: their connections are closed, and nobody writes that they are gone.
    fn kill(&mut self) {
        self.stopped().into_iter().flatten().for_each(|site| std::mem::forget(site.end));
    }

    fn stopped(&mut self) -> Option<[Site; 2]> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().map(|thread| thread.join().unwrap())
    }
}

impl Drop for Pair {
    fn drop(&mut self) {
        self.end();
    }
}

fn run(mut sites: [Site; 2], seen: &Seen, stop: &AtomicBool, held: &Mutex<()>) -> [Site; 2] {
    let (mut heard, mut turn) = ([Vec::new(), Vec::new()], 0);
    while !stop.load(Ordering::Relaxed) {
        turn += 1;
        let _held = held.lock().unwrap();
        for (number, site) in sites.iter_mut().enumerate() {
            site.admit();
            site.turn(&mut heard[number], turn);
            heard[1 - number] = site.end.sent();
            site.end.stack.rest();
        }
        let second = &mut sites[1].end.stack;
        let lines = second.program_mut::<Lines>().unwrap().counters();
        seen.wakes.store(lines.wakes, Ordering::Relaxed);
        seen.nonsense.store(lines.nonsense, Ordering::Relaxed);
        let free = second.sockets().map(|(_, socket)| socket.pool().available() as u64);
        seen.free.store(free.sum(), Ordering::Relaxed);
        seen.sockets.store(second.sockets().count() as u64, Ordering::Relaxed);
        seen.turns.store(turn, Ordering::Relaxed);
        std::thread::yield_now();
    }
    sites
}

fn any(port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)
}

fn to_second() -> SocketAddrV4 {
    SocketAddrV4::new(IP[1], 36_000)
}

fn number<T>(result: std::io::Result<T>) -> Errno {
    Errno::from_raw(result.err().and_then(|error| error.raw_os_error()).expect("it fails"))
}

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 7 + n / 251) as u8).collect()
}

#[test]
fn programs_of_two_stations_exchange_datagrams() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let port = a.local_addr().unwrap().port();
    let mut room = [0; 64];
    for n in 0..100 {
        a.send_to(&bytes(n % 60), to_second()).unwrap();
        let received = b.receive(&mut room).unwrap();
        assert_eq!(received.from, Sender::Udp(SocketAddrV4::new(IP[0], port)));
        assert_eq!(room[..received.len], bytes(n % 60));
        b.send_to(&room[..received.len], SocketAddrV4::new(IP[0], port)).unwrap();
        assert_eq!(a.receive(&mut room).unwrap().whole, n % 60);
    }
}

#[test]
fn the_longest_datagram_crosses_in_fragments() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    assert_eq!((a.extend(40).unwrap(), b.extend(40).unwrap()), (40, 40));
    let mut room = vec![0; 65_507];
    for _ in 0..20 {
        a.send_to(&bytes(65_507), to_second()).unwrap();
        assert_eq!(b.receive(&mut room).unwrap().len, 65_507);
        assert_eq!(room, bytes(65_507));
    }
    assert_eq!(b.shrink(1_000).unwrap(), 55, "one stays");
    assert_eq!(number(b.shrink(1)), Errno::EBUSY);
    assert_eq!(b.extend(1_000).unwrap(), 255, "as many as there is room for");
    assert_eq!(number(b.extend(1)), Errno::ENOMEM);
}

#[test]
fn what_is_peeked_at_stays_and_what_does_not_fit_is_cut() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    a.send_to(&bytes(100), to_second()).unwrap();
    let mut room = [0; 10];
    let peeked = b.receive_with(&mut room, Flags::PEEK).unwrap();
    assert_eq!((peeked.len, peeked.whole, peeked.is_truncated()), (10, 100, true));
    assert_eq!(b.try_receive(&mut room).unwrap(), peeked);
    assert_eq!(number(b.try_receive(&mut room)), Errno::EAGAIN);
    assert_eq!(number(b.receive_with(&mut room, Flags::DONTWAIT)), Errno::EAGAIN);
    assert_eq!(number(b.receive_with(&mut room, Flags::from_bits(libc::MSG_OOB))), Errno::EOPNOTSUPP);
}

#[test]
fn only_who_sleeps_is_woken() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let mut room = [0; 10];
    let spin = |room: &mut [u8]| loop {
        match b.receive_with(room, Flags::DONTWAIT) {
            Ok(received) => return received,
            Err(_) => std::thread::yield_now(),
        }
    };
    for _ in 0..50 {
        a.send_to(b"awake", to_second()).unwrap();
        spin(&mut room);
    }
    let wakes = || pair.seen.wakes.load(Ordering::Relaxed);
    assert!(wakes() <= 1, "who is awake costs no system call; who has never looked might sleep");
    assert_eq!(number(b.try_receive(&mut room)), Errno::EAGAIN);
    a.send_to(b"asleep", to_second()).unwrap();
    let mut fds = [PollFd::new(b.as_fd(), PollFlags::POLLIN)];
    assert_eq!(poll(&mut fds, PollTimeout::from(20_000u16)), Ok(1));
    assert_eq!(b.try_receive(&mut room).unwrap().len, 6);
    pair.until("it was woken once more", |seen| seen.wakes.load(Ordering::Relaxed) == 2);
}

#[test]
fn who_waits_before_it_has_ever_looked_is_woken() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    a.send_to(b"first", to_second()).unwrap();
    let mut fds = [PollFd::new(b.as_fd(), PollFlags::POLLIN)];
    assert_eq!(poll(&mut fds, PollTimeout::from(20_000u16)), Ok(1));
    assert_eq!(b.try_receive(&mut [0; 10]).unwrap().len, 5);
}

#[test]
fn a_wait_ends_in_time_and_when_another_thread_closes_the_socket() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    b.set_timeout(Some(Duration::from_millis(20)));
    assert_eq!(number(b.receive(&mut [])), Errno::ETIMEDOUT);
    b.set_timeout(None);
    std::thread::scope(|scope| {
        let waiter = scope.spawn(|| b.receive(&mut []));
        std::thread::sleep(Duration::from_millis(20));
        b.close();
        assert_eq!(number(waiter.join().unwrap()), Errno::EBADF);
    });
    assert_eq!(number(b.send_to(b"", to_second())), Errno::EBADF);
    pair.until("the station has closed it, too", |seen| seen.sockets.load(Ordering::Relaxed) == 0);
    a.send_to(b"", to_second()).unwrap();
}

#[test]
fn a_program_that_writes_nonsense_into_its_memory_ends_its_own_line_only() {
    let pair = Pair::new();
    let [a, b] = pair.sockets();
    let hostile = pair.stations[1].udp().unwrap();
    for (word, value) in [(9, 1 << 40), (9, 3)] {
        let hostile = pair.stations[1].udp().unwrap();
        let before = pair.seen.nonsense.load(Ordering::Relaxed);
        hostile.0.memory[word].store(value, Ordering::SeqCst);
        pair.until("it is noticed", |seen| seen.nonsense.load(Ordering::Relaxed) == before + 1);
        assert_eq!(number(hostile.receive(&mut [])), Errno::ENODEV);
    }
    hostile.0.memory.iter().for_each(|word| word.store(u64::MAX, Ordering::SeqCst));
    let mut room = [0; 10];
    a.send_to(b"unharmed", to_second()).unwrap();
    assert_eq!(b.receive(&mut room).unwrap().len, 8);
}

#[test]
fn a_program_has_a_protocol_of_its_own() {
    let pair = Pair::new();
    let own = EtherType(0x88b6);
    let open = |n: usize| -> PacketSocket {
        pair.stations[n].packet(LinkMode::Datagram, LinkType::Only(own)).unwrap()
    };
    let (a, b) = (open(0), open(1));
    b.set_timeout(Some(PATIENCE));
    a.send_to(&bytes(100), address(1), own).unwrap();
    let mut room = [0; 200];
    let received = b.receive(&mut room).unwrap();
    let Sender::Link(from) = received.from else { panic!("{received:?}") };
    assert_eq!((from.address, from.ether_type, received.len), (address(0), own, 100));
    assert_eq!(Answer::DONE.errno, 0);
}

mod time;
