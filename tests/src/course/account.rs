//! What became of cases: how long they took to settle, and what overlaps had which cause.

use core::fmt;

/// What became of a case that went as it must, or of several.
#[derive(Clone, Copy, Debug, Default)]
pub struct Account {
    /// Cycles from the end of the last fault until all followed one master.
    pub settled_after: u64,
    /// And how many there might have been: of several the case that came nearest to it.
    pub settles_within: u64,
    /// Overlaps for which a sender that was held up had told of it.
    pub explained: u64,
    /// Frames that were held up, as their senders told.
    pub held_up: u64,
    /// Overlaps of a reply to a station's former life with what it asks, or is answered, since it was started anew.
    pub crossed: u64,
    /// Replies that were late, in a slot of the master's own.
    pub late_replies: u64,
    /// Overlaps of a reply to a request that was changed on its way.
    pub astray: u64,
    /// Frames that were changed on their way.
    pub changed: u64,
    /// Overlaps of two masters' parts of a network, with a cut between them.
    pub severed: u64,
    /// Overlaps of Synchronisations of two primaries.
    pub rivals: u64,
    /// Overlaps of two whose lines were apart.
    pub apart: u64,
    /// Cycles with such overlaps.
    pub apart_cycles: u64,
    /// And how many of them there might have been.
    pub apart_within: u64,
    /// Frames on the medium.
    pub frames: u64,
}

impl Account {
    /// Both together.
    pub fn with(self, other: Account) -> Account {
        let nearest =
            if other.settled_after * self.settles_within.max(1) > self.settled_after * other.settles_within {
                other
            } else {
                self
            };
        Account {
            explained: self.explained + other.explained,
            held_up: self.held_up + other.held_up,
            crossed: self.crossed + other.crossed,
            late_replies: self.late_replies + other.late_replies,
            astray: self.astray + other.astray,
            changed: self.changed + other.changed,
            severed: self.severed + other.severed,
            rivals: self.rivals + other.rivals,
            apart: self.apart + other.apart,
            apart_cycles: self.apart_cycles + other.apart_cycles,
            apart_within: self.apart_within + other.apart_within,
            frames: self.frames + other.frames,
            ..nearest
        }
    }
}

impl fmt::Display for Account {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Account { settled_after, settles_within, explained, held_up, crossed, astray, .. } = self;
        let Account {
            late_replies, changed, severed, rivals, apart, apart_cycles, apart_within, frames, ..
        } = self;
        write!(
            f,
            "{frames} frames, {late_replies} late replies, overlaps: held up {explained} (by {held_up} hold-ups), with a reply to a \
             former life {crossed}, of a reply astray {astray} ({changed} frames changed), across a cut {severed}, of two primaries' syncs \
             {rivals}, of two whose lines were apart {apart} (in {apart_cycles} cycles of at most {apart_within}), otherwise 0; \
             settled after {settled_after} of {settles_within} cycles at the most"
        )
    }
}
