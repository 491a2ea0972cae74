//! Ways between the routers of two systems, so that mailboxes of one reach those of the other by their names.
//!
//! ```text
//! clients of system 1 ─► router of 1 ══ link ══► router of 2 ─► clients of system 2
//!                        registers 1.*           passes nothing on to a link of its own
//! ```
//!
//! A link is a connection that a router opens, as a client of the other router. It says of which system it is, and registers the
//! mailboxes of that there. Packages go one link far: so there are no loops. A link to a router of the same system is refused.

use std::collections::BTreeSet;

use core::net::SocketAddr;

use super::{Connection, Ending, Router, TooMany};
use crate::name::MailboxName;
use crate::tcp::control::{self, CONFIRM, LIFESIGN, PROOF, Proof, REGISTER, ROUTER, UNREGISTER};
use crate::tcp::requests::{OPEN_AT_MOST, Requests};
use crate::wire::{HEAD_LEN, Head, OK};

/// Bytes of a request that names a mailbox.
const REQUEST: usize = HEAD_LEN + 4;

/// The part that a connection has.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) enum Role {
    /// A client of this system.
    #[default]
    Client,
    /// The router of another system, which has opened it.
    Peer(u8),
    /// A link of this router's.
    Link(Link),
}

/// A link that is open.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Link {
    /// Its place in the configuration.
    place: usize,
    reach: Reach,
    requests: Requests<Asked>,
    /// Mailboxes that are to be registered there.
    waiting: BTreeSet<MailboxName>,
    /// Mailboxes that the other router has refused: they are asked for again in the next round.
    refused: BTreeSet<MailboxName>,
}

/// The systems to which a link leads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Reach {
    /// The systems that its configuration names.
    Only(BTreeSet<u8>),
    /// All systems but these, which other links name: its configuration names none.
    AllBut(BTreeSet<u8>),
}

impl Reach {
    fn contains(&self, system: u8) -> bool {
        match self {
            Self::Only(systems) => systems.contains(&system),
            Self::AllBut(systems) => !systems.contains(&system),
        }
    }
}

/// A request to the other router.
#[derive(Debug, PartialEq, Eq)]
enum Asked {
    /// That this is the router of a system.
    Announcement,
    /// A mailbox.
    Name(MailboxName),
    /// Whether it lives.
    Alive,
}

impl Role {
    /// The name in reports.
    pub fn name(&self) -> String {
        match self {
            Role::Client => "client".into(),
            Role::Peer(system) => format!("router of system {system}"),
            Role::Link(_) => "link".into(),
        }
    }

    /// Whether it is a link whose configuration names that system.
    pub fn is_link_of(&self, system: u8) -> bool {
        matches!(self, Role::Link(Link { reach: Reach::Only(systems), .. }) if systems.contains(&system))
    }

    /// Whether a mailbox may be of whoever is at the other end, in a network of which this router has `own` system.
    pub fn may_have(&self, name: MailboxName, own: u8) -> bool {
        match self {
            Role::Client => true,
            Role::Peer(system) => name.system() == *system,
            Role::Link(link) => {
                let system = name.system();
                system != own && link.reach.contains(system)
            }
        }
    }
}

impl Router {
    /// Sets the system of its own mailboxes, and the systems to which each link leads; a link without any leads to all that no other
    /// names.
    pub fn set_links(&mut self, system: u8, links: Vec<BTreeSet<u8>>) {
        let named: BTreeSet<u8> = links.iter().flatten().copied().collect();
        let reach = |systems: BTreeSet<u8>| match systems.is_empty() {
            true => Reach::AllBut(named.clone()),
            false => Reach::Only(systems),
        };
        (self.system, self.links) = (system, links.into_iter().map(reach).collect());
    }

    /// A link is open: it begins with the proof, if it needs one.
    pub fn link(
        &mut self,
        place: usize,
        peer: SocketAddr,
        proof: Option<&Proof>,
        now: u64,
    ) -> Result<Connection, TooMany> {
        let connection = self.connect(peer, now)?;
        // Requests to delete mailboxes have no answer that could pace them.
        let most = (self.limits.all_names + OPEN_AT_MOST) * REQUEST;
        let waiting = self.table.keys().copied().filter(|name| name.system() == self.system).collect();
        let reach = self.links.get(place).cloned().unwrap_or(Reach::AllBut(BTreeSet::new()));
        let link = Link { place, reach, requests: Requests::default(), waiting, refused: BTreeSet::new() };
        if let Some(client) = self.client(connection) {
            client.role = Role::Link(link);
            client.outgoing.let_own_wait(most);
        }
        self.open_links.push((connection, place));
        proof.iter().for_each(|proof| self.request(connection, PROOF, 0, *proof, now));
        self.ask(connection, Asked::Announcement, now);
        self.ask_waiting(connection, now);
        Ok(connection)
    }

