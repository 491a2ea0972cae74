//! What speaks against a run of time slots.

use rtnet::time::Span;

use super::Parts;
use crate::judge::verdict::{Evidence, Reason, Slots, Weight};
use crate::report::figures::Figures;
use crate::scenario::{Expectation, Measure, Scenario};

/// The evidence on a run. Where its scenario bounds a figure, that decides instead.
pub(super) fn evidence(scenario: &Scenario, parts: &Parts, figures: &Figures) -> Evidence {
    let measured = Span::from_nanos((figures.cycles * figures.cycle_ns) as i64);
    let stations = figures.per_station.iter().zip(&parts.stations).enumerate();
    // A bound on what all stations miss bounds each one. Frames seen of all may be those of another station.
    let is_decided = |id| {
        let is_bounded = |of: &Expectation| match of.measure {
            Measure::SlotsMissed => of.station.is_none() || of.station == id,
            Measure::FramesSeen => of.station == id,
            _ => false,
        };
        bounds(scenario).any(is_bounded)
    };
    let slots = stations.map(|(id, (of, facts))| Slots {
        station: of.name.clone(),
        expected: of.frames_expected,
        seen: of.frames_seen,
        woke_late: facts.woke_late,
        is_decided: is_decided(Some(id)),
    });
    Evidence {
        interrupted: parts.interrupted.then(|| format!("{measured} of {}", scenario.duration)),
        slots: Some(slots.collect()),
        reasons: reasons(scenario, parts, figures),
    }
}

/// Whether the scenario has no bound for a figure, of this station or of all. That there are some bounds nothing.
fn is_left_open(scenario: &Scenario, measure: Measure, station: Option<usize>) -> bool {
    let decides = |of: &Expectation| of.measure == measure && (of.station.is_none() || of.station == station);
    !bounds(scenario).any(decides)
}

/// The expectations that bound a figure of all traffic.
fn bounds(scenario: &Scenario) -> impl Iterator<Item = &Expectation> {
    scenario.conditions.expectations.iter().filter(|of| of.priority.is_none() && of.is_a_bound())
}

/// What speaks against a run, but for what stations have missed and what was expected.
fn reasons(scenario: &Scenario, parts: &Parts, figures: &Figures) -> Vec<Reason> {
    let mut reasons = of_stations(scenario, parts);
    let is_left_open = |measure, station| is_left_open(scenario, measure, station);
    let mut add = |weight, what| reasons.push(Reason::new(weight, what));
    if figures.unexplained > 0 && is_left_open(Measure::Unexplained, None) {
        add(Weight::Wrong, counted(figures.unexplained, "unexplained miss", "es"));
    }
    if figures.overlaps > 0 && is_left_open(Measure::Overlaps, None) {
        add(of_the_medium(figures), counted(figures.overlaps, "overlap", "s"));
    }
    if figures.out_of_slot > 0 && is_left_open(Measure::OutOfSlot, None) {
        add(of_the_medium(figures), counted(figures.out_of_slot, "frame", "s") + " out of slot");
    }
    let all = || figures.per_station.iter().enumerate();
    let wrong = all().filter(|(of, _)| is_left_open(Measure::PayloadErrors, Some(*of)));
    let wrong = wrong.map(|(_, station)| station.payload_errors).sum::<u64>();
    if wrong > 0 {
        add(Weight::Wrong, counted(wrong, "payload error", "s"));
    }
    for (_, station) in all().filter(|(of, _)| is_left_open(Measure::FramesLost, Some(*of))) {
        let (name, n) = (&station.name, station.frames_lost - station.lost_on_purpose);
        if n > 0 {
            let (frames, were) = (counted(n, "frame", "s"), if n == 1 { "was" } else { "were" });
            add(
                Weight::HostMay,
                format!("station '{name}' did not receive {frames} that {were} on the medium"),
            );
        }
    }
    reasons.extend(of_the_observer(scenario, parts, figures));
    reasons
}

/// What stations say against themselves.
fn of_stations(scenario: &Scenario, parts: &Parts) -> Vec<Reason> {
    let mut reasons = Vec::new();
    for (station, plan) in parts.stations.iter().zip(&scenario.stations) {
        reasons.extend(station.reproach.clone());
        if station.lost_records > 0 {
            let what = format!("station '{}' could not tell of {} events", plan.name, station.lost_records);
            reasons.push(Reason::new(Weight::Blind, what));
        }
    }
    reasons
}

/// What was not seen, or not written.
fn of_the_observer(scenario: &Scenario, parts: &Parts, figures: &Figures) -> Vec<Reason> {
    let mut reasons = Vec::new();
    let mut add = |weight, what| reasons.push(Reason::new(weight, what));
    if figures.capture_dropped > 0 {
        add(Weight::Blind, format!("the observer lost {}", counted(figures.capture_dropped, "frame", "s")));
    }
    if let Some(why) = &parts.capture_failed {
        add(Weight::Wrong, format!("the capture is not whole: {why}"));
    }
    if parts.distrusted > 0 {
        let frames = counted(parts.distrusted, "frame", "s");
        add(Weight::Blind, format!("the wall clock was set during the run: {frames} not judged"));
    }
    let asked = (scenario.duration.nanos() / scenario.cycle.nanos()).max(1) as u64;
    if figures.cycles < asked && !parts.ended_early && !parts.interrupted {
        add(Weight::HostMay, format!("the syncs ended after {} of {asked} cycles", figures.cycles));
    }
    reasons
}

/// Frames where they should not be. In virtual time the file alone is the cause, and has not said so. In a lab the host is
/// the cause of all that has a known one.
fn of_the_medium(figures: &Figures) -> Weight {
    let is_of_host = !figures.host.is_virtual_time() && figures.unexplained == 0;
    if is_of_host { Weight::Short } else { Weight::Wrong }
}

/// `1 frame`, `2 frames`.
pub(crate) fn counted(n: u64, what: &str, plural: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { plural })
}

/// A station that was lost when the run ended.
pub(crate) fn not_synchronised(name: &str) -> Reason {
    Reason::new(Weight::HostMay, format!("station '{name}' was not synchronised at the end"))
}
