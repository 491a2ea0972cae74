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
use rtnet::wire::ethernet;
use serde::Serialize;

use crate::report::document::document;
use crate::report::text::duration;
use crate::scenario::Scenario;

pub use crate::scenario::STAMP_ERROR;
pub use host::{Host, OnHost};
pub use table::{BackupRow, SlotRow, TimeTable};
pub use vnics::VnicRow;
pub use waits::{RoundTrip, RoundTrips, WaitRow};

/// How late a host must be allowed to be of which nothing is known: a thread on a core of its own wakes up to 12.6 us late in
/// 99 of 100 cycles where that core goes idle, and within 0.1 us where it does not.
pub const LATENESS_LEAST: Span = Span::from_micros(10);
/// No clock is taken to be further from true time, however much a guard band would absorb: twice as much, from clock to clock, is what stations take
/// for possible.
pub const MAX_DRIFT_PPB: i64 = 100_000;

/// Usual quartz clocks drift by up to that.
const QUARTZ_PPB: i64 = 50_000;

/// A schedule, and what it does. Times are in nanoseconds, shares from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Plan {
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
    /// What works, but on few hosts.
    pub warned: Vec<String>,
}

document!(Plan, "plan", plan_has_its_schema);

/// The guard band of every slot, and the bounds within which no frame meets another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
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
    /// The smallest guard band that leaves hosts what they need, if nothing is known of them.
    pub least_ns: i64,
    /// Whether the clocks' part absorbs what stamps are wrong by.
    #[serde(skip)]
    absorbs_stamps: bool,
}

