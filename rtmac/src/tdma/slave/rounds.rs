//! A slave's rounds of calibration: the first, and those that measure the delay anew while it is locked.

use rtnet::counters::Refusal;
use rtnet::discipline::{EventKind, SyncState};
use rtnet::time::{Instant, Offset, Span};
use rtnet::wire::ethernet::Address;

use super::super::bound::Disagreement;
use super::super::calibration::Calibration;
use super::super::envelope::Envelope;
use super::super::events::Events;
use super::super::follow::{OnMasterChange, Servo};
use super::super::line::TimeLine;
use super::super::mark;
use super::super::round::Begun;
use super::{Slave, Track};

/// Rounds so many cycles ago say nothing of a line any more. Behind 2^31 they would be to come.
const LONG_AGO: i32 = 1 << 20;

impl Slave {
    /// A calibration reply, received at `rx`; `true` when it was the last that was needed to be locked.
    pub fn on_reply(
        &mut self,
        rx: Instant,
        request_xmit: u64,
        reception: u64,
        xmit: u64,
        events: &mut Events,
    ) -> Result<bool, Refusal> {
        let Track::On { line, .. } = &mut self.track else { return Err(Refusal::UnexpectedReply) };
        if !self.calibration.is_measuring() {
            return Err(Refusal::UnexpectedReply);
        }
        let before = self.calibration.delay();
        let known = before.unwrap_or(Span::ZERO);
        // The first time what is followed counts; later the line need not be where Synchronisations are by now.
        let beside = before.map_or(Span::ZERO, |_| self.beside);
        let bare = without_delay(line, known + beside);
        let Some(delay) = self.calibration.reply(request_xmit, reception, xmit, rx, &bare, beside)? else {
            return Ok(false);
        };
        // The offset grows by what is more of the delay, so everything is due that much earlier on this clock.
        let longer = if before.is_some() { self.calibration.of_line() - known } else { delay };
        line.start = line.start - longer;
        self.envelope.lengthen(longer);
        self.envelope.know_delay(delay);
        let cycle = line.cycle;
        if let (Some(rate), Servo::Linear) = (self.calibration.rate(), self.config.servo) {
            if before.is_none() || !self.envelope.knows_better(rx, rate) {
                self.envelope.know(rx, rate, delay, line.period);
            }
            correct_delay(&mut self.calibration, &mut self.envelope, line);
        }
        if let Some((start, drift)) = self.envelope.start_of(cycle) {
            (line.start, line.drift) = (start, drift);
        }
        line.offset = Offset::between(line.start, line.sched);
        if before.is_some() {
            events.note(cycle, EventKind::CalibratedAnew, delay);
        }
        // Who has lost the master meanwhile is locked by the next Synchronisation, not by a reply.
        if self.state == SyncState::Calibrating {
            self.settle(cycle, events);
        }
        Ok(before.is_none())
    }

    /// Whether `moved`, to which syncs have come, is earlier than the line only since syncs are on their way for a shorter time than the
    /// delay. Then the delay is corrected, and the line goes on. It has to be known as it was while the delay was measured.
    pub(super) fn quicken(&mut self, from: Address, moved: &TimeLine, events: &mut Events) -> bool {
        let Track::On { line, .. } = &self.track else { return false };
        let says_the_same =
            from == self.line_of && moved.sched == line.sched_of(moved.cycle) && moved.period == line.period;
        let by = line.start_of(moved.cycle) - moved.start;
        let knows = |done| self.envelope.is_unbroken_since(done) && self.envelope.unsure_in(done).is_some();
        if !says_the_same || !self.calibration.done().is_some_and(knows) {
            return false;
        }
        let Some(shorter) = self.calibration.quicker(by) else { return false };
        let start = moved.start + shorter;
        let line =
            TimeLine { start, offset: Offset::between(start, moved.sched), drift: line.drift, ..*moved };
        let delay = self.calibration.shorten(shorter);
        self.envelope.quicken(shorter);
        self.disagreement = Disagreement::at_first(mark::step_limit(self.config.step_limit, line.period));
        self.track = Track::On { line, step: None };
        self.beside = Span::ZERO;
        events.note(moved.cycle, EventKind::CalibratedAnew, delay);
        true
    }

    /// Whether the delay is to be measured, now or when somebody else gives the time.
    pub fn has_to_calibrate(&self) -> bool {
        self.calibration.is_measuring() || self.config.on_master_change == OnMasterChange::Repeat
    }

    /// In how many rounds.
    pub fn rounds(&self) -> u32 {
        self.calibration.progress().map_or(self.config.rounds, |(_, of)| of)
    }

    /// Whoever is followed gives the time. The delay to another may be another; whether that matters is configured.
    pub(super) fn measure_with(&mut self, master: Address) {
        let before = core::mem::replace(&mut self.measured_with, master);
        let is_another = before != master && before != Address::BROADCAST;
        if is_another && self.config.on_master_change == OnMasterChange::Repeat {
            match self.calibration.delay() {
                None => self.calibration.leave_master(),
                Some(_) => self.calibration.repeat(),
            }
        }
    }
}

/// The line as it would be if Synchronisations came at once.
fn without_delay(line: &TimeLine, delay: Span) -> TimeLine {
    let start = line.start + delay;
    TimeLine { start, offset: Offset::between(start, line.sched), ..*line }
}

/// The envelope has become clearer. If it reaches back to the time of calibration, so has what rounds say of the delay of
/// syncs: then the host may have been busy, and the line have been followed late.
pub(super) fn correct_delay(calibration: &mut Calibration, envelope: &mut Envelope, line: &TimeLine) {
    let (Some(done), Some(drift)) = (calibration.done(), envelope.drift()) else { return };
    if !envelope.is_unbroken_since(done) || line.ahead(done) < -LONG_AGO {
        return calibration.outdate();
    }
    let Some(unsure) = envelope.unsure_in(done) else { return };
    let begun = |cycle| {
        let start = envelope.start_of(cycle).map_or(line.start, |(start, _)| start);
        Begun { cycle, start, offset: Offset::between(start, line.sched_of(cycle)) }
    };
    let apart = -(drift.parts_per_billion(line.period) as f64) / 1e9;
    let longer = calibration.corrected(line.period, unsure, apart, begun);
    envelope.lengthen(longer);
}
