//! The figures of a run, as the JSON report names them.
//!
//! The order of the fields is the order in the report. Times are integers in nanoseconds.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::document::document;
use super::histogram::Summary;
use super::host::HostFacts;
pub use super::verdict::Verdict;
use crate::judge::masters::{Rivals, Takeover};

/// A whole run.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Figures {
    /// Stations in the lab, the master included.
    pub stations: u64,
    /// The length of a cycle.
    pub cycle_ns: u64,
    /// How long before their slots stations wake.
    #[serde(default)]
    pub lead_ns: i64,
    /// How long after its slot's instant a frame may still begin. A station that wakes later than `lead_ns` and this together
    /// misses its slot.
    #[serde(default)]
    pub last_moment_ns: i64,
    /// Cycles measured.
    pub cycles: u64,
    /// Synchronisation frames seen on the medium.
    pub syncs_sent: u64,
    /// Cycles in which the master sent no Synchronisation frame.
    pub syncs_skipped: u64,
    /// Frames that the stations had queued for their slots.
    pub frames_expected: u64,
    /// Frames seen on the medium.
    pub frames_seen: u64,
    /// Slots with no frame though one was queued.
    pub slots_missed: u64,
    /// Slots that a station skipped because it was late.
    pub overruns: u64,
    /// Frames late because the station was held up inside the send call.
    pub stalled_in_send: u64,
    /// Frames that a kernel guard dropped because the station was held up before or inside the send call.
    pub guard_drops: u64,
    /// Times at which two frames were on the air at once, at the medium's rate.
    pub overlaps: u64,
    /// Frames seen outside their slots.
    pub out_of_slot: u64,
    /// Of the frame that left the air latest: how long after its slot's end, or, below zero, before it.
    pub latest_frame_ns: Option<i64>,
    /// Misses of any kind without a known cause.
    pub unexplained: u64,
    /// Frames whose payload was not what the station had sent.
    pub payload_errors: u64,
    /// Actual - scheduled transmit, all stations.
    pub slot_error_ns: Summary,
    /// |slot error - the station's own median|, all stations.
    pub slot_error_abs_ns: Summary,
    /// (t(n) - t(n-1)) - T of successive Synchronisation frames.
    pub sync_period_jitter_ns: Summary,
    /// Estimated - true global time, all slaves.
    pub sync_error_ns: Summary,
    /// |estimated - true global time|, so that its tail is that of both sides.
    pub sync_error_abs_ns: Summary,
    /// One entry per station.
    pub per_station: Vec<StationFigures>,
    /// What the run took place on.
    pub host: HostFacts,
    /// What the run comes to, and why.
    pub verdict: Verdict,
    /// So many of a million slots each station might miss, where no expectation decides.
    #[serde(default)]
    pub max_miss_ppm: u32,
    /// Processor time of all real-time threads, in per cent of one core.
    pub rt_cpu_percent: f64,
    /// How often the host's clock was seen to jump.
    pub clock_steps: u64,
    /// Frames that the capture lost, so that nothing is known of them.
    pub capture_dropped: u64,
    /// Frames that were on the medium and did not reach their receiver.
    pub frames_lost: u64,
    /// Those of them that the scenario meant to be lost.
    #[serde(default)]
    pub lost_on_purpose: u64,
    /// Missed slots, by cause: all but those that are unexplained.
    pub causes: BTreeMap<String, u64>,
    /// Missing Synchronisations, by cause: so, too.
    #[serde(default)]
    pub sync_causes: BTreeMap<String, u64>,
    /// The worst misses, at most [`Figures::MISSES_MAX`]; see [`Figures::note_miss`].
    pub misses: Vec<Miss>,
    /// Cycles without a Synchronisation.
    #[serde(default)]
    pub syncs_missing: u64,
    /// How often another station gave the time than before.
    #[serde(default)]
    pub takeovers: u64,
    /// Most cycles from the last Synchronisation of one to the first of the other: 1 is none missing.
    #[serde(default)]
    pub takeover_cycles: u32,
    /// Most cycles in a row in which two gave the time.
    #[serde(default)]
    pub rival_cycles: u32,
    /// The first take-overs.
    #[serde(default)]
    pub masters_seen: Vec<Takeover>,
    /// Who gave the time at once, the last times.
    #[serde(default)]
    pub rivals: Vec<Rivals>,
    /// Frames outside all slots, of addresses that no station has; of the ninth and later ones together.
    #[serde(default)]
    pub strangers: BTreeMap<String, u64>,
    /// Synchronisations that are not what they say, by reason: of a stranger, or of a cycle that cannot have begun or is long
    /// over.
    #[serde(default)]
    pub implausible_syncs: BTreeMap<String, u64>,
    /// How much later than it was to be the last look at the clock before each send was, all stations: ranges of
    /// nanoseconds, lowest and highest, and how many. A simulation's hosts draw from it: `late = "recorded FILE"`.
    #[serde(default)]
    pub wake_latency: Vec<(u64, u64, u64)>,
    /// What programs queued, by priority.
    #[serde(default)]
    pub queueing: Vec<QueueingFigures>,
}

