//! What is configured of a TDMA station, and what may be asked of it later.

use rtnet::discipline::{Channel, SyncState};
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;

use super::change::{Activation, Book};
use super::joint;
use super::line::PERIODS;
use super::master::BACKUP_LOOKS_BEFORE;
use super::replies::MAX_REPLY_AHEAD;
use super::slot::{MAX_PERIOD, MIN_SIZE};
use super::{
    MAX_HOLDOVER, MAX_REQUESTS, MAX_ROUNDS, Master, MasterConfig, NewRounds, Role, Slave, SlaveConfig,
    SlotConfig, Tdma,
};
use crate::wire::change::Why;

/// How long before a slot its frame is chosen, unless configured otherwise: a woken thread is there
/// within 50 us in 99 of 100 cases on a virtual machine.
pub const DEFAULT_LEAD: Span = Span::from_micros(50);

/// What to do with a slot whose `latest` instant has passed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum LatePolicy {
    /// Send nothing (invariant 5).
    #[default]
    Skip,
    /// Send all the same, as RTnet does, up to a cycle late. For comparison runs.
    Send,
}

/// What a station is in the cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoleConfig {
    /// Gives the time.
    Master(MasterConfig),
    /// Follows it.
    Slave(SlaveConfig),
}

/// Everything that is configured of a TDMA station.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TdmaConfig {
    /// The interface's address.
    pub address: Address,
    /// Master or slave.
    pub role: RoleConfig,
    /// Its slots.
    pub slots: Vec<SlotConfig>,
    /// Highest slot id.
    pub max_slot_id: u8,
    /// How long before a slot its frame is chosen.
    pub lead: Span,
    /// What to do when late.
    pub late: LatePolicy,
}

/// What the control thread may ask of a TDMA station.
// A role in a box would have to be freed by the real-time thread.
#[allow(clippy::large_enum_variant)]
pub enum TdmaCommand {
    /// Define or change a slot, from the next cycle on.
    SetSlot(SlotConfig),
    /// Remove a slot, from the next cycle on. What is queued in it is dropped and counted, but of slot 1, whose channel
    /// is slot 0's again then, and of a joint slot.
    RemoveSlot(Channel),
    /// Be something else from now on.
    Become(NewRole),
    /// Measure the delay from the master anew, from the next cycle on.
    Calibrate(NewRounds),
    /// Propose another schedule to all stations, and, if it is said when, use it once all have acknowledged.
    Propose(Book, Option<Activation>),
    /// Use what is proposed once all have acknowledged.
    Activate(Activation),
    /// Withdraw what is proposed.
    CancelChange,
}

impl TdmaCommand {
    /// Define or change a slot.
    pub fn set_slot(slot: SlotConfig) -> Self {
        Self::SetSlot(slot)
    }
}

/// A role that is ready to be taken: made by the control thread, since making it takes memory.
pub struct NewRole(pub(super) Role);

impl NewRole {
    /// A master that is about to listen, or a slave that waits for its first Synchronisation.
    pub fn attached(config: RoleConfig) -> Result<Self, Refused> {
        match config {
            RoleConfig::Master(master) => Ok(Self(Role::Master(Master::new(checked(master, &[])?)))),
            RoleConfig::Slave(slave) => slave.check().map(|()| Self(Role::Slave(Slave::new(slave)))),
        }
    }

    /// No part in the cycle: silent and deaf, until attached again.
    pub fn detached() -> Self {
        Self(Role::Detached)
    }
}

