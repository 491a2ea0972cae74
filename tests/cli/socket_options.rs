//! What `rtnet station` is told of its sockets at the start, and what comes of it: their number, their ports, checksums of
//! datagrams in fragments, and how long a lost tail is waited for.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use rtnet::api::{PacketSocket, Station as Attached, UdpSocket};
use rtnet::socket::{Flags, LinkMode, LinkType};
use rtnet::wire::ethernet::{Address, EtherType, Header};
use rtnet::wire::ipv4::{self, Fields, Protocol};
use rtnet::wire::udp;
use serde_json::Value;
use zerocopy::IntoBytes;

use crate::host::{shared, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

const ADDRESS: [Address; 2] = [Address([2, 0, 0, 0, 0, 0xa]), Address([2, 0, 0, 0, 0, 0xb])];
const IP: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(10, 0, 0, 2)];
const PORT: u16 = 36_000;
const FROM: u16 = 1_024;
/// Bytes of the datagrams, and of what is in each of their two fragments.
const DATA: [u8; 200] = [7; 200];
const EACH: usize = 104;

/// Two stations on one medium, which differ by some options only.
struct Two {
    names: [String; 2],
    _stations: [Station; 2],
    _medium: Medium,
}

impl Two {
    fn start(what: &str, options: [&[&str]; 2]) -> Self {
        let medium = Medium::new();
        let names = [0, 1].map(|n| unique(&format!("{what}-{n}")));
        let start = |n: usize, namespace| {
            let ip = format!("{}/24", IP[n]);
            let usual = ["--interface", "rt0", "--discipline", "direct", "--name", &names[n], "--ip", &ip];
            let station = Station::start(namespace, &[&usual, options[n]].concat());
            station.wait_for("Ctrl-C ends it");
            station
        };
        let stations = [start(0, &medium.a), start(1, &medium.b)];
        Self { names, _stations: stations, _medium: medium }
    }

    fn open(&self, n: usize) -> std::io::Result<UdpSocket> {
        Attached::named(&self.names[n])?.udp()
    }

