//! The master: gives the time, as the primary or as a backup in its place.
//!
//! ```text
//!                   a primary is there already
//!  Attached ► Listening ──────────────────────► Yielded (a primary that never spoke: for good)
//!               │  ▲ │ 3 cycles of silence
//!               │  │ └─────────────────────────────────────► Active ◄─────┐
//!    any other  │  │ lost, or only one heard                  ▲  │        │ its instant in a cycle
//!    sync       ▼  │      calibrated, and it is a backup      │  │        │ without a sync
//!             Following ──────────────────────────────────────┘  │        │
//!               │   ▲      a primary that a rival outlasts       │        │
//!               │   └────────────────────────────────────────────┤        │
//!               │ a backup: calibrated                           │ a backup: another's sync
//!               └──────────────────────────► StandBy ◄───────────┘        │
//!                          Listening ◄───────┘  └─────────────────────────┘
//!                               no line any more
//! ```
//!
//! Attached it answers as while it listens, which it does from its first turn on. Who has no slot does not wait to be
//! calibrated. A command ends it wherever it is, and begins anew. `tests/transitions.rs` has every phase of a primary and of
//! a backup against everything that can happen.
//!
//! Active, it sends a Synchronisation at every point of its grid, a backup so much later, and the replies that are asked
//! for. The grid never moves: it is the one that was followed, or a new one. A Synchronisation that comes too late for
//! its window is not sent, and the next carries the number that the grid says. A foreign one never re-times the grid of
//! an active primary. A backup that hears one beside its line sends nothing before the next of that would have come; of two
//! that have spoken in one cycle, the one with the higher address waits for one more.
//!
//! Who sends as late as backups do is one: that is how one that returns knows whether the place is taken or only kept for
//! it. Of
//! two primaries, after a parted network is whole again, the one with the lower address stays; one that is not of our
//! kind does not know that, and outlasts ours.

mod foreign;

use rtnet::counters::Refusal;
use rtnet::discipline::{EventKind, SyncState};
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::Address;

use super::events::Events;
use super::follow::{HOLDOVER_CYCLES, SlaveConfig};
use super::line::{Drift, TimeLine};
use super::replies::{DEFAULT_MAX_REQUESTS, Replies};
use super::rival::Rival;
use super::slave::Slave;

/// Cycles of silence before a master speaks.
const LISTEN_CYCLES: i64 = 3;
/// And at least this long.
const LISTEN_AT_LEAST: Span = Span::from_millis(3);
/// A backup listens for longer, so that a primary that is started with it speaks first.
const BACKUP_LISTENS_AT_LEAST: Span = Span::from_millis(50);
/// How long before its instant a backup looks for the last time: what it then sends is to leave in time.
pub const BACKUP_LOOKS_BEFORE: Span = Span::from_micros(20);
/// So many late Synchronisations in a row are a backup's.
const LATE_OF_BACKUP: u32 = 2;

/// What is configured of a master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MasterConfig {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// How long after its instant a Synchronisation may still be sent.
    pub sync_latest: Span,
    /// How long after the instant asked for a calibration reply may still be sent.
    pub reply_latest: Span,
    /// From this station's clock to global time, taken once.
    pub epoch: Offset,
    /// A cycle and its scheduled start, of a master before this one whose grid is gone on with. `None`: a new
    /// grid begins.
    pub resume: Option<(u32, GlobalTime)>,
    /// How long after a cycle's start a backup sends a Synchronisation if there was none, for which it looks
    /// [`BACKUP_LOOKS_BEFORE`]. `None`: this is the primary.
    pub backup: Option<Span>,
    /// So long after a cycle's start or later backups send, as a primary knows: only from one of them it takes its place
    /// back. `None`: from nobody.
    pub backups_from: Option<Span>,
    /// Calibration requests that are answered at a time, at least 1; more are refused.
    pub max_requests: usize,
    /// Where a master without slots sends a calibration reply that is late. `None`: nowhere, and it is dropped.
    pub behind_sync: Option<BehindSync>,
    /// How another master is followed.
    pub follow: SlaveConfig,
}

/// Room that the sync window has behind the Synchronisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BehindSync {
    /// So long after the instant of a Synchronisation a short frame may be sent.
    pub after: Span,
    /// So long after that it may still be begun.
    pub latest: Span,
}

