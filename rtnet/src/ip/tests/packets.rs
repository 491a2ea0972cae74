//! Packet sockets.

use super::*;
use crate::socket::{LinkAddress, LinkMode, LinkType, Sender};
use crate::wire::ethernet::EtherType;

const OWN: EtherType = EtherType(0x88b6);

fn packet(end: &mut End, mode: LinkMode, link_type: LinkType, buffers: usize) -> SocketId {
    end.open(Socket::packet(mode, link_type, Arc::new(Pool::new(buffers))))
}

fn send(
    end: &mut End,
    id: SocketId,
    data: &[u8],
    to: Option<(Address, EtherType)>,
) -> Result<(), SocketError> {
    end.stack.send_frame(id, data, to, Flags::NONE, &mut end.queue)
}

#[test]
fn a_protocol_of_ones_own_needs_no_ip() {
    let (mut a, mut b) = pair();
    let from = packet(&mut a, LinkMode::Datagram, LinkType::Only(OWN), 2);
    let to = packet(&mut b, LinkMode::Datagram, LinkType::Only(OWN), 2);
    send(&mut a, from, &bytes(80), Some((B, OWN))).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    let (received, data) = b.receive(to).unwrap();
    assert_eq!(data, bytes(80));
    let from = LinkAddress { address: A, ether_type: OWN, to_group: false };
    assert_eq!(received.from, Sender::Link(from));
}

#[test]
fn a_raw_socket_writes_and_reads_whole_frames() {
    let (mut a, mut b) = pair();
    let from = packet(&mut a, LinkMode::Raw, LinkType::Nothing, 2);
    let to = packet(&mut b, LinkMode::Raw, LinkType::Only(OWN), 2);
    let mut frame = [&B.0[..], &A.0, &OWN.0.to_be_bytes(), b"content"].concat();
    send(&mut a, from, &frame, None).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    frame.resize(60, 0);
    assert_eq!(b.receive(to).unwrap().1, frame, "padded to the least that an Ethernet carries");
    assert_eq!(a.hears(&frame), Err(Refusal::UnclaimedEtherType), "who only sends hears nothing");
}

#[test]
fn all_that_want_a_frame_have_it_and_each_pays_for_its_own() {
    let (mut a, mut b) = pair();
    let from = packet(&mut a, LinkMode::Datagram, LinkType::Nothing, 9);
    let small = packet(&mut b, LinkMode::Datagram, LinkType::Only(OWN), 1);
    let tap = packet(&mut b, LinkMode::Raw, LinkType::All, 4);
    let large = packet(&mut b, LinkMode::Datagram, LinkType::Only(OWN), 4);
    for _ in 0..3 {
        send(&mut a, from, b"for three", Some((Address::BROADCAST, OWN))).unwrap();
        assert_eq!(cross(&mut a, &mut b), []);
    }
    let came = |b: &mut End, id| std::iter::from_fn(|| b.receive(id)).count();
    assert_eq!([small, tap, large].map(|id| came(&mut b, id)), [1, 3, 3]);
    assert_eq!(b.stack.socket_counters(small).unwrap().dropped, 2);
    b.stack.bind_link(small, LinkType::Only(EtherType(0x1234))).unwrap();
    send(&mut a, from, b"for two", Some((Address::BROADCAST, OWN))).unwrap();
    cross(&mut a, &mut b);
    assert_eq!([small, tap, large].map(|id| came(&mut b, id)), [0, 1, 1]);
}

#[test]
fn a_tap_hears_what_the_stack_takes_and_takes_nothing_from_it() {
    let (mut a, mut b) = pair();
    let (from, to) = (a.socket(0, 4), b.socket(36_000, 4));
    let tap = packet(&mut b, LinkMode::Raw, LinkType::All, 1);
    for n in 0..2 {
        a.send(from, b"x", IP_B, 36_000).unwrap();
        let sent = a.sent();
        b.hears(&sent[0]).unwrap();
        assert!(b.receive(to).is_some());
        if n == 0 {
            assert_eq!(b.receive(tap).unwrap().1, sent[0]);
        }
    }
    b.stack.overhear(None, &bytes(60));
    assert_eq!(b.stack.socket_counters(tap).unwrap().dropped, 1, "its only buffer is taken");
    b.receive(tap).unwrap();
    a.send(from, b"x", IP_B, 36_000).unwrap();
    let mut forged = a.sent().remove(0);
    forged[6] |= 1;
    assert_eq!(b.hears(&forged), Err(Refusal::ForgedSource));
    assert_eq!(b.receive(tap).unwrap().1, forged, "also what the stack does not take");
}

#[test]
fn what_cannot_be_a_frame_is_refused() {
    let (mut a, _) = pair();
    let raw = packet(&mut a, LinkMode::Raw, LinkType::Nothing, 2);
    let datagram = packet(&mut a, LinkMode::Datagram, LinkType::Nothing, 2);
    let udp = a.socket(0, 1);
    let number = |result: Result<(), SocketError>| result.unwrap_err().errno();
    assert_eq!(number(send(&mut a, raw, &bytes(13), None)), libc::EINVAL);
    assert_eq!(number(send(&mut a, raw, &bytes(1_515), None)), libc::EMSGSIZE);
    assert_eq!(number(send(&mut a, datagram, b"", None)), libc::ENOTCONN);
    assert_eq!(number(send(&mut a, datagram, b"", Some((B, EtherType(0))))), libc::EINVAL);
    assert_eq!(number(send(&mut a, datagram, &bytes(1_501), Some((B, OWN)))), libc::EMSGSIZE);
    assert_eq!(number(send(&mut a, udp, b"", Some((B, OWN)))), libc::EOPNOTSUPP);
    assert_eq!(number(a.send(raw, b"", IP_B, 1)), libc::EOPNOTSUPP);
    a.queue.limit = 100;
    assert_eq!(number(send(&mut a, datagram, &bytes(101), Some((B, OWN)))), libc::EMSGSIZE);
    assert_eq!(a.sent().len(), 0);
    let pools = a.stack.sockets().map(|(_, socket)| socket.pool().available());
    assert_eq!(pools.collect::<Vec<_>>(), [2, 2, 1]);
}

#[test]
fn no_socket_forges_the_frames_of_a_discipline() {
    let (mut a, _) = pair();
    let id = packet(&mut a, LinkMode::Datagram, LinkType::Nothing, 2);
    let refused = send(&mut a, id, b"a sync", Some((Address::BROADCAST, EtherType::RTMAC))).unwrap_err();
    assert_eq!((refused.errno(), a.sent().len()), (libc::EPERM, 0));
}
