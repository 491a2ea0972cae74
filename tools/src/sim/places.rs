//! Where to look first when something is not as expected: the cycle in which each figure was worst, or what is counted
//! was there for the first time.

use std::collections::BTreeMap;

use rtnet::sim::{Loss, StationId};

use crate::judge::account::Account;
use crate::judge::analysis::Analysis;
use crate::judge::findings::FindingKind;
use crate::judge::worst::Worst;
use crate::scenario::{Expectation, Measure};

/// What only who looks at the network sees, while it is measured.
#[derive(Default)]
pub struct Seen {
    /// The largest difference between estimated and true global time, by station.
    pub sync_error: Vec<Worst>,
    /// For how long the medium was not free between two frames, below zero: it was free.
    pub least_gap: Worst,
    /// The first test traffic that did not reach each station.
    lost: Vec<Option<u32>>,
    /// The first frame that a hub destroyed.
    collided: Option<u32>,
    /// The first frame for which a port of a switch had no room.
    queue_full: Option<u32>,
}

impl Seen {
    /// Nothing yet of so many stations.
    pub fn of(stations: usize) -> Self {
        Self { sync_error: vec![Worst::default(); stations], lost: vec![None; stations], ..Self::default() }
    }

    /// A frame was lost on its way to a station.
    pub fn note_lost(&mut self, to: StationId, why: Loss, is_data: bool, cycle: u32) {
        match why {
            Loss::Collision => _ = self.collided.get_or_insert(cycle),
            Loss::QueueFull => _ = self.queue_full.get_or_insert(cycle),
            Loss::Wire | Loss::Cut | Loss::NoBuffer | Loss::Changed(_) => {}
        }
        if is_data {
            self.lost[to].get_or_insert(cycle);
        }
    }
}

/// The places of a run.
#[derive(Default)]
pub struct Places {
    /// By kind, of all or of a station.
    firsts: BTreeMap<(FindingKind, Option<usize>), u32>,
    stations: Vec<OfStation>,
    seen: Seen,
    latest: Worst,
    /// The last cycle of the longest time in which two gave the time.
    rivals: Option<u32>,
    /// The first finding that nobody has told of.
    unexplained: Option<u32>,
    /// The first cycle of the longest take-over.
    takeover: Option<u32>,
    /// When somebody was not synchronised for the last time.
    unlocked: Option<u32>,
    /// The last cycle.
    end: Option<u32>,
}

struct OfStation {
    slot_error: Worst,
    queueing: BTreeMap<u8, Worst>,
    strayed: Option<u32>,
}

impl Places {
    /// What was seen, and when somebody was not synchronised for the last time.
    pub fn of(analysis: &Analysis, account: &Account, seen: Seen, unlocked: Option<u32>) -> Self {
        let stations = analysis.stations.iter().map(|of| OfStation {
            slot_error: of.worst_slot_error,
            queueing: of.queueing.iter().map(|(&priority, of)| (priority, of.worst)).collect(),
            strayed: of.strayed,
        });
        let longest = analysis.masters.takeovers.iter().max_by_key(|takeover| takeover.cycles);
        let (from, cycles) = analysis.window_counted();
        Self {
            firsts: account.firsts.clone(),
            stations: stations.collect(),
            seen,
            latest: analysis.latest,
            rivals: analysis.masters.rivals_in,
            unexplained: account.first_unexplained,
            takeover: longest.map(|takeover| takeover.cycle),
            unlocked,
            end: cycles.checked_sub(1).map(|last| from.wrapping_add(last)),
        }
    }

    /// The cycle to look at; some measures have none.
    pub fn of_measure(&self, expected: &Expectation) -> Option<u32> {
        match expected.measure {
            Measure::Overlaps => self.first(expected, FindingKind::Overlap),
            Measure::OutOfSlot => self.first(expected, FindingKind::OutOfSlot),
            Measure::FramesSeen if expected.priority.is_some() => None,
            Measure::SlotsMissed | Measure::Overruns | Measure::FramesSeen => {
                self.first(expected, FindingKind::SlotMissed)
            }
            Measure::SyncsMissing => self.first(expected, FindingKind::SyncGap),
            Measure::Unexplained => self.unexplained,
            Measure::Takeovers | Measure::TakeoverCycles => self.takeover,
            Measure::RivalCycles => self.rivals,
            Measure::RelockCycles => self.unlocked,
            Measure::Locked | Measure::Masters => self.end,
            Measure::SyncError => worst(expected, &self.seen.sync_error, |of| *of).cycle(),
            Measure::SlotError => worst(expected, &self.stations, |of| of.slot_error).cycle(),
            Measure::QueueingDelay | Measure::QueueingP99 => {
                let of_priority = |of: &OfStation| {
                    let all = of.queueing.iter();
                    let asked = all.filter(|(of, _)| expected.priority.is_none_or(|only| only == **of));
                    asked.fold(Worst::default(), |worst, (_, of)| worst.or(*of))
                };
                worst(expected, &self.stations, of_priority).cycle()
            }
            Measure::LatestFrame => self.latest.cycle(),
            Measure::SmallestGap => self.seen.least_gap.cycle(),
            Measure::Stray => asked(expected, &self.stations).filter_map(|of| of.strayed).next(),
            Measure::FramesLost => asked(expected, &self.seen.lost).find_map(|of| *of),
            Measure::Collisions => self.seen.collided,
            Measure::QueueFull => self.seen.queue_full,
            // Who refuses a frame only counts it.
            Measure::PayloadErrors | Measure::QueueRefused => None,
        }
    }

    /// The first cycle in which there was something of this kind.
    fn first(&self, expected: &Expectation, kind: FindingKind) -> Option<u32> {
        self.firsts.get(&(kind, expected.station)).copied()
    }
}

/// Those of the stations that something is expected of.
fn asked<'a, T>(expected: &Expectation, stations: &'a [T]) -> impl Iterator<Item = &'a T> {
    let only = expected.station;
    let all = stations.iter().enumerate();
    all.filter(move |(station, _)| only.is_none_or(|only| only == *station)).map(|(_, of)| of)
}

fn worst<T>(expected: &Expectation, stations: &[T], of: impl Fn(&T) -> Worst) -> Worst {
    asked(expected, stations).fold(Worst::default(), |worst, station| worst.or(of(station)))
}