    /// The place of the link that a connection is, if it is one.
    pub fn place_of_link(&self, connection: Connection) -> Option<usize> {
        match self.clients.get(connection.0 as usize)?.as_ref()?.role {
            Role::Link(ref link) => Some(link.place),
            _ => None,
        }
    }

    /// A system whose router is connected here, and that an open link leads to without naming it: perhaps the same router's. Packages
    /// that come by the link in names that are registered here are refused.
    pub fn unnamed_system(&self, place: usize) -> Option<u8> {
        let reach = self.links.get(place).filter(|reach| matches!(reach, Reach::AllBut(_)))?;
        let is_open = self.open_links.iter().any(|(_, open)| *open == place);
        let systems = self.clients.iter().flatten().filter_map(|client| match client.role {
            Role::Peer(system) => Some(system),
            _ => None,
        });
        systems.filter(|system| is_open && reach.contains(*system)).min()
    }

    /// The link that leads to the system of a mailbox, if one does.
    pub(super) fn way_out(&self, to: MailboxName) -> Option<Connection> {
        if to.system() == self.system {
            return None;
        }
        let leads_there =
            |place: &usize| self.links.get(*place).is_some_and(|reach| reach.contains(to.system()));
        self.open_links.iter().find(|(_, place)| leads_there(place)).map(|(link, _)| *link)
    }

    /// A mailbox of this system has come or gone: the other routers hear of it.
    pub(super) fn tell_links(&mut self, name: MailboxName, is_there: bool, now: u64) {
        if name.system() != self.system {
            return;
        }
        for place in 0..self.open_links.len() {
            let (link, _) = self.open_links[place];
            let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role) else { continue };
            if is_there {
                of.waiting.insert(name);
                self.ask_waiting(link, now);
            } else if !of.waiting.remove(&name) && !of.refused.remove(&name) {
                self.request(link, UNREGISTER, 0, &name.0.to_le_bytes(), now);
            }
        }
    }

    /// Asks for a sign of life, and again for mailboxes that the other router has refused.
    pub(super) fn ask_again(&mut self, link: Connection, now: u64) {
        let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role) else { return };
        let mut refused = core::mem::take(&mut of.refused);
        of.waiting.append(&mut refused);
        self.ask(link, Asked::Alive, now);
        self.ask_waiting(link, now);
    }

    /// A control package of another router, by a link.
    pub(super) fn of_other_router(&mut self, link: Connection, head: &Head, now: u64) {
        if head.kind == LIFESIGN {
            self.own(link, &head.answer(OK), now);
            return;
        }
        let Some(client) = self.client(link) else { return };
        let Role::Link(of) = &mut client.role else { return };
        let Link { requests, waiting, refused, .. } = of;
        // Other packages of a router answer nothing that was asked.
        let answered = requests.answered(head.id, |lost| {
            if let Asked::Name(name) = lost {
                waiting.insert(name);
            }
        });
        match answered {
            // A mailbox that went and came again is asked for a second time, which decides.
            Some(asked @ Asked::Name(_)) if requests.has(|open| *open == asked) => {}
            Some(Asked::Name(name)) if head.kind != OK => {
                refused.insert(name);
                client.counters.names_refused += 1;
            }
            Some(Asked::Announcement) if head.kind != OK => self.end(link, Ending::SameSystem),
            _ => {}
        }
        self.ask_waiting(link, now);
    }

    /// Another router says of which system it is; whether that can be.
    pub(super) fn announced(&mut self, from: Connection, system: u32) -> bool {
        let own = self.system;
        let Some(client) = self.client(from) else { return false };
        let system = u8::try_from(system).ok().filter(|system| *system != own);
        match (system, &client.role) {
            (Some(system), Role::Client) if client.names.is_empty() => {
                client.role = Role::Peer(system);
                true
            }
            _ => false,
        }
    }

    /// Registers mailboxes that wait for that, as many at a time as the other router surely answers.
    fn ask_waiting(&mut self, link: Connection, now: u64) {
        while let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role)
            && of.requests.has_room()
            && let Some(name) = of.waiting.pop_first()
        {
            // One that has gone since its registration was lost is asked for no more.
            if self.table.contains_key(&name) {
                self.ask(link, Asked::Name(name), now);
            }
        }
    }

    fn ask(&mut self, link: Connection, what: Asked, now: u64) {
        let (kind, number) = match what {
            Asked::Announcement => (ROUTER, u32::from(self.system)),
            Asked::Name(name) => (REGISTER, name.0),
            Asked::Alive => (CONFIRM, MailboxName::NOBODY.0),
        };
        let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role) else { return };
        let id = of.requests.open(what);
        self.request(link, kind, id, &number.to_le_bytes(), now);
    }

    fn request(&mut self, link: Connection, kind: i8, id: u8, body: &[u8], now: u64) {
        self.own_with(link, &control::request(kind, id, body), body, now);
    }
}

#[cfg(test)]
mod tests;
