//! The first part of a lab's run: its stations are started, become locked, and their clocks settle.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};

use super::launch::{Resume, arguments};
use super::load::calibrating_at_once;
use super::members::Member;
use super::processes::Process;
use super::run::{Lab, SETTLE_CYCLES};
use crate::report::verdict::Interrupted;
use crate::scenario::Scenario;

/// Cycles that a lab waits at the most for clocks to settle once all stations are locked: at 1 ms they take some 1300, at 5 ms some 500.
const SETTLE_WITHIN: u32 = 3_000;
const SETTLE_AT_MOST: Duration = Duration::from_secs(7);
/// Longest time until a station's first report: its program comes from a disk, and its sockets wait for the kernel's lock of all
/// networks, which others may hold for seconds. A station that has died is seen at once.
pub const START_WITHIN: Duration = Duration::from_secs(30);
/// Longest time from a step of any station to the next one's lock, in addition to calibration.
const LOCK_WITHIN: Duration = Duration::from_secs(5);
/// A calibration round takes two periods of the slot; this multiple of that time is allowed.
const CALIBRATION_ALLOWANCE: u32 = 3;

/// The time since the last step of any station: a slow host takes long for all stations together.
#[derive(Debug, Default)]
pub struct Steps {
    count: usize,
    /// When the last was seen, since the start.
    last: Duration,
}

impl Steps {
    /// The time without a step, where `count` have been seen by `now`.
    pub fn pause(&mut self, count: usize, now: Duration) -> Duration {
        if count != self.count {
            (self.count, self.last) = (count, now);
        }
        now - self.last
    }
}

impl Lab {
    /// Starts the stations, and waits until every one has been locked.
    pub(super) fn join(&mut self, scenario: &Scenario) -> Result<()> {
        let at_once = calibrating_at_once(scenario, self.launch.lead);
        let rounds = scenario.stations.iter().map(|station| {
            let period = station.slots.iter().map(|slot| slot.period).max().unwrap_or(1);
            station.rounds.saturating_mul(2).saturating_mul(period)
        });
        let cycles = rounds.max().unwrap_or(0).saturating_mul(CALIBRATION_ALLOWANCE);
        let cycle = Duration::from_nanos(scenario.cycle.nanos() as u64);
        let lock_within = LOCK_WITHIN + cycle.saturating_mul(cycles.saturating_add(SETTLE_CYCLES));
        let (begun, mut steps) = (Instant::now(), Steps::default());
        while !self.members.iter().all(Member::has_joined) {
            self.start_some(scenario, at_once)?;
            self.look();
            self.fail_early(scenario)?;
            let joined = self.members.iter().filter(|member| member.has_joined()).count();
            if self.interrupted.load(Ordering::Relaxed) {
                let all = self.members.len();
                bail!(Interrupted(format!("{joined} of {all} stations were locked")));
            }
            let pause = steps.pause(self.members.iter().map(Member::steps).sum(), begun.elapsed());
            if let Some(why) = self.late(scenario, pause, lock_within) {
                bail!(why);
            }
            self.show_progress(|| format!("{joined} of {} stations locked", scenario.stations.len()));
        }
        Ok(())
    }

    /// The first station that has taken too long, if there has been no step for too long: what to do about it.
    fn late(&self, scenario: &Scenario, pause: Duration, lock_within: Duration) -> Option<String> {
        let starting = self.members.iter().position(Member::is_starting);
        if pause <= if starting.is_some() { START_WITHIN } else { lock_within } {
            return None;
        }
        let station = starting.or_else(|| self.members.iter().position(|member| !member.has_joined()))?;
        let (name, state) = (&scenario.stations[station].name, self.members[station].state());
        Some(match starting {
            Some(_) => format!(
                "station '{name}' has not started within {START_WITHIN:?}: this host's disk or kernel is too busy"
            ),
            None => format!(
                "station '{name}' is not locked to the master in time ({state}): a longer --cycle or --guard gives a busy \
                 host more room"
            ),
        })
    }

    /// Starts stations in their order, while fewer than `at_once` calibrate.
    fn start_some(&mut self, scenario: &Scenario, at_once: usize) -> Result<()> {
        let is_joining = |member: &&Member| member.process.is_some() && !member.has_joined();
        let joining = self.members.iter().filter(is_joining).count();
        let waiting = self.members.iter_mut().enumerate().filter(|(_, member)| member.process.is_none());
        for (station, member) in waiting.take(at_once.saturating_sub(joining)) {
            let arguments = arguments(scenario, station, &self.launch, &Resume::default())?;
            member.process =
                Some(Process::start(&member.namespace, station, &arguments, self.teller.clone())?);
        }
        Ok(())
    }

    /// Waits until the clocks of all stations are as near the master's as they come, for a limited time: a host may be too
    /// busy, and that belongs to what is measured.
    pub(super) fn settle(&mut self, scenario: &Scenario) {
        let cycle = Duration::from_nanos(scenario.cycle.nanos() as u64);
        let deadline = Instant::now() + cycle.saturating_mul(SETTLE_WITHIN).min(SETTLE_AT_MOST);
        while !self.members.iter().all(Member::is_settled) && Instant::now() < deadline {
            self.look();
            if self.interrupted.load(Ordering::Relaxed) || self.members.iter().any(|member| member.ended) {
                break;
            }
            let (settled, all) =
                (self.members.iter().filter(|member| member.is_settled()).count(), self.members.len());
            self.show_progress(|| format!("clocks of {settled} of {all} stations settled"));
        }
        let unsettled =
            self.members.iter().zip(&scenario.stations).filter(|(member, _)| !member.is_settled());
        let names: Vec<_> = unsettled.map(|(_, plan)| plan.name.as_str()).collect();
        if !names.is_empty() {
            self.notes
                .push(format!("clocks had not settled when the measurement began: {}", names.join(", ")));
        }
    }

    /// A station that cannot be what it is to be ends the run before it begins.
    fn fail_early(&mut self, scenario: &Scenario) -> Result<()> {
        for (station, member) in self.members.iter().enumerate() {
            let name = &scenario.stations[station].name;
            if let Some(why) = &member.failed {
                bail!("station '{name}': {why}");
            }
            if member.ended {
                bail!("station '{name}' ended before the network was up; its own message is above");
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_step_of_a_station_restarts_the_time() {
        let at = Duration::from_millis;
        let mut steps = Steps::default();
        assert_eq!(steps.pause(0, at(4_000)), at(4_000), "none has been seen");
        assert_eq!(steps.pause(1, at(5_000)), at(0));
        assert_eq!(steps.pause(1, at(9_000)), at(4_000));
        assert_eq!(steps.pause(3, at(9_500)), at(0));
        // One that has gone is a change, too.
        assert_eq!(steps.pause(2, at(9_900)), at(0));
    }
}
