//! Who does not read, floods, or is stormed loses its own frames: others lose none, and theirs come when they would have.

use std::sync::Arc;

use rtmac::nomac::Unslotted;
use rtmac::tdma::Tdma;
use rtmac::token::bound::access_delay_bound;
use rtnet::at_once::{AtOnce, DEFAULT_ASK_EVERY, Rules};
use rtnet::buf::Pool;
use rtnet::direct::Unplugged;
use rtnet::discipline::Discipline;
use rtnet::ip::Stack;
use rtnet::sim::{Host, Network};
use rtnet::socket::{
    Access, Flags, LinkMode, LinkType, Program, Socket, SocketCounters, SocketError, SocketId,
};
use rtnet::station::Station;
use rtnet::wire::ethernet::{EtherType, Header as LinkHeader, MIN_FRAME};
use rtnet::wire::icmpv4::{Echo, Kind};
use rtnet::wire::ipv4::{Fields, Header, Protocol};
use rtnet::wire::udp;
use tests::rings;
use tests::stacks::{
    CYCLE, Does, Notes, Own, SETTLES, address, at, bytes, cycles, ip, is_settled, network, settled, slot,
    stack, udp as open,
};
use zerocopy::IntoBytes;

/// Which number came, its receive stamp, and when it was sent, by the clock of who did.
type Arrivals = Notes<(u32, u64, u64)>;

const CYCLES: u64 = 500;
/// Frames of a storm in each cycle: its medium has no slots.
const STORM: u64 = 10;
const PORT: u16 = 2_000;
/// Of the socket that is flooded, stormed, or never read.
const OTHER: u16 = 3_000;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trouble {
    /// Station 2 sends to a socket of station 0's that nobody reads.
    NeverRead,
    /// A tap on station 0 that nobody reads.
    Tap,
    /// A program of station 1, before the one that works, sends whatever its pool takes.
    Flood,
    /// Ten echoes a cycle are asked of station 0.
    Pings,
    /// Ten datagrams a cycle to another socket of station 0's begin and never go on.
    FirstFragments,
}

/// Sends a number every other millisecond, a tenth of them in three fragments, and notes what comes.
fn works(to: usize, arrivals: Arrivals) -> Box<dyn Program> {
    let (mut socket, mut number, mut sent_in) = (Own::udp(PORT, 16).with_priority(10), 0u32, 0);
    let data = bytes(4_000);
    Box::new(Does(move |sockets: &mut Access<'_>| {
        let socket = socket.id(sockets);
        let (now, mut room) = (sockets.now().nanos(), [0; 4_000]);
        while let Ok(received) = sockets.receive(socket, &mut room, Flags::NONE) {
            let stamp = received.rx.expect("stamps are sound here");
            let number = u32::from_be_bytes(*room.first_chunk().unwrap());
            let sent = u64::from_be_bytes(*room[4..].first_chunk().unwrap());
            arrivals.lock().unwrap().push((number, stamp.nanos(), sent));
        }
        let part = now / (2 * CYCLE.nanos() as u64);
        if is_settled(sockets) && part != sent_in {
            sent_in = part;
            room.copy_from_slice(&data);
            room[..4].copy_from_slice(&number.to_be_bytes());
            room[4..12].copy_from_slice(&now.to_be_bytes());
            let len = if number.is_multiple_of(10) { 4_000 } else { 64 };
            sockets.send_to(socket, &room[..len], at(to, PORT)).expect("what others do is nothing to it");
            number += 1;
        }
    }))
}

/// Sends to a socket that nobody reads: one frame in each turn, or as many as its pool takes.
fn bothers(to: usize, most: usize) -> Box<dyn Program> {
    let mut socket = Own::udp(OTHER, 64).with_priority(20);
    Box::new(Does(move |sockets: &mut Access<'_>| {
        let socket = socket.id(sockets);
        let sent = (0..most).map(|_| sockets.send_to(socket, &[7; 200], at(to, OTHER)));
        match sent.take_while(Result::is_ok).count() {
            all if all == most => {}
            _ => assert!(matches!(
                sockets.send_to(socket, &[7], at(to, OTHER)),
                Err(SocketError::NoBuffers { .. })
            )),
        }
    }))
}

fn echo(sequence: u16) -> Vec<u8> {
    let data = [9; 32];
    let echo = Echo::new(Kind::Request, 1, sequence, &data);
    packet(Protocol::ICMP, sequence, false, &[echo.as_bytes(), &data].concat())
}

