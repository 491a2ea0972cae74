//! What comes to sockets from a medium that lies, and what programs ask that cannot be.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use pnet_packet::Packet;
use pnet_packet::ipv4::Ipv4Packet;
use pnet_packet::udp::UdpPacket;
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::socket::{Flags, LinkMode, LinkType, Options, Socket, SocketError, SocketId};
use rtnet::time::Span;
use rtnet::wire::ethernet::{EtherType, HEADER_LEN};
use tests::ends::{A, B, C, End, mend, pair};

const PORT: u16 = 36_000;
/// Where the IP header's fields are in a frame.
const TOTAL_LEN: usize = HEADER_LEN + 2;
const FLAGS_OFFSET: usize = HEADER_LEN + 6;
const TTL: usize = HEADER_LEN + 8;
const CONTENT: usize = HEADER_LEN + 20;

/// What B sends to A's socket.
fn sent(len: usize) -> Vec<Vec<u8>> {
    let (_, mut b) = pair();
    let from = b.socket(5_000, 64);
    let data: Vec<u8> = (0..len).map(|at| (at + at / 251) as u8).collect();
    b.send(from, &data, Some(SocketAddrV4::new(A.1, PORT))).expect("room");
    b.leaves(usize::MAX)
}

/// A with a socket.
fn hearing() -> (End, SocketId) {
    let (mut a, _) = pair();
    let socket = a.socket(PORT, 16);
    (a, socket)
}

fn word(frame: &mut [u8], at: usize, value: u16) {
    frame[at..at + 2].copy_from_slice(&value.to_be_bytes());
}

/// The frame with this word of its IP header, and checksums that are right.
fn with(frame: &[u8], at: usize, value: u16) -> Vec<u8> {
    let mut frame = frame.to_vec();
    word(&mut frame, at, value);
    mend(&mut frame[HEADER_LEN..]);
    frame
}

/// The same packet with these options in its IP header.
fn with_options(frame: &[u8], options: &[u8]) -> Vec<u8> {
    let total = u16::from_be_bytes([frame[TOTAL_LEN], frame[TOTAL_LEN + 1]]);
    let mut longer = [&frame[..CONTENT], options, &frame[CONTENT..]].concat();
    longer[HEADER_LEN] += (options.len() / 4) as u8;
    with(&longer, TOTAL_LEN, total + options.len() as u16)
}

fn read(a: &mut End, socket: SocketId) -> Option<Vec<u8>> {
    let came = a.receive(socket, 65_536, Flags::NONE).ok().map(|(_, data)| data);
    a.check_buffers();
    came
}

/// What was refused of these frames.
fn refused(a: &mut End, frames: &[Vec<u8>]) -> Vec<Refusal> {
    frames.iter().filter_map(|frame| a.hears(frame).err()).collect()
}

#[test]
fn every_part_of_every_frame_that_a_station_takes_is_refused_and_nothing_is_kept_of_it() {
    let (mut a, mut b) = pair();
    let socket = a.socket(PORT, 16);
    b.stack.solicit(A.1, &mut b.queue).unwrap();
    b.stack.ask_echo(A.1, (1, 1), &[7; 80], Options::default(), &mut b.queue).unwrap();
    let frames = [sent(80), sent(3_000), b.leaves(2)].concat();
    for frame in &frames {
        let is_arp = frame[12..HEADER_LEN] == EtherType::ARP.0.to_be_bytes();
        // An ARP packet has padding, of which nobody misses any.
        let end = if is_arp { HEADER_LEN + 28 } else { frame.len() };
        for len in 0..end {
            let expected = if len < HEADER_LEN { Refusal::Runt } else { Refusal::Truncated };
            let reason = a.hears(&frame[..len]).unwrap_err();
            let is_whole_header = !is_arp && len >= CONTENT;
            assert_eq!(reason, if is_whole_header { Refusal::IpLength } else { expected }, "{len} bytes");
        }
    }
    assert_eq!((read(&mut a, socket), a.queue.waiting.len()), (None, 0));
    assert_eq!(a.stack.collecting(socket), 0);
}

#[test]
fn every_bit_of_a_packet_that_is_changed_on_the_way_is_noticed() {
    let (mut a, socket) = hearing();
    let frame = sent(40).remove(0);
    for bit in HEADER_LEN * 8..frame.len() * 8 {
        let mut changed = frame.clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert!(a.hears(&changed).is_err(), "bit {bit}");
    }
    assert_eq!(read(&mut a, socket), None);
    a.hears(&frame).unwrap();
    assert_eq!(read(&mut a, socket).unwrap().len(), 40);
}