document!(Figures, "lab-run", lab_run_has_its_schema);

impl Figures {
    /// How many misses are kept, so that a bad run's report stays readable.
    pub const MISSES_MAX: usize = 100;

    /// Enters a miss into the list, which is kept worst first. Out of a full list falls the least bad one of the kind that
    /// has the most, so that no kind hides another. The counters are not touched.
    pub fn note_miss(&mut self, miss: Miss) {
        miss.note(&mut self.misses);
    }
}

/// One station's part in a run.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct StationFigures {
    /// The station's name.
    pub name: String,
    /// The role in which it started.
    pub role: Role,
    /// Its address, `02:00:00:00:00:01`.
    pub mac: String,
    /// Its process.
    pub pid: u32,
    /// How far its clock is set off from the host's.
    pub clock_offset_ns: i64,
    /// How much faster its clock runs than the host's, in 10^-9.
    pub clock_drift_ppb: i64,
    /// The delay from the master that calibration found; none for the master or before calibration.
    pub calibration_delay_ns: Option<i64>,
    /// Frames that it had queued for its slots.
    pub frames_expected: u64,
    /// Frames of it seen on the medium.
    pub frames_seen: u64,
    /// Slots with no frame though one was queued.
    pub slots_missed: u64,
    /// Frames of it outside its slots, of whatever kind.
    #[serde(default)]
    pub stray: u64,
    /// Slots that it skipped because it was late.
    pub overruns: u64,
    /// Frames late because it was held up inside the send call.
    pub stalled_in_send: u64,
    /// What enforced its slots.
    pub guard: GuardName,
    /// Frames that the kernel guard dropped.
    pub guard_drops: u64,
    /// Frames whose payload was not what it had sent.
    pub payload_errors: u64,
    /// Actual - scheduled transmit.
    pub slot_error_ns: Summary,
    /// |slot error - the station's own median|.
    pub slot_error_abs_ns: Summary,
    /// Estimated - true global time; `n` is 0 for the master.
    pub sync_error_ns: Summary,
    /// Resident memory at the end, in bytes.
    pub rss_bytes: u64,
    /// Processor time of the whole process, in per cent of one core.
    pub cpu_percent: f64,
    /// Frames missing between those that it received: missed by their sender, or lost on the way.
    pub sequence_gaps: u64,
    /// Frames for it that were on the medium and that it did not receive.
    pub frames_lost: u64,
    /// Those of them that the scenario meant to be lost.
    #[serde(default)]
    pub lost_on_purpose: u64,
    /// What the station's stack refused, by name of the refusal.
    pub refusals: BTreeMap<String, u64>,
    /// What a reader should know, such as `SCHED_FIFO refused: ...`.
    pub notes: Vec<String>,
    /// What its program queued, by priority.
    #[serde(default)]
    pub queueing: Vec<QueueingFigures>,
}

/// What became of frames of one priority that programs queued.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct QueueingFigures {
    /// 0 is the most urgent.
    pub priority: u8,
    /// Frames seen on the medium.
    pub frames_seen: u64,
    /// Frames that found no room in their queue.
    pub refused: u64,
    /// From when a frame was queued until it was on the wire.
    pub delay_ns: Summary,
    /// Frames that were on the medium and did not reach their receiver, as they are in its `frames_lost`.
    #[serde(default)]
    pub lost: u64,
    /// Those of them that the scenario meant to be lost.
    #[serde(default)]
    pub lost_on_purpose: u64,
}

/// The part that a station plays in the cycle.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Sends the Synchronisation frames.
    Master,
    /// Sends them if the master does not.
    Backup,
    /// Follows them.
    #[default]
    Slave,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Role::Master => "master",
            Role::Backup => "backup",
            Role::Slave => "slave",
        })
    }
}

/// What keeps a station from sending after its slot's `latest` instant.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum GuardName {
    /// The kernel guard, behind its own last look at the clock.
    Kernel,
    /// Only that.
    #[default]
    User,
}

impl fmt::Display for GuardName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            GuardName::Kernel => "kernel",
            GuardName::User => "user",
        })
    }
}

impl From<bool> for GuardName {
    fn from(is_guarded: bool) -> Self {
        if is_guarded { GuardName::Kernel } else { GuardName::User }
    }
}

/// Something that went wrong with one slot, or with one cycle's Synchronisation frame.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Miss {
    /// The number of the cycle.
    pub cycle: u64,
    /// The station's name.
    pub station: String,
    /// What went wrong.
    pub kind: MissKind,
    /// By how much: how late, how long stalled, how far out of the slot. Negative is early; 0 if there
    /// is no such time.
    pub span_ns: i64,
    /// Why, as its station's own stamps tell; empty if they do not.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub cause: String,
    /// Of the unexplained: what was found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub found: Option<String>,
}

