//! Stations with sockets: what they send, receive, answer, ask, put together and give up allocates nothing.

use std::sync::{Arc, Mutex};

use rtmac::tdma::Tdma;
use rtmac::token::Token;
use rtnet::Direct;
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::buf::Pool;
use rtnet::discipline::{Discipline, TimeView};
use rtnet::live::Bells;
use rtnet::sim::{Host, Latency, Network};
use rtnet::socket::{
    Access, Flags, LinkMode, LinkType, Options, Program, Sender, Socket, SocketError, SocketId,
};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{EtherType, MTU};
use tests::rings;
use tests::stacks::{
    self, CYCLE, Does, Own, address, assert_pools_full, at, bytes, cycles, ip, network, slot, stack,
};
use tools::control::EchoRequest;
use tools::station::echoes::Echoes;

use crate::calls;

const PORT: u16 = 2_000;

/// What a program has done.
#[derive(Clone, Copy, Debug, Default)]
struct Done {
    sent: u64,
    received: u64,
    refused: u64,
    frames: u64,
    /// It sends no more.
    rests: bool,
}

/// Sends datagrams to another station so often, now and then in fragments, and frames; reads all that comes, and counts.
fn works(to: usize, every: Span, done: Arc<Mutex<Done>>) -> Box<dyn Program> {
    let mut own = Own::udp(PORT, 64);
    let packet =
        Socket::packet(LinkMode::Datagram, LinkType::Only(EtherType::EXPERIMENTAL), Arc::new(Pool::new(16)));
    let (mut packet, mut frames): (_, Option<SocketId>) = (Some(packet), None);
    let (data, mut last) = (bytes(20_000), Instant::default());
    Box::new(Does(move |sockets: &mut Access<'_>| {
        let socket = own.id(sockets);
        if let Some(packet) = packet.take() {
            frames = sockets.open(packet).ok();
        }
        let frames = frames.expect("it was opened");
        let mut done = done.lock().expect("nobody panics");
        let mut room = [0; 20_000];
        while let Ok(received) = sockets.receive(socket, &mut room, Flags::NONE) {
            assert!(matches!(received.from, Sender::Udp(_)) && room[..received.len] == data[..received.len]);
            done.received += 1;
        }
        while sockets.receive(frames, &mut room, Flags::NONE).is_ok() {
            done.frames += 1;
        }
        if done.rests || sockets.now() - last < every {
            return;
        }
        last = sockets.now();
        for len in [64, 1_000, if done.sent.is_multiple_of(16) { 20_000 } else { 200 }] {
            match sockets.send_to(socket, &data[..len], at(to, PORT)) {
                Ok(()) => done.sent += 1,
                Err(SocketError::NoBuffers { .. }) => done.refused += 1,
                Err(error) => panic!("{error}"),
            }
        }
        let _ = sockets.send_frame(frames, &data[..100], Some((address(to), EtherType::EXPERIMENTAL)));
    }))
}

/// Two stations that work with each other, one of them with a tap and a socket that nobody reads.
struct Pair<D: Discipline> {
    network: Network<D>,
    done: [Arc<Mutex<Done>>; 2],
    round: u16,
}

fn stacks_of(done: &[Arc<Mutex<Done>>; 2], every: Span) -> [rtnet::ip::Stack; 2] {
    let [mut one, other] = [0, 1].map(|id| stack(id, vec![works(1 - id, every, done[id].clone())]));
    stacks::udp(&mut one, 3_000, 16);
    let tap = Socket::packet(LinkMode::Raw, LinkType::All, Arc::new(Pool::new(16)));
    one.open(tap).map_err(|(error, _)| error).expect("there is room");
    [one, other]
}

fn without_slots() -> Pair<Direct> {
    let done = Default::default();
    let stations = stacks_of(&done, CYCLE)
        .map(|stack| Station::new(Direct::new(DEFAULT_ASK_EVERY), Vec::new()).with_stack(stack));
    let send = Latency::Constant(Span::from_micros(12));
    let mut network = network(stations.into(), Host { send, ..Host::IDEAL });
    cycles(&mut network, 10);
    Pair { network, done, round: 0 }
}

fn in_a_ring() -> Pair<Token> {
    let done = Default::default();
    let [one, other] = stacks_of(&done, CYCLE * 8);
    let station = |id, stack| Station::new(rings::in_a_ring(id, &[0, 1]), Vec::new()).with_stack(stack);
    let mut network = network(vec![station(0, one), station(1, other)], Host::IDEAL);
    cycles(&mut network, 10);
    Pair { network, done, round: 0 }
}

