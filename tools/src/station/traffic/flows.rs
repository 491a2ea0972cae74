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

use rtmac::tdma::DEFAULT_LEAD;
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Channel, Opportunity, Outlet};
use rtnet::queue::Priority;
use rtnet::time::GlobalTime;
use serde::{Deserialize, Serialize};

use super::Newest;

/// Frames of flows that wait, or are being sent: as many as two slots' queues hold.
pub const BUFFERS_OF_FLOWS: usize = 64;

/// Frames of one priority, queued again and again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
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
    /// What is sent to it.
    pub from: Vec<Flow>,
}

/// The flows of a station as they go.
pub(super) struct Flows {
    plan: FlowPlan,
    going: Vec<Going>,
    pool: Option<Pool>,
    /// The numbers of the last frames that came of each flow of the sender's.
    heard: Vec<Newest>,
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
        let pool = (!going.is_empty()).then(|| Pool::new(BUFFERS_OF_FLOWS));
        let heard = vec![Newest::default(); plan.from.len()];
        Self { plan, going, pool, heard }
    }

    /// Queues all that are due. `write` makes a frame, and `refused` is told of those for which there was no room.
    pub fn poll(
        &mut self,
        slot: &Opportunity,
        out: &mut Outlet<'_>,
        mut write: impl FnMut(&Queued, &mut Buf),
        mut refused: impl FnMut(&Flow, u64),
    ) {
        let Some(pool) = &self.pool else { return };
        for (flow, going) in self.plan.flows.iter().zip(&mut self.going) {
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
            }
            // Where one finds no room the next one does not, either.
            refused(flow, due - queued);
        }
    }

    /// The numbers that came of a priority, if the sender has frames of that and of this size.
    pub fn heard(&mut self, priority: u8, payload: usize) -> Option<&mut Newest> {
        let mut flows = self.plan.from.iter().zip(&mut self.heard);
        let (flow, heard) = flows.find(|(flow, _)| flow.priority == priority)?;
        (flow.payload == payload).then_some(heard)
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rtnet::discipline::{SendError, Service};
    use rtnet::time::Instant;
    use rtnet::wire::ethernet::Address;

    use super::super::{Tag, Traffic, TrafficCounts, TrafficPlan};
    use super::*;

    const FLOW: Flow = Flow { priority: 3, every_ns: 3_000_000, burst: 2, payload: 100, slot: 0 };

    /// A station whose slots take from one queue; all that has left is kept.
    struct Bench {
        traffic: Traffic,
        counts: Arc<TrafficCounts>,
        waiting: Vec<Buf>,
        left: Vec<Buf>,
        room: usize,
    }

    fn priority(frame: &Buf) -> u8 {
        Tag::read(frame).unwrap().0.priority().unwrap_or(Priority::LAST_REAL_TIME.level())
    }

    impl Bench {
        fn new(flows: &[Flow]) -> Self {
            let flows = FlowPlan { flows: flows.to_vec(), from: Vec::new() };
            let counts = Arc::new(TrafficCounts::of(&flows));
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
            let traffic = Traffic::new(plan, counts.clone()).with_flows(flows);
            Self { traffic, counts, waiting: Vec::new(), left: Vec::new(), room: usize::MAX }
        }

        /// What is queued for slot 0 of a cycle of 1 ms, 100 us behind its start: priority, number, and at which
        /// microsecond a program queued it. The most urgent of all that waits leaves.
        fn poll(&mut self, cycle: u32) -> Vec<(u8, u64, u64)> {
            self.poll_slot(cycle, 0)
        }

        fn poll_slot(&mut self, cycle: u32, channel: Channel) -> Vec<(u8, u64, u64)> {
            let at = u64::from(cycle) * 1_000_000 + 100_000 + u64::from(channel) * 100_000;
            let (begin, scheduled) = (Instant::from_nanos(at), GlobalTime::from_nanos(at));
            let slot = Opportunity { channel, cycle, begin, scheduled, non_rt: None };
            let mut queued = Vec::new();
            let Self { traffic, waiting, left, room, .. } = self;
            let mut out = |frame: Buf, of: Priority, _| {
                assert_eq!(priority(&frame), of.level());
                if queued.len() == *room {
                    return Err((SendError::QueueFull(0), frame));
                }
                let (tag, _) = Tag::read(&frame).unwrap();
                queued.push((priority(&frame), tag.sequence(), tag.scheduled().nanos() / 1_000));
                waiting.push(frame);
                Ok(())
            };
            traffic.poll(&slot, &mut out);
            if waiting.is_empty() {
                traffic.fill(&slot, None, &mut |frame, of, channel| {
                    assert_eq!((of, channel), (Priority::LAST_REAL_TIME, slot.channel));
                    let (tag, _) = Tag::read(&frame).unwrap();
                    queued.push((priority(&frame), tag.sequence(), tag.scheduled().nanos() / 1_000));
                    waiting.push(frame);
                    Ok(())
                });
            }
            waiting.sort_by_key(priority);
            let mut frame = waiting.remove(0);
            traffic.leaves(&slot, &mut frame);
            let (tag, _) = Tag::read(&frame).unwrap();
            assert_eq!((tag.cycle(), tag.slot), (cycle, channel), "it says in which turn it leaves");
            left.push(frame);
            queued
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
        assert!(!bench.traffic.still_wanted(&bench.left[0], Priority::LAST_REAL_TIME));
        assert!(bench.traffic.still_wanted(&bench.left[1], Priority::LAST_REAL_TIME));
        bench.waiting.insert(0, bench.left.remove(1));
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
        (bench.waiting, bench.left) = Default::default();
        let late = bench.poll(600_006);
        assert_eq!((late.len(), late[0]), (BUFFERS_OF_FLOWS, (3, 8, 9_000)));
        assert_eq!(
            bench.counts.refused().collect::<Vec<_>>(),
            [(3, 2 + 200_000 * 5 - BUFFERS_OF_FLOWS as u64)]
        );
    }

    #[test]
    fn queued_frames_that_are_gone_leave_their_slots_to_the_usual_ones() {
        let mut bench = Bench::new(&[FLOW]);
        bench.poll(2);
        assert_eq!(bench.poll(3).len(), 2);
        bench.waiting.clear();
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
    #[should_panic(expected = "the counts are of other flows")]
    fn flows_without_a_count_are_refused_at_once() {
        let plan = Bench::new(&[]).traffic.plan;
        let flows = FlowPlan { flows: vec![FLOW], from: Vec::new() };
        drop(Traffic::new(plan, Arc::default()).with_flows(flows));
    }

    #[test]
    fn a_receiver_takes_what_its_sender_queues_in_the_order_of_each_priority() {
        let mut bench = Bench::new(&[FLOW]);
        (2..=4).for_each(|cycle| drop(bench.poll(cycle)));
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
            let flows = FlowPlan { from, ..FlowPlan::default() };
            Traffic::new(plan, Arc::new(TrafficCounts::of(&flows))).with_flows(flows)
        };
        let pool = Pool::new(4);
        let copy = |frame: &Buf| {
            let mut copy = pool.take().unwrap();
            copy.fill(frame);
            copy
        };
        let mut knows = receiver(vec![FLOW]);
        for frame in &bench.left {
            assert_eq!(knows.on_frame(None, copy(frame)), Ok(()));
        }
        assert!(knows.on_frame(None, copy(&bench.left[1])).is_err(), "twice");
        assert!(receiver(Vec::new()).on_frame(None, copy(&bench.left[1])).is_err(), "nobody said so");
        let other = Flow { payload: 60, ..FLOW };
        assert!(receiver(vec![other]).on_frame(None, copy(&bench.left[1])).is_err(), "of another size");
    }
}