impl MasterConfig {
    /// A primary that knows of no backup, may be late by `latest`, and gives its own clock's time.
    pub fn new(cycle: Span, latest: Span) -> Self {
        Self {
            cycle,
            sync_latest: latest,
            reply_latest: latest,
            epoch: Offset::default(),
            resume: None,
            backup: None,
            backups_from: None,
            max_requests: DEFAULT_MAX_REQUESTS,
            behind_sync: None,
            follow: SlaveConfig::default(),
        }
    }

    /// Whether it is told that somebody else may give the time, whom it then follows.
    pub fn knows_of_others(&self) -> bool {
        self.backup.or(self.backups_from).is_some()
    }
}

/// A station that gives the time, or would.
pub struct Master {
    config: MasterConfig,
    phase: Phase,
    follower: Slave,
    replies: Replies,
    /// Synchronisations in a row that were sent as late as a backup's.
    late_in_row: u32,
    rival: Option<Rival>,
    /// The last cycle whose Synchronisation it has sent in time.
    sent: Option<u32>,
    /// Who outlasted this one: its place is not taken back.
    outlasted_by: Option<Address>,
    /// The line on which it gave the time, while it has made way and has none.
    left: Option<TimeLine>,
    has_spoken: bool,
}

#[derive(Clone, Copy)]
enum Phase {
    Attached,
    Listening {
        until: Instant,
    },
    /// Until then for a line.
    Following {
        until: Instant,
    },
    /// Up to this cycle nothing is to be done any more.
    StandBy {
        passed: u32,
    },
    Active {
        line: TimeLine,
    },
    Yielded {
        to: Address,
    },
}

/// What a master is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mastery {
    /// Finding out whether there is another.
    Listening,
    /// Following another, calibrating, or silent for want of it.
    Following,
    /// A backup that would take over in this very cycle.
    StandBy,
    /// Giving the time.
    Active,
    /// A primary that found another, and never speaks.
    Yielded,
}

impl Mastery {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Mastery::Listening => "listening",
            Mastery::Following => "following",
            Mastery::StandBy => "stand-by",
            Mastery::Active => "active",
            Mastery::Yielded => "yielded",
        }
    }
}

impl Master {
    pub fn new(config: MasterConfig) -> Self {
        Self {
            config,
            phase: Phase::Attached,
            follower: Slave::new(config.follow),
            replies: Replies::of(config.max_requests),
            late_in_row: 0,
            rival: None,
            sent: None,
            outlasted_by: None,
            left: None,
            has_spoken: false,
        }
    }

    pub fn config(&self) -> &MasterConfig {
        &self.config
    }

    /// What it is doing.
    pub fn mastery(&self) -> Mastery {
        match self.phase {
            Phase::Attached | Phase::Listening { .. } => Mastery::Listening,
            Phase::Following { .. } => Mastery::Following,
            Phase::StandBy { .. } => Mastery::StandBy,
            Phase::Active { .. } => Mastery::Active,
            Phase::Yielded { .. } => Mastery::Yielded,
        }
    }

    pub fn is_active(&self) -> bool {
        matches!(self.phase, Phase::Active { .. })
    }

    /// Whether it waits for what another master sends, and sends nothing itself meanwhile.
    pub fn only_listens(&self) -> bool {
        match self.phase {
            Phase::Attached => true,
            Phase::Listening { .. } | Phase::Following { .. } => self.follower.line().is_none(),
            Phase::StandBy { .. } | Phase::Active { .. } | Phase::Yielded { .. } => false,
        }
    }

    /// How it follows another, unless it gives the time itself.
    pub fn follower(&self) -> Option<&Slave> {
        (!self.is_active()).then_some(&self.follower)
    }

    /// How it follows another, unless it gives the time itself.
    pub fn follower_mut(&mut self) -> Option<&mut Slave> {
        if self.is_active() { None } else { Some(&mut self.follower) }
    }

    /// Whether it is to measure the delay from another, now or later.
    pub fn has_to_calibrate(&self) -> bool {
        let follows = self.follower().is_some_and(|follower| follower.line().is_some());
        (follows || self.config.knows_of_others()) && self.follower.has_to_calibrate()
    }

