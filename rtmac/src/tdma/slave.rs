//! The slave: follows the master's time line.
//!
//! ```text
//!            second Synchronisation agrees        last round
//!  Waiting ──────────────────────► Calibrating ─────────────► Locked ◄──────────┐
//!     (without rounds: Locked)        │  ▲                  (1) │ │ one missing  │ a Synchronisation that agrees,
//!                                     │  │                      │ ▼              │ or the last that a new line
//!                                     │  │                      │ Holdover ──────┤ takes
//!                                     │  │ the same, before     │ │ two missing  │
//!                        two missing  │  │ the last round       ▼ ▼              │
//!                                     │  └──────────────────── Lost ─────────────┘
//!                                     └──────────────────────►  │ a thousand missing
//!                                                               ▼
//!                                              Lost, and the line given up: two that agree are needed again
//!
//!  (1) two missing at once, after a sleep; or one where none is bridged (a holdover of 0)
//! ```
//!
//! One is bridged, or as many as configured; one more is a loss. A calibration always bridges one. All that follows is so
//! unless there is no filter (`overwrite.rs`).
//!
//! Whatever is refused or waits to be confirmed changes no state; `tests/transitions.rs` has every state, with what may be
//! doubted in it, against everything that can happen, with a filter and without. The follower of a master also begins anew
//! (`forget`), and goes on with the line on which that one gave the time (`resume`: Locked, or Calibrating before the last
//! round).
//!
//! A Synchronisation that disagrees with the line is a *time step*. The next one decides: the master has moved if it agrees
//! with the step; one frame was delayed if it agrees with the line. Until then a cycle is bridged, as if its Synchronisation
//! were missing, if that was a little late, and silent if it was early or very late.
//!
//! A frame is never early, but networks and slow hosts delay many in a row. So a late Synchronisation shows little of the
//! clocks. An earlier line needs two Synchronisations in a row, a later one eight, and a later one that a slow host explains
//! needs a window of the envelope.
//!
//! Synchronisations that have become earlier by a step show that they had been slow while the delay was measured, if the step is no
//! longer than the delay is longer than that of a frame for one station: the delay is shorter then, and the line stays (`rounds.rs`).
//!
//! A Synchronisation that agrees belongs to the line below all of them ([`Envelope`]), once that line is known. Until then
//! it moves the line by a 300th of the cycle at most. Lateness beyond the clocks' drift moves it by an eighth only.

mod overwrite;
mod rounds;

use rtnet::counters::Refusal;
use rtnet::discipline::{EventKind, SyncState};
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::Address;

use super::bound::Disagreement;
use super::calibration::Calibration;
use super::envelope::{Envelope, OLDEST};
use super::events::Events;
use super::follow::{Servo, SlaveConfig};
use super::line::{self, Drift, LINE_GOOD_FOR, TimeLine};
use super::mark::{self, Mark, Step};

/// A cycle's Synchronisation is missing when this part of the cycle has gone by without it: no sync window is longer.
const GRACE_PARTS: i64 = 8;
/// A cycle starts at most this long before or after its Synchronisation is received; once the period is
/// known, at most one period.
const MAX_SYNC_AGE: Span = Span::from_millis(10_000);

/// A station that follows. What every turn looks at comes first, together.
#[repr(C)]
pub struct Slave {
    state: SyncState,
    /// Who sent the last Synchronisation, and the last that was followed.
    master: Address,
    line_of: Address,
    /// With whom the delay was, or is being, measured.
    measured_with: Address,
    /// A cycle whose number came twice, and not as from a backup.
    doubted: Option<u32>,
    deviation: Span,
    /// How much later than the line the last Synchronisation on it is, as the line is since.
    beside: Span,
    disagreement: Disagreement,
    /// Cycles since the line's last Synchronisation.
    missing: i64,
    config: SlaveConfig,
    track: Track,
    calibration: Calibration,
    envelope: Envelope,
}

enum Track {
    Nothing,
    First(Mark),
    On { line: TimeLine, step: Option<Step> },
}

/// What became of a Synchronisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Followed {
    /// It continues the line.
    Agrees,
    /// The line begins, or begins anew: slots are to be aligned to it.
    NewLine,
    /// It waits for the next one to confirm it.
    Pending,
    /// It is of a cycle of the line that is over, and says nothing.
    Late,
}

