//! The router's rules, without a socket or a clock: bytes of connections go in, bytes for connections wait to be written.

mod controls;
mod ending;
mod flight;
mod forward;
mod links;
mod rates;
mod round;
mod status;
#[cfg(test)]
mod tests;

use core::net::{IpAddr, SocketAddr};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io::{self, IoSlice};

use super::control::{Control, Proof};
use super::frames::Frames;
use super::outgoing::{Outgoing, Source};
use super::rules::Rules;
use crate::name::MailboxName;
use crate::wire::{HEAD_LEN, Head, MAX_LEN};
use flight::Flight;
use links::{Reach, Role};
use rates::Meter;

pub use ending::Ending;
pub use rates::Rates;
pub use status::{ClientStatus, Closed, Counters, LinkStatus, Status};

/// Milliseconds between two signs of life that are asked for.
pub const LIFESIGN_EVERY: u64 = 5_000;
/// Connections that are not trusted yet, at the most: strangers leave room for clients.
pub(super) const UNTRUSTED: usize = 256;
/// A network has more than its share of them with more than one of so many.
const SHARE: usize = 8;
/// Closed connections that are remembered.
const CLOSED: usize = 64;

/// A connection of the router. Its number is another's once it has been closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Connection(pub u32);

/// The limits of a router.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Connections.
    pub connections: usize,
    /// Mailboxes of one connection.
    pub names: usize,
    /// Mailboxes of all connections.
    pub all_names: usize,
    /// Bytes that wait for one connection, not less than the longest package.
    pub queue: usize,
    /// Bytes that wait for all connections, and of packages whose end has not come.
    pub memory: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { connections: 10_000, names: 1_024, all_names: 100_000, queue: 4 << 20, memory: 256 << 20 }
    }
}

/// As many connections are open as may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("as many connections are open here as may be (limits.connections)")]
pub struct TooMany;

/// The trust in a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trust {
    /// Its TLS session has not begun.
    Handshake,
    /// Its first package has to be this proof.
    Proof(Proof),
    /// It may do all that rules allow.
    Full,
}

/// Whether a connection shows that its client is alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Life {
    /// Something has come since it was asked, or it has not been asked.
    Shown,
    /// It is to be asked, and has no room for the question.
    Unasked,
    /// It was asked, and nothing has come since.
    Asked,
}

struct Client {
    /// Its number among all connections so far.
    number: u32,
    peer: SocketAddr,
    is_by_tls: bool,
    trust: Trust,
    role: Role,
    since: u64,
    frames: Frames,
    outgoing: Outgoing,
    flight: Flight,
    names: BTreeSet<MailboxName>,
    watchdog: bool,
    life: Life,
    /// It is among those that are to be written to.
    is_awake: bool,
    /// It is to be closed: nothing that it sends counts any more.
    is_ending: bool,
    /// Its packages that wait here, or are in flight to their receivers.
    waits: u64,
    counters: Counters,
    meter: Meter,
}

impl Client {
    /// Bytes that wait for it, and of its package that has begun.
    fn held(&self) -> usize {
        self.outgoing.held() + self.frames.begun()
    }
}

/// A router of packages among connections.
pub struct Router {
    limits: Limits,
    rules: Rules,
    /// The system of its own mailboxes.
    system: u8,
    /// The systems to which each link leads.
    links: Vec<Reach>,
    /// Those that are open, and their places in the configuration.
    open_links: Vec<(Connection, usize)>,
    clients: Vec<Option<Client>>,
    free: Vec<u32>,
    /// Connections so far.
    connections: u32,
    /// Connections that may do all that rules allow.
    trusted: usize,
    /// Connections that have not proved yet that they may come, the oldest first.
    untrusted: VecDeque<Connection>,
    table: BTreeMap<MailboxName, Connection>,
    awake: VecDeque<Connection>,
    endings: Vec<(Connection, Ending)>,
    closed: VecDeque<Closed>,
    /// Sums over the closed connections.
    counters: Counters,
    /// How many were closed, by [`Ending::reason`].
    counted_endings: BTreeMap<&'static str, u64>,
    /// The error of a file that was read again; none once another was read without.
    rules_error: Option<String>,
    /// The rate of all connections.
    meter: Meter,
    next_round: u64,
    /// The place of the connection whose turn is next in a round that has begun.
    round_at: usize,
    /// Bytes that wait for all connections, and of packages that have begun.
    held: usize,
    /// Memory for [`Self::write`].
    gone: Vec<(Source, u64)>,
}