fn in_slots() -> Pair<Tdma> {
    let done = Default::default();
    let [one, other] = stacks_of(&done, CYCLE * 8);
    let network = stacks::settled(vec![(vec![slot(0, 200)], one), (vec![slot(0, 600)], other)]);
    Pair { network, done, round: 0 }
}

impl<D: Discipline> Pair<D> {
    /// As many cycles with echoes, questions for addresses, and datagrams that nobody reads or that never become whole.
    fn works_for(&mut self, count: u64) {
        let data = [5; MTU];
        for _ in 0..count / 10 {
            self.round = self.round.wrapping_add(1);
            let (stack, exit) = self.network.member_mut(1).station.stack_mut().expect("it has one");
            let _ = stack.ask_echo(ip(0), (7, self.round), &data[..56], Options::default(), exit);
            let _ = stack.solicit(ip(0), exit);
            let first = stack.sockets().next().map(|(id, _)| id).expect("it has sockets");
            let _ = stack.send_to(first, &data[..9], Some(at(0, 3_000)), Flags::NONE, exit);
            cycles(&mut self.network, 10);
            let (stack, _) = self.network.member_mut(1).station.stack_mut().expect("it has one");
            while stack.next_pong().is_some() {}
        }
    }

    fn done(&self) -> [Done; 2] {
        [0, 1].map(|id| *self.done[id].lock().expect("nobody panics"))
    }
}

fn check_allocates_nothing<D: Discipline>(mut pair: Pair<D>) {
    // The simulator's own lists become as long as they will be.
    pair.works_for(1_000);
    let (before, done) = (calls(), pair.done());
    pair.works_for(1_000);
    let allocations = calls() - before;
    for (before, after) in done.iter().zip(pair.done()) {
        assert!(
            after.received > before.received + 200 && after.frames > before.frames + 10,
            "{before:?} {after:?}"
        );
    }
    let counters = pair.network.member(0).station.stack().expect("it has one").counters();
    assert!(counters.echoes_answered > 50, "{counters:?}");
    assert_eq!(allocations, 0);
}

#[test]
fn sockets_in_slots_allocate_nothing() {
    check_allocates_nothing(in_slots());
}

#[test]
fn sockets_in_a_ring_allocate_nothing() {
    check_allocates_nothing(in_a_ring());
}

#[test]
fn sockets_without_slots_allocate_nothing() {
    check_allocates_nothing(without_slots());
}

#[test]
fn what_a_ping_asks_for_allocates_nothing_in_the_stations_thread() {
    let bells = Bells::new().expect("a host has descriptors");
    let mut echoes = Echoes::new(&bells).expect("the same");
    let stacks = [stack(0, vec![Box::new(echoes.asker())]), stack(1, Vec::new())];
    let stations = stacks.map(|own| Station::new(Direct::new(DEFAULT_ASK_EVERY), Vec::new()).with_stack(own));
    let mut network = network(stations.into(), Host::IDEAL);
    let (mut allocations, mut came, mut failed) = (0, 0, 0);
    for sequence in 0..3_000 {
        // A station that answers, this one itself, and nobody.
        let to = [ip(1), ip(0), ip(20)][usize::from(sequence) % 3];
        let echo = EchoRequest { to, identifier: 7, sequence, size: 56, priority: 30, channel: 1 };
        echoes.ask(echo, Instant::default).expect("the one before was taken");
        let before = calls();
        cycles(&mut network, 2);
        // The simulator's own lists become as long as they will be.
        allocations += if sequence < 1_000 { 0 } else { calls() - before };
        let news = echoes.of(7);
        (came, failed) = (came + news.came.len(), failed + news.failed.len());
    }
    assert_eq!((came, failed), (2_000, 1_000));
    assert_eq!(allocations, 0);
}

#[test]
fn a_hundred_thousand_datagrams_leave_all_pools_as_they_were() {
    let mut pair = without_slots();
    pair.works_for(1_000);
    let before = calls();
    while pair.done().iter().map(|done| done.received).sum::<u64>() < 100_000 {
        pair.works_for(1_000);
    }
    assert_eq!(calls() - before, 0, "memory is constant");
    // What nobody reads is all that is out then.
    pair.done.iter().for_each(|done| done.lock().expect("nobody panics").rests = true);
    cycles(&mut pair.network, 1_100);
    for id in [0, 1] {
        let (stack, _) = pair.network.member_mut(id).station.stack_mut().expect("it has one");
        let (ids, mut room): (Vec<SocketId>, _) = (stack.sockets().map(|(id, _)| id).collect(), [0; 20_000]);
        for socket in ids {
            while stack.receive(socket, &mut room, Flags::NONE, &TimeView::default()).is_ok() {}
        }
        assert_pools_full(pair.network.member(id).station.stack().expect("it has one"), "a station");
    }
}
