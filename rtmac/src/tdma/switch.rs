//! A station's part in a change of the schedule: what it makes of extension frames, whether it can take a schedule, and the
//! switch itself.

use arrayvec::ArrayVec;
use rtnet::counters::Refusal;
use rtnet::discipline::EventKind;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{self, Header};

use super::change::{Activation, Book, Change, ChangeConfig, MAX_BRIDGED, Switch};
use super::config::{Refused, check_cycle, check_rounds, checked};
use super::job::Job;
use super::slot::{SlotConfig, Turn};
use super::{MasterConfig, Mastery, Role, Tdma};
use crate::wire::change::{Answer, Extension, PART_LEN, Status, Verdict, Why};

/// Slots that a schedule may give to one station.
const OWN_SLOTS: usize = 32;

impl Tdma {
    /// The same station, taking part in changes of the schedule.
    pub fn with_changes(mut self, config: &ChangeConfig) -> Self {
        self.change = Some(Box::new(Change::new(config, self.slots.max_id())));
        self
    }

    /// Whether somebody else may give the time besides this station while it does.
    pub(super) fn knows_of_others(&self) -> bool {
        matches!(&self.role, Role::Master(master) if master.config().knows_of_others())
    }

    /// Whether the slots may be used in this cycle, as far as schedules go.
    pub(super) fn schedule_allows(&self, cycle: u32) -> bool {
        self.change.as_ref().is_none_or(|change| change.may_send(cycle, self.knows_of_others()))
    }

    /// A Synchronisation says this of schedules. Whoever gives the time and does not make way only overhears it.
    pub(super) fn hear(&mut self, rx: Instant, cycle: u32, status: Option<Status>) {
        let switch = self.change.as_mut().and_then(|change| change.hear(cycle, status));
        if let Some(switch) = switch {
            self.switch(switch, rx);
        }
    }

    /// Another gives the time while this station does.
    pub(super) fn overhear(&mut self, status: Option<Status>) {
        if let Some((change, status)) = self.change.as_mut().zip(status) {
            change.overhear(status);
        }
    }

    /// What is known of schedules, to be changed on request.
    pub(super) fn changes(&mut self) -> Result<&mut Change, Refused> {
        self.change.as_deref_mut().ok_or(Refused::NoExtensions)
    }

    /// Whoever has acknowledged a schedule stays what it was then.
    pub(super) fn not_while_changing(&self) -> Result<(), Refused> {
        match &self.change {
            Some(change) if change.is_pending() => Err(Refused::ScheduleChanges),
            _ => Ok(()),
        }
    }

    /// Proposes a schedule to all.
    pub(super) fn propose(
        &mut self,
        cycle: u32,
        book: &Book,
        activation: Option<Activation>,
    ) -> Result<(), Refused> {
        self.changes()?;
        self.can_take(book).map_err(|(why, id)| Refused::CannotTake { id, why })?;
        let own = self.address;
        self.changes()?.propose(cycle, own, book, activation)
    }

    /// A frame that real stations drop.
    pub(super) fn on_extension(
        &mut self,
        rx: Instant,
        header: &Header,
        extension: Extension,
    ) -> Result<(), Refusal> {
        if header.source.is_group() || header.source == self.address {
            return Err(Refusal::ForgedSource);
        }
        let cycle = self.cycle_at(rx);
        let Some(change) = &mut self.change else { return Err(Refusal::TdmaVersion) };
        match extension {
            // On a hub all hear it.
            Extension::Answer(_) if header.destination != self.address => Ok(()),
            Extension::Answer(answer) => change.on_answer(cycle, header.source, &answer),
            Extension::Part(part) => {
                if change.take(&part)? {
                    self.judge_collected(rx);
                }
                Ok(())
            }
        }
    }

    /// All of a schedule is there: whether it can be used, and is in use already.
    fn judge_collected(&mut self, now: Instant) {
        let verdict = match &self.change {
            Some(change) => self.can_take(change.admin()),
            None => return,
        };
        let switch = self.change.as_mut().and_then(|change| change.judged(verdict));
        if let Some(switch) = switch {
            self.switch(switch, now);
        }
    }

