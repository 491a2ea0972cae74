//! When which slot is used.

use std::collections::BTreeMap;

use rtmac::tdma::schedule::{Gap, Schedule, gcd};
use rtnet::time::Span;
use serde::Serialize;

use crate::scenario::{Scenario, StationPlan};

/// Longer ones are shown by slot only.
const PHASES_AT_MOST: u64 = 1 << 16;

/// The time table of a schedule. Times are in nanoseconds from a cycle's start.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TimeTable {
    /// After how many cycles it repeats; none where that is more than 65 536.
    pub phases: Option<u64>,
    /// In the order of their begins.
    pub slots: Vec<SlotRow>,
    /// In the order in which they look.
    pub backups: Vec<BackupRow>,
}

/// A slot in it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct SlotRow {
    /// Whose.
    pub station: String,
    /// 0 real-time, 1 non-real-time, 2.. the user's.
    pub slot: u8,
    /// The slot whose queue it takes from, if not its own.
    pub joint: Option<u8>,
    /// Used in cycles with `cycle mod period == phase`.
    pub phase: u32,
    /// See `phase`.
    pub period: u32,
    /// Largest payload behind the Ethernet header, in bytes.
    pub size: usize,
    /// Its begin.
    pub begins_ns: i64,
    /// When the largest frame that begins then has ended.
    pub frame_ends_ns: i64,
    /// The end of its guard band.
    pub ends_ns: i64,
    /// What is free behind that frame, in the cycles in which it is least.
    pub free_ns: i64,
    /// Whose slot ends that; none: the cycle's end.
    pub free_until: Option<String>,
    /// The number of its station, from 0 in the order of their first slots, which pictures are coloured by.
    #[serde(skip)]
    pub number: usize,
}

impl SlotRow {
    /// Its number, with that of the slot whose queue it takes from.
    pub fn name(&self) -> String {
        self.joint.map_or(self.slot.to_string(), |joint| format!("{}->{joint}", self.slot))
    }
}

/// A backup master in it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct BackupRow {
    /// Whose.
    pub station: String,
    /// When it sends a sync if there is none.
    pub sends_ns: i64,
    /// The end of its sync window.
    pub until_ns: i64,
}

impl TimeTable {
    /// Of these slots, which do not conflict.
    pub fn of(scenario: &Scenario, schedule: &Schedule) -> Self {
        let slots_of = |station: &'_ StationPlan| {
            station.slots.iter().map(|slot| ((station.name.clone(), slot.id), slot.joint)).collect::<Vec<_>>()
        };
        let joint: BTreeMap<_, _> = scenario.stations.iter().flat_map(slots_of).collect();
        let mut numbers = BTreeMap::new();
        let row = |gap: Gap<'_>| SlotRow {
            number: {
                let next = numbers.len();
                *numbers.entry(gap.slot.owner.clone()).or_insert(next)
            },
            station: gap.slot.owner.clone(),
            slot: gap.slot.id,
            joint: joint.get(&(gap.slot.owner.clone(), gap.slot.id)).copied().flatten(),
            phase: gap.slot.phase,
            period: gap.slot.period,
            size: gap.slot.size,
            begins_ns: gap.slot.offset.nanos(),
            frame_ends_ns: (gap.slot.offset + schedule.air_time(gap.slot)).nanos(),
            ends_ns: schedule.end(gap.slot).nanos(),
            free_ns: gap.length.nanos(),
            free_until: gap.until.map(|until| until.owner.clone()),
        };
        let slots: Vec<_> = schedule.gaps().into_iter().map(row).collect();
        let mut periods = slots.iter().map(|row| u64::from(row.period.max(1)));
        let phases = periods.try_fold(1, |all: u64, period| {
            Some(all / gcd(all, period) * period).filter(|&all| all <= PHASES_AT_MOST)
        });
        Self { phases, slots, backups: backups(&scenario.stations, scenario.sync_window) }
    }

    /// The slots that are used in one of its cycles.
    pub fn phase(&self, phase: u64) -> impl Iterator<Item = &SlotRow> {
        self.slots.iter().filter(move |row| phase % u64::from(row.period.max(1)) == u64::from(row.phase))
    }

    /// The least that is free behind a frame, and behind whose.
    pub fn smallest_gap(&self) -> Option<&SlotRow> {
        self.slots.iter().min_by_key(|row| row.free_ns)
    }
}

fn backups(stations: &[StationPlan], window: Span) -> Vec<BackupRow> {
    let row = |station: &StationPlan| {
        let sends = station.backup?;
        let (sends_ns, until_ns) = (sends.nanos(), (sends + window).nanos());
        Some(BackupRow { station: station.name.clone(), sends_ns, until_ns })
    };
    let mut rows: Vec<_> = stations.iter().filter_map(row).collect();
    rows.sort_by_key(|row| row.sends_ns);
    rows
}
