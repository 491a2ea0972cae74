//! The worker of a peer: where it is in its list of jobs.

use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;

use super::PeerSlot;

/// What the worker sleeps for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Job {
    /// The Synchronisation of the next cycle.
    Sync,
    /// A backup's look whether somebody else has sent it.
    Look,
    /// A calibration request.
    Request,
    /// A calibration reply.
    Reply(Reply),
    /// The slot with this index.
    Slot(usize),
}

/// A reply that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    pub cycle: u32,
    pub offset: Span,
    pub to: Address,
    pub xmit: u64,
    pub reception: Instant,
}

/// One lap after another through: Synchronisation, request, then slots and replies by offset.
pub struct Worker {
    lap: Lap,
    replies: Vec<Reply>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Lap {
    /// At the Synchronisation's job.
    Waiting,
    /// Behind the job with this place in the list.
    Behind(Place),
}

/// The request's place is directly behind the Synchronisation; then offsets count, then ids.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    Sync,
    Request,
    At(Span, usize),
}

impl Worker {
    pub fn new() -> Self {
        Self { lap: Lap::Waiting, replies: Vec::with_capacity(super::MAX_REQUESTS) }
    }

    pub fn is_waiting(&self) -> bool {
        self.lap == Lap::Waiting
    }

    pub fn pending_replies(&self) -> usize {
        self.replies.len()
    }

    pub fn add_reply(&mut self, reply: Reply) {
        self.replies.push(reply);
    }

    /// A Synchronisation was received or is being sent: a lap begins, unless one is still under way.
    /// Tells how many replies were discarded because their cycle had passed.
    pub fn pulse(&mut self, cycle: u32) -> u64 {
        if !self.is_waiting() {
            return 0;
        }
        self.lap = Lap::Behind(Place::Sync);
        let before = self.replies.len();
        self.replies.retain(|reply| reply.cycle >= cycle);
        (before - self.replies.len()) as u64
    }

    /// The next job of this lap in `cycle`, and its offset from the cycle's start.
    pub fn next(&self, cycle: u32, request: Option<&PeerSlot>, slots: &[PeerSlot]) -> Option<(Job, Span)> {
        let Lap::Behind(done) = self.lap else { return None };
        let mine = |slot: &PeerSlot| cycle % slot.period == slot.phase;
        let request =
            request.filter(|slot| mine(slot)).map(|slot| (Place::Request, Job::Request, slot.offset));
        let replies = self.replies.iter().filter(|reply| reply.cycle == cycle);
        let replies = replies.map(|reply| (Place::At(reply.offset, 0), Job::Reply(*reply), reply.offset));
        let slots = slots.iter().enumerate().filter(|(_, slot)| mine(slot));
        let slots = slots
            .map(|(i, slot)| (Place::At(slot.offset, 1 + usize::from(slot.id)), Job::Slot(i), slot.offset));
        // A reply is taken out of the list when it is sent, so several may have one place.
        let ahead = request.into_iter().chain(replies).chain(slots).filter(|(place, job, _)| match job {
            Job::Reply(_) => *place >= done,
            _ => *place > done,
        });
        ahead.min_by_key(|(place, ..)| *place).map(|(_, job, offset)| (job, offset))
    }

    /// The job is done, or there was nothing to send.
    pub fn pass(&mut self, job: &Job, slots: &[PeerSlot]) {
        let place = match job {
            Job::Sync | Job::Look => Place::Sync,
            Job::Request => Place::Request,
            Job::Reply(reply) => {
                if let Some(i) = self.replies.iter().position(|waiting| waiting == reply) {
                    self.replies.remove(i);
                }
                Place::At(reply.offset, 0)
            }
            Job::Slot(i) => Place::At(slots[*i].offset, 1 + usize::from(slots[*i].id)),
        };
        self.lap = Lap::Behind(place);
    }

    /// Nothing is left in this lap.
    pub fn end_lap(&mut self) {
        self.lap = Lap::Waiting;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slot(id: u8, offset: i64, phase: u32, period: u32) -> PeerSlot {
        PeerSlot { id, offset: Span::from_nanos(offset), phase, period, size: 46 }
    }

    fn reply(cycle: u32, offset: i64) -> Reply {
        let (to, offset) = (Address([2, 0, 0, 0, 0, 9]), Span::from_nanos(offset));
        Reply { cycle, offset, to, xmit: 1, reception: Instant::default() }
    }

    /// What is left of the lap in `cycle`, job after job.
    fn lap(worker: &mut Worker, cycle: u32, slots: &[PeerSlot]) -> Vec<Job> {
        let step = || {
            let (job, _) = worker.next(cycle, None, slots)?;
            worker.pass(&job, slots);
            Some(job)
        };
        core::iter::from_fn(step).collect()
    }

    #[test]
    fn a_lap_goes_by_offset_and_a_reply_waits_for_its_cycle() {
        let slots = [slot(0, 300, 0, 1), slot(1, 100, 1, 2)];
        let mut worker = Worker::new();
        worker.add_reply(reply(8, 200));
        worker.pulse(7);
        assert_eq!(lap(&mut worker, 7, &slots), [Job::Slot(1), Job::Slot(0)]);
        worker.end_lap();
        worker.pulse(8);
        assert_eq!(lap(&mut worker, 8, &slots), [Job::Reply(reply(8, 200)), Job::Slot(0)]);
    }

    #[test]
    fn a_pulse_during_a_lap_is_not_remembered() {
        let slots = [slot(0, 300, 0, 1)];
        let mut worker = Worker::new();
        worker.pulse(7);
        worker.pulse(8);
        assert_eq!(lap(&mut worker, 8, &slots), [Job::Slot(0)], "late, on the clock of cycle 8");
        worker.end_lap();
        assert_eq!(lap(&mut worker, 8, &slots), []);
    }

    #[test]
    fn a_reply_whose_cycle_has_passed_is_discarded_by_plain_comparison() {
        let mut worker = Worker::new();
        worker.add_reply(reply(7, 0));
        worker.add_reply(reply(u32::MAX, 0));
        assert_eq!(worker.pulse(8), 1);
        assert_eq!(worker.pending_replies(), 1, "of the cycle before the wrap, for ever");
    }
}