    /// One that hears at [`PORT`].
    fn bound(&self, n: usize) -> UdpSocket {
        let socket = self.open(n).unwrap();
        socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)).unwrap();
        socket.set_timeout(Some(PATIENCE));
        socket
    }

    /// What sends whole frames as another station might.
    fn frames(&self, n: usize) -> PacketSocket {
        let station = Attached::named(&self.names[n]).unwrap();
        station.packet(LinkMode::Raw, LinkType::Nothing).unwrap()
    }

    fn stat(&self, n: usize) -> Value {
        let output = rtnet().args(["stat", "-S", &self.names[n], "--json"]).output().unwrap();
        crate::schema::read(&output.stdout)
    }

    /// Waits until a count of a station is this.
    fn counts(&self, n: usize, [group, count]: [&str; 2], expected: u64) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let stat = self.stat(n);
            if stat[group][count] == expected {
                return;
            }
            assert!(Instant::now() < deadline, "{expected} {count}: {stat:#}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Both fragments of a datagram to station `to`; its checksum is right, or not.
fn fragments(to: usize, identification: u16, is_right: bool) -> [Vec<u8>; 2] {
    let from = 1 - to;
    let mut header = udp::Header::new(FROM, PORT, DATA.len() as u16);
    let mut sum = udp::pseudo_header(IP[from], IP[to], header.len());
    sum.add(header.as_bytes());
    sum.add(&DATA);
    // Neither none, nor another way to write the right one.
    header.set_checksum(udp::to_field(sum) ^ if is_right { 0 } else { 0x0101 });
    let datagram = [header.as_bytes(), &DATA].concat();
    [0, EACH].map(|offset| {
        let packet = ipv4::Header::new(&Fields {
            source: IP[from],
            destination: IP[to],
            protocol: Protocol::UDP,
            tos: 0,
            identification,
            dont_fragment: false,
            more_fragments: offset == 0,
            offset: offset as u16,
            payload_len: EACH as u16,
        });
        let link = Header::new(ADDRESS[to], ADDRESS[from], EtherType::IPV4);
        [link.as_bytes(), packet.as_bytes(), &datagram[offset..offset + EACH]].concat()
    })
}

fn number<T>(result: std::io::Result<T>) -> Errno {
    Errno::from_raw(result.err().and_then(|error| error.raw_os_error()).expect("it fails"))
}

#[test]
fn wrong_checksums_of_fragmented_datagrams_are_let_in_and_counted_unless_strict() {
    shared("wrong_checksums_of_fragmented_datagrams_are_let_in_and_counted_unless_strict", || {
        let two = Two::start("strict", [&[], &["--strict-checksums"]]);
        let (lenient, strict) = (two.bound(0), two.bound(1));
        let send = |to: usize, identification, is_right| {
            let frames = two.frames(1 - to);
            fragments(to, identification, is_right).iter().for_each(|frame| frames.send(frame).unwrap());
        };
        let mut room = [0; 300];
        send(0, 1, false);
        assert_eq!(lenient.receive(&mut room).unwrap().whole, DATA.len());
        assert_eq!(room[..DATA.len()], DATA);
        two.counts(0, ["stack", "checksums_tolerated"], 1);

        send(1, 1, false);
        two.counts(1, ["refused", "udp_checksum"], 1);
        assert_eq!(number(strict.receive_with(&mut room, Flags::DONTWAIT)), Errno::EAGAIN);
        send(1, 2, true);
        assert_eq!(strict.receive(&mut room).unwrap().whole, DATA.len(), "what is right is let in");
        assert_eq!(two.stat(1)["stack"]["checksums_tolerated"], 0);
    });
}

#[test]
fn a_lost_tail_is_given_up_after_the_time_that_was_said_at_the_start() {
    shared("a_lost_tail_is_given_up_after_the_time_that_was_said_at_the_start", || {
        let waits = [&["--fragment-timeout", "4s"], &["--fragment-timeout", "1000s"]];
        let two = Two::start("tails", waits.map(|options| &options[..]));
        let (short, long) = (two.bound(0), two.bound(1));
        let frames = [two.frames(1), two.frames(0)];
        let both = [0, 1].map(|to| fragments(to, 1, true));
        // First to who waits longer: once the other has given up, this one has waited longer, too.
        for to in [1, 0] {
            frames[to].send(&both[to][0]).unwrap();
        }
        // One that was told nothing waits for a second.
        std::thread::sleep(Duration::from_millis(1_500));
        assert_eq!([0, 1].map(|n| two.stat(n)["stack"]["fragments_timed_out"].clone()), [0, 0]);
        two.counts(0, ["stack", "fragments_timed_out"], 1);
        for to in [1, 0] {
            frames[to].send(&both[to][1]).unwrap();
        }
        let mut room = [0; 300];
        assert_eq!(long.receive(&mut room).unwrap().whole, DATA.len(), "it is waited for");
        assert_eq!(two.stat(1)["stack"]["fragments_timed_out"], 0);
        two.counts(0, ["refused", "fragment_orphan"], 1);
        assert_eq!(number(short.receive_with(&mut room, Flags::DONTWAIT)), Errno::EAGAIN);
    });
}

#[test]
fn automatic_ports_are_of_the_range_that_was_said_at_the_start() {
    shared("automatic_ports_are_of_the_range_that_was_said_at_the_start", || {
        let two = Two::start("ports", [&["--ports", "2000-2002"], &[]]);
        let sockets: Vec<UdpSocket> = (0..3).map(|_| two.open(0).unwrap()).collect();
        let mut ports: Vec<u16> = sockets.iter().map(|socket| socket.local_addr().unwrap().port()).collect();
        ports.sort();
        assert_eq!(ports, [2_000, 2_001, 2_002]);
        assert_eq!(number(two.open(0)), Errno::EAGAIN, "there is no other port");
        assert_eq!(two.open(1).unwrap().local_addr().unwrap().port(), 1_024, "of one that was told nothing");
    });
}

#[test]
fn a_socket_more_than_was_said_at_the_start_is_refused() {
    shared("a_socket_more_than_was_said_at_the_start_is_refused", || {
        let two = Two::start("most", [&["--sockets", "3"], &["--sockets", "5"]]);
        for (n, most) in [(0, 3), (1, 5)] {
            let mut sockets: Vec<UdpSocket> = (0..most).map(|_| two.open(n).unwrap()).collect();
            assert_eq!(number(two.open(n)), Errno::EAGAIN, "{most} are there");
            sockets.pop();
            let deadline = Instant::now() + PATIENCE;
            while two.open(n).is_err() {
                assert!(Instant::now() < deadline, "there is room for one again");
                std::thread::sleep(Duration::from_millis(5));
            }
        }
    });
}