/// Why a TDMA station cannot be, or cannot be changed, as asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The id is beyond the configured ones.
    #[error("slot {id}: ids go from 0 to {max}")]
    SlotId {
        /// What was asked for.
        id: u8,
        /// The highest there is.
        max: u8,
    },
    /// A negative offset.
    #[error("slot {id}: the offset {offset} is before the cycle's start")]
    BeforeCycle {
        /// Which slot.
        id: u8,
        /// What was asked for.
        offset: Span,
    },
    /// The master's cycle ends before the slot begins.
    #[error("slot {id}: the offset {offset} is beyond the cycle of {cycle}")]
    BeyondCycle {
        /// Which slot.
        id: u8,
        /// What was asked for.
        offset: Span,
        /// The master's.
        cycle: Span,
    },
    /// A phase outside its period.
    #[error("slot {id}: phase {} of {period} does not exist: it is from 1 to the period, that 1 to {MAX_PERIOD} cycles", phase + 1)]
    Phase {
        /// Which slot.
        id: u8,
        /// Counted from 0.
        phase: u32,
        /// In cycles.
        period: u32,
    },
    /// No frame has such a payload.
    #[error("slot {id}: a size of {size} is not within {MIN_SIZE} to {}", rtnet::wire::ethernet::MTU)]
    Size {
        /// Which slot.
        id: u8,
        /// Bytes behind the Ethernet header.
        size: usize,
    },
    /// Two slots with one id.
    #[error("slot {id}: defined twice")]
    DefinedTwice {
        /// Which.
        id: u8,
    },
    /// There is nothing to remove.
    #[error("slot {id} is not defined")]
    NotDefined {
        /// Which.
        id: u8,
    },
    /// Slot 1 is not defined, and slot 0 sends what is queued for it.
    #[error("slot 1 is another name of slot 0 as long as it is not defined: there is nothing to remove")]
    Alias,
    /// A slot that another one is joined to stays.
    #[error(
        "slot {by} is joined to slot {id}, and takes from its queue: remove slot {by} first, or unjoin it (joint=none)"
    )]
    JoinedTo {
        /// Which.
        id: u8,
        /// The first that is joined to it.
        by: u8,
    },
    /// There is no slot to be joined to.
    #[error("slot {id} cannot be joined to slot {joint}: that is not defined; define it first")]
    JointUndefined {
        /// Which slot.
        id: u8,
        /// Which there is not.
        joint: u8,
    },
    /// Slots that take from one queue take the same frames.
    #[error(
        "slot {id} cannot be joined to slot {joint}: it takes {size} bytes, slot {joint} {other}; give both one size"
    )]
    JointSize {
        /// Which slot.
        id: u8,
        /// What it takes.
        size: usize,
        /// To which it was to be joined.
        joint: u8,
        /// What that takes.
        other: usize,
    },
    /// Who is joined to whom goes round, and ends at no queue.
    #[error(
        "slot {id} cannot be joined to slot {joint}: that would take from itself; give one of them its own queue"
    )]
    JointRound {
        /// Which slot.
        id: u8,
        /// To which it was to be joined.
        joint: u8,
    },
    /// The slot in which a slave calibrates cannot be removed while it has no other.
    #[error("slot {id} is the only one of a slave, which calibrates in it: define another first, or detach")]
    LastSlot {
        /// Which.
        id: u8,
    },
    /// Requests and replies are under way in it.
    #[error("slot {id} is calibrated in just now: ask again when that is done")]
    Calibrating {
        /// Which.
        id: u8,
    },
    /// More rounds than are kept.
    #[error("{rounds} calibration rounds: at most {MAX_ROUNDS}")]
    TooManyRounds {
        /// What was asked for.
        rounds: u32,
    },
    /// None at all.
    #[error("0 calibration rounds measure nothing: at least 1")]
    NoRounds,
    /// Nobody is there with whom a delay could be measured.
    #[error("this station gives the time itself: only who follows a master calibrates")]
    GivesTheTime,
    /// What is measured without a time that is followed says nothing.
    #[error("the station is {}, and calibrates anew only while it is locked", state.name())]
    NotLocked {
        /// How far it is with the master's time.
        state: SyncState,
    },
    /// It does so already.
    #[error("the station calibrates already: ask again when that is done")]
    CalibratesAlready,
    /// A line that is bridged for so long would be given up meanwhile.
    #[error("a holdover of {cycles} cycles: at most {MAX_HOLDOVER}, then the time line is given up")]
    Holdover {
        /// What was asked for.
        cycles: u32,
    },
    /// A master that answers nobody, or more than there can be.
    #[error("{requests} calibration requests at a time: at least 1 and at most {MAX_REQUESTS}")]
    Requests {
        /// What was asked for.
        requests: usize,
    },
    /// A slave that is to calibrate without a slot.
    #[error("a slave calibrates in its first slot: give it one, or 0 rounds")]
    NoSlotToCalibrate,
    /// A slave asks for a reply in the next use of its first slot, further ahead than masters look.
    #[error(
        "slot {id}: a slave calibrates in its first slot, and no master promises a reply {period} cycles ahead: \
         give that slot a period of at most {MAX_REPLY_AHEAD}, or a lower id to one with such a period, or the slave \
         0 rounds"
    )]
    NeverCalibrated {
        /// Which slot.
        id: u8,
        /// In cycles.
        period: u32,
    },
    /// No slave would follow.
    #[error("a cycle of {cycle}: no slave follows one outside {} to {}", PERIODS.start(), PERIODS.end())]
    Cycle {
        /// What was asked for.
        cycle: Span,
    },
    /// A backup would look before the primary may be late no more, or too late for its own to be in the cycle.
    #[error(
        "a backup that sends {backup} after a cycle's start: it must be later than {earliest}, since the primary may send \
         until a little earlier, and as long before the end of the cycle of {cycle}"
    )]
    Backup {
        /// What was asked for.
        backup: Span,
        /// How late a Synchronisation may be, and the time to hear of it.
        earliest: Span,
        /// The master's.
        cycle: Span,
    },
    /// In the cycle in which it takes over, a backup's slot would be before its Synchronisation.
    #[error(
        "slot {id}: the offset {offset} of a backup is not behind its Synchronisation, {earliest} at the earliest"
    )]
    BeforeBackup {
        /// Which slot.
        id: u8,
        /// What was asked for.
        offset: Span,
        /// Where the first may be.
        earliest: Span,
    },
    /// A slot that would never be used: when its frame is chosen, no Synchronisation of its cycle is there.
    #[error(
        "slot {id}: the offset {offset} is too near to the cycle's start for a holdover of 0: when its frame is chosen, no \
         Synchronisation can be there; begin it at {earliest} or later, or bridge 1 cycle"
    )]
    BeforeSync {
        /// Which slot.
        id: u8,
        /// What was asked for.
        offset: Span,
        /// Where the first may be.
        earliest: Span,
    },
    /// More slots than a schedule may have here, or none.
    #[error("a schedule of {slots} slots: at least 1, and at most {most} here")]
    ScheduleSize {
        /// How many.
        slots: usize,
        /// The most.
        most: usize,
    },
    /// Changes are for those that were started for them.
    #[error(
        "this station takes no part in changes of the schedule: start it, and all others, with --extensions"
    )]
    NoExtensions,
    /// Only the acting master proposes.
    #[error(
        "this station does not give the time, or does not know which schedule is in use: ask the acting master"
    )]
    NotActing,
    /// One at a time.
    #[error("change {number} is under way: wait for it, or cancel it")]
    ChangePending {
        /// Which.
        number: u16,
    },
    /// A change of a station's own would come between.
    #[error("a change of the schedule is under way: wait for it, or cancel it at the master")]
    ScheduleChanges,
    /// There is nothing to be activated or cancelled.
    #[error("no schedule is proposed, or it is decided on already: see `rtnet schedule show`")]
    NothingProposed,
    /// All know that it comes.
    #[error("all stations have confirmed that they switch in cycle {at}: nothing stops it any more")]
    AlreadySealed {
        /// The activation cycle.
        at: u32,
    },
    /// Too soon for all to confirm.
    #[error(
        "activation cycle {at}: it is cycle {now}, and all stations are to hear of it before; ask for one at least {least} cycles ahead"
    )]
    ActivationTooNear {
        /// What was asked for.
        at: u32,
        /// The cycle that it is.
        now: u32,
        /// How far ahead it has to be.
        least: u32,
    },
    /// Who may give the time has to be able to confirm.
    #[error("station {station} may give the time, and has no slot to confirm a change in: give it one first")]
    MasterWithoutSlot {
        /// Which.
        station: Address,
    },
    /// The proposer's own slots cannot be.
    #[error("slot {id} of this station: {}", why.text())]
    CannotTake {
        /// Which.
        id: u8,
        /// Why.
        why: Why,
    },
    /// The Synchronisation would have more than the cycle.
    #[error("a sync window that lasts beyond the cycle of {cycle}: shorten it")]
    SyncWindow {
        /// The master's.
        cycle: Span,
    },
}

