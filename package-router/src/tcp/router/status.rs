//! The status of a router.

use core::net::SocketAddr;
use std::collections::BTreeMap;

use super::{Ending, Rates, Router};
use crate::name::MailboxName;
use crate::tcp::account::Lost;
use crate::tcp::numbers::numbers;

numbers! {
    /// Counters of a connection, or sums over all.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
    pub struct Counters {
        /// Packages of this connection that were passed on.
        packages_in,
        /// Their bytes.
        bytes_in,
        /// Packages for this connection that were queued.
        packages_out,
        /// Their bytes.
        bytes_out,
        /// Its packages to names that nobody has.
        nobody_there,
        /// Its packages whose sender is another connection's name.
        foreign_senders,
        /// Its packages that no rule allows.
        forbidden,
        /// Its packages that found their receiver's queue full.
        receiver_full,
        /// Its packages that made room for more urgent ones in their receiver's queue.
        overtaken,
        /// Its packages that waited for their receiver when its connection ended, or that its kernel had not confirmed.
        receiver_gone,
        /// Packages for it that found its queue full.
        queue_full,
        /// Packages for it that made room for more urgent ones.
        displaced,
        /// Packages that waited for it when it was closed.
        lost_at_close,
        /// Answers of the router that it did not read in time.
        answers_lost,
        /// Names that it might not register or delete.
        names_refused,
        /// Its control packages of unknown kinds.
        controls_ignored,
        /// Its control packages with a wrong body.
        controls_malformed,
        /// Connections beyond the limit.
        connections_refused,
        /// Attempts to take a connection that failed: for want of descriptors, say. It waits, and is tried again.
        accepts_failed,
        /// Files that were read again and had an error: the rules before stayed in force.
        rules_refused,
    }
}

impl Counters {
    /// Adds those of another.
    pub fn add(&mut self, other: &Self) {
        *self = self.with(other, |ours, theirs| ours + theirs);
    }

    /// Its packages that were not passed on.
    pub fn lost(&self) -> Lost {
        let Self {
            nobody_there, foreign_senders, forbidden, receiver_full, overtaken, receiver_gone, ..
        } = *self;
        Lost { nobody_there, foreign_senders, forbidden, receiver_full, overtaken, receiver_gone }
    }
}

/// A connection that is open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClientStatus {
    /// Where it comes from.
    pub peer: SocketAddr,
    /// Milliseconds since it was opened.
    pub open_for: u64,
    /// Its mailboxes.
    pub names: Vec<MailboxName>,
    /// Its part: a client, the router of another system, or a link to one.
    pub role: String,
    /// Whether it is asked for signs of life.
    pub watchdog: bool,
    /// Packages that wait for it.
    pub waiting: usize,
    /// Their bytes.
    pub waiting_bytes: usize,
    /// Milliseconds that the oldest of them has waited.
    pub oldest: Option<u64>,
    /// Its counters.
    pub counters: Counters,
    /// Its rates; none before its first round has ended.
    pub rates: Option<Rates>,
}

/// A connection that was closed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Closed {
    /// Where it came from.
    pub peer: SocketAddr,
    /// Why it was closed.
    pub why: Ending,
    /// When, in milliseconds of the router's clock.
    pub at: u64,
    /// For how many milliseconds it was open.
    pub open_for: u64,
    /// Its mailboxes at the end.
    pub names: Vec<MailboxName>,
    /// Its counters.
    pub counters: Counters,
}

/// A link of this router, open or not.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LinkStatus {
    /// The router that it leads to.
    pub router: String,
    /// The systems that are reached by it; none: all that no other link names.
    pub systems: Vec<u8>,
    /// Whether it is open, and the other router has sent something.
    pub is_open: bool,
    /// The failure of the last attempt to open it, or its end; while it is open, what keeps packages from it.
    pub last_error: Option<String>,
}

/// A router as it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    /// The open connections.
    pub clients: Vec<ClientStatus>,
    /// The last that were closed, the newest first.
    pub closed: Vec<Closed>,
    /// Its links.
    pub links: Vec<LinkStatus>,
    /// Sums over all connections so far.
    pub counters: Counters,
    /// How many connections were closed, by [`Ending::reason`]; all reasons are there.
    pub endings: BTreeMap<&'static str, u64>,
    /// The error of the file that was read again last, if it had one.
    pub rules_error: Option<String>,
    /// The rates of all connections; none before the first round has ended.
    pub rates: Option<Rates>,
}

impl Router {
    /// The router's status, without its links: the sockets know those.
    pub fn status(&self, now: u64) -> Status {
        let clients: Vec<ClientStatus> = self
            .clients
            .iter()
            .flatten()
            .map(|client| ClientStatus {
                peer: client.peer,
                open_for: now - client.since,
                names: client.names.iter().copied().collect(),
                role: client.role.name(),
                watchdog: client.watchdog,
                waiting: client.outgoing.packages(),
                waiting_bytes: client.outgoing.bytes(),
                oldest: client.outgoing.oldest(now),
                counters: client.counters,
                rates: client.meter.rates(),
            })
            .collect();
        let mut counters = self.counters;
        clients.iter().for_each(|client| counters.add(&client.counters));
        let closed = self.closed.iter().cloned().collect();
        Status {
            clients,
            closed,
            links: Vec::new(),
            counters,
            endings: self.counted_endings.clone(),
            rules_error: self.rules_error.clone(),
            rates: self.meter.rates(),
        }
    }
}
