//! What a schedule does, before anybody runs it: what is free in it, and what that absorbs; how long frames wait at the
//! worst; what is left for the VNIC. All of it is arithmetic: nothing is measured, and nothing runs.
//!
//! ```text
//!   file ──► scenario ──► plan ──► screen, svg, JSON
//!   options ─► propose ─────┘ └──► a file
//!   doctor.json ─► host ────┘
//! ```

pub mod host;
pub mod propose;
pub mod screen;
pub mod svg;
mod table;
mod vnics;
mod waits;

use rtmac::tdma::schedule::{clock_share, drift_bound, latest};
use rtmac::tdma::{DEFAULT_LEAD, HOLDOVER_CYCLES};
use rtnet::time::Span;
use serde::Serialize;

use crate::scenario::Scenario;

pub use host::{Host, OnHost};
pub use table::{BackupRow, SlotRow, TimeTable};
pub use vnics::VnicRow;
pub use waits::{RoundTrip, RoundTrips, WaitRow};

/// What files with a plan say that they are; the number changes with what is in them.
pub const KIND: &str = "rtnet plan 1";
/// How wrong a stamp may be, and how long a frame may take from a station's last look at the clock to the wire.
pub const STAMP_ERROR: Span = Span::from_nanos(1_500);
/// No clock is taken to be further from true time, however much a guard band would absorb: twice as much, from clock to clock, is what stations take
/// for possible.
pub const MAX_DRIFT_PPB: i64 = 100_000;

/// A schedule, and what it does. Times are in nanoseconds, shares from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// [`KIND`].
    pub kind: &'static str,
    /// From one cycle's start to the next.
    pub cycle_ns: i64,
    /// The Synchronisation's share of each cycle.
    pub sync_window_ns: i64,
    /// The medium's, bits per second.
    pub rate: u64,
    /// How many.
    pub stations: usize,
    /// Share of the time in which frames of full size and syncs are on the air.
    pub utilisation: f64,
    /// What is kept free behind frames, and what that absorbs.
    pub guard: Guard,
    /// When which slot is used.
    pub table: TimeTable,
    /// How long frames wait.
    pub waits: Vec<WaitRow>,
    /// Questions and their answers.
    pub round_trips: RoundTrips,
    /// What is left for what is not real-time.
    pub vnics: Vec<VnicRow>,
    /// What a host as it was measured does to it.
    pub host: Option<OnHost>,
    /// What cannot work, with the sum that shows it; nothing of a schedule that does.
    pub refused: Vec<String>,
}

/// The guard band of every slot, and the bounds within which no frame meets another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Guard {
    /// Behind each frame.
    pub band_ns: i64,
    /// Of that: for clocks, at either end.
    pub clocks_ns: i64,
    /// Of that: how late a station may still send; later it is silent.
    pub lateness_ns: i64,
    /// Rate error of each clock that the clocks' part absorbs, parts per billion, with a Synchronisation missing ...
    pub drift_ppb: i64,
    /// ... and stamps wrong by so much.
    pub stamp_error_ns: i64,
}

impl Plan {
    /// Of a scenario that can be, on hosts of which nothing is known, or as they were measured.
    pub fn of(scenario: &Scenario, host: Option<&Host>) -> Self {
        let schedule = scenario.schedule();
        let waits = waits::waits(scenario, DEFAULT_LEAD);
        let mut refused = waits::overloaded(&waits);
        let host = host.map(|host| host.holds(scenario));
        refused.extend(host.as_ref().and_then(OnHost::refused));
        Self {
            kind: KIND,
            cycle_ns: scenario.cycle.nanos(),
            sync_window_ns: scenario.sync_window.nanos(),
            rate: scenario.rate.bits_per_second(),
            stations: scenario.stations.len(),
            utilisation: schedule.utilisation(),
            guard: Guard::of(scenario),
            table: TimeTable::of(scenario, &schedule),
            round_trips: RoundTrips::of(scenario, DEFAULT_LEAD),
            vnics: vnics::vnics(scenario),
            waits,
            host,
            refused,
        }
    }

    /// Whether nothing speaks against it.
    pub fn works(&self) -> bool {
        self.refused.is_empty()
    }
}

impl Guard {
    fn of(scenario: &Scenario) -> Self {
        let (guard, stations) = (scenario.guard, scenario.stations.len());
        let clocks = clock_share(guard, stations);
        Self {
            band_ns: guard.nanos(),
            clocks_ns: clocks.nanos(),
            lateness_ns: latest(guard, stations).nanos(),
            drift_ppb: drift_bound(clocks, scenario.cycle, HOLDOVER_CYCLES as u32, STAMP_ERROR)
                .clamp(0, MAX_DRIFT_PPB),
            stamp_error_ns: STAMP_ERROR.nanos(),
        }
    }
}
