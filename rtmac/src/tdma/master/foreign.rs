//! What a master makes of the Synchronisations of others.

use rtnet::discipline::EventKind;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;

use super::super::events::Events;
use super::super::line::TimeLine;
use super::super::rival::Rival;
use super::{BACKUP_LOOKS_BEFORE, LISTEN_CYCLES, Master, Phase};

/// One that comes by less than this part of a cycle early is of the next.
const EARLY_PARTS: i64 = 8;

impl Master {
    /// Another master's Synchronisation, sent `late` after it was scheduled; `true` if it is to be followed.
    pub fn on_foreign_sync(
        &mut self,
        rx: Instant,
        (from, own): (Address, Address),
        late: Span,
        events: &mut Events,
    ) -> bool {
        let is_backups = self.config.backups_from.is_some_and(|from| late >= from - BACKUP_LOOKS_BEFORE);
        self.late_in_row = if is_backups { self.late_in_row.saturating_add(1) } else { 0 };
        match self.phase {
            Phase::Yielded { .. } => return false,
            Phase::Attached | Phase::Listening { .. } => {
                let is_taken = self.config.backup.is_none() && !is_backups && self.outlasted_by.is_none();
                if is_taken && self.follower.line().is_none() {
                    events.note(0, EventKind::OtherMaster, Span::ZERO);
                    self.phase = Phase::Yielded { to: from };
                    return false;
                }
                self.phase = Phase::Following { until: rx + self.listens() };
            }
            Phase::Following { ref mut until } => *until = rx + self.config.cycle * LISTEN_CYCLES,
            Phase::StandBy { ref mut passed } => {
                if let Some(line) = self.follower.line() {
                    let gone = (rx - line.start + line.period / EARLY_PARTS).nanos();
                    *passed = line.cycle.wrapping_add(gone.div_euclid(line.period.nanos()) as u32);
                }
            }
            Phase::Active { line } if self.config.backup.is_some() => {
                self.step_down(line);
                self.phase = Phase::StandBy { passed: line.cycle.wrapping_add(1) };
                events.note(line.cycle, EventKind::SteppedDown, Span::ZERO);
            }
            Phase::Active { line } => {
                events.note(line.cycle, EventKind::OtherMaster, late);
                // Who gives the time does not calibrate.
                self.replies.forget(from);
                // A backup does what it is for where there was none of this one, also if that is read only later by who
                // slept, or whose clock was set back. What came just before a cycle may be read in it.
                let heard_in = line.cycle_at(rx);
                if self.sent.is_none_or(|sent| sent.wrapping_sub(heard_in) > 1) {
                    return false;
                }
                let rival = self.rival.get_or_insert_with(|| Rival::new(from, rx));
                rival.heard(from, rx, line.period);
                if !rival.outlasts(own, is_backups) {
                    return false;
                }
                events.note(line.cycle, EventKind::Yielded, rival.lasted(rx));
                (self.outlasted_by, self.left) = (Some(from), Some(line));
                self.follower.forget();
                self.replies.clear();
                self.phase = Phase::Following { until: rx + self.listens() };
            }
        }
        true
    }

    /// Who else gives the time while this one does.
    pub fn rival(&self, now: Instant) -> Option<Address> {
        let Phase::Active { line } = &self.phase else { return None };
        self.rival.filter(|rival| rival.is_heard(now, line.period)).map(|rival| rival.address())
    }

    /// Whether it has ever given the time.
    pub fn has_spoken(&self) -> bool {
        self.has_spoken
    }

    /// The line that it left when it made way, if no other was found since.
    pub fn take_left(&mut self) -> Option<TimeLine> {
        self.left.take()
    }

    /// Another line is followed: cycles may be numbered anew.
    pub fn follows_another_line(&mut self) {
        if let (Phase::StandBy { passed }, Some(line)) = (&mut self.phase, self.follower.line()) {
            *passed = line.cycle;
        }
    }

    /// What was heard at `rx` was beside the line, and may be of another: a backup sends nothing before the next of that
    /// would have told. Else it would hear its own line again and again, from itself or the other backups. Who makes way waits
    /// for one more: of two backups that both have spoken, and both hesitate, one would else never hear the other.
    pub fn doubts_line(&mut self, rx: Instant, makes_way: bool) {
        let looks = self.looks_after();
        if let (Phase::StandBy { passed }, Some(line)) = (&mut self.phase, self.follower.line()) {
            let gone = (rx + line.period - looks - line.start).nanos().div_euclid(line.period.nanos());
            let silent = line.cycle.wrapping_add(gone as u32).wrapping_add(makes_way.into());
            if silent.wrapping_sub(*passed) as i32 > 0 {
                *passed = silent;
            }
        }
    }

    /// Whether it would have spoken already in the cycle of a moment, had it heard nothing.
    pub fn would_have_spoken(&self, at: Instant) -> bool {
        let looks = self.looks_after();
        let is_so = |line: &TimeLine| at - line.start_of(line.cycle_at(at)) >= looks;
        matches!(self.phase, Phase::StandBy { .. }) && self.follower.line().is_some_and(is_so)
    }

    /// Whether it has sent the Synchronisation of a cycle, the last that it has sent.
    pub fn has_sent(&self, cycle: u32) -> bool {
        self.sent == Some(cycle)
    }

    /// So long after a cycle's start a backup looks for the last time.
    fn looks_after(&self) -> Span {
        self.config.backup.map_or(Span::ZERO, |backup| backup - BACKUP_LOOKS_BEFORE)
    }

    /// What others tell is compared with the line on which this one gave the time.
    fn step_down(&mut self, line: TimeLine) {
        self.follower.resume(line);
        self.replies.clear();
    }
}
