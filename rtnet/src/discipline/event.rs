//! What a discipline tells of: what happened in which cycle, and why.

use super::Channel;
use crate::time::Span;

/// Something worth telling, latched with its cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// The cycle it happened in.
    pub cycle: u32,
    /// What it was.
    pub kind: EventKind,
    /// In which of the station's slots, if it was in one; of a ring, which station, if it is about one.
    pub slot: Option<Channel>,
    /// How much: lateness, size of a step, measured delay.
    pub span: Span,
}

/// Kinds of [`Event`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EventKind {
    /// A slot was skipped because its `latest` instant had passed by so much.
    Overrun,
    /// A frame was sent, but the clock read afterwards was beyond `latest` by so much.
    StalledInSend,
    /// So it was with a calibration reply.
    ReplyStalled,
    /// The kernel guard dropped a frame that was sent in time but came too late, by so much or less.
    GuardDropped,
    /// A slot was passed over because synchronisation did not allow it.
    SlotSilent,
    /// A slot's turn was of a line that was left before the turn came.
    TurnLeft,
    /// Nothing waited for a slot that was used the last time. Those after it are only counted.
    SlotEmpty,
    /// A slot begins after the master's cycle ends, by so much: it is never used.
    SlotBeyondCycle,
    /// The slot that this one was joined to has grown: from this cycle on it has a queue of its own.
    JointDetached,
    /// The kernel refused a frame; the span is its error number.
    SendFailed,
    /// So it did with a calibration reply.
    ReplyFailed,
    /// A slot's turn carried no data, since the delay is measured anew in it.
    CalibrationTurn,
    /// A slot's turn carried no data, but the answer to a schedule that is proposed.
    AnswerTurn,
    /// A slot was passed over since it was not known that its schedule is in use.
    ScheduleUnsure,
    /// Another schedule is in use from this cycle on; the span is its number.
    ScheduleSwitched,
    /// The master skipped a Synchronisation because its window had passed by so much.
    SyncSkipped,
    /// The kernel guard dropped a Synchronisation that came too late, by so much or less: its cycle has none.
    SyncDropped,
    /// A Synchronisation disagrees with the time line by so much.
    TimeStep,
    /// A cycle number came twice; this station stays silent in that cycle, unless another master said the same.
    DuplicateCycle,
    /// A Synchronisation is missing; its cycle is bridged, and those after it as far as configured.
    Holdover,
    /// More Synchronisations are missing than are bridged.
    SyncLost,
    /// They have been missing for so long that there is no line any more, and no slot, until it is locked again.
    LineGivenUp,
    /// A Synchronisation was handed over only after a slot had been silent for want of it, by so much or more.
    SyncLate,
    /// Synchronised; the span is the delay from the master.
    Locked,
    /// The delay was measured again, or shortened: the span is what it is from now on.
    CalibratedAnew,
    /// Calibration was given up for now; a delay that is known stays.
    CalibrationTimeout,
    /// Another master is active on the medium.
    OtherMaster,
    /// This station is the active master from this cycle on.
    MasterActive,
    /// A backup has sent the Synchronisation that was missing, so long after its cycle's start.
    TookOver,
    /// A backup that gave the time has heard another master, and stands by again.
    SteppedDown,
    /// A primary makes way for another one, which it has heard for so long.
    Yielded,
    /// The token was sent once more: the next station had shown no sign of it.
    TokenRepeated,
    /// A station that had shown no sign of the token was skipped, and is absent.
    StationSkipped,
    /// The token was lost, and claimed.
    TokenClaimed,
    /// The token that this station held is void, since another one stays.
    TokenGivenUp,
    /// This station was too late to pass the token on, by so much, and has lost it.
    TokenOverdue,
}

impl EventKind {
    /// Every kind.
    pub const ALL: [EventKind; 36] = [
        EventKind::Overrun,
        EventKind::StalledInSend,
        EventKind::ReplyStalled,
        EventKind::GuardDropped,
        EventKind::SlotSilent,
        EventKind::TurnLeft,
        EventKind::SlotEmpty,
        EventKind::SlotBeyondCycle,
        EventKind::JointDetached,
        EventKind::SendFailed,
        EventKind::ReplyFailed,
        EventKind::CalibrationTurn,
        EventKind::AnswerTurn,
        EventKind::ScheduleUnsure,
        EventKind::ScheduleSwitched,
        EventKind::SyncSkipped,
        EventKind::SyncDropped,
        EventKind::TimeStep,
        EventKind::DuplicateCycle,
        EventKind::Holdover,
        EventKind::SyncLost,
        EventKind::LineGivenUp,
        EventKind::SyncLate,
        EventKind::Locked,
        EventKind::CalibratedAnew,
        EventKind::CalibrationTimeout,
        EventKind::OtherMaster,
        EventKind::MasterActive,
        EventKind::TookOver,
        EventKind::SteppedDown,
        EventKind::Yielded,
        EventKind::TokenRepeated,
        EventKind::StationSkipped,
        EventKind::TokenClaimed,
        EventKind::TokenGivenUp,
        EventKind::TokenOverdue,
    ];

