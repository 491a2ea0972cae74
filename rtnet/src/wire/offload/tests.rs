use pnet_packet::Packet;
use pnet_packet::ipv4::{self as their_ipv4, Ipv4Packet};
use pnet_packet::tcp::{self as their_tcp, TcpPacket};
use pnet_packet::udp::UdpPacket;
use proptest::prelude::*;

use super::*;

const LINK: [u8; ethernet::HEADER_LEN] = [2, 0, 0, 0, 0, 2, 2, 0, 0, 0, 0, 1, 8, 0];

fn offload(gso_type: u8, gso_size: u16) -> Offload {
    Offload { flags: NEEDS_SUM, gso_type, header_len: 0, gso_size, sum_start: 34, sum_offset: 6 }
}

/// A frame as a kernel leaves it: one IP packet around a transport header and this payload, of any length.
fn frame(protocol: u8, transport: &[u8], payload: &[u8]) -> Vec<u8> {
    let total = (20 + transport.len() + payload.len()) as u16;
    let [high, low] = total.to_be_bytes();
    let ip = [0x45, 0, high, low, 0xff, 0xff, 0x40, 0, 64, protocol, 0, 0, 10, 0, 0, 1, 10, 0, 0, 2];
    [&LINK[..], &ip, transport, payload].concat()
}

fn udp(payload: &[u8]) -> Vec<u8> {
    let [high, low] = ((8 + payload.len()) as u16).to_be_bytes();
    frame(17, &[0x10, 0, 0x20, 0, high, low, 0xab, 0xcd], payload)
}

/// With all flags set, and 12 bytes of options.
fn tcp(sequence: u32, payload: &[u8]) -> Vec<u8> {
    let mut head = vec![0; 32];
    head[..4].copy_from_slice(&[0x10, 0, 0x20, 0]);
    head[4..8].copy_from_slice(&sequence.to_be_bytes());
    (head[12], head[13]) = (0x80, 0xff);
    frame(6, &head, payload)
}

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 7 + n / 251) as u8).collect()
}

/// The frames that were meant.
fn cut(offload: &Offload, uncut: &[u8]) -> Result<Vec<Vec<u8>>, CannotCut> {
    let cut = offload.cut(uncut)?;
    let mut room = [0; ROOM];
    let frames = (0..cut.count()).map(|number| {
        let len = cut.write(uncut, number, &mut room);
        room[..len].to_vec()
    });
    Ok(frames.collect())
}

/// Its IP packet, which is sound by another's judgement.
fn packet(frame: &[u8]) -> Ipv4Packet<'_> {
    let packet = Ipv4Packet::new(&frame[ethernet::HEADER_LEN..]).unwrap();
    assert_eq!(packet.get_checksum(), their_ipv4::checksum(&packet));
    assert_eq!(usize::from(packet.get_total_length()), packet.packet().len());
    packet
}

#[test]
fn an_uncut_datagram_becomes_those_that_were_sent() {
    let uncut = udp(&bytes(2_300));
    let frames = cut(&offload(UDP, 1_000), &uncut).unwrap();
    let lens: Vec<_> = frames.iter().map(|frame| frame.len() - 42).collect();
    assert_eq!(lens, [1_000, 1_000, 300]);
    for (n, frame) in frames.iter().enumerate() {
        assert_eq!(frame[..14], LINK);
        let packet = packet(frame);
        assert_eq!(packet.get_identification(), 0xffff_u16.wrapping_add(n as u16));
        let datagram = UdpPacket::new(packet.payload()).unwrap();
        let ports = (datagram.get_source(), datagram.get_destination(), datagram.get_checksum());
        assert_eq!(ports, (0x1000, 0x2000, 0), "no checksum, and it says so");
        assert_eq!(usize::from(datagram.get_length()), 8 + lens[n]);
        let begin = n * 1_000;
        assert_eq!(datagram.payload(), &bytes(2_300)[begin..begin + lens[n]]);
    }
}

#[test]
fn an_uncut_segment_becomes_those_that_were_sent() {
    let frames = cut(&offload(TCP | ECN, 1_000), &tcp(u32::MAX - 500, &bytes(2_300))).unwrap();
    let mut seen = Vec::new();
    for frame in &frames {
        let packet = packet(frame);
        let segment = TcpPacket::new(packet.payload()).unwrap();
        let sum = their_tcp::ipv4_checksum(&segment, &packet.get_source(), &packet.get_destination());
        assert_eq!(segment.get_checksum(), sum);
        seen.push((segment.get_sequence(), segment.get_flags(), segment.payload().to_vec()));
    }
    let [first, second, third] = &seen[..] else { panic!("{} segments", seen.len()) };
    let sequences = [first.0, second.0, third.0];
    assert_eq!(sequences, [0, 1_000, 2_000].map(|n| (u32::MAX - 500).wrapping_add(n)));
    // FIN and PSH at the end, CWR at the begin.
    assert_eq!([first.1, second.1, third.1], [0xf6, 0x76, 0x7f]);
    assert_eq!([&first.2[..], &second.2, &third.2].concat(), bytes(2_300));
}

