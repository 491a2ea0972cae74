//! Which reply belongs to which call. Pure: it is told what comes, and when.
//!
//! ```text
//! an id    Never ─┐
//!                 ├─ begin ─► Open ─ finished, with its reply ─► Answered ─┐ begin, once
//!                 │             └─── given up, or over time ───► GivenUp ──┤ it comes round
//!                 └────────────────────────────────────────────────────────┘
//! ```

use core::time::Duration;

use super::{CallError, Reply};
use crate::name::MailboxName;
use crate::wire::{ERROR, Head, NOT_AVAILABLE, TIMEOUT};

/// Calls of a proxy that are in flight at a time. An id comes round after 255 calls; with so many that keep theirs, at least 239
/// others are begun before a call is given the id of one that was given up, so a reply is taken for another's only if it is
/// late by as many.
pub const MOST_CALLS: usize = 16;
/// Of packages that belong to no call.
const NO_CALL: u8 = 0;
const IDS: usize = 1 << u8::BITS;

/// A call in flight: it is finished, or given up.
#[derive(Debug, PartialEq, Eq)]
#[must_use = "a call that is neither finished nor given up takes the place of another"]
pub struct Call {
    /// Whose: no other proxy has this mailbox.
    of: MailboxName,
    id: u8,
    number: u64,
}

/// Packages that answered no open call, and were dropped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Replies to calls that had been given up.
    pub late: u64,
    /// Second replies to a call.
    pub doubled: u64,
    /// What nobody had asked for: commands, and replies of somebody else or to no call that there ever was.
    pub unasked: u64,
}

/// All calls of a proxy.
pub(super) struct Calls {
    own: MailboxName,
    server: MailboxName,
    /// Of each id, what became of its last call.
    ids: [Last; IDS],
    /// Of the newest call.
    id: u8,
    number: u64,
    places: Box<[Place]>,
    /// Of each place as many bytes as the largest body has.
    bodies: Box<[u8]>,
    largest_body: usize,
    dropped: Dropped,
}

/// What is next for who waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// The reply is there.
    Answered,
    /// To wait, so long at the most.
    Wait(Duration),
    /// It has waited long enough.
    Over,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Last {
    Never,
    Open(u8),
    Answered,
    GivenUp,
}

#[derive(Clone, Copy, Default)]
struct Place {
    /// Of the call that is here; 0: none.
    number: u64,
    begun: u64,
    reply: Option<Kept>,
}

#[derive(Clone, Copy)]
struct Kept {
    head: Head,
    len: usize,
    took: u64,
}

impl Call {
    /// Which command has it, and which reply.
    pub fn id(&self) -> u8 {
        self.id
    }
}

impl Calls {
    /// Of the proxy whose mailbox is `own`, so many at a time.
    pub fn new(own: MailboxName, server: MailboxName, most: usize, largest_body: usize) -> Self {
        let most = most.clamp(1, MOST_CALLS);
        Self {
            own,
            server,
            ids: [Last::Never; IDS],
            id: NO_CALL,
            number: 0,
            places: vec![Place::default(); most].into_boxed_slice(),
            bodies: vec![0; most * largest_body].into_boxed_slice(),
            largest_body,
            dropped: Dropped::default(),
        }
    }

    pub fn server(&self) -> MailboxName {
        self.server
    }
    pub fn dropped(&self) -> Dropped {
        self.dropped
    }
    pub fn open(&self) -> usize {
        self.places.iter().filter(|place| place.number != 0).count()
    }

    /// A call with an id that no open one has.
    pub fn begin(&mut self, now: u64) -> Result<Call, CallError> {
        let free = self.places.iter().position(|place| place.number == 0);
        let at = free.ok_or(CallError::TooMany(self.places.len()))?;
        loop {
            self.id = self.id.wrapping_add(1);
            // There are fewer open ones than ids.
            if self.id != NO_CALL && !matches!(self.ids[usize::from(self.id)], Last::Open(_)) {
                break;
            }
        }
        self.number += 1;
        self.ids[usize::from(self.id)] = Last::Open(at as u8);
        self.places[at] = Place { number: self.number, begun: now, reply: None };
        Ok(Call { of: self.own, id: self.id, number: self.number })
    }

    /// Something has come: keeps it if it is the reply to an open call, its body by `copy`, which says how many bytes that are.
    pub fn on_package(&mut self, head: &Head, now: u64, copy: impl FnOnce(&mut [u8]) -> usize) {
        let last = self.ids[usize::from(head.id)];
        let dropped = &mut self.dropped;
        let count = match last {
            _ if head.is_command() || head.from != self.server => &mut dropped.unasked,
            Last::Open(at) => {
                let place = &mut self.places[usize::from(at)];
                if place.reply.is_none() {
                    let begin = usize::from(at) * self.largest_body;
                    // The mailbox has refused what is larger.
                    let len = copy(&mut self.bodies[begin..begin + self.largest_body]);
                    place.reply = Some(Kept { head: *head, len, took: now.saturating_sub(place.begun) });
                    return;
                }
                &mut dropped.doubled
            }
            Last::Answered => &mut dropped.doubled,
            Last::GivenUp => &mut dropped.late,
            Last::Never => &mut dropped.unasked,
        };
        *count += 1;
    }

    /// What is next for who waits for a call until then.
    pub fn next(&self, call: &Call, until: u64, now: u64) -> Result<Next, CallError> {
        let at = self.find(call).ok_or(CallError::NotOpen)?;
        Ok(match until.checked_sub(now) {
            _ if self.places[at].reply.is_some() => Next::Answered,
            None | Some(0) => Next::Over,
            Some(left) => Next::Wait(Duration::from_nanos(left)),
        })
    }

    /// The call is over: its reply, if that has come, and says that it was done.
    pub fn reply(&mut self, call: Call) -> Result<Reply<'_>, CallError> {
        let at = self.find(&call).ok_or(CallError::NotOpen)?;
        let reply = self.places[at].reply;
        self.close(&call, if reply.is_some() { Last::Answered } else { Last::GivenUp });
        let Kept { head, len, took } = reply.ok_or(CallError::TimedOut(self.server))?;
        match head.kind {
            ERROR => Err(CallError::Failed(self.server)),
            TIMEOUT => Err(CallError::NotInTime(self.server)),
            NOT_AVAILABLE => Err(CallError::NotAvailable(self.server)),
            _ => {
                let begin = at * self.largest_body;
                Ok(Reply { head, body: &self.bodies[begin..begin + len], took })
            }
        }
    }

    /// The call is over, and nobody waits for its reply. One that is over already stays so.
    pub fn give_up(&mut self, call: &Call) {
        if let Some(at) = self.find(call) {
            let is_answered = self.places[at].reply.is_some();
            self.close(call, if is_answered { Last::Answered } else { Last::GivenUp });
        }
    }

    fn close(&mut self, call: &Call, last: Last) {
        if let Some(at) = self.find(call) {
            self.places[at] = Place::default();
            self.ids[usize::from(call.id)] = last;
        }
    }

    fn find(&self, call: &Call) -> Option<usize> {
        let Last::Open(at) = self.ids[usize::from(call.id)] else { return None };
        let is_it = call.of == self.own && self.places[usize::from(at)].number == call.number;
        is_it.then_some(at.into())
    }
}
