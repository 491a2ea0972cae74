//! How long before their slots the stations of a lab wake.
//!
//! ```text
//!   wakes                       ready                slot                     sleeps again
//!   ├──── wake-up latency ────┬─┤ PREPARES ├── spins ──┤ sends, reads: FOLLOWS ┤
//!   └───────────────────────── lead ─────────────────────┘
//! ```
//!
//! A shorter lead leaves more of the core to others; with a longer one more frames leave on time. The lead covers 95 % of
//! the wake-ups on this core, as long as all stations take a quarter of it, and else half of the wake-ups.

use rtmac::tdma::DEFAULT_LEAD;
use rtnet::time::Span;

use super::turns::{FOLLOWS, FRAME, Turns};
use crate::report::histogram::SignedHistogram;
use crate::scenario::Scenario;
use crate::wakeups::wake_often;

/// Time from a station's wake-up until it spins: it reads Synchronisations, chooses the frame, stamps it. Measured:
/// with a lead of 15 us half of the frames leave 0.2 us late on a warm core, which wakes in 6 us.
const PREPARES: Span = Span::from_micros(9);
/// Share of their core that the stations of a lab take for a lead that covers most wake-ups.
const USUAL_SHARE: f64 = 0.25;
/// Share of their core that they may take.
const SHARE: f64 = 0.75;
/// Share of their core that they may spin for.
const SPUN: f64 = 1.0 / 3.0;
/// The shortest lead: a station still prepares its frame before its slot.
const LEAST: Span = PREPARES;
/// Distance of the wake-ups that are measured, and their number.
const PERIOD: Span = Span::from_micros(250);
const MEASURED: u64 = 800;

/// Lateness of a core's wake-ups.
#[derive(Clone, Copy, Debug)]
pub struct WakeUps {
    /// Half of them are not later.
    pub half: Span,
    /// 95 % of them are not later.
    pub most: Span,
}

impl WakeUps {
    /// Measures a core for a fifth of a second.
    pub fn measure(cpu: usize) -> Self {
        Self::of(&wake_often(cpu, PERIOD, MEASURED))
    }

    /// The quantiles of a histogram, in nanoseconds.
    pub fn of(lateness: &SignedHistogram) -> Self {
        let [half, most] = [0.5, 0.95].map(|share| Span::from_nanos(lateness.quantile(share)));
        Self { half, most }
    }
}

/// The lead of a lab's stations on a core with these wake-ups.
pub fn lead(scenario: &Scenario, wake_ups: WakeUps) -> Span {
    let turns = Turns::of(scenario);
    let cycle = scenario.cycle.nanos() as f64;
    let each = |share: f64| Span::from_nanos((share * cycle / turns.all) as i64);
    let frames = Span::from_nanos((FRAME.nanos() as f64 * turns.heard / turns.all) as i64);
    let room = |share: f64| each(share) - FOLLOWS - frames;
    let most = (wake_ups.most + PREPARES).min(room(USUAL_SHARE));
    let half = (wake_ups.half + PREPARES).min(room(SHARE));
    let spun = each(SPUN) + PREPARES;
    let apart = closest(scenario).map_or(DEFAULT_LEAD, |apart| apart - FOLLOWS);
    most.max(half).min(spun).min(apart).clamp(LEAST, DEFAULT_LEAD)
}

/// Shortest distance between two instants of the cycle: slots and the Synchronisation.
fn closest(scenario: &Scenario) -> Option<Span> {
    let slots = scenario.stations.iter().flat_map(|station| &station.slots);
    let mut instants: Vec<_> = slots.map(|slot| slot.offset).chain([Span::ZERO, scenario.cycle]).collect();
    instants.sort_unstable();
    // Stations that share a slot take turns.
    instants.dedup();
    instants.windows(2).map(|pair| pair[1] - pair[0]).min()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    /// In microseconds; half of the wake-ups are as late as `half`.
    fn of(stations: usize, cycle: &str, [half, most]: [i64; 2]) -> i64 {
        let mut text = format!("cycle = \"{cycle}\"\n");
        for station in 0..stations {
            let role = if station == 0 { "master" } else { "slave" };
            text += &format!("[[station]]\nname = \"s{station}\"\nrole = \"{role}\"\n");
        }
        let scenario = Source::new("net.toml", &text).parse().unwrap();
        lead(&scenario, wake_ups([half, most])).nanos() / 1_000
    }

    fn wake_ups(micros: [i64; 2]) -> WakeUps {
        let [half, most] = micros.map(Span::from_micros);
        WakeUps { half, most }
    }

    #[test]
    fn a_lead_is_what_wake_ups_take_where_there_is_room() {
        assert_eq!([2, 4, 8].map(|stations| of(stations, "1ms", [5, 9])), [18; 3]);
        assert_eq!(of(8, "10ms", [5, 41]), 50);
        assert_eq!(of(2, "10ms", [400, 400]), 50, "a slow core is not waited for");
    }

    #[test]
    fn most_wake_ups_are_covered_for_a_quarter_of_the_core() {
        // Nine turns of 27.8 us are a quarter of a millisecond; 17 of 24 us are 0.41 of it.
        assert_eq!([4, 8, 16].map(|stations| of(stations, "1ms", [6, 37])), [41, 18, 15]);
    }

    #[test]
    fn many_stations_share_a_core_by_shorter_leads() {
        let leads = [8, 16, 24, 32].map(|stations| of(stations, "1ms", [400; 2]));
        assert!(leads.is_sorted_by(|a, b| a > b), "{leads:?}");
        for (stations, lead) in [8, 16, 24, 32].into_iter().zip(leads) {
            let takes = (stations + 1) * (lead + FOLLOWS.nanos() / 1_000);
            assert!(takes <= 750, "{stations} stations take {takes} us of a cycle of 1 ms");
            let spin = (stations + 1) * (lead - PREPARES.nanos() / 1_000);
            assert!(spin <= 334, "{stations} stations spin for {spin} us of a cycle of 1 ms");
        }
        assert_eq!(of(60, "1ms", [400; 2]), 9, "a frame is prepared all the same");
    }

    #[test]
    fn a_lead_ends_behind_the_turn_before() {
        let text = "cycle = \"10ms\"\n[[station]]\nname = \"m\"\nrole = \"master\"\nslots = [{ id = 0, offset = \"1ms\" }]\n\
                    [[station]]\nname = \"s\"\nrole = \"slave\"\nslots = [{ id = 0, offset = \"1030us\" }]\n";
        let scenario = Source::new("net.toml", text).parse().unwrap();
        assert_eq!(lead(&scenario, wake_ups([400; 2])).nanos(), 21_000);
    }
}
