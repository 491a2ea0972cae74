//! Changing the schedule while it runs: what a station knows of it, and what the acting master does with it. Pure.
//!
//! ```text
//!             proposed       all have           those that may      the activation
//!             (parts, asked  acknowledged, and  give the time have  cycle comes
//!             for answers)   it is activated    confirmed
//!      Idle ────────► Proposed ────────► Committed ────────► Sealed ────────► Switched ──► Idle
//!        ▲               │ refused, silent,  │ not confirmed       (nothing stops it)
//!        │               │ withdrawn         │ in time, withdrawn
//!        │               ▼                   ▼
//!        └─────────── Cancelled ◄────────────┘
//!           later
//!
//! who takes over from     goes on as
//!   Idle, Switched,         the same: all that these say is decided
//!   Cancelled, Sealed
//!   Proposed                Cancelled: nobody can have been committed to it
//!   Committed               Cancelled if it has not confirmed: so it was not sealed. Else Committed, from the activation
//!                           cycle on without being sure of it, until it has been alone for long enough to know that the
//!                           other is gone; then Cancelled
//! ```
//!
//! One station decides at any time: the acting master, which says with every Synchronisation which schedule is in use. All others
//! use a schedule in a cycle only if they were told so by one that is sure of it: in that very cycle, or, bridging, in one before it
//! with no activation cycle between, whether that is pending or withdrawn. So in a cycle in which one schedule may be in use, nobody
//! uses another, whoever heard what; what has to agree is what masters say, which is what confirming is for.
//!
//! **Who is sure.** A master that was silent, or heard nobody, for more than [`DEAF`] cycles may have missed a decision. It says what it
//! knows and that it is not sure of it, so that all are silent; hears for [`ALONE`] cycles what others know; and goes on from
//! what is furthest on: a higher number, or a later state, since numbers only grow and no state is left but for a later one. Whoever is sure is
//! believed by all who are not.
//!
//! All of it holds as long as no station that may give the time, and is awake, misses so many Synchronisations of another in a row that
//! others hear: those of [`ALONE`] less twice [`DEAF`] cycles. `tests.rs` has every state against every event, `tests/model.rs` networks by chance.

mod book;
mod hear;
mod lead;

use std::sync::Arc;

use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::slot::SlotConfig;
use crate::wire::change::{Part, ScheduleId, State, Status, Why};

pub use book::{Book, MAX_PLANNED, Planned};
use hear::{Answering, Heard};
pub use lead::Activation;
use lead::Lead;

/// Who gives the time and hears nothing of another for so many cycles is alone. Who has been deaf for as long knows nothing.
pub const DEAF: u32 = 16;
/// Who is not sure which schedule is in use has nobody send for so long: more than anybody bridges. Who was committed by another is
/// alone after so long, and decides.
pub const ALONE: u32 = 48;
/// A station that bridges more cycles than this could miss a commit.
pub const MAX_BRIDGED: u32 = 16;
/// By so many cycles before the activation cycle all must have confirmed; from then on it is known to all who may give the time,
/// or withdrawn.
const SEALED_BEFORE: u32 = 24;
/// From the commit to the activation cycle, if none is asked for; at the least, if one is.
const AHEAD: u32 = 48;
const AHEAD_AT_LEAST: u32 = 40;
/// For so long it is told that a schedule was switched, or withdrawn.
const FRESH: u32 = 64;
/// All are to have acknowledged after so many cycles and turns, and the parts that are to be sent before.
const PATIENCE: u32 = 256;
const PATIENCE_IN_TURNS: u32 = 16;
/// Parts are sent in every cycle while stations are asked, in every so many while nothing changes, for who joins later.
const PARTS_SELDOM: u32 = 4;
/// So many in a row may be too late before one takes a turn.
const OWED_AT_MOST: u32 = 2;
const OWED_SELDOM: u32 = 8;

/// What is configured of a station that takes part in changes.
#[derive(Clone, Debug)]
pub struct ChangeConfig {
    /// Most slots of a schedule, of all stations together: memory for twice as many.
    pub capacity: usize,
    /// Whether all of that memory is taken at the start, as a real-time thread must have it. Else it is when a schedule comes:
    /// for thousands of stations in virtual time.
    pub is_reserved: bool,
    /// The schedule that all stations were started with, as far as it is known: whoever has slots in it is asked. Without
    /// it those are asked that have slots in the schedule that is proposed. The stations of one process have it in common.
    pub first: Option<Arc<Book>>,
    /// Who may give the time, as far as it is known: all of them must have slots, to confirm in.
    pub masters: Vec<Address>,
    /// How long after the instant of a Synchronisation a part of a schedule is sent.
    pub behind: Span,
    /// How long after that it may still be sent.
    pub latest: Span,
}