impl Miss {
    /// See [`Figures::note_miss`].
    pub fn note(self, misses: &mut Vec<Miss>) {
        let place = misses.partition_point(|other| other.badness() >= self.badness());
        misses.insert(place, self);
        if misses.len() > Figures::MISSES_MAX {
            let kinds = misses.chunk_by(|one, next| one.kind == next.kind);
            let ends = kinds.scan(0, |end, kind| {
                *end += kind.len();
                Some((kind.len(), *end))
            });
            let (_, end) = ends.max().expect("a full list");
            misses.remove(end - 1);
        }
    }

    /// Worse is greater: first what has no known cause, then the longer span.
    fn badness(&self) -> (Reverse<MissKind>, u64) {
        (Reverse(self.kind), self.span_ns.unsigned_abs())
    }
}

/// What can go wrong with a slot, worst first.
#[derive(Clone, Copy, Debug, Deserialize, Eq, Ord, PartialEq, PartialOrd, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum MissKind {
    /// No known cause.
    Unexplained,
    /// Two frames on the air at once.
    Overlap,
    /// A frame outside its slot.
    OutOfSlot,
    /// A payload that is not what was sent.
    PayloadError,
    /// The station was held up inside the send call.
    StalledInSend,
    /// The station was held up, and the kernel guard dropped its frame.
    GuardDropped,
    /// The station was late and skipped the slot.
    Overrun,
    /// The master sent no Synchronisation frame.
    SyncSkipped,
}

impl fmt::Display for MissKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            MissKind::Unexplained => "unexplained",
            MissKind::Overlap => "overlap",
            MissKind::OutOfSlot => "out of slot",
            MissKind::PayloadError => "payload error",
            MissKind::StalledInSend => "stalled in send",
            MissKind::GuardDropped => "guard dropped",
            MissKind::Overrun => "overrun",
            MissKind::SyncSkipped => "sync skipped",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn miss(kind: MissKind, span_ns: i64) -> Miss {
        Miss { cycle: 7, station: "b".into(), kind, span_ns, cause: String::new(), found: None }
    }

    #[test]
    fn the_fields_are_in_the_promised_order() {
        let names = [
            "stations cycle_ns lead_ns last_moment_ns cycles syncs_sent syncs_skipped frames_expected frames_seen",
            "slots_missed overruns stalled_in_send guard_drops overlaps out_of_slot unexplained payload_errors slot_error_ns",
            "slot_error_abs_ns sync_period_jitter_ns sync_error_ns sync_error_abs_ns per_station host verdict",
            "rt_cpu_percent clock_steps capture_dropped frames_lost misses",
        ];
        let json = serde_json::to_string(&Figures::default()).unwrap();
        let places: Vec<_> = names
            .iter()
            .flat_map(|line| line.split(' '))
            .map(|name| json.find(&format!("\"{name}\":")).unwrap_or_else(|| panic!("no {name}")))
            .collect();
        assert!(places.is_sorted(), "{json}");
    }

    #[test]
    fn what_is_written_can_be_read() {
        let mut figures = Figures { stations: 2, ..Figures::default() };
        figures.per_station.push(StationFigures { role: Role::Master, ..StationFigures::default() });
        figures.note_miss(miss(MissKind::StalledInSend, 1));
        let json = serde_json::to_string(&figures).unwrap();
        assert!(json.contains(r#""role":"master""#) && json.contains(r#""kind":"stalled_in_send""#));
        assert_eq!(serde_json::from_str::<Figures>(&json).unwrap(), figures);
    }

    #[test]
    fn a_full_list_keeps_the_worst_misses() {
        let mut figures = Figures::default();
        for span in 0..300 {
            figures.note_miss(miss(MissKind::Overrun, span));
        }
        figures.note_miss(miss(MissKind::Unexplained, 0));
        assert_eq!(figures.misses.len(), Figures::MISSES_MAX);
        assert_eq!(figures.misses[0].kind, MissKind::Unexplained);
        assert_eq!((figures.misses[1].span_ns, figures.misses[99].span_ns), (299, 201));
    }

    #[test]
    fn a_kind_of_which_there_are_many_hides_no_other() {
        let mut figures = Figures::default();
        let of = |figures: &Figures, kind| figures.misses.iter().filter(|miss| miss.kind == kind).count();
        for span in 0..300 {
            figures.note_miss(miss(MissKind::StalledInSend, span));
        }
        for span in 0..30 {
            figures.note_miss(miss(MissKind::GuardDropped, span));
        }
        assert_eq!(of(&figures, MissKind::StalledInSend), 70);
        assert_eq!(of(&figures, MissKind::GuardDropped), 30);
        for span in 30..300 {
            figures.note_miss(miss(MissKind::GuardDropped, span));
        }
        assert_eq!(of(&figures, MissKind::GuardDropped), 50);
        assert_eq!((figures.misses[49].span_ns, figures.misses[99].span_ns), (250, 250));
    }
}
