//! Calls of programs on two stations, by chance, against a simple model: which ports are whose, and what waits where.

use std::collections::{BTreeMap, VecDeque};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use rtnet::buf::Pool;
use rtnet::ip::StackConfig;
use rtnet::ip::route::Interface;
use rtnet::socket::{Flags, Sender, Socket, SocketError, SocketId};
use tests::ends::{A, B, C, End};

use super::engine::{Target, fuzz, in_turn, outcome};
use super::steps::{self, Step};

const SOCKETS: u16 = 4;
const PORTS: core::ops::RangeInclusive<u16> = 1024..=1026;
const ROOM: usize = 64;
/// Bytes of a datagram in each of its frames.
const EACH: usize = 1480;
const ALL_HERE: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 255);

#[test]
fn sockets_do_what_the_model_does() {
    fuzz(&Target { name: "sockets", seeds: seeds(), has_corpus: true, mutate: steps::change, run });
}

/// A station as the model has it.
#[derive(Default)]
struct Model {
    sockets: BTreeMap<SocketId, ModelSocket>,
    /// What has not left yet: whose, from where, to where, what.
    leaving: VecDeque<(SocketId, SocketAddrV4, SocketAddrV4, Vec<u8>)>,
}

struct ModelSocket {
    local: SocketAddrV4,
    is_bound: bool,
    peer: Option<SocketAddrV4>,
    capacity: usize,
    /// What waits to be read, and from whom.
    waiting: VecDeque<(SocketAddrV4, Vec<u8>)>,
}

/// Buffers that a datagram takes.
fn buffers(data: &[u8]) -> usize {
    (data.len() + 8).div_ceil(EACH)
}

impl Model {
    fn get(&mut self, id: SocketId) -> Result<&mut ModelSocket, SocketError> {
        self.sockets.get_mut(&id).ok_or(SocketError::NoSuchSocket)
    }

    fn free(&self, id: SocketId) -> usize {
        let socket = &self.sockets[&id];
        let waiting: usize = socket.waiting.iter().map(|(_, data)| buffers(data)).sum();
        let leaving = self.leaving.iter().filter(|(of, ..)| *of == id).map(|(.., data)| buffers(data));
        socket.capacity - waiting - leaving.sum::<usize>()
    }

    fn has_port(&self, port: u16) -> bool {
        self.sockets.values().any(|socket| socket.local.port() == port)
    }

    /// The port of a socket that is opened.
    fn open(&self) -> Result<u16, SocketError> {
        if self.sockets.len() == usize::from(SOCKETS) {
            return Err(SocketError::TooMany(SOCKETS.into()));
        }
        let none = SocketError::NoPortLeft { first: *PORTS.start(), last: *PORTS.end() };
        PORTS.clone().find(|&port| !self.has_port(port)).ok_or(none)
    }

    fn bind(&mut self, own: Ipv4Addr, id: SocketId, to: SocketAddrV4) -> Result<(), SocketError> {
        if ![own, Ipv4Addr::UNSPECIFIED, Ipv4Addr::LOCALHOST, ALL_HERE, Ipv4Addr::BROADCAST].contains(to.ip())
        {
            return Err(SocketError::NotOurAddress(*to.ip()));
        }
        let before = self.get(id)?.local.port();
        let port = if to.port() == 0 { before } else { to.port() };
        // Those at different addresses have the same port.
        let is_taken = self.sockets.iter().filter(|(other, _)| **other != id).any(|(_, other)| {
            let ips = [*other.local.ip(), *to.ip()];
            other.local.port() == port && (ips[0] == ips[1] || ips.iter().any(Ipv4Addr::is_unspecified))
        });
        let socket = self.get(id)?;
        match () {
            () if socket.is_bound => Err(SocketError::AlreadyBound(before)),
            () if is_taken => Err(SocketError::PortInUse(port)),
            () => {
                (socket.local, socket.is_bound) = (SocketAddrV4::new(*to.ip(), port), true);
                Ok(())
            }
        }
    }

    fn connect(&mut self, id: SocketId, peer: Option<SocketAddrV4>) -> Result<(), SocketError> {
        peer.map_or(Ok(()), is_destination)?;
        self.get(id)?.peer = peer;
        Ok(())
    }

    fn send(
        &mut self,
        own: Ipv4Addr,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
    ) -> Result<(), SocketError> {
        let socket = self.get(id)?;
        let (to, capacity) = (to.or(socket.peer).ok_or(SocketError::NotConnected)?, socket.capacity);
        let local = socket.local;
        // What is sent to a loopback address comes from one.
        let source = match to.ip().is_loopback() {
            true if local.ip().is_loopback() => *local.ip(),
            true => Ipv4Addr::LOCALHOST,
            false => own,
        };
        let from = SocketAddrV4::new(source, local.port());
        is_destination(to)?;
        if data.len() > 65_507 {
            return Err(SocketError::TooLong(data.len()));
        }
        let other = if own == A.1 { B.1 } else { A.1 };
        if ![own, other, ALL_HERE, Ipv4Addr::BROADCAST, Ipv4Addr::LOCALHOST].contains(to.ip()) {
            return Err(SocketError::NoRoute(*to.ip()));
        }
        let (needed, free) = (buffers(data), self.free(id));
        if needed > capacity {
            return Err(SocketError::NeverFits { needed, capacity, most: 1_480 * capacity - 8 });
        }
        if needed > free {
            return Err(SocketError::NoBuffers { needed, free, capacity });
        }
        if *to.ip() == own || to.ip().is_loopback() {
            // Who sends to itself pays with one of its own for what it keeps.
            self.deliver(own, from, to, data.to_vec(), Some((id, needed)));
        } else {
            self.leaving.push_back((id, from, to, data.to_vec()));
        }
        Ok(())
    }

