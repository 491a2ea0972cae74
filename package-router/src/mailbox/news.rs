//! How an owner sees what has come since it last looked: in each lane in its order, and across lanes as it was sent.

use super::inbox::Inbox;
use super::layout::{Entry, of_owner, of_sender, of_slot};
use super::shape::WhenFull;
use super::urgency::Node;
use super::word::{Segment, Word};

/// What came, as it is found; room for all that can.
pub(super) struct News {
    all: Vec<New>,
    /// How many there were before the lane that is looked into.
    before: usize,
    /// The slots of a sender that was quicker than its ring, by their numbers.
    overtaken: Vec<(u64, u16)>,
}

#[derive(Clone, Copy)]
struct New {
    sent: u64,
    /// Which it is as it was found: of those that were sent at the same time the first.
    order: u32,
    node: Node,
    priority: u8,
}

impl News {
    /// Room for lanes of so many slots, and so many nodes in all.
    pub fn with_room(slots: usize, nodes: usize) -> Self {
        Self { all: Vec::with_capacity(nodes), before: 0, overtaken: Vec::with_capacity(slots) }
    }
}

impl<Own: Segment, Theirs: Segment> Inbox<Own, Theirs> {
    /// Sees what has come. It takes a comparison or a few for each package, whatever senders say of when they sent it: what was
    /// seen before stays before it.
    #[inline]
    pub(super) fn look(&mut self) {
        // Who looks often finds something in one lane at the most: that needs no sorting.
        let (mut only, mut lanes) = (None, 0);
        for lane in 0..self.used {
            let Some(sender) = &self.lanes[lane].sender else { continue };
            if sender.segment.at(of_sender::PUBLISHED).get_acquire() == sender.seen || sender.is_broken {
                continue;
            }
            lanes += 1;
            match (only.take(), lanes) {
                (_, 1) => only = Some(lane),
                (first, _) => first.into_iter().chain([lane]).for_each(|lane| self.look_into::<false>(lane)),
            }
        }
        match only {
            Some(lane) => self.look_into::<true>(lane),
            None if lanes == 0 => return,
            None => self.let_all_wait(),
        }
        let (depth, most) = (self.urgency.len() as u64, self.own.at(of_owner::MOST));
        if most.get() < depth {
            most.set(depth);
        }
    }

    /// In the order in which they were sent.
    fn let_all_wait(&mut self) {
        let Self { news, urgency, .. } = self;
        news.all.sort_unstable_by_key(|new| (new.sent, new.order));
        news.all.drain(..).for_each(|new| urgency.push(new.node, new.priority));
    }

    /// Sees what has come in a lane, which may be the only one.
    fn look_into<const IS_ONLY: bool>(&mut self, lane: usize) {
        let ring = self.layout.ring as u64;
        let Some(sender) = &mut self.lanes[lane].sender else { return };
        let newest = sender.segment.at(of_sender::PUBLISHED).get_acquire();
        let seen = core::mem::replace(&mut sender.seen, newest);
        self.news.before = self.news.all.len();
        let mut sent = 0;
        for behind in 1..=newest.wrapping_sub(seen).min(ring + 1) {
            let number = seen.wrapping_add(behind);
            let Some(sender) = &mut self.lanes[lane].sender else { return };
            let entry = Entry::from_word(sender.segment.at(self.layout.announced(number)).get_acquire());
            if behind > ring || entry.number() != number {
                return self.look_at_all_of::<IS_ONLY>(lane, newest, sent);
            }
            if entry.slot() >= self.layout.slots {
                sender.is_broken = true;
                return self.count(of_owner::NONSENSE, 1);
            }
            sent = self.note::<IS_ONLY>(lane, entry.slot(), number, sent);
        }
    }

    /// A sender has announced more than its ring holds: each slot says what is in it.
    #[cold]
    fn look_at_all_of<const IS_ONLY: bool>(&mut self, lane: usize, newest: u64, mut sent: u64) {
        let Self { lanes, layout, news, .. } = self;
        let Some(sender) = &mut lanes[lane].sender else { return };
        if layout.when_full != WhenFull::Replace {
            // It has no more slots than that: nobody has read so many.
            sender.is_broken = true;
            return self.count(of_owner::NONSENSE, 1);
        }
        let number = |slot| sender.segment.at(layout.slot(slot) + of_slot::NUMBER).get_acquire();
        news.overtaken.clear();
        news.overtaken.extend((0..layout.slots).map(|slot| (number(slot), slot as u16)));
        news.overtaken.sort_unstable();
        for at in 0..self.news.overtaken.len() {
            let (number, slot) = self.news.overtaken[at];
            // What was announced since then is noted with all that was before it.
            if number <= newest {
                sent = self.note::<IS_ONLY>(lane, slot.into(), number, sent);
            }
        }
    }

    /// Notes a package in its slot, if that is not known yet, as sent no earlier than what was noted of its lane before; tells
    /// when. One that has made way meanwhile is not noted: what has its place is announced by itself.
    #[inline]
    fn note<const IS_ONLY: bool>(&mut self, lane: usize, slot: usize, number: u64, before: u64) -> u64 {
        let Some(sender) = &self.lanes[lane].sender else { return before };
        let words = sender.segment.part(self.layout.slot(slot), of_slot::BODY);
        let is_there = words[of_slot::NUMBER].get_acquire() == number;
        let node = lane * self.layout.slots + slot;
        let is_known = number == 0 || number == self.known[node];
        // A sender that goes on changing what is in its slots has no more of them than others.
        let are_more = self.news.all.len() - self.news.before >= self.layout.slots;
        if !is_there || is_known || are_more {
            return before;
        }
        self.known[node] = number;
        let [_, _, priority, ..] = words[of_slot::HEAD].get().to_ne_bytes();
        if IS_ONLY {
            self.urgency.push(node as Node, priority);
            return before;
        }
        let sent = words[of_slot::SENT].get().max(before);
        let order = self.news.all.len() as u32;
        self.news.all.push(New { sent, order, node: node as Node, priority });
        sent
    }
}