impl Slave {
    pub fn new(config: SlaveConfig) -> Self {
        Self {
            config,
            track: Track::Nothing,
            envelope: Envelope::new(),
            state: SyncState::Waiting,
            calibration: Calibration::new(config.rounds, config.servo, config.delay_of()),
            master: Address::BROADCAST,
            line_of: Address::BROADCAST,
            measured_with: Address::BROADCAST,
            doubted: None,
            deviation: Span::ZERO,
            beside: Span::ZERO,
            disagreement: Disagreement::default(),
            missing: 0,
        }
    }

    /// A Synchronisation, received at `rx`.
    pub fn on_sync(
        &mut self,
        rx: Instant,
        from: Address,
        cycle: u32,
        xmit: GlobalTime,
        sched: GlobalTime,
        events: &mut Events,
    ) -> Result<Followed, Refusal> {
        let delay = self.calibration.delay().unwrap_or(Span::ZERO);
        let offset = line::offset(xmit, delay, rx);
        let mark = Mark { cycle, sched, offset, sent: xmit - sched };
        let age = (mark.start() - rx).abs();
        let known = self.line().map_or(MAX_SYNC_AGE, |line| line.period);
        if age > known {
            return Err(Refusal::ImplausibleSync);
        }
        let followed = match self.config.servo {
            Servo::None => self.overwrite(from, mark, age),
            Servo::Linear => self.filter(from, mark, rx, events)?,
        };
        self.master = from;
        if matches!(followed, Followed::Pending | Followed::Late) {
            return Ok(followed);
        }
        self.line_of = from;
        self.measure_with(from);
        self.settle(cycle, events);
        Ok(followed)
    }

    /// A Synchronisation, received at `rx`, agrees with the line, confirms another, or waits for the next one to do so.
    fn filter(
        &mut self,
        from: Address,
        mark: Mark,
        rx: Instant,
        events: &mut Events,
    ) -> Result<Followed, Refusal> {
        let (cycle, age) = (mark.cycle, (mark.start() - rx).abs());
        let followed = match &mut self.track {
            Track::Nothing => {
                self.track = Track::First(mark);
                Followed::Pending
            }
            Track::First(first) => match first.line_to(&mark, self.config.step_limit) {
                Some(line) if age <= line.period => {
                    // Whichever was held up less.
                    let start = line.start.min(first.start() + (mark.sched - first.sched));
                    self.adopt(from, line.carried_on(&mark, start, Drift::NONE))
                }
                _ => {
                    self.track = Track::First(mark);
                    Followed::Pending
                }
            },
            Track::On { line, step } => {
                let agrees = mark.agrees_with(line, self.config.step_limit, self.envelope.slower());
                if cycle == line.cycle || step.is_some_and(|step| step.mark.cycle == cycle) {
                    // Media double frames; and a backup that has not heard its master says the same as that.
                    let is_copy = from == self.line_of && (cycle, mark.sched) == (line.cycle, line.sched);
                    let is_backups = from != self.master && mark.repeats(line, self.config.step_limit);
                    if !is_copy && !is_backups {
                        self.doubted = Some(cycle);
                    }
                    events.note(cycle, EventKind::DuplicateCycle, mark.deviation_from(line));
                    // The other one was beside the line: which of the two is right for time is not in doubt.
                    if !agrees {
                        return Err(Refusal::DuplicateCycle);
                    }
                }
                if mark.is_overtaken(line, rx, self.config.step_limit) {
                    return Ok(Followed::Late);
                }
                self.deviation = mark.deviation_from(line);
                if agrees {
                    if from != self.line_of {
                        // Another clock: it may drift otherwise.
                        self.envelope.restart();
                        self.calibration.leave_line();
                    }
                    if self.envelope.note(cycle, mark.start(), line.start_of(cycle), line.period) {
                        rounds::correct_delay(&mut self.calibration, &mut self.envelope, line);
                    }
                    *line = match self.envelope.start_of(cycle) {
                        Some((start, drift)) => line.carried_on(&mark, start, drift),
                        None => line.moved_to(&mark),
                    };
                    *step = None;
                    self.beside = mark.start() - line.start;
                    self.disagreement.note(self.deviation);
                    Followed::Agrees
                } else {
                    let takes = mark.takes(line, self.config.step_limit, from == self.line_of);
                    let agreed =
                        step.and_then(|step| step.with(mark, takes, self.config.step_limit, line.period));
                    match agreed {
                        Some((step, moved)) if step.seen >= step.takes && age <= moved.period => {
                            if self.quicken(from, &moved, events) {
                                Followed::Agrees
                            } else {
                                self.adopt(from, moved)
                            }
                        }
                        _ => {
                            *step = Some(agreed.map_or(Step { mark, seen: 1, takes }, |(step, _)| step));
                            events.note(mark.silences(line, rx), EventKind::TimeStep, self.deviation);
                            Followed::Pending
                        }
                    }
                }
            }
        };
        Ok(followed)
    }

