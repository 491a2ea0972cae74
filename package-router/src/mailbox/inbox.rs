//! The owner's end: all lanes of a mailbox, merged by priority. Nothing that a sender writes is believed: the worst that comes
//! of it is that its own packages are lost.

use super::layout::{Entry, Layout, of_lane, of_owner, of_sender, of_slot};
use super::news::News;
use super::package::{Package, TooSmall};
use super::refused::read_head;
use super::sender::{Origin, Stamps};
use super::shape::{Shape, WhenFull};
use super::statistics::bucket;
use super::urgency::{Node, Urgency};
use super::word::{Segment, Word};
use rtnet::time::GlobalTime;

use crate::name::MailboxName;
use crate::wire::Head;

/// The receiving end of a mailbox. `Own` is its segment, `Theirs` those of its senders.
pub struct Inbox<Own, Theirs> {
    pub(super) own: Own,
    pub(super) layout: Layout,
    pub(super) lanes: Box<[Lane<Theirs>]>,
    /// So many of them ever had a sender: those behind need not be looked at.
    pub(super) used: usize,
    pub(super) urgency: Urgency,
    /// The number of the package that was last found in each node, and not replaced since.
    pub(super) known: Box<[u64]>,
    pub(super) news: News,
    /// Packages of senders that have gone that found no slot.
    refused: u64,
    /// What is lent, or was last: here, since to move it costs as much as to find it.
    found: Found,
}

/// What is known of a lane.
pub(super) struct Lane<Theirs> {
    pub(super) sender: Option<Attached<Theirs>>,
    /// How many of its slots were given back, whoever had it.
    returned: u64,
    /// How many refused commands were taken, whoever had it.
    pub(super) answered: u64,
}

pub(super) struct Attached<Theirs> {
    pub(super) segment: Theirs,
    /// Whose packages these are; a router's are anybody's.
    pub(super) from: MailboxName,
    /// The number of the newest that was looked at.
    pub(super) seen: u64,
    /// It sends no more: the lane is free once what it has sent is read.
    has_left: bool,
    /// It has written what cannot be: it is not looked at any more.
    pub(super) is_broken: bool,
}

/// A lane that is not free.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("that lane has a sender whose packages are not all read yet")]
pub struct Taken;

/// What there was to be read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Taking {
    Found,
    Nothing,
    /// Nothing but what had made way for others.
    Replaced,
}

/// A package that is about to be read.
#[derive(Default)]
pub(super) struct Found {
    pub(super) head: Head,
    node: Node,
    lane: usize,
    slot: usize,
    number: u64,
    /// How long it took until it was found.
    pub(super) took: u64,
}

impl<Own: Segment, Theirs: Segment> Inbox<Own, Theirs> {
    /// An empty mailbox of a shape that [can be](Shape::check), whose segment has the words that its layout says, all zero.
    pub fn new(own: Own, shape: &Shape) -> Self {
        let layout = Layout::of(shape);
        assert!(own.count() >= layout.owner_words(shape.senders), "the owner's segment has all lanes");
        let nodes = shape.slots * shape.senders;
        let lanes = (0..shape.senders).map(|_| Lane { sender: None, returned: 0, answered: 0 }).collect();
        let known = vec![0; nodes].into_boxed_slice();
        let news = News::with_room(shape.slots, nodes);
        let urgency = Urgency::new(nodes);
        Self { own, layout, lanes, used: 0, urgency, known, news, refused: 0, found: Found::default() }
    }

    /// Lets a sender in, whose packages are from that mailbox; from [nobody](MailboxName::NOBODY): it says of each whose it is.
    pub fn attach(&mut self, lane: usize, from: MailboxName, segment: Theirs) -> Result<(), Taken> {
        assert!(segment.count() >= self.layout.sender_words(), "a sender's segment has room for its slots");
        if self.lanes[lane].sender.is_some() {
            return Err(Taken);
        }
        let slots = self.layout.slots;
        self.known[lane * slots..][..slots].fill(0);
        self.used = self.used.max(lane + 1);
        self.lanes[lane].sender =
            Some(Attached { segment, from, seen: 0, has_left: false, is_broken: false });
        Ok(())
    }

    /// A sender has gone. What it had sent is still there to be read. Tells whether that is new.
    pub fn leave(&mut self, lane: usize) -> bool {
        let sender = self.lanes[lane].sender.as_mut();
        sender.is_some_and(|sender| !core::mem::replace(&mut sender.has_left, true))
    }

