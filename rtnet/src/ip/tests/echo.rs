//! Echoes, asked for and answered.

use super::*;
use crate::ip::Pong;
use crate::ip::icmp::OPTIONS;
use crate::socket::Options;

fn ask(end: &mut End, to: Ipv4Addr, which: (u16, u16), data: &[u8]) -> Result<(), SocketError> {
    end.stack.ask_echo(to, which, data, OPTIONS, &mut end.queue)
}

#[test]
fn an_echo_is_answered_with_what_came_at_the_last_real_time_priority() {
    let (mut a, mut b) = pair();
    ask(&mut a, IP_B, (7, 1), &bytes(56)).unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    let (_, priority, channel) = b.queue.waiting[0];
    assert_eq!((priority, channel), (Priority::LAST_REAL_TIME, 1));
    assert_eq!(cross(&mut b, &mut a), []);
    let rx = Some(Instant::from_nanos(2_000));
    assert_eq!(
        a.stack.next_pong(),
        Some(Pong { from: IP_B, identifier: 7, sequence: 1, len: 56, rx, left: None })
    );
    assert_eq!(a.stack.next_pong(), None);
    assert_eq!(b.stack.counters().echoes_answered, 1);
}

#[test]
fn an_answer_of_another_round_or_one_that_nobody_asked_for_is_refused() {
    let (mut a, mut b) = pair();
    ask(&mut a, IP_B, (7, 1), b"").unwrap();
    cross(&mut a, &mut b);
    let answer = b.sent();
    // As many rounds go on at a time; one more, and the first is over.
    for round in 8..=14 {
        ask(&mut a, IP_B, (round, 1), b"").unwrap();
        a.sent();
    }
    assert_eq!(a.hears(&answer[0]), Ok(()));
    ask(&mut a, IP_B, (15, 1), b"").unwrap();
    assert_eq!(a.hears(&answer[0]), Err(Refusal::IcmpUnexpected));
    assert_eq!(b.hears(&answer[0]), Err(Refusal::ForgedSource), "its own");
}

#[test]
fn who_has_no_route_back_or_no_slot_counts_the_echo_as_refused() {
    let (mut a, mut b) = pair();
    let mut stranger = End::new(Address([2, 0, 0, 0, 0, 9]), FROM_NOBODY);
    stranger.knows(IP_B, B);
    ask(&mut stranger, IP_B, (1, 1), b"").unwrap();
    assert_eq!(cross(&mut stranger, &mut b), [Refusal::NoRoute]);
    ask(&mut a, IP_B, (1, 1), b"").unwrap();
    b.queue.room = 0;
    assert_eq!(cross(&mut a, &mut b), [Refusal::NotQueued]);
    assert_eq!(b.stack.pools()[0].statistics.free, 8);
}

#[test]
fn a_storm_of_echoes_takes_the_buffers_of_echoes_only() {
    let (mut a, mut b) = pair();
    let to = b.socket(36_000, 4);
    let from = a.socket(0, 4);
    ask(&mut a, IP_B, (1, 1), &bytes(1_000)).unwrap();
    let question = a.sent().remove(0);
    let answers: Vec<_> = (0..1_000).map(|_| b.hears(&question)).collect();
    assert!(answers[..8].iter().all(Result::is_ok));
    assert!(answers[8..].iter().all(|answer| *answer == Err(Refusal::PoolEmpty)));
    a.send(from, b"comes through", IP_B, 36_000).unwrap();
    cross(&mut a, &mut b);
    assert_eq!(b.receive(to).unwrap().1, b"comes through");
    b.send(to, b"and leaves", IP_A, 1).unwrap();
    assert_eq!(b.sent().len(), 9);
    let pool = b.stack.pools()[0].statistics;
    assert_eq!((pool.free, pool.least, pool.exhausted), (8, 0, 992));
}

#[test]
fn more_answers_than_are_kept_are_told_from_those_that_nobody_asked_for() {
    let (mut a, mut b) = pair();
    ask(&mut a, IP_B, (1, 1), b"").unwrap();
    assert_eq!(cross(&mut a, &mut b), []);
    let answer = b.sent().remove(0);
    let heard: Vec<_> = (0..34).map(|_| a.hears(&answer)).collect();
    assert!(heard[..32].iter().all(Result::is_ok));
    assert_eq!(heard[32..], [Err(Refusal::IcmpBacklog); 2]);
}

#[test]
fn an_echo_to_all_is_answered_by_nobody_and_one_to_itself_at_once() {
    let (mut a, mut b) = pair();
    ask(&mut a, Ipv4Addr::new(10, 0, 0, 255), (1, 1), b"").unwrap();
    assert_eq!(cross(&mut a, &mut b), [Refusal::IcmpBroadcast]);
    ask(&mut a, IP_A, (1, 2), b"").unwrap();
    assert_eq!(a.stack.next_pong().map(|pong| pong.sequence), Some(2));
    for loopback in [[127, 0, 0, 1], [127, 9, 9, 9]].map(Ipv4Addr::from) {
        ask(&mut a, loopback, (1, 3), b"").unwrap();
        assert_eq!(a.stack.next_pong().map(|pong| pong.from), Some(loopback), "from whom was asked");
    }
}

#[test]
fn two_who_ask_at_once_have_each_their_own_answers() {
    let (mut a, mut b) = pair();
    // The same numbers in both rounds: each question has its own moment.
    for (round, at) in [(1, 100), (2, 200)] {
        ask(&mut a, IP_B, (round, 7), b"").unwrap();
        assert_eq!(a.stack.echoes_left(round), 0, "it waits");
        // The first turn was missed.
        for at in [at - 10, at] {
            a.stack.leaves(Instant::from_nanos(at), &a.queue.waiting[0].0);
        }
        assert_eq!((a.stack.echoes_left(round), a.stack.echoes_left(3)), (1, 0), "once, and of this round");
        cross(&mut a, &mut b);
    }
    assert_eq!(cross(&mut b, &mut a), []);
    let at = |nanos| Some(Instant::from_nanos(nanos));
    let pongs: Vec<Pong> = core::iter::from_fn(|| a.stack.next_pong()).collect();
    let came: Vec<_> = pongs.iter().map(|pong| (pong.identifier, pong.sequence, pong.left)).collect();
    assert_eq!(came, [(1, 7, at(100)), (2, 7, at(200))]);
}

#[test]
fn an_answer_too_long_for_the_slot_leaves_in_fragments() {
    let (mut a, mut b) = pair();
    ask(&mut a, IP_B, (1, 1), &bytes(1_000)).unwrap();
    b.queue.limit = 500;
    assert_eq!(cross(&mut a, &mut b), []);
    let answer = b.sent();
    assert_eq!(answer.len(), 3);
    let refused: Vec<_> = answer.iter().filter_map(|frame| a.hears(frame).err()).collect();
    assert_eq!(refused, [Refusal::IcmpFragmented; 3], "stations themselves collect datagrams only");
    let urgent = Options { priority: Priority::FIRST, ..OPTIONS };
    a.stack.ask_echo(IP_B, (1, 2), b"", urgent, &mut a.queue).unwrap();
    assert_eq!(a.queue.waiting[0].1, Priority::FIRST);
}
