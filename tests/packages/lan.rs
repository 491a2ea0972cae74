//! Packages from elsewhere: two stacks and the frames between them, in virtual time.

use std::cell::Cell;
use std::net::SocketAddrV4;
use std::sync::atomic::AtomicU64;

use package_router::mailbox::{
    Inbox, LARGEST_BODY as LARGEST, LaneSender, Layout, Origin, Stamps, Word, of_sender,
};
use package_router::priority::{Priorities, level_of};
use package_router::router::{Host, LAN_PORT, Router, RouterCounters, Way};
use package_router::wire::{ERROR, HEAD_LEN, Head, MOST_DATAGRAM, NOT_AVAILABLE, OK, split};
use rtnet::ip::StackConfig;
use rtnet::ip::route::Interface;
use rtnet::socket::{Flags, SocketId};
use rtnet::time::GlobalTime;
use tests::ends::{A, B, End};

use super::*;

/// A word, and how often it was written.
#[derive(Default)]
struct Spot {
    value: AtomicU64,
    writes: AtomicU64,
}

impl Word for Spot {
    fn get(&self) -> u64 {
        Word::get(&self.value)
    }
    fn get_acquire(&self) -> u64 {
        self.value.get_acquire()
    }
    fn set(&self, value: u64) {
        self.value.set(value);
        self.writes.fetch_add(1, Ordering::Relaxed);
    }
    fn set_release(&self, value: u64) {
        self.set(value);
    }
    fn fence() {
        AtomicU64::fence();
    }
}

type Words = Arc<[Spot]>;
type Lan = Router<Words, Words>;

thread_local! {
    static NOW: Cell<u64> = const { Cell::new(1_000_000) };
    static WOKEN: Cell<u32> = const { Cell::new(0) };
}

const US: MailboxName = MailboxName(0x0010_0000);
const OTHERS: MailboxName = MailboxName(0x00f0_0000);

fn words(count: usize) -> Words {
    (0..count).map(|_| Spot::default()).collect()
}

/// One station with mailboxes, and another that sends to it.
struct Pair {
    sender: End,
    from: SocketId,
    station: End,
    /// When what it sends was sent, if it says so.
    sent: Option<GlobalTime>,
}

/// A mailbox there, with the segment that the router writes.
struct Seen {
    inbox: Inbox<Words, Words>,
    of_router: Words,
    layout: Layout,
}

impl Pair {
    fn new() -> Self {
        Self::with(Priorities::default())
    }

    fn with(priorities: Priorities) -> Self {
        let (address, ip) = B;
        let config = StackConfig::new(Interface { address, ip, prefix: 24 });
        let clock = || NOW.get();
        let mut station = End::above(config, vec![Box::new(Lan::new(Host { clock, priorities }))]);
        station.knows(A);
        let reads = station.socket(LAN_PORT, 256);
        station.stack.program_mut::<Lan>().unwrap().reads(reads);
        let mut sender = End::new(A);
        sender.knows(B);
        let from = sender.socket(LAN_PORT, 256);
        Self { sender, from, station, sent: None }
    }

    fn mailbox(&mut self, name: MailboxName, shape: Shape) -> Seen {
        let layout = Layout::of(&shape);
        let own = words(layout.owner_words(1));
        let of_router = words(layout.sender_words());
        let mut inbox = Inbox::new(own.clone(), &shape.senders(1));
        inbox.attach(0, MailboxName::NOBODY, of_router.clone()).unwrap();
        let lane = LaneSender::new(of_router.clone(), own, layout, 0);
        let wake = Box::new(|| WOKEN.set(WOKEN.get() + 1));
        assert!(self.router().add(Way::new(name, lane, wake)).is_ok());
        Seen { inbox, of_router, layout }
    }

    fn router(&mut self) -> &mut Lan {
        self.station.stack.program_mut().unwrap()
    }

    fn counters(&mut self) -> RouterCounters {
        self.router().counters()
    }

    /// A datagram from one station to the other.
    fn datagram(&mut self, bytes: &[u8]) {
        let to = Some(SocketAddrV4::new(B.1, LAN_PORT));
        self.sender.send_sent_at(self.from, bytes, to, self.sent).unwrap();
        for frame in self.sender.leaves(usize::MAX) {
            self.station.hears(&frame).unwrap();
        }
        self.station.stack.rest();
        self.sender.check_buffers();
    }