    /// A lane whose sender has gone, and whose packages are all read; with its segment.
    pub fn next_left(&mut self) -> Option<(usize, Theirs)> {
        self.look();
        let slots = self.layout.slots;
        let lane = (0..self.used).find(|&lane| {
            let is_over = self.lanes[lane].sender.as_ref().is_some_and(|sender| sender.has_left);
            let mut nodes = lane * slots..(lane + 1) * slots;
            is_over && nodes.all(|node| !self.urgency.waits(node as Node)) && !self.keeps_commands(lane)
        })?;
        let sender = self.lanes[lane].sender.take()?;
        self.refused = self.refused.wrapping_add(sender.segment.at(of_sender::FULL).get());
        Some((lane, sender.segment))
    }

    /// Packages of all senders so far that found no slot, as the senders count them.
    pub fn refused(&self) -> u64 {
        let senders = self.lanes[..self.used].iter().filter_map(|lane| lane.sender.as_ref());
        senders.fold(self.refused, |sum, sender| sum.wrapping_add(sender.segment.at(of_sender::FULL).get()))
    }

    /// Whether something waits, or did when it was looked at.
    #[inline]
    pub(crate) fn has_some(&mut self) -> bool {
        self.look();
        self.urgency.len() > 0
    }

    /// Whether of what waited there is something to be read next: then it is to be [lent](Self::lend).
    #[inline]
    pub(crate) fn find(&mut self, now: u64) -> bool {
        match self.take(now) {
            Taking::Found => true,
            Taking::Nothing => false,
            // All that was known has made way: for what came behind it.
            Taking::Replaced => {
                self.look();
                self.take(now) == Taking::Found
            }
        }
    }