    /// Whether this station could use its slots of a schedule.
    pub(super) fn can_take(&self, book: &Book) -> Result<(), (Why, u8)> {
        let mut slots = ArrayVec::<SlotConfig, OWN_SLOTS>::new();
        for slot in book.of_station(self.address) {
            slots.try_push(slot).map_err(|_| (Why::SlotId, slot.id))?;
        }
        let cycle = book.cycle();
        for (i, slot) in slots.iter().enumerate() {
            slot.check(self.slots.max_id()).map_err(|refused| (why(&refused), slot.id))?;
            let owner = |other: &&SlotConfig| Some(other.id) == slot.joint;
            let is_joint =
                |owner: &SlotConfig| owner.joint.is_none() && owner.size == slot.size && owner.id != slot.id;
            if slots[..i].iter().any(|other| other.id == slot.id) {
                return Err((Why::Twice, slot.id));
            }
            if slot.joint.is_some() && !slots.iter().find(owner).is_some_and(is_joint) {
                return Err((Why::Joint, slot.id));
            }
            if slot.offset >= cycle {
                return Err((Why::Offset, slot.id));
            }
        }
        self.can_follow(cycle, &slots).map_err(|refused| (why(&refused), slot_of(&refused)))
    }

    /// Whether that goes with the station's role.
    fn can_follow(&self, cycle: Span, slots: &[SlotConfig]) -> Result<(), Refused> {
        check_cycle(cycle)?;
        self.role.can_use(self.lead, slots)?;
        let rounds = || slots.iter().map(|slot| (slot.id, slot.period));
        let (rounds, holdover) = match &self.role {
            Role::Master(master) => {
                let config = *master.config();
                checked(MasterConfig { cycle, ..config }, slots)?;
                let rounds = if master.has_to_calibrate() {
                    check_rounds(config.follow.rounds, rounds())
                } else {
                    Ok(())
                };
                (rounds, if config.knows_of_others() { config.follow.holdover } else { 0 })
            }
            Role::Slave(slave) if slave.has_to_calibrate() => {
                (check_rounds(slave.rounds(), rounds()), slave.config().holdover)
            }
            Role::Slave(slave) => (Ok(()), slave.config().holdover),
            Role::Detached => (Ok(()), 0),
        };
        if holdover > MAX_BRIDGED {
            return Err(Refused::Holdover { cycles: holdover });
        }
        match rounds {
            // Who has no slots any more has nothing to calibrate for.
            Err(Refused::NoSlotToCalibrate) | Ok(()) => Ok(()),
            Err(refused) => Err(refused),
        }
    }

    /// Another schedule is in use: its slots, and its cycle. The turns of the one before that are still to come in cycles before
    /// are left; those of the new one that have passed are, too.
    fn switch(&mut self, switch: Switch, now: Instant) {
        let Switch { from, to } = switch;
        let last = from.wrapping_sub(1);
        let (address, line) = (self.address, self.line().copied());
        self.leave_until(last, now);
        let Some(change) = &mut self.change else { return };
        let (left, length) = (self.slots.planned(), line.map(|line| line.period));
        change.switch(to, left, length);
        self.slots.replace(change.slots_of(to, address), last);
        if let Some(cycle) = change.cycle_of(to) {
            self.role.run_at(cycle, from);
        }
        if let Role::Master(master) = &mut self.role {
            master.postpone_replies(from);
        }
        self.reply_turn = None;
        self.silent = None;
        if let Some(line) = self.line().copied() {
            self.slots.align(&line, line.start_of(from));
            if !self.calibrates() {
                self.leave_until(line.cycle_at(now).wrapping_sub(1), now);
            }
        }
        self.events.note(from, EventKind::ScheduleSwitched, Span::from_nanos(to.number.into()));
    }

