//! Leading: what the acting master says, and when a change goes on, or is stopped.

use rtnet::counters::Refusal;
use rtnet::wire::ethernet::Address;

use super::super::config::Refused;
use super::{
    AHEAD, AHEAD_AT_LEAST, ALONE, Book, Change, DEAF, FRESH, PATIENCE, PATIENCE_IN_TURNS, SEALED_BEFORE,
    State, Status, Stopped, Switch, reached,
};
use crate::wire::change::{Answer, ScheduleId, Verdict};

/// Part of a status that concerns whoever gives the time.
pub struct Lead {
    /// Whether this station is the acting master.
    pub acts: bool,
    /// Since this cycle.
    since: u32,
    /// The last cycle whose Synchronisation has left.
    pub sent: Option<u32>,
    /// The schedule that the last Synchronisation which was made names as proposed, and the one that has left: something may be
    /// proposed between the two.
    named_next: ScheduleId,
    pub named: ScheduleId,
    /// It may have missed what others decided, and hears until then.
    unsure_until: Option<u32>,
    /// Another is sure of something else.
    is_contradicted: bool,
    /// A commit that it found when it took over, and has confirmed.
    is_inherited: bool,
    pub asked: Vec<Asked>,
    asked_in: u32,
    patience: u32,
    ahead: u32,
    activate: Option<Activation>,
    masters: Vec<Address>,
    pub stopped: Option<Stopped>,
}

/// A station that is asked.
#[derive(Clone, Copy)]
pub struct Asked {
    pub station: Address,
    pub acknowledged: bool,
    pub confirmed: bool,
    pub gives_time: bool,
}

/// When a schedule is to be used, once all have acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// As soon as can be.
    Soon,
    /// From this cycle on.
    At(u32),
}

impl Lead {
    /// For so many stations without taking memory.
    pub fn new(reserved: usize, masters: &[Address]) -> Self {
        Self {
            acts: false,
            since: 0,
            sent: None,
            named_next: ScheduleId::default(),
            named: ScheduleId::default(),
            unsure_until: None,
            is_contradicted: false,
            is_inherited: false,
            asked: Vec::with_capacity(reserved),
            asked_in: 0,
            patience: 0,
            ahead: AHEAD,
            activate: None,
            masters: masters.to_vec(),
            stopped: None,
        }
    }
}

impl Change {
    /// What this station says with its Synchronisation of `cycle`; `others` may give the time besides it. It takes over, if it was another that
    /// gave the time.
    pub fn say(&mut self, cycle: u32, others: bool) -> Status {
        if !self.lead.acts {
            self.take_over(cycle, others);
        }
        let was_silent = |sent: u32| others && cycle.wrapping_sub(sent) > DEAF;
        if self.lead.sent.is_some_and(was_silent) || self.lead.is_contradicted {
            // Who knows who gave the time meanwhile, and what that one said.
            self.doubt(cycle);
        }
        self.go_on(cycle);
        self.lead.named_next = self.told.admin;
        self.told
    }

    /// Its Synchronisation has left.
    pub fn spoke(&mut self, cycle: u32) {
        (self.lead.sent, self.lead.named) = (Some(cycle), self.lead.named_next);
    }

    fn take_over(&mut self, cycle: u32, others: bool) {
        let lead = &mut self.lead;
        (lead.acts, lead.since, lead.sent) = (true, cycle, None);
        (lead.is_inherited, lead.unsure_until, lead.activate) = (false, None, None);
        lead.is_contradicted = false;
        lead.asked.clear();
        match self.told.state {
            State::Proposed => self.stop(cycle, Stopped::MasterChanged),
            State::Committed if self.confirmed == Some(self.told.admin) => self.lead.is_inherited = true,
            State::Committed => self.stop(cycle, Stopped::MasterChanged),
            State::Idle | State::Sealed | State::Switched | State::Cancelled => {}
        }
        let was_deaf = |heard: super::Heard| others && cycle.wrapping_sub(heard.cycle) > DEAF;
        if !self.told.is_sure || !self.is_able() || self.heard.is_some_and(was_deaf) {
            self.doubt(cycle);
        }
    }

    /// Whether this station could lead the others in the schedule that is in use.
    pub fn is_able(&self) -> bool {
        self.told.oper == self.in_use || self.can_use(self.told.oper)
    }

    /// Which schedule is in use, and what is decided, is not known for sure any more.
    fn doubt(&mut self, cycle: u32) {
        self.lead.unsure_until = Some(cycle.wrapping_add(ALONE));
        self.lead.is_contradicted = false;
    }

