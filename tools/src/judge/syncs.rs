//! Which Synchronisations a station had: all that were on the medium but those that are known to be lost on their way to
//! it. Of a network that is cut in two, each part may have its master: nobody waits for the other part's.

use std::collections::BTreeMap;

use rtmac::tdma::line::LINE_GOOD_FOR;
use rtmac::wire::{self, Message, Rtmac};
use rtnet::wire::ethernet::{Address, Header};

use super::timetable::before;

/// What is known of them.
#[derive(Debug, Default)]
pub struct Syncs {
    /// Those that were on the medium, by sender.
    sent: BTreeMap<Address, Cycles>,
    /// Those that were lost, by station and sender.
    lost: BTreeMap<(usize, Address), Lost>,
}

/// Those of one sender that a station did not get.
#[derive(Debug, Default)]
struct Lost {
    on_the_way: Cycles,
    /// Since their sender was on the other side of a cut.
    beyond_cut: Cycles,
}

/// Whose Synchronisation a frame is, and of which cycle, if it is one.
pub fn sync_of(frame: &[u8]) -> Option<(Address, u32)> {
    let (header, _) = Header::parse(frame)?;
    match wire::parse(frame) {
        Ok(Rtmac::Tdma(Message::Sync { cycle, .. })) => Some((header.source, cycle)),
        _ => None,
    }
}

impl Syncs {
    /// One was on the medium.
    pub fn note(&mut self, from: Address, cycle: u32) {
        self.sent.entry(from).or_default().note(cycle);
    }

    /// A station did not get one, since it was lost, or its sender on the other side of a cut.
    pub fn note_lost(&mut self, station: usize, from: Address, cycle: u32, is_cut: bool) {
        let lost = self.lost.entry((station, from)).or_default();
        (if is_cut { &mut lost.beyond_cut } else { &mut lost.on_the_way }).note(cycle);
    }

    /// Forgets what is older than this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        self.sent.retain(|_, of| of.forget_before(cycle));
        self.lost.retain(|_, Lost { on_the_way, beyond_cut }| {
            let [of_way, of_cut] = [on_the_way, beyond_cut].map(|of| of.forget_before(cycle));
            of_way || of_cut
        });
    }

    /// Whether a station had one of this cycle, whosever.
    pub fn had(&self, station: usize, cycle: u32) -> bool {
        self.sent.iter().any(|(&from, sent)| {
            sent.run_of(cycle).is_some() && self.run_lost(station, from, cycle).is_none()
        })
    }

    /// Who sent one of the newest cycle before this one that has any, unless that line is given up.
    pub fn last_senders(&self, cycle: u32) -> impl Iterator<Item = Address> {
        let ago = move |sent: &Cycles| Some(cycle.wrapping_sub(sent.newest_until(cycle.wrapping_sub(1))?));
        let newest = self.sent.values().filter_map(ago).filter(|&ago| ago <= LINE_GOOD_FOR as u32).min();
        self.sent
            .iter()
            .filter(move |(_, sent)| newest.is_some() && ago(sent) == newest)
            .map(|(&from, _)| from)
    }

    /// Whether its sender never sent this one, but newer ones.
    pub fn passed_over(&self, from: Address, cycle: u32) -> bool {
        self.sent.get(&from).is_some_and(|sent| {
            let newest = sent.0.last().is_some_and(|&(_, last)| before(cycle, last));
            newest && sent.run_of(cycle).is_none()
        })
    }

    /// Whether this one did not get to a station.
    pub fn is_lost(&self, station: usize, from: Address, cycle: u32) -> bool {
        self.run_lost(station, from, cycle).is_some()
    }

    /// Whether a station had none of this cycle, and one that it waited for was lost.
    pub fn is_without(&self, station: usize, cycle: u32) -> bool {
        let mut lost = self.lost_to(station).filter(|(_, lost)| lost.run_of(cycle).is_some());
        let is_of_its_part = |(from, lost): (Address, &Lost)| {
            lost.on_the_way.run_of(cycle).is_some()
                || self.follows(station, cycle).is_none_or(|of| of == from)
        };
        !self.had(station, cycle) && lost.any(is_of_its_part)
    }

    /// Whose was the last that a station had before this cycle, unless it has given that line up.
    pub fn follows(&self, station: usize, cycle: u32) -> Option<Address> {
        let ago = |at: u32| cycle.wrapping_sub(at);
        let last = self.sent.iter().filter_map(|(&from, sent)| {
            let mut at = sent.newest_until(cycle.wrapping_sub(1))?;
            while let Some((first, _)) = self.run_lost(station, from, at) {
                at = sent.newest_until(first.wrapping_sub(1))?;
            }
            Some((ago(at), from))
        });
        last.filter(|&(ago, _)| ago <= LINE_GOOD_FOR as u32).min_by_key(|&(ago, _)| ago).map(|(_, from)| from)
    }

    fn lost_to(&self, station: usize) -> impl Iterator<Item = (Address, &Lost)> {
        let all = (station, Address([0; 6]))..=(station, Address([0xff; 6]));
        self.lost.range(all).map(|(&(_, from), lost)| (from, lost))
    }

    fn run_lost(&self, station: usize, from: Address, cycle: u32) -> Option<(u32, u32)> {
        self.lost.get(&(station, from))?.run_of(cycle)
    }
}

