//! The figures of a run in virtual time, as the JSON report names them.

use rtnet::discipline::SyncState;
use serde::Serialize;

use super::expect::Checked;
use crate::report::document::document;
use crate::report::figures::Figures;

/// The report of a run: that of a lab, and what only a simulation knows.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct SimFigures {
    /// As of a lab.
    #[serde(flatten)]
    pub figures: Figures,
    /// What only a simulation knows.
    pub simulation: Simulation,
}

document!(SimFigures, "sim-run", sim_run_has_its_schema);

/// What only a simulation knows.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Simulation {
    /// Everything random followed from it.
    pub seed: u64,
    /// Virtual time from the begin of the network to its end, joining included.
    pub virtual_ns: u64,
    /// Virtual time of the measurement.
    pub measured_ns: u64,
    /// Events of the scenario.
    pub events: u64,
    /// Frames on the medium, of the measurement.
    pub frames: u64,
    /// Shortest time that the medium was free between two frames.
    pub smallest_gap_ns: Option<i64>,
    /// Frames that a hub destroyed.
    pub collisions: u64,
    /// Deliveries for which a port of a switch had no room.
    pub queue_full: u64,
    /// Most frames that waited for a port of a switch at once.
    pub longest_queue: u64,
    /// Deliveries that were lost on the way.
    pub lost: u64,
    /// Deliveries that came twice.
    pub duplicated: u64,
    /// Deliveries of which a bit was changed.
    pub corrupted: u64,
    /// Deliveries that others overtook.
    pub reordered: u64,
    /// Cycles from the end of the last event until all were locked; none: they never were.
    pub relock_cycles: Option<i64>,
    /// By station, as in `per_station`.
    pub stations: Vec<SimStation>,
    /// What was expected, and what was found.
    pub expectations: Vec<Checked>,
}

/// How a station ended.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct SimStation {
    /// Its name.
    pub name: String,
    /// `locked`, `lost`, ...; `down` if it was not there. Synchronised if it was in one of the last cycles.
    pub state: String,
    /// Whether it gave the time in all of the last cycles.
    pub gives_time: bool,
    /// Frames that found its receive pool empty.
    pub dropped: u64,
}

impl SimStation {
    /// Whether it was synchronised: locked, or bridging a cycle.
    pub fn is_locked(&self) -> bool {
        [SyncState::Locked, SyncState::Holdover].iter().any(|state| state.name() == self.state)
    }
}