fn first_fragment(identification: u16) -> Vec<u8> {
    let head = udp::Header::new(9, OTHER, 2_000);
    packet(Protocol::UDP, identification, true, &[head.as_bytes(), &[3; 16]].concat())
}

/// What station 9 would send to station 0.
fn packet(protocol: Protocol, identification: u16, more_fragments: bool, content: &[u8]) -> Vec<u8> {
    let link = LinkHeader::new(address(0), address(9), EtherType::IPV4);
    let header = Header::new(&Fields {
        source: ip(9),
        destination: ip(0),
        protocol,
        tos: 0,
        identification,
        dont_fragment: false,
        more_fragments,
        offset: 0,
        payload_len: content.len() as u16,
    });
    let mut frame = [link.as_bytes(), header.as_bytes(), content].concat();
    frame.resize(frame.len().max(MIN_FRAME), 0);
    frame
}

/// What stations 0 and 1 heard of each other, and the counters of the other sockets of station 0.
struct Outcome<D: Discipline> {
    arrivals: [Vec<(u32, u64, u64)>; 2],
    others: Vec<SocketCounters>,
    network: Network<D>,
}

/// Stations 0 and 1 work in either case, on a network of this kind.
fn run<D: Discipline>(trouble: Option<Trouble>, join: impl Fn([Stack; 3]) -> Network<D>) -> Outcome<D> {
    let is = |which: Trouble| trouble == Some(which);
    let arrivals: [Arrivals; 2] = Default::default();
    let mut troubled = stack(0, vec![works(1, arrivals[0].clone())]);
    let mut others = vec![open(&mut troubled, OTHER, 16)];
    if is(Trouble::Tap) {
        let tap = Socket::packet(LinkMode::Raw, LinkType::All, Arc::new(Pool::new(16)));
        others.push(troubled.open(tap).map_err(|(error, _)| error).unwrap());
    }
    let mut programs = vec![works(0, arrivals[1].clone())];
    if is(Trouble::Flood) {
        programs.insert(0, bothers(2, usize::MAX));
    }
    let strangers = if is(Trouble::NeverRead) { vec![bothers(0, 1)] } else { Vec::new() };
    let mut network = join([troubled, stack(1, programs), stack(2, strangers)]);
    for n in 0..CYCLES * STORM {
        match trouble {
            Some(Trouble::Pings) => network.inject(&echo(n as u16)),
            Some(Trouble::FirstFragments) => network.inject(&first_fragment(n as u16)),
            _ => {}
        }
        network.run_until(network.now() + CYCLE.nanos() as u64 / STORM);
    }
    let counters = |id: &SocketId| network.member(0).station.stack().unwrap().socket_counters(*id).unwrap();
    let others = others.iter().map(counters).collect();
    let arrivals = arrivals.map(|notes| std::mem::take(&mut *notes.lock().unwrap()));
    for (id, arrivals) in arrivals.iter().enumerate() {
        assert!(arrivals.len() as u64 >= CYCLES / 2 - 10, "{} came", arrivals.len());
        assert!(arrivals.iter().zip(0..).all(|(arrival, number)| arrival.0 == number), "some were lost");
        assert_eq!(network.dropped(id), 0, "its network card had room");
    }
    Outcome { arrivals, others, network }
}

fn in_slots([troubled, other, stranger]: [Stack; 3]) -> Network<Tdma> {
    settled(vec![(vec![slot(0, 200)], troubled), (vec![slot(0, 450)], other), (vec![slot(0, 700)], stranger)])
}

/// The same as without it: every number, to the nanosecond.
fn check_unharmed(trouble: Trouble) -> Outcome<Tdma> {
    let (calm, troubled) = (run(None, in_slots), run(Some(trouble), in_slots));
    for (calm, troubled) in calm.arrivals.iter().zip(&troubled.arrivals) {
        let stamps =
            |arrivals: &[(u32, u64, u64)]| arrivals.iter().map(|arrival| arrival.1).collect::<Vec<_>>();
        assert_eq!(stamps(calm), stamps(troubled));
    }
    troubled
}

#[test]
fn a_socket_that_is_never_read_loses_its_own_frames_only() {
    let outcome = check_unharmed(Trouble::NeverRead);
    let [other] = outcome.others[..] else { panic!("there is one") };
    assert_eq!(other.received, 16, "as many as it has buffers");
    assert!(other.dropped >= CYCLES, "{other:?}");
}

