//! Datagrams that say when they were sent, and when they left.

use super::*;
use crate::discipline::Stamp;
use crate::socket::Times;
use crate::time::{GlobalTime, Offset, Span};
use crate::wire::ethernet::HEADER_LEN as LINK_HEADER;
use crate::wire::udp_options::len_behind;

const SENT: GlobalTime = GlobalTime::from_nanos(1_700_000_000_000_000_001);
/// Where UDP begins.
const CONTENT: usize = LINK_HEADER + 20;

fn to_b() -> Option<SocketAddrV4> {
    Some(SocketAddrV4::new(IP_B, 37_000))
}

/// The frames of a datagram of so many bytes in slots of `limit`, with times or without; when they leave they are stamped.
fn frames(len: usize, limit: usize, sent: Option<GlobalTime>, leaves: Option<Instant>) -> Vec<Vec<u8>> {
    let (mut a, _) = pair();
    a.queue.limit = limit;
    let socket = a.socket(1_024, 600);
    a.stack.send_sent_at(socket, &bytes(len), to_b(), Flags::NONE, sent, &mut a.queue).unwrap();
    let leave = |(mut frame, ..): (Buf, Priority, Channel)| {
        if let Some(at) = leaves
            && let Some(stamp) = Stamp::of(&frame, &line(), at)
        {
            stamp.write(&mut frame, at);
        }
        frame.to_vec()
    };
    a.queue.waiting.drain(..).map(leave).collect()
}

/// Global time is this far ahead.
fn line() -> TimeView {
    let offset = Offset::between(Instant::from_nanos(7), SENT);
    TimeView { offset, period: Some(Span::from_millis(1)), ..TimeView::default() }
}

fn receiver() -> (End, SocketId) {
    let (_, mut b) = pair();
    let socket = b.socket(37_000, 600);
    (b, socket)
}

/// What comes of these frames: the times, and how long it is.
fn received(frames: &[Vec<u8>]) -> (Option<Times>, Vec<u8>) {
    let (mut b, socket) = receiver();
    frames.iter().for_each(|frame| b.hears(frame).unwrap());
    let (received, data) = b.receive(socket).expect("it is whole");
    assert_eq!(b.stack.counters().options_ignored, 0);
    (received.times, data)
}

#[test]
fn what_was_sent_and_left_at_a_moment_comes_with_it_whole_or_in_fragments() {
    let leaves = Instant::from_nanos(5_007);
    let left = Some(SENT + Span::from_nanos(5_000));
    for (len, limit) in
        [(0, 1_500), (1, 1_500), (16, 1_500), (17, 1_500), (1_449, 1_500), (3_000, 1_500), (755, 100)]
    {
        let sent = frames(len, limit, Some(SENT), None);
        let times = Times { sent: SENT, left: None };
        assert_eq!(received(&sent), (Some(times), bytes(len)), "{len} in {limit}");
        let sent = frames(len, limit, Some(SENT), Some(leaves));
        assert_eq!(received(&sent), (Some(Times { left, ..times }), bytes(len)), "{len} in {limit}");
    }
}

#[test]
fn times_are_behind_what_is_sent_without_them_byte_for_byte() {
    for len in [0, 1, 16, 17, 1_000] {
        let (with, without) = (frames(len, 1_500, Some(SENT), None), frames(len, 1_500, None, None));
        let (with, without) = (&with[0], &without[0]);
        let end = CONTENT + 8 + len;
        assert_eq!(with[CONTENT..end], without[CONTENT..end], "{len}");
        let total =
            |frame: &[u8]| usize::from(u16::from_be_bytes([frame[LINK_HEADER + 2], frame[LINK_HEADER + 3]]));
        assert_eq!(total(without), 20 + 8 + len);
        assert_eq!(total(with), total(without) + len_behind(8 + len));
    }
}

#[test]
fn times_cost_no_frame_and_go_with_no_datagram_that_is_too_long_for_them() {
    let room = |len: usize, limit: usize| {
        let (with, without) = (frames(len, limit, Some(SENT), None), frames(len, limit, None, None));
        assert_eq!(with.len(), without.len(), "{len} in {limit}");
        let (times, data) = received(&with);
        assert_eq!(data, bytes(len));
        assert!(times.is_some() || with == without, "{len} in {limit}");
        times.is_some()
    };
    // A whole frame takes 1472 bytes; behind an odd number of them there is one more.
    for (len, limit, has_room) in [
        (1_450, 1_500, true),
        (1_451, 1_500, false),
        (1_472, 1_500, false),
        (1_473, 1_500, true),
        (65_483, 1_500, true),
        (65_484, 1_500, true),
        (65_485, 1_500, false),
        (65_507, 1_500, false),
        (8, 60, true),
        (24, 60, false),
        (50, 60, true),
    ] {
        assert_eq!(room(len, limit), has_room, "{len} in {limit}");
    }
    assert!((0..400).filter(|&len| room(len, 100)).count() > 100);
}

#[test]
fn times_that_were_changed_on_the_way_are_unknown_and_the_datagram_is_there() {
    for (len, limit) in [(16, 1_500), (17, 1_500), (3_000, 1_500)] {
        let sent = frames(len, limit, Some(SENT), None);
        let begin = CONTENT + if sent.len() == 1 { 8 + len } else { 3_008 % 1_480 };
        for at in begin..begin + len_behind(8 + len) {
            let mut changed = sent.clone();
            changed.last_mut().unwrap()[at] ^= 0x10;
            let (mut b, socket) = receiver();
            changed.iter().for_each(|frame| b.hears(frame).unwrap());
            let (received, data) = b.receive(socket).expect("it is whole");
            assert_eq!((received.times, data), (None, bytes(len)), "{len} at {at}");
            assert_eq!(b.stack.counters().options_ignored, 1);
        }
    }
}

#[test]
fn fragments_that_are_longer_than_their_datagram_says_must_have_the_right_checksum() {
    let mut sent = frames(3_000, 1_500, Some(SENT), None);
    sent[0][CONTENT + 5] ^= 16;
    let (mut b, socket) = receiver();
    let refused: Vec<_> = sent.iter().filter_map(|frame| b.hears(frame).err()).collect();
    assert_eq!(refused, [Refusal::UdpChecksum]);
    assert!(b.receive(socket).is_none());
    // Of RTnet's it is tolerated that they are wrong: these have nothing behind their end.
    let mut sent = frames(3_000, 1_500, None, None);
    sent[1][700] ^= 1;
    assert_eq!(received(&sent).1.len(), 3_000);
}

#[test]
fn what_a_station_sends_to_itself_says_when_it_was_sent() {
    let (mut a, _) = pair();
    let (from, to) = (a.socket(0, 8), a.socket(37_000, 8));
    let own = Some(SocketAddrV4::new(IP_A, 37_000));
    a.stack.send_sent_at(from, b"own", own, Flags::NONE, Some(SENT), &mut a.queue).unwrap();
    let (received, data) = a.receive(to).expect("it is there at once");
    assert_eq!((received.times, &data[..]), (Some(Times { sent: SENT, left: None }), &b"own"[..]));
}

#[test]
fn a_buffer_that_is_filled_again_says_nothing_of_when_it_left() {
    let (mut a, _) = pair();
    let socket = a.socket(0, 1);
    for sent in [Some(SENT), None, Some(SENT)] {
        a.stack.send_sent_at(socket, b"x", to_b(), Flags::NONE, sent, &mut a.queue).unwrap();
        let (frame, ..) = a.queue.waiting.pop_front().unwrap();
        assert_eq!(frame.blank().is_some(), sent.is_some());
    }
}
