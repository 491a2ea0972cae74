//! The lab's test traffic: one frame in each slot of a cycle, checked by its receiver.
//!
//! ```text
//! 0          14        16     17      18      22         30          38
//! +----------+---------+------+-------+-------+----------+-----------+------+--------+--------+-----
//! | Ethernet | station | slot | queue | cycle | sequence | scheduled | seed | seed+1 | seed+2 | ...
//! | 0x88B5   |         |      |       |       |          | global, ns|      |        |        |
//! +----------+---------+------+-------+-------+----------+-----------+------+--------+--------+-----
//!  \___________________________ head ________________________________/ \________ pattern _________/
//! ```
//!
//! `queue` is 0. Of a frame of a [`Flow`], which leaves in whatever slot its priority brings it to, it is that priority and
//! 1; `slot`, `cycle` and `scheduled` are then for which slot, in which cycle and when it was queued, and each flow has its
//! own `sequence`.
//!
//! All fields big-endian. The pattern is words of eight bytes, the last one cut off where the frame ends. Its
//! seed is folded from all of the head: whichever byte is changed on the way, head and pattern no longer go
//! together. A usual frame that misses its slot is worthless: the next slot gets a fresh one, and the gap in the
//! sequence shows the loss.

mod flows;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, Opportunity, Outlet, Service};
use rtnet::queue::Priority;
use rtnet::time::{GlobalTime, Instant};
use rtnet::wire::ethernet::{self, Address, EtherType, Header};
use zerocopy::byteorder::network_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

pub use flows::{Flow, FlowPlan};
use flows::{Flows, Queued};

/// Frames being sent or queued at a time: one per slot id.
const POOL: usize = 8;

/// Bytes in a word of the pattern.
const WORD: usize = size_of::<u64>();

/// A larger gap in the sequence is not one, but a forged frame: days of frames at 1 ms.
const MISSING_AT_MOST: u64 = 1 << 30;
/// Nor is a number that nobody can have come to.
const SEQUENCE_AT_MOST: u64 = 1 << 60;

/// How far a sender's frame is from the last one that was believed; none if it cannot be genuine: twice, or
/// numbered as nobody numbers who was silent for less than days.
pub fn step(last: Option<u64>, number: u64) -> Option<u64> {
    let step = match last {
        Some(last) => number.checked_sub(last).filter(|&step| step > 0)?,
        None => 1,
    };
    (step <= MISSING_AT_MOST && number <= SEQUENCE_AT_MOST).then_some(step)
}

/// What a frame says of itself, behind the Ethernet header.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Tag {
    station: U16,
    /// The slot's id.
    pub slot: u8,
    queue: u8,
    cycle: U32,
    sequence: U64,
    scheduled: U64,
}

const _: () = assert!(size_of::<Tag>() == 24);

impl Tag {
    /// Reads the tag of a frame of test traffic; `None` if it is none.
    pub fn read(frame: &[u8]) -> Option<(&Tag, &[u8])> {
        let (header, payload) = Header::parse(frame)?;
        (header.ether_type() == EtherType::EXPERIMENTAL).then_some(())?;
        Tag::ref_from_prefix(payload).ok()
    }
    /// Who sent it, by number in the lab.
    pub fn station(&self) -> usize {
        usize::from(self.station.get())
    }
    /// Of which priority a frame of a flow is; none of the usual ones.
    pub fn priority(&self) -> Option<u8> {
        self.queue.checked_sub(1)
    }
    /// In which cycle.
    pub fn cycle(&self) -> u32 {
        self.cycle.get()
    }
    /// The sender's number of the frame.
    pub fn sequence(&self) -> u64 {
        self.sequence.get()
    }
    /// When its slot was to begin, on the master's clock; of a frame of a flow, when it was queued.
    pub fn scheduled(&self) -> GlobalTime {
        GlobalTime::from_nanos(self.scheduled.get())
    }
}

