//! The end of a lane that writes: one sender's way into one mailbox. No call waits, whatever the owner does.

use rtnet::time::GlobalTime;

use super::layout::{Entry, Layout, of_lane, of_owner, of_sender, of_slot};
use super::refused::write_head;
use super::shape::WhenFull;
use super::word::{Segment, Word};
use crate::wire::{HEAD_LEN, Head};

/// When a package was where.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamps {
    /// It was sent into this mailbox, or brought there by the router: on this host's monotonic clock, nanoseconds.
    pub sent: u64,
    /// Its sender sent it.
    pub origin: Origin,
    /// It left the station of its sender, or the last of it did; `None`: it never did, or nobody said when.
    pub left: Option<GlobalTime>,
    /// It came to the station of its receiver; `None`: it was always here, or the station did not know the time.
    pub came: Option<GlobalTime>,
}

/// Where a package was sent, and when.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Origin {
    /// Here: it was in this mailbox at once.
    #[default]
    Here,
    /// By another station; `None`: it does not say when.
    Elsewhere(Option<GlobalTime>),
}

impl Origin {
    const HERE: u64 = 0;
    const UNKNOWN: u64 = 1;

    #[inline]
    pub(super) fn word(self) -> u64 {
        match self {
            Origin::Here => Self::HERE,
            Origin::Elsewhere(None) => Self::UNKNOWN,
            Origin::Elsewhere(Some(sent)) => sent.nanos().max(Self::UNKNOWN),
        }
    }

    #[inline]
    pub(super) fn of_word(word: u64) -> Self {
        match word {
            Self::HERE => Origin::Here,
            Self::UNKNOWN => Origin::Elsewhere(None),
            nanos => Origin::Elsewhere(Some(GlobalTime::from_nanos(nanos))),
        }
    }
}

/// Why a package is not in a mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// All slots of this sender have packages that nobody has read.
    #[error("the mailbox is full: all {0} slots of this sender wait to be read")]
    Full(usize),
    /// No slot holds it.
    #[error("a body of {got} bytes does not fit the mailbox, whose slots take {most}")]
    TooLarge {
        /// Bytes of the body.
        got: usize,
        /// What a slot takes.
        most: usize,
    },
    /// The owner has written what cannot be.
    #[error("the owner of the mailbox has written what cannot be: bind to it anew")]
    Nonsense,
}

/// A sender's side of a lane. `Own` is its segment, `Theirs` the owner's.
pub struct LaneSender<Own, Theirs> {
    pub(super) own: Own,
    pub(super) theirs: Theirs,
    pub(super) layout: Layout,
    pub(super) lane: usize,
    /// The number of its newest package.
    newest: u64,
    /// How many slots have come back.
    returned: u64,
    /// Slots that nothing is in.
    free: Vec<u16>,
    /// What is in the others.
    held: Box<[Held]>,
}

/// What waits in a slot.
#[derive(Clone, Copy, Default)]
struct Held {
    /// Its number; 0: nothing waits there.
    number: u64,
    priority: u8,
    /// It was to make way just when the owner began to read it: it comes back, read or not.
    in_limbo: bool,
}

/// A free slot that a package is written into. It is free again unless it is published, or put aside.
pub struct Slot<'a, Own: Segment, Theirs: Segment> {
    sender: &'a mut LaneSender<Own, Theirs>,
    begun: Option<Begun>,
}

/// A package that is written into a slot of a sender's, and whose rest comes later. It is that sender's to go on with.
#[derive(Debug)]
pub struct Begun {
    slot: u16,
    /// Where the body goes on, and what of a word was written so far.
    at: usize,
    carry: u64,
    written: usize,
    room: usize,
}

impl<Own: Segment, Theirs: Segment> LaneSender<Own, Theirs> {
    /// The sender of an empty lane; both segments have the words that the layout says, and its own are all zero.
    pub fn new(own: Own, theirs: Theirs, layout: Layout, lane: usize) -> Self {
        assert!(own.count() >= layout.sender_words(), "a sender's segment has room for its slots");
        assert!(theirs.count() >= layout.lane(lane + 1), "the owner's segment has that lane");
        // A lane that had another sender before goes on where that ended.
        let returned = theirs.at(layout.lane(lane) + of_lane::RETURNED).get_acquire();
        own.at(of_sender::BEGUN).set(returned);
        own.at(of_sender::KEPT).set(theirs.at(layout.lane(lane) + of_lane::ANSWERED).get_acquire());
        // The last one first, which is still in the cache; at the beginning the first.
        let free = (0..layout.slots as u16).rev().collect();
        let held = vec![Held::default(); layout.slots].into_boxed_slice();
        Self { own, theirs, layout, lane, newest: 0, returned, free, held }
    }

