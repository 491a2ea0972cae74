//! What `rtnet doctor` measured of a host, and the guard band that such a host needs: by the doctor's own predictions.
//!
//! ```text
//!   candidates of doctor.json: guard band -> how late a station may be -> the share of slots that it misses by that
//!
//!   share  |*
//!          |   *
//!          |     *  *
//!   limit  |- - - - - -*- - -    the least lateness that is allowed and misses no more than the limit
//!          |              *  *
//!          +------------------►  lateness
//! ```

use std::path::Path;

use anyhow::{Context, Result, ensure};
use rtmac::tdma::schedule::latest;
use rtnet::time::Span;
use serde::{Deserialize, Serialize};

use crate::doctor::verdict::{LOAD_MAX, MISSES_ACCEPTED, TURN_UNMEASURED};
use crate::report::text::duration;
use crate::scenario::Scenario;

/// A host as it was measured.
#[derive(Clone, Debug, PartialEq)]
pub struct Host {
    /// With the core kept warm, as the doctor recommends it.
    warm_core: bool,
    /// How late a station may be, and the share of slots that it misses then; in order.
    misses: Vec<(Span, f64)>,
    /// What a slot costs its core.
    turn: Span,
}

/// What such a host does to a schedule. Times are in nanoseconds, shares from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct OnHost {
    /// With the core kept warm.
    pub warm_core: bool,
    /// How late a station may be in this schedule.
    pub lateness_ns: i64,
    /// The share of slots that it misses then, at the most; none: less lateness than was looked at.
    pub miss_share: Option<f64>,
    /// How much is accepted.
    pub miss_accepted: f64,
    /// How late a station may have to be, to miss no more than that; none: it misses more at any that was looked at.
    pub needs_lateness_ns: Option<i64>,
    /// The guard band that gives it that.
    pub needs_guard_ns: Option<i64>,
    /// What all stations take of one core, as a lab on that host; 1 is all of it.
    pub load_as_lab: f64,
}

#[derive(Deserialize)]
struct Doctored {
    candidates: Vec<Candidate>,
    recommended: Option<Recommended>,
    wire: Option<Wire>,
}

#[derive(Deserialize)]
struct Candidate {
    warm_core: bool,
    stations: usize,
    guard_ns: i64,
    late_share: f64,
    uncertain_share: f64,
    outage_share: f64,
}

#[derive(Deserialize)]
struct Recommended {
    warm_core: bool,
}

#[derive(Deserialize)]
struct Wire {
    turn_ns: i64,
}

impl Host {
    /// As `rtnet doctor --json` has written it.
    pub fn load(path: &Path) -> Result<Self> {
        let name = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("{name} cannot be read"))?;
        let remedy = "write one with `rtnet doctor --json doctor.json`";
        let doctored = serde_json::from_str(&text)
            .with_context(|| format!("{name} is not what the doctor writes: {remedy}"))?;
        let host = Self::of(doctored);
        ensure!(!host.misses.is_empty(), "{name} has no predictions for any network: {remedy}");
        Ok(host)
    }

    fn of(Doctored { candidates, recommended, wire }: Doctored) -> Self {
        let warm_core = recommended.map_or(candidates.iter().any(|of| of.warm_core), |of| of.warm_core);
        let of_state = candidates.iter().filter(|of| of.warm_core == warm_core);
        let miss = |of: &Candidate| {
            let share = of.late_share + of.uncertain_share + of.outage_share;
            (latest(Span::from_nanos(of.guard_ns), of.stations), share.min(1.0))
        };
        let mut misses: Vec<_> = of_state.map(miss).collect();
        misses.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let turn = wire.map_or(TURN_UNMEASURED, |wire| Span::from_nanos(wire.turn_ns));
        Self { warm_core, misses, turn }
    }

    /// How late a station must be allowed to be there, to miss no more than is accepted. None: it misses more at any that was looked at.
    pub fn lateness(&self) -> Option<Span> {
        let holds = |&&(_, share): &&(Span, f64)| share <= MISSES_ACCEPTED;
        self.misses.iter().rev().take_while(holds).last().map(|&(late, _)| late)
    }

    /// The smallest guard band, in whole microseconds, by which so many stations may be that late.
    ///
    /// # Errors
    /// It misses more at any that was looked at.
    pub fn guard(&self, stations: usize) -> Result<Span> {
        let least = self.misses.iter().map(|&(_, share)| share).fold(1.0, f64::min);
        let lateness = self.lateness().with_context(|| {
            format!(
                "that host misses {} of its slots however late they may begin, and {} are accepted: `rtnet doctor` tells what \
                 would improve it, or say --guard",
                percent(least),
                percent(MISSES_ACCEPTED)
            )
        })?;
        Ok(guard_for(lateness, stations))
    }

    /// What it does to a schedule.
    pub fn holds(&self, scenario: &Scenario) -> OnHost {
        let (lateness, stations) = (scenario.latest(), scenario.stations.len());
        let slots = scenario.stations.iter().flat_map(|station| &station.slots);
        let turns: f64 = slots.map(|slot| 1.0 / f64::from(slot.period.max(1))).sum();
        let needs = self.lateness();
        OnHost {
            warm_core: self.warm_core,
            lateness_ns: lateness.nanos(),
            miss_share: self
                .misses
                .iter()
                .rev()
                .find(|&&(late, _)| late <= lateness)
                .map(|&(_, share)| share),
            miss_accepted: MISSES_ACCEPTED,
            needs_lateness_ns: needs.map(Span::nanos),
            needs_guard_ns: needs.map(|needs| guard_for(needs, stations).nanos()),
            load_as_lab: (turns + 1.0) * self.turn.nanos() as f64 / scenario.cycle.nanos() as f64,
        }
    }
}