    /// A datagram comes; `sending`: of a socket of this station's own, whose buffers it is in.
    fn deliver(
        &mut self,
        own: Ipv4Addr,
        from: SocketAddrV4,
        to: SocketAddrV4,
        data: Vec<u8>,
        sending: Option<(SocketId, usize)>,
    ) {
        let hears = |socket: &ModelSocket| {
            let is_all = *to.ip() == ALL_HERE && *socket.local.ip() == own;
            let is_address = socket.local.ip().is_unspecified() || socket.local.ip() == to.ip() || is_all;
            socket.local.port() == to.port() && is_address && socket.peer.is_none_or(|peer| peer == from)
        };
        let hearing = self.sockets.iter().filter(|(_, socket)| hears(socket));
        let Some((&id, _)) = hearing.min_by_key(|(_, socket)| socket.local.ip() != to.ip()) else { return };
        let needed = match sending {
            Some((sender, taken)) if sender == id => taken + 1,
            _ => buffers(&data),
        };
        if self.free(id) >= needed {
            self.sockets.get_mut(&id).expect("found").waiting.push_back((from, data));
        }
    }
}

fn is_destination(to: SocketAddrV4) -> Result<(), SocketError> {
    let is_one = !to.ip().is_unspecified() && to.port() != 0;
    is_one.then_some(()).ok_or(SocketError::NoDestination(*to.ip(), to.port()))
}

/// Both stations, and the model of each.
struct Both {
    ends: [End; 2],
    models: [Model; 2],
    /// All that were ever opened, closed ones among them.
    ids: [Vec<SocketId>; 2],
}

fn run(input: &[u8]) -> Vec<u64> {
    let end = |(address, ip), other| {
        let interface = Interface { address, ip, prefix: 24 };
        let mut end =
            End::with(StackConfig { sockets: SOCKETS, ports: PORTS, ..StackConfig::new(interface) });
        end.knows(other);
        end
    };
    let mut both = Both { ends: [end(A, B), end(B, A)], models: Default::default(), ids: Default::default() };
    let mut outcomes = Vec::new();
    for step in steps::read(input) {
        let came_of_it = both.step(&step);
        both.check();
        outcomes.push(outcome([u64::from(step.kind % 13), came_of_it]));
    }
    both.ends.iter_mut().for_each(End::check_all_comes_home);
    in_turn(&outcomes)
}