    /// Sends a package: whether its receiver sleeps, and is to be woken. The length in its head is made that of the body.
    #[inline]
    pub fn send(&mut self, head: &Head, body: &[u8], stamps: &Stamps) -> Result<bool, SendError> {
        let mut begun = match self.begin(head.priority, body.len()) {
            Ok(begun) => begun,
            Err(error) => return self.keep_command(head, error),
        };
        begun.write(&self.own, body);
        Ok(self.publish(&begun, head, stamps))
    }

    /// A slot for a body of so many bytes.
    #[inline]
    pub fn reserve(&mut self, priority: u8, len: usize) -> Result<Slot<'_, Own, Theirs>, SendError> {
        let begun = self.begin(priority, len)?;
        Ok(self.go_on(begun))
    }

    #[inline]
    fn begin(&mut self, priority: u8, len: usize) -> Result<Begun, SendError> {
        let most = self.layout.largest_body;
        if len > most {
            self.count(of_sender::TOO_LARGE);
            return Err(SendError::TooLarge { got: len, most });
        }
        self.take_back()?;
        let found = match self.free.pop() {
            None if self.layout.when_full == WhenFull::Replace => self.replace(priority)?,
            found => found,
        };
        let Some(slot) = found else {
            self.count(of_sender::FULL);
            return Err(SendError::Full(self.layout.slots));
        };
        let at = self.layout.slot(slot.into()) + of_slot::BODY;
        Ok(Begun { slot, at, carry: 0, written: 0, room: len })
    }

    /// Goes on with what was put aside, or, if the slot is dropped then, gives it up.
    #[inline]
    pub fn go_on(&mut self, begun: Begun) -> Slot<'_, Own, Theirs> {
        Slot { sender: self, begun: Some(begun) }
    }

    #[inline]
    fn publish(&mut self, begun: &Begun, head: &Head, stamps: &Stamps) -> bool {
        let Self { own, theirs, layout, newest, held, .. } = self;
        let (number, slot) = (*newest + 1, usize::from(begun.slot));
        let base = layout.slot(slot);
        let head = Head { len: (HEAD_LEN + begun.written) as u32, ..*head };
        let words = own.part(base, of_slot::BODY);
        words[of_slot::SENT].set(stamps.sent);
        words[of_slot::ORIGIN].set(stamps.origin.word());
        // Of what was always here the other two say nothing.
        if stamps.origin != Origin::Here {
            words[of_slot::LEFT].set(stamps.left.map_or(0, GlobalTime::nanos));
            words[of_slot::CAME].set(stamps.came.map_or(0, GlobalTime::nanos));
        }
        write_head(&words[of_slot::HEAD..], &head);
        *newest = number;
        held[slot] = Held { number, priority: head.priority, in_limbo: false };
        words[of_slot::NUMBER].set_release(number);
        own.at(layout.announced(number)).set_release(Entry::new(number, slot).word());
        let sent = own.at(of_sender::SENT);
        sent.set(sent.get().wrapping_add(1));
        own.at(of_sender::PUBLISHED).set_release(number);
        // Either the receiver has said that it sleeps, and that is seen here, or it looks once more and sees the package.
        Own::Word::fence();
        theirs.at(of_owner::ASLEEP).get() == of_owner::FOR_PACKAGES
    }

    /// How many of its packages wait to be read, as far as it knows.
    pub fn waiting(&mut self) -> Result<usize, SendError> {
        self.take_back()?;
        Ok(self.layout.slots - self.free.len())
    }

    /// Its segment.
    pub fn segment(&self) -> &Own {
        &self.own
    }

    /// Slots that the owner has read.
    #[inline]
    fn take_back(&mut self) -> Result<(), SendError> {
        let returned = self.theirs.at(self.layout.lane(self.lane) + of_lane::RETURNED).get_acquire();
        if returned == self.returned {
            return Ok(());
        }
        if returned.wrapping_sub(self.returned) > self.layout.ring as u64 {
            return Err(SendError::Nonsense);
        }
        while self.returned != returned {
            let entry =
                Entry::from_word(self.theirs.at(self.layout.returned(self.lane, self.returned)).get());
            self.returned += 1;
            // What comes back later than it was replaced is another's by now.
            let Some(held) = self.held.get_mut(entry.slot()) else { return Err(SendError::Nonsense) };
            if held.number == entry.number() && held.number != 0 {
                *held = Held::default();
                self.free.push(entry.slot() as u16);
                if entry.is_unread() {
                    self.count(of_sender::REPLACED);
                }
            }
        }
        Ok(())
    }

    /// Takes the slot of the oldest of the least urgent, if that is no more urgent than what is to be sent.
    fn replace(&mut self, priority: u8) -> Result<Option<u16>, SendError> {
        // The owner reads one slot at a time: of two one is free.
        for _ in 0..2 {
            let held = self.held.iter().enumerate().filter(|(_, held)| held.number != 0 && !held.in_limbo);
            let Some((slot, _)) = held.min_by_key(|(_, held)| (held.priority, held.number)) else { break };
            if self.held[slot].priority > priority {
                break;
            }
            self.own.at(self.layout.slot(slot) + of_slot::NUMBER).set(0);
            // Either the owner sees that, or it has said before which slot it takes, and that is seen here.
            Own::Word::fence();
            let taking = self.theirs.at(self.layout.lane(self.lane) + of_lane::TAKING).get_acquire();
            if taking == self.held[slot].number {
                self.held[slot].in_limbo = true;
                continue;
            }
            // It may have been read meanwhile: who reads it no more has given it back before.
            self.take_back()?;
            if self.held[slot].number == 0 {
                return Ok(self.free.pop());
            }
            self.held[slot] = Held::default();
            self.count(of_sender::REPLACED);
            return Ok(Some(slot as u16));
        }
        Ok(None)
    }

    /// Only this side writes there.
    fn count(&self, place: usize) {
        let word = self.own.at(place);
        word.set(word.get().wrapping_add(1));
    }
}