impl OnHost {
    /// Why it does not hold the schedule, if so.
    pub fn refused(&self) -> Option<String> {
        if self.miss_share.is_some_and(|share| share <= self.miss_accepted) {
            return None;
        }
        let late = duration(self.lateness_ns.unsigned_abs());
        let misses = match self.miss_share {
            Some(share) => format!("up to {}", percent(share)),
            None => "more than was looked at".to_owned(),
        };
        let remedy = match self.needs_guard_ns {
            Some(guard) => format!("a guard band of {} would do", duration(guard.unsigned_abs())),
            None => "`rtnet doctor` tells what would improve it".to_owned(),
        };
        Some(format!(
            "such a host misses {misses} of the slots that it may begin {late} late, and {} are accepted: {remedy}",
            percent(self.miss_accepted)
        ))
    }

    /// Whether one such host has the time for all stations.
    pub fn holds_as_lab(&self) -> bool {
        self.load_as_lab <= LOAD_MAX
    }
}

/// The smallest guard band, in whole microseconds, by which so many stations may be that late.
pub(super) fn guard_for(lateness: Span, stations: usize) -> Span {
    // What clocks have of it is half of it at the most.
    let (mut low, mut high) = (0, lateness.nanos().max(0) / 500 + 1);
    while low < high {
        let middle = (low + high) / 2;
        if latest(Span::from_micros(middle), stations) >= lateness { high = middle } else { low = middle + 1 }
    }
    Span::from_micros(low)
}

/// A share in words.
pub fn percent(share: f64) -> String {
    let percent = share * 100.0;
    if percent >= 10.0 { format!("{percent:.0} %") } else { format!("{percent:.2} %") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Uniform;
    use rtmac::tdma::schedule::Rate;

    /// Eight stations; guard bands of 12, 24, 48 and 96 us allow 6, 12, 28 and 76 us.
    fn measured(shares: [f64; 4]) -> Host {
        let candidates = shares.iter().zip([12, 24, 48, 96]).flat_map(|(&late_share, guard)| {
            [(false, 1.0), (true, late_share)].map(|(warm_core, late_share)| Candidate {
                warm_core,
                stations: 8,
                guard_ns: guard * 1_000,
                late_share,
                uncertain_share: 0.0,
                outage_share: 0.0,
            })
        });
        let recommended = Some(Recommended { warm_core: true });
        Host::of(Doctored {
            candidates: candidates.collect(),
            recommended,
            wire: Some(Wire { turn_ns: 50_000 }),
        })
    }

    fn network(guard: i64) -> Scenario {
        let guard = Some(Span::from_micros(guard));
        let (cycle, duration) = (Span::from_micros(1_000), Span::from_millis(1_000));
        let rate = Rate::from_bits_per_second(1_000_000_000);
        Uniform { stations: 8, cycle, duration, payload: 64, rate, guard, seed: 1, vnic: None }
            .scenario()
            .unwrap()
    }

    #[test]
    fn the_guard_band_is_the_smallest_by_which_it_misses_few_enough_in_the_recommended_state() {
        let host = measured([0.2, 0.02, 0.004, 0.001]);
        assert_eq!(host.lateness(), Some(Span::from_micros(28)));
        assert_eq!(host.guard(8).unwrap(), Span::from_micros(48));
        assert_eq!(host.guard(32).unwrap(), Span::from_micros(56), "more stations, more for their clocks");
        let wavering = measured([0.2, 0.004, 0.02, 0.001]);
        assert_eq!(wavering.lateness(), Some(Span::from_micros(76)), "and no larger one misses more");
    }

    #[test]
    fn a_schedule_that_it_misses_too_much_of_is_refused_with_the_guard_band_that_would_do() {
        let host = measured([0.2, 0.02, 0.004, 0.001]);
        let refused = |guard| host.holds(&network(guard)).refused();
        assert_eq!(refused(48), None);
        assert_eq!(
            refused(47).unwrap(),
            "such a host misses up to 2.00 % of the slots that it may begin 27us late, and 0.50 % are accepted: a guard band of \
             48us would do"
        );
        assert!(
            refused(5)
                .unwrap()
                .contains("misses more than was looked at of the slots that it may begin 2.5us late")
        );
    }

    #[test]
    fn a_host_that_always_misses_too_many_has_no_guard_band() {
        let host = measured([0.2, 0.1, 0.06, 0.03]);
        let error = host.guard(8).unwrap_err().to_string();
        assert!(
            error.starts_with("that host misses 3.00 % of its slots however late they may begin"),
            "{error}"
        );
        let refused = host.holds(&network(90)).refused().unwrap();
        assert!(refused.ends_with("`rtnet doctor` tells what would improve it"), "{refused}");
    }

    #[test]
    fn as_a_lab_all_stations_and_the_sync_take_their_turns_on_one_core() {
        let on = measured([0.0; 4]).holds(&network(48));
        assert_eq!((on.load_as_lab, on.holds_as_lab()), (9.0 * 0.05, true));
    }
}
