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
            let (first, mut left) = going.due(flow, slot.scheduled - DEFAULT_LEAD);
            for n in 0..left {
                let at = GlobalTime::from_nanos((first + n / u64::from(flow.burst)) * flow.every_ns);
                let Some(mut frame) = pool.take() else { break };
                write(&Queued { flow: *flow, sequence: going.sequence, at }, &mut frame);
                let priority = Priority::new(flow.priority).unwrap_or(Priority::LAST_REAL_TIME);
                if out(frame, priority, flow.slot).is_err() {
                    break;
                }
                (going.sequence, left) = (going.sequence + 1, left - 1);
                self.waiting[queue] += 1;
            }
            // Where one finds no room the next one does not, either.
            refused(flow, left);
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
