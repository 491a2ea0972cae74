//! A whole station, TDMA with sockets above it and a program that answers, on a hostile medium.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, RoleConfig, SlaveConfig, SlotConfig, Tdma,
    TdmaConfig,
};
use rtmac::wire::{self, Message};
use rtnet::buf::Pool;
use rtnet::discipline::{Discipline, SyncState};
use rtnet::ip::route::{HostRoute, Interface, Origin};
use rtnet::ip::{Stack, StackConfig};
use rtnet::socket::{Access, Flags, Program, Sender, Socket, SocketId};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME};
use tests::bench::Bench;
use tests::ends::{A, B, End};

use super::engine::{Target, fuzz, outcome};
use super::frames;
use super::steps::{self, Step};

const CYCLE: Span = Span::from_millis(1);
/// Of the slots, behind the Ethernet header.
const SIZE: usize = 512;
const PORT: u16 = 36_000;
/// Syncs that a slave is locked after, and the turns that empty every queue.
const HEARD: u32 = 3;
const LAST: u32 = 60;

#[test]
fn station_takes_any_frames() {
    fuzz(&Target { name: "station", seeds: seeds(), has_corpus: true, mutate: steps::change, run });
}

/// Gives back what comes.
struct Echo {
    socket: SocketId,
    room: Vec<u8>,
}

impl Program for Echo {
    fn run(&mut self, sockets: &mut Access<'_>) {
        while let Ok(received) = sockets.receive(self.socket, &mut self.room, Flags::NONE) {
            if let Sender::Udp(from) = received.from {
                // Who has no route, or too many at once, has no answer.
                let _ = sockets.send_to(self.socket, &self.room[..received.len], from);
            }
        }
    }
}

/// Begin of a cycle, on the master's clock and the station's.
fn start(cycle: u32) -> Instant {
    Instant::from_nanos(1_000_000_000_000) + CYCLE * i64::from(cycle)
}

fn station(is_master: bool) -> Station<Tdma> {
    let latest = Span::from_micros(50);
    let follow = SlaveConfig { rounds: 0, ..SlaveConfig::default() };
    let role = if is_master {
        RoleConfig::Master(MasterConfig { follow, ..MasterConfig::new(CYCLE, latest) })
    } else {
        RoleConfig::Slave(follow)
    };
    let slot = |id, offset| {
        let offset = Span::from_micros(offset);
        SlotConfig { id, offset, phase: 0, period: 1, size: SIZE, joint: None, latest }
    };
    let tdma = Tdma::new(&TdmaConfig {
        address: A.0,
        role,
        slots: vec![slot(0, 200), slot(1, 400)],
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    });
    Station::new(tdma.expect("a sound configuration"), vec![]).with_stack(stack())
}

fn stack() -> Stack {
    let config = StackConfig::new(Interface { address: A.0, ip: A.1, prefix: 24 });
    let mut empty = Stack::new(config.clone(), Vec::new());
    let open = |stack: &mut Stack| {
        let socket = stack.open(Socket::udp(Arc::new(Pool::new(16)))).map_err(|(error, _)| error);
        let socket = socket.expect("room for one");
        stack.bind(socket, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)).expect("a free port");
        socket
    };
    // The first of any stack has the same name.
    let socket = open(&mut empty);
    let mut stack = Stack::new(config, vec![Box::new(Echo { socket, room: vec![0; 65_536] })]);
    assert_eq!(open(&mut stack), socket);
    let route = HostRoute { ip: B.1, address: B.0, origin: Origin::Static };
    stack.routes_mut().add_host(route).expect("room");
    stack
}

fn genuine_sync(bench: &mut Bench<Tdma>, cycle: u32) {
    let mut frame = Pool::new(1).take().expect("a new pool is full");
    let (sched, late) = (GlobalTime::from_nanos(start(cycle).nanos()), Span::from_micros(5));
    Message::Sync { cycle, xmit: sched + late, sched }.write(Address::BROADCAST, B.0, &mut frame);
    bench.frame(start(cycle) + late, &frame);
}

/// Kinds: 0 a frame, later by the argument in microseconds; 1 the next cycle. The first argument says which role.
fn run(input: &[u8]) -> Vec<u64> {
    let steps = steps::read(input);
    let is_master = steps.first().is_some_and(|first| first.argument & 1 == 1);
    let begin = if is_master { start(0) - CYCLE * 3 } else { start(0) };
    let mut bench = Bench::new(station(is_master), begin);
    let mut cycle = 0;
    let next = |bench: &mut Bench<Tdma>, cycle: &mut u32| {
        *cycle += 1;
        if is_master { bench.advance(start(*cycle)) } else { genuine_sync(bench, *cycle) }
    };
    while cycle < HEARD {
        next(&mut bench, &mut cycle);
    }
    let (mut now, mut heard) = (start(cycle) + Span::from_micros(10), 0);
    for Step { kind, argument, bytes } in &steps {
        if kind % 4 == 1 || now >= start(cycle + 1) - Span::from_micros(20) {
            next(&mut bench, &mut cycle);
            now = start(cycle) + Span::from_micros(10);
        }
        if kind % 4 != 1 {
            now += Span::from_micros(i64::from(*argument));
            bench.frame(now, bytes);
            heard += 1;
        }
    }
    let refused = bench.station.refusals().total();
    assert!(refused <= heard, "{refused} of {heard}");
    for _ in 0..LAST {
        next(&mut bench, &mut cycle);
    }
    bench.advance(start(cycle + 1));
    check_sent(&bench, cycle);
    check_pools(&mut bench);
    let state = bench.station.discipline().time().state;
    // In which role, in which state in the end, for which reason how often, and how much was sent.
    let whole = outcome([state as u64, is_master.into()]);
    let of_whole = |part, n: u64| outcome([whole, part, n.checked_ilog2().unwrap_or(0).into()]);
    let reasons = bench.station.refusals().nonzero().map(|(reason, n)| of_whole(reason as u64, n));
    reasons.chain([of_whole(u64::MAX, bench.sent.len() as u64)]).collect()
}

