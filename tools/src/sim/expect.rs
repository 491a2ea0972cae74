//! Whether a run shows what its scenario expects of it.

use serde::Serialize;

use super::figures::{SimFigures, Simulation};
use super::places::Places;
use crate::judge::verdict::{Reason, Weight};
use crate::report::figures::{Figures, QueueingFigures};
use crate::scenario::{Expectation, Measure, Scenario};

/// What "never" is as a figure.
pub const NEVER: i64 = i64::MAX;

impl Checked {
    /// Why a run is not as expected.
    pub fn reason(&self) -> String {
        let of = self.station.as_ref().map_or(String::new(), |name| format!(" of '{name}'"));
        let at = self.priority.map_or(String::new(), |priority| format!(" at priority {priority}"));
        format!("line {}: expected {}{of}{at}, found {}", self.line, self.expected, self.found)
    }
}

/// An expectation, and what was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Checked {
    /// The line of the file.
    pub line: usize,
    /// What was expected, as in `takeover_cycles <= 1`.
    pub expected: String,
    /// Of which station, if not of all.
    pub station: Option<String>,
    /// Of its traffic of which priority, if not of all that it sends.
    pub priority: Option<u8>,
    /// What was found.
    pub found: String,
    /// Whether that is as expected.
    pub holds: bool,
    /// Where to look first, if it is not.
    pub cycle: Option<u32>,
    /// How much that weighs.
    #[serde(skip)]
    pub weight: Weight,
}

/// What a lab can show of the expectations of its scenario: it knows nothing of what only a simulation measures.
pub fn of_lab(scenario: &Scenario, figures: &Figures) -> Vec<Checked> {
    let run = SimFigures { figures: figures.clone(), simulation: Simulation::default() };
    let shown = |expected: &&Expectation| expected.measure.is_of_labs();
    check_those(scenario, &run, &Places::default(), scenario.conditions.expectations.iter().filter(shown))
}

/// All expectations of a scenario, in the order of its file.
pub fn check(scenario: &Scenario, figures: &SimFigures, places: &Places) -> Vec<Checked> {
    check_those(scenario, figures, places, scenario.conditions.expectations.iter())
}

fn check_those<'a>(
    scenario: &Scenario,
    figures: &SimFigures,
    places: &Places,
    expectations: impl Iterator<Item = &'a Expectation>,
) -> Vec<Checked> {
    let check = |expected: &Expectation| {
        let found = figure(figures, expected);
        let holds = found.is_some_and(|found| expected.holds(found));
        Checked {
            line: expected.place.line,
            expected: expected.to_string(),
            station: expected.station.map(|station| scenario.stations[station].name.clone()),
            priority: expected.priority,
            found: found.map_or("nothing".into(), |found| match found {
                NEVER => "never".into(),
                found => expected.measure.show(found),
            }),
            holds,
            weight: weight(expected.measure),
            cycle: if holds { None } else { places.of_measure(expected) },
        }
    };
    expectations.map(check).collect()
}

/// What is not as expected counts against a run besides what does so in any.
pub fn unmet(checked: &[Checked]) -> impl Iterator<Item = Reason> {
    let unmet = checked.iter().filter(|checked| !checked.holds);
    unmet.map(|checked| Reason::new(checked.weight, checked.reason()))
}

/// No host changes a payload, and what it does is explained; it can do all else that can be expected not to be.
fn weight(measure: Measure) -> Weight {
    match measure {
        Measure::Unexplained | Measure::PayloadErrors => Weight::Wrong,
        _ => Weight::HostMay,
    }
}

/// A figure of a run; none if there was nothing to measure.
pub(super) fn figure(figures: &SimFigures, expected: &Expectation) -> Option<i64> {
    let &Expectation { measure, station, priority, .. } = expected;
    let run = &figures.figures;
    let count = |n: u64| Some(i64::try_from(n).unwrap_or(i64::MAX));
    let extreme = |summary: &crate::report::histogram::Summary| {
        Some(summary.min?.saturating_abs().max(summary.max?.saturating_abs()))
    };
    if let Some(of) = station {
        let (seen, own) = (&run.per_station[of], figures.simulation.stations.get(of));
        let queueing = || seen.queueing.iter().filter(|of| priority.is_none_or(|only| of.priority == only));
        return match measure {
            Measure::FramesSeen if priority.is_some() => count(queueing().map(|of| of.frames_seen).sum()),
            Measure::QueueingDelay | Measure::QueueingP99 | Measure::QueueRefused => {
                of_queueing(measure, queueing())
            }
            Measure::SlotsMissed => count(seen.slots_missed),
            Measure::Overruns => count(seen.overruns),
            Measure::FramesLost => count(seen.frames_lost),
            Measure::FramesSeen => count(seen.frames_seen),
            Measure::PayloadErrors => count(seen.payload_errors),
            Measure::SyncError => extreme(&seen.sync_error_ns),
            Measure::SlotError => extreme(&seen.slot_error_ns),
            Measure::Locked => Some(own?.is_locked().into()),
            Measure::Masters => Some(own?.gives_time.into()),
            Measure::Stray => count(seen.stray),
            _ => None,
        };
    }
    let simulation = &figures.simulation;
    match measure {
        Measure::Overlaps => count(run.overlaps),
        Measure::OutOfSlot => count(run.out_of_slot),
        Measure::Unexplained => count(run.unexplained),
        Measure::SlotsMissed => count(run.slots_missed),
        Measure::Overruns => count(run.overruns),
        Measure::SyncsMissing => count(run.syncs_missing),
        Measure::FramesLost => count(run.frames_lost),
        Measure::FramesSeen => count(run.frames_seen),
        Measure::PayloadErrors => count(run.payload_errors),
        Measure::Collisions => count(simulation.collisions),
        Measure::QueueFull => count(simulation.queue_full),
        Measure::Takeovers => count(run.takeovers),
        Measure::TakeoverCycles => (run.takeovers > 0).then_some(run.takeover_cycles.into()),
        Measure::RivalCycles => Some(run.rival_cycles.into()),
        Measure::RelockCycles => Some(simulation.relock_cycles.unwrap_or(NEVER)),
        Measure::Locked => count(simulation.stations.iter().filter(|own| own.is_locked()).count() as u64),
        Measure::Masters => count(simulation.stations.iter().filter(|own| own.gives_time).count() as u64),
        Measure::SyncError => extreme(&run.sync_error_ns),
        Measure::SlotError => extreme(&run.slot_error_ns),
        Measure::LatestFrame => run.latest_frame_ns,
        Measure::SmallestGap => simulation.smallest_gap_ns,
        Measure::Stray => count(run.per_station.iter().map(|seen| seen.stray).sum()),
        Measure::QueueingDelay | Measure::QueueingP99 | Measure::QueueRefused => {
            of_queueing(measure, run.queueing.iter())
        }
    }
}

/// Over these priorities: the longest, or how many were refused.
fn of_queueing<'a>(measure: Measure, mut queueing: impl Iterator<Item = &'a QueueingFigures>) -> Option<i64> {
    match measure {
        Measure::QueueingDelay => queueing.filter_map(|of| of.delay_ns.max).max(),
        Measure::QueueingP99 => queueing.filter_map(|of| of.delay_ns.p99).max(),
        _ => {
            let first = queueing.next()?.refused;
            i64::try_from(queueing.fold(first, |all, of| all + of.refused)).ok()
        }
    }
}