impl Router {
    /// A router without connections. Times are milliseconds of any clock that does not go back.
    pub fn new(limits: Limits, now: u64) -> Self {
        Self {
            limits: Limits { queue: limits.queue.max(MAX_LEN), ..limits },
            rules: Rules::default(),
            system: 0,
            links: Vec::new(),
            open_links: Vec::new(),
            clients: Vec::new(),
            free: Vec::new(),
            connections: 0,
            trusted: 0,
            untrusted: VecDeque::new(),
            table: BTreeMap::new(),
            awake: VecDeque::new(),
            endings: Vec::new(),
            closed: VecDeque::new(),
            counters: Counters::default(),
            counted_endings: Ending::REASONS.map(|reason| (reason, 0)).into(),
            rules_error: None,
            meter: Meter::new(now),
            next_round: now + LIFESIGN_EVERY,
            round_at: 0,
            held: 0,
            gone: Vec::new(),
        }
    }

    /// Replaces the rules. Registered names stay.
    pub fn set_rules(&mut self, rules: Rules) {
        (self.rules, self.rules_error) = (rules, None);
    }

    /// Counts rules that cannot be, and remembers why. The rules before stay in force.
    pub fn refuse_rules(&mut self, why: String) {
        self.counters.rules_refused += 1;
        self.rules_error = Some(why);
    }

    /// Counts a connection that could not be taken: for want of descriptors, say.
    pub fn accept_failed(&mut self) {
        self.counters.accepts_failed += 1;
    }

    /// A connection from there is open.
    pub fn connect(&mut self, peer: SocketAddr, now: u64) -> Result<Connection, TooMany> {
        if self.is_full() {
            return Err(TooMany);
        }
        self.trusted += 1;
        Ok(self.add(peer, Trust::Full, now))
    }

    /// A connection from there is open, whose TLS session has not begun. One of too many such makes room for it: a client that may come
    /// proves that within moments. They take no place of [`Limits::connections`].
    pub fn connect_by_tls(&mut self, peer: SocketAddr, now: u64) -> Connection {
        let connection = self.add(peer, Trust::Handshake, now);
        self.untrusted.push_back(connection);
        if self.untrusted.len() > UNTRUSTED
            && let Some(crowding) = self.crowding()
        {
            self.untrusted.retain(|untrusted| *untrusted != crowding);
            self.end(crowding, Ending::Crowded);
        }
        connection
    }

    /// The oldest connection that is not trusted yet; of those of one network, if that has more than its share.
    fn crowding(&self) -> Option<Connection> {
        let network = |of: &Connection| Some(network(self.clients.get(of.0 as usize)?.as_ref()?.peer.ip()));
        let mut counts = BTreeMap::new();
        self.untrusted.iter().filter_map(network).for_each(|of| *counts.entry(of).or_insert(0) += 1);
        let (fullest, count) = counts.into_iter().max_by_key(|(_, count)| *count)?;
        let has_more = count > UNTRUSTED / SHARE;
        self.untrusted.iter().copied().find(|of| !has_more || network(of) == Some(fullest))
    }

    /// The TLS session of a connection has begun. With a proof, its first package has to be that.
    pub fn secured(&mut self, connection: Connection, proof: Option<Proof>) {
        let Some(client) = self.client(connection).filter(|client| client.trust == Trust::Handshake) else {
            return;
        };
        match proof {
            Some(proof) => (client.trust, client.life) = (Trust::Proof(proof), Life::Shown),
            None => self.trust(connection),
        }
    }