/// Bytes before the pattern.
const HEAD: usize = ethernet::HEADER_LEN + size_of::<Tag>();
/// 2^64 divided by the golden ratio: odd, so that multiplying by it can be undone, and its bits are well mixed.
const FACTOR: u64 = 0x9e37_79b9_7f4a_7c15;

/// Where the pattern of a frame with this head begins: from 0 on, `seed = (seed ^ word) * FACTOR` with its halves
/// exchanged, for every word of the head, the last one filled up with zeros. Each step can be undone: two heads
/// that differ in one word never have one seed.
fn seed(head: &[u8]) -> u64 {
    let (words, rest) = head.as_chunks();
    let mut last = [0; WORD];
    last[..rest.len()].copy_from_slice(rest);
    let step = |seed: u64, word: &[u8; WORD]| {
        (seed ^ u64::from_be_bytes(*word)).wrapping_mul(FACTOR).rotate_left(32)
    };
    words.iter().chain([&last]).fold(0, step)
}

/// A word of the pattern. The head decides all of them: 30 ns for a small frame, 0.3 us for the largest.
fn word(seed: u64, i: usize) -> [u8; WORD] {
    seed.wrapping_add(i as u64).to_be_bytes()
}

fn write_pattern(seed: u64, pattern: &mut [u8]) {
    let (words, rest) = pattern.as_chunks_mut();
    let last = word(seed, words.len());
    words.iter_mut().enumerate().for_each(|(i, bytes)| *bytes = word(seed, i));
    rest.copy_from_slice(&last[..rest.len()]);
}

fn is_pattern(seed: u64, bytes: &[u8]) -> bool {
    let (words, rest) = bytes.as_chunks();
    let last = word(seed, words.len());
    words.iter().enumerate().all(|(i, bytes)| *bytes == word(seed, i)) && *rest == last[..rest.len()]
}

/// Sends in every slot, and checks what comes from one other station.
pub struct Traffic {
    plan: TrafficPlan,
    pool: Pool,
    sequence: u64,
    heard: Option<u64>,
    /// For which slot of which cycle it has sent last. Who has no slots is asked more often.
    sent: Option<(u32, Channel)>,
    flows: Flows,
    counts: Arc<TrafficCounts>,
}

/// Who sends what to whom.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrafficPlan {
    /// This station's number in the lab.
    pub station: u16,
    /// Its address.
    pub source: Address,
    /// Where its frames go.
    pub destination: Address,
    /// Whose frames come here.
    pub from: u16,
    /// Bytes behind the Ethernet header.
    pub payload: usize,
    /// The same of the frames that come here.
    pub from_payload: usize,
    /// The number of its first frame.
    pub first: u64,
}

/// What the control thread may look at while the real-time thread counts.
#[derive(Debug, Default)]
pub struct TrafficCounts {
    /// Frames received that are what was sent.
    pub received: AtomicU64,
    /// Frames missing between two that were received.
    pub missing: AtomicU64,
    /// The sequence number of the first frame received.
    pub first: AtomicU64,
    /// Frames of flows that found no room in their queue, by priority.
    pub refused: [AtomicU64; Priority::LEVELS],
}

impl TrafficCounts {
    /// Frames of flows that found no room in their queue: each priority of which there were any, and how many.
    pub fn refused(&self) -> impl Iterator<Item = (u8, u64)> {
        let counts = self.refused.iter().map(|count| count.load(Ordering::Relaxed));
        (0..).zip(counts).filter(|&(_, n)| n > 0)
    }
}

impl Traffic {
    /// Traffic by this plan, counted into `counts`.
    pub fn new(plan: TrafficPlan, counts: Arc<TrafficCounts>) -> Self {
        let flows = Flows::new(FlowPlan::default(), plan.first);
        Self { plan, pool: Pool::new(POOL), sequence: plan.first, heard: None, sent: None, flows, counts }
    }

    /// The same with flows.
    pub fn with_flows(self, flows: FlowPlan) -> Self {
        let flows = Flows::new(flows, self.plan.first);
        Self { flows, ..self }
    }

