//! Test traffic: one frame in each slot of a cycle, which says whose, which cycle and for when.
//!
//! ```text
//! 0        14        16        17         18      22          30
//! +--------+---------+---------+----------+-------+-----------+----------------
//! | 0x88B5 | station | channel | 0        | cycle | scheduled | pattern ...
//! +--------+---------+---------+----------+-------+-----------+----------------
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, Opportunity, Outlet, Service};
use rtnet::queue::Priority;
use rtnet::time::{GlobalTime, Instant};
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME};
use tools::station::traffic::{Traffic, TrafficCounts, TrafficPlan};

const FIELDS_END: usize = 30;

/// The traffic of a lab's stations, 64 bytes a frame: station `station` sends to the next address, and checks what
/// `from` sends.
pub fn of_a_lab(
    (station, source): (u16, Address),
    destination: Address,
    from: u16,
    counts: Arc<TrafficCounts>,
) -> Traffic {
    let plan = TrafficPlan { station, source, destination, from, payload: 64, from_payload: 64, first: 0 };
    Traffic::new(plan, counts)
}

/// Sends to one station, and counts what it hears.
pub struct TestTraffic {
    /// Number of the station in its frames.
    pub station: u16,
    /// From this address.
    pub address: Address,
    /// To this one.
    pub to: Address,
    /// Bytes behind the Ethernet header.
    pub payload: usize,
    /// Where its buffers come from.
    pub pool: Pool,
    /// What it counts.
    pub tally: Arc<Tally>,
    /// For which slot of which cycle it has sent last. Who has no slots is asked more often.
    pub sent: Option<(u32, Channel)>,
}

/// What a [`TestTraffic`] counts.
#[derive(Debug, Default)]
pub struct Tally {
    /// Frames queued.
    pub queued: AtomicU64,
    /// Frames that could not be queued.
    pub not_queued: AtomicU64,
    /// Frames received from others.
    pub received: AtomicU64,
    /// Of the last slot, its begin on the station's own clock and on the master's, as the station believes.
    pub begin: AtomicU64,
    /// See `begin`.
    pub scheduled: AtomicU64,
}

/// What a frame of test traffic says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DataFrame {
    /// Whose.
    pub station: u16,
    /// In which slot.
    pub channel: Channel,
    /// For which cycle.
    pub cycle: u32,
    /// When its slot begins.
    pub scheduled: GlobalTime,
}

impl TestTraffic {
    /// Traffic of 64 bytes from `address` to `to`.
    pub fn new(station: u16, address: Address, to: Address) -> Self {
        Self { station, address, to, payload: 64, pool: Pool::new(8), tally: Arc::default(), sent: None }
    }
}

impl Tally {
    /// How many frames came from others.
    pub fn received(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }
}

impl DataFrame {
    /// Reads a frame; `None` when it is no test traffic.
    pub fn read(frame: &[u8]) -> Option<DataFrame> {
        let (header, _) = Header::parse(frame)?;
        if header.ether_type() != EtherType::EXPERIMENTAL || frame.len() < FIELDS_END {
            return None;
        }
        Some(DataFrame {
            station: u16::from_be_bytes(frame[14..16].try_into().ok()?),
            channel: frame[16],
            cycle: u32::from_be_bytes(frame[18..22].try_into().ok()?),
            scheduled: GlobalTime::from_nanos(u64::from_be_bytes(frame[22..30].try_into().ok()?)),
        })
    }

    fn write(&self, to: Address, from: Address, payload: usize, frame: &mut Buf) {
        let room = frame.room_mut();
        room[..6].copy_from_slice(&to.0);
        room[6..12].copy_from_slice(&from.0);
        room[12..HEADER_LEN].copy_from_slice(&EtherType::EXPERIMENTAL.0.to_be_bytes());
        room[14..16].copy_from_slice(&self.station.to_be_bytes());
        room[16..18].copy_from_slice(&[self.channel, 0]);
        room[18..22].copy_from_slice(&self.cycle.to_be_bytes());
        room[22..30].copy_from_slice(&self.scheduled.nanos().to_be_bytes());
        let end = (HEADER_LEN + payload).max(MIN_FRAME);
        room[FIELDS_END..end].fill(self.cycle as u8);
        frame.set_len(end);
    }
}

impl Service for TestTraffic {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::EXPERIMENTAL
    }

    fn on_frame(&mut self, _rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        DataFrame::read(&frame).ok_or(Refusal::BadPayload)?;
        self.tally.received.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        let turn = Some((slot.cycle, slot.channel));
        if std::mem::replace(&mut self.sent, turn) == turn {
            return;
        }
        let Some(mut frame) = self.pool.take() else { return };
        let Opportunity { channel, cycle, begin, scheduled, .. } = *slot;
        self.tally.begin.store(begin.nanos(), Ordering::Relaxed);
        self.tally.scheduled.store(scheduled.nanos(), Ordering::Relaxed);
        let data = DataFrame { station: self.station, channel, cycle, scheduled };
        data.write(self.to, self.address, self.payload, &mut frame);
        let queued = out(frame, Priority::DEFAULT, channel).is_ok();
        let count = if queued { &self.tally.queued } else { &self.tally.not_queued };
        count.fetch_add(1, Ordering::Relaxed);
    }

    /// Each frame is for one slot only.
    fn still_wanted(&mut self, _frame: &[u8], _priority: Priority) -> bool {
        false
    }
}