    /// How far it is with the time.
    pub fn state(&self) -> SyncState {
        self.follower().map_or(SyncState::Locked, Slave::state)
    }

    /// Time has passed. Who has no slot cannot calibrate, and does without; who has nothing of the schedule that is in use
    /// leads nobody in it. `true` when slots are to be aligned.
    pub fn on_timeout(
        &mut self,
        now: Instant,
        has_slots: bool,
        has_schedule: bool,
        events: &mut Events,
    ) -> bool {
        let listen = self.listens();
        match self.phase {
            Phase::Attached => self.phase = Phase::Listening { until: now + listen },
            Phase::Listening { until } if now >= until => return self.speak(now, events),
            Phase::Following { until } => {
                self.follower.on_timeout(now, events);
                let is_alone = self.follower.line().is_none() && now >= until;
                // However long its own slots are used without.
                let is_lost = self.follower.missing() > HOLDOVER_CYCLES.unsigned_abs();
                if is_alone || is_lost || self.follower.state() == SyncState::Lost {
                    self.phase = Phase::Listening { until: now + listen };
                } else if has_schedule && self.has_followed(has_slots) {
                    self.take_place(events);
                }
            }
            Phase::StandBy { .. } => {
                self.follower.on_timeout(now, events);
                if self.follower.line().is_none() {
                    self.phase = Phase::Listening { until: now + listen };
                }
            }
            _ => {}
        }
        false
    }

    fn listens(&self) -> Span {
        let silence = self.config.cycle * LISTEN_CYCLES;
        match self.config.backup {
            Some(_) => (silence * 2).max(BACKUP_LISTENS_AT_LEAST),
            None => silence.max(LISTEN_AT_LEAST),
        }
    }

    /// There is nobody else. What was followed goes on, if there was something. `true` if slots are to be aligned: to a grid
    /// of its own, or since calibration used one alone.
    fn speak(&mut self, now: Instant, events: &mut Events) -> bool {
        let followed = self.follower.line().copied();
        let MasterConfig { cycle: period, epoch: offset, resume, .. } = self.config;
        let known = followed.unwrap_or_else(|| {
            let (cycle, sched) = resume.unwrap_or((0, offset.global(now)));
            TimeLine { cycle, start: offset.local(sched), sched, period, offset, drift: Drift::NONE }
        });
        let gone = (now - known.start).nanos().div_euclid(known.period.nanos());
        let cycle = known.cycle.wrapping_add(gone as u32);
        self.begin(&known, cycle);
        events.note(cycle.wrapping_add(1), EventKind::MasterActive, Span::ZERO);
        followed.is_none() || self.follower.calibration().delay().is_none()
    }

    /// Gives the time on this line from now on; `cycle` was the last that has begun. Of a new grid that is cycle 0,
    /// without a Synchronisation; the first carries cycle 1, as RTnet's does.
    fn begin(&mut self, line: &TimeLine, cycle: u32) {
        let (start, sched) = (line.start_of(cycle), line.sched_of(cycle));
        let offset = Offset::between(start, sched);
        let line = TimeLine { cycle, start, sched, period: line.period, offset, drift: Drift::NONE };
        self.phase = Phase::Active { line };
        (self.late_in_row, self.rival, self.has_spoken) = (0, None, true);
    }

    fn has_followed(&self, has_slots: bool) -> bool {
        match self.follower.state() {
            SyncState::Locked => true,
            SyncState::Calibrating => !has_slots && self.follower.line().is_some(),
            _ => false,
        }
    }

    /// It follows as well as can be: a backup stands by, and a primary takes its place back from one.
    fn take_place(&mut self, events: &mut Events) {
        let Some(line) = self.follower.line().copied() else { return };
        if self.config.backup.is_some() {
            self.phase = Phase::StandBy { passed: line.cycle };
        } else if self.late_in_row >= LATE_OF_BACKUP && self.outlasted_by != Some(self.follower.master()) {
            self.begin(&line, line.cycle);
            events.note(line.cycle.wrapping_add(1), EventKind::MasterActive, Span::ZERO);
        }
    }

