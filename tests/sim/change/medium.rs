//! What is on the medium, by two schedules: in which of them each frame was sent, and whether any met another.

use std::collections::{BTreeMap, BTreeSet};

use rtmac::wire::{self, Message, Rtmac};
use rtnet::sim::Aired;
use rtnet::time::{GlobalTime, Span};
use tests::networks::Plan;
use tests::traffic::DataFrame;

/// A look at every frame.
pub struct Watch {
    schedules: Vec<Plan>,
    /// The cycles of which a Synchronisation was sent, and when they were to begin.
    cycles: BTreeMap<u32, GlobalTime>,
    busy_until: u64,
    /// Frames that began while another was on the air.
    pub overlaps: u64,
    /// Cycles, in the order in which they were first used, with the schedules in which data was sent in them.
    pub used: BTreeMap<u32, BTreeSet<usize>>,
    /// Data frames of each station by cycle.
    pub data: BTreeMap<u32, Vec<usize>>,
    /// Data that was in no place of any schedule.
    pub astray: Vec<String>,
}

impl Watch {
    pub fn new(schedules: Vec<Plan>) -> Self {
        Watch {
            schedules,
            cycles: BTreeMap::new(),
            busy_until: 0,
            overlaps: 0,
            used: BTreeMap::new(),
            data: BTreeMap::new(),
            astray: Vec::new(),
        }
    }

    pub fn see(&mut self, aired: &Aired<'_>) {
        self.overlaps += u64::from(aired.at < self.busy_until);
        self.busy_until = self.busy_until.max(aired.until);
        if let Ok(Rtmac::Tdma(Message::Sync { cycle, sched, .. })) = wire::parse(aired.bytes) {
            self.cycles.insert(cycle, sched);
        } else if let Some(frame) = DataFrame::read(aired.bytes) {
            self.place(&frame);
        }
    }

    /// In which schedule's slot of its cycle a frame was sent. One of a cycle without a Synchronisation is counted from the
    /// one before.
    fn place(&mut self, frame: &DataFrame) {
        let DataFrame { station, cycle, scheduled, .. } = *frame;
        let Some((&before, &sched)) = self.cycles.range(..=cycle).next_back() else { return };
        let id = usize::from(station);
        let is_in = |plan: &Plan| {
            let start = sched + plan.cycle() * i64::from(cycle - before);
            plan.scenario.stations[id].slots.first().is_some_and(|slot| scheduled - start == slot.offset)
        };
        let of: Vec<usize> = (0..self.schedules.len()).filter(|&i| is_in(&self.schedules[i])).collect();
        match of[..] {
            [] => {
                let slot = |plan: &Plan| plan.scenario.stations[id].slots.first().map(|slot| slot.offset);
                let slots: Vec<Option<Span>> = self.schedules.iter().map(slot).collect();
                let after = scheduled - sched;
                let what = format!(
                    "station {id} in cycle {cycle}, {after} behind {before}: its slots are {slots:?}"
                );
                self.astray.push(what);
            }
            [only] => drop(self.used.entry(cycle).or_default().insert(only)),
            _ => {}
        }
        self.data.entry(cycle).or_default().push(id);
    }

    /// Two schedules at once are in no cycle, no frame meets another, and none is in no place at all.
    pub fn check(&self, situation: &str) {
        let mixed: Vec<_> = self.used.iter().filter(|(_, used)| used.len() > 1).collect();
        assert!(mixed.is_empty(), "{situation}: two schedules in use: {mixed:?}");
        assert_eq!(self.overlaps, 0, "{situation}: frames met");
        assert!(self.astray.is_empty(), "{situation}: {:?}", self.astray);
    }

    /// The schedule in which data was sent last.
    pub fn last_used(&self) -> Option<usize> {
        self.used.values().next_back().and_then(|used| used.first()).copied()
    }
}
