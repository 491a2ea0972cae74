//! Following: what the acting master says, what this station answers, and when it may send.

use rtnet::counters::Refusal;

use super::{Change, DEAF, State, Status, Switch, reached};
use crate::wire::change::{Answer, Part, ScheduleId, Verdict, Why};

/// An answer is repeated after so many turns at the most.
const REPEATED_WITHIN: u32 = 16;

/// Of which cycle the last status is.
#[derive(Clone, Copy)]
pub struct Heard {
    pub cycle: u32,
    /// Two masters have said different things in it.
    is_twofold: bool,
}

/// How often this station has answered to what is asked, and how many turns it leaves to data before it does again.
#[derive(Clone, Copy, Default)]
pub struct Answering {
    to: Option<(ScheduleId, State)>,
    sent: u32,
    wait: u32,
}

impl Change {
    /// A Synchronisation of `cycle` that is followed, or may be, says this; `None`: nothing. What is to be done if another schedule is in
    /// use, which this station has.
    pub fn hear(&mut self, cycle: u32, status: Option<Status>) -> Option<Switch> {
        let Some(status) = status else {
            self.heard = None;
            return None;
        };
        self.lead.acts = false;
        if let Some(heard) = self.heard.as_mut().filter(|heard| heard.cycle == cycle)
            && self.told.is_sure
        {
            heard.is_twofold |= status.is_sure && status.oper != self.told.oper;
            return None;
        }
        self.heard = Some(Heard { cycle, is_twofold: false });
        self.learn(status);
        // What it has is used before it makes room for another.
        let switch = self.switch_to_oper(cycle);
        if switch.is_none() {
            self.collect();
        }
        switch
    }

    /// Whoever is sure is believed; of what others know that counts which is furthest on.
    pub(super) fn learn(&mut self, status: Status) {
        for number in [status.oper.number, status.admin.number] {
            if is_later(number, self.highest) {
                self.highest = number;
            }
        }
        if status.is_sure || status.is_ahead_of(&self.told) {
            self.told = status;
        }
        self.told.is_sure = status.is_sure;
    }

    /// What of another schedule is to come is collected.
    fn collect(&mut self) {
        let Status { oper, admin, state, .. } = self.told;
        let asks = matches!(state, State::Proposed | State::Committed | State::Sealed);
        let wanted = if asks && admin != self.in_use { admin } else { oper };
        // What it has, and will use once that is sure, makes room for nothing.
        let is_kept = oper != self.in_use && self.can_use(oper);
        if wanted != self.in_use && wanted.number != 0 && self.admin.id() != wanted && !is_kept {
            self.admin.begin(wanted);
            self.verdict = None;
        }
        let asked = (admin, state);
        if asks && self.answering.to != Some(asked) {
            self.answering = Answering { to: Some(asked), sent: 0, wait: 0 };
        }
    }

    /// Another schedule is in use than this station's, which it has and can use.
    pub(super) fn switch_to_oper(&self, cycle: u32) -> Option<Switch> {
        let Status { oper, state, activation, is_sure, .. } = self.told;
        if !is_sure || oper == self.in_use || !self.can_use(oper) {
            return None;
        }
        let from = if state == State::Switched && reached(cycle, activation) { activation } else { cycle };
        Some(Switch { from, to: oper })
    }

    /// Whether this station has all of a schedule, and can use it.
    pub(super) fn can_use(&self, id: ScheduleId) -> bool {
        let is_here = self.oper.holds(id) || self.admin.holds(id) && self.verdict == Some(Ok(()));
        id == ScheduleId::default() || is_here
    }

    /// A part of a schedule has come; `true` if `admin` is whole by that, and to be judged.
    pub fn take(&mut self, part: &Part) -> Result<bool, Refusal> {
        if self.lead.acts {
            return Err(Refusal::ScheduleUnknown);
        }
        // One of the schedule that is in use is for others.
        if part.id == self.in_use {
            return Ok(false);
        }
        let is_whole = self.admin.take(part)?;
        self.parts_received += 1;
        Ok(is_whole)
    }

    /// Whether this station can use what it has collected. What is to be done if that is in use already.
    pub fn judged(&mut self, verdict: Result<(), (Why, u8)>) -> Option<Switch> {
        self.verdict = Some(verdict);
        self.heard.and_then(|heard| self.switch_to_oper(heard.cycle))
    }

    /// What this station is to answer in its next turn, if anything.
    pub fn answer(&self, gives_time: bool) -> Option<Answer> {
        let Status { admin, state, .. } = self.told;
        if self.lead.acts || self.answering.wait > 0 || !self.admin.holds(admin) {
            return None;
        }
        let verdict = match (state, self.verdict?) {
            (State::Proposed, Ok(())) => Verdict::Acknowledged,
            (State::Proposed, Err((why, slot))) => Verdict::Refused(why, slot),
            (State::Committed, Ok(())) if gives_time => Verdict::Confirmed,
            _ => return None,
        };
        Some(Answer { id: admin, digest: self.admin.digest(), verdict, gives_time })
    }

    /// This answer is being sent.
    pub fn answers(&mut self, answer: &Answer) {
        if answer.verdict == Verdict::Confirmed {
            self.confirmed = Some(answer.id);
        }
        self.answers_sent += 1;
        self.answering.sent += 1;
        self.answering.wait = (1 << self.answering.sent.min(5)).min(REPEATED_WITHIN);
    }

    /// A turn in which it could have answered is over.
    pub fn turn_is_over(&mut self) {
        self.answering.wait = self.answering.wait.saturating_sub(1);
    }

    /// Whether this station's slots may be used in `cycle`, as far as schedules go; `others` may give the time besides it.
    pub fn may_send(&self, cycle: u32, others: bool) -> bool {
        if self.told.oper != self.in_use {
            return false;
        }
        if self.lead.acts {
            let is_there = |sent: u32| cycle.wrapping_sub(sent) as i32 <= DEAF as i32;
            return self.told.is_sure && (!others || self.lead.sent.is_some_and(is_there));
        }
        let Some(heard) = self.heard else { return false };
        let bridged = cycle.wrapping_sub(heard.cycle) as i32;
        let Status { activation, state, is_sure, .. } = self.told;
        let names_one = matches!(state, State::Committed | State::Sealed | State::Cancelled);
        let is_across =
            bridged > 0 && names_one && reached(cycle, activation) && !reached(heard.cycle, activation);
        is_sure && !(bridged == 0 && heard.is_twofold) && !is_across
    }
}

/// Whether a change's number is a later one than another, shortest way round 2^16; 0, what stations were started with, is before all.
pub(super) fn is_later(number: u16, other: u16) -> bool {
    match (number, other) {
        (0, _) => false,
        (_, 0) => true,
        _ => number.wrapping_sub(other) as i16 > 0,
    }
}

impl Status {
    /// Whether this is further on than another: a schedule of a later change is in use or proposed, or the same one is nearer to
    /// its end. What is sealed goes before what is withdrawn, as only who does not know better withdraws that.
    fn is_ahead_of(&self, other: &Status) -> bool {
        let place = |status: &Status| match status.state {
            State::Proposed => 0,
            State::Committed => 1,
            State::Idle | State::Cancelled => 2,
            State::Sealed => 3,
            State::Switched => 4,
        };
        match (self.oper.number == other.oper.number, self.admin.number == other.admin.number) {
            (false, _) => is_later(self.oper.number, other.oper.number),
            (_, false) => is_later(self.admin.number, other.admin.number),
            _ => place(self) > place(other),
        }
    }
}