    /// From `from` on cycles are this long.
    pub fn run_at(&mut self, period: Span, from: u32) {
        self.config.cycle = period;
        self.follower.run_at(period, from);
        if let Phase::Active { line } = &mut self.phase {
            line.run_at(period, from);
        }
    }

    /// Another schedule is in use from cycle `from` on.
    pub fn postpone_replies(&mut self, from: u32) {
        if let Phase::Active { line } = &self.phase {
            self.replies.postpone_all(line.start_of(from));
        }
    }

    /// A calibration request, received at `rx`.
    pub fn on_request(
        &mut self,
        rx: Instant,
        from: Address,
        request_xmit: u64,
        cycle: u32,
        offset: u64,
    ) -> Result<(), Refusal> {
        let Phase::Active { line } = &self.phase else { return Err(Refusal::NotMaster) };
        self.replies.ask(line, rx, from, request_xmit, cycle, offset)
    }

    /// The line of the grid, anchored at the last cycle that was begun, or the line that is followed.
    pub fn line(&self) -> Option<&TimeLine> {
        match &self.phase {
            Phase::Active { line } => Some(line),
            _ => self.follower.line(),
        }
    }

    /// The master this one made way for.
    pub fn yielded_to(&self) -> Option<Address> {
        match self.phase {
            Phase::Yielded { to } => Some(to),
            Phase::Active { .. } => None,
            _ => self.outlasted_by,
        }
    }

    /// When to wake next whatever is to be sent.
    pub fn deadline(&self) -> Option<Instant> {
        match self.phase {
            Phase::Attached => Some(Instant::default()),
            Phase::Listening { until } => Some(until),
            Phase::Following { until } => self.follower.deadline().or(Some(until)),
            Phase::StandBy { .. } => self.follower.deadline(),
            Phase::Active { .. } | Phase::Yielded { .. } => None,
        }
    }

    /// The next Synchronisation: its cycle, instant and global time. A backup's is sent only if nobody else's was heard
    /// by then.
    pub fn next_sync(&self) -> Option<(u32, Instant, GlobalTime)> {
        let line = self.line()?;
        let begun = match self.phase {
            Phase::Active { line } => line.cycle,
            // Whichever is later.
            Phase::StandBy { passed } if line.ahead(passed) > 0 => passed,
            Phase::StandBy { .. } => line.cycle,
            _ => return None,
        };
        let cycle = begun.wrapping_add(1);
        let at = line.start_of(cycle) + self.config.backup.unwrap_or(Span::ZERO);
        Some((cycle, at, line.sched_of(cycle)))
    }

    /// From this station's clock to global time.
    pub fn epoch(&self) -> Offset {
        self.line().map_or(self.config.epoch, |line| line.offset)
    }

    /// The next cycle has begun, with or without its Synchronisation.
    pub fn advance(&mut self) {
        let Some((cycle, ..)) = self.next_sync() else { return };
        match &mut self.phase {
            Phase::Active { line } => {
                *line = line.at(cycle);
            }
            Phase::StandBy { passed } => *passed = cycle,
            _ => {}
        }
    }

    /// Nothing is to be sent in cycles before this one. How many Synchronisations it was to send in them.
    pub fn jump(&mut self, cycle: u32) -> u64 {
        let Phase::Active { line } = &mut self.phase else { return 0 };
        let last = cycle.wrapping_sub(1);
        let skipped = line.ahead(last).max(0);
        if skipped > 0 {
            *line = line.at(last);
        }
        skipped as u64
    }

    /// Its Synchronisation of a cycle has left, `in_time` or held up: a backup that stood by has taken over.
    pub fn sent(&mut self, cycle: u32, in_time: bool, events: &mut Events) {
        self.sent = in_time.then_some(cycle);
        if let (Phase::StandBy { .. }, Some(line)) = (self.phase, self.follower.line().copied()) {
            self.begin(&line, cycle);
            events.note(cycle, EventKind::TookOver, self.config.backup.unwrap_or(Span::ZERO));
        }
    }

    pub fn replies(&self) -> &Replies {
        &self.replies
    }

    pub fn replies_mut(&mut self) -> &mut Replies {
        &mut self.replies
    }
}

#[cfg(test)]
mod tests;
