//! A client's rules, without a socket or a clock: it registers mailboxes, answers signs of life, and hands over packages both ways.
//!
//! ```text
//! mailboxes here ─► names ─ register, delete ─┐
//! signs of life, answers ─────────────────────┼─► batch ─► the router
//! packages of this host ──────────────────────┘   requests and answers first, then packages up to 32 KiB
//!
//! the router ─► frames ─► answers to registrations, signs of life
//!                  └────► packages for mailboxes here
//! ```
//!
//! No more than a batch leaves the mailbox in which packages wait: there the most urgent is the first.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io;

use crate::name::MailboxName;
use crate::tcp::account::{Account, Lost};
use crate::tcp::control::{ACCOUNT, CONFIRM, LIFESIGN, PROOF, Proof, REGISTER, UNREGISTER, request};
use crate::tcp::frames::Frames;
use crate::tcp::requests::Requests;
use crate::wire::{HEAD_LEN, Head, HeadError, OK};

/// Milliseconds until a registration that the router has refused is tried again: a connection that is dead may still have the name.
pub const RETRY: u64 = 1_000;
/// Milliseconds until the router is asked again about packages that wait there.
const CONFIRM_AGAIN: u64 = 100;
/// Milliseconds without a byte after which the router counts as gone. It asks for a sign of life every 5 s.
pub const SILENCE: u64 = 15_000;
/// Bytes after which a batch takes no further package.
const BATCH: usize = 32 << 10;
/// Bytes of answers that may wait: a peer that asks and does not read gets no more.
const ANSWERS: usize = 64 << 10;
/// Bytes of requests that may wait: a router that sends and does not read counts as gone.
const REQUESTS: usize = 1 << 20;
/// Batches of one call of [`Session::write`]: then it is the turn of what has come.
const BATCHES: usize = 16;

/// A client of a router, over one connection after the other.
#[derive(Debug, Default)]
pub struct Session {
    is_connected: bool,
    frames: Frames,
    names: BTreeMap<MailboxName, Registration>,
    /// Names that are to be registered.
    waiting: BTreeSet<MailboxName>,
    requests: Requests<Asked>,
    /// Requests and answers that wait for the next batch.
    own: Vec<u8>,
    /// The router waits for a sign of life.
    is_asked: bool,
    batch: Vec<u8>,
    written: usize,
    /// Where in the batch packages end that are not written.
    ends: VecDeque<usize>,
    last_heard: u64,
    /// Packages of all connections that the router has confirmed, or that are counted as lost or unconfirmed.
    settled: u64,
    /// The packages that it was asked about last, and when it is asked about the same again.
    asked: u64,
    ask_again: u64,
    /// Packages that the router has read; and those of them that wait there, as it said last.
    read: u64,
    waiting_there: u64,
    /// Packages that the routers of earlier connections did not pass on.
    lost_before: Lost,
    now: u64,
    counters: SessionCounters,
}

/// Counters over all connections.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionCounters {
    /// Packages that the kernel or TLS has taken.
    pub sent: u64,
    /// Bytes that were written, requests and answers included.
    pub bytes_sent: u64,
    /// Packages that came from the router for mailboxes.
    pub received: u64,
    /// Their bytes.
    pub bytes_received: u64,
    /// Packages lost with a connection before all their bytes were written.
    pub lost: u64,
    /// Packages of [`Self::sent`] whose connection was lost before the router confirmed that it had read them: some may have arrived.
    pub unconfirmed: u64,
    /// Packages, and answers, that the router has read and not passed on, as it said when it last confirmed any.
    pub lost_at_router: Lost,
    /// Answers that were not sent, since as many wait as may.
    pub answers_lost: u64,
    /// Registrations that the router has refused.
    pub names_refused: u64,
}

/// A request to the router.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asked {
    /// A registration.
    Name(MailboxName),
    /// The packages that it has not passed on so far.
    Account,
    /// That it has read all packages that were sent before: their number.
    Confirmation(u64),
}

/// The state of a name at the router.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Registration {
    /// It waits for its registration, or for the answer to that.
    Open,
    /// This client's.
    Registered,
    /// Refused; asked for again then.
    Refused(u64),
}

/// The end of a call of [`Session::write`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    /// Nothing is left.
    All,
    /// The connection takes no more for now.
    Blocked,
    /// More is there: this was as much as one call writes.
    More,
}

impl Session {
    /// A connection is open: the proof goes first, if it needs one, then all names are registered, before any package leaves.
    pub fn connected(&mut self, now: u64, proof: Option<&Proof>) {
        self.disconnected();
        self.is_connected = true;
        self.lost_before = self.counters.lost_at_router;
        self.last_heard = now;
        proof.iter().for_each(|proof| self.control(PROOF, 0, *proof));
        self.names.values_mut().for_each(|at| *at = Registration::Open);
        self.waiting = self.names.keys().copied().collect();
    }

