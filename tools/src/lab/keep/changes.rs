//! Changes of a running lab: judged by all its slots, made by the station, and known to whoever judges frames.

use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use rtmac::tdma::HOLDOVER_CYCLES;
use rtmac::tdma::joint;
use rtmac::tdma::schedule::Schedule;
use rtnet::time::Span;
use rtnet::wire::ethernet::MTU;

use super::Keeper;
use crate::control::{self, Place, Question, Reply, Request, RoleRequest, SlotChange, SlotRequest};
use crate::lab::load::{load, too_much};
use crate::scenario::SlotPlan;

/// How long a station may take to let its lab in, and to answer it: meanwhile nobody looks at the medium, and the
/// observer's ring holds a second.
const LET_IN_WITHIN: Duration = Duration::from_millis(100);
const ANSWER_WITHIN: Duration = Duration::from_millis(500);
/// Changes of slots in a lab's life, each of which is remembered.
const CHANGES_AT_MOST: u32 = 100_000;

/// A change that its station has not answered in time: until it does, nobody knows whether it is made.
pub(super) struct Pending {
    station: usize,
    change: Change,
    question: Question,
}

/// What holds from the cycle on that the station tells.
pub(super) enum Change {
    /// Nothing yet: when it does, the medium tells.
    Nothing,
    /// Its slots are so.
    Slots(Vec<SlotPlan>),
    /// A slave leaves the cycle.
    Leave,
    /// It may come back.
    Return,
}

impl Keeper {
    /// Changes a slot; what is not given stays as it is to be after the changes before.
    pub(super) fn try_set(&mut self, name: &str, change: &SlotChange) -> Result<u32> {
        let station = self.station(name)?;
        let plan = &self.scenario.stations[station];
        let latest = self.scenario.latest();
        let slots: Vec<_> = plan.slots.iter().map(|slot| slot.config(latest)).collect();
        let before = slots.iter().find(|slot| slot.id == change.id).map(|&slot| slot.into());
        let slot = change.over(before.as_ref());
        let SlotRequest { size, phase, period, .. } = slot;
        ensure!(phase < period, "phase {} of {period} does not exist", u64::from(phase) + 1);
        let payload = plan.largest_payload();
        ensure!(
            (payload..=MTU).contains(&size),
            "a size of {size} is not within {payload}, the payload of '{name}', and {MTU}"
        );
        let slots = joint::redefined(&slots, slot.config(latest))?.into_iter().map(SlotPlan::from);
        self.change_slots(station, slots.collect(), Request::SetSlot(slot.into()))
    }

    pub(super) fn try_remove(&mut self, name: &str, id: u8) -> Result<u32> {
        let station = self.station(name)?;
        let slots = &self.scenario.stations[station].slots;
        let slots = slots.iter().filter(|slot| slot.id != id).copied().collect();
        self.change_slots(station, slots, Request::RemoveSlot(id))
    }

    /// Changes a station's slots where they hit no neighbour, and expects them so from the cycle that the station tells.
    fn change_slots(&mut self, station: usize, slots: Vec<SlotPlan>, request: Request) -> Result<u32> {
        let name = &self.scenario.stations[station].name;
        ensure!(
            self.changes < CHANGES_AT_MOST,
            "{CHANGES_AT_MOST} changes were made: take the lab down first"
        );
        ensure!(
            !self.lab.analysis.timetable.is_away(station),
            "station '{name}' is detached: let it join first"
        );
        self.must_have_been_locked(station)?;
        self.must_have_answered()?;
        let mut changed = self.scenario.clone();
        changed.stations[station].slots.clone_from(&slots);
        if let Some(conflict) = changed.schedule().conflicts().first() {
            let bare = Schedule { guard: Span::ZERO, ..changed.schedule() };
            let room = "; without the guard band there is room: bring the lab up with a smaller one (`guard` in its \
                        file, --guard without a file)";
            bail!("{conflict}{}", if bare.conflicts().is_empty() { room } else { "" });
        }
        let load = load(&changed, self.lab.launch.lead);
        let too_much = too_much(self.lab.cpu, load, self.lab.declared.as_ref());
        if let (Some(why), true) = (too_much, self.lab.declared.is_some() && load > self.lab.load) {
            bail!("{why}: give the slot a longer period, or take another lab down");
        }
        self.ask(station, request, Change::Slots(slots))
    }

