//! The figures of an observation, as the JSON report names them.
//!
//! The order of the fields is the order in the report. Times are integers in nanoseconds.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::ear::Ear;
use super::line::Line;
use super::tally::{Tally, Which};
use crate::report::document::document;
use crate::report::histogram::{SignedHistogram, Summary};
use crate::report::host::HostFacts;

/// How far a kernel's software stamp on a bridge may be from the frame's moment on the medium: it is taken in the
/// sender's context, before or after other work of the same interrupt.
pub const STAMP_ERROR_NS: u64 = 1_000;

/// A whole observation.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct JitterFigures {
    /// The interface that was listened on.
    pub interface: String,
    /// The lab whose bridge that is.
    pub lab: Option<String>,
    /// How long.
    pub observed_ns: u64,
    /// From one cycle's start to the next; none if no two syncs of neighbouring cycles were heard.
    pub cycle_ns: Option<u64>,
    /// How much faster the master's clock runs than this host's, in 10^-9; none before 64 syncs.
    pub clock_drift_ppb: Option<i64>,
    /// Frames.
    pub frames: u64,
    /// Frames by kind.
    pub kinds: BTreeMap<String, u64>,
    /// Cycle numbers between the first sync and the last that had none.
    pub sync_gaps: u64,
    /// Syncs whose cycle number does not follow the one before.
    pub syncs_repeated: u64,
    /// Syncs of cycles that cannot have begun yet.
    #[serde(default)]
    pub syncs_implausible: u64,
    /// Two frames on the air at once, at the medium's rate.
    pub overlaps: u64,
    /// Bits per second for which overlaps are counted.
    pub rate: u64,
    /// Frames that the ring lost, so that nothing is known of them.
    pub dropped_by_ring: u64,
    /// Steps of this host's wall clock.
    pub clock_steps: u64,
    /// How often the time line was given up for another.
    pub line_restarts: u64,
    /// Frames that came when there was no line, or no stamp to be trusted.
    pub not_judged: u64,
    /// Frames of stations or kinds beyond those that are told apart.
    pub frames_beyond: u64,
    /// How exact the observer's own stamps are.
    pub stamp_error_ns: u64,
    /// (t(n) - t(n-1)) - T, T from sched_xmit.
    pub sync_period_jitter_ns: Summary,
    /// Syncs, and each slot of the stations whose frames say when they were scheduled.
    pub slots: Vec<SlotFigures>,
    /// Each station's other frames.
    pub others: Vec<OtherFigures>,
    /// Where it took place.
    pub host: HostFacts,
}

document!(JitterFigures, "jitter", jitter_has_its_schema);

/// A station's syncs, or its frames in one slot.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct SlotFigures {
    /// Its address.
    pub source: String,
    /// Its name in the lab.
    pub name: Option<String>,
    /// Its number in the lab; none for syncs.
    pub station: Option<usize>,
    /// The slot's id; none for syncs.
    pub slot: Option<u8>,
    /// Its frames.
    pub frames: u64,
    /// Turns without one, between the first and the last.
    pub missed: u64,
    /// stamp - (scheduled + the line's offset).
    pub slot_error_ns: Summary,
    /// |slot error - its median|.
    pub slot_error_abs_ns: Summary,
    /// All of the latter: a value, and how many frames have it, as far as the histogram tells them apart.
    pub slot_errors_abs: Vec<(i64, u64)>,
}

/// A station's frames of one kind that do not say when they were scheduled.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct OtherFigures {
    /// Its address.
    pub source: String,
    /// Its name in the lab.
    pub name: Option<String>,
    /// `request`, `reply`, `tunnel`, or an EtherType.
    pub what: String,
    /// Its frames.
    pub frames: u64,
    /// Turns without one, between the first and the last; none where frames come now and then.
    pub missed: Option<u64>,
    /// stamp - (the cycle's start + the line's offset).
    pub place_ns: Summary,
    /// |place - its median|.
    pub place_spread_ns: Summary,
}

impl JitterFigures {
    /// What was tallied at an ear.
    pub fn of(
        ear: &mut Ear,
        tally: &Tally,
        line: &Line,
        observed_ns: u64,
        rate: u64,
        host: HostFacts,
    ) -> Self {
        let mut figures = Self {
            interface: ear.interface.clone(),
            lab: ear.lab.clone(),
            observed_ns,
            cycle_ns: line.period().map(|period| period.nanos() as u64),
            clock_drift_ppb: line.drift_ppb(),
            frames: tally.frames,
            kinds: tally.kinds.iter().map(|(&kind, &count)| (kind.to_owned(), count)).collect(),
            sync_gaps: tally.sync_gaps,
            syncs_repeated: tally.syncs_repeated,
            syncs_implausible: tally.syncs_implausible,
            overlaps: tally.overlaps,
            rate,
            dropped_by_ring: ear.dropped(),
            clock_steps: ear.clock_steps(),
            line_restarts: line.restarts(),
            not_judged: tally.not_judged,
            frames_beyond: tally.frames_beyond,
            stamp_error_ns: STAMP_ERROR_NS,
            sync_period_jitter_ns: tally.sync_period.summary(),
            host,
            ..Self::default()
        };
        for (stream, seen) in &tally.streams {
            let (source, name) = (stream.source.to_string(), ear.names.get(&stream.source).cloned());
            let (frames, missed) = (seen.frames, seen.missed());
            let has_turns = !matches!(stream.which, Which::Sporadic(_));
            let with_gaps = |of: &SignedHistogram| match has_turns {
                true => of.summary().with_gaps(missed),
                false => of.summary(),
            };
            let times = with_gaps(&seen.times);
            let spread = seen.times.deviation_from(seen.times.median());
            let of_slot = |station, slot| SlotFigures {
                source: source.clone(),
                name: name.clone(),
                station,
                slot,
                frames,
                missed,
                slot_error_ns: times,
                slot_error_abs_ns: with_gaps(&spread),
                slot_errors_abs: spread.iter().collect(),
            };
            match stream.which {
                Which::Sync => figures.slots.push(of_slot(None, None)),
                Which::Slot { station, slot } => figures.slots.push(of_slot(Some(station), Some(slot))),
                which => figures.others.push(OtherFigures {
                    source,
                    name,
                    what: which.to_string(),
                    frames,
                    missed: matches!(which, Which::Foreign(_)).then_some(missed),
                    place_ns: times,
                    place_spread_ns: with_gaps(&spread),
                }),
            }
        }
        figures
    }
}