impl Both {
    /// Bytes 0 and 1 say which address and port, 2 and 3 how long.
    fn step(&mut self, Step { kind, argument, bytes }: &Step) -> u64 {
        let (n, which) = (usize::from(*argument), usize::from(argument & 1));
        let byte = |at: usize| bytes.get(at).copied().unwrap_or(0);
        let own = [A.1, B.1][which];
        let address =
            [B.1, A.1, ALL_HERE, Ipv4Addr::UNSPECIFIED, Ipv4Addr::LOCALHOST, Ipv4Addr::BROADCAST, C.1];
        let port = [1024, 1025, 36_000, 36_001, 0, 1026][usize::from(byte(1)) % 6];
        let to = SocketAddrV4::new(address[usize::from(byte(0)) % 7], port);
        let (end, model) = (&mut self.ends[which], &mut self.models[which]);
        let known = &mut self.ids[which];
        let id = if known.is_empty() { None } else { Some(known[(n >> 1) % known.len()]) };
        let Some(id) = id.filter(|_| kind % 13 != 0) else {
            let capacity = 1 + usize::from(byte(0)) % 8;
            let opened = end.open(Socket::udp(Arc::new(Pool::with_room(capacity, ROOM))));
            assert_eq!(
                opened.as_ref().map(|&id| end.stack.local_address(id).map(|to| to.port())),
                model.open().as_ref().map(|port| Ok(*port))
            );
            let Ok(id) = opened else { return 1 };
            let local = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, model.open().expect("it was"));
            let waiting = VecDeque::new();
            model.sockets.insert(id, ModelSocket { local, is_bound: false, peer: None, capacity, waiting });
            known.push(id);
            return 0;
        };
        let same = |ours: Result<(), SocketError>, models: Result<(), SocketError>| {
            assert_eq!(ours, models);
            ours.map_or_else(|error| error.errno() as u64, |()| 0)
        };
        match kind % 13 {
            1 => same(end.stack.bind(id, to), model.bind(own, id, to)),
            2 => {
                let peer = (byte(2) < 200).then_some(to);
                same(end.stack.connect(id, peer), model.connect(id, peer))
            }
            3..6 => {
                let len = usize::from(u16::from_be_bytes([byte(2), byte(3)]));
                let len = if len < 60_000 { len % 6_000 } else { len + 1_000 };
                let data: Vec<u8> = (0..len).map(|at| (at + n) as u8).collect();
                let to = (byte(4) < 200).then_some(to);
                same(end.send(id, &data, to), model.send(own, id, &data, to))
            }
            6 | 7 => self.receive(which, id, usize::from(byte(2)) * 32, byte(0) % 4 == 0),
            8 => {
                let closed = model.sockets.remove(&id).map(drop).ok_or(SocketError::NoSuchSocket);
                same(end.close(id), closed)
            }
            9 | 10 => {
                let (Some((_, socket)), Ok(_)) =
                    (end.stack.sockets().find(|(of, _)| *of == id), model.get(id))
                else {
                    return 2;
                };
                let (pool, n, free) = (socket.pool(), usize::from(byte(0)) % 16, model.free(id));
                let capacity = &mut model.sockets.get_mut(&id).expect("open").capacity;
                if kind % 13 == 9 {
                    assert_eq!(pool.extend(n), n.min(ROOM - *capacity));
                    *capacity = (*capacity + n).min(ROOM);
                } else {
                    let removed = n.min(free).min(*capacity - 1);
                    assert_eq!(pool.shrink(n), removed);
                    *capacity -= removed;
                }
                0
            }
            _ => self.cross(which),
        }
    }

    fn receive(&mut self, which: usize, id: SocketId, room: usize, peeks: bool) -> u64 {
        let flags = if peeks { Flags::PEEK } else { Flags::NONE };
        let received = self.ends[which].receive(id, room, flags);
        let expected = self.models[which].get(id).and_then(|socket| {
            let first = if peeks { socket.waiting.front().cloned() } else { socket.waiting.pop_front() };
            first.ok_or(SocketError::WouldBlock)
        });
        let received = received.map(|(received, data)| {
            assert_eq!((received.len, received.len < received.whole), (data.len(), received.is_truncated()));
            (received.from, received.whole, data)
        });
        let expected = expected
            .map(|(from, data)| (Sender::Udp(from), data.len(), data[..data.len().min(room)].to_vec()));
        assert_eq!(received, expected);
        received.map_or_else(|error| error.errno() as u64, |(_, whole, data)| u64::from(whole > data.len()))
    }

    /// All that one has sent comes to the other.
    fn cross(&mut self, which: usize) -> u64 {
        let frames = self.ends[which].leaves(usize::MAX);
        for frame in frames {
            let _ = self.ends[1 - which].hears(&frame);
        }
        let other = [A.1, B.1][1 - which];
        let leaving = std::mem::take(&mut self.models[which].leaving);
        let n = leaving.len();
        leaving
            .into_iter()
            .for_each(|(_, from, to, data)| self.models[1 - which].deliver(other, from, to, data, None));
        n as u64
    }

    fn check(&mut self) {
        for (end, model) in self.ends.iter_mut().zip(&self.models) {
            end.check_buffers();
            assert_eq!(end.stack.sockets().count(), model.sockets.len());
            for (id, socket) in end.stack.sockets() {
                let expected = &model.sockets[&id];
                assert_eq!(end.stack.local_address(id), Ok(expected.local));
                assert_eq!(end.stack.peer_address(id).ok(), expected.peer);
                let statistics = socket.pool().statistics();
                assert_eq!(
                    (statistics.free, statistics.capacity),
                    (model.free(id), expected.capacity),
                    "{id:?}"
                );
            }
        }
    }
}

/// Two stations with sockets that send to each other, in some orders.
fn seeds() -> Vec<Vec<u8>> {
    let step = |kind, argument, bytes: &[u8]| Step { kind, argument, bytes: bytes.to_vec() };
    let open = [step(0, 0, &[7]), step(0, 1, &[7]), step(0, 0, &[3]), step(0, 1, &[0])];
    let bind = [step(1, 0, &[3, 2]), step(1, 1, &[3, 2]), step(1, 2, &[2, 3]), step(1, 3, &[5, 3])];
    let send = [
        step(3, 0, &[0, 2, 0, 9]),
        step(3, 1, &[1, 2, 9, 9]),
        step(3, 2, &[2, 2, 0, 9]),
        step(3, 0, &[4, 2, 9, 9]),
    ];
    let cross = [step(11, 0, &[]), step(11, 1, &[])];
    let read = [step(6, 0, &[1, 0, 200]), step(6, 1, &[0, 0, 2]), step(6, 1, &[1, 0, 200]), step(6, 3, &[1])];
    let other = [
        step(2, 0, &[0, 2]),
        step(9, 0, &[9]),
        step(10, 1, &[9]),
        step(8, 2, &[]),
        step(3, 0, &[0, 0, 0, 1, 255]),
    ];
    let whole = [&open[..], &bind, &send, &cross, &read, &other, &send, &cross, &read].concat();
    [whole, [&open[..], &send, &cross, &read].concat(), [&open[..], &other, &bind].concat()]
        .iter()
        .map(|steps| steps::write(steps))
        .collect()
}