    /// Another gives the time while this one does, and does not make way.
    pub fn overhear(&mut self, status: Status) {
        let is_unsure = self.lead.unsure_until.is_some();
        self.lead.is_contradicted = !is_unsure && status.is_sure && status.oper != self.told.oper;
        if is_unsure {
            self.learn(status);
            self.told.is_sure = false;
        }
    }

    /// It has heard for long enough what others know.
    fn trust(&mut self, cycle: u32) {
        self.lead.unsure_until = None;
        if matches!(self.told.state, State::Proposed | State::Committed) {
            self.stop(cycle, Stopped::MasterChanged);
        }
        if !self.is_able() {
            // What nobody can be told of nobody can use.
            (self.told.oper, self.told.admin) = (self.in_use, self.in_use);
            (self.told.activation, self.told.state) = (cycle, State::Idle);
        }
    }

    /// Time has passed.
    fn go_on(&mut self, cycle: u32) {
        if self.lead.unsure_until.is_some_and(|until| reached(cycle, until)) {
            self.trust(cycle);
        }
        let (activation, is_unsure) = (self.told.activation, self.lead.unsure_until.is_some());
        match self.told.state {
            State::Proposed | State::Committed if is_unsure => {}
            State::Proposed => self.ask_on(cycle),
            State::Committed if self.lead.is_inherited => {
                if cycle.wrapping_sub(self.lead.since) >= ALONE {
                    self.stop(cycle, Stopped::MasterChanged);
                }
            }
            State::Committed => {
                let missing = self.lead.asked.iter().find(|asked| asked.gives_time && !asked.confirmed);
                match missing.map(|asked| asked.station) {
                    None => self.told.state = State::Sealed,
                    Some(station) if reached(cycle.wrapping_add(SEALED_BEFORE), activation) => {
                        self.stop(cycle, Stopped::Unconfirmed { station, at: activation });
                    }
                    Some(_) => {}
                }
            }
            State::Sealed if reached(cycle, activation) && self.can_use(self.told.admin) => {
                (self.told.oper, self.told.state) = (self.told.admin, State::Switched);
            }
            State::Sealed if reached(cycle, activation) => {
                self.stop(cycle, Stopped::MasterChanged);
                self.doubt(cycle);
            }
            State::Switched | State::Cancelled if reached(cycle, activation.wrapping_add(FRESH)) => {
                self.told.state = State::Idle;
            }
            State::Sealed | State::Switched | State::Cancelled | State::Idle => {}
        }
        let is_open = self.told.state == State::Committed && reached(cycle, self.told.activation);
        self.told.is_sure = self.lead.unsure_until.is_none() && !is_open;
    }

    /// Stations are asked: all have acknowledged, or one did not in time.
    fn ask_on(&mut self, cycle: u32) {
        let lead = &self.lead;
        let waited = cycle.wrapping_sub(lead.asked_in);
        match (lead.asked.iter().find(|asked| !asked.acknowledged), lead.activate) {
            (Some(asked), _) if waited > lead.patience => {
                self.stop(cycle, Stopped::Silent { station: asked.station, within: lead.patience });
            }
            (None, Some(Activation::Soon)) => self.commit(cycle.wrapping_add(lead.ahead)),
            (None, Some(Activation::At(at))) if reached(cycle.wrapping_add(AHEAD_AT_LEAST), at) => {
                self.stop(cycle, Stopped::TooLate { at, now: cycle });
            }
            (None, Some(Activation::At(at))) => self.commit(at),
            _ => {}
        }
    }

    fn commit(&mut self, at: u32) {
        (self.told.state, self.told.activation) = (State::Committed, at);
    }

    /// Nobody switches. An activation cycle that was named stays named, so that nobody bridges it.
    fn stop(&mut self, cycle: u32, why: Stopped) {
        if self.told.state != State::Committed {
            self.told.activation = cycle;
        }
        (self.told.state, self.lead.is_inherited) = (State::Cancelled, false);
        self.lead.stopped = Some(why);
    }