    /// The connection is over. Packages that were not written are lost; such as were written and not confirmed may be. Both are counted.
    pub fn disconnected(&mut self) {
        self.is_connected = false;
        self.counters.lost += self.ends.len() as u64;
        self.counters.unconfirmed += self.counters.sent - self.settled;
        (self.settled, self.read, self.asked) = (self.counters.sent, self.counters.sent, self.counters.sent);
        self.waiting_there = 0;
        self.frames = Frames::default();
        self.requests.clear();
        self.own.clear();
        self.is_asked = false;
        self.batch.clear();
        self.written = 0;
        self.ends.clear();
    }

    /// The mailboxes here are these.
    pub fn set_names(&mut self, here: &BTreeSet<MailboxName>) {
        let gone: Vec<_> = self.names.keys().filter(|name| !here.contains(name)).copied().collect();
        for name in gone {
            self.names.remove(&name);
            if !self.waiting.remove(&name) && self.is_connected {
                self.control(UNREGISTER, 0, &name.0.to_le_bytes());
            }
        }
        for name in here {
            if !self.names.contains_key(name) {
                self.register(*name);
            }
        }
    }

    /// Bytes have come. Each package for a mailbox goes to `each`. An error ends the connection.
    pub fn received(
        &mut self,
        bytes: &[u8],
        now: u64,
        mut each: impl FnMut(&Head, &[u8]),
    ) -> Result<(), HeadError> {
        self.last_heard = now;
        let mut frames = core::mem::take(&mut self.frames);
        let cut = frames.cut(bytes, |head, body| match (head.to, head.from) {
            (MailboxName::NOBODY, MailboxName::NOBODY) => self.of_router(&head, body, now),
            _ => {
                self.counters.received += 1;
                self.counters.bytes_received += u64::from(head.len);
                each(&head, body);
            }
        });
        self.frames = frames;
        cut
    }

    /// Answers a package that no mailbox here takes.
    pub fn answer(&mut self, head: &Head) {
        if self.own.len() + HEAD_LEN > ANSWERS {
            self.counters.answers_lost += 1;
        } else {
            self.own.extend_from_slice(&head.to_bytes());
        }
    }

    /// Registers names again whose time has come, and asks again about packages that wait at the router.
    pub fn retry(&mut self, now: u64) {
        self.now = now;
        let due = |at: &Registration| matches!(at, Registration::Refused(at) if *at <= now);
        let names: Vec<_> = self.names.iter().filter(|(_, at)| due(at)).map(|(name, _)| *name).collect();
        names.into_iter().for_each(|name| self.register(name));
    }

    /// When [`Self::retry`] is due, or the router counts as gone if nothing comes; or the next question, if it may be written.
    pub fn next_due(&self, may_write: bool) -> u64 {
        let retries = self.names.values().filter_map(|at| match at {
            Registration::Refused(at) => Some(*at),
            _ => None,
        });
        let questions = (may_write && self.has_unsettled()).then_some(self.ask_again);
        retries.chain(questions).fold(self.last_heard + SILENCE, u64::min)
    }

    /// Whether nothing has come for so long that the router counts as gone, or it reads nothing.
    pub fn is_silent(&self, now: u64) -> bool {
        now >= self.last_heard + SILENCE || self.own.len() > REQUESTS
    }

    /// Whether packages may leave: all mailboxes are asked for.
    pub fn takes_packages(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Whether all that it has taken is written.
    pub fn is_idle(&self) -> bool {
        self.own.is_empty() && self.written == self.batch.len()
    }

    /// Whether the router has read all packages that were sent.
    pub fn is_read(&self) -> bool {
        self.counters.sent == self.read
    }

    /// Writes requests, answers, and packages, which `next` appends one at a time as long as there are any.
    pub fn write(
        &mut self,
        mut next: impl FnMut(&mut Vec<u8>) -> bool,
        mut send: impl FnMut(&[u8]) -> io::Result<usize>,
    ) -> io::Result<Written> {
        for _ in 0..BATCHES {
            if self.written == self.batch.len() {
                self.fill(&mut next);
            }
            while self.written < self.batch.len() {
                match send(&self.batch[self.written..]) {
                    Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                    Ok(sent) => self.wrote(sent),
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(Written::Blocked),
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) => return Err(error),
                }
            }
            if self.batch.is_empty() {
                return Ok(Written::All);
            }
        }
        Ok(Written::More)
    }