    /// Begins anew, in place: nobody is followed. A delay that is known stays.
    pub fn forget(&mut self) {
        self.track = Track::Nothing;
        self.envelope.restart();
        self.calibration.leave_line();
        (self.master, self.line_of) = (Address::BROADCAST, Address::BROADCAST);
        (self.doubted, self.missing, self.deviation) = (None, 0, Span::ZERO);
        self.state = SyncState::Waiting;
    }

    /// This station gave the time itself, on this line, and follows from now on whoever does. A delay that is known
    /// stays.
    pub fn resume(&mut self, line: TimeLine) {
        self.track = Track::On { line, step: None };
        self.beside = Span::ZERO;
        self.disagreement = Disagreement::at_first(mark::step_limit(self.config.step_limit, line.period));
        self.envelope.restart();
        self.calibration.leave_line();
        (self.master, self.line_of) = (Address::BROADCAST, Address::BROADCAST);
        (self.doubted, self.missing) = (None, 0);
        self.state = match self.calibration.delay() {
            None => SyncState::Calibrating,
            Some(_) => SyncState::Locked,
        };
    }

    /// From `from` on cycles are this long: the clocks are the same.
    pub fn run_at(&mut self, period: Span, from: u32) {
        let Track::On { line, step } = &mut self.track else { return };
        if line.period == period {
            return;
        }
        let is_to_come = line.ahead(from) > 0;
        line.run_at(period, from);
        if is_to_come {
            // What is known best is not that cycle: its own Synchronisation is followed as any.
            *line = line.at(from.wrapping_sub(1));
        }
        (*step, self.missing) = (None, 0);
        self.disagreement = Disagreement::at_first(mark::step_limit(self.config.step_limit, period));
        self.envelope.begin_line();
        self.calibration.leave_line();
    }

    /// Time has passed: Synchronisations may be missing.
    pub fn on_timeout(&mut self, now: Instant, events: &mut Events) {
        let Track::On { line, .. } = &self.track else { return };
        let since = now - line.start - line.period / GRACE_PARTS;
        let missing = (since.nanos() / line.period.nanos()).max(0);
        self.missing = missing;
        let cycle = line.cycle.wrapping_add(missing as u32);
        let is_bridged = missing <= i64::from(self.config.holdover);
        match (self.state, missing) {
            (_, 0) => {}
            (SyncState::Holdover, _) if is_bridged => {}
            (SyncState::Locked, _) if is_bridged => {
                self.state = SyncState::Holdover;
                events.note(cycle, EventKind::Holdover, since);
            }
            // One missing Synchronisation does not interrupt a calibration.
            (SyncState::Calibrating, 1) => {}
            (SyncState::Calibrating, _) if is_bridged => {}
            (SyncState::Lost, _) if missing > i64::from(LINE_GOOD_FOR) => {
                self.track = Track::Nothing;
                events.note(cycle, EventKind::LineGivenUp, since);
            }
            (SyncState::Lost, _) => {}
            _ => {
                self.state = SyncState::Lost;
                events.note(cycle, EventKind::SyncLost, since);
            }
        }
    }

