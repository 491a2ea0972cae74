//! When stations told that something holds for them from a cycle on, and when that it does no more: searched by cycle, as
//! a run of hours tells of it thousands of times.

use std::collections::BTreeMap;

use super::timetable::before;

/// Of all stations.
#[derive(Debug, Default)]
pub struct Spells {
    /// By station, and whether it is a begin: in which cycles, in order, each with its place among all that were told.
    told: BTreeMap<(usize, bool), Vec<(u32, u64)>>,
    all: u64,
}

impl Spells {
    /// A station told of a begin, or of an end.
    pub fn note(&mut self, station: usize, cycle: u32, begins: bool) {
        let its = self.told.entry((station, begins)).or_default();
        let place = its.partition_point(|&(at, _)| !before(cycle, at));
        its.insert(place, (cycle, self.all));
        self.all += 1;
    }

    /// The newest begin, or end, before a cycle.
    pub fn newest_before(&self, station: usize, cycle: u32, begins: bool) -> Option<u32> {
        self.last_before(station, cycle, begins).map(|(at, _)| at)
    }

    /// Whether it holds in a cycle: it begins there, or what was told last before is a begin.
    pub fn holds(&self, station: usize, cycle: u32) -> bool {
        self.lasts(station, cycle) || self.newest_before(station, cycle.wrapping_add(1), true) == Some(cycle)
    }

    /// Whether what was told last up to a cycle is an end.
    pub fn has_ended(&self, station: usize, cycle: u32) -> bool {
        let next = cycle.wrapping_add(1);
        self.newest_before(station, next, false).is_some() && !self.lasts(station, next)
    }

    /// Forgets what was told before this cycle, but for the newest of it: that still holds.
    pub fn forget_before(&mut self, cycle: u32) {
        for its in self.told.values_mut() {
            let older = its.partition_point(|&(at, _)| before(at, cycle));
            its.drain(..older.saturating_sub(1));
        }
    }

    /// Whether what was told last before a cycle is a begin.
    fn lasts(&self, station: usize, cycle: u32) -> bool {
        let [began, ended] = [true, false].map(|begins| self.last_before(station, cycle, begins));
        began.is_some_and(|(at, place)| {
            ended.is_none_or(|(end, behind)| before(end, at) || end == at && behind < place)
        })
    }

    fn last_before(&self, station: usize, cycle: u32, begins: bool) -> Option<(u32, u64)> {
        let its = self.told.get(&(station, begins))?;
        its[..its.partition_point(|&(at, _)| before(at, cycle))].last().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_told_last_holds_also_after_the_rest_is_forgotten() {
        let mut spells = Spells::default();
        for (cycle, begins) in
            [(u32::MAX - 1, true), (3, false), (7, true), (7, false), (9, false), (9, true)]
        {
            spells.note(2, cycle, begins);
        }
        let hold =
            |spells: &Spells| [u32::MAX - 2, u32::MAX, 3, 4, 7, 8, 9, 10].map(|at| spells.holds(2, at));
        assert_eq!(hold(&spells), [false, true, true, false, true, false, true, true]);
        assert!(!spells.holds(1, 8), "another station's");
        let ended = [u32::MAX, 2, 3, 6, 7, 8, 9].map(|at| spells.has_ended(2, at));
        assert_eq!(ended, [false, false, true, true, true, true, false]);
        assert!(!spells.has_ended(1, 8), "it has told of none");
        assert_eq!(spells.newest_before(2, 8, false), Some(7));
        spells.forget_before(1_000);
        assert!(spells.holds(2, 1_000_000));
        assert_eq!(spells.told.values().map(Vec::len).collect::<Vec<_>>(), [1, 1]);
    }
}