    /// A package as a component sends it.
    fn package(&mut self, head: &Head, body: &[u8]) {
        for datagram in datagrams(head, body, MOST_DATAGRAM) {
            self.datagram(&datagram);
        }
    }

    /// What the station has sent back.
    fn answers(&mut self) -> Vec<Head> {
        for frame in self.station.leaves(usize::MAX) {
            self.sender.hears(&frame).unwrap();
        }
        let mut next = || self.sender.receive(self.from, 64, Flags::NONE).ok();
        std::iter::from_fn(|| next().map(|(_, bytes)| Head::parse(&bytes).unwrap())).collect()
    }
}

fn datagrams(head: &Head, body: &[u8], most: usize) -> Vec<Vec<u8>> {
    let head = head.with_body(body.len()).unwrap();
    split(&head, most)
        .unwrap()
        .map(|piece| [&piece.head.to_bytes()[..], &body[piece.body]].concat())
        .collect()
}

fn body(len: usize) -> Vec<u8> {
    (0..len).map(|at| (at * 7 + at / 251) as u8).collect()
}

/// What has come: whose, its number, and its body.
fn all(seen: &mut Seen) -> Vec<(MailboxName, u8, Vec<u8>)> {
    let mut next = || {
        let package = seen.inbox.receive(NOW.get())?;
        Some((package.head().from, package.head().id, package.body().to_vec()))
    };
    std::iter::from_fn(&mut next).collect()
}

fn to(name: MailboxName, id: u8) -> Head {
    Head { id, priority: 9, ..Head::new(1, name, OTHERS) }
}

#[test]
fn a_package_from_elsewhere_lies_in_its_mailbox_as_it_was_sent_copied_once() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(1, MOST_DATAGRAM));
    for (id, len) in
        [0, 1, 7, 8, 9, 1_400, 1_456, 1_457, 3_000, 20_001, MOST_DATAGRAM - HEAD_LEN].into_iter().enumerate()
    {
        let (sent, id) = (body(len), id as u8);
        let begin = seen.layout.slot(0) + 8;
        let slot = begin..begin + len.div_ceil(8);
        let writes = |seen: &Seen| {
            slot.clone().map(|at| seen.of_router[at].writes.load(Ordering::Relaxed)).collect::<Vec<_>>()
        };
        let before = writes(&seen);
        // What is behind the datagram's end is no part of it.
        pair.sent = (id % 2 == 0).then_some(GlobalTime::from_nanos(1));
        pair.package(&to(US, id), &sent);
        // Of the words at which parts of it meet one is written twice: of two frames, and behind the head.
        let copies: Vec<_> = writes(&seen).iter().zip(before).map(|(after, before)| after - before).collect();
        let meets = copies.iter().filter(|&&copies| copies == 2).count();
        assert!(copies.iter().all(|copies| (1..=2).contains(copies)), "{len}: each byte is copied, once");
        assert!(meets <= len / 1_000 + 1, "{len}: {meets}");
        assert_eq!(all(&mut seen), [(OTHERS, id, sent)]);
    }
    assert_eq!(pair.counters(), RouterCounters { delivered: 11, ..RouterCounters::default() });
}

#[test]
fn a_package_that_is_longer_than_a_datagram_comes_in_parts_and_is_whole() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(2, LARGEST));
    let (long, short) = (body(LARGEST), body(100));
    let parts = datagrams(&to(US, 1), &long, MOST_DATAGRAM);
    assert_eq!(parts.len(), 5);
    for (n, part) in parts.iter().enumerate() {
        // Others come between.
        if n == 2 {
            pair.package(&Head { from: MailboxName(0x00f0_0100), ..to(US, 9) }, &short);
            assert_eq!(all(&mut seen).len(), 1);
        }
        pair.datagram(part);
    }
    assert_eq!(all(&mut seen), [(OTHERS, 1, long)]);
    assert_eq!(pair.counters(), RouterCounters { delivered: 2, ..RouterCounters::default() });
}