    /// Proposes a schedule to all stations that have slots. What this station itself says to it is `verdict`.
    pub fn propose(
        &mut self,
        cycle: u32,
        own: Address,
        book: &Book,
        activate: Option<Activation>,
    ) -> Result<(), Refused> {
        if !self.lead.acts || !self.told.is_sure {
            return Err(Refused::NotActing);
        }
        if self.is_pending() {
            return Err(Refused::ChangePending { number: self.told.admin.number });
        }
        if let Some(Activation::At(at)) = activate {
            self.check_activation(cycle, at)?;
        }
        let known = if self.oper.holds(self.in_use) { Some(&self.oper) } else { self.first.as_deref() };
        let known = known.filter(|_| self.told.oper == self.in_use).unwrap_or(book);
        let lacks =
            |master: &&Address| **master != own && !known.stations().any(|station| station == **master);
        if let Some(&station) = self.lead.masters.iter().find(lacks) {
            return Err(Refused::MasterWithoutSlot { station });
        }
        let others = known.stations().filter(|&station| station != own);
        let room = self.admin.capacity();
        self.lead.asked.clear();
        self.lead.asked.extend(others.take(room).map(|station| {
            let gives_time = self.lead.masters.contains(&station);
            Asked { station, acknowledged: false, confirmed: false, gives_time }
        }));
        let turns = known.longest_period();
        self.lead.ahead = AHEAD.saturating_add(turns.saturating_mul(2));
        self.lead.patience = PATIENCE
            .saturating_add(turns.saturating_mul(PATIENCE_IN_TURNS))
            .saturating_add(4 * book.planned().len() as u32);
        let number = self.highest.wrapping_add(1).max(1);
        self.admin.copy_from(book, number)?;
        self.highest = number;
        (self.lead.asked_in, self.lead.activate, self.lead.stopped) = (cycle, activate, None);
        self.verdict = Some(Ok(()));
        self.told = Status {
            oper: self.told.oper,
            admin: self.admin.id(),
            activation: cycle,
            state: State::Proposed,
            is_sure: true,
        };
        Ok(())
    }

    fn check_activation(&self, cycle: u32, at: u32) -> Result<(), Refused> {
        let ahead = at.wrapping_sub(cycle) as i32;
        if ahead < (AHEAD_AT_LEAST + DEAF) as i32 {
            return Err(Refused::ActivationTooNear { at, now: cycle, least: AHEAD_AT_LEAST + DEAF });
        }
        Ok(())
    }

    /// What is proposed is to be used once all have acknowledged it.
    pub fn activate(&mut self, cycle: u32, activation: Activation) -> Result<(), Refused> {
        if !self.lead.acts {
            return Err(Refused::NotActing);
        }
        if self.told.state != State::Proposed {
            return Err(Refused::NothingProposed);
        }
        if let Activation::At(at) = activation {
            self.check_activation(cycle, at)?;
        }
        self.lead.activate = Some(activation);
        Ok(())
    }

    /// What is proposed is withdrawn, as long as it is not sealed.
    pub fn cancel(&mut self, cycle: u32) -> Result<(), Refused> {
        if !self.lead.acts {
            return Err(Refused::NotActing);
        }
        match self.told.state {
            State::Proposed | State::Committed => {
                self.stop(cycle, Stopped::Asked);
                Ok(())
            }
            State::Sealed => Err(Refused::AlreadySealed { at: self.told.activation }),
            _ => Err(Refused::NothingProposed),
        }
    }

    /// A station's answer.
    pub fn on_answer(&mut self, cycle: u32, from: Address, answer: &Answer) -> Result<(), Refusal> {
        if !self.lead.acts || answer.id != self.told.admin {
            return Err(Refusal::ScheduleUnknown);
        }
        let is_asked = matches!(self.told.state, State::Proposed | State::Committed);
        if !is_asked || self.lead.is_inherited {
            // It was repeated, and is not waited for any more.
            return Ok(());
        }
        if answer.digest != self.admin.digest() {
            return Err(Refusal::ScheduleUnknown);
        }
        let Some(asked) = self.lead.asked.iter_mut().find(|asked| asked.station == from) else {
            // Who has no slots yet is not asked, and learns what is in use when it is.
            return Ok(());
        };
        asked.gives_time |= answer.gives_time;
        match answer.verdict {
            Verdict::Acknowledged => asked.acknowledged = true,
            Verdict::Confirmed => (asked.acknowledged, asked.confirmed) = (true, true),
            Verdict::Refused(why, slot) => self.stop(cycle, Stopped::Refused { station: from, why, slot }),
        }
        Ok(())
    }

    /// What this station is to do, as it gives the time, in the cycle that begins.
    pub fn begins(&self, cycle: u32) -> Option<Switch> {
        self.switch_to_oper(cycle).filter(|_| self.lead.acts)
    }
}
