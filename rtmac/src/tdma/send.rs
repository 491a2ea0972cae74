//! The frames of jobs: what they carry, and what is counted once they have left.

use rtnet::buf::Buf;
use rtnet::discipline::{Discipline, EventKind, Stamp, Transmission};
use rtnet::queue::Priority;
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::Address;

use super::job::{Job, Pending};
use super::slot::Turn;
use super::{Role, Tdma};
use crate::wire::Message;
use crate::wire::change::Extension;

impl Tdma {
    /// Builds the frame of a job that is due; `None` when there is nothing to send after all.
    pub(super) fn build(&mut self, job: Job) -> Option<Transmission> {
        let (frame, stamp, priority) = match job {
            Job::Data(turn) => {
                let Some((priority, frame)) = self.slots.dequeue(turn.id) else {
                    self.counters.slots_empty += 1;
                    if self.slots.was_used(turn.id) {
                        self.events.note_job(&job, EventKind::SlotEmpty, Span::ZERO);
                    }
                    return None;
                };
                let stamp = frame.blank().and_then(|_| Stamp::of(&frame, &self.time(), job.at()));
                (frame, stamp, priority)
            }
            Job::Answer(turn) => (self.answer_frame(&turn)?, None, Priority::FIRST),
            Job::Part { cycle, .. } => {
                let part = self.change.as_ref()?.part_for(cycle)?;
                let mut frame = self.pool.take()?;
                Extension::Part(part).write(Address::BROADCAST, self.address, &mut frame);
                (frame, None, Priority::FIRST)
            }
            control => {
                let (message, to, add) = self.control_message(control)?;
                let mut frame = self.pool.take()?;
                message.write(to, self.address, &mut frame);
                let others = self.knows_of_others();
                if let (Job::Sync { cycle, .. }, Some(change)) = (control, &mut self.change) {
                    change.say(cycle, others).write(&mut frame);
                }
                (frame, Some(message.stamp(add)), Priority::FIRST)
            }
        };
        self.pending = Some(Pending { job, priority });
        Some(Transmission { frame, at: job.at(), latest: job.latest(), stamp })
    }

    /// A control job's message with its transmit stamp left open, whom it is for, and the stamp's addend.
    fn control_message(&mut self, job: Job) -> Option<(Message, Address, u64)> {
        match (job, &mut self.role) {
            (Job::Sync { cycle, sched, .. }, Role::Master(master)) => {
                let sync = Message::Sync { cycle, xmit: GlobalTime::default(), sched };
                Some((sync, Address::BROADCAST, master.epoch().nanos()))
            }
            (Job::Reply { .. } | Job::ReplyBehindSync { .. } | Job::ReplyInTurn(_), Role::Master(master)) => {
                let in_time = matches!(job, Job::Reply { .. });
                let asked = if in_time { master.replies().next() } else { master.replies().next_late() }?;
                // By the clock of its Synchronisations, as a real master's are: slaves compare the two.
                let epoch = master.epoch();
                let (request_xmit, reception) = (asked.request_xmit, epoch.global(asked.reception).nanos());
                Some((Message::Reply { request_xmit, reception, xmit: 0 }, asked.to, epoch.nanos()))
            }
            (Job::Request(turn), _) => {
                self.calibrates_in(&job);
                let slave = self.role.follower_mut()?;
                if !slave.calibration_mut().begin_round() {
                    self.counters.calibration_timeouts += 1;
                    self.events.note(turn.cycle, EventKind::CalibrationTimeout, Span::ZERO);
                    return None;
                }
                let slot = self.slots.get(turn.id)?;
                let reply_cycle = turn.cycle.wrapping_add(slot.period);
                let reply_offset = slot.offset.nanos() as u64;
                Some((Message::Request { xmit: 0, reply_cycle, reply_offset }, slave.master(), 0))
            }
            _ => None,
        }
    }

    /// What this station says to a schedule, or of one, for its turn, which carries no data then.
    fn answer_frame(&mut self, turn: &Turn) -> Option<Buf> {
        let said = self.said_in(turn)?;
        let to = self.follower().map_or(Address::BROADCAST, |follower| follower.master());
        let mut frame = self.pool.take()?;
        said.write(to, self.address, &mut frame);
        let change = self.change.as_mut()?;
        match &said {
            Extension::Answer(answer) => change.answers(answer),
            Extension::Part(_) => change.part_is_sent(),
        }
        self.events.note_job(&Job::Answer(*turn), EventKind::AnswerTurn, Span::ZERO);
        Some(frame)
    }

    /// How long after the Synchronisation that has left a late reply follows it: of a master that has no slot for it, and where
    /// no part of a schedule is there.
    fn reply_follows(&self) -> Option<Span> {
        let Role::Master(master) = &self.role else { return None };
        let is_free = self.slots.first().is_none() && self.part_in.is_none();
        let owes = master.replies().next_late().is_some();
        master.config().behind_sync.filter(|_| is_free && owes).map(|room| room.after)
    }

    /// A job's frame has left, with this stamp unless it was held up.
    pub(super) fn count_sent(&mut self, job: &Job, stamped: Option<Instant>) {
        match (job, &mut self.role) {
            (Job::Sync { cycle, .. }, role) => {
                self.counters.syncs_sent += 1;
                if let Role::Master(master) = role {
                    master.sent(*cycle, stamped.is_some(), &mut self.events);
                }
                if let Some(change) = &mut self.change {
                    change.spoke(*cycle);
                    let part = change.part_for(*cycle);
                    self.part_in = part.map(|_| (*cycle, job.at() + change.behind));
                }
                self.reply_in = self.reply_follows().map(|after| (*cycle, job.at() + after));
            }
            (Job::Reply { .. } | Job::ReplyBehindSync { .. }, _) => self.counters.replies_sent += 1,
            (Job::ReplyInTurn(_), _) => {
                self.counters.replies_sent += 1;
                self.calibrates_in(job);
            }
            (Job::Part { .. }, _) => {
                if let Some(change) = &mut self.change {
                    change.part_is_sent();
                }
            }
            (Job::Answer(_), _) => {}
            (Job::Data(turn), _) => {
                self.counters.frames_sent += 1;
                self.slots.count_sent(turn.id);
            }
            (Job::Request(turn), _) => {
                self.counters.requests_sent += 1;
                self.await_reply(turn);
                // A request that was held up would measure the hold-up: its reply is not awaited.
                if let (Some(slave), Some(stamped)) = (self.role.follower_mut(), stamped) {
                    slave.calibration_mut().sent(stamped);
                }
            }
        }
    }
}
