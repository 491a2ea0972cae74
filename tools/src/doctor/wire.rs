//! What sending costs: a port of a station in a namespace of its own, another one that receives, and a
//! segment between them as a lab has it.

use anyhow::{Context, Result};
use rtnet::buf::Pool;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Sent, Transmission};
use rtnet::live::clock::{monotonic, sleep_until, thread_cpu_time};
use rtnet::live::interface::Interface;
use rtnet::live::realtime::WarmCore;
use rtnet::live::{GuardMode, Port};
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};
use zerocopy::IntoBytes;

use super::verdict::MEASURED_LEAD;
use crate::lab::namespace::{Namespace, Segment};
use crate::report::histogram::SignedHistogram;
use crate::wakeups::on_core;

const INTERFACE: &str = "rt0";
const SENDER: Address = Address([0x02, 0, 0, 0, 0, 0x0a]);
const RECEIVER: Address = Address([0x02, 0, 0, 0, 0, 0x0b]);
/// From one frame to the next: as far apart as those of 8 stations at 1 ms. Further apart, each would find
/// the caches cold.
const PERIOD: Span = Span::from_micros(125);
/// A frame this late is still worth sending here: its lateness is not what is measured.
const LATEST: Span = Span::from_millis(100);
/// From one broadcast to the next: syncs are a cycle apart.
const BROADCAST_PERIOD: Span = Span::from_millis(1);
/// Stations that hear a broadcast; the bridge delivers to one after the other, in the sender's context.
pub const LISTENERS: usize = 8;
/// The part of the time that is for broadcasts.
const BROADCAST_PART: i64 = 4;
/// Frames that do not count: caches, and the port's idea of what `send` costs.
const SETTLE: u64 = 5;

/// What was measured, in nanoseconds.
pub struct Wire {
    /// `send` of a frame of 60 bytes: over a veth to a bridge and over another one to its receiver.
    pub send: SignedHistogram,
    /// `send` of a broadcast to [`LISTENERS`] stations.
    pub broadcast: SignedHistogram,
    /// The kernel's receive stamp - the clock before `send`.
    pub stamp: SignedHistogram,
    /// Frames received without a stamp.
    pub unstamped: u64,
    /// Processor time of a turn: wake up at slot - 50 us, drain, spin, send, receive.
    pub turn: Span,
}

/// Ports on a segment.
struct Ends {
    sender: Port,
    /// The first one is sent to, all hear broadcasts.
    receivers: Vec<Port>,
    _segment: Segment,
}

/// Sends frames for about `span` and measures.
///
/// # Errors
/// Namespaces, links or packet sockets are refused.
pub fn measure(cpu: usize, span: Span) -> Result<Wire> {
    let mut ends = Ends::new()?;
    // A wire can be measured on a cold core, too.
    let _warm = WarmCore::start(cpu);
    let [send, broadcast, stamp] = std::array::from_fn(|_| SignedHistogram::for_real_time());
    let mut wire = Wire { send, broadcast, stamp, unstamped: 0, turn: Span::ZERO };
    let turns = |part: Span, period: Span| (part.nanos() / period.nanos()).max(1) as u64;
    let broadcasts = turns(span / BROADCAST_PART, BROADCAST_PERIOD);
    let turns = turns(span - span / BROADCAST_PART, PERIOD);
    on_core(cpu, || {
        broadcast_often(&mut ends, broadcasts, &mut wire);
        send_often(&mut ends, turns, &mut wire);
    });
    Ok(wire)
}

impl Ends {
    fn new() -> Result<Self> {
        let mut segment = Segment::new()?;
        let mut port = |name: &str, address: Address| {
            let namespace = Namespace::new()?;
            segment.attach(&namespace, name, INTERFACE, address.0)?;
            namespace.run(|| -> Result<Port> {
                let interface = Interface::find(INTERFACE)?;
                let (data, clock) = ([EtherType::EXPERIMENTAL], EmulatedClock::default());
                Port::open(&interface, &data, clock, MEASURED_LEAD.nanos() as u64, GuardMode::Auto)
                    .context("no packet socket")
            })?
        };
        let sender = port("sender", SENDER)?;
        let receivers = (0..LISTENERS).map(|k| {
            let Address([head @ .., last]) = RECEIVER;
            let [a, b, c, d, e] = head;
            port(&format!("port{k}"), Address([a, b, c, d, e, last + k as u8]))
        });
        let receivers = receivers.collect::<Result<_>>()?;
        Ok(Self { sender, receivers, _segment: segment })
    }
}

/// What a sync costs its sender.
fn broadcast_often(ends: &mut Ends, turns: u64, wire: &mut Wire) {
    let pool = Pool::new(1);
    let mut slot = monotonic();
    for turn in 0..SETTLE + turns {
        slot += BROADCAST_PERIOD.nanos() as u64;
        sleep_until(slot - MEASURED_LEAD.nanos() as u64);
        let before = transmit(&mut ends.sender, &pool, Address::BROADCAST, slot);
        let after = Instant::from_nanos(monotonic());
        if let Some(before) = before.filter(|_| turn >= SETTLE) {
            wire.broadcast.record((after - before).nanos());
        }
        for receiver in &mut ends.receivers {
            receiver.drain_control(|_, _| {});
            receiver.drain_data(|_, _| {});
        }
    }
}

/// Sends a frame at its instant; the clock before `send`, if it could be sent.
fn transmit(sender: &mut Port, pool: &Pool, to: Address, slot: u64) -> Option<Instant> {
    let mut frame = pool.take()?;
    frame.fill(Header::new(to, SENDER, EtherType::EXPERIMENTAL).as_bytes());
    frame.pad_to(MIN_FRAME);
    let at = Instant::from_nanos(slot);
    match sender.transmit(Transmission { frame, at, latest: at + LATEST, stamp: None }) {
        Sent::At(before) => Some(before),
        _ => None,
    }
}

/// One turn a period, in the order of a station's own loop.
fn send_often(ends: &mut Ends, turns: u64, wire: &mut Wire) {
    let Ends { sender, receivers, .. } = ends;
    let receiver = &mut receivers[0];
    let pool = Pool::new(1);
    let mut slot = monotonic();
    let mut cpu = 0;
    for turn in 0..SETTLE + turns {
        if turn == SETTLE {
            cpu = thread_cpu_time();
        }
        slot += PERIOD.nanos() as u64;
        sleep_until(slot - MEASURED_LEAD.nanos() as u64);
        sender.drain_control(|_, _| {});
        let before = transmit(sender, &pool, RECEIVER, slot);
        let after = Instant::from_nanos(monotonic());
        if let Some(before) = before.filter(|_| turn >= SETTLE) {
            wire.send.record((after - before).nanos());
        }
        receiver.drain_control(|_, _| {});
        receiver.drain_data(|stamp, _| match (stamp, before) {
            (Some(stamp), Some(before)) if turn >= SETTLE => wire.stamp.record((stamp - before).nanos()),
            (None, _) => wire.unstamped += 1,
            _ => {}
        });
    }
    wire.turn = Span::from_nanos(((thread_cpu_time() - cpu) / turns) as i64);
}
