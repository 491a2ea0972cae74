//! The TDMA discipline: [`Tdma`] is a master or a slave with its slots.
//!
//! Every cycle has a grid of jobs, at most one of them at a time:
//!
//! ```text
//! job          whose    when                       what
//! Sync         master   start of each cycle        tells cycle number and time
//!              backup   later, if it is missing    the same
//! Reply        master   where a slave asked, or,   answers a calibration request
//!                       if that is over, in the
//!                       master's own next slot
//! Request      slave    its first slot             asks, until calibrated, or anew; then silent for the reply
//! Data         both     its slots                  the most urgent frame of the slot's queue
//! ```
//!
//! A job is chosen at its instant less the lead. One whose `latest` instant has passed is skipped,
//! counted and told of; it is never made up for.

mod anew;
mod bound;
mod calibration;
pub mod change;
mod config;
mod due;
mod edge;
mod envelope;
mod events;
mod follow;
mod job;
pub mod joint;
pub mod line;
mod mark;
mod master;
mod rate;
mod receive;
mod replies;
mod report;
mod rival;
mod round;
mod running;
pub mod schedule;
mod send;
mod slave;
mod slot;
mod status;
mod switch;

use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{
    Channel, Claimed, Discipline, Event, EventKind, Opportunity, Returned, SendError, Sent, SyncState,
    TimeView, Transmission,
};
use rtnet::queue::Priority;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header};

pub use anew::NewRounds;
use anew::ReplyTurn;
pub use calibration::{DEFAULT_ROUNDS, MAX_ROUNDS};
use change::Change;
pub use config::{
    DEFAULT_LEAD, LatePolicy, NewRole, Refused, RoleConfig, TdmaCommand, TdmaConfig, check_cycle,
    check_rounds,
};
use config::{check_rounds_of_master, checked};
use events::Events;
pub use follow::{HOLDOVER_CYCLES, MAX_HOLDOVER, OnMasterChange, Servo, SlaveConfig};
use job::{Job, Pending};
pub use line::TimeLine;
pub use mark::{bridged_below, slow_at_most};
use master::Master;
pub use master::{BACKUP_LOOKS_BEFORE, BehindSync, MasterConfig, Mastery};
pub use replies::{DEFAULT_MAX_REQUESTS, MAX_REPLY_AHEAD, MAX_REQUESTS};
pub use report::{CalibrationReport, DelayOf, Delays};
use slave::Slave;
use slot::Slots;
pub use slot::{DEFAULT_MAX_SLOT_ID, MIN_SIZE, NON_RT_SLOT, RT_SLOT, SlotConfig, SlotStatus};
pub use status::{Counters, RoleName, SLOTS_SHOWN, TdmaStatus};

use crate::wire::change::Status;
use crate::wire::{self, Rtmac};

/// A station of a TDMA network. What every turn looks at is together, from `address` on to the end of what a slave begins
/// with: of a thousand stations in virtual time it is what has to fit into a processor's cache.
#[repr(C)]
pub struct Tdma {
    /// Where the reply was asked for by the last request.
    reply_turn: Option<ReplyTurn>,
    /// It has calibrated: its slots begin then, once it knows.
    begins: Option<Instant>,
    address: Address,
    late: LatePolicy,
    lead: Span,
    /// When time was last told of.
    looked: Instant,
    /// Synchronisations, requests and replies are sent from here.
    pool: Pool,
    pending: Option<Pending>,
    slots: Slots,
    /// The last slot that was silent: its cycle, and when it was.
    silent: Option<(u32, Instant)>,
    counters: Counters,
    role: Role,
    events: Events,
    /// The cycle and the instant of what is to follow the last Synchronisation.
    part_in: Option<(u32, Instant)>,
    /// The same of a reply that is late.
    reply_in: Option<(u32, Instant)>,
    /// `None`: it takes no part in changes of the schedule.
    change: Option<Box<Change>>,
}

// A master is a slave and more; in a box it would have to be freed when it becomes one.
#[allow(clippy::large_enum_variant)]
enum Role {
    Master(Master),
    Slave(Slave),
    Detached,
}