impl Plan {
    /// Of a scenario that can be, on hosts of which nothing is known, or as they were measured.
    pub fn of(scenario: &Scenario, host: Option<&Host>) -> Self {
        let schedule = scenario.schedule();
        let waits = waits::waits(scenario, DEFAULT_LEAD);
        let guard = Guard::of(scenario);
        let mut refused = waits::overloaded(&waits);
        let host = host.map(|host| host.holds(scenario));
        refused.extend(sync_meets_slot(scenario));
        refused.extend(guard.refused());
        refused.extend(host.as_ref().and_then(OnHost::refused));
        // What a host was measured to do goes before what hosts usually do.
        let warned = guard.warned(scenario.cycle).filter(|_| host.is_none() && refused.is_empty());
        Self {
            cycle_ns: scenario.cycle.nanos(),
            sync_window_ns: scenario.sync_window.nanos(),
            rate: scenario.rate.bits_per_second(),
            stations: scenario.stations.len(),
            utilisation: schedule.utilisation(),
            guard,
            table: TimeTable::of(scenario, &schedule),
            round_trips: RoundTrips::of(scenario, DEFAULT_LEAD),
            vnics: vnics::vnics(scenario),
            waits,
            host,
            refused,
            warned: warned.into_iter().collect(),
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
        let drift = drift_bound(clocks, scenario.cycle, HOLDOVER_CYCLES as u32, STAMP_ERROR);
        Self {
            band_ns: guard.nanos(),
            clocks_ns: clocks.nanos(),
            lateness_ns: latest(guard, stations).nanos(),
            drift_ppb: drift.clamp(0, MAX_DRIFT_PPB),
            stamp_error_ns: STAMP_ERROR.nanos(),
            least_ns: host::guard_for(LATENESS_LEAST, stations).nanos(),
            absorbs_stamps: drift >= 0,
        }
    }

    /// Why frames meet whatever hosts do, if so.
    fn refused(&self) -> Option<String> {
        let [band, clocks, least, stamp] =
            [self.band_ns, self.clocks_ns, self.least_ns, self.stamp_error_ns].map(time);
        (!self.absorbs_stamps).then(|| {
            format!(
                "a guard band of {band} has {clocks} at either end for clocks, and the stamps of a sync are wrong by up to \
                 {stamp} each: a frame may leave its slot whatever hosts do; a guard band of {least} would do"
            )
        })
    }

    /// Why few hosts hold it, if so, or few clocks.
    fn warned(&self, cycle: Span) -> Option<String> {
        let [band, clocks, least, left] =
            [self.band_ns, self.clocks_ns, self.least_ns, self.lateness_ns].map(time);
        if self.lateness_ns < LATENESS_LEAST.nanos() {
            return Some(format!(
                "a guard band of {band} less {clocks} at either end leaves hosts {left}, and one of which nothing is known is \
                 taken to be {LATENESS_LEAST} late: a guard band of {least} would do; --host decides by what `rtnet doctor \
                 --json` has measured"
            ));
        }
        let [ppm, usual] = [self.drift_ppb, QUARTZ_PPB].map(|ppb| ppb as f64 / 1e3);
        (self.drift_ppb < QUARTZ_PPB).then(|| {
            let shorter = time(cycle.nanos() / QUARTZ_PPB * self.drift_ppb);
            format!(
                "a guard band of {band} has {clocks} at either end for clocks, which in a cycle of {cycle} absorb a drift of \
                 {ppm} ppm, and usual clocks drift by up to {usual} ppm: a cycle of {shorter} would do, or a longer guard band"
            )
        })
    }
}

/// Why a sync meets the first slot's frame whatever hosts do, if so.
fn sync_meets_slot(scenario: &Scenario) -> Option<String> {
    let air = scenario.rate.air_time(ethernet::MIN_FRAME);
    let slots =
        scenario.stations.iter().flat_map(|station| station.slots.iter().map(move |slot| (station, slot)));
    let (station, first) = slots.min_by_key(|(_, slot)| slot.offset)?;
    let least = air + STAMP_ERROR;
    (first.offset < least).then(|| {
        format!(
            "slot {} of {} begins at {}, and a sync is on the air for {air} and takes up to {STAMP_ERROR} to leave: they may \
             meet whatever hosts do; let the slot begin at {least} or later",
            first.id, station.name, first.offset
        )
    })
}

/// A time as a person reads it.
fn time(ns: i64) -> String {
    if ns < 0 { format!("-{}", time(-ns)) } else { duration(ns.unsigned_abs()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    /// Three stations of 64 bytes in 1 ms, with this guard band.
    fn plan(guard: &str, host: Option<&Host>) -> Plan {
        let slaves =
            "[[station]]\nname = \"a\"\nrole = \"slave\"\n[[station]]\nname = \"b\"\nrole = \"slave\"\n";
        let text = format!(
            "cycle = \"1ms\"\nguard = \"{guard}\"\n[[station]]\nname = \"m\"\nrole = \"master\"\n{slaves}"
        );
        Plan::of(&Source::new("net.toml", &text).parse().unwrap(), host)
    }

    #[test]
    fn guard_band_below_the_stamps_error_is_refused() {
        // At either end a quarter is for clocks: 3.002us are needed, two stamps and rounding, so 12.008us in all.
        for (guard, works) in [("0us", false), ("184ns", false), ("12.004us", false), ("12.008us", true)] {
            assert_eq!(plan(guard, None).works(), works, "{guard}");
        }
        let refused = plan("184ns", None).refused;
        let expected = "a guard band of 184ns has 46ns at either end for clocks, and the stamps of a sync are wrong by up to \
                        1.5us each: a frame may leave its slot whatever hosts do; a guard band of 20us would do";
        assert_eq!(refused, [expected]);
        assert_eq!(plan("184ns", None).warned, [""; 0], "it is refused");
    }

    #[test]
    fn guard_band_that_leaves_hosts_little_is_warned_of() {
        // Half of it is for hosts, up to 20us.
        for (guard, warned) in [("12.008us", 1), ("19.9us", 1), ("20us", 0), ("200us", 0)] {
            let plan = plan(guard, None);
            assert_eq!((plan.warned.len(), plan.works()), (warned, true), "{guard}: {:?}", plan.warned);
        }
        let warned = &plan("15us", None).warned[0];
        assert!(
            warned.starts_with("a guard band of 15us less 3.75us at either end leaves hosts 7.5us, and"),
            "{warned}"
        );
    }

    #[test]
    fn guard_band_too_short_for_long_cycles_is_warned_of() {
        let long = |cycle: &str| {
            let text = format!(
                "cycle = \"{cycle}\"\nguard = \"20us\"\n[[station]]\nname = \"m\"\nrole = \"master\"\n[[station]]\nname = \
                 \"a\"\nrole = \"slave\"\n"
            );
            Plan::of(&Source::new("net.toml", &text).parse().unwrap(), None).warned
        };
        assert_eq!(long("15ms"), [""; 0]);
        let warned = &long("1s")[0];
        let expected = "a guard band of 20us has 5us at either end for clocks, which in a cycle of 1s absorb a drift of 0.799 \
                        ppm, and usual clocks drift by up to 50 ppm: a cycle of 15.98ms would do, or a longer guard band";
        assert_eq!(warned, expected);
    }

    #[test]
    fn slot_that_a_sync_reaches_is_refused() {
        // A sync is on the air for 67.2us, and takes up to 1.5us to leave.
        let first = |offset: &str| {
            let text = format!(
                "cycle = \"2ms\"\nrate = \"10M\"\nsync_window = \"67200ns\"\nguard = \"20us\"\n[[station]]\nname = \"m\"\nrole \
                 = \"master\"\nslots = [{{ id = 0, offset = \"{offset}\" }}]\n[[station]]\nname = \"a\"\nrole = \
                 \"slave\"\nslots = [{{ id = 0, offset = \"1ms\" }}]\n"
            );
            Plan::of(&Source::new("net.toml", &text).parse().unwrap(), None).refused
        };
        assert_eq!(first("68700ns"), [""; 0]);
        let expected = "slot 0 of m begins at 68.699us, and a sync is on the air for 67.2us and takes up to 1.5us to leave: they \
                        may meet whatever hosts do; let the slot begin at 68.7us or later";
        assert_eq!(first("68699ns"), [expected]);
    }

    #[test]
    fn measured_host_decides_alone_what_it_needs() {
        let dir = tempfile::tempdir().unwrap();
        let doctored = |share: f64| {
            let path = dir.path().join("doctor.json");
            // With 8 stations a guard band of 12us allows 6us.
            let text = format!(
                "{{\"candidates\": [{{\"warm_core\": true, \"stations\": 8, \"guard_ns\": 12000, \"late_share\": {share}, \
                 \"uncertain_share\": 0.0, \"outage_share\": 0.0}}], \"recommended\": null, \"wire\": null}}"
            );
            std::fs::write(&path, text).unwrap();
            Host::load(&path).unwrap()
        };
        let good = plan("15us", Some(&doctored(0.001)));
        assert_eq!((good.works(), good.warned.len()), (true, 0), "{:?}", good.refused);
        let bad = plan("200us", Some(&doctored(0.1)));
        assert!(
            bad.refused[0].starts_with("such a host misses up to 10 % of the slots"),
            "{:?}",
            bad.refused
        );
    }
}