    /// The cycle that this station's Synchronisation begins, or would have begun, is the first of another schedule.
    pub(super) fn begin_cycle(&mut self, cycle: u32, now: Instant) {
        let others = self.knows_of_others();
        let Some(change) = &mut self.change else { return };
        if change.acts() {
            change.say(cycle, others);
        }
        if let Some(switch) = change.begins(cycle) {
            self.switch(switch, now);
        }
    }

    /// When to look for the Synchronisation of the activation cycle, if the first slot of the schedule to come is before any other.
    pub(super) fn switch_wakes_at(&self) -> Option<Instant> {
        let (from, admin) = self.change.as_ref()?.sealed()?;
        let line = self.line()?;
        let first = admin.of_station(self.address).map(|slot| slot.offset).min().unwrap_or_default();
        let wakes = line.start_of(from) + (first - self.lead).max(Span::ZERO);
        (self.looked < wakes).then_some(wakes)
    }

    /// A backup that lets the activation cycle pass, and may take over in a later one, counts cycles as all others do then.
    pub(super) fn stand_by_for_switch(&mut self, now: Instant) {
        let Some((from, admin)) = self.change.as_ref().and_then(|change| change.follows_sealed()) else {
            return;
        };
        let (cycle, Role::Master(master)) = (admin.cycle(), &mut self.role) else { return };
        let is_later = master.mastery() == Mastery::StandBy
            && master.next_sync().is_some_and(|(next, ..)| next.wrapping_sub(from) as i32 > 0);
        if is_later && master.line().is_some_and(|line| line.period != cycle && now >= line.start_of(from)) {
            master.run_at(cycle, from);
        }
    }

    /// What is sent besides data in a turn of the first slot.
    pub(super) fn said_in(&self, turn: &Turn) -> Option<Extension> {
        let first = self.slots.first()?;
        let gives_time = matches!(self.role, Role::Master(_));
        let change = self.change.as_ref().filter(|_| first.id == turn.id && !self.calibrates())?;
        if change.acts() {
            let fits = first.size >= PART_LEN - ethernet::HEADER_LEN;
            return change.part_in_turn().filter(|_| fits).map(Extension::Part);
        }
        let answer = change.answer(gives_time)?;
        // What is under way in the first slot is of where that is now.
        let measures = self.follower().is_some_and(|follower| follower.calibration().is_measuring());
        let is_bound = measures || self.awaits_reply(turn.at);
        let verdict = if is_bound && answer.verdict == Verdict::Acknowledged {
            Verdict::Refused(Why::Calibrating, first.id)
        } else {
            answer.verdict
        };
        Some(Extension::Answer(Answer { verdict, ..answer }))
    }

    /// The part of a schedule that follows this station's Synchronisation, if that has left.
    pub(super) fn part_job(&self) -> Option<Job> {
        let (cycle, at) = self.part_in?;
        let latest = at + self.change.as_ref()?.latest;
        Some(Job::Part { cycle, at, latest })
    }
}

impl Role {
    /// From `from` on cycles are this long.
    fn run_at(&mut self, period: Span, from: u32) {
        match self {
            Role::Master(master) => master.run_at(period, from),
            Role::Slave(slave) => slave.run_at(period, from),
            Role::Detached => {}
        }
    }
}

/// As it is told to whoever proposes.
fn why(refused: &Refused) -> Why {
    match refused {
        Refused::SlotId { .. } => Why::SlotId,
        Refused::Size { .. } => Why::Size,
        Refused::Phase { .. } => Why::Phase,
        Refused::BeforeCycle { .. } | Refused::BeyondCycle { .. } => Why::Offset,
        Refused::BeforeBackup { .. } | Refused::BeforeSync { .. } => Why::TooEarly,
        Refused::Holdover { .. } => Why::Holdover,
        Refused::NeverCalibrated { .. } => Why::NeverCalibrated,
        _ => Why::Cycle,
    }
}

fn slot_of(refused: &Refused) -> u8 {
    match *refused {
        Refused::BeyondCycle { id, .. }
        | Refused::BeforeBackup { id, .. }
        | Refused::BeforeSync { id, .. }
        | Refused::NeverCalibrated { id, .. } => id,
        _ => 0,
    }
}