impl Role {
    /// Who follows a master: a slave, or a master that does not give the time itself.
    fn follower(&self) -> Option<&Slave> {
        match self {
            Role::Master(master) => master.follower(),
            Role::Slave(slave) => Some(slave),
            Role::Detached => None,
        }
    }

    fn follower_mut(&mut self) -> Option<&mut Slave> {
        match self {
            Role::Master(master) => master.follower_mut(),
            Role::Slave(slave) => Some(slave),
            Role::Detached => None,
        }
    }

    /// Whether these slots can be used as it follows others, if it is told that there may be some.
    fn can_use<'a>(
        &self,
        lead: Span,
        slots: impl IntoIterator<Item = &'a SlotConfig>,
    ) -> Result<(), Refused> {
        let follow = match self {
            Role::Master(master) if master.config().knows_of_others() => master.config().follow,
            Role::Slave(slave) => *slave.config(),
            Role::Master(_) | Role::Detached => return Ok(()),
        };
        follow.check_slots(lead, slots)
    }
}

impl Tdma {
    /// A station with its slots; what cannot be is refused by name.
    pub fn new(config: &TdmaConfig) -> Result<Self, Refused> {
        let (mut slots, mut events) = (Slots::new(config.max_slot_id), Events::new());
        let mut resolved = joint::resolved(&config.slots)?;
        // Those that others are joined to come first.
        resolved.sort_by_key(|slot| slot.joint);
        for slot in resolved {
            if slots.get(slot.id).is_some() {
                return Err(Refused::DefinedTwice { id: slot.id });
            }
            slots.set(slot, 0, &mut events)?;
        }
        match config.role {
            RoleConfig::Master(master) => {
                checked(master, &config.slots)?;
                check_rounds_of_master(&master, config.slots.iter().map(|slot| (slot.id, slot.period)))?;
            }
            RoleConfig::Slave(slave) => {
                check_rounds(slave.rounds, config.slots.iter().map(|slot| (slot.id, slot.period)))?;
            }
        }
        let NewRole(role) = NewRole::attached(config.role)?;
        role.can_use(config.lead, &config.slots)?;
        Ok(Self {
            address: config.address,
            lead: config.lead,
            late: config.late,
            role,
            slots,
            // All pending replies are built when their instant comes, one frame at a time.
            pool: Pool::new(2),
            pending: None,
            reply_turn: None,
            begins: None,
            looked: Instant::default(),
            silent: None,
            events,
            counters: Counters::default(),
            part_in: None,
            reply_in: None,
            change: None,
        })
    }

    fn line(&self) -> Option<&TimeLine> {
        match &self.role {
            Role::Master(master) => master.line(),
            Role::Slave(slave) => slave.line(),
            Role::Detached => None,
        }
    }

    fn follower(&self) -> Option<&Slave> {
        self.role.follower()
    }

    /// The cycle that it is now, by the line; 0 without one.
    fn cycle_at(&self, now: Instant) -> u32 {
        self.line().map_or(0, |line| {
            let gone = (now - line.start).nanos().div_euclid(line.period.nanos());
            line.cycle.wrapping_add(gone as u32)
        })
    }
}

impl Discipline for Tdma {
    type Command = TdmaCommand;
    type Refused = Refused;
    type Status = TdmaStatus;

    fn claims(&self, header: &Header) -> bool {
        header.ether_type() == EtherType::RTMAC
    }

    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Claimed {
        let message = match wire::parse(&frame) {
            Ok(Rtmac::Tdma(message)) => Ok(message),
            Ok(Rtmac::Tunnel(..)) => return Claimed::Tunnel(frame),
            Ok(Rtmac::Extension(_)) if self.change.is_none() => {
                return Claimed::Refused(Refusal::TdmaVersion);
            }
            Ok(Rtmac::Extension(extension)) => Err(extension),
            Err(reason) => return Claimed::Refused(reason),
        };
        let Some((header, _)) = Header::parse(&frame) else { return Claimed::Refused(Refusal::Runt) };
        let Some(rx) = rx else { return Claimed::Refused(Refusal::NoStamp) };
        let done = match message {
            Ok(message) => {
                let status = self.change.as_ref().and_then(|_| Status::of_sync(&frame));
                self.on_message(rx, header, message, status)
            }
            Err(extension) => self.on_extension(rx, header, extension),
        };
        match done {
            Ok(()) => Claimed::Kept,
            Err(reason) => Claimed::Refused(reason),
        }
    }