    fn check(&mut self, frame: &[u8]) -> Option<()> {
        let (tag, _) = Tag::read(frame)?;
        let TrafficPlan { from, source, from_payload, .. } = self.plan;
        let (header, payload) = Header::parse(frame)?;
        let (head, pattern) = frame.split_at_checked(HEAD)?;
        let intact = is_pattern(seed(head), pattern);
        let expected = tag.station() == usize::from(from) && header.destination == source;
        (intact && expected).then_some(())?;
        let sequence = tag.sequence();
        if let Some(priority) = tag.priority() {
            return self.flows.check(priority, sequence, payload.len());
        }
        (payload.len() == from_payload).then_some(())?;
        let missing = step(self.heard, sequence)? - 1;
        self.counts.missing.fetch_add(missing, Ordering::Relaxed);
        if self.heard.is_none() {
            self.counts.first.store(sequence, Ordering::Relaxed);
        }
        self.heard = Some(sequence);
        self.counts.received.fetch_add(1, Ordering::Relaxed);
        Some(())
    }
}

impl TrafficPlan {
    /// A frame of so many bytes behind the Ethernet header.
    fn write(&self, tag: Tag, payload: usize, frame: &mut Buf) {
        let header = Header::new(self.destination, self.source, EtherType::EXPERIMENTAL);
        frame.set_len(ethernet::HEADER_LEN + payload);
        let (head, pattern) = frame.split_at_mut(HEAD);
        head[..ethernet::HEADER_LEN].copy_from_slice(header.as_bytes());
        head[ethernet::HEADER_LEN..].copy_from_slice(tag.as_bytes());
        write_pattern(seed(head), pattern);
    }

    /// What the usual frame of a slot says of itself.
    fn usual(&self, slot: &Opportunity, sequence: u64) -> Tag {
        Tag {
            station: U16::new(self.station),
            slot: slot.channel,
            queue: 0,
            cycle: U32::new(slot.cycle),
            sequence: U64::new(sequence),
            scheduled: U64::new(slot.scheduled.nanos()),
        }
    }

    /// The same of a frame of a flow.
    fn queued(&self, slot: &Opportunity, queued: &Queued) -> Tag {
        Tag {
            slot: queued.flow.slot,
            queue: queued.flow.priority + 1,
            scheduled: U64::new(queued.at.nanos()),
            ..self.usual(slot, queued.sequence)
        }
    }
}

