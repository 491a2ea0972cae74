//! Which slots the stations of a lab have in which cycles: slots may change while it runs.

use rtmac::tdma::line::next_cycle;

use crate::scenario::{Scenario, SlotPlan};

/// Every station's slots, with the cycles in which they hold.
pub struct Timetable {
    stations: Vec<Vec<Entry>>,
    /// The slots of those that have left, to hold again from their next frame on, if it may come.
    away: Vec<Option<(Vec<SlotPlan>, bool)>>,
}

struct Entry {
    plan: SlotPlan,
    /// `None`: from the beginning.
    from: Option<u32>,
    /// The first cycle in which it does not hold any more.
    until: Option<u32>,
}

impl Timetable {
    /// The slots that a scenario has throughout.
    pub fn of(scenario: &Scenario) -> Self {
        let entry = |&plan: &SlotPlan| Entry { plan, from: None, until: None };
        let entries = |slots: &Vec<SlotPlan>| slots.iter().map(entry).collect();
        Self {
            stations: scenario.stations.iter().map(|station| entries(&station.slots)).collect(),
            away: scenario.stations.iter().map(|_| None).collect(),
        }
    }

    /// How many stations there are.
    pub fn stations(&self) -> usize {
        self.stations.len()
    }

    /// From cycle `from` on a slot is as `plan` says, or there is none.
    pub fn change(&mut self, station: usize, id: u8, plan: Option<SlotPlan>, from: u32) {
        let entries = &mut self.stations[station];
        // One that was to begin then, or later, never does.
        let has_begun = |entry: &Entry| entry.from.is_none_or(|begins| before(begins, from));
        entries.retain(|entry| entry.plan.id != id || has_begun(entry));
        for entry in entries.iter_mut().filter(|entry| entry.plan.id == id) {
            entry.until = entry.until.filter(|&until| before(until, from)).or(Some(from));
        }
        entries.extend(plan.map(|plan| Entry { plan, from: Some(from), until: None }));
    }

    /// From cycle `from` on a station has these slots and no others; one that is away, once it is back.
    pub fn replace(&mut self, station: usize, slots: &[SlotPlan], from: u32) {
        if let Some((plans, _)) = &mut self.away[station] {
            plans.clone_from(&slots.to_vec());
            return;
        }
        let open: Vec<SlotPlan> = self.open(station).collect();
        for gone in open.iter().filter(|plan| slots.iter().all(|slot| slot.id != plan.id)) {
            self.change(station, gone.id, None, from);
        }
        for slot in slots.iter().filter(|slot| !open.contains(slot)) {
            self.change(station, slot.id, Some(*slot), from);
        }
    }

    /// Every station's slots, as they are to be after all changes; of those that are away, once they are back.
    pub fn now(&self) -> Vec<Vec<SlotPlan>> {
        let of = |station: usize| match &self.away[station] {
            Some((plans, _)) => plans.clone(),
            None => self.open(station).collect(),
        };
        (0..self.stations.len()).map(of).collect()
    }