impl Lost {
    fn run_of(&self, cycle: u32) -> Option<(u32, u32)> {
        self.on_the_way.run_of(cycle).or_else(|| self.beyond_cut.run_of(cycle))
    }
}

/// Cycles, as runs without a gap, first and last, in order.
#[derive(Debug, Default)]
struct Cycles(Vec<(u32, u32)>);

impl Cycles {
    fn note(&mut self, cycle: u32) {
        let place = self.0.partition_point(|&(_, last)| before(last, cycle));
        if self.0.get(place).is_some_and(|&(first, _)| !before(cycle, first)) {
            return;
        }
        match self.0[..place].last_mut() {
            Some((_, last)) if last.wrapping_add(1) == cycle => *last = cycle,
            _ => self.0.insert(place, (cycle, cycle)),
        }
    }

    /// The run that this cycle is in.
    fn run_of(&self, cycle: u32) -> Option<(u32, u32)> {
        let run = self.0.get(self.0.partition_point(|&(_, last)| before(last, cycle)))?;
        (!before(cycle, run.0)).then_some(*run)
    }

    /// The newest that is not newer than this.
    fn newest_until(&self, cycle: u32) -> Option<u32> {
        let (_, last) = self.0[..self.0.partition_point(|&(first, _)| !before(cycle, first))].last()?;
        Some(if before(cycle, *last) { cycle } else { *last })
    }

    /// Whether there are any left.
    fn forget_before(&mut self, cycle: u32) -> bool {
        self.0.retain(|&(_, last)| !before(last, cycle));
        !self.0.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: Address = Address([2, 0, 0, 0, 0, 1]);
    const B: Address = Address([2, 0, 0, 0, 0, 2]);
    const STATION: usize = 3;

    /// One of each of these cycles.
    fn sent(by: &[(Address, std::ops::Range<u32>)]) -> Syncs {
        let mut syncs = Syncs::default();
        by.iter().for_each(|(from, cycles)| cycles.clone().for_each(|cycle| syncs.note(*from, cycle)));
        syncs
    }

    #[test]
    fn who_had_another_of_the_cycle_is_not_without() {
        let mut syncs = sent(&[(A, 0..10), (B, 5..6)]);
        syncs.note_lost(STATION, A, 4, false);
        syncs.note_lost(STATION, A, 5, false);
        let without = |syncs: &Syncs| [3, 4, 5].map(|cycle| syncs.is_without(STATION, cycle));
        assert_eq!(without(&syncs), [false, true, false], "a backup has repeated one");
        syncs.note_lost(STATION, B, 5, false);
        assert_eq!(without(&syncs), [false, true, true]);
        assert!(!syncs.is_without(STATION + 1, 5), "another station");
    }

    #[test]
    fn nobody_waits_for_the_master_of_the_other_part() {
        // A cut from 10 on; B gives the time in the station's part from 12 on, and forgets to in 20.
        let mut syncs = sent(&[(A, 0..30), (B, 12..20), (B, 21..30)]);
        (10..30).for_each(|cycle| syncs.note_lost(STATION, A, cycle, true));
        let without: Vec<u32> = (0..30).filter(|&cycle| syncs.is_without(STATION, cycle)).collect();
        assert_eq!(without, [10, 11], "it followed A until then, and B since");
        syncs.note_lost(STATION, B, 25, false);
        assert!(syncs.is_without(STATION, 25), "one of its own part");
    }

    #[test]
    fn who_follows_nobody_waits_for_anybody() {
        let mut syncs = sent(&[(A, 0..3_000)]);
        (0..3_000).for_each(|cycle| syncs.note_lost(STATION, A, cycle, true));
        assert!([0, 1, 2_999].iter().all(|&cycle| syncs.is_without(STATION, cycle)));
        syncs.note(B, 1);
        assert_eq!(syncs.follows(STATION, 1_001), Some(B));
        assert_eq!(syncs.follows(STATION, 1_002), None, "it has given that line up");
    }

    #[test]
    fn cycles_are_kept_as_runs_and_are_forgotten() {
        let mut cycles = Cycles::default();
        for cycle in [u32::MAX - 1, u32::MAX, 0, 0, 5, 6, 3, u32::MAX] {
            cycles.note(cycle);
        }
        assert_eq!(cycles.0, [(u32::MAX - 1, 0), (3, 3), (5, 6)]);
        let run_of = |cycle| cycles.run_of(cycle);
        assert_eq!(
            [u32::MAX - 2, u32::MAX, 1, 3].map(run_of),
            [None, Some((u32::MAX - 1, 0)), None, Some((3, 3))]
        );
        let newest = [u32::MAX - 2, u32::MAX, 2, 5, 9].map(|cycle| cycles.newest_until(cycle));
        assert_eq!(newest, [None, Some(u32::MAX), Some(0), Some(5), Some(6)]);
        assert!(cycles.forget_before(6) && cycles.0 == [(5, 6)]);
        assert!(!cycles.forget_before(7));
    }
}
