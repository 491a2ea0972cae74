//! What decides on a ring: nothing is unexplained or lost, and everything was within its bound, which is for hosts that are in
//! time.

use rtnet::time::Span;

use super::figures::{Known, RingFigures};
use super::judge::Judged;
use crate::judge::outcome::counted;
use crate::judge::verdict::{Evidence, Reason, Weight, judge};
use crate::report::text::grouped;
use crate::report::verdict::Verdict;
use crate::scenario::{MAX_MISS_PPM, RingScenario};

/// What is known of the observer besides what it saw.
#[derive(Debug, Default)]
pub struct Observed {
    /// Frames that it lost.
    pub dropped: u64,
    /// Why what was to be captured is not whole.
    pub capture_failed: Option<String>,
    /// Somebody ended the run before its time.
    pub interrupted: bool,
}

/// The verdict on a ring whose figures are all there. It has no slots, so that none can be missed.
pub fn of(
    scenario: &RingScenario,
    judged: &Judged,
    known: &[Known],
    seen: &Observed,
    figures: &RingFigures,
) -> Verdict {
    let mut reasons: Vec<Reason> = known.iter().filter_map(|known| known.reproach.clone()).collect();
    let mut add = |is_so: bool, weight, what: String| {
        reasons.extend(is_so.then(|| Reason::new(weight, what)));
    };
    let lost = figures.frames_lost - figures.lost_on_purpose;
    add(figures.frames_seen == 0, Weight::Wrong, "nobody sent anything".into());
    add(figures.unexplained > 0, Weight::Wrong, format!("{} unexplained", figures.unexplained));
    let errors = counted(figures.payload_errors, "payload error", "s");
    add(figures.payload_errors > 0, Weight::Wrong, errors);
    let frames = counted(lost, "frame", "s");
    add(
        lost > 0,
        Weight::HostMay,
        format!("of what was on the medium, {frames} did not reach their receiver"),
    );
    for what in hardly_seen(figures, known) {
        add(true, Weight::HostMay, what);
    }
    // Who was later than a host may be has cost more than the bounds say.
    if judged.seats.iter().all(|seat| seat.late == 0) {
        if let Some((longest, bound)) = judged.undisturbed {
            let what = format!("a round took {longest}, and {bound} at the most were promised");
            add(longest > bound, Weight::Wrong, what);
        }
        let beyond = judged.recoveries.iter().filter(|of| of.took() > of.bound(&scenario.ring));
        if let Some(of) = beyond.max_by_key(|of| of.took()) {
            let (took, bound) = (of.took(), of.bound(&scenario.ring));
            let what = format!("the token was back after {took}, and {bound} at the most were promised");
            add(true, Weight::Wrong, what);
        }
    }
    let dropped = counted(seen.dropped, "frame", "s");
    add(seen.dropped > 0, Weight::Blind, format!("the observer lost {dropped}"));
    if let Some(why) = &seen.capture_failed {
        add(true, Weight::Wrong, format!("the capture is not whole: {why}"));
    }
    let measured = Span::from_nanos(figures.measured_ns as i64);
    let interrupted = seen.interrupted.then(|| format!("{measured} of {}", scenario.network.duration));
    let evidence = Evidence { interrupted, slots: None, reasons };
    judge(&evidence, MAX_MISS_PPM, &figures.host)
}

/// Stations that were there all the while and were not seen, or had the token less than half as often as another.
fn hardly_seen<'a>(figures: &'a RingFigures, known: &'a [Known]) -> impl Iterator<Item = String> + 'a {
    let most = figures.per_station.iter().map(|station| station.visits).max().unwrap_or(0);
    let there = figures.per_station.iter().zip(known).filter(|(_, known)| known.throughout);
    there.filter(|_| figures.frames_seen > 0).filter_map(move |(station, _)| {
        let (name, visits) = (&station.name, station.visits);
        if station.frames_seen == 0 {
            return Some(format!("station '{name}' was never seen"));
        }
        let times =
            || format!("station '{name}' had the token {} times of {}", grouped(visits), grouped(most));
        (visits * 2 < most).then(times)
    })
}

/// One that was there, and was not in the ring.
pub fn no_part(name: &str) -> Reason {
    Reason::new(Weight::HostMay, format!("station '{name}' had no part in the ring at the end"))
}