    /// A connection has proved that it may come. It is closed if as many are open as may be.
    fn trust(&mut self, connection: Connection) {
        self.untrusted.retain(|untrusted| *untrusted != connection);
        if self.is_full() {
            return self.end(connection, Ending::TooMany);
        }
        self.trusted += 1;
        if let Some(client) = self.client(connection) {
            (client.trust, client.life) = (Trust::Full, Life::Shown);
        }
    }

    /// Whether as many connections are open as may be: then another is refused, and counted.
    fn is_full(&mut self) -> bool {
        let is_full = self.trusted >= self.limits.connections;
        self.counters.connections_refused += u64::from(is_full);
        is_full
    }

    fn add(&mut self, peer: SocketAddr, trust: Trust, now: u64) -> Connection {
        self.connections = self.connections.wrapping_add(1);
        let client = Client {
            number: self.connections,
            peer,
            is_by_tls: trust == Trust::Handshake,
            trust,
            role: Role::default(),
            since: now,
            frames: Frames::default(),
            outgoing: Outgoing::new(self.limits.queue),
            flight: Flight::default(),
            names: BTreeSet::new(),
            watchdog: true,
            life: Life::Shown,
            is_awake: false,
            is_ending: false,
            waits: 0,
            counters: Counters::default(),
            meter: Meter::new(now),
        };
        match self.free.pop() {
            Some(place) => {
                self.clients[place as usize] = Some(client);
                Connection(place)
            }
            None => {
                self.clients.push(Some(client));
                Connection(self.clients.len() as u32 - 1)
            }
        }
    }

    /// Bytes have come from a connection.
    pub fn received(&mut self, from: Connection, bytes: &[u8], now: u64) {
        let Some(client) = self.client(from).filter(|client| !client.is_ending) else { return };
        // A handshake that takes long is no sign of life.
        if client.trust == Trust::Full {
            client.life = Life::Shown;
        }
        let mut frames = core::mem::take(&mut client.frames);
        self.held -= frames.begun();
        let cut = frames.cut_runs(bytes, |head, body, rest| self.package(from, &head, (body, rest), now));
        let begun = frames.begun();
        self.held += begun;
        let is_stranger = self.client(from).is_some_and(|client| {
            client.frames = frames;
            client.trust != Trust::Full && begun > HEAD_LEN + size_of::<Proof>()
        });
        match cut {
            Ok(()) if is_stranger => self.end(from, Ending::Stranger),
            Err(no_package) => self.end(from, no_package.into()),
            Ok(()) => self.make_memory(0, now),
        }
    }

