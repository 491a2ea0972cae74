//! Frames that programs queue: in which slot each left, and how long it had waited.

use std::collections::BTreeMap;

use rtnet::clock::True;
use rtnet::time::Span;

use super::{Analysis, Seen};
use crate::judge::delivery::BEYOND;
use crate::judge::findings::Author;
use crate::judge::worst::Worst;
use crate::report::histogram::SignedHistogram;
use crate::scenario::StationPlan;
use crate::station::traffic::{Tag, step};

/// What was seen of a station's traffic of one priority.
#[derive(Default)]
pub struct Queueing {
    /// From when each frame was queued until it was on the wire.
    pub delay: SignedHistogram,
    /// The longest.
    pub worst: Worst,
    /// The number of its newest frame, in a cycle that counts or not.
    newest: Option<u64>,
}

/// Of each priority that a station has traffic of, nothing yet.
pub(super) fn of_station(plan: &StationPlan) -> BTreeMap<u8, Queueing> {
    plan.flows.iter().map(|flow| (flow.priority, Queueing::default())).collect()
}

impl Seen {
    /// A number that the station has not come to in any of its traffic, however much of it has not been seen yet.
    pub fn beyond(&self) -> u64 {
        let newest = self.queueing.values().filter_map(|seen| seen.newest);
        newest.map(|number| number + BEYOND).fold(self.passed.beyond(), u64::max)
    }
}

impl Analysis {
    /// Whose frame it is, and of which slot of which cycle: it says so, unless it was queued for whatever slot its
    /// priority brings it to. None if its station queues none of that priority.
    pub fn author_of(&self, at: True, tag: &Tag, len: usize) -> Option<Author> {
        let (station, air) = (tag.station(), self.rate.air_time(len));
        let seen = self.stations.get(station)?;
        let Some(priority) = tag.priority() else {
            return Some(Author { station, cycle: tag.cycle(), slot: Some(tag.slot) });
        };
        seen.queueing.contains_key(&priority).then_some(())?;
        let (cycle, slot) = self.turn_of(station, at, air).unwrap_or((tag.cycle(), tag.slot));
        Some(Author { station, cycle, slot: Some(slot) })
    }

    /// The turn of a station to which a frame belongs that is on the medium then: the newest, if it is within its slot;
    /// else it was held up, in the oldest of which no frame was seen.
    fn turn_of(&self, station: usize, at: True, air: Span) -> Option<(u32, u8)> {
        let cycle = self.cycle_at(at + self.clock_share.nanos() as u64)?;
        let ids = self.timetable.ids(station);
        let error = |(cycle, id)| self.slot_error(at, Author { station, cycle, slot: Some(id) });
        let begun = |&turn: &(u32, u8)| error(turn).is_some_and(|error| error >= -self.clock_share);
        let newest = ids.iter().filter_map(|&id| {
            let back = self.timetable.at(station, id, cycle)?.period;
            let turns = self.timetable.turns(station, id, cycle.wrapping_sub(back), cycle.wrapping_add(1));
            turns.map(|cycle| (cycle, id)).filter(begun).last()
        });
        let newest = newest.min_by_key(|&turn| error(turn))?;
        let length = self.length(self.timetable.at(station, newest.1, newest.0)?.size);
        if error(newest).is_some_and(|error| error + air <= length - self.clock_share) {
            return Some(newest);
        }
        let from = self.window.map_or(cycle, |(from, _)| from);
        let unseen = ids.iter().filter_map(|&id| {
            let next = self.next_turn(station, id, from);
            let mut turns = self.timetable.turns(station, id, next, cycle.wrapping_add(1));
            turns.next().map(|cycle| (cycle, id)).filter(begun)
        });
        unseen.max_by_key(|&turn| error(turn)).or(Some(newest))
    }

    /// A queued frame is on the wire, in a cycle that counts or not.
    pub(super) fn note_queued(&mut self, at: True, tag: &Tag, author: Author) {
        let (waited, counts) = (self.error(at, tag.scheduled()), self.counts(author.cycle));
        let queueing = &mut self.stations[author.station].queueing;
        let Some(seen) = tag.priority().and_then(|priority| queueing.get_mut(&priority)) else { return };
        // What a receiver does not believe is not believed here.
        if step(seen.newest, tag.sequence()).is_some() {
            seen.newest = Some(tag.sequence());
        }
        if counts {
            seen.delay.record(waited.nanos());
            seen.worst.note(waited.nanos(), author.cycle);
        }
    }
}
