//! What there is to be seen of a TDMA station.

use rtnet::buf::PoolStatistics;
use rtnet::discipline::{Discipline, SyncState};
use rtnet::time::{Offset, Span};
use rtnet::wire::ethernet::Address;

use super::change::ChangeStatus;
use super::master::{Master, Mastery};
use super::replies::Replies;
use super::report::{CalibrationReport, DelayOf};
use super::slot::SlotStatus;
use super::{Role, Servo, Tdma};

/// Everything a TDMA station counts. What every cycle counts comes first, together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[repr(C)]
pub struct Counters {
    /// Synchronisations received, accepted or not.
    pub syncs_received: u64,
    /// Data frames sent.
    pub frames_sent: u64,
    /// Slots for which nothing was queued.
    pub slots_empty: u64,
    /// Synchronisations sent.
    pub syncs_sent: u64,
    /// Synchronisations that came too late for their window and were not sent, or that the kernel guard dropped.
    pub syncs_skipped: u64,
    /// Of them, those that came after a slot had been silent for want of them.
    pub syncs_late: u64,
    /// Slots skipped because they were late.
    pub overruns: u64,
    /// Frames sent although the clock read afterwards was beyond `latest`.
    pub stalled_in_send: u64,
    /// Frames of any kind that the kernel guard dropped.
    pub guard_drops: u64,
    /// Frames the kernel refused.
    pub send_failed: u64,
    /// Slots passed over because synchronisation did not allow them.
    pub slots_silent: u64,
    /// Turns of a slot that carried no data, since the delay was measured anew in them, or a late reply went in them.
    pub slots_calibrating: u64,
    /// Calibration requests sent.
    pub requests_sent: u64,
    /// Times that calibration was given up.
    pub calibration_timeouts: u64,
    /// Calibration replies sent.
    pub replies_sent: u64,
    /// Calibration replies that were not sent at the instant that was asked for: each goes in the master's own next slot, in
    /// place of data, or behind the Synchronisation of one without slots.
    pub replies_late: u64,
    /// Calibration replies that were promised and not sent: late, of a master that has no slot and no room behind its
    /// Synchronisation; to a station that asked again; or by one that gives the time no more.
    pub replies_given_up: u64,
    /// Frames dropped because their slot is gone, or too small for them now.
    pub returned_dropped: u64,
    /// Joint slots that got a queue of their own because the slot that they were joined to grew.
    pub joints_detached: u64,
    /// Parts of schedules that were too late behind their Synchronisation, and not sent.
    pub parts_late: u64,
}

impl Counters {
    /// Each with its name.
    pub fn named(&self) -> [(&'static str, u64); 20] {
        [
            ("syncs_sent", self.syncs_sent),
            ("syncs_skipped", self.syncs_skipped),
            ("syncs_received", self.syncs_received),
            ("syncs_late", self.syncs_late),
            ("frames_sent", self.frames_sent),
            ("overruns", self.overruns),
            ("stalled_in_send", self.stalled_in_send),
            ("guard_drops", self.guard_drops),
            ("send_failed", self.send_failed),
            ("slots_empty", self.slots_empty),
            ("slots_silent", self.slots_silent),
            ("slots_calibrating", self.slots_calibrating),
            ("requests_sent", self.requests_sent),
            ("calibration_timeouts", self.calibration_timeouts),
            ("replies_sent", self.replies_sent),
            ("replies_late", self.replies_late),
            ("replies_given_up", self.replies_given_up),
            ("returned_dropped", self.returned_dropped),
            ("joints_detached", self.joints_detached),
            ("parts_late", self.parts_late),
        ]
    }
}

/// What a station is in the cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoleName {
    /// Gives the time.
    Master,
    /// Gives it when the master does not.
    Backup,
    /// Follows it.
    Slave,
    /// Takes no part in the cycle.
    Detached,
}

impl RoleName {
    /// The role's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            RoleName::Master => "master",
            RoleName::Backup => "backup",
            RoleName::Slave => "slave",
            RoleName::Detached => "detached",
        }
    }
}

/// Slots that a status shows, the lowest ids first; more are in use only where `max_slot_id` was raised.
pub const SLOTS_SHOWN: usize = 16;