    fn open(&self, station: usize) -> impl Iterator<Item = SlotPlan> + '_ {
        self.stations[station].iter().filter(|entry| entry.until.is_none()).map(|entry| entry.plan)
    }

    /// From cycle `from` on nothing is expected of a station.
    pub fn leave(&mut self, station: usize, from: u32) {
        if self.is_away(station) {
            return;
        }
        let open = self.stations[station].iter().filter(|entry| entry.until.is_none());
        let plans: Vec<SlotPlan> = open.map(|entry| entry.plan).collect();
        for id in self.ids(station) {
            self.change(station, id, None, from);
        }
        self.away[station] = Some((plans, false));
    }

    /// Whether a station has left and was not heard again.
    pub fn is_away(&self, station: usize) -> bool {
        self.away[station].is_some()
    }

    /// Whether a station has left, and is not about to return.
    pub fn has_left(&self, station: usize) -> bool {
        matches!(self.away[station], Some((_, false)))
    }

    /// A station that has left may send again.
    pub fn may_return(&mut self, station: usize) {
        if let Some((_, may)) = &mut self.away[station] {
            *may = true;
        }
    }

    /// A station has sent in a slot of a cycle: if it had left, it is back, with its slots from there on.
    pub fn sent(&mut self, station: usize, slot: u8, cycle: u32) {
        if !matches!(self.away[station], Some((_, true)))
            || self.stations[station].iter().any(|e| e.holds(cycle))
        {
            return;
        }
        let plans = self.away[station].take().map(|(plans, _)| plans).unwrap_or_default();
        let begin = plans.iter().find(|plan| plan.id == slot).map(|plan| plan.offset);
        for plan in plans {
            let has_passed = begin.is_some_and(|begin| plan.offset < begin);
            self.change(station, plan.id, Some(plan), cycle.wrapping_add(has_passed.into()));
        }
    }

    /// A slot as it is in a cycle.
    pub fn at(&self, station: usize, id: u8, cycle: u32) -> Option<&SlotPlan> {
        self.entries(station, id).find(|entry| entry.holds(cycle)).map(|entry| &entry.plan)
    }

    /// The slots that a station may use in a cycle: who returns does so before its first frame is known.
    pub fn usable(&self, station: usize, cycle: u32) -> impl Iterator<Item = &SlotPlan> {
        let held = self.stations[station].iter().filter(move |entry| entry.holds(cycle));
        let away =
            self.away[station].iter().filter(|(_, may_return)| *may_return).flat_map(|(plans, _)| plans);
        held.map(|entry| &entry.plan).chain(away).filter(move |plan| plan.has_turn(cycle))
    }

    /// The ids of a station's slots, each once, also of those that are gone.
    pub fn ids(&self, station: usize) -> Vec<u8> {
        let mut ids: Vec<u8> = self.stations[station].iter().map(|entry| entry.plan.id).collect();
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// Payload of a station's largest slot.
    pub fn largest(&self, station: usize) -> usize {
        let open = self.stations[station].iter().filter(|entry| entry.until.is_none());
        open.map(|entry| entry.plan.size).max().unwrap_or(0)
    }

    /// The cycles from `next` up to `end` in which a slot has its turn.
    pub fn turns(&self, station: usize, id: u8, next: u32, end: u32) -> impl Iterator<Item = u32> {
        self.entries(station, id).flat_map(move |entry| {
            let (next, end) = entry.within(next, end);
            turns(next, end, entry.plan.phase, entry.plan.period)
        })
    }

    /// How many those are.
    pub fn count_of(&self, station: usize, id: u8, next: u32, end: u32) -> u64 {
        let count = |entry: &Entry| {
            let (next, end) = entry.within(next, end);
            count(next, end, entry.plan.phase, entry.plan.period)
        };
        self.entries(station, id).map(count).sum()
    }

    /// How many turns all slots of a station have in those cycles.
    pub fn count(&self, station: usize, next: u32, end: u32) -> u64 {
        self.ids(station).into_iter().map(|id| self.count_of(station, id, next, end)).sum()
    }

    fn entries(&self, station: usize, id: u8) -> impl Iterator<Item = &Entry> {
        self.stations[station].iter().filter(move |entry| entry.plan.id == id)
    }
}

impl Entry {
    fn holds(&self, cycle: u32) -> bool {
        let (from, until) = self.within(cycle, cycle.wrapping_add(1));
        from == cycle && before(from, until)
    }

    /// What of a range of cycles it holds in; nothing if the end is not after the begin.
    fn within(&self, next: u32, end: u32) -> (u32, u32) {
        let from = self.from.filter(|&from| before(next, from)).unwrap_or(next);
        let until = self.until.filter(|&until| before(until, end)).unwrap_or(end);
        (from, until)
    }
}

/// In the order of cycle numbers, which go round.
pub fn before(a: u32, b: u32) -> bool {
    (b.wrapping_sub(a) as i32) > 0
}

