//! Which schedule is in use, as Synchronisations on the medium say.

use rtmac::wire::change::{ScheduleId, State, Status};
use rtnet::time::Span;

use super::Analysis;
use crate::judge::timetable::before;
use crate::scenario::SlotPlan;

/// A schedule that may be in use.
#[derive(Clone, Debug)]
pub struct Known {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// Every station's slots.
    pub slots: Vec<Vec<SlotPlan>>,
}

/// The schedules that may be in use, and the one that is.
#[derive(Debug, Default)]
pub struct Schedules {
    in_use: ScheduleId,
    /// The one that is sealed, so that it is in use from a cycle on, whether or not that one's Synchronisation is on the medium.
    to_come: Option<(ScheduleId, u32)>,
    /// By what their content sums up to.
    known: Vec<(u16, Known)>,
    /// What all began with, as it was when it was left.
    first: Option<Known>,
    /// Of the last switch that nobody has been told of.
    switched: Option<Known>,
    /// How often another was switched to.
    pub changes: u64,
}

impl Schedules {
    fn find(&self, id: ScheduleId) -> Option<&Known> {
        match id == ScheduleId::default() {
            true => self.first.as_ref(),
            false => self.known.iter().find(|(sum, _)| *sum == id.sum).map(|(_, schedule)| schedule),
        }
    }
}

impl Analysis {
    /// Stations may switch to this.
    pub fn may_switch(&mut self, sum: u16, schedule: Known) {
        let known = &mut self.schedules.known;
        known.retain(|(other, _)| *other != sum);
        known.push((sum, schedule));
    }

    /// What stations have switched to since this was asked last.
    pub fn take_switch(&mut self) -> Option<Known> {
        self.schedules.switched.take()
    }

    /// Schedules that were switched to.
    pub fn changes(&self) -> u64 {
        self.schedules.changes
    }

    /// A Synchronisation of `cycle` says which schedule is in use, or will be.
    pub(super) fn note_schedule(&mut self, cycle: u32, status: &Status) {
        let Status { oper, admin, activation, state, is_sure } = *status;
        if !is_sure {
            return;
        }
        let Schedules { in_use, to_come, .. } = self.schedules;
        if oper != in_use {
            let from = if state == State::Switched { activation } else { cycle };
            let is_planned = to_come.is_some_and(|(id, _)| id == oper);
            if is_planned || self.plan(oper, from) {
                self.switched(oper);
            }
        } else if to_come.is_some_and(|(_, at)| !before(cycle, at)) {
            // Nobody who knew of it is left.
            self.plan(in_use, cycle);
            self.schedules.to_come = None;
        } else if state == State::Sealed && to_come.is_none() && self.plan(admin, activation) {
            self.schedules.to_come = Some((admin, activation));
        }
    }

    /// From a cycle on a schedule is in use, if it is known.
    fn plan(&mut self, id: ScheduleId, from: u32) -> bool {
        if self.schedules.in_use == ScheduleId::default() && self.schedules.to_come.is_none() {
            self.schedules.first = Some(Known { cycle: self.cycle, slots: self.timetable.now() });
        }
        let Some(Known { cycle, slots }) = self.schedules.find(id).cloned() else { return false };
        for (station, slots) in slots.iter().enumerate() {
            self.timetable.replace(station, slots, from);
        }
        self.run_at(cycle, from);
        true
    }

    fn switched(&mut self, to: ScheduleId) {
        let schedules = &mut self.schedules;
        (schedules.in_use, schedules.to_come) = (to, None);
        schedules.changes += 1;
        schedules.switched = schedules.find(to).cloned();
        self.cycle = schedules.switched.as_ref().map_or(self.cycle, |schedule| schedule.cycle);
    }
}
