//! Datagrams whose receivers know where the time went, exactly: clocks do not drift here, and hosts are ideal.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use package_router::journey::Journey;
use package_router::mailbox::{Inbox, LaneSender, Layout, Shape};
use package_router::name::MailboxName;
use package_router::priority::Priorities;
use package_router::router::{Host, LAN_PORT, Router, Way};
use package_router::wire::Head;
use rtmac::tdma::{SlotConfig, Tdma};
use rtnet::discipline::{Discipline, TimeView};
use rtnet::sim::Network;
use rtnet::socket::{Flags, Received, SocketId, Times};
use rtnet::time::{GlobalTime, Span};
use tests::stacks::{CYCLE, at, bytes, cycles, settled, slot, stack, udp};

const PORT: u16 = 2_000;
/// The sender's slot in each cycle.
const SLOT_US: i64 = 500;
/// From the stamp of a frame to that of its receiver.
const WIRE: Span = Span::from_nanos(500);

/// Station 0 hears, station 1 sends in a slot of this size.
fn pair(size: usize) -> (Network<Tdma>, SocketId, SocketId) {
    let (mut hears, mut sends) = (stack(0, Vec::new()), stack(1, Vec::new()));
    let sockets = (udp(&mut hears, PORT, 64), udp(&mut sends, PORT, 64));
    let slots = vec![SlotConfig { size, ..slot(0, SLOT_US) }];
    (settled(vec![(vec![slot(0, 200)], hears), (slots, sends)]), sockets.0, sockets.1)
}

fn view(network: &Network<Tdma>, id: usize) -> TimeView {
    network.member(id).station.discipline().time()
}

/// What a station takes global time to be.
fn global(network: &Network<Tdma>, id: usize) -> GlobalTime {
    let local = network.member(id).clock.local(network.now());
    view(network, id).to_global(local).expect("it is synchronised")
}

fn send(network: &mut Network<Tdma>, from: SocketId, data: &[u8], sent: Option<GlobalTime>) {
    let (stack, exit) = network.member_mut(1).station.stack_mut().unwrap();
    stack.send_sent_at(from, data, Some(at(0, PORT)), Flags::NONE, sent, exit).unwrap();
}

fn receive(network: &mut Network<Tdma>, socket: SocketId) -> Received {
    let line = view(network, 0);
    let (stack, _) = network.member_mut(0).station.stack_mut().unwrap();
    stack.receive(socket, &mut [0; 4_096], Flags::NONE, &line).unwrap()
}

/// Into the middle of a cycle's first part: `micros` behind its start, by global time.
fn until(network: &mut Network<Tdma>, micros: i64) {
    let gone = global(network, 0) - view(network, 0).offset.global(view(network, 0).start);
    let ahead = CYCLE * 2 - gone + Span::from_micros(micros);
    network.run_until(network.now() + ahead.nanos() as u64);
}

/// How long it waited for its slot, and was on its way.
fn parts(received: &Received) -> (Span, Span) {
    let Times { sent, left } = received.times.expect("it says so");
    let left = left.expect("it was stamped");
    (left - sent, received.global.expect("its receiver knows the time") - left)
}

#[test]
fn a_datagram_tells_how_long_it_waited_for_its_slot_and_how_long_it_was_on_its_way() {
    // The frame for a slot is chosen a lead of 50 us before it: what comes later has missed it.
    for (micros, wait) in [(1, 499), (100, 400), (449, 51), (451, 1_049), (600, 900), (999, 501)] {
        let (mut network, hears, sends) = pair(1_500);
        until(&mut network, micros);
        let sent = global(&network, 1);
        send(&mut network, sends, &bytes(100), Some(sent));
        cycles(&mut network, 2);
        let received = receive(&mut network, hears);
        assert_eq!(received.times.map(|times| times.sent), Some(sent));
        assert_eq!(
            parts(&received),
            (Span::from_micros(wait), WIRE),
            "sent {micros} us behind the cycle's start"
        );
    }
}

#[test]
fn of_a_datagram_in_fragments_the_last_one_tells() {
    let (mut network, hears, sends) = pair(500);
    until(&mut network, 100);
    let sent = global(&network, 1);
    // Three fragments, one each cycle.
    send(&mut network, sends, &bytes(1_200), Some(sent));
    cycles(&mut network, 4);
    assert_eq!(parts(&receive(&mut network, hears)), (Span::from_micros(400) + CYCLE * 2, WIRE));
}