#[test]
fn a_package_was_sent_when_its_first_part_that_says_so_was_and_is_of_unknown_age_if_none_does() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(2, LARGEST));
    let at = |nanos: u64| GlobalTime::from_nanos(nanos);
    // Parts as long as can be have no room for it.
    for (most, says, sent) in [
        (1_000, 0..9, Some(500)),
        (1_000, 1..9, Some(501)),
        (1_000, 9..9, None),
        (MOST_DATAGRAM, 0..9, Some(504)),
    ] {
        let len = if most == MOST_DATAGRAM { LARGEST } else { 4_500 };
        let parts = datagrams(&to(US, 1), &body(len), most);
        assert_eq!(parts.len(), 5);
        for (n, part) in parts.iter().enumerate() {
            pair.sent = says.contains(&n).then(|| at(500 + n as u64));
            pair.datagram(part);
        }
        let package = seen.inbox.receive(NOW.get() + 7).unwrap();
        let stamps = Stamps { sent: NOW.get(), origin: Origin::Elsewhere(sent.map(at)), ..Stamps::default() };
        assert_eq!((package.stamps(), package.waited()), (stamps, 7));
    }
}

#[test]
fn parts_that_are_missing_doubled_or_reversed_leave_nothing_and_take_no_slot() {
    let long = body(400);
    let whole = datagrams(&to(US, 1), &long, 116);
    assert_eq!(whole.len(), 4);
    let courses: [&[usize]; 7] =
        [&[0, 2, 3], &[0, 1, 1, 2, 3], &[1, 0, 2, 3], &[3, 2, 1, 0], &[0, 1, 2], &[2], &[0, 0]];
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(1, 400));
    for course in courses {
        let before = pair.counters();
        course.iter().for_each(|&part| pair.datagram(&whole[part]));
        assert_eq!(all(&mut seen), [], "{course:?}");
        // What was begun is given up when the next begins, or when its time is over.
        NOW.set(NOW.get() + 200_000_000);
        pair.datagram(&[0; 3]);
        assert!(pair.counters().incomplete > before.incomplete, "{course:?}");
        whole.iter().for_each(|part| pair.datagram(part));
        assert_eq!(all(&mut seen), [(OTHERS, 1, long.clone())], "{course:?}");
    }
}

#[test]
fn who_asks_a_mailbox_that_is_not_here_is_told_so_and_what_is_no_question_is_only_counted() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(1, 8));
    let unknown = MailboxName(0x0010_0100);
    pair.package(&Head { kind: 3, ..to(unknown, 43) }, &[1, 2]);
    pair.package(&Head { kind: -6, ..to(unknown, 44) }, &[1, 2]);
    let told = pair.answers();
    let expected =
        Head { kind: NOT_AVAILABLE, to: OTHERS, from: unknown, id: 43, priority: 9, ..Head::default() };
    assert_eq!(told, [Head { len: 16, ..expected }]);
    pair.package(&to(US, 1), &[5]);
    assert_eq!(all(&mut seen), [(OTHERS, 1, vec![5])]);
    let counters = pair.counters();
    assert_eq!((counters.no_route, counters.answered, counters.delivered), (2, 1, 1));
}

#[test]
fn command_too_large_for_its_mailbox_is_answered() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(2, 100));
    let expected =
        |id| Head { kind: ERROR, to: OTHERS, from: US, id, priority: 9, len: 16, ..Head::default() };
    pair.package(&to(US, 43), &body(101));
    assert_eq!(pair.answers(), [expected(43)]);
    // In parts: one answer, for all of them.
    datagrams(&to(US, 44), &body(400), 116).iter().for_each(|part| pair.datagram(part));
    assert_eq!(pair.answers(), [expected(44)]);
    // A reply is none that is answered.
    pair.package(&Head { kind: OK, ..to(US, 45) }, &body(101));
    assert_eq!(pair.answers(), []);
    pair.package(&to(US, 46), &body(100));
    assert_eq!(all(&mut seen), [(OTHERS, 46, body(100))]);
    let counters = pair.counters();
    assert_eq!((counters.too_large, counters.answered, counters.delivered), (3, 2, 1));
}

