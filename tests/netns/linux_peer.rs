//! A plain Linux host as the peer of a station: nothing but the kernel's own stack, which knows where the station is.

use std::net::{SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::UdpGsoSegment;
use rtmac::token::{Ring, RingConfig, Token};
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::clock::EmulatedClock;
use rtnet::direct::Direct;
use rtnet::discipline::Discipline;
use rtnet::time::Span;
use socket2::{Domain, Protocol, Socket, Type};
use tests::host::alone;

use crate::live::{CYCLE, master_of};
use crate::with_sockets::{HOST_IP, PORT, Pair, STATION, STATION_IP};

const PATIENCE: Duration = Duration::from_secs(30);
/// A busy host loses some; then the test asks again.
const AGAIN: Duration = Duration::from_secs(2);
/// Whom the kernel lets send echoes: every group.
const PING: (&str, &str) = ("/proc/sys/net/ipv4/ping_group_range", "0 2147483647");

/// Of one packet, with and without padding, the longest of one, the shortest of two, and more of several.
const LENGTHS: [usize; 6] = [0, 1, 100, 1_472, 1_473, 30_000];

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 7 + n / 251) as u8).collect()
}

/// The kernel's sockets on the host: one of UDP's, and one for echoes.
fn sockets<D: Discipline + 'static>(pair: &Pair<D>) -> (UdpSocket, UdpSocket) {
    let mut netlink = pair.host.netlink().unwrap();
    let index = netlink.link_index("rt0").unwrap();
    netlink.add_address(index, HOST_IP, 24).unwrap();
    netlink.add_neighbour(index, STATION_IP, STATION).unwrap();
    let open = || {
        std::fs::write(PING.0, PING.1).unwrap();
        let echo = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::ICMPV4)).unwrap();
        (UdpSocket::bind((HOST_IP, 0)).unwrap(), echo.into())
    };
    let (udp, echo): (UdpSocket, UdpSocket) = pair.host.run(open).unwrap();
    for socket in [&udp, &echo] {
        socket.set_read_timeout(Some(AGAIN)).unwrap();
    }
    (udp, echo)
}

/// Sends until the answer comes that is waited for.
fn exchange(socket: &UdpSocket, to: SocketAddrV4, question: &[u8], is_answer: impl Fn(&[u8]) -> bool) {
    let (deadline, mut room) = (Instant::now() + PATIENCE, vec![0; 65_536]);
    loop {
        socket.send_to(question, to).unwrap();
        while let Ok((len, from)) = socket.recv_from(&mut room) {
            assert_eq!(from.ip(), STATION_IP);
            if is_answer(&room[..len]) {
                return;
            }
        }
        assert!(Instant::now() < deadline, "no answer to {} bytes", question.len());
    }
}

fn converse<D: Discipline + 'static>(
    discipline: impl FnOnce(rtnet::wire::ethernet::Address) -> D,
    longest: usize,
) {
    let pair = Pair::start(discipline);
    let (udp, echo) = sockets(&pair);
    for len in LENGTHS.into_iter().chain([longest]) {
        let data = bytes(len);
        exchange(&udp, SocketAddrV4::new(STATION_IP, PORT), &data, |answer| answer == data);
    }
    for (sequence, len) in [(1, 0), (2, 56), (3, 1_472)] {
        let question = [&[8, 0, 0, 0, 0, 0, 0, sequence], &bytes(len)[..]].concat();
        // The kernel writes identifier and checksum.
        let is_answer = |answer: &[u8]| answer[0] == 0 && answer[6..] == question[6..];
        exchange(&echo, SocketAddrV4::new(STATION_IP, 0), &question, is_answer);
    }
}

#[test]
fn a_linux_host_and_a_station_without_slots_exchange_datagrams_up_to_the_longest_and_echoes() {
    alone("a_linux_host_and_a_station_without_slots_exchange_datagrams_up_to_the_longest_and_echoes", || {
        converse(|_| Direct::new(DEFAULT_ASK_EVERY), 65_507);
    });
}

#[test]
fn a_linux_host_and_a_station_in_a_ring_exchange_datagrams_in_fragments_and_echoes() {
    alone("a_linux_host_and_a_station_in_a_ring_exchange_datagrams_in_fragments_and_echoes", || {
        // A ring of one station: the Linux host has no token, and answers at any time.
        let ring = |address| Ring::new(RingConfig::new(vec![address]), address).unwrap();
        converse(|address| Token::new(ring(address)), 65_507);
    });
}

#[test]
fn a_linux_host_and_a_station_with_slots_exchange_datagrams_in_fragments_and_echoes() {
    alone("a_linux_host_and_a_station_with_slots_exchange_datagrams_in_fragments_and_echoes", || {
        let clock = EmulatedClock::default();
        converse(|address| master_of(CYCLE, address, &clock, Span::from_millis(2), 1_500), 65_507);
    });
}

/// Datagrams that the kernel would cut for a program, or a card for the kernel; here nobody has cut them. Each datagram comes back as it was
/// meant.
fn uncut<D: Discipline + 'static>(discipline: impl FnOnce(rtnet::wire::ethernet::Address) -> D) {
    let pair = Pair::start(discipline);
    let (udp, _) = sockets(&pair);
    for (len, size, times) in [(5_000, 1_000, 5), (1_300, 1_000, 2), (48, 1, 48), (20_000, 1_472, 14)] {
        setsockopt(&udp, UdpGsoSegment, &size).unwrap();
        let (data, deadline) = (bytes(len), Instant::now() + PATIENCE);
        let meant: Vec<_> = data.chunks(size as usize).map(<[u8]>::to_vec).collect();
        assert_eq!(meant.len(), times);
        let mut room = vec![0; 65_536];
        loop {
            udp.send_to(&data, (STATION_IP, PORT)).unwrap();
            let mut answers = Vec::new();
            while answers.len() < times
                && let Ok(len) = udp.recv(&mut room)
            {
                answers.push(room[..len].to_vec());
            }
            if answers == meant {
                break;
            }
            assert!(
                Instant::now() < deadline,
                "{len} bytes in {size} each: {:?}",
                answers.iter().map(Vec::len)
            );
            // A busy host loses some: what is still on its way is of this try.
            while udp.recv(&mut room).is_ok() {}
        }
    }
}

#[test]
fn uncut_datagrams_come_as_they_were_meant_without_slots() {
    alone("uncut_datagrams_come_as_they_were_meant_without_slots", || {
        uncut(|_| Direct::new(DEFAULT_ASK_EVERY))
    });
}

#[test]
fn uncut_datagrams_come_as_they_were_meant_with_slots() {
    alone("uncut_datagrams_come_as_they_were_meant_with_slots", || {
        let clock = EmulatedClock::default();
        uncut(|address| master_of(CYCLE, address, &clock, Span::from_millis(2), 1_500));
    });
}

#[test]
fn jumbo_frames_of_a_linux_host_are_taken() {
    alone("jumbo_frames_of_a_linux_host_are_taken", || {
        let pair = Pair::start(|_| Direct::new(DEFAULT_ASK_EVERY));
        pair.set_mtu(9_000);
        let (udp, _) = sockets(&pair);
        for len in [100, 1_472, 1_473, 8_972, 30_000] {
            let data = bytes(len);
            exchange(&udp, SocketAddrV4::new(STATION_IP, PORT), &data, |answer| answer == data);
        }
    });
}
