//! Which schedule is in use, as Synchronisations on the medium say.

use rtmac::wire::change::{ScheduleId, State, Status};
use rtnet::time::Span;

use super::Analysis;
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
    /// By what their content sums up to.
    known: Vec<(u16, Known)>,
    /// What all began with, as it was when it was left.
    first: Option<Known>,
    /// Of the last switch that nobody has been told of.
    switched: Option<Known>,
    /// How often another was switched to.
    pub changes: u64,
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

    /// A Synchronisation of `cycle` says which schedule is in use.
    pub(super) fn note_schedule(&mut self, cycle: u32, status: &Status) {
        let Status { oper, activation, state, is_sure, .. } = *status;
        if !is_sure || oper == self.schedules.in_use {
            return;
        }
        let Schedules { known, first, .. } = &self.schedules;
        let schedule = match (oper == ScheduleId::default(), first) {
            (true, Some(first)) => first.clone(),
            _ => match known.iter().find(|(sum, _)| *sum == oper.sum) {
                Some((_, schedule)) => schedule.clone(),
                None => return,
            },
        };
        if self.schedules.in_use == ScheduleId::default() {
            self.schedules.first = Some(Known { cycle: self.cycle, slots: self.timetable.now() });
        }
        let from = if state == State::Switched { activation } else { cycle };
        for (station, slots) in schedule.slots.iter().enumerate() {
            self.timetable.replace(station, slots, from);
        }
        self.run_at(schedule.cycle, from);
        self.schedules.in_use = oper;
        self.schedules.changes += 1;
        self.schedules.switched = Some(schedule);
    }
}