#[test]
fn a_fragment_that_is_cut_short_on_the_way_ends_its_datagram_and_no_other() {
    let (mut a, socket) = hearing();
    let frames = sent(5_000);
    for cut in 0..frames.len() {
        let mut short = frames.clone();
        let len = short[cut].len() - 1;
        short[cut].truncate(len);
        let reasons = refused(&mut a, &short);
        assert_eq!(reasons[0], Refusal::IpLength, "{cut}");
        let then = if cut == 0 { Refusal::FragmentOrphan } else { Refusal::FragmentOrder };
        assert!(reasons.get(1).is_none_or(|&second| second == then), "{cut}: {reasons:?}");
        assert_eq!(read(&mut a, socket), None, "{cut}");
        // The same datagram again: what came before the cut is there already, unless it was given up.
        let there = if cut + 1 == frames.len() { cut } else { 0 };
        assert_eq!(refused(&mut a, &frames), vec![Refusal::FragmentRepeated; there], "{cut}");
        assert_eq!(read(&mut a, socket).unwrap().len(), 5_000, "{cut}");
    }
}

#[test]
fn fragments_that_overlap_or_leave_a_hole_are_never_put_together() {
    let frames = sent(5_000);
    let at = |frame: &[u8], units: i32| {
        let field = u16::from_be_bytes([frame[FLAGS_OFFSET], frame[FLAGS_OFFSET + 1]]);
        with(frame, FLAGS_OFFSET, (i32::from(field) + units) as u16)
    };
    // The whole second one again, all but a unit of it, a unit too few or too many, and far away.
    for units in [-185, -184, -1, 1, 184, 185, 6_000] {
        for lying in 1..frames.len() {
            let (mut a, socket) = hearing();
            let mut changed = frames.clone();
            changed[lying] = at(&changed[lying], units);
            let reasons = refused(&mut a, &changed);
            // What begins where the datagram does says what port it is for.
            let known =
                [Refusal::FragmentOrder, Refusal::FragmentOrphan, Refusal::UdpLength, Refusal::NoSocket];
            assert!(reasons.iter().all(|reason| known.contains(reason)), "{reasons:?}");
            assert!(!reasons.is_empty() && read(&mut a, socket).is_none(), "{lying} by {units}");
            a.check_all_comes_home();
        }
    }
}

#[test]
fn fragments_beyond_the_longest_datagram_are_refused_before_they_are_kept() {
    let (mut a, socket) = hearing();
    let frames = sent(3_000);
    a.hears(&frames[0]).unwrap();
    let held = a.stack.collecting(socket);
    for units in [8_005, 8_100, 0x1fff] {
        for more in [0, 0x2000] {
            assert_eq!(a.hears(&with(&frames[1], FLAGS_OFFSET, more | units)), Err(Refusal::IpFragment));
        }
    }
    assert_eq!(a.stack.collecting(socket), held);
    assert_eq!(refused(&mut a, &frames[1..]), []);
    assert_eq!(read(&mut a, socket).unwrap().len(), 3_000, "who was waited for still comes");
}

#[test]
fn lengths_that_lie_never_show_what_was_not_sent() {
    let (mut a, socket) = hearing();
    let frame = sent(40).remove(0);
    let there = (frame.len() - HEADER_LEN) as u16;
    for total in 0..=u16::MAX {
        let heard = a.hears(&with(&frame, TOTAL_LEN, total));
        let reason = match total {
            0..20 => Refusal::IpLength,
            20..28 => Refusal::Truncated,
            68 => continue,
            28..68 => Refusal::UdpLength,
            _ if total <= there => continue,
            _ => Refusal::IpLength,
        };
        assert_eq!(heard, Err(reason), "{total}");
    }
    while read(&mut a, socket).is_some() {}
    for udp_len in 0..=u16::MAX {
        let lying = with(&frame, CONTENT + 4, udp_len);
        match a.hears(&lying) {
            Err(reason) => assert_eq!((reason, (8..=48).contains(&udp_len)), (Refusal::UdpLength, false)),
            Ok(()) => {
                let packet = Ipv4Packet::new(&lying[HEADER_LEN..]).expect("a whole packet");
                let theirs = UdpPacket::new(packet.payload()).expect("a whole header");
                assert_eq!(usize::from(theirs.get_length()), usize::from(udp_len));
                let data = &frame[CONTENT + 8..][..usize::from(udp_len) - 8];
                assert_eq!(read(&mut a, socket).as_deref(), Some(data), "as much as another decoder has");
            }
        }
    }
}

#[test]
fn options_are_skipped_in_datagrams_fragments_and_echoes_and_never_followed() {
    let (mut a, mut b) = pair();
    let socket = a.socket(PORT, 16);
    // Loose source route by C, record route, and ends.
    for options in
        [&[131, 7, 4, 10, 0, 0, 7, 0][..], &[7, 39, 4].repeat(12)[..], &[1; 40], &[0; 4], &[0xff; 40]]
    {
        let whole = with_options(&sent(40)[0], options);
        a.hears(&whole).unwrap();
        assert_eq!(read(&mut a, socket).unwrap().len(), 40);
        let frames: Vec<_> = sent(2_000).iter().map(|frame| with_options(frame, options)).collect();
        let short: Vec<_> = frames.iter().filter(|frame| frame.len() <= 1_514).cloned().collect();
        if short.len() == frames.len() {
            assert_eq!(refused(&mut a, &frames), []);
            assert_eq!(read(&mut a, socket).unwrap().len(), 2_000);
        }
        b.stack.ask_echo(A.1, (1, 1), &[7; 16], Options::default(), &mut b.queue).unwrap();
        a.hears(&with_options(&b.leaves(1)[0], options)).unwrap();
        let answer = a.leaves(1).remove(0);
        assert_eq!(
            (answer[..6].to_vec(), answer[HEADER_LEN]),
            (B.0.0.to_vec(), 0x45),
            "to who asked, without"
        );
    }
    let mut too_long = with_options(&sent(40)[0], &[1; 40]);
    let cut = HEADER_LEN + 40;
    too_long.truncate(cut);
    assert_eq!(a.hears(&too_long), Err(Refusal::IpHeaderLength));
}