    /// Lets a slave leave the cycle, or join it again: from when on its frames are expected no more, or, from its
    /// first on, again.
    pub(super) fn try_become(&mut self, name: &str, role: RoleRequest) -> Result<u32> {
        let station = self.station(name)?;
        ensure!(
            station != 0,
            "'{name}' is the lab's master, by whose time all is judged: it stays what it is"
        );
        let change = match role {
            RoleRequest::Master { .. } => bail!("a lab has one master, '{}'", self.scenario.stations[0].name),
            RoleRequest::Detached => Change::Leave,
            RoleRequest::Slave { holdover: Some(_), .. } => {
                bail!(
                    "a lab judges its stations by a holdover of {HOLDOVER_CYCLES} cycle: leave --holdover out"
                )
            }
            RoleRequest::Slave { servo: Some(_), .. } => {
                bail!("a lab's stations all follow as its file says (servo = \"...\"): leave --servo out")
            }
            RoleRequest::Slave { .. } => Change::Return,
        };
        // Who is away and is to return need not know the cycle.
        if matches!(change, Change::Leave) || !self.lab.analysis.timetable.is_away(station) {
            self.must_have_been_locked(station)?;
        }
        self.must_have_answered()?;
        self.ask(station, Request::Become(role), change)
    }

    /// Asks a station for a change. One that does not answer soon is to leave all as it is; whether it still can, its
    /// answer tells.
    pub(super) fn ask(&mut self, station: usize, request: Request, change: Change) -> Result<u32> {
        let name = self.scenario.stations[station].name.clone();
        let place = Place { lab: Some(self.home.lab.clone()), station: name.clone() };
        let mut question = control::put(&self.home.directory, &place, request, LET_IN_WITHIN)?;
        let reply = question.answer(ANSWER_WITHIN);
        match reply.with_context(|| format!("station '{name}' has not made the change"))? {
            Some(reply) => self.answered(station, change, reply),
            None => {
                question.take_back();
                self.pending = Some(Pending { station, change, question });
                let within = ANSWER_WITHIN.as_millis();
                bail!(
                    "station '{name}' has not answered within {within}ms, and is told to leave all as it is: \
                     `rtnet slot -S {place} list` tells whether it has"
                )
            }
        }
    }

    /// Looks whether a station has answered that was not waited for any longer.
    pub(super) fn take_late_answer(&mut self) {
        let Some(mut pending) = self.pending.take() else { return };
        match pending.question.answer(Duration::ZERO) {
            Ok(None) => self.pending = Some(pending),
            // Whoever asked has been told to look for himself.
            Ok(Some(reply)) => drop(self.answered(pending.station, pending.change, reply)),
            // It has ended, or hung up without looking at it: it is, or will be started, as it was.
            Err(_) => {}
        }
    }

    /// Nothing can be judged by slots that nobody knows.
    fn must_have_answered(&self) -> Result<()> {
        let Some(Pending { station, .. }) = &self.pending else { return Ok(()) };
        let (name, lab) = (&self.scenario.stations[*station].name, &self.home.lab);
        bail!(
            "station '{name}' has not said yet what became of the change before this one: ask again once it has; \
             if it is stuck, `rtnet lab restart {lab}/{name}`"
        )
    }

    /// What a station has done holds for the lab, too.
    fn answered(&mut self, station: usize, change: Change, reply: Reply) -> Result<u32> {
        let name = &self.scenario.stations[station].name;
        let from = match reply {
            Reply::Applied(from) => from,
            Reply::Refused(why) => bail!("station '{name}': {why}"),
            _ => bail!("station '{name}' answers what it was not asked"),
        };
        // One that was lost for long has no idea of the cycle any more, and changed at once.
        let current = self.lab.analysis.current().unwrap_or(from);
        let known = current.wrapping_sub(from) as i32 <= 0;
        let from = if known { from } else { current.wrapping_add(1) };
        let timetable = &mut self.lab.analysis.timetable;
        match change {
            Change::Slots(after) => {
                let slots = &mut self.scenario.stations[station].slots;
                for slot in slots.iter().filter(|slot| after.iter().all(|other| other.id != slot.id)) {
                    timetable.change(station, slot.id, None, from);
                }
                for slot in after.iter().filter(|slot| !slots.contains(slot)) {
                    timetable.change(station, slot.id, Some(*slot), from);
                }
                *slots = after;
                self.changes += 1;
                self.lab.load = load(&self.scenario, self.lab.launch.lead);
                if let Some(declared) = &mut self.lab.declared {
                    // Where it cannot be written, others see what it took before.
                    let _ = declared.change(self.lab.load);
                }
            }
            Change::Nothing => {}
            Change::Leave => timetable.leave(station, from),
            Change::Return => {
                timetable.leave(station, from);
                timetable.may_return(station);
            }
        }
        Ok(from)
    }
}