impl Service for Traffic {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::EXPERIMENTAL
    }

    fn on_frame(&mut self, _rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        self.check(&frame).ok_or(Refusal::BadPayload)
    }

    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        let turn = Some((slot.cycle, slot.channel));
        if std::mem::replace(&mut self.sent, turn) == turn {
            return;
        }
        let Self { plan, flows, counts, .. } = self;
        let write = |queued: &Queued, frame: &mut Buf| {
            plan.write(plan.queued(slot, queued), queued.flow.payload, frame)
        };
        let refused = |flow: &Flow, n| {
            counts.refused[usize::from(flow.priority)].fetch_add(n, Ordering::Relaxed);
        };
        if flows.poll(slot, out, write, refused) {
            return;
        }
        let Some(mut frame) = self.pool.take() else { return };
        plan.write(plan.usual(slot, self.sequence), plan.payload, &mut frame);
        // A slot that takes no frame shows as a gap in the sequence and in the capture.
        let _ = out(frame, Priority::LAST_REAL_TIME, slot.channel);
        self.sequence += 1;
    }

    fn still_wanted(&mut self, frame: &[u8]) -> bool {
        let Some((tag, _)) = Tag::read(frame) else { return true };
        let is_queued = tag.priority().is_some();
        if is_queued {
            self.flows.waits_again(tag);
        }
        is_queued
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: Address = Address([2, 0, 0, 0, 0, 1]);
    const B: Address = Address([2, 0, 0, 0, 0, 2]);

    fn pair() -> (Traffic, Traffic, Arc<TrafficCounts>) {
        let counts = Arc::new(TrafficCounts::default());
        let (payload, from_payload, first) = (64, 64, 0);
        let a = TrafficPlan { station: 0, source: A, destination: B, from: 1, payload, from_payload, first };
        let b = TrafficPlan { station: 1, source: B, destination: A, from: 0, ..a };
        (Traffic::new(a, Arc::default()), Traffic::new(b, counts.clone()), counts)
    }

    fn sent(by: &mut Traffic, cycle: u32) -> Buf {
        let (begin, scheduled) = (Instant::default(), GlobalTime::from_nanos(77));
        let mut taken = None;
        by.poll(&Opportunity { channel: 2, cycle, begin, scheduled }, &mut |frame, _, channel| {
            assert_eq!(channel, 2);
            taken = Some(frame);
            Ok(())
        });
        taken.unwrap()
    }

    #[test]
    fn a_frame_says_what_it_is_and_its_receiver_accepts_it() {
        let (mut a, mut b, counts) = pair();
        let frame = sent(&mut a, 5);
        assert_eq!(frame.len(), 14 + 64);
        let (tag, _) = Tag::read(&frame).unwrap();
        assert_eq!((tag.station(), tag.slot, tag.cycle(), tag.scheduled().nanos()), (0, 2, 5, 77));
        assert_eq!(b.on_frame(None, frame), Ok(()));
        drop(sent(&mut a, 6));
        assert_eq!(b.on_frame(None, sent(&mut a, 7)), Ok(()));
        let seen = [&counts.received, &counts.missing, &counts.first].map(|n| n.load(Ordering::Relaxed));
        assert_eq!(seen, [2, 1, 0], "the frame of cycle 6 is missing");
    }

    #[test]
    fn a_changed_repeated_or_misdirected_frame_is_refused() {
        let (mut a, mut b, _) = pair();
        let mut changed = sent(&mut a, 1);
        changed[50] ^= 1;
        assert_eq!(b.on_frame(None, changed), Err(Refusal::BadPayload));
        let first = sent(&mut a, 2);
        let mut again = b.pool.take().unwrap();
        again.fill(&first);
        assert_eq!(b.on_frame(None, first), Ok(()));
        assert_eq!(b.on_frame(None, again), Err(Refusal::BadPayload), "twice");
        assert_eq!(a.on_frame(None, sent(&mut b, 3)), Ok(()));
        let mut own = sent(&mut a, 4);
        own[0] = 0xff;
        assert_eq!(b.on_frame(None, own), Err(Refusal::BadPayload), "to somebody else");
    }

    #[test]
    fn a_frame_with_any_one_byte_changed_is_refused() {
        let (mut a, mut b, counts) = pair();
        let genuine = sent(&mut a, 0x0102_0304);
        for at in 0..genuine.len() {
            for change in 1..=u8::MAX {
                let mut changed = b.pool.take().unwrap();
                changed.fill(&genuine);
                changed[at] ^= change;
                assert_eq!(b.on_frame(None, changed), Err(Refusal::BadPayload), "byte {at} ^ {change:#x}");
            }
        }
        assert_eq!(counts.received.load(Ordering::Relaxed), 0);
        assert_eq!(b.on_frame(None, genuine), Ok(()), "and none of them has left a trace");
    }

    #[test]
    fn bytes_that_change_places_are_noticed_wherever_they_are() {
        let (mut a, mut b, _) = pair();
        let genuine = sent(&mut a, 0x0102_0304);
        for (one, other) in (0..genuine.len()).flat_map(|one| (0..one).map(move |other| (one, other))) {
            let mut changed = b.pool.take().unwrap();
            changed.fill(&genuine);
            changed.swap(one, other);
            let same = genuine[one] == genuine[other];
            assert!(same || b.on_frame(None, changed).is_err(), "bytes {one} and {other}");
        }
    }

    #[test]
    fn a_frame_that_missed_its_slot_is_not_wanted_any_more() {
        let (mut a, ..) = pair();
        let frame = sent(&mut a, 1);
        assert!(!a.still_wanted(&frame));
        assert!(a.still_wanted(&[0; 60]), "somebody else's");
    }
}
