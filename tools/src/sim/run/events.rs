//! What happens to a network while it runs, as its scenario has it.

use anyhow::Result;
use rtnet::clock::True;

use super::Run;
use crate::judge::absences::Absence;
use crate::judge::clocks::set_clock;
use crate::report::figures::Role;
use crate::scenario::{Act, Happening, Part};
use crate::sim::faults;
use crate::sim::watch::Watch;
use crate::sim::world::traffic_counts;

impl Run<'_> {
    /// By how much the clock is set back that all follow: so much of the run is counted again.
    pub(super) fn set_back_by(&self, act: &Act) -> True {
        let watch = self.watch.borrow();
        self.set_back_of(act, |station| watch.analysis.has_the_time(station))
    }

    /// The same at the most, whoever has the time then.
    pub(super) fn may_set_back_by(&self, act: &Act) -> True {
        self.set_back_of(act, |station| self.scenario.stations[station].role != Role::Slave)
    }

    fn set_back_of(&self, act: &Act, moves_all: impl Fn(usize) -> bool) -> True {
        match &self.scenario.conditions.events[act.event].what {
            Happening::Clock(stations, step, ..) if stations.iter().any(|&station| moves_all(station)) => {
                (-*step).nanos().max(0) as u64
            }
            _ => 0,
        }
    }

    /// Something happens, or is over.
    pub(super) fn act(&mut self, act: &Act) -> Result<()> {
        let what = &self.scenario.conditions.events[act.event].what;
        let now = self.watch.borrow().analysis.cycle_at(act.at).unwrap_or(0);
        match what {
            Happening::Kill(stations) => {
                for &id in stations {
                    self.world.network.stop(id);
                    self.present[id] = false;
                    self.watch.borrow_mut().ended(id, now);
                }
            }
            Happening::Restart(stations) | Happening::Start(stations) => {
                for &id in stations {
                    self.restart(id, now)?;
                }
            }
            Happening::Stop(stations, _) => self.absent(stations, Absence::Stopped, act.part, now),
            Happening::Unplug(stations, _) => self.absent(stations, Absence::NoCarrier, act.part, now),
            Happening::Cut(stations, _) => {
                self.watch.borrow_mut().cut_off(if act.part == Part::Begin { stations } else { &[] }, now);
            }
            _ => {}
        }
        faults::act(&mut self.world.network, self.scenario, what, act.part);
        if let Happening::Clock(stations, step, ..) = what {
            let mut watch = self.watch.borrow_mut();
            let Watch { analysis, records, .. } = &mut *watch;
            for &id in stations {
                let clock = self.world.network.member(id).clock;
                set_clock((analysis, records), (id, clock, *step), act.at, 0);
            }
        }
        Ok(())
    }

    fn absent(&self, stations: &[usize], why: Absence, part: Part, now: u32) {
        let absences = &mut self.watch.borrow_mut().records.absences;
        for &id in stations {
            match part {
                Part::End => absences.end(id, why, now.wrapping_add(1)),
                _ => absences.begin(id, why, now),
            }
        }
    }

    /// A new process in the place of a station's; a master goes on with the grid, if there is one.
    fn restart(&mut self, id: usize, now: u32) -> Result<()> {
        let mut watch = self.watch.borrow_mut();
        let (grid, first) = (watch.analysis.grid(), watch.analysis.stations[id].beyond());
        watch.ended(id, now);
        watch.analysis.begins_anew(id);
        watch.analysis.await_again(id, now.wrapping_add(1));
        drop(watch);
        (self.present[id], self.anew[id]) = (true, true);
        // What the process before has counted goes on from 0 in this one.
        self.before[id] = std::mem::take(&mut self.before[id]) - &self.world.counted(id);
        self.world.counts[id] = traffic_counts(self.scenario, id);
        let station = self.world.station(self.scenario, id, grid, first)?;
        self.world.network.restart(id, station);
        Ok(())
    }
}