    /// Whether anything may be sent in `cycle`: not without (or long after) its Synchronisation or the one before,
    /// not while a time step is unconfirmed that no hold-up explains, not in a cycle whose number came twice.
    pub fn may_send(&self, cycle: u32) -> bool {
        let Track::On { line, step } = &self.track else { return false };
        let moved = step.is_some_and(|step| !step.mark.is_bridged(line));
        let bridged = self.config.holdover as i32;
        // The next one's Synchronisation may have come before a slot at the cycle's end.
        let known = -bridged.min(1)..=bridged;
        known.contains(&line.ahead(cycle)) && !moved && !self.doubts(cycle)
    }

    /// Whether the number of this cycle came twice, and not as from a backup.
    pub fn doubts(&self, cycle: u32) -> bool {
        self.doubted == Some(cycle)
    }

    /// The line that is followed. Without Synchronisations it is kept for a while, so that slots that
    /// are passed over are told of.
    pub fn line(&self) -> Option<&TimeLine> {
        match &self.track {
            Track::On { line, .. } => Some(line),
            _ => None,
        }
    }

    /// When the loss of one more Synchronisation would be noticed, but the first that is bridged, which whoever sends
    /// notices.
    pub fn deadline(&self) -> Option<Instant> {
        let line = self.line()?;
        let cycles = self.missing.max(i64::from(self.config.holdover.min(1))) + 1;
        Some(line.start + line.period * cycles + line.period / GRACE_PARTS)
    }

    pub fn state(&self) -> SyncState {
        self.state
    }
    pub fn master(&self) -> Address {
        self.master
    }
    /// Whose line is followed, if there is one.
    pub fn followed(&self) -> Option<Address> {
        self.line().map(|_| self.line_of).filter(|&of| of != Address::BROADCAST)
    }
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }
    pub fn calibration_mut(&mut self) -> &mut Calibration {
        &mut self.calibration
    }
    /// By how much the last Synchronisation disagreed with the line.
    pub fn deviation(&self) -> Span {
        self.deviation
    }
    pub fn config(&self) -> &SlaveConfig {
        &self.config
    }
    pub fn envelope(&self) -> &Envelope {
        &self.envelope
    }
    pub fn disagreement(&self) -> Disagreement {
        self.disagreement
    }
    /// Cycles since the line's last Synchronisation that ought to have had one.
    pub fn missing(&self) -> u32 {
        self.missing as u32
    }

    /// How fast this station's clock gains on the master's, in parts per 10^9, once known.
    pub fn drift_ppb(&self) -> Option<i64> {
        let line = self.line()?;
        self.envelope.drift().map(|drift| drift.parts_per_billion(line.period))
    }

    /// Whether the drift is known well, and the delay by the line as it is since, or its rounds are old. Until then time may be
    /// off by some microseconds on a busy host.
    pub fn is_settled(&self) -> bool {
        let Some(line) = self.line() else { return false };
        let locked = matches!(self.state, SyncState::Locked | SyncState::Holdover);
        let envelope = &self.envelope;
        let is_old = |done| line.period * i64::from(-line.ahead(done)) > OLDEST;
        let corrected =
            |done| !envelope.is_unbroken_since(done) || envelope.unsure_in(done).is_some() || is_old(done);
        let clear = envelope.is_clear() && self.calibration.done().is_none_or(corrected);
        locked && (clear || self.config.servo == Servo::None)
    }

    fn adopt(&mut self, from: Address, line: TimeLine) -> Followed {
        self.track = Track::On { line, step: None };
        self.beside = Span::ZERO;
        self.disagreement = Disagreement::at_first(mark::step_limit(self.config.step_limit, line.period));
        if from == self.line_of {
            self.envelope.begin_line();
        } else {
            self.envelope.restart();
        }
        self.calibration.leave_line();
        Followed::NewLine
    }

    /// There is a line: calibrate on it, or be locked to it.
    fn settle(&mut self, cycle: u32, events: &mut Events) {
        let was = self.state;
        self.missing = 0;
        self.state = match self.calibration.delay() {
            None => SyncState::Calibrating,
            Some(_) => SyncState::Locked,
        };
        if self.state == SyncState::Locked && !matches!(was, SyncState::Locked | SyncState::Holdover) {
            events.note(cycle, EventKind::Locked, self.calibration.delay().unwrap_or(Span::ZERO));
        }
    }
}

#[cfg(test)]
mod tests;