/// Nothing that others could be harmed by, and nothing that does not fit a slot, or more than there are slots.
fn check_sent(bench: &Bench<Tdma>, cycles: u32) {
    let mut of_stack = 0;
    for (_, frame) in &bench.sent {
        let (header, _) = Header::parse(frame).expect("a frame has a header");
        assert!(!wire::is_lethal(frame), "{frame:02x?}");
        assert!((MIN_FRAME..=HEADER_LEN + SIZE).contains(&frame.len()), "{}", frame.len());
        if header.ether_type() != EtherType::RTMAC {
            assert!([EtherType::IPV4, EtherType::ARP].contains(&header.ether_type()), "{header:?}");
            assert_eq!(header.source, A.0);
            of_stack += 1;
        }
    }
    // A forged time line may be a little ahead of the genuine one.
    assert!(of_stack <= 2 * (cycles as usize + 10), "{of_stack} in {cycles} cycles");
}

/// Where the station sends, everything comes home; where it was silenced, what waits is in its queues.
fn check_pools(bench: &mut Bench<Tdma>) {
    let is_sending = bench.station.discipline().time().state == SyncState::Locked;
    let status = bench.station.discipline().status();
    let queued: usize = status.slots.iter().flatten().map(|slot| slot.queued).sum();
    let stack = bench.station.stack().expect("it has one");
    let of_stack =
        stack.pools().map(|pool| pool.statistics.capacity - pool.statistics.free).iter().sum::<usize>();
    let of_sockets = stack.sockets().map(|(id, socket)| {
        let statistics = socket.pool().statistics();
        statistics.capacity - statistics.free - socket.waiting() - stack.collecting(id)
    });
    assert_eq!(of_stack + of_sockets.sum::<usize>(), queued, "what is not at home waits to leave");
    assert!(queued == 0 || !is_sending, "{queued} wait, in {:?}", status.state);
}

fn seeds() -> Vec<Vec<u8>> {
    let frame = |argument, bytes| Step { kind: 0, argument, bytes };
    let turn = || Step { kind: 1, argument: 0, bytes: Vec::new() };
    let mut b = End::new(B);
    b.knows(A);
    let socket = b.socket(1_000, 64);
    b.stack.solicit(A.1, &mut b.queue).expect("room");
    for len in [16, 3_000] {
        b.send(socket, &vec![9; len], Some(SocketAddrV4::new(A.1, PORT))).expect("room");
    }
    b.stack.ask_echo(A.1, (1, 1), &[3; 900], Default::default(), &mut b.queue).expect("room");
    let asked = b.leaves(usize::MAX);
    let mut all = Vec::new();
    for role in 0..2 {
        let to_us: Vec<_> = asked.iter().map(|bytes| frame(2 | role, bytes.clone())).collect();
        all.push([to_us.clone(), vec![turn()], to_us].concat());
        let heard: Vec<_> = frames::all().into_iter().map(|bytes| frame(8 | role, bytes)).collect();
        all.extend(heard.chunks(16).map(<[Step]>::to_vec));
    }
    all.iter().map(|steps| steps::write(steps)).collect()
}

#[test]
fn the_seeds_of_the_station_are_answered_in_its_slots() {
    for is_master in [false, true] {
        let seed = &seeds()[if is_master { seeds().len() / 2 } else { 0 }];
        let mut bench =
            Bench::new(station(is_master), if is_master { start(0) - CYCLE * 3 } else { start(0) });
        let next = |bench: &mut Bench<Tdma>, cycle| {
            if is_master { bench.advance(start(cycle)) } else { genuine_sync(bench, cycle) }
        };
        (1..=HEARD).for_each(|cycle| next(&mut bench, cycle));
        for step in steps::read(seed).iter().filter(|step| step.kind == 0) {
            bench.frame(start(HEARD) + Span::from_micros(10), &step.bytes);
        }
        (HEARD + 1..HEARD + 40).for_each(|cycle| next(&mut bench, cycle));
        let kind = |of: EtherType| move |(_, sent): &&(Instant, Vec<u8>)| sent[12..14] == of.0.to_be_bytes();
        assert_eq!(bench.sent.iter().filter(kind(EtherType::ARP)).count(), 2);
        // Twice: a small datagram, one of seven fragments, an echo of two.
        assert_eq!(bench.sent.iter().filter(kind(EtherType::IPV4)).count(), 20);
        check_pools(&mut bench);
    }
}
