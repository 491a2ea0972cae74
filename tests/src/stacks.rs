//! Stations with sockets in virtual time: in slots or without, each knows all others, and no clock drifts.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, Mutex};

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, RoleConfig, SlaveConfig, SlotConfig, Tdma,
    TdmaConfig,
};
use rtnet::buf::Pool;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Channel, Discipline, SyncState};
use rtnet::ip::route::{HostRoute, Interface, Origin};
use rtnet::ip::{Stack, StackConfig};
use rtnet::queue::Priority;
use rtnet::sim::{Host, Medium, Member, Network};
use rtnet::socket::{Access, Options, Program, Socket, SocketId};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, MTU};

use crate::networks::epoch;
use crate::seeds;

/// From one cycle's start to the next.
pub const CYCLE: Span = Span::from_millis(1);
/// True time when networks begin.
pub const BEGIN: u64 = 10_000_000_000;
/// How late in its slot a station may send.
const LATEST: Span = Span::from_micros(20);
/// Cycles until all follow the master, with their calibration, and programs have opened their sockets.
pub const SETTLES: u64 = 600;

/// Address of a station.
pub fn address(id: usize) -> Address {
    Address([2, 0, 0, 0, 0, id as u8 + 1])
}

/// Its IP address.
pub fn ip(id: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 0, 0, id as u8 + 1)
}

/// A port of it.
pub fn at(id: usize, port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(ip(id), port)
}

/// A stack that knows stations 0 to 9, with these programs.
pub fn stack(id: usize, programs: Vec<Box<dyn Program>>) -> Stack {
    let mut stack = strange_stack(id, programs);
    for other in (0..10).filter(|&other| other != id) {
        let route = HostRoute { ip: ip(other), address: address(other), origin: Origin::Static };
        stack.routes_mut().add_host(route).expect("there is room");
    }
    stack
}

/// The same of one that knows nobody.
pub fn strange_stack(id: usize, programs: Vec<Box<dyn Program>>) -> Stack {
    let interface = Interface { address: address(id), ip: ip(id), prefix: 24 };
    Stack::new(StackConfig::new(interface), programs)
}

/// A UDP socket of a stack, with so many buffers, bound to a port.
pub fn udp(stack: &mut Stack, port: u16, buffers: usize) -> SocketId {
    let id = stack.open(Socket::udp(Arc::new(Pool::new(buffers)))).map_err(|(error, _)| error);
    let id = id.expect("there is room");
    stack.bind(id, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)).expect("the port is free");
    id
}

/// A program that is a closure.
pub struct Does<F>(pub F);

impl<F: FnMut(&mut Access<'_>) + Send + 'static> Program for Does<F> {
    fn run(&mut self, sockets: &mut Access<'_>) {
        (self.0)(sockets);
    }
}

/// A UDP socket of a program's own, which it opens when it runs first.
pub struct Own {
    closed: Option<Box<Socket>>,
    port: u16,
    options: Options,
    id: Option<SocketId>,
}

impl Own {
    /// With so many buffers, bound to a port.
    pub fn udp(port: u16, buffers: usize) -> Self {
        let closed = Some(Socket::udp(Arc::new(Pool::new(buffers))));
        Self { closed, port, options: Options::default(), id: None }
    }

    /// The same that sends with another priority.
    pub fn with_priority(self, level: u8) -> Self {
        let priority = Priority::new(level).expect("a level");
        Self { options: Options { priority, ..self.options }, ..self }
    }

    /// The same that sends in another slot.
    pub fn in_channel(self, channel: Channel) -> Self {
        Self { options: Options { channel, ..self.options }, ..self }
    }

    /// Its name.
    pub fn id(&mut self, sockets: &mut Access<'_>) -> SocketId {
        if let Some(socket) = self.closed.take() {
            let id = sockets.open(socket).map_err(|(error, _)| error).expect("there is room");
            sockets.bind(id, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, self.port)).expect("the port is free");
            sockets.set_options(id, self.options).expect("it is open");
            self.id = Some(id);
        }
        self.id.expect("it was opened")
    }
}

/// Whether all stations of a network that has settled are there, by any one's clock.
pub fn is_settled(sockets: &Access<'_>) -> bool {
    sockets.now().nanos() >= BEGIN + (SETTLES + 10) * CYCLE.nanos() as u64
}

/// What a program notes.
pub type Notes<T> = Arc<Mutex<Vec<T>>>;

/// A slot of every cycle.
pub fn slot(id: u8, micros: i64) -> SlotConfig {
    let offset = Span::from_micros(micros);
    SlotConfig { id, offset, phase: 0, period: 1, size: MTU, joint: None, latest: LATEST }
}

/// A TDMA station: number 0 is the master.
pub fn in_slots(id: usize, slots: &[SlotConfig]) -> Tdma {
    let follow = SlaveConfig { rounds: 10, ..SlaveConfig::default() };
    let role = match id {
        0 => RoleConfig::Master(MasterConfig { epoch: epoch(), follow, ..MasterConfig::new(CYCLE, LATEST) }),
        _ => RoleConfig::Slave(follow),
    };
    let (slots, max_slot_id) = (slots.to_vec(), DEFAULT_MAX_SLOT_ID);
    let (lead, late) = (DEFAULT_LEAD, LatePolicy::Skip);
    let config = TdmaConfig { address: address(id), role, slots, max_slot_id, lead, late };
    Tdma::new(&config).expect("the plan is sound")
}

/// A network of these stations on hosts like this one, which begin at once.
pub fn network<D: Discipline>(stations: Vec<Station<D>>, host: Host) -> Network<D> {
    let mut network = Network::new(Medium::default(), seeds::one("stacks"));
    network.run_until(BEGIN);
    for (id, station) in stations.into_iter().enumerate() {
        let clock = EmulatedClock { anchor: BEGIN, offset: Span::from_micros(id as i64 * 777), drift_ppb: 0 };
        network.add(Member { address: address(id), clock, host: host.clone().into(), station }, BEGIN);
    }
    network
}

/// The same of TDMA stations, each with its slots and stack, which all follow the master.
pub fn settled(stations: Vec<(Vec<SlotConfig>, Stack)>) -> Network<Tdma> {
    let count = stations.len();
    let numbered = stations.into_iter().enumerate();
    let stations =
        numbered.map(|(id, (slots, stack))| Station::new(in_slots(id, &slots), Vec::new()).with_stack(stack));
    let mut network = network(stations.collect(), Host::IDEAL);
    cycles(&mut network, SETTLES);
    for id in 0..count {
        assert_eq!(network.member(id).station.discipline().time().state, SyncState::Locked, "station {id}");
    }
    network
}

/// Lets so many cycles pass.
pub fn cycles<D: Discipline>(network: &mut Network<D>, count: u64) {
    network.run_until(network.now() + count * CYCLE.nanos() as u64);
}

/// Bytes that tell where in a datagram they are.
pub fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 7 + n / 251) as u8).collect()
}

/// Asserts that every buffer of a stack is at home.
pub fn assert_pools_full(stack: &Stack, whose: &str) {
    for pool in stack.pools() {
        assert_eq!(pool.statistics.free, pool.statistics.capacity, "{} of {whose}", pool.name);
    }
    for (id, socket) in stack.sockets() {
        assert_eq!(socket.pool().available(), socket.pool().capacity(), "{id:?} of {whose}");
    }
}
