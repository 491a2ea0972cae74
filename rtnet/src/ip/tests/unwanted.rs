//! What sockets have no part in, for whoever else has the station's address.

use super::*;
use crate::wire::checksum::checksum;
use crate::wire::ethernet::{EtherType, Header as LinkHeader, MIN_FRAME};
use crate::wire::ipv4::{Fields, Header, Protocol};
use crate::wire::{icmpv4, udp};
use zerocopy::IntoBytes;

/// A frame for B with a packet of this protocol: offset in its datagram, whether more follow, content.
fn frame(protocol: Protocol, (offset, more_fragments): (u16, bool), content: &[u8]) -> Vec<u8> {
    let header = Header::new(&Fields {
        source: IP_A,
        destination: IP_B,
        protocol,
        tos: 0,
        identification: 77,
        dont_fragment: false,
        more_fragments,
        offset,
        payload_len: content.len() as u16,
    });
    [LinkHeader::new(B, A, EtherType::IPV4).as_bytes(), header.as_bytes(), content].concat()
}

/// A datagram to a port, without a checksum, of which `there` bytes are in its first packet.
fn datagram(port: u16, whole: u16, there: usize) -> Vec<u8> {
    let mut bytes = [udp::Header::new(9, port, whole).as_bytes(), &[0xaa; 64]].concat();
    bytes.truncate(udp::HEADER_LEN + there);
    bytes
}

/// An ICMP message of this type.
fn icmp(kind: u8) -> Vec<u8> {
    let mut message = [&[kind, 0, 0, 0, 0, 9, 0, 1][..], &[0x55; 24]].concat();
    let sum = checksum(&message);
    message[2..4].copy_from_slice(&sum.to_be_bytes());
    message
}

const WHOLE: (u16, bool) = (0, false);

#[test]
fn what_sockets_and_echoes_have_no_part_in_comes_back_as_it_came_but_for_its_padding() {
    let (_, mut b) = pair();
    b.socket(37_000, 4);
    for (why, frame) in [
        (Refusal::NoProtocol, frame(Protocol(6), WHOLE, &[1; 20])),
        (Refusal::NoProtocol, frame(Protocol(6), (16, true), &[1; 40])),
        (Refusal::NoSocket, frame(Protocol::UDP, WHOLE, &datagram(37_001, 3, 3))),
        (Refusal::NoSocket, frame(Protocol::UDP, (0, true), &datagram(37_001, 64, 8))),
        (Refusal::FragmentOrphan, frame(Protocol::UDP, (16, false), &[2; 11])),
        (Refusal::IcmpType, frame(Protocol::ICMP, WHOLE, &icmp(3))),
        (Refusal::IcmpUnexpected, frame(Protocol::ICMP, WHOLE, &icmp(0))),
        (Refusal::IcmpFragmented, frame(Protocol::ICMP, (0, true), &icmp(8))),
    ] {
        let mut padded = frame.clone();
        padded.resize(frame.len().max(MIN_FRAME), 0);
        let refused = b.tells(&padded).unwrap_err();
        assert_eq!((refused.why, refused.unwanted.as_deref()), (why, Some(&frame[..])), "{why:?}");
    }
}

#[test]
fn what_is_a_sockets_or_an_echo_or_nobodys_is_not_for_others() {
    let (_, mut b) = pair();
    let socket = b.socket(37_000, 1);
    let mut none = |why: Result<(), Refusal>, frame: &[u8]| {
        let heard = b.tells(frame).map_err(|refused| {
            assert!(refused.unwanted.is_none(), "{:?}", refused.why);
            refused.why
        });
        assert_eq!(heard, why);
    };
    none(Ok(()), &frame(Protocol::UDP, WHOLE, &datagram(37_000, 3, 3)));
    none(Err(Refusal::PoolEmpty), &frame(Protocol::UDP, WHOLE, &datagram(37_000, 3, 3)));
    none(Err(Refusal::PoolEmpty), &frame(Protocol::UDP, (0, true), &datagram(37_000, 64, 8)));
    none(Ok(()), &frame(Protocol::ICMP, WHOLE, &icmp(8)));

    let mut changed = frame(Protocol(6), WHOLE, &[1; 20]);
    changed[15] ^= 1;
    none(Err(Refusal::IpChecksum), &changed);
    let mut changed = frame(Protocol::ICMP, WHOLE, &icmp(8));
    changed[40] ^= 1;
    none(Err(Refusal::IcmpChecksum), &changed);
    let mut to_another = frame(Protocol(6), WHOLE, &[1; 20]);
    to_another[33] = 77;
    to_another[24..26].fill(0);
    let sum = checksum(&to_another[14..34]);
    to_another[24..26].copy_from_slice(&sum.to_be_bytes());
    none(Err(Refusal::ForeignAddress), &to_another);
    assert!(b.receive(socket).is_some());
}

#[test]
fn a_fragment_beside_its_order_is_a_sockets_and_what_follows_is_not() {
    let (_, mut b) = pair();
    b.socket(37_000, 4);
    b.hears(&frame(Protocol::UDP, (0, true), &datagram(37_000, 64, 8))).unwrap();
    let refused = b.tells(&frame(Protocol::UDP, (32, true), &[0; 16])).unwrap_err();
    assert!(refused.why == Refusal::FragmentOrder && refused.unwanted.is_none());
    let refused = b.tells(&frame(Protocol::UDP, (48, false), &[0; 24])).unwrap_err();
    assert!(refused.why == Refusal::FragmentOrphan && refused.unwanted.is_some());
}

#[test]
fn what_a_station_sends_to_itself_is_for_nobody_else() {
    let (mut a, _) = pair();
    let socket = a.socket(0, 4);
    a.send(socket, b"x", IP_A, 37_001).unwrap();
    assert_eq!(a.stack.counters().loopback.get(Refusal::NoSocket), 1);
    let echo = icmpv4::Echo::new(icmpv4::Kind::Reply, 1, 1, b"");
    assert_eq!(a.hears(&frame(Protocol::ICMP, WHOLE, echo.as_bytes())), Err(Refusal::ForgedSource));
}
