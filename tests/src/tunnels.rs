//! Networks in virtual time with tunnels, and a simulated Linux at the mouth of each: it is looked after whenever its
//! station has taken a turn or sent, so that it is saturated at every moment.

use std::cell::RefCell;
use std::rc::Rc;

use rtmac::wire;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Discipline, Service};
use rtnet::ip::Stack;
use rtnet::sim::{Host, Latency, Medium, Member, Network, StationId};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header};
use vnic::tunnel::{self, Config, FRAME, Inner, Mouth, Tunnel};

use crate::seeds;
use crate::stacks::{BEGIN, CYCLE, address};

/// Payload that is not worth a tunnel's padding: a frame of this and less is as long as the smallest.
pub const PADDED_TO: usize = 42;
/// The types of what a Linux sends, one after the other; the last would be RTmac's own.
const KINDS: [EtherType; 5] =
    [EtherType::IPV4, EtherType::ARP, EtherType(0x86dd), EtherType::EXPERIMENTAL, EtherType::RTMAC];

/// What a Linux does.
#[derive(Clone, Debug)]
pub struct Habits {
    /// Whom it sends to, in turn; nobody: it sends nothing.
    pub to: Vec<Address>,
    /// How long its payloads are, in turn, as far as its device takes as much.
    pub lens: Vec<usize>,
    /// Buffers that it leaves to what comes.
    pub leaves: usize,
    /// Whether it reads what comes.
    pub reads: bool,
    /// Whether it writes down what goes and comes.
    pub notes: bool,
}

impl Habits {
    /// Sends largest frames to these in turn, reads, and leaves half of the usual buffers to what comes.
    pub fn saturated(to: Vec<Address>) -> Self {
        let (lens, leaves) = (vec![tunnel::MTU], tunnel::DEFAULT_BUFFERS / 2);
        Self { to, lens, leaves, reads: true, notes: false }
    }
}

/// What is at the mouth of a tunnel.
pub struct Linux {
    /// The mouth.
    pub mouth: Mouth,
    /// What it does.
    pub habits: Habits,
    /// Frames that it has sent.
    pub sent: Vec<Vec<u8>>,
    /// Frames that it has read.
    pub received: Vec<Vec<u8>>,
    number: usize,
}

impl Linux {
    /// A Linux with these habits, and its station's end.
    pub fn new(config: Config, habits: Habits) -> (Tunnel, Self) {
        let (tunnel, mouth) = tunnel::new(config);
        (tunnel, Self { mouth, habits, sent: Vec::new(), received: Vec::new(), number: 0 })
    }

    /// Reads what there is, and sends as long as there are buffers.
    pub fn turn(&mut self) {
        while self.habits.reads
            && let Some(frame) = self.mouth.received()
        {
            if self.habits.notes {
                self.received.push(Inner::of(&frame).expect("a whole frame").pieces().concat());
            }
        }
        while !self.habits.to.is_empty() && self.mouth.pool().available() > self.habits.leaves {
            self.send();
        }
    }

    fn send(&mut self) {
        let Habits { to, lens, notes, .. } = &self.habits;
        let number = self.number;
        self.number += 1;
        let mut frame = self.mouth.take().expect("one is free");
        let len = HEADER_LEN + lens[number % lens.len()].min(self.mouth.mtu());
        let bytes = &mut frame.room_mut()[FRAME..][..len];
        let own = self.mouth.config().address;
        bytes[..6].copy_from_slice(&to[number % to.len()].0);
        bytes[6..12].copy_from_slice(&own.0);
        bytes[12..HEADER_LEN].copy_from_slice(&KINDS[number % KINDS.len()].0.to_be_bytes());
        for (at, byte) in bytes[HEADER_LEN..].iter_mut().enumerate() {
            *byte = (at * 7 + number * 13 + at / 251) as u8 ^ own.0[5];
        }
        bytes[HEADER_LEN..].iter_mut().zip((number as u32).to_be_bytes()).for_each(|(byte, of)| *byte = of);
        if *notes {
            self.sent.push(bytes.to_vec());
        }
        self.mouth.send_frame(frame, len).expect("it is no longer than the device takes");
    }

    /// What it has sent and others are to read: padded, since nothing tells how long it was.
    pub fn sent_to(&self, reader: Address) -> Vec<Vec<u8>> {
        let of_reader = |frame: &&Vec<u8>| frame[..6] == reader.0 || frame[..6] == Address::BROADCAST.0;
        let padded = |frame: &Vec<u8>| {
            let mut frame = frame.clone();
            frame.resize(frame.len().max(HEADER_LEN + PADDED_TO), 0);
            frame
        };
        self.sent.iter().filter(of_reader).map(padded).collect()
    }
}

