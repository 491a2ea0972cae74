//! A way from a mailbox of this component to another, wherever that is.

use core::net::Ipv4Addr;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use rtnet::discipline::Channel;
use rtnet::live::clock::monotonic;
use rtnet::live::sealed::Sealed;

use super::away::Away;
use super::{Error, Link, odd, short};
use crate::bells::Bell;
use crate::handshake::{Answer, Ask, FILES, Lane};
use crate::mailbox::{self, LaneSender, Layout, Origin, Segment, Shape, Stamps, Word};
use crate::name::MailboxName;
use crate::shared::Room;
use crate::wire::Head;

/// A way from a mailbox of this component to another, of this station or of one on the LAN.
pub struct Sender {
    link: Arc<Link>,
    way: Way,
    /// What of the board was so when it was bound.
    moves: u64,
    from: MailboxName,
    /// Where that mailbox is, and which it is of all that were there.
    own: (usize, u64),
    to: MailboxName,
    priority: u8,
    id: u8,
}

enum Way {
    /// Straight into it.
    Here(Here),
    /// Into the TCP client's mailbox.
    Tcp(Here),
    /// To the station that has it.
    Away(Box<Away>),
}

/// A lane of a mailbox of this station.
struct Here {
    link: Arc<Link>,
    lane: Option<(LaneSender<Room, Sealed>, Bell)>,
    which: Lane,
}

/// Why a package was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// The mailbox takes none.
    #[error(transparent)]
    Mailbox(#[from] mailbox::SendError),
    /// The TCP client takes no body that long.
    #[error(
        "a body of {got} bytes is longer than the TCP client takes ({most}): start the station with a larger `--router-body`, or the \
         component with a larger `largest_body`"
    )]
    LongerThanTcpTakes {
        /// Its bytes.
        got: usize,
        /// Bytes of the largest.
        most: usize,
    },
    /// It is there no more.
    #[error("{0} is there no more: bind to it anew once it is there again")]
    NoMailbox(MailboxName),
    /// The mailbox that it sends from is there no more: the name may be another's now.
    #[error("{0}, which it is from, is there no more")]
    Unbound(MailboxName),
    /// The station does not take it: a number of `errno`, as its sockets have them.
    #[error("the station does not take it: {}{}", std::io::Error::from_raw_os_error(*.0), remedy(*.0))]
    Station(i32),
}

/// The remedy against a number of `errno`, where the number's own text has none.
fn remedy(errno: i32) -> &'static str {
    match errno {
        libc::EMSGSIZE => {
            ": send less, or start the station with more buffers for each socket (`--socket-buffers`), of which each fragment \
             of a package takes one"
        }
        _ => "",
    }
}

impl Sender {
    /// From a mailbox of this component that is there, of that generation.
    pub(super) fn bind(
        link: &Arc<Link>,
        from: MailboxName,
        own: (usize, u64),
        to: MailboxName,
    ) -> Result<Self, Error> {
        let moves = link.board.moves();
        let (answer, files) = link.ask(Ask::Bind { from, to }, &[])?;
        let (way, priority) = match answer {
            Answer::Reserved { lane, shape, priority, is_tcp } => {
                let lane = Here::new(link, lane, &shape, files)?;
                (if is_tcp { Way::Tcp(lane) } else { Way::Here(lane) }, priority)
            }
            Answer::Away { station, priority, channel } => {
                (Way::Away(Box::new(Away::new(&link.station, station, channel)?)), priority)
            }
            answer => return Err(odd(&answer).into()),
        };
        Ok(Self { link: link.clone(), way, moves, from, own, to, priority, id: 0 })
    }

    /// To which mailbox.
    pub fn to(&self) -> MailboxName {
        self.to
    }

    /// Whether that is a mailbox of this station.
    pub fn is_here(&self) -> bool {
        matches!(self.way, Way::Here(_))
    }

    /// The other station to which it leads, and the slot; `None`: it leads to a mailbox of this one, or to the TCP router.
    pub fn away(&self) -> Option<(Ipv4Addr, Channel)> {
        match &self.way {
            Way::Here(_) | Way::Tcp(_) => None,
            Way::Away(away) => Some(away.to),
        }
    }

    /// Whether it still leads to where the name is: a mailbox of this station that is there, or, elsewhere, as long as none has
    /// come here and no route has changed.
    pub fn is_current(&self) -> bool {
        match &self.way {
            Way::Here(here) => here.is_there(),
            Way::Tcp(lane) => lane.is_there() && self.has_not_moved(),
            Way::Away(_) => self.has_not_moved(),
        }
    }

    fn has_not_moved(&self) -> bool {
        self.link.board.moves() == self.moves
    }

    /// Leads to where the name is now, if that may be elsewhere. It asks the broker, so it is not for who must be on time.
    pub fn follow(&mut self) -> Result<(), Error> {
        if !self.is_current() {
            let Self { id, priority, .. } = *self;
            *self = Self { id, priority, ..Self::bind(&self.link, self.from, self.own, self.to)? };
        }
        Ok(())
    }

