//! One thing to be done at an instant of a cycle.

use rtnet::buf::Buf;
use rtnet::discipline::{Channel, Returned};
use rtnet::queue::Priority;
use rtnet::time::{GlobalTime, Instant, Span};

use super::master::BACKUP_LOOKS_BEFORE;
use super::slot::Turn;

/// Time from a master's wake-up until it can send: a reply is chosen this long before its instant.
const REPLY_LOOKS_BEFORE: Span = Span::from_micros(10);

/// A job of the grid.
#[derive(Clone, Copy)]
pub enum Job {
    /// A backup's is chosen at the last moment: until then another's may be heard.
    Sync {
        cycle: u32,
        at: Instant,
        latest: Instant,
        sched: GlobalTime,
        is_backups: bool,
    },
    Reply {
        cycle: u32,
        at: Instant,
        latest: Instant,
    },
    /// One that is late, behind this station's own Synchronisation.
    ReplyBehindSync {
        cycle: u32,
        at: Instant,
        latest: Instant,
    },
    /// One that is late, in a slot of this station's own.
    ReplyInTurn(Turn),
    /// What of a schedule follows a Synchronisation.
    Part {
        cycle: u32,
        at: Instant,
        latest: Instant,
    },
    Request(Turn),
    /// To a schedule that is proposed.
    Answer(Turn),
    Data(Turn),
}

/// What is being sent.
#[derive(Clone, Copy)]
pub struct Pending {
    pub job: Job,
    pub priority: Priority,
}

impl Job {
    pub fn at(&self) -> Instant {
        match self {
            Job::Sync { at, .. }
            | Job::Reply { at, .. }
            | Job::ReplyBehindSync { at, .. }
            | Job::Part { at, .. } => *at,
            Job::Request(turn) | Job::ReplyInTurn(turn) | Job::Answer(turn) | Job::Data(turn) => turn.at,
        }
    }
    pub fn latest(&self) -> Instant {
        match self {
            Job::Sync { latest, .. }
            | Job::Reply { latest, .. }
            | Job::ReplyBehindSync { latest, .. }
            | Job::Part { latest, .. } => *latest,
            Job::Request(turn) | Job::ReplyInTurn(turn) | Job::Answer(turn) | Job::Data(turn) => turn.latest,
        }
    }
    pub fn cycle(&self) -> u32 {
        match self {
            Job::Sync { cycle, .. }
            | Job::Reply { cycle, .. }
            | Job::ReplyBehindSync { cycle, .. }
            | Job::Part { cycle, .. } => *cycle,
            Job::Request(turn) | Job::ReplyInTurn(turn) | Job::Answer(turn) | Job::Data(turn) => turn.cycle,
        }
    }

    /// When it is chosen, `lead` before its instant. A backup's Synchronisation is chosen later. So is a reply: it is
    /// stamped when it leaves, so that spinning for it gains nothing.
    pub fn chosen_at(&self, lead: Span) -> Instant {
        match self {
            Job::Sync { at, is_backups: true, .. } => *at - lead.min(BACKUP_LOOKS_BEFORE),
            Job::Reply { at, .. } => *at - lead.min(REPLY_LOOKS_BEFORE),
            other => other.at() - lead,
        }
    }

    /// When to wake for it, if the last look at the time was at `looked`. A backup wakes `lead` before its
    /// Synchronisation, so that it is there when it has to choose.
    pub fn wakes_at(&self, lead: Span, looked: Instant) -> Instant {
        match self {
            Job::Sync { at, is_backups: true, .. } if looked < *at - lead => *at - lead,
            other => other.chosen_at(lead),
        }
    }

    /// The slot that it is of.
    pub fn slot(&self) -> Option<Channel> {
        self.turn().map(|turn| turn.id)
    }

    /// The slot's turn that it is of.
    pub fn turn(&self) -> Option<&Turn> {
        match self {
            Job::Sync { .. } | Job::Reply { .. } | Job::ReplyBehindSync { .. } | Job::Part { .. } => None,
            Job::Request(turn) | Job::ReplyInTurn(turn) | Job::Answer(turn) | Job::Data(turn) => Some(turn),
        }
    }

    /// Whether it is a calibration reply.
    pub fn is_reply(&self) -> bool {
        matches!(self, Job::Reply { .. } | Job::ReplyBehindSync { .. } | Job::ReplyInTurn(_))
    }

    /// Only data goes back to its queue; control frames are made anew.
    pub fn returned(&self, frame: Buf, priority: Priority) -> Option<Returned> {
        match self {
            Job::Data(turn) => Some(Returned { frame, priority, channel: turn.id }),
            _ => None,
        }
    }
}