    /// Names that are registered, and names that are not, or not yet.
    pub fn names(&self) -> (usize, usize) {
        let registered = self.names.values().filter(|at| **at == Registration::Registered).count();
        (registered, self.names.len() - registered)
    }

    /// Counters over all connections.
    pub fn counters(&self) -> SessionCounters {
        self.counters
    }

    /// Whether the router is asked for a confirmation.
    fn is_confirming(&self) -> bool {
        self.requests.has(|open| matches!(open, Asked::Confirmation(_)))
    }

    /// Whether there are packages that are not settled, and the router is not asked about them.
    fn has_unsettled(&self) -> bool {
        !self.is_confirming() && self.counters.sent > self.settled
    }

    fn register(&mut self, name: MailboxName) {
        self.names.insert(name, Registration::Open);
        self.waiting.insert(name);
    }

    fn ask(&mut self, what: Asked) {
        let id = self.requests.open(what);
        match what {
            Asked::Name(name) => self.control(REGISTER, id, &name.0.to_le_bytes()),
            Asked::Account => self.control(ACCOUNT, id, &[]),
            Asked::Confirmation(_) => self.control(CONFIRM, id, &MailboxName::NOBODY.0.to_le_bytes()),
        }
    }

    fn control(&mut self, kind: i8, id: u8, body: &[u8]) {
        self.own.extend_from_slice(&request(kind, id, body).to_bytes());
        self.own.extend_from_slice(body);
    }

    fn of_router(&mut self, head: &Head, body: &[u8], now: u64) {
        if head.kind == LIFESIGN {
            self.is_asked = true;
            return;
        }
        let Self { requests, names, waiting, .. } = self;
        // Other packages of the router answer nothing that was asked.
        let answered = requests.answered(head.id, |lost| match lost {
            Asked::Name(name) if names.contains_key(&name) => _ = waiting.insert(name),
            // A router of another make does not answer it.
            Asked::Name(_) | Asked::Account | Asked::Confirmation(_) => {}
        });
        match answered {
            Some(Asked::Confirmation(sent)) => {
                // No answer confirms packages that have not left, or that wait at the router.
                self.read = self.read.max(sent.min(self.counters.sent));
                let settled = self.read.saturating_sub(self.waiting_there);
                self.settled = self.settled.max(settled);
            }
            Some(Asked::Account) => {
                // A router of another make has none.
                if let Some(Account { lost, waiting }) = Account::parse(body).filter(|_| head.kind == OK) {
                    let lost = self.lost_before.plus(&lost);
                    self.counters.lost_at_router = self.counters.lost_at_router.max(&lost);
                    self.waiting_there = waiting;
                }
            }
            // A mailbox that went and came again is asked for a second time, which decides.
            Some(asked @ Asked::Name(_)) if requests.has(|open| *open == asked) => {}
            Some(Asked::Name(name)) => self.registered(name, head.kind == OK, now),
            None => {}
        }
    }

    fn registered(&mut self, name: MailboxName, is_done: bool, now: u64) {
        // It may be gone meanwhile.
        let Some(registration) = self.names.get_mut(&name) else { return };
        *registration = if is_done { Registration::Registered } else { Registration::Refused(now + RETRY) };
        self.counters.names_refused += u64::from(!is_done);
    }

    fn fill(&mut self, next: &mut impl FnMut(&mut Vec<u8>) -> bool) {
        self.batch.clear();
        self.written = 0;
        if core::mem::take(&mut self.is_asked) {
            self.control(OK, 0, &[]);
        }
        while self.requests.has_room()
            && let Some(name) = self.waiting.pop_first()
        {
            self.ask(Asked::Name(name));
        }
        self.batch.append(&mut self.own);
        // Packages follow once all mailboxes are asked for: what they are answered with finds its way back.
        while self.takes_packages() && self.batch.len() < BATCH && next(&mut self.batch) {
            self.ends.push_back(self.batch.len());
        }
        let sent = self.counters.sent + self.ends.len() as u64;
        let is_due = sent > self.asked || self.has_unsettled() && self.now >= self.ask_again;
        if is_due && !self.is_confirming() {
            (self.asked, self.ask_again) = (sent, self.now + CONFIRM_AGAIN);
            // In this order: packages that are confirmed are accounted for.
            self.ask(Asked::Account);
            self.ask(Asked::Confirmation(sent));
            self.batch.append(&mut self.own);
        }
    }

    fn wrote(&mut self, bytes: usize) {
        self.written += bytes;
        self.counters.bytes_sent += bytes as u64;
        while self.ends.front().is_some_and(|end| *end <= self.written) {
            self.ends.pop_front();
            self.counters.sent += 1;
        }
    }
}

#[cfg(test)]
mod tests;