#[test]
fn of_those_that_wait_for_one_another_each_tells_its_own() {
    let (mut network, hears, sends) = pair(1_500);
    until(&mut network, 300);
    let sent = global(&network, 1);
    (0..5).for_each(|_| send(&mut network, sends, b"one", Some(sent)));
    cycles(&mut network, 6);
    for turn in 0..5 {
        assert_eq!(parts(&receive(&mut network, hears)), (Span::from_micros(200) + CYCLE * turn, WIRE));
    }
}

#[test]
fn what_is_sent_without_times_tells_when_it_came_and_nothing_else() {
    let (mut network, hears, sends) = pair(1_500);
    send(&mut network, sends, &bytes(100), None);
    cycles(&mut network, 2);
    let received = receive(&mut network, hears);
    assert!(received.times.is_none() && received.global.is_some());
}

type Words = Arc<[AtomicU64]>;

thread_local! {
    /// True time, as the receiver's host shows it.
    static NOW: Cell<u64> = const { Cell::new(0) };
}

/// When the package that comes next was brought into its mailbox.
fn look(inbox: &mut Inbox<Words, Words>) -> u64 {
    let package = inbox.receive(0).expect("it has come");
    let delivered = package.stamps().sent;
    package.put_back();
    delivered
}

fn words(count: usize) -> Words {
    (0..count).map(|_| AtomicU64::new(0)).collect()
}

#[test]
fn the_parts_of_a_packages_age_are_known_to_the_nanosecond() {
    let host = Host { clock: || NOW.get(), priorities: Priorities::default() };
    let (mut hears, mut sends) =
        (stack(0, vec![Box::new(Router::<Words, Words>::new(host))]), stack(1, Vec::new()));
    let (reads, from) = (udp(&mut hears, LAN_PORT, 64), udp(&mut sends, LAN_PORT, 64));
    let (name, shape) = (MailboxName(0x0010_0000), Shape::new(4, 3_000));
    let layout = Layout::of(&shape);
    let (own, of_router) = (words(layout.owner_words(1)), words(layout.sender_words()));
    let mut inbox = Inbox::new(own.clone(), &shape.senders(1));
    inbox.attach(0, MailboxName::NOBODY, of_router.clone()).unwrap();
    let router = hears.program_mut::<Router<Words, Words>>().unwrap();
    router.reads(reads);
    assert!(router.add(Way::new(name, LaneSender::new(of_router, own, layout, 0), Box::new(|| ()))).is_ok());
    let slots = vec![SlotConfig { size: 1_500, ..slot(0, SLOT_US) }];
    let mut network = settled(vec![(vec![slot(0, 200)], hears), (slots, sends)]);

    // In one frame, and in two of which the second leaves a cycle later.
    for (len, cycles_more) in [(100, 0), (2_000, 1)] {
        until(&mut network, 100);
        let sent = global(&network, 1);
        let head =
            Head { priority: 9, ..Head::new(1, name, MailboxName(0x00f0_0000)) }.with_body(len).unwrap();
        let (stack, exit) = network.member_mut(1).station.stack_mut().unwrap();
        let package = [&head.to_bytes()[..], &bytes(len)].concat();
        stack.send_sent_at(from, &package, Some(at(0, LAN_PORT)), Flags::NONE, Some(sent), exit).unwrap();
        for _ in 0..2_000 {
            NOW.set(network.now() + 1_000);
            network.run_until(NOW.get());
        }
        let (line, clock) = (view(&network, 0), network.member(0).clock);
        let mailbox = Span::from_micros(30);
        let delivered = look(&mut inbox);
        let package = inbox.receive(delivered + mailbox.nanos() as u64).expect("it has come");
        let stamps = package.stamps();
        let moments =
            [stamps.sent, stamps.sent + package.waited()].map(|at| line.to_global(clock.local(at)).unwrap());
        let journey = Journey::of(&stamps, package.waited(), Some(moments));
        let wait = Span::from_micros(400) + CYCLE * cycles_more;
        assert_eq!(journey.sent, Some(sent));
        assert_eq!((journey.slot_wait(), journey.wire()), (Some(wait), Some(WIRE)));
        // Its station looks a lead before the next slot: that of the master's Synchronisation.
        let router = Span::from_micros(950 - SLOT_US) - WIRE;
        assert_eq!((journey.router(), journey.mailbox), (Some(router), mailbox));
        assert_eq!(journey.age(), Some(wait + WIRE + router + mailbox));
    }
}