#[test]
fn a_packet_without_a_hop_left_is_refused_whatever_is_in_it() {
    let (mut a, mut b) = pair();
    let socket = a.socket(PORT, 16);
    b.stack.ask_echo(A.1, (1, 1), &[], Options::default(), &mut b.queue).unwrap();
    for frame in [sent(40), sent(3_000), b.leaves(1)].concat() {
        let protocol = u16::from(frame[TTL + 1]);
        assert_eq!(a.hears(&with(&frame, TTL, protocol)), Err(Refusal::IpTtl));
        a.hears(&with(&frame, TTL, 1 << 8 | protocol)).unwrap();
    }
    assert_eq!(read(&mut a, socket).unwrap().len(), 40);
}

#[test]
fn a_datagram_whose_rest_comes_after_the_time_out_is_none() {
    let (mut a, socket) = hearing();
    let frames = sent(3_000);
    assert_eq!(refused(&mut a, &frames[..2]), []);
    a.waits(Span::from_millis(1_001));
    assert_eq!(refused(&mut a, &frames[2..]), [Refusal::FragmentOrphan]);
    assert_eq!((read(&mut a, socket), a.stack.collecting(socket)), (None, 0));
}

#[test]
fn each_mistake_of_a_program_has_its_number_and_leaves_nothing_behind() {
    let (mut a, mut udp) = hearing();
    let to = |ip, port| Some(SocketAddrV4::new(ip, port));
    let packet = Socket::packet(LinkMode::Raw, LinkType::Nothing, Arc::new(Pool::new(2)));
    let packet = a.open(packet).unwrap();
    let second = a.socket(7_000, 2);
    let any = |port| SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port);
    let automatic = a.open(Socket::udp(Arc::new(Pool::new(1)))).unwrap();
    let lethal = [&B.0.0[..], &A.0.0, &EtherType::RTMAC.0.to_be_bytes(), &[0; 46]].concat();
    let number = |expected: i32, result: Result<(), SocketError>| {
        assert_eq!(
            result.map_err(|error| (error.errno(), error.to_string().is_empty())),
            Err((expected, false))
        );
    };
    number(libc::EADDRINUSE, a.stack.bind(automatic, any(PORT)));
    number(libc::EINVAL, a.stack.bind(udp, any(1)));
    number(libc::EADDRNOTAVAIL, a.stack.bind(automatic, SocketAddrV4::new(C.1, 1)));
    number(libc::EHOSTUNREACH, a.send(udp, b"", to(C.1, 1)));
    number(libc::EMSGSIZE, a.send(udp, &[0; 65_508], to(B.1, 1)));
    number(libc::EMSGSIZE, a.send(second, &[0; 4_000], to(B.1, 1)));
    number(libc::ENOTCONN, a.send(udp, b"", None));
    number(libc::EINVAL, a.send(udp, b"", to(B.1, 0)));
    number(libc::EOPNOTSUPP, a.send(packet, b"", to(B.1, 1)));
    number(libc::EOPNOTSUPP, a.send_frame(udp, &[0; 60], None));
    number(libc::EPERM, a.send_frame(packet, &lethal, None));
    number(libc::EMSGSIZE, a.send_frame(packet, &[0; 1_515], None));
    number(libc::EINVAL, a.send_frame(packet, &[0; 13], None));
    for (bits, expected) in [(libc::MSG_OOB, libc::EOPNOTSUPP), (libc::MSG_TRUNC, libc::EINVAL)] {
        number(expected, a.receive(udp, 1, Flags::from_bits(bits)).map(drop));
    }
    number(libc::EAGAIN, a.receive(udp, 1, Flags::DONTWAIT).map(drop));
    a.close(udp).unwrap();
    number(libc::EBADF, a.send(udp, b"", to(B.1, 1)));
    number(libc::EBADF, a.close(udp));
    udp = a.socket(PORT, 1);
    a.send(udp, b"", to(B.1, 1)).unwrap();
    number(libc::ENOBUFS, a.send(udp, b"", to(B.1, 1)));
    assert_eq!(a.leaves(usize::MAX).len(), 1, "nothing left of what was refused");
    a.check_all_comes_home();
}
