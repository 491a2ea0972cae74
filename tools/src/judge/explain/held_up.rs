//! Frames that were held up behind their station's last look at the clock: late in their own slots, or taken for those of
//! a later turn where they do not say of which they are. A Synchronisation that was moves who follows it, or comes when a
//! backup has taken over.

use rtnet::discipline::{Cause, EventKind};
use rtnet::time::Span;

use super::{BRIDGED, MASTER, NO_SYNC_BY, Records, key};
use crate::judge::findings::{Author, Finding};
use crate::scenario::StationPlan;

/// A frame may be of a turn that was so long ago, if it does not say of which it is, and a Synchronisation be overtaken by
/// those of so many cycles: for longer the kernel takes no core from a thread.
pub const HELD_UP_FOR: Span = Span::from_millis(100);

/// Cycles in which backups that have heard each other wait for each other.
const HESITATE: u8 = 2;

impl Records {
    /// Whether a frame was held up, and by enough. A Synchronisation that was moves every station of its cycle.
    pub(super) fn held_up(&self, author: Author, late: Span) -> Option<&'static str> {
        let (by, _) = self.by_cycle.get(&key(author, EventKind::StalledInSend))?;
        let explains = Span::ZERO < late && late <= *by + self.in_time;
        explains.then(|| self.told(author, EventKind::StalledInSend)).flatten()
    }

    /// Whether it was, and the Synchronisation that it follows, too, by enough together.
    pub(super) fn held_up_twice(&self, author: Author, late: Span) -> Option<&'static str> {
        let by = |of| self.by_cycle.get(&key(of, EventKind::StalledInSend)).map(|(by, _)| *by);
        let moved = self.moved_by(author).filter_map(by).max()?;
        self.held_up(author, late - moved)
    }

    /// A program's frame does not say of which turn it is, nor does a tunnelled one: held up for long, it was taken for
    /// another's.
    pub(super) fn unmarked_frame(&self, author: Author) -> Option<&'static str> {
        self.between_turns(author.station)?;
        self.told(author, EventKind::StalledInSend).or_else(|| self.moved_to_another_turn(author, Span::ZERO))
    }

    /// A Synchronisation that was held up moves what follows it, until the next one: by so much that a frame was taken for
    /// another turn's, and was late there by what was left of it.
    pub(super) fn moved_to_another_turn(&self, author: Author, late: Span) -> Option<&'static str> {
        let between = self.between_turns(author.station).filter(|_| late >= Span::ZERO)?;
        self.cycles_ago().find_map(|ago| {
            let of = Author { cycle: author.cycle.wrapping_sub(ago), ..author };
            let at_least = between.max(self.cycle * (i64::from(ago) - 1 - i64::from(BRIDGED))) + late;
            self.moved_by(of).find_map(|master| self.held_up(master, at_least))
        })
    }

    /// A backup that gave the time has told that it gives it no more: it heard another's Synchronisation, which had been held
    /// up or was of the same cycle, and whose author has made way in turn. Both hesitate for a cycle or two, and for longer
    /// if the other one sleeps through those.
    pub(super) fn both_made_way(&self, finding: &Finding) -> Option<&'static str> {
        let author = finding.authors[0].filter(|of| self.reigns.has_ended(of.station, of.cycle))?;
        let others =
            |cycle| self.masters(Author::sync(MASTER, cycle)).filter(move |of| of.station != author.station);
        let sleeps = others(author.cycle).any(|of| self.told_of(of, &NO_SYNC_BY).is_some());
        let hesitate = i64::from(HESITATE) * if sleeps { 2 } else { 1 };
        self.cycles_ago().skip(1).find_map(|ago| {
            let cycle = author.cycle.wrapping_sub(ago);
            let beyond = i64::from(ago) - hesitate;
            let at_least = (self.cycle * beyond).max(Span::from_nanos(1));
            let own = Author::sync(author.station, cycle);
            let two_spoke = || self.told(own, EventKind::DuplicateCycle).filter(|_| beyond <= 0);
            others(cycle).find_map(|of| self.held_up(of, at_least)).or_else(two_spoke)
        })
    }

    /// Whether a Synchronisation of the cycle came only when so many cycles more had begun.
    pub(super) fn syncs_are_held_up(&self, author: Author, cycles: u32) -> bool {
        let by = (self.cycle * i64::from(cycles)).max(self.in_time);
        self.moved_by(author).any(|master| self.held_up(master, by).is_some())
    }

    /// Whether a frame was held up at all: this turn's, or one that is taken for it.
    pub(super) fn stalled(&self, author: Author) -> Option<&'static str> {
        let told = self.told(author, EventKind::StalledInSend);
        told.or_else(|| self.of_an_earlier_turn(author, Span::ZERO))
    }

    /// One that was held up beyond a later turn's begin was taken for that one's, and was late there by what was left of it.
    pub(super) fn of_an_earlier_turn(&self, author: Author, late: Span) -> Option<&'static str> {
        let Author { station, cycle, .. } = author;
        let between = self.between_turns(station).filter(|_| late >= Span::ZERO)?;
        self.cycles_ago().find_map(|ago| {
            let of = cycle.wrapping_sub(ago);
            let told = self.by_cycle.range((of, station, Some(0), EventKind::Overrun)..);
            let mut told = told.take_while(|((of_cycle, who, ..), _)| (*of_cycle, *who) == (of, station));
            // How much earlier its turn was, at the least: the slots of one cycle lie anywhere in it.
            let at_least = between.max(self.cycle * (i64::from(ago) - 1)) + late;
            let (_, (_, cause)) = told.find(|((.., kind), (by, _))| {
                *kind == EventKind::StalledInSend && at_least <= *by + self.in_time
            })?;
            Some(cause.map_or(EventKind::StalledInSend.name(), Cause::name))
        })
    }

    /// In which cycles what is held up may have begun.
    pub(super) fn cycles_ago(&self) -> impl Iterator<Item = u32> + use<> {
        0..=(HELD_UP_FOR.nanos() / self.cycle.nanos().max(1)) as u32 + 1
    }

    /// How soon a turn of a station can follow another, if what it sends may not say which it is.
    fn between_turns(&self, station: usize) -> Option<Span> {
        self.unmarked.iter().find(|(of, _)| *of == station).map(|&(_, between)| between)
    }

    /// A calibration reply, whose author nobody knows, meets others when it is late, of a later cycle, too; it moves
    /// nobody.
    pub(super) fn late_reply(&self, finding: &Finding) -> Option<&'static str> {
        let told = |ago: u32| {
            let cycle = finding.cycle.wrapping_sub(ago);
            let at_least = self.cycle * (i64::from(ago) - 1) - self.in_time;
            self.masters(Author::sync(MASTER, cycle)).find_map(|of| {
                let (by, _) = self.by_cycle.get(&key(of, EventKind::ReplyStalled))?;
                self.told(of, EventKind::ReplyStalled).filter(|_| *by >= at_least)
            })
        };
        let is_hit = finding.authors.contains(&None);
        self.cycles_ago().filter(|_| is_hit).find_map(told)
    }
}

/// From one slot of a station's to its next, in this cycle or the one that follows, at the least.
pub fn nearest_turns(plan: &StationPlan, cycle: Span) -> Span {
    let mut offsets: Vec<Span> = plan.slots.iter().map(|slot| slot.offset).collect();
    offsets.sort_unstable();
    let within = offsets.windows(2).map(|two| two[1] - two[0]);
    let across = offsets.first().zip(offsets.last()).map(|(&first, &last)| first + cycle - last);
    within.chain(across).min().unwrap_or(cycle)
}

#[cfg(test)]
mod tests;
