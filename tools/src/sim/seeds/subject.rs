//! A file that is run with many seeds, and what one run of it has shown.

use std::path::Path;

use super::tally::{Row, Worse};
use crate::ring::{self, RingFigures};
use crate::scenario::{self, Expectation, FileError, Measure, Network, Place, Relation, Scenario};
use crate::sim::expect::figure;
use crate::sim::{self, Options, SimFigures};

/// What is shown of a network with slots besides what its file expects.
const MEASURES: [Measure; 9] = [
    Measure::SlotsMissed,
    Measure::SyncsMissing,
    Measure::Overlaps,
    Measure::OutOfSlot,
    Measure::Unexplained,
    Measure::FramesLost,
    Measure::PayloadErrors,
    Measure::SyncError,
    Measure::SlotError,
];

/// A figure of a ring: its name, whether it is a time, and its value.
type OfRing = (&'static str, bool, fn(&RingFigures) -> Option<i64>);

/// What is shown of a ring.
const OF_RINGS: [OfRing; 7] = [
    ("overlaps", false, |ring| count(ring.overlaps)),
    ("unexplained", false, |ring| count(ring.unexplained)),
    ("frames_lost", false, |ring| count(ring.frames_lost - ring.lost_on_purpose)),
    ("payload_errors", false, |ring| count(ring.payload_errors)),
    ("rotation", true, |ring| ring.rotation_ns.max),
    ("delivery", true, |ring| ring.delivery_ns.max),
    ("recovery", true, |ring| ring.recovery_ns.max),
];

fn count(n: u64) -> Option<i64> {
    Some(i64::try_from(n).unwrap_or(i64::MAX))
}

/// A file that is run with many seeds.
#[derive(Debug)]
pub struct Subject {
    /// Its name, as it was given.
    pub file: String,
    network: Network,
    figures: Vec<Expectation>,
}

/// What a run has shown.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Run {
    /// Why it failed; none: it is as expected.
    pub reasons: Vec<String>,
    /// For each of [`Subject::rows`], what was found and whether it is as expected; nothing of a run that broke off.
    pub found: Vec<(Option<i64>, bool)>,
}

impl Subject {
    /// Reads a file.
    pub fn load(file: &Path) -> Result<Self, FileError> {
        Ok(Self::new(file.display().to_string(), scenario::load_network(file)?))
    }

    /// A network under a file's name.
    pub fn new(file: String, network: Network) -> Self {
        let expected = match &network {
            Network::Slots(scenario) => &scenario.conditions.expectations[..],
            Network::Ring(_) => &[],
        };
        let is_expected = |measure| expected.iter().any(|of| of.measure == measure && of.station.is_none());
        let figures = MEASURES.into_iter().filter(|&measure| !is_expected(measure)).map(of_all).collect();
        Self { file, network, figures }
    }

    /// Lets each station miss so many of a million slots; `false`: a ring has none.
    pub fn set_max_miss(&mut self, max_miss_ppm: u32) -> bool {
        let Network::Slots(scenario) = &mut self.network else { return false };
        scenario.max_miss_ppm = max_miss_ppm;
        true
    }

    /// The seed that the file itself gives.
    pub fn own_seed(&self) -> u64 {
        match &self.network {
            Network::Slots(scenario) => scenario.seed,
            Network::Ring(ring) => ring.network.seed,
        }
    }

    /// What is kept of its runs: what its file expects, then figures.
    pub fn rows(&self) -> Vec<Row> {
        let Network::Slots(scenario) = &self.network else {
            return OF_RINGS.iter().map(|&(name, is_time, _)| Row::figure(name, is_time)).collect();
        };
        let expected = scenario.conditions.expectations.iter().map(|of| expected(scenario, of));
        let figures = self.figures.iter().map(|of| Row::figure(of.measure.name(), of.measure.is_time()));
        expected.chain(figures).collect()
    }

    /// Runs it with a seed. A run that breaks off has failed.
    pub fn run(&self, seed: u64, options: &Options) -> Run {
        let run = match self.network.clone() {
            Network::Slots(scenario) => self.run_slots(&scenario.with_seed(seed), options),
            Network::Ring(ring) => ring::run(&ring.with_seed(seed), options).map(of_ring),
        };
        run.unwrap_or_else(|error| Run::failed(format!("{error:#}")))
    }

    fn run_slots(&self, scenario: &Scenario, options: &Options) -> anyhow::Result<Run> {
        let ended = sim::run(scenario, options)?;
        let SimFigures { figures, simulation } = &ended.figures;
        let expected = scenario.conditions.expectations.iter().zip(&simulation.expectations);
        let expected = expected.map(|(of, checked)| (figure(&ended.figures, of), checked.holds));
        let shown = self.figures.iter().map(|of| (figure(&ended.figures, of), true));
        Ok(Run { found: expected.chain(shown).collect(), reasons: reasons(&figures.verdict) })
    }
}

impl Run {
    /// One that has nothing but a reason.
    pub fn failed(reason: String) -> Self {
        Self { reasons: vec![reason], found: Vec::new() }
    }
}

fn of_ring(figures: RingFigures) -> Run {
    let found = OF_RINGS.iter().map(|(.., value)| (value(&figures), true)).collect();
    Run { found, reasons: reasons(&figures.verdict) }
}

/// Why a run failed: whatever its verdict has against it, of which each expectation that does not hold is one.
fn reasons(verdict: &crate::report::figures::Verdict) -> Vec<String> {
    if verdict.ok { Vec::new() } else { verdict.reasons.clone() }
}

/// A figure of all stations, of which nothing is expected.
fn of_all(measure: Measure) -> Expectation {
    let (relation, place) = (Relation::AtMost, Place::default());
    Expectation { measure, station: None, priority: None, relation, limit: i64::MAX, place }
}

fn expected(scenario: &Scenario, of: &Expectation) -> Row {
    let worse = match of.relation {
        Relation::Equal => Worse::Further(of.limit),
        Relation::Less | Relation::AtMost => Worse::More,
        Relation::More | Relation::AtLeast => Worse::Less,
    };
    Row {
        what: of.to_string(),
        line: Some(of.place.line),
        station: of.station.map(|station| scenario.stations[station].name.clone()),
        priority: of.priority,
        worse,
        is_time: of.measure.is_time(),
    }
}
