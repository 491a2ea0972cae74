//! What is looked at besides, where the report is to have pictures: whole cycles, the worst of them, and how regular frames
//! are. Bounded, however long a run is.

pub mod captures;
pub mod envelope;
pub mod regular;

use rtmac::tdma::line::next_cycle;

use super::timetable::Timetable;
use crate::scenario::{Scenario, SlotPlan};

use captures::{Captured, Captures, Finished};
use regular::{Largest, Regular};

/// What is looked at.
#[derive(Debug)]
pub struct Closely {
    /// The worst cycles.
    pub captures: Captures,
    /// How regular frames are.
    pub regular: Regular,
}

/// What is kept of cycles.
#[derive(Debug, Default)]
pub struct Cycles {
    /// The worst, worst first.
    pub worst: Vec<Shown>,
    /// The fullest in which nothing was wrong, the first of those.
    pub ordinary: Option<Shown>,
    /// In how many something was.
    pub faulty: u64,
    /// Of each, the largest difference between the slot errors of two of its frames.
    pub spread: Largest,
}

/// A cycle, with the slots that had their turn in it.
#[derive(Clone, Debug)]
pub struct Shown {
    /// What was on the air.
    pub captured: Captured,
    /// By station.
    pub slots: Vec<(usize, SlotPlan)>,
}

impl Closely {
    /// Of a scenario: nothing yet.
    pub fn of(scenario: &Scenario) -> Self {
        let slots = scenario.stations.iter().map(|station| station.slots.len()).sum();
        Self { captures: Captures::of(slots), regular: Regular::of(scenario.stations.len()) }
    }

    /// What it has kept, at the end.
    pub fn finish(self, timetable: &Timetable) -> (Cycles, Regular) {
        let Self { captures, regular } = self;
        let Finished { worst, ordinary, faulty, spread } = captures.finish();
        let stations = timetable.stations();
        let shown = |captured: Captured| {
            let cycle = captured.cycle;
            let its = |station| {
                let held =
                    timetable.ids(station).into_iter().filter_map(move |id| timetable.at(station, id, cycle));
                let has_turn = move |slot: &&SlotPlan| next_cycle(cycle, slot.phase, slot.period) == cycle;
                held.filter(has_turn).map(move |&slot| (station, slot))
            };
            Shown { slots: (0..stations).flat_map(its).collect(), captured }
        };
        let worst = worst.into_iter().map(shown).collect();
        (Cycles { worst, ordinary: ordinary.map(shown), faulty, spread }, regular)
    }
}