/// The slots here are 0 and 1.
#[test]
fn an_answer_for_whom_nobody_is_leaves_in_the_slot_of_that_class_if_the_station_has_it() {
    let file = "[class.Camera]\nchannel = 1\n[class.Odometry]\nchannel = 2\n[class.0xf0]\nchannel = 1";
    let mut pair = Pair::with(Priorities::parse(file, "priorities.toml").unwrap());
    for (class, channel) in [(Class::CAMERA, 1), (Class::PILOT, 0), (Class::ODOMETRY, 0)] {
        pair.package(&to(MailboxName::new(0, class, 1, 0), 7), &[]);
        assert_eq!(pair.station.queue.last.take(), Some((level_of(9), channel)), "{class}");
        assert_eq!(pair.answers().len(), 1, "{class}");
    }
    assert_eq!(pair.counters().answered, 3);
}

#[test]
fn a_full_mailbox_keeps_nobody_waiting_behind_what_was_for_it() {
    let mut pair = Pair::new();
    let (mut full, mut other) =
        (pair.mailbox(US, Shape::new(2, 8)), pair.mailbox(MailboxName(0x0011_0000), Shape::new(9, 8)));
    for id in 0..9 {
        pair.package(&to(US, id), &[id]);
        pair.package(&to(MailboxName(0x0011_0000), id), &[id; 8]);
        pair.package(&to(US, id), &[id; 9]);
    }
    assert_eq!((all(&mut full).len(), all(&mut other).len()), (2, 9));
    let counters = pair.counters();
    assert_eq!((counters.full, counters.too_large, counters.delivered), (7, 9, 11));
    assert_eq!(Word::get(&full.of_router[of_sender::FULL]), 7);
}

#[test]
fn heads_that_lie_and_names_that_are_ours_are_refused_and_counted() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(2, 64));
    let good = datagrams(&to(US, 1), &[7; 20], MOST_DATAGRAM).remove(0);
    let mut refused = 0;
    for len in 0..good.len() {
        pair.datagram(&good[..len]);
        refused += 1;
    }
    for said in [0, 15, 16, 35, 37, 1 << 18, (1 << 18) + 1, u32::MAX] {
        let mut lies = good.clone();
        lies[12..16].copy_from_slice(&said.to_le_bytes());
        pair.datagram(&lies);
        refused += 1;
    }
    pair.datagram(&[&good[..], &[0]].concat());
    assert_eq!(pair.counters().malformed, refused + 1);
    pair.package(&Head { from: US, ..to(US, 2) }, &[]);
    assert_eq!(pair.counters().forged, 1);
    assert_eq!(all(&mut seen), []);
    pair.datagram(&good);
    assert_eq!(all(&mut seen), [(OTHERS, 1, vec![7; 20])]);
}

#[test]
fn the_most_urgent_of_what_has_come_is_read_first_and_who_sleeps_is_woken_once_a_turn() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(8, 8));
    assert!(seen.inbox.falls_asleep());
    let before = WOKEN.get();
    let frames: Vec<_> = [3, 200, 7]
        .into_iter()
        .flat_map(|priority| {
            let datagram = datagrams(&Head { priority, ..to(US, priority) }, &[], MOST_DATAGRAM).remove(0);
            pair.sender.send(pair.from, &datagram, Some(SocketAddrV4::new(B.1, LAN_PORT))).unwrap();
            pair.sender.leaves(usize::MAX)
        })
        .collect();
    for frame in frames {
        pair.station.hears(&frame).unwrap();
        NOW.set(NOW.get() + 10);
    }
    assert_eq!(WOKEN.get(), before, "nobody is woken before the slot's send");
    pair.station.stack.rest();
    assert_eq!(WOKEN.get(), before + 1);
    pair.station.stack.rest();
    assert_eq!(WOKEN.get(), before + 1);
    seen.inbox.wakes_up();
    let ids: Vec<_> = all(&mut seen).into_iter().map(|(_, id, _)| id).collect();
    assert_eq!(ids, [200, 7, 3]);
}

#[test]
fn a_mailbox_that_is_gone_gets_nothing_more_and_what_was_begun_for_it_is_gone_with_it() {
    let mut pair = Pair::new();
    let mut seen = pair.mailbox(US, Shape::new(1, 400));
    pair.datagram(&datagrams(&to(US, 1), &body(400), 116)[0]);
    assert!(pair.router().remove(US).is_some() && pair.router().remove(US).is_none());
    pair.package(&to(US, 2), &[]);
    assert_eq!((all(&mut seen), pair.counters().no_route), (vec![], 1));
}