#[test]
fn a_tap_that_is_never_read_loses_its_own_frames_only() {
    let outcome = check_unharmed(Trouble::Tap);
    assert_eq!(outcome.others[1].received, 16);
    assert!(outcome.others[1].dropped > CYCLES / 2, "{:?}", outcome.others[1]);
}

#[test]
fn a_program_that_floods_is_refused_for_want_of_its_own_buffers_and_makes_nobody_elses_send_fail() {
    let outcome = check_unharmed(Trouble::Flood);
    let stack = outcome.network.member(1).station.stack().unwrap();
    let flooding =
        stack.sockets().map(|(_, socket)| socket.counters()).find(|counters| counters.no_buffers > 0);
    let flooding = flooding.expect("it has flooded");
    assert!(flooding.sent > CYCLES / 4 && flooding.no_buffers > CYCLES, "{flooding:?}");
    assert_eq!(flooding.refused + flooding.cut_short, 0);
}

#[test]
fn a_storm_of_pings_takes_the_buffers_of_echoes_only() {
    let mut outcome = check_unharmed(Trouble::Pings);
    let stack = outcome.network.member(0).station.stack().unwrap();
    let (answered, [icmp, _]) = (stack.counters().echoes_answered, stack.pools());
    assert!((CYCLES / 4..CYCLES).contains(&answered), "as many as its slot leaves room for: {answered}");
    assert!(icmp.statistics.exhausted > CYCLES, "{icmp:?}");
    cycles(&mut outcome.network, 50);
    let [icmp, _] = outcome.network.member(0).station.stack().unwrap().pools();
    assert_eq!(icmp.statistics.free, icmp.statistics.capacity);
}

#[test]
fn a_storm_of_first_fragments_takes_the_buffers_of_the_socket_that_it_is_for_only() {
    let outcome = check_unharmed(Trouble::FirstFragments);
    let collectors = outcome.network.member(0).station.stack().unwrap().counters().collectors;
    assert!(collectors.given_up > CYCLES * (STORM - 1), "{collectors:?}");
}

const TROUBLES: [Trouble; 5] =
    [Trouble::NeverRead, Trouble::Tap, Trouble::Flood, Trouble::Pings, Trouble::FirstFragments];

/// How long each number took from its program to the stamp of its receiver, in nanoseconds, where stations share the medium
/// like this.
fn times_with<D: Discipline>(trouble: Trouble, discipline: impl Fn(usize) -> D) -> Vec<i64> {
    let outcome = run(Some(trouble), |stacks| {
        let of = |(id, stack)| Station::new(discipline(id), Vec::new()).with_stack(stack);
        let mut network = network((0..).zip(stacks).map(of).collect(), Host::IDEAL);
        cycles(&mut network, SETTLES);
        network
    });
    let times = outcome.arrivals.iter().enumerate().flat_map(|(id, arrivals)| {
        let [here, there] = [id, 1 - id].map(|id| outcome.network.member(id).clock.offset.nanos());
        arrivals.iter().map(move |&(_, stamp, sent)| stamp as i64 - sent as i64 - (here - there))
    });
    times.collect()
}

/// Without slots nobody waits for one: a number is there when it has been on its way.
fn check_unharmed_at_once<R: Rules>(trouble: Trouble) {
    let times = times_with(trouble, |_| AtOnce::<R>::new(DEFAULT_ASK_EVERY));
    assert!(times.iter().all(|time| *time == 500), "{trouble:?}");
}

#[test]
fn without_slots_others_lose_no_frame_either_and_none_of_theirs_waits() {
    for trouble in TROUBLES {
        check_unharmed_at_once::<Unplugged>(trouble);
        check_unharmed_at_once::<Unslotted>(trouble);
    }
}

#[test]
fn in_a_ring_others_lose_no_frame_either_and_theirs_wait_no_longer_than_the_bound() {
    let all: Vec<usize> = (0..3).collect();
    let config = rings::quick(all.iter().map(|&id| address(id)).collect());
    // On its way besides, and as long as its receiver waits for the frames that were first.
    let bound = access_delay_bound(&config, all.len(), 0) + config.delay;
    for trouble in TROUBLES {
        let times = times_with(trouble, |id| rings::in_a_ring(id, &all));
        let longest = times.iter().max().expect("some came");
        assert!(*longest <= bound.nanos(), "{trouble:?}: {longest} ns, and no more than {bound}");
    }
}