/// Whether a slave can calibrate in so many rounds with these slots, each an id and a period.
pub fn check_rounds(rounds: u32, slots: impl Iterator<Item = (Channel, u32)>) -> Result<(), Refused> {
    match (rounds, slots.min()) {
        (0, _) => Ok(()),
        (too_many, _) if too_many > MAX_ROUNDS => Err(Refused::TooManyRounds { rounds }),
        (_, None) => Err(Refused::NoSlotToCalibrate),
        (_, Some((id, period))) if period > MAX_REPLY_AHEAD => Err(Refused::NeverCalibrated { id, period }),
        _ => Ok(()),
    }
}

/// The same of a master, which calibrates when it follows another: without a slot it does without, and whoever is not told
/// of others follows them only to make way.
pub fn check_rounds_of_master(
    master: &MasterConfig,
    slots: impl Iterator<Item = (Channel, u32)>,
) -> Result<(), Refused> {
    match check_rounds(master.follow.rounds, slots) {
        Err(Refused::NoSlotToCalibrate) => Ok(()),
        Err(Refused::NeverCalibrated { .. }) if !master.knows_of_others() => Ok(()),
        checked => checked,
    }
}

impl Tdma {
    /// A reply is on its way in the slot that calibration uses: it stays where it is for the while, and stays the first.
    pub(super) fn not_while_calibrating(&self, id: Channel, now: Instant) -> Result<(), Refused> {
        let follower = self.follower().filter(|follower| follower.line().is_some());
        let measures = follower.is_some_and(|follower| follower.calibration().is_measuring());
        match self.slots.first() {
            Some(first) if (measures || self.awaits_reply(now)) && id <= first.id => {
                Err(Refused::Calibrating { id: first.id })
            }
            _ => Ok(()),
        }
    }