/// Why a change was stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stopped {
    /// Somebody asked for that.
    #[error("it was cancelled on request")]
    Asked,
    /// A station cannot take it.
    #[error("station {station} refuses slot {slot}: {}", why.text())]
    Refused {
        /// Who.
        station: Address,
        /// Why.
        why: Why,
        /// Which of its slots.
        slot: u8,
    },
    /// A station that has slots did not answer.
    #[error(
        "station {station} did not acknowledge within {within} cycles: is it there, and does it know of changes (--extensions)?"
    )]
    Silent {
        /// Who.
        station: Address,
        /// How long was waited.
        within: u32,
    },
    /// A station that may give the time did not confirm.
    #[error("station {station}, which may give the time, did not confirm activation cycle {at} in time")]
    Unconfirmed {
        /// Who.
        station: Address,
        /// The activation cycle.
        at: u32,
    },
    /// The activation cycle that was asked for came too near.
    #[error(
        "all had acknowledged only in cycle {now}, too late for activation cycle {at}: ask for a later one"
    )]
    TooLate {
        /// The activation cycle.
        at: u32,
        /// When all had.
        now: u32,
    },
    /// The master that had proposed it gives the time no more.
    #[error("the master that had proposed it does not give the time any more: propose it anew")]
    MasterChanged,
}

/// What a station is to do, now that another schedule is in use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Switch {
    /// From this cycle on.
    pub from: u32,
    /// Which.
    pub to: ScheduleId,
}

/// What there is to be seen of changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChangeStatus {
    /// The schedule whose slots this station uses.
    pub in_use: ScheduleId,
    /// What the acting master says.
    pub told: Status,
    /// Whether that is this station.
    pub acts: bool,
    /// Whether any master has said something.
    pub heard: bool,
    /// Stations that are, or were last, asked; that have acknowledged, and confirmed.
    pub asked: u32,
    /// See `asked`.
    pub acknowledged: u32,
    /// Of those that may give the time.
    pub confirmed: u32,
    /// Those that may, so far as they have said.
    pub masters: u32,
    /// The first that has not acknowledged.
    pub waits_for: Option<Address>,
    /// Why the last was stopped, as far as this station decided that.
    pub stopped: Option<Stopped>,
    /// Schedules switched to.
    pub switched: u64,
    /// Answers that were sent.
    pub answers_sent: u64,
    /// Parts of schedules that were sent.
    pub parts_sent: u64,
    /// Parts of schedules that came.
    pub parts_received: u64,
}

/// What a station knows of schedules.
pub(super) struct Change {
    /// The one whose slots are in use.
    oper: Book,
    /// The one that is proposed, or collected, or that was in use before.
    admin: Book,
    /// What all stations were started with; its slots of this station as they were when it left them.
    first: Option<Arc<Book>>,
    first_slots: Vec<SlotConfig>,
    first_cycle: Option<Span>,
    in_use: ScheduleId,
    /// The highest number that was heard of.
    highest: u16,
    told: Status,
    heard: Option<Heard>,
    /// Whether this station can take `admin`, once that is whole.
    verdict: Option<Result<(), (Why, u8)>>,
    answering: Answering,
    /// What it has confirmed, or may have: whoever asked may have sealed it.
    confirmed: Option<ScheduleId>,
    lead: Lead,
    /// How long after a Synchronisation a part is sent, and how long after that it still may be.
    pub behind: Span,
    pub latest: Span,
    switched: u64,
    answers_sent: u64,
    parts_sent: u64,
    parts_received: u64,
    /// Which part is next.
    next_part: u32,
    /// Parts in a row that were too late.
    owed: u32,
}

impl Change {
    /// A station that has the slots of `first`. What it will ever hold has its place now, if that is reserved.
    pub fn new(config: &ChangeConfig, max_slot_id: u8) -> Self {
        let ChangeConfig { capacity, is_reserved, first, masters, behind, latest } = config;
        let capacity = first.as_ref().map_or(0, |first| first.planned().len()).max(*capacity);
        Self {
            oper: Book::empty(capacity, *is_reserved),
            admin: Book::empty(capacity, *is_reserved),
            first: first.clone(),
            first_slots: Vec::with_capacity(usize::from(max_slot_id) + 1),
            first_cycle: None,
            in_use: ScheduleId::default(),
            highest: 0,
            told: Status {
                oper: ScheduleId::default(),
                admin: ScheduleId::default(),
                activation: 0,
                state: State::Idle,
                is_sure: true,
            },
            heard: None,
            verdict: None,
            answering: Answering::default(),
            confirmed: None,
            lead: Lead::new(if *is_reserved { capacity } else { 0 }, masters),
            behind: *behind,
            latest: *latest,
            switched: 0,
            answers_sent: 0,
            parts_sent: 0,
            parts_received: 0,
            next_part: 0,
            owed: 0,
        }
    }

    pub fn status(&self) -> ChangeStatus {
        let asked = || self.lead.asked.iter();
        let count = |n: usize| n as u32;
        ChangeStatus {
            in_use: self.in_use,
            told: self.told,
            acts: self.lead.acts,
            heard: self.lead.acts || self.heard.is_some(),
            asked: count(asked().count()),
            acknowledged: count(asked().filter(|asked| asked.acknowledged).count()),
            confirmed: count(asked().filter(|asked| asked.gives_time && asked.confirmed).count()),
            masters: count(asked().filter(|asked| asked.gives_time).count()),
            waits_for: asked().find(|asked| !asked.acknowledged).map(|asked| asked.station),
            stopped: self.lead.stopped,
            switched: self.switched,
            answers_sent: self.answers_sent,
            parts_sent: self.parts_sent,
            parts_received: self.parts_received,
        }
    }

