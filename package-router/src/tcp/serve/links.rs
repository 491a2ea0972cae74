//! Links to the routers of other systems, on sockets.

use core::fmt::Display;
use std::collections::BTreeSet;

use mio::{Interest, Registry, Token};

use super::{LINKS, Server, Socket, broken};
use crate::tcp::address::Address;
use crate::tcp::control::Proof;
use crate::tcp::dial::{Dial, Opened};
use crate::tcp::keys::ClientKeys;
use crate::tcp::router::{Ending, LinkStatus, TooMany};
use crate::tcp::stream::Stream;

/// A link to the router of another system.
#[derive(Clone, Debug)]
pub struct LinkTo {
    /// That router.
    pub router: Address,
    /// Keys, if it is reached by TLS.
    pub keys: Option<ClientKeys>,
    /// The systems whose mailboxes are reached by it; none: all that no other link names.
    pub systems: BTreeSet<u8>,
}

/// A link of this router: it is opened again whenever it is lost.
pub(super) struct OwnLink {
    router: Address,
    systems: BTreeSet<u8>,
    dial: Dial,
    is_open: bool,
    last_error: Option<String>,
}

impl OwnLink {
    pub fn new(to: LinkTo) -> Self {
        let LinkTo { router, keys, systems } = to;
        let dial = Dial::new(router.clone(), keys);
        Self { router, systems, dial, is_open: false, last_error: None }
    }

    pub fn due(&self) -> Option<u64> {
        self.dial.due()
    }

    /// As it is; `unnamed` is a system whose router has a link here, too, and that this one does not name.
    pub fn status(&self, unnamed: Option<u8>) -> LinkStatus {
        let hint = |system| {
            format!(
                "the router of system {system} has a link here: if this one leads there, name the system in its `systems`, or packages \
                 of its clients that come by it are refused"
            )
        };
        LinkStatus {
            router: self.router.to_string(),
            systems: self.systems.iter().copied().collect(),
            is_open: self.is_open,
            last_error: unnamed.filter(|_| self.is_open).map(hint).or_else(|| self.last_error.clone()),
        }
    }

    /// Something has come by it.
    pub fn works(&mut self) {
        self.dial.works();
        (self.is_open, self.last_error) = (true, None);
    }

    /// It is over; another attempt follows.
    pub fn ended(&mut self, why: &Ending, now: u64) {
        if *why == Ending::SameSystem {
            self.dial.refused(now);
        } else {
            self.dial.lost(now);
        }
        self.note_end(why);
    }

    fn note_end(&mut self, why: &dyn Display) {
        (self.is_open, self.last_error) = (false, Some(why.to_string()));
    }

    fn go_on(&mut self, registry: &Registry, token: Token, now: u64) -> Option<Opened> {
        self.dial.go_on(registry, token, now).unwrap_or_else(|error| {
            self.last_error = Some(error.to_string());
            None
        })
    }
}

impl Server {
    /// Opens links that are not open, as far as that goes.
    pub(super) fn link(&mut self) {
        let now = self.now();
        for place in 0..self.links.len() {
            let opened = self.links[place].go_on(self.poll.registry(), Token(LINKS + place), now);
            if let Some(Opened { stream, proof }) = opened {
                self.linked(place, stream, proof.as_ref(), now);
            }
        }
    }

    fn linked(&mut self, place: usize, mut stream: Stream, proof: Option<&Proof>, now: u64) {
        let connection =
            stream.tcp.peer_addr().ok().and_then(|peer| self.router.link(place, peer, proof, now).ok());
        let Some(connection) = connection else {
            self.links[place].dial.lost(now);
            return self.links[place].note_end(&TooMany);
        };
        let (token, both) = (Token(connection.0 as usize), Interest::READABLE | Interest::WRITABLE);
        if let Err(error) = self.poll.registry().reregister(&mut stream.tcp, token, both) {
            let why = broken(&error);
            self.links[place].ended(&why, now);
            return self.router.disconnect(connection, why, now);
        }
        self.keep(connection, Socket { is_readable: true, ..Socket::new(stream, None) });
        self.readable.push(connection);
    }
}