/// The cycles from `next` up to `end` of this phase.
pub fn turns(next: u32, end: u32, phase: u32, period: u32) -> impl Iterator<Item = u32> {
    let mut cycle = next_cycle(next, phase, period);
    std::iter::from_fn(move || {
        let turn = cycle;
        cycle = next_cycle(turn.wrapping_add(1), phase, period);
        before(turn, end).then_some(turn)
    })
}

/// How many those are; counted one by one only where cycle numbers go round in between.
fn count(next: u32, end: u32, phase: u32, period: u32) -> u64 {
    if !before(next, end) {
        return 0;
    }
    if next > end {
        return turns(next, end, phase, period).count() as u64;
    }
    let up_to = |cycle: u32| (u64::from(cycle) + u64::from(period - 1 - phase)) / u64::from(period);
    up_to(end) - up_to(next)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Uniform;
    use rtmac::tdma::schedule::Rate;
    use rtnet::time::Span;

    fn timetable() -> (Timetable, SlotPlan) {
        let uniform = Uniform {
            stations: 2,
            cycle: Span::from_millis(1),
            duration: Span::from_millis(1_000),
            payload: 64,
            rate: Rate::from_bits_per_second(1_000_000_000),
            guard: None,
            seed: 1,
            vnic: None,
        };
        let scenario = uniform.scenario().unwrap();
        (Timetable::of(&scenario), scenario.stations[1].slots[0])
    }

    #[test]
    fn a_slot_is_as_it_was_up_to_the_cycle_of_its_change() {
        let (mut timetable, plan) = timetable();
        let moved = SlotPlan { offset: Span::from_micros(900), ..plan };
        timetable.change(1, 0, Some(moved), 100);
        assert_eq!(timetable.at(1, 0, 99), Some(&plan));
        assert_eq!(timetable.at(1, 0, 100), Some(&moved));
        assert_eq!(timetable.at(0, 0, 100).unwrap().id, 0, "another station's stays");
        timetable.change(1, 0, None, 110);
        assert_eq!((timetable.at(1, 0, 109), timetable.at(1, 0, 110)), (Some(&moved), None));
        assert_eq!(timetable.turns(1, 0, 98, 200).collect::<Vec<_>>(), (98..110).collect::<Vec<_>>());
        assert_eq!(timetable.count(1, 98, 200), 12);
        timetable.change(1, 0, Some(plan), 120);
        assert_eq!(timetable.count(1, 98, 200), 12 + 80);
        assert_eq!(timetable.ids(1), [0]);
    }

    #[test]
    fn nothing_is_expected_of_who_has_left_until_it_sends_again() {
        let (mut timetable, _) = timetable();
        timetable.leave(1, 100);
        timetable.sent(1, 0, 110);
        assert_eq!(timetable.count(1, 90, 200), 10, "it may not send yet");
        timetable.may_return(1);
        timetable.sent(1, 0, 99);
        timetable.sent(1, 0, 120);
        timetable.sent(1, 0, 121);
        assert_eq!(timetable.turns(1, 0, 98, 123).collect::<Vec<_>>(), [98, 99, 120, 121, 122]);
    }

    #[test]
    fn a_change_of_the_same_cycle_replaces_the_one_before() {
        let (mut timetable, plan) = timetable();
        timetable.change(1, 0, Some(SlotPlan { period: 4, phase: 1, ..plan }), 100);
        timetable.change(1, 0, Some(SlotPlan { period: 2, ..plan }), 100);
        assert_eq!(timetable.turns(1, 0, 97, 105).collect::<Vec<_>>(), [97, 98, 99, 100, 102, 104]);
    }

    #[test]
    fn turns_are_counted_as_they_are_listed() {
        for (next, end, phase, period) in
            [(0, 10, 0, 1), (3, 17, 2, 5), (7, 7, 0, 1), (9, 3, 0, 1), (u32::MAX - 4, 6, 1, 3)]
        {
            let listed = turns(next, end, phase, period).count() as u64;
            assert_eq!(count(next, end, phase, period), listed, "{next} {end} {phase} {period}");
        }
    }
}
