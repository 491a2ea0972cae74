//! What a run must show: `overlaps = 0`, `takeover_cycles = "<= 1"`, `sync_error = "< 20us"`.

use std::fmt;

use rtnet::time::Span;

use super::Place;
use crate::units::parse_span;

/// One line of what is expected.
#[derive(Clone, Debug, PartialEq)]
pub struct Expectation {
    /// What is measured.
    pub measure: Measure,
    /// Of which station alone; none: of all.
    pub station: Option<usize>,
    /// And of its traffic of which priority alone.
    pub priority: Option<u8>,
    /// How it is compared, and with what: a count, or nanoseconds.
    pub relation: Relation,
    /// See `relation`.
    pub limit: i64,
    /// Where it stands in its file.
    pub place: Place,
}

/// How a figure is compared with its limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Relation {
    /// `3` or `"= 3"`.
    Equal,
    /// `"< 3"`.
    Less,
    /// `"<= 3"`.
    AtMost,
    /// `"> 3"`.
    More,
    /// `">= 3"`.
    AtLeast,
}

/// What can be expected of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Measure {
    /// Times at which two frames were on the air at once.
    Overlaps,
    /// Frames outside their slots.
    OutOfSlot,
    /// Misses without a known cause.
    Unexplained,
    /// Slots without their frame.
    SlotsMissed,
    /// Slots skipped for being late.
    Overruns,
    /// Cycles without a Synchronisation.
    SyncsMissing,
    /// Frames that were on the medium and did not reach their receiver.
    FramesLost,
    /// Frames of the stations seen in their slots.
    FramesSeen,
    /// Frames whose payload was not what was sent.
    PayloadErrors,
    /// Frames that a hub destroyed.
    Collisions,
    /// Deliveries for which a switch's port had no room.
    QueueFull,
    /// How often another station gave the time than before.
    Takeovers,
    /// At each of them, cycles from the last Synchronisation of one to the first of the other: 1 is none missing.
    TakeoverCycles,
    /// Most cycles in a row in which two stations gave the time.
    RivalCycles,
    /// Cycles from the end of the last event until all stations were synchronised for good.
    RelockCycles,
    /// Stations that were synchronised in one of the last cycles: locked, or bridging a cycle.
    Locked,
    /// Stations that gave the time in all of the last cycles.
    Masters,
    /// Largest difference between estimated and true global time.
    SyncError,
    /// Largest difference between actual and scheduled transmit.
    SlotError,
    /// How long after its slot's end the latest frame left the air; below zero, before it.
    LatestFrame,
    /// Shortest time that the medium was free between two frames.
    SmallestGap,
    /// Frames of a station outside its slots, as others see them: see `babbling` in the report.
    Stray,
    /// Longest time from when a program queued a frame until it was on the wire.
    QueueingDelay,
    /// What 99 of 100 of those do not exceed; of several priorities, the worst one's.
    QueueingP99,
    /// Frames of programs that found no room in their queue.
    QueueRefused,
}

impl Measure {
    /// Every one, with its name in files.
    pub const ALL: [(Measure, &'static str); 25] = [
        (Measure::Overlaps, "overlaps"),
        (Measure::OutOfSlot, "out_of_slot"),
        (Measure::Unexplained, "unexplained"),
        (Measure::SlotsMissed, "slots_missed"),
        (Measure::Overruns, "overruns"),
        (Measure::SyncsMissing, "syncs_missing"),
        (Measure::FramesLost, "frames_lost"),
        (Measure::FramesSeen, "frames_seen"),
        (Measure::PayloadErrors, "payload_errors"),
        (Measure::Collisions, "collisions"),
        (Measure::QueueFull, "queue_full"),
        (Measure::Takeovers, "takeovers"),
        (Measure::TakeoverCycles, "takeover_cycles"),
        (Measure::RivalCycles, "rival_cycles"),
        (Measure::RelockCycles, "relock_cycles"),
        (Measure::Locked, "locked"),
        (Measure::Masters, "masters"),
        (Measure::SyncError, "sync_error"),
        (Measure::SlotError, "slot_error"),
        (Measure::LatestFrame, "latest_frame"),
        (Measure::SmallestGap, "smallest_gap"),
        (Measure::Stray, "stray"),
        (Measure::QueueingDelay, "queueing_delay"),
        (Measure::QueueingP99, "queueing_p99"),
        (Measure::QueueRefused, "queue_refused"),
    ];

    /// Its name in files and reports.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(of, _)| *of == self).map_or("", |&(_, name)| name)
    }

    /// By its name.
    pub fn by_name(name: &str) -> Option<Measure> {
        Self::ALL.iter().find(|(_, of)| *of == name).map(|&(measure, _)| measure)
    }

    /// Whether it can be asked of a single station.
    pub fn is_of_stations(self) -> bool {
        use Measure::*;
        matches!(
            self,
            SlotsMissed
                | Overruns
                | FramesLost
                | FramesSeen
                | PayloadErrors
                | SyncError
                | SlotError
                | Locked
                | Masters
                | Stray
                | QueueingDelay
                | QueueingP99
                | QueueRefused
        )
    }

