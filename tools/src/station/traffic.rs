//! The lab's test traffic: one frame in each slot of a cycle, checked by its receiver.
//!
//! A usual frame that misses its slot is worthless: the next slot gets a fresh one, and the gap in the sequence shows the
//! loss. What a program queues besides waits for the next.

mod arrivals;
mod flows;
mod frame;

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, Opportunity, Outlet, Service};
use rtnet::ip::route::Routes;
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{self, Address, EtherType, Header};
use zerocopy::IntoBytes;
use zerocopy::byteorder::network_endian::{U16, U32, U64};

pub use arrivals::{Arrivals, Arrived, Came, Newest, SKIPPED};
pub use flows::{BUFFERS_OF_FLOWS, Flow, FlowPlan};
use flows::{Flows, Queued};
pub use frame::Tag;
use frame::{HEAD, finish, is_intact};

/// Frames being sent or queued at a time: one per slot id.
const POOL: usize = 8;

/// Sends in every slot, and checks what comes from one other station.
pub struct Traffic {
    plan: TrafficPlan,
    pool: Pool,
    sequence: u64,
    heard: Newest,
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
    /// What came of the sender's usual frames.
    usual: Arrivals,
    /// The same of each of its flows, by priority.
    queued: Box<[(u8, Arrivals)]>,
    /// Frames of this station's flows that found no room in their queue, by priority.
    refused: Box<[(u8, AtomicU64)]>,
}

impl TrafficCounts {
    /// Counts for these flows, besides the usual frames.
    pub fn of(plan: &FlowPlan) -> Self {
        let (sent, from) = (plan.flows.iter(), plan.from.iter());
        Self {
            usual: Arrivals::default(),
            queued: from.map(|flow| (flow.priority, Arrivals::default())).collect(),
            refused: sent.map(|flow| (flow.priority, AtomicU64::new(0))).collect(),
        }
    }

    fn are_of(&self, plan: &FlowPlan) -> bool {
        let sent = plan.flows.iter().map(|flow| flow.priority);
        let from = plan.from.iter().map(|flow| flow.priority);
        self.refused.iter().map(|(of, _)| *of).eq(sent) && self.queued.iter().map(|(of, _)| *of).eq(from)
    }

    /// Frames of flows that found no room in their queue: each priority of which there were any, and how many.
    pub fn refused(&self) -> impl Iterator<Item = (u8, u64)> {
        let counts = self.refused.iter().map(|(priority, count)| (*priority, count.load(Ordering::Relaxed)));
        counts.filter(|&(_, n)| n > 0)
    }

    /// What came of the frames with this [`Tag::priority`].
    pub fn arrived(&self, of: Option<u8>) -> Arrived {
        self.arrivals(of).map(Arrivals::now).unwrap_or_default()
    }

    /// Which numbers of them count, and how many came with others; see [`Arrivals::counted`].
    pub fn counted(&self, of: Option<u8>) -> (Range<u64>, u64) {
        self.arrivals(of).map_or((0..u64::MAX, 0), Arrivals::counted)
    }

    /// What counts them; none where there is no such priority.
    pub fn arrivals(&self, of: Option<u8>) -> Option<&Arrivals> {
        let queued =
            |priority| self.queued.iter().find(|(of, _)| *of == priority).map(|(_, arrivals)| arrivals);
        of.map_or(Some(&self.usual), queued)
    }

    /// The same of each flow of which something came, by priority.
    pub fn arrived_queued(&self) -> impl Iterator<Item = (u8, Arrived)> {
        let all = self.queued.iter().map(|(priority, arrivals)| (*priority, arrivals.now()));
        all.filter(|(_, arrived)| arrived.received > 0)
    }
}

impl Traffic {
    /// Traffic by this plan, counted into `counts`.
    pub fn new(plan: TrafficPlan, counts: Arc<TrafficCounts>) -> Self {
        let flows = Flows::new(FlowPlan::default(), plan.first);
        let (sequence, heard) = (plan.first, Newest::default());
        Self { plan, pool: Pool::new(POOL), sequence, heard, sent: None, flows, counts }
    }

    /// The same with flows.
    ///
    /// # Panics
    /// If the counts are not [of](TrafficCounts::of) these flows.
    pub fn with_flows(self, flows: FlowPlan) -> Self {
        assert!(self.counts.are_of(&flows), "the counts are of other flows");
        let flows = Flows::new(flows, self.plan.first);
        Self { flows, ..self }
    }

