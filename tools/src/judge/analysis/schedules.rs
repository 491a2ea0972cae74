//! Which schedule is in use, as Synchronisations on the medium say.

use rtmac::wire::change::{ScheduleId, State, Status};

use super::Analysis;
use crate::scenario::SlotPlan;

/// The schedules that may be in use, and the one that is.
#[derive(Debug, Default)]
pub struct Schedules {
    in_use: ScheduleId,
    /// By what their content sums up to: every station's slots.
    known: Vec<(u16, Vec<Vec<SlotPlan>>)>,
    /// What all began with, as it was when it was left.
    first: Option<Vec<Vec<SlotPlan>>>,
    /// Of the last switch that nobody has been told of.
    switched: Option<Vec<Vec<SlotPlan>>>,
    /// How often another was switched to.
    pub changes: u64,
}

impl Analysis {
    /// Stations may switch to these slots, station by station.
    pub fn may_switch(&mut self, sum: u16, slots: Vec<Vec<SlotPlan>>) {
        let known = &mut self.schedules.known;
        known.retain(|(other, _)| *other != sum);
        known.push((sum, slots));
    }

    /// The slots that stations have switched to since this was asked last.
    pub fn take_switch(&mut self) -> Option<Vec<Vec<SlotPlan>>> {
        self.schedules.switched.take()
    }

    /// Schedules that were switched to.
    pub fn changes(&self) -> u64 {
        self.schedules.changes
    }

    /// A Synchronisation of `cycle` says which schedule is in use.
    pub(super) fn note_schedule(&mut self, cycle: u32, status: &Status) {
        let Status { oper, activation, state, .. } = *status;
        if state == State::Unsure || oper == self.schedules.in_use {
            return;
        }
        let Schedules { known, first, .. } = &self.schedules;
        let slots = match (oper == ScheduleId::default(), first) {
            (true, Some(first)) => first.clone(),
            _ => match known.iter().find(|(sum, _)| *sum == oper.sum) {
                Some((_, slots)) => slots.clone(),
                None => return,
            },
        };
        if self.schedules.in_use == ScheduleId::default() {
            self.schedules.first = Some(self.timetable.now());
        }
        let from = if state == State::Switched { activation } else { cycle };
        for (station, slots) in slots.iter().enumerate() {
            self.timetable.replace(station, slots, from);
        }
        self.schedules.in_use = oper;
        self.schedules.changes += 1;
        self.schedules.switched = Some(slots);
    }
}