impl<Own: Segment, Theirs: Segment> Slot<'_, Own, Theirs> {
    /// Appends bytes of the body, as far as there was said to be room: how many.
    #[inline]
    pub fn write(&mut self, part: &[u8]) -> usize {
        self.begun.as_mut().map_or(0, |begun| begun.write(&self.sender.own, part))
    }

    /// The rest of the body comes later.
    pub fn put_aside(mut self) -> Option<Begun> {
        self.begun.take()
    }

    /// Lets the receiver see it, with the body as far as it was written: whether the receiver sleeps, and is to be woken.
    #[inline]
    pub fn publish(mut self, head: &Head, stamps: &Stamps) -> bool {
        self.begun.take().is_some_and(|begun| self.sender.publish(&begun, head, stamps))
    }
}

impl Begun {
    #[inline]
    fn write<Own: Segment>(&mut self, own: &Own, mut part: &[u8]) -> usize {
        const WORD: usize = size_of::<u64>();
        let len = part.len().min(self.room - self.written);
        part = &part[..len];
        let begun = self.written % WORD;
        self.written += len;
        if begun > 0 {
            let n = len.min(WORD - begun);
            let mut bytes = self.carry.to_ne_bytes();
            bytes[begun..begun + n].copy_from_slice(&part[..n]);
            self.carry = u64::from_ne_bytes(bytes);
            own.at(self.at).set(self.carry);
            part = &part[n..];
            if begun + n < WORD {
                return len;
            }
            self.at += 1;
        }
        let (words, rest) = part.as_chunks::<WORD>();
        for (at, word) in own.part(self.at, words.len()).iter().zip(words) {
            at.set(u64::from_ne_bytes(*word));
        }
        self.at += words.len();
        if !rest.is_empty() {
            let mut bytes = [0; WORD];
            bytes[..rest.len()].copy_from_slice(rest);
            self.carry = u64::from_ne_bytes(bytes);
            own.at(self.at).set(self.carry);
        }
        len
    }
}

impl<Own: Segment, Theirs: Segment> Drop for Slot<'_, Own, Theirs> {
    fn drop(&mut self) {
        if let Some(begun) = self.begun.take() {
            self.sender.free.push(begun.slot);
        }
    }
}