    /// Whether it can be asked of a station's traffic of one priority.
    pub fn is_of_traffic(self) -> bool {
        use Measure::*;
        matches!(self, FramesSeen | QueueingDelay | QueueingP99 | QueueRefused)
    }

    /// Whether a lab measures it, too.
    pub fn is_of_labs(self) -> bool {
        use Measure::*;
        matches!(
            self,
            Overlaps
                | OutOfSlot
                | Unexplained
                | SlotsMissed
                | Overruns
                | FramesLost
                | FramesSeen
                | PayloadErrors
                | SyncError
                | SlotError
                | LatestFrame
                | Stray
                | SyncsMissing
                | Takeovers
                | TakeoverCycles
                | RivalCycles
                | QueueingDelay
                | QueueingP99
                | QueueRefused
        )
    }

    /// Whether it is a time, not a count.
    pub fn is_time(self) -> bool {
        use Measure::*;
        matches!(self, SyncError | SlotError | LatestFrame | SmallestGap | QueueingDelay | QueueingP99)
    }

    /// A value of it in words.
    pub fn show(self, value: i64) -> String {
        if self.is_time() { Span::from_nanos(value).to_string() } else { value.to_string() }
    }
}

impl Expectation {
    /// Reads what is compared with: a count or a time, behind a relation or not.
    pub fn parse(measure: Measure, text: &str) -> Result<(Relation, i64), String> {
        let text = text.trim();
        let (relation, rest) = [
            ("<=", Relation::AtMost),
            (">=", Relation::AtLeast),
            ("<", Relation::Less),
            (">", Relation::More),
            ("=", Relation::Equal),
        ]
        .iter()
        .find_map(|(sign, relation)| Some((*relation, text.strip_prefix(sign)?)))
        .unwrap_or((Relation::Equal, text));
        let rest = rest.trim();
        let limit = if measure.is_time() {
            parse_span(rest).map_err(|error| error.to_string())?.nanos()
        } else {
            let example = "write for example 0, \"<= 2\" or \">= 990\"";
            rest.parse().map_err(|_| format!("'{text}' is no count: {example}"))?
        };
        // A time that comes after another may be below zero, which is before it.
        let may_be_below = matches!(measure, Measure::LatestFrame | Measure::SmallestGap);
        if !may_be_below && (limit < 0 || (relation == Relation::Less && limit == 0)) {
            let name = measure.name();
            return Err(format!("'{text}': {name} is never below 0: expect 0 or more"));
        }
        Ok((relation, limit))
    }

    /// Whether it bounds how bad a figure may be: too few frames seen, too many of all else.
    pub fn is_a_bound(&self) -> bool {
        match self.relation {
            Relation::Equal => true,
            Relation::Less | Relation::AtMost => self.measure != Measure::FramesSeen,
            Relation::More | Relation::AtLeast => self.measure == Measure::FramesSeen,
        }
    }

    /// Whether a figure is as expected.
    pub fn holds(&self, figure: i64) -> bool {
        match self.relation {
            Relation::Equal => figure == self.limit,
            Relation::Less => figure < self.limit,
            Relation::AtMost => figure <= self.limit,
            Relation::More => figure > self.limit,
            Relation::AtLeast => figure >= self.limit,
        }
    }
}

impl fmt::Display for Relation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Relation::Equal => "=",
            Relation::Less => "<",
            Relation::AtMost => "<=",
            Relation::More => ">",
            Relation::AtLeast => ">=",
        })
    }
}

impl fmt::Display for Expectation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {}", self.measure.name(), self.relation, self.measure.show(self.limit))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(measure: Measure, text: &str, figure: i64, holds: bool) {
        let (relation, limit) = Expectation::parse(measure, text).unwrap();
        let expected =
            Expectation { measure, station: None, priority: None, relation, limit, place: Place::default() };
        assert_eq!(expected.holds(figure), holds, "{expected}, {figure}");
    }

    #[test]
    fn what_is_expected_is_read_as_it_is_written() {
        for (text, below, at, above) in [
            ("3", false, true, false),
            ("= 3", false, true, false),
            ("<= 3", true, true, false),
            ("< 3", true, false, false),
            (">=3", false, true, true),
            ("> 3", false, false, true),
        ] {
            check(Measure::Overlaps, text, 2, below);
            check(Measure::Overlaps, text, 3, at);
            check(Measure::Overlaps, text, 4, above);
        }
        check(Measure::SyncError, "< 20us", 19_999, true);
        check(Measure::LatestFrame, "<= -1us", -1_000, true);
    }

    #[test]
    fn what_is_no_figure_says_what_to_write() {
        let error = Expectation::parse(Measure::Overlaps, "few").unwrap_err();
        assert_eq!(error, "'few' is no count: write for example 0, \"<= 2\" or \">= 990\"");
        let error = Expectation::parse(Measure::SyncError, "< 20").unwrap_err();
        assert!(error.contains("write ns, us, ms, s or min"), "{error}");
    }

    #[test]
    fn every_measure_is_found_by_its_name() {
        for (measure, name) in Measure::ALL {
            assert_eq!((Measure::by_name(name), measure.name()), (Some(measure), name));
        }
    }
}
