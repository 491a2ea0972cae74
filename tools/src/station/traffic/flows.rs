//! What a station's program sends besides its usual frames: frames of a priority that it queues again and again. They
//! compete for the station's slots; a usual frame has what slots are left.
//!
//! ```text
//!   every ──┬──────────┬──────────┬──────────►  whole multiples of global time, for programs on all stations alike
//!           │burst     │burst     │burst
//!           ▼          ▼          ▼
//!   poll, a lead before a slot: all that were queued by then ──► the slot's queue, most urgent first ──► the medium
//! ```
//!
//! A queue is looked at only when a slot is chosen for: what was queued since the last time may be put into it then,
//! as if it had been waiting there.

use rtmac::tdma::{DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID};
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Channel, Opportunity, Outlet};
use rtnet::queue::Priority;
use rtnet::time::GlobalTime;
use serde::{Deserialize, Serialize};

use super::{Tag, step};

/// Frames of flows that wait, or are being sent: as many as two slots' queues hold.
const POOL: usize = 64;
/// The queues that a station can have.
const QUEUES: usize = DEFAULT_MAX_SLOT_ID as usize + 1;

/// Frames of one priority, queued again and again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct Flow {
    /// 0 to [`Flow::LAST_PRIORITY`]; a station has one flow of each.
    pub priority: u8,
    /// How often, nanoseconds of global time.
    pub every_ns: u64,
    /// How many at a time.
    pub burst: u32,
    /// Bytes behind the Ethernet header of each.
    pub payload: usize,
    /// The slot that they are for.
    pub slot: Channel,
}

impl Flow {
    /// Behind it come the usual frames, and what is not real-time.
    pub const LAST_PRIORITY: u8 = Priority::LAST_REAL_TIME.level() - 1;
}

/// The flows of a station, and what it must know to send and check them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
pub struct FlowPlan {
    /// What it sends, most urgent first.
    pub flows: Vec<Flow>,
    /// Its slots that take from the queue of another one, and which.
    pub joint: Vec<(Channel, Channel)>,
    /// What is sent to it.
    pub from: Vec<Flow>,
}

/// The flows of a station as they go.
pub(super) struct Flows {
    plan: FlowPlan,
    going: Vec<Going>,
    pool: Option<Pool>,
    /// Frames that wait, by queue.
    waiting: [usize; QUEUES],
    /// The number of the last frame that came, by priority.
    heard: [Option<u64>; Priority::LEVELS],
}

#[derive(Clone, Copy)]
struct Going {
    /// The number of its next frame.
    sequence: u64,
    /// Which of its moments comes next, from the begin of global time; none before the first slot.
    next: Option<u64>,
}

/// A frame to be queued.
pub(super) struct Queued {
    pub flow: Flow,
    pub sequence: u64,
    /// When it was.
    pub at: GlobalTime,
}

impl Flows {
    pub fn new(plan: FlowPlan, first: u64) -> Self {
        let going = vec![Going { sequence: first, next: None }; plan.flows.len()];
        let pool = (!going.is_empty()).then(|| Pool::new(POOL));
        Self { plan, going, pool, waiting: [0; QUEUES], heard: [None; Priority::LEVELS] }
    }

    /// Queues all that are due; whether one of them, or one that has waited, takes this slot. `write` makes a frame, and
    /// `refused` is told of those for which there was no room.
    pub fn poll(
        &mut self,
        slot: &Opportunity,
        out: &mut Outlet<'_>,
        mut write: impl FnMut(&Queued, &mut Buf),
        mut refused: impl FnMut(&Flow, u64),
    ) -> bool {
        let Some(pool) = &self.pool else { return false };
        if pool.available() == pool.capacity() {
            // Those of a slot that was taken away will not come any more.
            self.waiting = [0; QUEUES];
        }
        for (flow, going) in self.plan.flows.iter().zip(&mut self.going) {
            let queue = queue_of(&self.plan, flow.slot);
            let (first, due) = going.due(flow, slot.scheduled - DEFAULT_LEAD);
            let mut queued = 0;
            for n in 0..due {
                let at = GlobalTime::from_nanos((first + n / u64::from(flow.burst)) * flow.every_ns);
                let Some(mut frame) = pool.take() else { break };
                write(&Queued { flow: *flow, sequence: going.sequence, at }, &mut frame);
                let priority = Priority::new(flow.priority).unwrap_or(Priority::LAST_REAL_TIME);
                if out(frame, priority, flow.slot).is_err() {
                    break;
                }
                (going.sequence, queued) = (going.sequence + 1, queued + 1);
                self.waiting[queue] += 1;
            }
            // Where one finds no room the next one does not, either.
            refused(flow, due - queued);
        }
        let waiting = &mut self.waiting[queue_of(&self.plan, slot.channel)];
        let is_taken = *waiting > 0;
        *waiting -= usize::from(is_taken);
        is_taken
    }

