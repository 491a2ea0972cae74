//! What decides on a lab that stays, so far or at its end.

use crate::control::{LabStatus, MemberStatus};
use crate::judge::outcome::counted;
use crate::judge::verdict::{Evidence, Reason, Slots, Weight, judge};
use crate::report::host::HostFacts;
use crate::report::verdict::Verdict;

/// The verdict on what it shows. Of each station: slots that it was more than a cycle late for, if nobody has stopped it.
/// Interrupted: how much of how long it was to stay.
pub fn of(
    status: &LabStatus,
    woke_late: &[Option<u64>],
    capture_failed: Option<&str>,
    interrupted: Option<&str>,
    max_miss_ppm: u32,
    host: &HostFacts,
) -> Verdict {
    let slots = status.stations.iter().zip(woke_late).map(|(station, &woke_late)| Slots {
        station: station.name.clone(),
        expected: station.frames_seen + station.slots_missed,
        seen: station.frames_seen,
        woke_late,
        is_decided: false,
    });
    let mut reasons: Vec<Reason> = status.stations.iter().flat_map(of_station).collect();
    let mut add = |n: u64, weight, what: String| {
        reasons.extend((n > 0).then(|| Reason::new(weight, what)));
    };
    add(status.unexplained, Weight::Wrong, counted(status.unexplained, "unexplained miss", "es"));
    // The host is the cause of all that has a known one.
    let of_the_medium = if status.unexplained == 0 { Weight::Short } else { Weight::Wrong };
    add(status.overlaps, of_the_medium, counted(status.overlaps, "overlap", "s"));
    add(status.out_of_slot, of_the_medium, counted(status.out_of_slot, "frame", "s") + " out of slot");
    let frames = counted(status.not_judged, "frame", "s");
    add(status.not_judged, Weight::Blind, format!("{frames} not judged"));
    reasons.extend(
        capture_failed.map(|why| Reason::new(Weight::Wrong, format!("the capture is not whole: {why}"))),
    );
    judge(
        &Evidence { interrupted: interrupted.map(str::to_owned), slots: Some(slots.collect()), reasons },
        max_miss_ppm,
        host,
    )
}

fn of_station(station: &MemberStatus) -> Vec<Reason> {
    let name = &station.name;
    let mut reasons: Vec<Reason> = absence(station).into_iter().collect();
    let mut add = |n: u64, weight, what: String| {
        reasons.extend((n > 0).then(|| Reason::new(weight, what)));
    };
    let MemberStatus { payload_errors, lost_records, frames_lost, .. } = *station;
    add(
        payload_errors,
        Weight::Wrong,
        format!("station '{name}': {}", counted(payload_errors, "payload error", "s")),
    );
    add(
        lost_records,
        Weight::Blind,
        format!("station '{name}' could not tell of {}", counted(lost_records, "event", "s")),
    );
    add(
        frames_lost,
        Weight::HostMay,
        format!("station '{name}' did not receive {}", counted(frames_lost, "frame", "s")),
    );
    reasons
}

/// Why a station is not where it should be. One that was lost for a moment is there, and its misses have their cause.
fn absence(station: &MemberStatus) -> Option<Reason> {
    let MemberStatus { name, state, .. } = station;
    let weight = match (&station.failed, state.as_str()) {
        (Some(why), _) => return Some(Reason::new(Weight::Wrong, format!("station '{name}': {why}"))),
        (None, "locked" | "holdover" | "detached") => return None,
        (None, "lost") if !station.lost => return None,
        // Whoever is late to follow a sync may be held up.
        (None, "lost" | "waiting" | "calibrating") => Weight::HostMay,
        (None, _) => Weight::Wrong,
    };
    Some(Reason::new(weight, format!("station '{name}' is {state}")))
}

#[cfg(test)]
mod tests;