    /// What is joined to a slot changes with it, by the same rule.
    pub(super) fn joined_may_follow(&self, slot: &SlotConfig, now: Instant) -> Result<(), Refused> {
        let mut followers = self.slots.planned().filter(|other| joint::follow(other, slot).is_some());
        followers.try_for_each(|follower| self.not_while_calibrating(follower.id, now))
    }

    /// Who is still to calibrate, or will again, must be able to with the slots that it would have: slot `id` as `changed`.
    pub(super) fn can_calibrate(&self, id: Channel, changed: Option<&SlotConfig>) -> Result<(), Refused> {
        let others = self.slots.planned().filter(|slot| slot.id != id);
        let slots = others.chain(changed.copied()).map(|slot| (slot.id, slot.period));
        match &self.role {
            Role::Slave(slave) if slave.has_to_calibrate() => check_rounds(slave.rounds(), slots),
            Role::Master(master) if master.has_to_calibrate() => {
                check_rounds_of_master(master.config(), slots)
            }
            _ => Ok(()),
        }
    }
}

/// Whether slaves would follow a cycle of this length.
pub fn check_cycle(cycle: Span) -> Result<(), Refused> {
    if PERIODS.contains(&cycle) { Ok(()) } else { Err(Refused::Cycle { cycle }) }
}

/// A master knows its cycle, so that its own slots can be checked against it.
pub fn checked(master: MasterConfig, slots: &[SlotConfig]) -> Result<MasterConfig, Refused> {
    let MasterConfig { cycle, sync_latest, max_requests, .. } = master;
    check_cycle(cycle)?;
    master.follow.check()?;
    if !(1..=MAX_REQUESTS).contains(&max_requests) {
        return Err(Refused::Requests { requests: max_requests });
    }
    if sync_latest >= cycle {
        return Err(Refused::SyncWindow { cycle });
    }
    if let Some(backup) = master.backup {
        let earliest = backup + sync_latest;
        if backup - BACKUP_LOOKS_BEFORE <= sync_latest || earliest >= cycle {
            return Err(Refused::Backup { backup, earliest: sync_latest + BACKUP_LOOKS_BEFORE, cycle });
        }
        if let Some(&SlotConfig { id, offset, .. }) = slots.iter().find(|slot| slot.offset < earliest) {
            return Err(Refused::BeforeBackup { id, offset, earliest });
        }
    }
    match slots.iter().find(|slot| slot.offset >= cycle) {
        Some(&SlotConfig { id, offset, .. }) => Err(Refused::BeyondCycle { id, offset, cycle }),
        None => Ok(master),
    }
}