    fn check(&mut self, at: Option<u64>, frame: &[u8]) -> Option<()> {
        let (tag, _) = Tag::read(frame)?;
        let TrafficPlan { from, source, from_payload, .. } = self.plan;
        let (header, payload) = Header::parse(frame)?;
        let expected = tag.station() == usize::from(from) && header.destination == source;
        (is_intact(frame) && expected).then_some(())?;
        let sequence = tag.sequence();
        if let Some(priority) = tag.priority() {
            let counts = self.counts.arrivals(Some(priority))?;
            return counts.note(self.flows.heard(priority, payload.len())?, sequence, at);
        }
        (payload.len() == from_payload).then_some(())?;
        self.counts.usual.note(&mut self.heard, sequence, at)
    }
}

impl TrafficPlan {
    /// A frame of so many bytes behind the Ethernet header.
    fn write(&self, tag: Tag, payload: usize, frame: &mut Buf) {
        let header = Header::new(self.destination, self.source, EtherType::EXPERIMENTAL);
        frame.set_len(ethernet::HEADER_LEN + payload);
        let head = &mut frame[..HEAD];
        head[..ethernet::HEADER_LEN].copy_from_slice(header.as_bytes());
        head[ethernet::HEADER_LEN..].copy_from_slice(tag.as_bytes());
        finish(frame);
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

    /// The same of a frame of a flow, as if it left in this one.
    fn queued(&self, slot: &Opportunity, queued: &Queued) -> Tag {
        Tag {
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

    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        self.check(rx.map(Instant::nanos), &frame).ok_or(Refusal::BadPayload)
    }

    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        let Self { plan, flows, counts, .. } = self;
        let write = |queued: &Queued, frame: &mut Buf| {
            plan.write(plan.queued(slot, queued), queued.flow.payload, frame)
        };
        let refused = |flow: &Flow, n| {
            if let Some((_, count)) = counts.refused.iter().find(|(priority, _)| *priority == flow.priority) {
                count.fetch_add(n, Ordering::Relaxed);
            }
        };
        flows.poll(slot, out, write, refused);
    }

    fn fill(&mut self, slot: &Opportunity, _routes: Option<&Routes>, out: &mut Outlet<'_>) {
        let turn = Some((slot.cycle, slot.channel));
        if std::mem::replace(&mut self.sent, turn) == turn {
            return;
        }
        let Some(mut frame) = self.pool.take() else { return };
        self.plan.write(self.plan.usual(slot, self.sequence), self.plan.payload, &mut frame);
        // A slot that takes no frame shows as a gap in the sequence and in the capture.
        let _ = out(frame, Priority::LAST_REAL_TIME, slot.channel);
        self.sequence += 1;
    }

    /// A usual frame says so from the begin.
    fn leaves(&mut self, slot: &Opportunity, frame: &mut [u8]) {
        let Some((tag, _)) = Tag::read(frame) else { return };
        if tag.priority().is_some() {
            let tag = Tag { slot: slot.channel, cycle: U32::new(slot.cycle), ..*tag };
            frame[ethernet::HEADER_LEN..HEAD].copy_from_slice(tag.as_bytes());
            finish(frame);
        }
    }

    /// The next slot has a usual frame of its own.
    fn still_wanted(&mut self, frame: &[u8], _priority: Priority) -> bool {
        Tag::read(frame).is_none_or(|(tag, _)| tag.priority().is_some())
    }
}

#[cfg(test)]
mod tests {
    use rtnet::time::GlobalTime;

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
        by.fill(
            &Opportunity { channel: 2, cycle, begin, scheduled, non_rt: None },
            None,
            &mut |frame, _, channel| {
                assert_eq!(channel, 2);
                taken = Some(frame);
                Ok(())
            },
        );
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
        let seen = Arrived { received: 2, missing: 1, first: 0 };
        assert_eq!(counts.arrived(None), seen, "the frame of cycle 6 is missing");
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
        assert_eq!(counts.arrived(None), Arrived::default());
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
        assert!(!a.still_wanted(&frame, Priority::LAST_REAL_TIME));
        assert!(a.still_wanted(&[0; 60], Priority::LAST_REAL_TIME), "somebody else's");
    }
}