    /// Hands over what waits for a connection, as much as `send` takes; tells whether all of it was taken.
    pub fn write(
        &mut self,
        to: Connection,
        send: impl FnMut(&[IoSlice<'_>]) -> io::Result<usize>,
    ) -> io::Result<bool> {
        let mut gone = core::mem::take(&mut self.gone);
        let Some(client) = self.client(to) else { return Ok(true) };
        let before = client.outgoing.held();
        let written = client.outgoing.write(send, &mut gone);
        gone.drain(..).for_each(|(source, count)| client.flight.takes(source, count));
        let left = before - client.outgoing.held();
        self.held -= left;
        self.gone = gone;
        written
    }

    /// The next connection that something has been left for since it was last named here.
    pub fn next_awake(&mut self) -> Option<Connection> {
        let next = self.awake.pop_front()?;
        if let Some(client) = self.client(next) {
            client.is_awake = false;
        }
        Some(next)
    }

    /// Whether [`Self::next_awake`] has one.
    pub fn has_awake(&self) -> bool {
        !self.awake.is_empty()
    }

    /// Whether anything waits to be written.
    pub fn has_waiting(&self) -> bool {
        self.clients.iter().flatten().any(|client| !client.is_ending && !client.outgoing.is_empty())
    }

    /// The next connection that is to be closed, and why.
    pub fn next_ending(&mut self) -> Option<(Connection, Ending)> {
        self.endings.pop()
    }

    /// A connection has been closed: its mailboxes are gone, and what waited for it.
    pub fn disconnect(&mut self, gone: Connection, why: Ending, now: u64) {
        let Some(mut client) = self.clients.get_mut(gone.0 as usize).and_then(Option::take) else { return };
        for name in &client.names {
            self.table.remove(name);
            self.tell_links(*name, false, now);
        }
        self.held -= client.held();
        self.trusted -= usize::from(client.trust == Trust::Full);
        client.counters.lost_at_close += client.outgoing.packages() as u64;
        for (source, count) in client.flight.all() {
            let Some(sender) = self.source(source) else { continue };
            sender.waits -= count;
            sender.counters.receiver_gone += count;
        }
        self.give_up(client.outgoing, now);
        self.counters.add(&client.counters);
        *self.counted_endings.entry(why.reason()).or_default() += 1;
        self.closed.truncate(CLOSED - 1);
        self.closed.push_front(Closed {
            peer: client.peer,
            why,
            at: now,
            open_for: now - client.since,
            names: client.names.into_iter().collect(),
            counters: client.counters,
        });
        self.awake.retain(|awake| *awake != gone);
        self.untrusted.retain(|untrusted| *untrusted != gone);
        self.open_links.retain(|(link, _)| *link != gone);
        self.endings.retain(|(ending, _)| *ending != gone);
        self.free.push(gone.0);
    }

    /// A connection is to be closed.
    fn end(&mut self, whom: Connection, why: Ending) {
        if let Some(client) = self.client(whom)
            && !core::mem::replace(&mut client.is_ending, true)
        {
            self.endings.push((whom, why));
        }
    }

    /// Makes room for a number of bytes: connections that hold the most are closed.
    fn make_memory(&mut self, bytes: usize, now: u64) {
        while self.held + bytes > self.limits.memory {
            let all =
                self.clients.iter().enumerate().filter_map(|(place, client)| Some((place, client.as_ref()?)));
            let Some((place, client)) = all.max_by_key(|(_, client)| client.held()) else { return };
            let (whom, held) = (Connection(place as u32), client.held());
            if held == 0 {
                return;
            }
            self.end(whom, Ending::NoMemory);
            self.held -= held;
            let empty = Outgoing::new(self.limits.queue);
            let Some(client) = self.client(whom) else { return };
            client.counters.lost_at_close += client.outgoing.packages() as u64;
            client.frames = Frames::default();
            let outgoing = core::mem::replace(&mut client.outgoing, empty);
            self.give_up(outgoing, now);
        }
    }

    /// The connection that a package came by, if it is still open.
    fn source(&mut self, of: Source) -> Option<&mut Client> {
        self.client(Connection(of.place)).filter(|client| client.number == of.number)
    }

    fn client(&mut self, of: Connection) -> Option<&mut Client> {
        self.clients.get_mut(of.0 as usize)?.as_mut()
    }

    /// A package, with the bytes behind it; returns the bytes of the packages among them that went the same way.
    fn package(&mut self, from: Connection, head: &Head, (body, rest): (&[u8], &[u8]), now: u64) -> usize {
        if !self.is_trusted(from, head, body) {
            return 0;
        }
        match Control::of(head, body) {
            Some(_) if self.place_of_link(from).is_some() => self.of_other_router(from, head, now),
            Some(control) => self.control(from, head, control, now),
            None => return self.forward(from, head, (body, rest), now),
        }
        0
    }
}

/// The network of an address: a host has as many addresses of IPv6 as it likes, all with the same 64 bits in front.
fn network(of: IpAddr) -> IpAddr {
    match of {
        IpAddr::V4(_) => of,
        IpAddr::V6(of) => IpAddr::V6((u128::from(of) >> 64 << 64).into()),
    }
}