    /// One has missed its slot: it waits for the next.
    pub fn waits_again(&mut self, tag: &Tag) {
        self.waiting[queue_of(&self.plan, tag.slot)] += 1;
    }

    /// Whether a frame that came is one of the sender's, and not of old.
    pub fn check(&mut self, priority: u8, sequence: u64, payload: usize) -> Option<()> {
        let flow = self.plan.from.iter().find(|flow| flow.priority == priority)?;
        let heard = self.heard.get_mut(usize::from(priority)).filter(|_| flow.payload == payload)?;
        step(*heard, sequence)?;
        *heard = Some(sequence);
        Some(())
    }
}

impl Going {
    /// The first moment that has come and whose frames are not queued yet, and how many frames there are up to now. What
    /// would have been before the first slot, or in a time that was given up for an earlier one, never was.
    fn due(&mut self, flow: &Flow, now: GlobalTime) -> (u64, u64) {
        let behind = now.nanos() / flow.every_ns + 1;
        let first = self.next.filter(|&next| next <= behind).unwrap_or(behind);
        self.next = Some(behind);
        (first, (behind - first).saturating_mul(flow.burst.into()))
    }
}

/// Where a slot takes its frames from.
fn queue_of(plan: &FlowPlan, slot: Channel) -> usize {
    let joint = plan.joint.iter().find(|(of, _)| *of == slot);
    usize::from(joint.map_or(slot, |&(_, queue)| queue)) % QUEUES
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rtnet::discipline::{SendError, Service};
    use rtnet::time::Instant;
    use rtnet::wire::ethernet::Address;

    use super::super::{Traffic, TrafficCounts, TrafficPlan};
    use super::*;

    const FLOW: Flow = Flow { priority: 3, every_ns: 3_000_000, burst: 2, payload: 100, slot: 0 };

    /// A station with slots 0 and 2, of which the second takes from the first one's queue; all that it queued is kept.
    struct Bench {
        traffic: Traffic,
        counts: Arc<TrafficCounts>,
        queued: Vec<Buf>,
        room: usize,
    }

    impl Bench {
        fn new(flows: &[Flow]) -> Self {
            let counts = Arc::new(TrafficCounts::default());
            let (source, destination) = (Address([2, 0, 0, 0, 0, 1]), Address([2, 0, 0, 0, 0, 2]));
            let plan = TrafficPlan {
                station: 0,
                source,
                destination,
                from: 1,
                payload: 64,
                from_payload: 64,
                first: 0,
            };
            let flows = FlowPlan { flows: flows.to_vec(), joint: vec![(2, 0)], from: Vec::new() };
            let traffic = Traffic::new(plan, counts.clone()).with_flows(flows);
            Self { traffic, counts, queued: Vec::new(), room: usize::MAX }
        }

        /// What is queued for slot 0 of a cycle of 1 ms, 100 us behind its start: priority, number, and at which
        /// microsecond a program queued it.
        fn poll(&mut self, cycle: u32) -> Vec<(u8, u64, u64)> {
            self.poll_slot(cycle, 0)
        }

        fn poll_slot(&mut self, cycle: u32, channel: Channel) -> Vec<(u8, u64, u64)> {
            let at = u64::from(cycle) * 1_000_000 + 100_000 + u64::from(channel) * 100_000;
            let (begin, scheduled) = (Instant::from_nanos(at), GlobalTime::from_nanos(at));
            let before = self.queued.len();
            let Self { traffic, queued, room, .. } = self;
            traffic.poll(&Opportunity { channel, cycle, begin, scheduled }, &mut |frame, priority, _| {
                let (tag, _) = Tag::read(&frame).unwrap();
                assert_eq!(tag.priority().unwrap_or(30), priority.level());
                if queued.len() - before == *room {
                    return Err((SendError::QueueFull(0), frame));
                }
                queued.push(frame);
                Ok(())
            });
            let tag = |frame: &Buf| *Tag::read(frame).unwrap().0;
            let all = self.queued[before..].iter().map(tag);
            all.map(|tag| (tag.priority().unwrap_or(30), tag.sequence(), tag.scheduled().nanos() / 1_000))
                .collect()
        }
    }

    #[test]
    fn usual_frames_have_what_slots_are_left() {
        let mut bench = Bench::new(&[FLOW]);
        assert_eq!(bench.poll(1), [(30, 0, 1_100)]);
        assert_eq!(bench.poll(2), [(30, 1, 2_100)]);
        assert_eq!(bench.poll(3), [(3, 0, 3_000), (3, 1, 3_000)], "the first of them takes this slot");
        assert_eq!(bench.poll(4), [], "the second one waits");
        assert_eq!(bench.poll(5), [(30, 2, 5_100)]);
        assert_eq!(bench.poll(6), [(3, 2, 6_000), (3, 3, 6_000)]);
        assert_eq!(bench.poll_slot(6, 2), [], "a slot that is joined takes the second one");
        assert_eq!(bench.poll(7), [(30, 3, 7_100)]);
    }

    #[test]
    fn a_queued_frame_that_missed_its_slot_waits_for_the_next_and_a_usual_one_is_not_wanted() {
        let mut bench = Bench::new(&[FLOW]);
        bench.poll(2);
        bench.poll(3);
        assert!(!bench.traffic.still_wanted(&bench.queued[0]));
        assert!(bench.traffic.still_wanted(&bench.queued[1]));
        assert_eq!([bench.poll(4), bench.poll(5)], [vec![], vec![]], "both wait");
        assert_eq!(bench.poll(6).len(), 2);
    }

    #[test]
    fn what_finds_no_room_is_counted_and_gone() {
        let mut bench = Bench::new(&[Flow { burst: 5, ..FLOW }]);
        bench.poll(2);
        bench.room = 3;
        assert_eq!(bench.poll(3).len(), 3);
        assert_eq!(bench.counts.refused().collect::<Vec<_>>(), [(3, 2)]);
        bench.room = usize::MAX;
        assert_eq!(bench.poll(6)[0], (3, 3, 6_000), "it has no number");
        // For ten minutes there was no slot: the oldest are queued, as many as there is room for.
        bench.queued.clear();
        let late = bench.poll(600_006);
        assert_eq!((late.len(), late[0]), (POOL, (3, 8, 9_000)));
        assert_eq!(bench.counts.refused().collect::<Vec<_>>(), [(3, 2 + 200_000 * 5 - POOL as u64)]);
    }

    #[test]
    fn queued_frames_that_are_gone_leave_their_slots_to_the_usual_ones() {
        let mut bench = Bench::new(&[FLOW]);
        bench.poll(2);
        assert_eq!(bench.poll(3).len(), 2);
        bench.queued.clear();
        assert_eq!(bench.poll(4), [(30, 1, 4_100)]);
    }

    #[test]
    fn a_time_that_is_set_back_queues_nothing_of_before() {
        let mut bench = Bench::new(&[FLOW]);
        bench.poll(300);
        assert_eq!(bench.poll(10), [(30, 1, 10_100)]);
        assert_eq!(bench.poll(12), [(3, 0, 12_000), (3, 1, 12_000)]);
    }

    #[test]
    fn a_receiver_takes_what_its_sender_queues_in_the_order_of_each_priority() {
        let mut bench = Bench::new(&[FLOW]);
        bench.poll(2);
        bench.poll(3);
        let plan = TrafficPlan {
            station: 1,
            source: Address([2, 0, 0, 0, 0, 2]),
            destination: Address([2, 0, 0, 0, 0, 1]),
            from: 0,
            payload: 64,
            from_payload: 64,
            first: 0,
        };
        let receiver = |from: Vec<Flow>| {
            Traffic::new(plan, Arc::default()).with_flows(FlowPlan { from, ..FlowPlan::default() })
        };
        let pool = Pool::new(4);
        let copy = |frame: &Buf| {
            let mut copy = pool.take().unwrap();
            copy.fill(frame);
            copy
        };
        let mut knows = receiver(vec![FLOW]);
        for frame in &bench.queued {
            assert_eq!(knows.on_frame(None, copy(frame)), Ok(()));
        }
        assert!(knows.on_frame(None, copy(&bench.queued[1])).is_err(), "twice");
        assert!(receiver(Vec::new()).on_frame(None, copy(&bench.queued[1])).is_err(), "nobody said so");
        let other = Flow { payload: 60, ..FLOW };
        assert!(receiver(vec![other]).on_frame(None, copy(&bench.queued[1])).is_err(), "of another size");
    }
}