    /// Whether a slot or a Synchronisation was missed by it, or a frame was late.
    pub const fn is_miss(self) -> bool {
        use EventKind::*;
        matches!(
            self,
            Overrun
                | StalledInSend
                | ReplyStalled
                | GuardDropped
                | SlotSilent
                | TurnLeft
                | SlotEmpty
                | CalibrationTurn
                | AnswerTurn
                | ScheduleUnsure
                | SendFailed
                | ReplyFailed
                | SyncSkipped
                | SyncDropped
        )
    }

    /// Why that was, as far as the kind tells. What was too late for its instant only the loop's stamps explain.
    pub const fn cause(self) -> Option<Cause> {
        match self {
            EventKind::StalledInSend
            | EventKind::ReplyStalled
            | EventKind::GuardDropped
            | EventKind::SyncDropped => Some(Cause::StalledInSend),
            EventKind::SlotSilent | EventKind::TurnLeft => Some(Cause::NoSync),
            EventKind::SlotEmpty => Some(Cause::QueueEmpty),
            EventKind::CalibrationTurn => Some(Cause::Calibrating),
            EventKind::AnswerTurn | EventKind::ScheduleUnsure => Some(Cause::ScheduleChange),
            EventKind::SendFailed | EventKind::ReplyFailed => Some(Cause::Refused),
            _ => None,
        }
    }

    /// The kind's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            EventKind::Overrun => "overrun",
            EventKind::StalledInSend => "stalled_in_send",
            EventKind::ReplyStalled => "reply_stalled",
            EventKind::GuardDropped => "guard_dropped",
            EventKind::SlotSilent => "slot_silent",
            EventKind::TurnLeft => "turn_left",
            EventKind::SlotEmpty => "slot_empty",
            EventKind::SlotBeyondCycle => "slot_beyond_cycle",
            EventKind::JointDetached => "joint_detached",
            EventKind::SendFailed => "send_failed",
            EventKind::ReplyFailed => "reply_failed",
            EventKind::CalibrationTurn => "calibration_turn",
            EventKind::AnswerTurn => "answer_turn",
            EventKind::ScheduleUnsure => "schedule_unsure",
            EventKind::ScheduleSwitched => "schedule_switched",
            EventKind::SyncSkipped => "sync_skipped",
            EventKind::SyncDropped => "sync_dropped",
            EventKind::TimeStep => "time_step",
            EventKind::DuplicateCycle => "duplicate_cycle",
            EventKind::Holdover => "holdover",
            EventKind::SyncLost => "sync_lost",
            EventKind::LineGivenUp => "line_given_up",
            EventKind::SyncLate => "sync_late",
            EventKind::Locked => "locked",
            EventKind::CalibratedAnew => "calibrated_anew",
            EventKind::CalibrationTimeout => "calibration_timeout",
            EventKind::OtherMaster => "other_master",
            EventKind::MasterActive => "master_active",
            EventKind::TookOver => "took_over",
            EventKind::SteppedDown => "stepped_down",
            EventKind::Yielded => "yielded",
            EventKind::TokenRepeated => "token_repeated",
            EventKind::StationSkipped => "station_skipped",
            EventKind::TokenClaimed => "token_claimed",
            EventKind::TokenGivenUp => "token_given_up",
            EventKind::TokenOverdue => "token_overdue",
        }
    }
}

/// Why a slot or a Synchronisation was missed, or a frame was late.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The thread was woken too late: by the timer, or because something more urgent ran.
    TimerLate,
    /// It was awake in time, and held up before it could send.
    Preempted,
    /// It was held up between its last look at the clock and the wire.
    StalledInSend,
    /// There was no Synchronisation to follow, or none yet.
    NoSync,
    /// Nothing was queued in time.
    QueueEmpty,
    /// The delay was measured in it, as was asked for.
    Calibrating,
    /// The schedule changed: it carried an answer, or it was not known which is in use.
    ScheduleChange,
    /// The kernel did not take the frame.
    Refused,
}

impl Cause {
    /// Every cause.
    pub const ALL: [Cause; 8] = [
        Cause::TimerLate,
        Cause::Preempted,
        Cause::StalledInSend,
        Cause::NoSync,
        Cause::QueueEmpty,
        Cause::Calibrating,
        Cause::ScheduleChange,
        Cause::Refused,
    ];

    /// The cause's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Cause::TimerLate => "timer_late",
            Cause::Preempted => "preempted",
            Cause::StalledInSend => "stalled_in_send",
            Cause::NoSync => "sync_lost_or_late",
            Cause::QueueEmpty => "queue_empty",
            Cause::Calibrating => "calibrating",
            Cause::ScheduleChange => "schedule_change",
            Cause::Refused => "refused",
        }
    }
}