#[test]
fn missing_checksum_is_completed_and_udp_has_none() {
    // A kernel leaves the pseudo header's part in the field.
    let mut segment = tcp(1, &bytes(333));
    let part = {
        let mut sum = Checksum::new();
        sum.add(&segment[26..34]);
        sum.add(&[0, 6]);
        sum.add(&((segment.len() - 34) as u16).to_be_bytes());
        !sum.finish()
    };
    put(&mut segment, 50, part);
    let ip_sum = checksum(&segment[14..34]);
    put(&mut segment, 24, ip_sum);
    Offload { sum_offset: 16, ..offload(WHOLE, 0) }.complete(&mut segment);
    let packet = packet(&segment);
    let tcp = TcpPacket::new(packet.payload()).unwrap();
    let sum = their_tcp::ipv4_checksum(&tcp, &packet.get_source(), &packet.get_destination());
    assert_eq!(tcp.get_checksum(), sum);

    let mut datagram = udp(&bytes(100));
    offload(WHOLE, 0).complete(&mut datagram);
    assert_eq!(datagram[40..42], [0, 0]);
    let mut right = udp(&bytes(100));
    Offload { flags: 0, ..offload(WHOLE, 0) }.complete(&mut right);
    assert_eq!(right, udp(&bytes(100)), "nothing is left to do");
}

#[test]
fn what_nobody_here_can_cut_is_refused() {
    let (datagram, segment) = (udp(&bytes(3_000)), tcp(1, &bytes(3_000)));
    let mut other = datagram.clone();
    (other[12], other[13]) = (0x86, 0xdd);
    let mut short = datagram.clone();
    short[14] = 0x44;
    for (why, offload, frame) in [
        ("TCP over IPv6", offload(4, 1_000), &segment),
        ("UDP fragments of old kernels", offload(3, 1_000), &datagram),
        ("UDP that says TCP", offload(TCP, 1_000), &datagram),
        ("TCP that says UDP", offload(UDP, 1_000), &segment),
        ("of no size", offload(UDP, 0), &datagram),
        ("longer than a frame", offload(UDP, 1_473), &datagram),
        ("another EtherType", offload(UDP, 1_000), &other),
        ("an IP header without its end", offload(UDP, 1_000), &short),
        ("nothing behind the header", offload(UDP, 1_000), &datagram[..42].to_vec()),
    ] {
        assert_eq!(cut(&offload, frame), Err(CannotCut), "{why}");
    }
    assert!(cut(&offload(UDP, 1_472), &datagram).is_ok());
}

#[test]
fn a_jumbo_frame_becomes_the_fragments_of_its_packet() {
    let mut jumbo = udp(&bytes(4_000));
    for (flags, base) in [([0x40, 0], 0), ([0x20, 3], 24), ([0, 3], 24)] {
        jumbo[20..22].copy_from_slice(&flags);
        let cut = Cut::into_fragments(&jumbo).unwrap();
        let (mut room, mut joined) = ([0; ROOM], Vec::new());
        for number in 0..cut.count() {
            let len = cut.write(&jumbo, number, &mut room);
            let packet = packet(&room[..len]);
            assert_eq!(packet.get_identification(), 0xffff);
            assert_eq!(usize::from(packet.get_fragment_offset()) * 8, base + joined.len());
            let more = number + 1 < cut.count() || flags[0] == 0x20;
            assert_eq!(packet.get_flags(), u8::from(more));
            joined.extend_from_slice(packet.payload());
        }
        assert_eq!(joined, jumbo[34..]);
    }
    jumbo[12] = 0x86;
    assert_eq!(Cut::into_fragments(&jumbo), Err(CannotCut));
}

proptest! {
    #[test]
    fn frames_of_any_size_have_all_bytes_once(len in 1_usize..20_000, size in 1_u16..1_472, is_tcp: bool) {
        let payload = bytes(len);
        let (uncut, kind, head) = match is_tcp {
            true => (tcp(7, &payload), TCP, 66),
            false => (udp(&payload), UDP, 42),
        };
        let size = size.min((ROOM - head) as u16);
        let frames = cut(&offload(kind, size), &uncut).unwrap();
        let joined: Vec<u8> = frames.iter().flat_map(|frame| frame[head..].to_vec()).collect();
        prop_assert_eq!(joined, payload);
        let (last, others) = frames.split_last().unwrap();
        prop_assert!(others.iter().all(|frame| frame.len() == head + usize::from(size)));
        prop_assert!(last.len() > head && last.len() <= head + usize::from(size));
    }

    #[test]
    fn any_header_and_any_bytes_are_taken(
        header: [u8; HEADER_LEN], mut frame in proptest::collection::vec(any::<u8>(), 0..200), gso: bool,
    ) {
        let mut offload = Offload::default();
        offload.as_mut_bytes().copy_from_slice(&header);
        if gso && frame.len() > 34 {
            (frame[12], frame[13], frame[14]) = (8, 0, 0x40 | frame[14] & 0xf);
            (offload.gso_type, frame[23]) = if frame[0] & 1 == 0 { (UDP, 17) } else { (TCP, 6) };
            offload.gso_size %= 64;
        }
        if let Ok(frames) = cut(&offload, &frame) {
            prop_assert!(frames.iter().all(|frame| (28..=ROOM).contains(&frame.len())));
        }
        offload.complete(&mut frame);
        if let Ok(cut) = Cut::into_fragments(&frame) {
            let mut room = [0; ROOM];
            prop_assert!((0..cut.count()).all(|number| cut.write(&frame, number, &mut room) <= ROOM));
        }
    }
}