    /// Waits until the station has taken what goes to another station: with this sender the rest is lost. It waits a second; then it
    /// returns ETIMEDOUT. [`taken`](Self::taken) says whether the station takes any at all. Packages for a mailbox here and for a TCP router need no
    /// wait: they are in memory that outlives their sender.
    pub fn drained(&self) -> Result<(), SendError> {
        match &self.way {
            Way::Here(_) | Way::Tcp(_) => Ok(()),
            Way::Away(away) => away.drained(),
        }
    }

    /// What the station says that it has taken of what goes elsewhere: to be compared with what it said before, and nothing else.
    pub fn taken(&self) -> u64 {
        match &self.way {
            Way::Here(_) | Way::Tcp(_) => 0,
            Way::Away(away) => away.taken(),
        }
    }

    /// How urgent its packages are, unless they say it.
    pub fn priority(&self) -> u8 {
        self.priority
    }

    /// How urgent its packages are, unless they say it: larger is more urgent.
    pub fn set_priority(&mut self, priority: u8) {
        self.priority = priority;
    }

    /// Sends a package. It does not wait, whatever its receiver does. Returns the package's number, which a reply has, too. A command
    /// that finds the queue to a TCP router full is answered NOT_AVAILABLE; while 256 of them wait for that, further ones are refused.
    #[inline]
    pub fn send(&mut self, kind: i8, body: &[u8]) -> Result<u8, SendError> {
        self.id = self.id.wrapping_add(1);
        let head = Head { kind, priority: self.priority, id: self.id, ..Head::default() };
        self.send_with(&head, body)?;
        Ok(self.id)
    }

    /// Sends a package with this head, but for whose it is, whom it is for and how long it is.
    #[inline]
    pub fn send_with(&mut self, head: &Head, body: &[u8]) -> Result<(), SendError> {
        let head = Head { from: self.from, to: self.to, ..*head };
        match &mut self.way {
            // A lane keeps the name from others; elsewhere nobody does.
            Way::Here(lane) => lane.send(&head, body, Origin::Here),
            Way::Tcp(lane) => lane.send(&head, body, Origin::Here).map_err(|error| match error {
                SendError::Mailbox(mailbox::SendError::TooLarge { got, most }) => {
                    SendError::LongerThanTcpTakes { got, most }
                }
                error => error,
            }),
            Way::Away(_) if !self.link.board.has(self.own.0, self.own.1) => {
                Err(SendError::Unbound(self.from))
            }
            Way::Away(away) => away.send(head, body),
        }
    }

    /// Brings a package into a mailbox here that came by the TCP router. It keeps its sender's name: no lane but the TCP client's takes
    /// that.
    pub(crate) fn bring(&mut self, head: &Head, body: &[u8]) -> Result<(), SendError> {
        match &mut self.way {
            Way::Here(lane) => lane.send(head, body, Origin::Elsewhere(None)),
            Way::Tcp(_) | Way::Away(_) => Err(SendError::NoMailbox(self.to)),
        }
    }

    /// Its own memory, where it counts: see [`mailbox::of_sender`]. What goes elsewhere the station counts.
    pub fn counted(&self, what: usize) -> u64 {
        match &self.way {
            Way::Here(Here { lane: Some((lane, _)), .. }) | Way::Tcp(Here { lane: Some((lane, _)), .. }) => {
                Word::get(lane.segment().at(what))
            }
            _ => 0,
        }
    }
}

impl Here {
    fn new(link: &Arc<Link>, which: Lane, shape: &Shape, files: Vec<OwnedFd>) -> Result<Self, Error> {
        // From now on it is given back when this is dropped.
        let mut here = Self { link: link.clone(), lane: None, which };
        let [owner, lanes, bell]: [OwnedFd; FILES] = files.try_into().map_err(|_| short())?;
        let layout = Layout::of(shape);
        let theirs = Sealed::open(owner, layout.owner_words(shape.lanes()))?;
        let own = Room::open(&lanes, &layout, which.lane)?;
        here.lane = Some((LaneSender::new(own, theirs, layout, which.lane), Bell::of(bell)));
        link.ask(Ask::Ready(which), &[])?;
        Ok(here)
    }

    #[inline]
    fn is_there(&self) -> bool {
        self.link.board.has(self.which.place, self.which.mailbox)
    }

    #[inline]
    fn send(&mut self, head: &Head, body: &[u8], origin: Origin) -> Result<(), SendError> {
        let is_there = self.is_there();
        let way = self.lane.as_mut().filter(|_| is_there);
        let (lane, bell) = way.ok_or(SendError::NoMailbox(head.to))?;
        let stamps = Stamps { sent: monotonic(), origin, ..Stamps::default() };
        if lane.send(head, body, &stamps)? {
            bell.ring();
        }
        Ok(())
    }
}

impl Drop for Here {
    fn drop(&mut self) {
        // It is not written any more before another may have it.
        self.lane = None;
        let _ = self.link.ask(Ask::Unbind(self.which), &[]);
    }
}
