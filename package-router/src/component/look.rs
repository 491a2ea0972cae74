//! What a station's mailboxes are, and what they have counted, for people and tools: nobody is asked but the broker, and no
//! owner notices.

use core::net::Ipv4Addr;
use std::collections::BTreeSet;
use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use rtnet::live::sealed::Sealed;

use super::{Component, Error, odd, short};
use crate::board::LaneShown;
use crate::handshake::{Answer, Ask};
use crate::mailbox::{Latencies, Layout, Segment, Shape, Word, of_owner, of_sender};
use crate::name::{MailboxName, Pattern};
use crate::route::{Route, RouteError};
use crate::shared::{View, lane_at};

/// A mailbox of a station, and what it has counted so far.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MailboxSeen {
    /// What it is called.
    pub name: MailboxName,
    /// What it is.
    pub shape: Shape,
    /// Its owner's process; 0: it cannot be seen from the station.
    pub process: u32,
    /// Packages that were received.
    pub received: u64,
    /// Such that were cleaned away.
    pub cleaned: u64,
    /// The most that ever waited.
    pub most: u64,
    /// Such that said to be from somebody else.
    pub forged: u64,
    /// Such that could not be, and senders that wrote what cannot be.
    pub nonsense: u64,
    /// How long packages took from being sent to being received.
    pub latencies: Latencies,
    /// Who sends to it now.
    pub senders: Vec<SenderSeen>,
}

/// A sender of a mailbox, and what it has counted so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SenderSeen {
    /// The mailbox that it sends from.
    pub from: MailboxName,
    /// Packages that it has sent.
    pub sent: u64,
    /// Such that found no slot.
    pub full: u64,
    /// Such that no slot holds.
    pub too_large: u64,
    /// Such that made way for newer ones, unread.
    pub replaced: u64,
    /// Such that wait to be read.
    pub waiting: u64,
}

/// The way that packages for a mailbox go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// Into a mailbox of this station.
    Here {
        /// Its owner's process; 0: it cannot be seen from the station.
        process: u32,
    },
    /// By real-time UDP to another station, by that route.
    Station(Route),
    /// To the TCP router: there is no such mailbox here, and no route.
    Tcp {
        /// Whether it is of another system than the station: no route leads there.
        is_of_other_system: bool,
    },
}

impl Component {
    /// All mailboxes of the station, as they are now.
    pub fn mailboxes(&self) -> Result<Vec<MailboxSeen>, Error> {
        let mut all = Vec::new();
        let mut from = 0;
        loop {
            match self.link.ask(Ask::Look(from), &[])? {
                (Answer::NoMore, _) => return Ok(all),
                (Answer::Mailbox { place, name, shape, process }, files) => {
                    from = place + 1;
                    all.push(self.seen(place, name, shape, process, files)?);
                }
                (answer, _) => return Err(odd(&answer).into()),
            }
        }
    }

    /// The names of all mailboxes, as they are now.
    pub(crate) fn names(&self) -> Result<BTreeSet<MailboxName>, Error> {
        let mut all = BTreeSet::new();
        let mut from = 0;
        loop {
            match self.link.ask(Ask::Look(from), &[])? {
                (Answer::NoMore, _) => return Ok(all),
                (Answer::Mailbox { place, name, .. }, _) => {
                    from = place + 1;
                    all.insert(name);
                }
                (answer, _) => return Err(odd(&answer).into()),
            }
        }
    }

    /// Moves whenever [`Self::names`] has changed.
    pub(crate) fn name_changes(&self) -> u64 {
        self.link.board.names()
    }

    /// The way that packages for a mailbox go.
    ///
    /// # Errors
    /// [`Refused::NoMailbox`](crate::registry::Refused::NoMailbox): no layer takes them.
    pub fn way(&self, to: MailboxName) -> Result<Way, Error> {
        match self.link.ask(Ask::Way(to), &[])?.0 {
            Answer::Mailbox { process, .. } => Ok(Way::Here { process }),
            Answer::Route(by, station) => Ok(Way::Station(Route { to: by, station })),
            Answer::ByTcp { is_of_other_system } => Ok(Way::Tcp { is_of_other_system }),
            answer => Err(odd(&answer).into()),
        }
    }

    fn seen(
        &self,
        place: usize,
        name: MailboxName,
        shape: Shape,
        process: u32,
        files: Vec<OwnedFd>,
    ) -> Result<MailboxSeen, Error> {
        let [owner, lanes]: [OwnedFd; 2] = files.try_into().map_err(|_| short())?;
        let (layout, all) = (Layout::of(&shape), shape.lanes());
        let owner = Sealed::open(owner, layout.owner_words(all))?;
        let lanes = Arc::new(Sealed::open(lanes, lane_at(&layout, all))?);
        let count = |what| Word::get(owner.at(what));
        let senders = (0..all).filter_map(|lane| {
            let LaneShown::Bound { from, .. } = self.link.board.lane(place, lane) else { return None };
            let view = View::of(lanes.clone(), lane_at(&layout, lane), layout.sender_words())?;
            let count = |what| Word::get(view.at(what));
            let (sent, replaced) = (count(of_sender::SENT), count(of_sender::REPLACED));
            let seen = SenderSeen {
                from,
                sent,
                full: count(of_sender::FULL),
                too_large: count(of_sender::TOO_LARGE),
                replaced,
                waiting: layout.waiting(&owner, &view, lane),
            };
            (from != MailboxName::NOBODY).then_some(seen)
        });
        Ok(MailboxSeen {
            name,
            shape,
            process,
            received: count(of_owner::RECEIVED),
            cleaned: count(of_owner::CLEANED),
            most: count(of_owner::MOST),
            forged: count(of_owner::FORGED),
            nonsense: count(of_owner::NONSENSE),
            latencies: Latencies::read(&owner, of_owner::LATENCIES),
            senders: senders.collect(),
        })
    }

    /// Which mailboxes are at which other stations, the most specific first.
    pub fn routes(&self) -> Result<Vec<Route>, Error> {
        let mut all = Vec::new();
        loop {
            match self.link.ask(Ask::RouteAt(all.len()), &[])? {
                (Answer::NoMore, _) => return Ok(all),
                (Answer::Route(to, station), _) => all.push(Route { to, station }),
                (answer, _) => return Err(odd(&answer).into()),
            }
        }
    }

    /// From now on these mailboxes are at that station; whoever is bound to one stays so until it binds anew.
    pub fn add_route(&self, to: Pattern, station: Ipv4Addr) -> Result<(), Error> {
        self.link.ask(Ask::AddRoute(to, station), &[]).map(drop).map_err(|error| match number(&error) {
            Some(libc::ENOSPC) => RouteError::Full.into(),
            Some(libc::EADDRNOTAVAIL) => RouteError::NotAStation(station, "write that of one station").into(),
            Some(libc::EXDEV) => RouteError::OtherSystem(to).into(),
            _ => error,
        })
    }

    /// There is no such route any more.
    pub fn delete_route(&self, to: Pattern) -> Result<(), Error> {
        self.link.ask(Ask::DeleteRoute(to), &[]).map(drop).map_err(|error| match number(&error) {
            Some(libc::ENOENT) => RouteError::Unknown(to).into(),
            _ => error,
        })
    }
}

fn number(error: &Error) -> Option<i32> {
    match error {
        Error::Io(error) => io::Error::raw_os_error(error),
        _ => None,
    }
}