    /// Lends what was found.
    #[inline]
    pub(crate) fn lend(&mut self) -> Package<'_, Own, Theirs> {
        Package::new(self)
    }

    /// The most urgent package: it stays where it is until it is let go. `now` is this host's monotonic clock.
    #[inline]
    pub fn receive(&mut self, now: u64) -> Option<Package<'_, Own, Theirs>> {
        if self.has_some() && self.find(now) { Some(self.lend()) } else { None }
    }

    /// Copies the most urgent package's body; one that is too long for it stays, and says how long it is.
    pub fn receive_into(&mut self, now: u64, into: &mut [u8]) -> Result<Option<(Head, usize)>, TooSmall> {
        let Some(package) = self.receive(now) else { return Ok(None) };
        let (head, len) = (*package.head(), package.body().len());
        if len > into.len() {
            package.put_back();
            return Err(TooSmall { got: into.len(), needed: len });
        }
        package.body().copy_to(0, into);
        Ok(Some((head, len)))
    }

    /// Throws away what waits: how many.
    pub fn clean(&mut self, now: u64) -> usize {
        self.look();
        let mut cleaned = 0;
        while self.take(now) == Taking::Found {
            self.give_back(false);
            cleaned += 1;
        }
        self.count(of_owner::CLEANED, cleaned as u64);
        cleaned
    }

    /// How many wait.
    pub fn depth(&mut self) -> usize {
        self.look();
        self.urgency.len()
    }

    /// Says that it sleeps, and looks once more: whether there is nothing, so that it may. Who sends then says that it is to be woken.
    /// If there is something, and refused commands are to be answered, those wake it.
    pub fn falls_asleep(&mut self) -> bool {
        self.own.at(of_owner::ASLEEP).set(of_owner::FOR_PACKAGES);
        // Either a sender sees that, or what it has sent is seen here.
        Own::Word::fence();
        if !self.has_some() {
            return true;
        }
        let answers = self.layout.when_full == WhenFull::Answer;
        self.own.at(of_owner::ASLEEP).set(if answers { of_owner::FOR_REFUSED } else { 0 });
        false
    }

    /// It does not sleep any more.
    pub fn wakes_up(&mut self) {
        self.own.at(of_owner::ASLEEP).set(0);
    }

    /// What moves with each package that comes, and what it was when it was last looked at: one of each sender.
    pub fn awaited(&self) -> impl Iterator<Item = (&Theirs::Word, u64)> {
        let senders = self.lanes[..self.used].iter().filter_map(|lane| lane.sender.as_ref());
        senders
            .filter(|sender| !sender.is_broken)
            .map(|sender| (sender.segment.at(of_sender::PUBLISHED), sender.seen))
    }

    /// Whether something has come since it was last looked at: for who spins.
    #[inline]
    pub fn has_news(&self) -> bool {
        self.awaited().any(|(word, seen)| word.get() != seen)
    }

    /// What is where in its memory.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }
    /// Its segment, for who shows what it counts.
    pub fn segment(&self) -> &Own {
        &self.own
    }

    /// The most urgent package that is still there.
    #[inline]
    fn take(&mut self, now: u64) -> Taking {
        let mut nothing = Taking::Nothing;
        while let Some(node) = self.urgency.first() {
            self.urgency.remove(node);
            let (lane, slot) = self.place(node);
            let number = self.known[node as usize];
            if self.layout.when_full == WhenFull::Replace {
                self.own.at(self.layout.lane(lane) + of_lane::TAKING).set_release(number);
                // Either the sender sees that, or what it has replaced is seen here.
                Own::Word::fence();
            }
            let Some(sender) = &self.lanes[lane].sender else { continue };
            let base = self.layout.slot(slot);
            let words = sender.segment.part(base, of_slot::BODY);
            let is_there = words[of_slot::NUMBER].get_acquire() == number;
            let (from, took) = (sender.from, now.saturating_sub(words[of_slot::SENT].get()));
            let parsed = read_head(&words[of_slot::HEAD..]);
            let head = parsed.unwrap_or_default();
            self.found = Found { head, node, lane, slot, number, took };
            if !is_there {
                // It was replaced; what it made way for is announced, or will be.
                self.known[node as usize] = 0;
                self.give_back(true);
                nothing = Taking::Replaced;
                continue;
            }
            let is_sound = parsed.is_some() && head.body_len() <= self.layout.largest_body;
            if !is_sound || (from != MailboxName::NOBODY && head.from != from) {
                self.count(if is_sound { of_owner::FORGED } else { of_owner::NONSENSE }, 1);
                self.give_back(false);
                continue;
            }
            return Taking::Found;
        }
        nothing
    }

    /// What is lent.
    #[inline]
    pub(super) fn found(&self) -> &Found {
        &self.found
    }

    /// It was read, and its slot is its sender's again.
    #[inline]
    pub(super) fn let_go(&mut self) {
        self.count(of_owner::RECEIVED, 1);
        self.count(of_owner::LATENCIES + bucket(self.found.took), 1);
        self.give_back(false);
    }

    /// It was not read, and is the first of its priority again, for all that is known of it.
    pub(super) fn put_back(&mut self) {
        let Found { node, lane, slot, number: taken, .. } = self.found;
        self.own.at(self.layout.lane(lane) + of_lane::TAKING).set_release(0);
        let Some(sender) = &self.lanes[lane].sender else { return };
        // Whoever was to make way for another while it was looked at does so now.
        let number = sender.segment.at(self.layout.slot(slot) + of_slot::NUMBER).get_acquire();
        if number == taken {
            self.urgency.push_front(node, self.found.head.priority);
        } else {
            self.known[node as usize] = 0;
            self.give_back(true);
        }
    }

    /// What is said of when a package was where that is being read: few ask.
    pub(super) fn stamps(&self) -> Stamps {
        let Found { lane, slot, .. } = self.found;
        let Some(sender) = &self.lanes[lane].sender else { return Stamps::default() };
        let words = sender.segment.part(self.layout.slot(slot), of_slot::BODY);
        let at = |place: usize| words[place].get();
        let (sent, origin) = (at(of_slot::SENT), Origin::of_word(at(of_slot::ORIGIN)));
        if origin == Origin::Here {
            return Stamps { sent, ..Stamps::default() };
        }
        let some = |stamp: u64| (stamp != 0).then(|| GlobalTime::from_nanos(stamp));
        let [left, came] = [of_slot::LEFT, of_slot::CAME].map(|place| some(at(place)));
        Stamps { sent, origin, left, came }
    }

    /// The body of a package that is being read.
    #[inline]
    pub(super) fn body(&self) -> Option<(&Theirs, usize)> {
        let Found { lane, slot, .. } = self.found;
        let sender = self.lanes[lane].sender.as_ref()?;
        Some((&sender.segment, self.layout.slot(slot) + of_slot::BODY))
    }

    fn give_back(&mut self, is_unread: bool) {
        let Found { lane, slot, number, .. } = self.found;
        let entry = Entry::new(number, slot);
        let entry = if is_unread { entry.unread() } else { entry };
        let Lane { returned, .. } = &mut self.lanes[lane];
        self.own.at(self.layout.returned(lane, *returned)).set(entry.word());
        *returned += 1;
        let begin = self.layout.lane(lane);
        // Nothing of the slot is read any more once that is there.
        self.own.at(begin + of_lane::RETURNED).set_release(*returned);
        if self.layout.when_full == WhenFull::Replace {
            // Who sees that it is not taken any more sees that it was given back.
            self.own.at(begin + of_lane::TAKING).set_release(0);
        }
    }

    fn place(&self, node: Node) -> (usize, usize) {
        let (node, slots) = (node as usize, self.layout.slots);
        (node / slots, node % slots)
    }

    /// Only this side writes there.
    #[inline]
    pub(super) fn count(&self, place: usize, more: u64) {
        let word = self.own.at(place);
        word.set(word.get().wrapping_add(more));
    }
}