    fn on_timeout(&mut self, now: Instant) {
        self.looked = now;
        if let (Some(from), Some(line)) = (self.begins.take(), self.line().copied()) {
            // A station that has given the time had turns meanwhile: they are reported.
            let from = if self.has_given_the_time() { from } else { from.max(now) };
            self.slots.align(&line, from);
        }
        self.stand_by_for_switch(now);
        match &mut self.role {
            Role::Master(master) => {
                let has_slots = self.slots.first().is_some();
                if !has_slots && master.config().behind_sync.is_none() {
                    // Without a place for a late reply, the master drops it as RTnet does.
                    master.replies_mut().drop_late();
                }
                let has_schedule = self.change.as_ref().is_none_or(|change| change.is_able());
                if master.on_timeout(now, has_slots, has_schedule, &mut self.events)
                    && let (Some(line), Some((cycle, ..))) = (master.line(), master.next_sync())
                {
                    let line = line.at(cycle);
                    if let Some(left) = master.take_left() {
                        self.leave(&left, &left, now, true);
                    }
                    self.slots.align(&line, now);
                }
            }
            Role::Slave(slave) => {
                let left = slave.line().copied();
                slave.on_timeout(now, &mut self.events);
                // Who calibrates has no slots yet.
                let is_calibrated = slave.calibration().delay().is_some();
                if let (Some(left), None, true) = (left, slave.line(), is_calibrated) {
                    self.leave(&left, &left, now, false);
                }
            }
            Role::Detached => {}
        }
    }

    fn opportunity(&mut self, now: Instant) -> Option<Opportunity> {
        let Some(Job::Data(turn)) = self.due(now) else { return None };
        let line = self.line()?;
        let slot = self.slots.get(turn.id)?;
        let scheduled = line.sched_of(turn.cycle) + slot.offset;
        let non_rt = self.slots.takes_non_rt(slot).then_some(slot.size);
        Some(Opportunity { channel: turn.id, cycle: turn.cycle, begin: turn.at, scheduled, non_rt })
    }

    fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        let job = self.due(now)?;
        let built = self.build(job);
        // A chosen job does not come again.
        self.pass(&job, now);
        built
    }

    fn on_sent(&mut self, outcome: Sent) -> Option<Returned> {
        let Pending { job, priority } = self.pending.take()?;
        match outcome {
            Sent::At(stamped) => self.count_sent(&job, Some(stamped)),
            Sent::StalledUntil(until) => {
                self.count_sent(&job, None);
                self.counters.stalled_in_send += 1;
                let late = until - job.latest();
                if job.is_reply() {
                    self.events.note(job.cycle(), EventKind::ReplyStalled, late);
                } else {
                    self.events.note_job(&job, EventKind::StalledInSend, late);
                }
            }
            Sent::Late(now, frame) => {
                self.missed(&job, now - job.latest());
                self.postpone(&job);
                return job.returned(frame, priority);
            }
            Sent::Guarded(now, frame) => {
                self.guard_dropped(&job, now - job.latest());
                self.postpone(&job);
                return job.returned(frame, priority);
            }
            Sent::Failed(errno, frame) => {
                self.counters.send_failed += 1;
                let kind = match job {
                    Job::Reply { .. } | Job::ReplyBehindSync { .. } => EventKind::ReplyFailed,
                    _ => EventKind::SendFailed,
                };
                self.events.note_job(&job, kind, Span::from_nanos(i64::from(errno)));
                self.postpone(&job);
                return job.returned(frame, priority);
            }
        }
        None
    }

    fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        self.slots.enqueue(frame, priority, ch)
    }

    fn is_waiting(&self, channel: Channel) -> bool {
        self.slots.first_for(channel).is_some()
    }

    fn put_back(&mut self, frame: Returned) {
        if self.slots.put_back(frame).is_err() {
            self.counters.returned_dropped += 1;
        }
    }

    fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        self.slots.payload_limit(ch)
    }

    fn next_deadline(&self) -> Option<Instant> {
        let role = match &self.role {
            Role::Master(master) => master.deadline(),
            Role::Slave(slave) => slave.deadline(),
            Role::Detached => None,
        };
        let job = self.next_job().map(|job| job.wakes_at(self.lead, self.looked));
        role.into_iter().chain(job).chain(self.switch_wakes_at()).min()
    }

    /// A master that only listens for another has no slot to wait for, and may have heard enough long before its deadline.
    fn wakes_on_frames(&self) -> bool {
        matches!(&self.role, Role::Master(master) if master.only_listens())
    }

    fn time(&self) -> TimeView {
        let state = match &self.role {
            Role::Master(master) => master.state(),
            Role::Slave(slave) => slave.state(),
            Role::Detached => SyncState::Waiting,
        };
        let line = self.line();
        TimeView {
            state,
            cycle: line.map_or(0, |line| line.cycle),
            start: line.map_or(Instant::default(), |line| line.start),
            offset: line.map_or(Default::default(), |line| line.offset),
            period: line.map(|line| line.period),
            drift_ppb: line.map_or(0, |line| line.drift.parts_per_billion(line.period)),
            holdover: self.follower().map_or(0, |follower| follower.config().holdover as u16),
        }
    }

    fn next_event(&mut self) -> Option<Event> {
        self.events.take()
    }

    fn command(&mut self, now: Instant, command: &mut TdmaCommand) -> Result<u32, Refused> {
        let cycle = self.cycle_at(now);
        match command {
            TdmaCommand::SetSlot(slot) => {
                let slot = *slot;
                self.not_while_changing()?;
                if let Role::Master(master) = &self.role {
                    checked(*master.config(), &[slot])?;
                }
                self.not_while_calibrating(slot.id, now)?;
                self.joined_may_follow(&slot, now)?;
                self.can_calibrate(slot.id, Some(&slot))?;
                self.role.can_use(self.lead, [&slot])?;
                if let Some(&TimeLine { period: cycle, .. }) = self.line()
                    && slot.offset >= cycle
                {
                    return Err(Refused::BeyondCycle { id: slot.id, offset: slot.offset, cycle });
                }
                self.slots.set(slot, cycle, &mut self.events)?;
            }
            TdmaCommand::RemoveSlot(id) => {
                self.not_while_changing()?;
                self.not_while_calibrating(*id, now)?;
                let others = self.slots.planned().any(|slot| slot.id != *id);
                if matches!(self.role, Role::Slave(_)) && !others {
                    return Err(Refused::LastSlot { id: *id });
                }
                self.can_calibrate(*id, None)?;
                self.slots.remove(*id, cycle)?;
            }
            TdmaCommand::Become(NewRole(role)) => {
                self.not_while_changing()?;
                let slots = || self.slots.planned().map(|slot| (slot.id, slot.period));
                match role {
                    Role::Master(master) => {
                        let config = master.config();
                        self.slots.planned().try_for_each(|slot| checked(*config, &[slot]).map(drop))?;
                        check_rounds_of_master(config, slots())?;
                    }
                    Role::Slave(slave) => check_rounds(slave.calibration().rounds(), slots())?,
                    Role::Detached => {}
                }
                self.slots.planned().try_for_each(|slot| role.can_use(self.lead, [&slot]))?;
                self.leave_until(cycle, now);
                if let Role::Master(master) = &mut self.role {
                    master.replies_mut().clear();
                    self.counters.replies_late += master.replies().late();
                    self.counters.replies_given_up += master.replies().broken();
                }
                core::mem::swap(&mut self.role, role);
                self.silent = None;
            }
            TdmaCommand::Calibrate(rounds) => {
                self.not_while_changing()?;
                self.measure_anew(rounds)?;
            }
            TdmaCommand::Propose(book, activation) => self.propose(cycle, book, *activation)?,
            TdmaCommand::Activate(activation) => {
                self.changes()?.activate(cycle, *activation)?;
            }
            TdmaCommand::CancelChange => self.changes()?.cancel(cycle)?,
        }
        Ok(cycle.wrapping_add(1))
    }

    fn status(&self) -> TdmaStatus {
        TdmaStatus::of(self)
    }
}

#[cfg(test)]
mod tests;
