//! A network of which only what is said of schedules is left: a primary, backups and slaves, in cycles, with losses, stalls and
//! deaths by chance. In no cycle may two of them use two schedules.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::super::*;
use super::{book, config};

/// Cycles that stations bridge.
const BRIDGED: u32 = 2;
/// Who gives the time, of all stations the first.
const MASTERS: usize = 3;

struct Model {
    stations: Vec<(Address, Change, u32)>,
    /// Dead, or stopped until that cycle.
    gone: Vec<Option<u32>>,
    /// Who hears nothing until that cycle, after it was stopped.
    deaf: Vec<u32>,
    cycle: u32,
    random: u64,
    loss: u64,
}

impl Model {
    fn new(stations: u8, loss: u64, seed: u64) -> Self {
        let all: Vec<Address> = (1..=stations).map(|n| Address([2, 0, 0, 0, 0, n])).collect();
        let config = config(&all[..MASTERS], &all);
        let of = |&address: &Address| (address, Change::new(&config, 7), 0);
        let (gone, deaf) = (vec![None; all.len()], vec![0; all.len()]);
        Model { stations: all.iter().map(of).collect(), gone, deaf, cycle: 0, random: seed | 1, loss }
    }

    /// Percent.
    fn chance(&mut self, percent: u64) -> bool {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        self.random >> 16 & 0xffff < percent * 0xffff / 100
    }

    fn is_gone(&self, id: usize) -> bool {
        self.gone[id].is_some_and(|until| self.cycle < until)
    }

    fn act(&mut self, id: usize, switch: Option<Switch>) {
        if let Some(Switch { to, .. }) = switch {
            self.stations[id].1.switch(to, [slot_of_first()].into_iter(), None);
        }
    }

    /// One cycle: whoever gives the time says so, each master that has heard nothing until its instant takes its place; parts and
    /// answers go their way. The schedules in use.
    fn step(&mut self) -> BTreeSet<ScheduleId> {
        self.cycle += 1;
        let cycle = self.cycle;
        let mut heard = vec![false; self.stations.len()];
        for speaker in 0..MASTERS {
            if self.is_gone(speaker) || heard[speaker] && (speaker > 0 || !self.stations[0].1.acts()) {
                continue;
            }
            let said = self.stations[speaker].1.say(cycle, true);
            let begins = self.stations[speaker].1.begins(cycle);
            self.act(speaker, begins);
            self.stations[speaker].1.spoke(cycle);
            self.stations[speaker].2 = cycle;
            let part = self.stations[speaker].1.part_for(cycle);
            self.stations[speaker].1.part_is_sent();
            for id in (0..self.stations.len()).filter(|&id| id != speaker) {
                if self.is_gone(id) || self.cycle < self.deaf[id] || self.chance(self.loss) {
                    continue;
                }
                heard[id] = true;
                // A primary that gives the time makes way for nobody.
                let switch = if id == 0 && self.stations[0].1.acts() {
                    self.stations[id].1.overhear(said);
                    None
                } else {
                    self.stations[id].2 = cycle;
                    self.stations[id].1.hear(cycle, Some(said))
                };
                self.act(id, switch);
                if let (Some(part), false) = (part, self.chance(self.loss))
                    && self.stations[id].1.take(&part) == Ok(true)
                {
                    let switch = self.stations[id].1.judged(Ok(()));
                    self.act(id, switch);
                }
            }
        }
        let senders: Vec<usize> = (0..self.stations.len())
            .filter(|&id| !self.is_gone(id) && cycle - self.stations[id].2 <= BRIDGED)
            .filter(|&id| self.stations[id].1.may_send(cycle, true))
            .collect();
        for &id in &senders {
            let (address, change, _) = &mut self.stations[id];
            let from = *address;
            if let Some(answer) = change.answer(id < MASTERS) {
                change.answers(&answer);
                for master in 0..MASTERS {
                    if !self.is_gone(master) && !self.chance(self.loss) {
                        let _ = self.stations[master].1.on_answer(cycle, from, &answer);
                    }
                }
            }
            self.stations[id].1.turn_is_over();
        }
        senders.iter().map(|&id| self.stations[id].1.in_use()).collect()
    }

    fn propose(&mut self, shift: i64) {
        let all: Vec<Address> = self.stations.iter().map(|station| station.0).collect();
        let cycle = self.cycle;
        for (own, change, _) in &mut self.stations[..MASTERS] {
            let _ = change.propose(cycle, *own, &book(shift, &all), Some(Activation::Soon));
        }
    }
}

fn slot_of_first() -> SlotConfig {
    super::slot(100)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases * 8))]

    #[test]
    fn never_are_two_schedules_in_use_and_all_agree_in_the_end(
        seed: u64,
        loss in 0u64..25,
        stalls in prop::collection::vec((0usize..5, 0u32..400, 1u32..120, 0u32..10), 0..10),
        proposals in prop::collection::vec(1u32..500, 1..5),
        dies in prop::option::of((0usize..2, 0u32..400)),
    ) {
        let mut model = Model::new(5, loss, seed);
        let mut used = BTreeSet::new();
        for step in 0..700u32 {
            for &(id, _, long, deaf) in stalls.iter().filter(|stall| stall.1 == step) {
                model.gone[id] = Some(model.gone[id].unwrap_or(0).max(model.cycle + long));
                model.deaf[id] = model.gone[id].unwrap_or(0).saturating_add(deaf);
            }
            if let Some((id, _)) = dies.filter(|dies| dies.1 == step) {
                model.gone[id] = Some(u32::MAX);
            }
            if proposals.contains(&step) {
                model.propose(i64::from(step % 7) + 1);
            }
            let in_use = model.step();
            prop_assert!(in_use.len() <= 1, "cycle {}: {in_use:?}", model.cycle);
            used.extend(in_use);
        }
        // Whatever was stopped is there again, and nothing is lost any more.
        model.loss = 0;
        let after: Vec<_> = (0..600).map(|_| model.step()).collect();
        prop_assert!(after.iter().all(|in_use| in_use.len() <= 1));
        let there: Vec<_> = (0..5).filter(|&id| !model.is_gone(id)).map(|id| model.stations[id].1.in_use()).collect();
        prop_assert!(there.iter().all(|id| *id == there[0]), "{there:?}");
        prop_assert_eq!(after.last().unwrap().len(), 1, "all of them send");
    }

    #[test]
    fn without_losses_every_proposal_is_switched_to(seed: u64, proposals in 1u32..5) {
        let mut model = Model::new(5, 0, seed);
        model.step();
        for number in 1..=proposals {
            model.propose(i64::from(number));
            (0..300).for_each(|_| drop(model.step()));
            let all = model.stations.iter().map(|station| u32::from(station.1.in_use().number));
            prop_assert!(all.clone().all(|in_use| in_use == number), "{:?}", all.collect::<Vec<_>>());
        }
    }
}
