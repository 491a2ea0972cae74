//! The router's way into one mailbox: a datagram's bytes go straight into a slot there.

use rtnet::room;
use rtnet::socket::{Access, Received, SocketId};
use rtnet::time::GlobalTime;

use crate::mailbox::{Begun, LaneSender, Origin, Segment, SendError, Stamps};
use crate::name::MailboxName;
use crate::wire::{HEAD_LEN, Head, Joining, Part};

/// Packages of several datagrams that a mailbox may wait for the rest of: each keeps a slot.
const MOST_JOINS: usize = 4;
/// How long the next datagram of one is waited for, nanoseconds: as RTnet waits for fragments, a hundred cycles of 1 ms.
pub(super) const JOIN_TIMEOUT: u64 = 100_000_000;

/// Wakes an owner: one system call.
pub type Wake = Box<dyn Fn() + Send>;

/// Into one mailbox.
pub struct Way<Own: Segment, Theirs: Segment> {
    pub(super) name: MailboxName,
    lane: LaneSender<Own, Theirs>,
    /// Wakes who reads there.
    pub(super) wake: Wake,
    joins: Vec<Join>,
    /// Packages that were given up for others of the same sender.
    pub(super) given_up: u64,
    /// Its reader sleeps.
    pub(super) wakes: bool,
}

/// A package of which more is to come.
struct Join {
    joining: Joining,
    begun: Begun,
    /// When it was sent, as the first of its parts says that does: one that is as long as can be has no room for it.
    sent: Option<GlobalTime>,
    /// When the last of it came.
    since: u64,
}

/// What became of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// A package is there; whether its reader sleeps.
    Delivered(bool),
    /// More is to come.
    Begun,
    NoRoute,
    Full,
    TooLarge,
    Forged,
    Malformed,
    Incomplete,
}

impl Outcome {
    pub(super) fn is_consumed(self) -> bool {
        matches!(self, Outcome::Delivered(_) | Outcome::Begun)
    }
}

impl<Own: Segment, Theirs: Segment> Way<Own, Theirs> {
    /// Into the mailbox of this name, through its router's lane.
    pub fn new(name: MailboxName, lane: LaneSender<Own, Theirs>, wake: Wake) -> Box<Self> {
        Box::new(Self { name, lane, wake, joins: room::vec(MOST_JOINS), given_up: 0, wakes: false })
    }

    /// Of which mailbox.
    pub fn name(&self) -> MailboxName {
        self.name
    }

    pub(super) fn receive(
        &mut self,
        head: &Head,
        now: u64,
        socket: SocketId,
        sockets: &mut Access<'_>,
        received: &Received,
    ) -> Outcome {
        let times = received.times;
        let (sent, left) = (times.map(|times| times.sent), times.and_then(|times| times.left));
        let stamps = Stamps { sent: now, origin: Origin::Elsewhere(sent), left, came: received.global };
        if head.part == Part::Whole {
            let mut slot = match self.lane.reserve(head.priority, head.body_len()) {
                Ok(slot) => slot,
                Err(error) => return refusal(error),
            };
            receive_into(socket, sockets, |part| slot.write(part));
            return Outcome::Delivered(slot.publish(head, &stamps));
        }
        let begun = match head.part {
            Part::First => self.begin(head, received.whole, sent, now),
            _ => self.next(head, received.whole),
        };
        let (join, is_complete) = match begun {
            Ok(begun) => begun,
            Err(outcome) => return outcome,
        };
        let mut slot = self.lane.go_on(join.begun);
        receive_into(socket, sockets, |part| slot.write(part));
        if is_complete {
            let stamps = Stamps { origin: Origin::Elsewhere(join.sent.or(sent)), ..stamps };
            return Outcome::Delivered(slot.publish(join.joining.head(), &stamps));
        }
        if let Some(begun) = slot.put_aside() {
            self.joins.push(Join { joining: join.joining, begun, sent: join.sent.or(sent), since: now });
        }
        Outcome::Begun
    }

    /// The first part of a package. One of the same two mailboxes that was not complete is given up.
    fn begin(
        &mut self,
        head: &Head,
        datagram: usize,
        sent: Option<GlobalTime>,
        now: u64,
    ) -> Result<(Join, bool), Outcome> {
        let (joining, _) = Joining::begin(head, datagram - HEAD_LEN).map_err(|_| Outcome::Malformed)?;
        if let Some(old) = self.find(head.from) {
            self.give_up(old);
            self.given_up += 1;
        }
        if self.joins.len() == self.joins.capacity() {
            return Err(Outcome::Full);
        }
        let slot = self.lane.reserve(head.priority, head.body_len()).map_err(refusal)?;
        let begun = slot.put_aside().ok_or(Outcome::Incomplete)?;
        Ok((Join { joining, begun, sent, since: now }, false))
    }

    fn next(&mut self, head: &Head, datagram: usize) -> Result<(Join, bool), Outcome> {
        let place = self.find(head.from).ok_or(Outcome::Incomplete)?;
        match self.joins[place].joining.next(head, datagram - HEAD_LEN) {
            Ok(placed) => Ok((self.joins.swap_remove(place), placed.is_complete)),
            Err(_) => {
                self.give_up(place);
                Err(Outcome::Incomplete)
            }
        }
    }

    /// Packages of which more is to come.
    pub(super) fn joins(&self) -> usize {
        self.joins.len()
    }

    /// Gives up those of which nothing has come for so long: how many, and since when the oldest of the others waits, if not `now`.
    pub(super) fn give_up_old(&mut self, now: u64) -> (usize, u64) {
        let before = self.joins.len();
        let is_old = |join: &Join| now.saturating_sub(join.since) > JOIN_TIMEOUT;
        while let Some(old) = self.joins.iter().position(is_old) {
            self.give_up(old);
        }
        let oldest = self.joins.iter().map(|join| join.since).fold(now, u64::min);
        (before - self.joins.len(), oldest)
    }

    fn find(&self, from: MailboxName) -> Option<usize> {
        self.joins.iter().position(|join| join.joining.head().from == from)
    }

    fn give_up(&mut self, place: usize) {
        let join = self.joins.swap_remove(place);
        drop(self.lane.go_on(join.begun));
    }
}

fn refusal(error: SendError) -> Outcome {
    match error {
        SendError::TooLarge { .. } => Outcome::TooLarge,
        SendError::Full(_) | SendError::Nonsense => Outcome::Full,
    }
}

/// The one copy: from the buffers of the frames, behind the head, to where it stays.
fn receive_into(socket: SocketId, sockets: &mut Access<'_>, mut write: impl FnMut(&[u8]) -> usize) {
    let _ = sockets.pass_on(socket, |_, parts| {
        let mut skip = HEAD_LEN;
        for part in parts {
            let behind = &part[skip.min(part.len())..];
            skip -= part.len() - behind.len();
            write(behind);
        }
        true
    });
}