/// A frame as it was on the air.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OnAir {
    /// Who sent it.
    pub from: StationId,
    /// When its first bit left, in true time.
    pub at: u64,
    /// The frame.
    pub bytes: Vec<u8>,
}

impl OnAir {
    /// Whether it was tunnelled.
    pub fn is_tunnelled(&self) -> bool {
        let is_rtmac = |header: &Header| header.ether_type() == EtherType::RTMAC;
        Header::parse(&self.bytes).is_some_and(|(header, _)| is_rtmac(header))
            && wire::head(&self.bytes).is_ok_and(|(head, _)| head.is_tunnel())
    }
}

/// What all networks with tunnels are like, unless it is said otherwise.
#[derive(Clone, Debug)]
pub struct Kind {
    /// The medium.
    pub medium: Medium,
    /// What all hosts are like.
    pub host: Host,
    /// Buffers of a tunnel.
    pub buffers: usize,
    /// Frames that leave in a turn.
    pub per_turn: usize,
}

impl Default for Kind {
    /// Hosts take the same time for the same thing each time.
    fn default() -> Self {
        let host = Host { wake: constant(13_000), send: constant(300), ..Host::IDEAL };
        let medium = Medium::default();
        Self { medium, host, buffers: tunnel::DEFAULT_BUFFERS, per_turn: 1 }
    }
}

/// It takes so many nanoseconds each time.
pub fn constant(nanos: i64) -> Latency {
    Latency::Constant(Span::from_nanos(nanos))
}

/// A network with tunnels.
pub struct Tunnelled<D: Discipline> {
    /// The stations.
    pub network: Network<D>,
    /// What is at their mouths.
    pub linuxes: Rc<RefCell<Vec<Option<Linux>>>>,
    /// What was on the air since it was watched.
    pub aired: Rc<RefCell<Vec<OnAir>>>,
}

impl<D: Discipline> Tunnelled<D> {
    /// Stations with these stacks, and tunnels to a Linux with these habits where there are any. Their clocks run apart.
    pub fn new(kind: &Kind, stations: Vec<(D, Stack, Option<Habits>)>) -> Self {
        let mut network = Network::new(kind.medium, seeds::one("tunnels"));
        network.run_until(BEGIN);
        let mut linuxes = Vec::new();
        for (id, (discipline, stack, habits)) in stations.into_iter().enumerate() {
            let own = address(id);
            let config = Config { buffers: kind.buffers, per_turn: kind.per_turn, ..Config::of(own) };
            let (tunnel, linux) = habits.map(|habits| Linux::new(config, habits)).unzip();
            let services = tunnel.map(|tunnel| Box::new(tunnel) as Box<dyn Service>).into_iter().collect();
            linuxes.push(linux);
            let station = Station::new(discipline, services).with_stack(stack);
            let (offset, drift_ppb) = (Span::from_micros(id as i64 * 777), id as i64 * 4_000);
            let clock = EmulatedClock { anchor: BEGIN, offset, drift_ppb };
            let host = kind.host.clone().into();
            network.add(Member { address: own, clock, host, station }, BEGIN);
        }
        let linuxes = Rc::new(RefCell::new(linuxes));
        let looked_after = linuxes.clone();
        network.attend(move |moment, _| {
            if let Some(linux) = &mut looked_after.borrow_mut()[moment.id] {
                linux.turn();
            }
        });
        Self { network, linuxes, aired: Rc::default() }
    }

    /// Writes down what is on the air from now on.
    pub fn watch(&mut self) {
        let aired = self.aired.clone();
        self.network.observe(move |of| {
            aired.borrow_mut().push(OnAir { from: of.from, at: of.at, bytes: of.bytes.to_vec() });
        });
    }

    /// Lets so many cycles pass.
    pub fn run_cycles(&mut self, count: u64) {
        self.network.run_until(self.network.now() + count * CYCLE.nanos() as u64);
    }

    /// Nobody sends any more; what waits for a turn gets one.
    pub fn quiet(&mut self, cycles: u64) {
        self.linuxes.borrow_mut().iter_mut().flatten().for_each(|linux| linux.habits.to.clear());
        self.run_cycles(cycles);
    }
}
