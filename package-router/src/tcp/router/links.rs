//! Ways between the routers of two systems, so that mailboxes of one reach those of the other by their names.
//!
//! ```text
//! clients of system 1 ─► router of 1 ══ link ══► router of 2 ─► clients of system 2
//!                        registers 1.*           passes nothing on to a link of its own
//! ```
//!
//! A link is a connection that a router opens, as a client of the other router. It says of which system it is, and registers the
//! mailboxes of that there. Packages go one link far: so there are no loops. A link to a router of the same system is refused.

use std::collections::{BTreeSet, VecDeque};

use core::net::SocketAddr;

use super::{Connection, Ending, Router, TooMany, Trust};
use crate::name::MailboxName;
use crate::tcp::control::{LIFESIGN, PROOF, Proof, REGISTER, ROUTER, UNREGISTER};
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
    /// Requests that the other router has not answered, in their order; `None`: the announcement.
    asked: VecDeque<(u8, Option<MailboxName>)>,
    id: u8,
    /// Mailboxes that the other router has refused: they are asked for again in the next round.
    refused: BTreeSet<MailboxName>,
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

    /// Whether a mailbox may be of whoever is at the other end, in a network of which this router has `own` system.
    pub fn may_have(&self, name: MailboxName, own: u8) -> bool {
        match self {
            Role::Client => true,
            Role::Peer(system) => name.system() == *system,
            Role::Link(_) => name.system() != own,
        }
    }
}

impl Router {
    /// Sets the system of its own mailboxes, and the systems to which each link leads; a link without any leads to all.
    pub fn set_links(&mut self, system: u8, links: Vec<BTreeSet<u8>>) {
        (self.system, self.links) = (system, links);
    }

    /// A link is open: it begins with the proof, if it needs one.
    pub fn link(
        &mut self,
        place: usize,
        peer: SocketAddr,
        proof: Option<&Proof>,
        now: u64,
    ) -> Result<Connection, TooMany> {
        let connection = self.add(peer, Trust::Full, now)?;
        let most = (self.limits.all_names + 2) * 2 * REQUEST;
        let link = Link { place, asked: VecDeque::new(), id: 0, refused: BTreeSet::new() };
        if let Some(client) = self.client(connection) {
            client.role = Role::Link(link);
            client.outgoing.let_own_wait(most);
        }
        proof.iter().for_each(|proof| self.request(connection, PROOF, 0, *proof, now));
        self.ask(connection, ROUTER, None, now);
        let own: Vec<_> = self.table.keys().copied().filter(|name| name.system() == self.system).collect();
        own.into_iter().for_each(|name| self.ask(connection, REGISTER, Some(name), now));
        Ok(connection)
    }

    /// The place of the link that a connection is, if it is one.
    pub fn place_of_link(&self, connection: Connection) -> Option<usize> {
        match self.clients.get(connection.0 as usize)?.as_ref()?.role {
            Role::Link(ref link) => Some(link.place),
            _ => None,
        }
    }

    /// The link by which a package leaves that comes from one of this system's clients, if one leads there.
    pub(super) fn way_out(&self, from: Connection, to: MailboxName) -> Option<Connection> {
        let is_client =
            self.clients[from.0 as usize].as_ref().is_some_and(|client| client.role == Role::Client);
        if !is_client || to.system() == self.system {
            return None;
        }
        self.open_links()
            .find(|(_, place)| {
                let systems = self.links.get(*place);
                systems.is_some_and(|systems| systems.is_empty() || systems.contains(&to.system()))
            })
            .map(|(link, _)| link)
    }

    /// A mailbox of this system has come or gone: the other routers hear of it.
    pub(super) fn tell_links(&mut self, name: MailboxName, is_there: bool, now: u64) {
        if name.system() != self.system || self.links.is_empty() {
            return;
        }
        let links: Vec<_> = self.open_links().map(|(link, _)| link).collect();
        for link in links {
            match is_there {
                true => self.ask(link, REGISTER, Some(name), now),
                false => {
                    if let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role) {
                        of.refused.remove(&name);
                    }
                    self.request(link, UNREGISTER, 0, &name.0.to_le_bytes(), now);
                }
            }
        }
    }

    /// Asks again for mailboxes that another router has refused.
    pub(super) fn ask_again(&mut self, link: Connection, now: u64) {
        let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role) else { return };
        for name in core::mem::take(&mut of.refused) {
            self.ask(link, REGISTER, Some(name), now);
        }
    }

    /// A control package of another router, by a link.
    pub(super) fn of_other_router(&mut self, link: Connection, head: &Head, now: u64) {
        if head.kind == LIFESIGN {
            return self.own(link, &head.answer(OK), now);
        }
        let Some(client) = self.client(link) else { return };
        let Role::Link(of) = &mut client.role else { return };
        let place = of.asked.iter().position(|(id, _)| *id == head.id);
        // Other packages of a router answer nothing that was asked.
        let Some((_, name)) = place.and_then(|place| of.asked.remove(place)) else { return };
        match name {
            _ if head.kind == OK => {}
            Some(name) => {
                of.refused.insert(name);
                client.counters.names_refused += 1;
            }
            None => self.endings.push((link, Ending::SameSystem)),
        }
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

    fn open_links(&self) -> impl Iterator<Item = (Connection, usize)> {
        let all = self.clients.iter().enumerate();
        all.filter_map(|(place, client)| match &client.as_ref()?.role {
            Role::Link(link) => Some((Connection(place as u32), link.place)),
            _ => None,
        })
    }

    /// Asks for something that is answered.
    fn ask(&mut self, link: Connection, kind: i8, name: Option<MailboxName>, now: u64) {
        let number = name.map_or(u32::from(self.system), |name| name.0);
        let Some(Role::Link(of)) = self.client(link).map(|client| &mut client.role) else { return };
        of.id = of.id.wrapping_add(1);
        of.asked.push_back((of.id, name));
        let id = of.id;
        self.request(link, kind, id, &number.to_le_bytes(), now);
    }

    fn request(&mut self, link: Connection, kind: i8, id: u8, body: &[u8], now: u64) {
        let len = (HEAD_LEN + body.len()) as u32;
        let head = Head { id, len, ..Head::new(kind, MailboxName::NOBODY, MailboxName::NOBODY) };
        self.own_with(link, &head, body, now);
    }
}

#[cfg(test)]
mod tests;
