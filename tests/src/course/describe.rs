//! A case in words, for one that fails.

use super::Course;
use crate::networks::Plan;

/// Of a case that fails so many of the last events are told.
const EVENTS_TOLD: usize = 40;

impl Course<'_> {
    /// What it is, what happened to it, and what the stations told of last.
    pub(super) fn describe(&self) -> String {
        let scenario = &self.case.plan.scenario;
        let mut text = format!(
            "  cycle {}, sync window {}, guard band {}, backups {:?}, another master's delay: {:?}\n",
            scenario.cycle,
            scenario.sync_window,
            scenario.guard,
            self.case.plan.backups,
            self.case.plan.follow.on_master_change
        );
        let Plan { first_cycle, without_filter, follow, .. } = &self.case.plan;
        let holdover = follow.holdover;
        text += &format!(
            "  bridges {holdover}, from cycle {first_cycle:?}, without a filter {without_filter:?}\n"
        );
        for (id, station) in scenario.stations.iter().enumerate() {
            let slots: Vec<_> = station.slots.iter().map(|s| (s.id, s.offset, s.phase, s.period)).collect();
            let (rounds, drift, host) = (station.rounds, station.clock_drift_ppb, &self.case.hosts[id].wake);
            let member = self.members[id];
            text += &format!(
                "  {id}, now {member:?}: {rounds} rounds, {drift} ppb, wakes in {host:?}, {slots:?}\n"
            );
        }
        for fault in &self.case.faults {
            text += &format!("  {fault:?}\n");
        }
        let master = self.beliefs.masters().next();
        for (id, member) in self.there() {
            let (state, mastery) = (self.lab.state(member), self.lab.status(member).mastery);
            let later =
                master.zip(self.beliefs.of(id)).and_then(|(master, of)| self.beliefs.later(of, master));
            text += &format!("  {id}: {state:?}, {mastery:?}, later than the master by {later:?}\n");
        }
        let events = &self.lab.events;
        for (member, event) in &events[events.len().saturating_sub(EVENTS_TOLD)..] {
            text += &format!("  {member}: {event:?}\n");
        }
        text
    }
}