/// A snapshot of a TDMA station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TdmaStatus {
    /// What it is in the cycle.
    pub role: RoleName,
    /// How far it is with the master's time; a master that speaks is locked.
    pub state: SyncState,
    /// The last cycle that was told of.
    pub cycle: u32,
    /// From one cycle's start to the next, once known.
    pub period: Option<Span>,
    /// From this station's clock to the master's, once known.
    pub offset: Option<Offset>,
    /// The measured delay from the master, once known.
    pub delay: Option<Span>,
    /// By how much the last Synchronisation disagreed with the line.
    pub deviation: Span,
    /// How fast this station's clock gains on the master's, in parts per 10^9, once known.
    pub drift_ppb: Option<i64>,
    /// Whether its time will not become clearer: the drift is known, and the delay by it.
    pub settled: bool,
    /// By how much cycles may start earlier or later than is believed, as of the last look at the time; `None`: nobody is
    /// followed, or no delay was measured.
    pub error_bound: Option<Span>,
    /// How Synchronisations become its line; `None`: nobody is followed.
    pub servo: Option<Servo>,
    /// What all calibration rounds say together; `None`: nobody is followed.
    pub delay_of: Option<DelayOf>,
    /// Cycles without a Synchronisation that are bridged, of those that follow somebody.
    pub holdover: u32,
    /// Cycles since the last Synchronisation that was followed.
    pub missing: u32,
    /// What calibration has shown.
    pub calibration: Option<CalibrationReport>,
    /// Rounds that were measured of one under way, and of how many.
    pub calibrating: Option<(u32, u32)>,
    /// Calibration rounds that are configured.
    pub rounds: u32,
    /// Calibration requests that had no answer and were repeated.
    pub calibration_repeats: u64,
    /// What a master or a backup is doing.
    pub mastery: Option<Mastery>,
    /// The other master that kept this one from speaking, or outlasted it.
    pub yielded_to: Option<Address>,
    /// Who gives the time, as far as this station knows: whom it follows, or itself.
    pub time_by: Option<Address>,
    /// Who else does, while it does.
    pub rival: Option<Address>,
    /// Events that found the log full.
    pub events_lost: u64,
    /// How the pool of Synchronisations, requests and replies fares.
    pub control: PoolStatistics,
    /// What it knows of changes of the schedule; `None`: it takes no part in them.
    pub change: Option<ChangeStatus>,
    /// Its slots.
    pub slots: [Option<SlotStatus>; SLOTS_SHOWN],
    /// Everything that is counted.
    pub counters: Counters,
}

impl TdmaStatus {
    pub(super) fn of(tdma: &Tdma) -> Self {
        let line = tdma.line();
        let time = tdma.time();
        let slave = tdma.follower();
        let master = match &tdma.role {
            Role::Master(master) => Some(master),
            _ => None,
        };
        let mut shown = tdma.slots.statuses();
        let replies = master.map(|master| master.replies());
        let counters = Counters {
            returned_dropped: tdma.counters.returned_dropped + tdma.slots.dropped(),
            joints_detached: tdma.slots.detached(),
            replies_late: tdma.counters.replies_late + replies.map_or(0, Replies::late),
            replies_given_up: tdma.counters.replies_given_up + replies.map_or(0, Replies::broken),
            ..tdma.counters
        };
        Self {
            role: match tdma.role {
                Role::Master(ref master) if master.config().backup.is_some() => RoleName::Backup,
                Role::Master(_) => RoleName::Master,
                Role::Slave(_) => RoleName::Slave,
                Role::Detached => RoleName::Detached,
            },
            state: time.state,
            cycle: time.cycle,
            period: line.map(|line| line.period),
            offset: line.map(|line| line.offset),
            delay: slave.and_then(|slave| slave.calibration().delay()),
            deviation: slave.map_or(Span::ZERO, |slave| slave.deviation()),
            drift_ppb: slave.and_then(|slave| slave.drift_ppb()),
            settled: slave.map_or(time.state == SyncState::Locked, |slave| slave.is_settled()),
            error_bound: slave.and_then(|slave| slave.error_bound(tdma.looked)),
            servo: slave.map(|slave| slave.config().servo),
            delay_of: slave.map(|slave| slave.config().delay_of()),
            holdover: slave.map_or(0, |slave| slave.config().holdover),
            missing: slave.map_or(0, |slave| slave.missing()),
            calibration: slave.and_then(|slave| slave.calibration().report()),
            calibrating: slave.and_then(|slave| slave.calibration().progress()),
            rounds: slave.map_or(0, |slave| slave.config().rounds),
            calibration_repeats: slave.map_or(0, |slave| slave.calibration().repeats()),
            mastery: master.map(Master::mastery),
            yielded_to: master.and_then(|master| master.yielded_to()),
            time_by: match &tdma.role {
                Role::Master(master) if master.is_active() => Some(tdma.address),
                _ => slave.and_then(|slave| slave.followed()),
            },
            rival: master.and_then(|master| master.rival(tdma.looked)),
            events_lost: tdma.events.lost(),
            control: tdma.pool.statistics(),
            change: tdma.change.as_ref().map(|change| change.status()),
            slots: core::array::from_fn(|_| shown.next()),
            counters,
        }
    }
}