    /// The schedule whose slots are in use.
    #[cfg(test)]
    pub fn in_use(&self) -> ScheduleId {
        self.in_use
    }

    /// Whether a change is under way that this station has, or may have, answered to.
    pub fn is_pending(&self) -> bool {
        matches!(self.told.state, State::Proposed | State::Committed | State::Sealed)
    }

    /// Whether this station gives the time, as far as it has said so.
    pub fn acts(&self) -> bool {
        self.lead.acts
    }

    /// The schedule to come and its activation cycle, once that is sealed, or as good as.
    pub fn sealed(&self) -> Option<(u32, &Book)> {
        let is_to_come = matches!(self.told.state, State::Committed | State::Sealed);
        (is_to_come && self.admin.holds(self.told.admin)).then_some((self.told.activation, &self.admin))
    }

    /// The same once that is sealed, if another gives the time.
    pub fn follows_sealed(&self) -> Option<(u32, &Book)> {
        self.sealed().filter(|_| self.told.state == State::Sealed && !self.lead.acts)
    }

    /// The cycle in which this station will have others switch, as it gives the time.
    pub fn sealed_for(&self) -> Option<u32> {
        (self.lead.acts && self.told.state == State::Sealed).then_some(self.told.activation)
    }

    /// The schedule that is proposed, or collected.
    pub fn admin(&self) -> &Book {
        &self.admin
    }

    /// The cycle length that comes with a switch; `None`: as it is.
    pub fn cycle_of(&self, id: ScheduleId) -> Option<Span> {
        let book = [&self.oper, &self.admin].into_iter().find(|book| book.holds(id));
        let first = self.first_cycle.filter(|_| id == ScheduleId::default());
        book.map(Book::cycle).or(first)
    }

    /// The slots of a schedule that are this station's; those it was started with, as they were when it left them.
    pub fn slots_of(&self, id: ScheduleId, own: Address) -> impl Iterator<Item = SlotConfig> + '_ {
        let book = [&self.oper, &self.admin].into_iter().find(|book| book.holds(id));
        let first = (id == ScheduleId::default()).then_some(&self.first_slots);
        book.into_iter()
            .flat_map(move |book| book.of_station(own))
            .chain(first.into_iter().flatten().copied())
    }

    /// It uses this schedule from now on; `left` are the slots that it had, in cycles of `length`.
    pub fn switch(&mut self, to: ScheduleId, left: impl Iterator<Item = SlotConfig>, length: Option<Span>) {
        if self.in_use == ScheduleId::default() {
            self.first_slots.clear();
            let room = self.first_slots.capacity();
            self.first_slots.extend(left.take(room));
            self.first_cycle = length.or(self.first_cycle);
        }
        if self.admin.holds(to) {
            core::mem::swap(&mut self.oper, &mut self.admin);
        }
        // What it leaves it could take once.
        self.verdict = (self.admin.holds(self.in_use)).then_some(Ok(()));
        self.in_use = to;
        self.switched += 1;
    }

    /// The part that is sent behind this station's Synchronisation of a cycle.
    pub fn part_for(&self, cycle: u32) -> Option<Part> {
        let every = if self.waits_for_answers() { 1 } else { PARTS_SELDOM };
        if cycle.is_multiple_of(every) { self.next_part() } else { None }
    }

    /// The same in a turn of its own, which carries no data then: on a busy host none may ever be in time behind a
    /// Synchronisation.
    pub fn part_in_turn(&self) -> Option<Part> {
        let at_most = if self.waits_for_answers() { OWED_AT_MOST } else { OWED_SELDOM };
        if self.owed >= at_most { self.next_part() } else { None }
    }

    fn waits_for_answers(&self) -> bool {
        let is_missing = || self.lead.asked.iter().any(|asked| !asked.acknowledged);
        self.told.state == State::Proposed && is_missing()
    }

    fn next_part(&self) -> Option<Part> {
        let (book, id, is_named) = match self.is_pending() {
            // Nobody collects what no Synchronisation has named yet.
            true => (&self.admin, self.told.admin, self.lead.named == self.told.admin),
            false => (&self.oper, self.told.oper, true),
        };
        let is_known = self.lead.acts && is_named && book.holds(id) && id.number != 0;
        is_known.then(|| book.part(self.next_part as usize % book.planned().len())).flatten()
    }

    /// It was sent.
    pub fn part_is_sent(&mut self) {
        self.parts_sent += 1;
        (self.next_part, self.owed) = (self.next_part.wrapping_add(1), 0);
    }

    /// It was too late.
    pub fn part_is_owed(&mut self) {
        self.owed = self.owed.saturating_add(1);
    }
}

/// Whether `cycle` is `at` or later, shortest way round 2^32.
fn reached(cycle: u32, at: u32) -> bool {
    cycle.wrapping_sub(at) as i32 >= 0
}

#[cfg(test)]
mod tests;
