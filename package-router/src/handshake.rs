//! What a component and the broker tell each other: packets on the broker's socket. A connection is one component's: who hangs up
//! gives up its mailboxes.
//!
//! ```text
//! ask     "RTP4"  what 1  shape 13  name 4  from 4  lane 20  pattern 8  station 4
//!         and, to `Create`: the owner's file, the lanes', the set that its bells hang in
//! answer  "RTP4"  what 1  shape 13  name 4  detail 24  generation 8  lane 20  station 4  priority 1  channel 1
//!         and, to `Attach`: the board; to `Create`: the router's file, if there is one; to `Look`: the owner's, the lanes';
//!         to `Bind` here: the owner's, the lanes', a bell
//! shape   when full 1  slots 4  largest body 4  senders 4           lane    place 4  lane 4  mailbox 8  generation 4           numbers little-endian
//! ```

use core::net::Ipv4Addr;

use zerocopy::byteorder::little_endian::{U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::mailbox::{Shape, ShapeError, WhenFull};
use crate::name::{MailboxName, Pattern};
pub use crate::registry::LaneId as Lane;
use crate::registry::Refused;

/// Begins every packet.
const MAGIC: [u8; 4] = *b"RTP4";
/// Bytes of an ask.
pub const ASK_LEN: usize = size_of::<RawAsk>();
/// Bytes of an answer.
pub const ANSWER_LEN: usize = size_of::<RawAnswer>();
/// Files that come with a packet at the most.
pub const FILES: usize = 3;

/// What a component asks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ask {
    /// To be let in.
    Attach,
    /// A mailbox, whose memory comes along.
    Create(MailboxName, Shape),
    /// A mailbox is not needed any more.
    Delete(MailboxName),
    /// A lane from a mailbox of its own to another.
    Bind {
        /// Its own.
        from: MailboxName,
        /// The other.
        to: MailboxName,
    },
    /// A lane that was reserved is ready.
    Ready(Lane),
    /// A lane is not needed any more.
    Unbind(Lane),
    /// The first mailbox in that place, or behind it.
    Look(usize),
    /// Which route is that one, counted from the most specific.
    RouteAt(usize),
    /// From now on these mailboxes are at that station.
    AddRoute(Pattern, Ipv4Addr),
    /// There is no such route any more.
    DeleteRoute(Pattern),
    /// The way that packages for a mailbox go.
    Way(MailboxName),
}

/// What the broker answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// It is done.
    Done,
    /// It is not.
    Refused(Refused),
    /// The packet was none, or there is something else wrong with it: a number of `errno`.
    Failed(i32),
    /// The mailbox is there.
    Created {
        /// Where on the board.
        place: usize,
        /// Which it is of all that were there.
        generation: u64,
    },
    /// A lane is reserved.
    Reserved {
        /// Which.
        lane: Lane,
        /// What that is.
        shape: Shape,
        /// How urgent what is sent by it is, unless that is said.
        priority: u8,
        /// Whether it is a lane of the TCP client's mailbox: what is for the other mailbox goes by the TCP router.
        is_tcp: bool,
    },
    /// It is elsewhere: what is for it goes there by real-time UDP.
    Away {
        /// The station.
        station: Ipv4Addr,
        /// How urgent what is sent by it is, unless that is said.
        priority: u8,
        /// The slot that it leaves in.
        channel: u8,
    },
    /// A mailbox that is there.
    Mailbox {
        /// Where.
        place: usize,
        /// What it is called.
        name: MailboxName,
        /// What it is.
        shape: Shape,
        /// Its owner's process, as the broker sees it; 0: not at all.
        process: u32,
    },
    /// A route.
    Route(Pattern, Ipv4Addr),
    /// There is no other.
    NoMore,
    /// Packages for a mailbox go to the TCP router.
    ByTcp {
        /// Whether it is of another system than the station: no route leads there.
        is_of_other_system: bool,
    },
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned, Default)]
#[repr(C)]
struct RawAsk {
    magic: [u8; 4],
    what: u8,
    shape: RawShape,
    name: U32,
    from: U32,
    lane: RawLane,
    pattern: U64,
    station: [u8; 4],
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned, Default)]
#[repr(C)]
struct RawAnswer {
    magic: [u8; 4],
    what: u8,
    shape: RawShape,
    name: U32,
    detail: [U64; 3],
    generation: U64,
    lane: RawLane,
    station: [u8; 4],
    priority: u8,
    channel: u8,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned, Clone, Copy, Default)]
#[repr(C)]
struct RawShape {
    when_full: u8,
    slots: U32,
    largest_body: U32,
    senders: U32,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned, Clone, Copy, Default)]
#[repr(C)]
struct RawLane {
    place: U32,
    lane: U32,
    mailbox: U64,
    generation: U32,
}

impl Ask {
    /// As a packet.
    pub fn to_bytes(&self) -> [u8; ASK_LEN] {
        let mut raw = RawAsk { magic: MAGIC, ..RawAsk::default() };
        match *self {
            Ask::Attach => raw.what = 1,
            Ask::Create(name, shape) => {
                (raw.what, raw.name, raw.shape) = (2, U32::new(name.0), RawShape::of(&shape));
            }
            Ask::Delete(name) => (raw.what, raw.name) = (3, U32::new(name.0)),
            Ask::Bind { from, to } => {
                (raw.what, raw.name, raw.from) = (4, U32::new(to.0), U32::new(from.0));
            }
            Ask::Ready(lane) => (raw.what, raw.lane) = (5, RawLane::of(lane)),
            Ask::Unbind(lane) => (raw.what, raw.lane) = (6, RawLane::of(lane)),
            Ask::Look(place) => (raw.what, raw.lane) = (7, RawLane::of(Lane { place, ..Lane::default() })),
            Ask::RouteAt(place) => (raw.what, raw.lane) = (8, RawLane::of(Lane { place, ..Lane::default() })),
            Ask::AddRoute(to, station) => {
                (raw.what, raw.pattern, raw.station) = (9, U64::new(to.to_bits()), station.octets());
            }
            Ask::DeleteRoute(to) => (raw.what, raw.pattern) = (10, U64::new(to.to_bits())),
            Ask::Way(to) => (raw.what, raw.name) = (11, U32::new(to.0)),
        }
        zerocopy::transmute!(raw)
    }

    /// Reads a packet; `None`: nothing that could be asked.
    pub fn parse(packet: &[u8]) -> Option<Self> {
        let raw = RawAsk::ref_from_bytes(packet).ok().filter(|raw| raw.magic == MAGIC)?;
        let name = MailboxName(raw.name.get());
        Some(match raw.what {
            1 => Ask::Attach,
            2 => Ask::Create(name, raw.shape.shape()?),
            3 => Ask::Delete(name),
            4 => Ask::Bind { from: MailboxName(raw.from.get()), to: name },
            5 => Ask::Ready(raw.lane.lane()),
            6 => Ask::Unbind(raw.lane.lane()),
            7 => Ask::Look(raw.lane.lane().place),
            8 => Ask::RouteAt(raw.lane.lane().place),
            9 => Ask::AddRoute(Pattern::from_bits(raw.pattern.get())?, raw.station.into()),
            10 => Ask::DeleteRoute(Pattern::from_bits(raw.pattern.get())?),
            11 => Ask::Way(name),
            _ => return None,
        })
    }
}

const DONE: u8 = 0;
const FAILED: u8 = 1;
const CREATED: u8 = 2;
const RESERVED: u8 = 3;
const AWAY: u8 = 4;
const MAILBOX: u8 = 5;
const ROUTE: u8 = 6;
const NO_MORE: u8 = 7;
const RESERVED_TCP: u8 = 8;
const BY_TCP: u8 = 9;
const TAKEN: u8 = 16;
const NO_NAME: u8 = 17;
const TOO_MANY: u8 = 18;
const NO_MAILBOX: u8 = 19;
const NOT_OWN: u8 = 20;
const NO_LANE: u8 = 21;
const SLOTS: u8 = 32;
const BODY: u8 = 33;
const SENDERS: u8 = 34;
const MEMORY: u8 = 35;
const ANSWERS: u8 = 36;

impl Answer {
    /// As a packet.
    pub fn to_bytes(&self) -> [u8; ANSWER_LEN] {
        let mut raw = RawAnswer { magic: MAGIC, ..RawAnswer::default() };
        match *self {
            Answer::Done => raw.what = DONE,
            Answer::Failed(errno) => (raw.what, raw.detail[0]) = (FAILED, U64::new(errno as u64)),
            Answer::Created { place, generation } => {
                (raw.what, raw.generation) = (CREATED, U64::new(generation));
                raw.lane = RawLane::of(Lane { place, ..Lane::default() });
            }
            Answer::Reserved { lane, shape, priority, is_tcp } => {
                (raw.what, raw.priority) = (if is_tcp { RESERVED_TCP } else { RESERVED }, priority);
                (raw.lane, raw.shape) = (RawLane::of(lane), RawShape::of(&shape));
            }
            Answer::Away { station, priority, channel } => {
                (raw.what, raw.station) = (AWAY, station.octets());
                (raw.priority, raw.channel) = (priority, channel);
            }
            Answer::Mailbox { place, name, shape, process } => {
                (raw.what, raw.name, raw.shape) = (MAILBOX, U32::new(name.0), RawShape::of(&shape));
                (raw.lane, raw.detail[0]) =
                    (RawLane::of(Lane { place, ..Lane::default() }), U64::new(process.into()));
            }
            Answer::Route(to, station) => {
                (raw.what, raw.detail[0], raw.station) = (ROUTE, U64::new(to.to_bits()), station.octets());
            }
            Answer::NoMore => raw.what = NO_MORE,
            Answer::ByTcp { is_of_other_system } => {
                (raw.what, raw.detail[0]) = (BY_TCP, U64::new(is_of_other_system.into()));
            }
            Answer::Refused(refused) => raw.refuse(refused),
        }
        zerocopy::transmute!(raw)
    }

    /// Reads a packet; `None`: nothing that could be answered.
    pub fn parse(packet: &[u8]) -> Option<Self> {
        let raw = RawAnswer::ref_from_bytes(packet).ok().filter(|raw| raw.magic == MAGIC)?;
        let generation = raw.generation.get();
        Some(match raw.what {
            DONE => Answer::Done,
            FAILED => Answer::Failed(raw.detail[0].get() as i32),
            CREATED => Answer::Created { place: raw.lane.lane().place, generation },
            RESERVED | RESERVED_TCP => {
                let (lane, priority, is_tcp) = (raw.lane.lane(), raw.priority, raw.what == RESERVED_TCP);
                Answer::Reserved { lane, shape: raw.shape.shape()?, priority, is_tcp }
            }
            AWAY => {
                Answer::Away { station: raw.station.into(), priority: raw.priority, channel: raw.channel }
            }
            MAILBOX => Answer::Mailbox {
                place: raw.lane.lane().place,
                name: MailboxName(raw.name.get()),
                shape: raw.shape.shape()?,
                process: raw.detail[0].get() as u32,
            },
            ROUTE => Answer::Route(Pattern::from_bits(raw.detail[0].get())?, raw.station.into()),
            NO_MORE => Answer::NoMore,
            BY_TCP => Answer::ByTcp { is_of_other_system: raw.detail[0].get() != 0 },
            _ => Answer::Refused(raw.refused()?),
        })
    }
}

impl RawAnswer {
    fn refuse(&mut self, refused: Refused) {
        let (what, name, detail) = match refused {
            Refused::Taken(name) => (TAKEN, name, [0; 3]),
            Refused::NoName(name) => (NO_NAME, name, [0; 3]),
            Refused::TooMany => (TOO_MANY, MailboxName::NOBODY, [0; 3]),
            Refused::NoMailbox(name) => (NO_MAILBOX, name, [0; 3]),
            Refused::NotOwn(name) => (NOT_OWN, name, [0; 3]),
            Refused::NoLane(name, senders) => (NO_LANE, name, [senders, 0, 0]),
            Refused::Shape(ShapeError::Slots(n)) => (SLOTS, MailboxName::NOBODY, [n, 0, 0]),
            Refused::Shape(ShapeError::Body(n)) => (BODY, MailboxName::NOBODY, [n, 0, 0]),
            Refused::Shape(ShapeError::Senders(n)) => (SENDERS, MailboxName::NOBODY, [n, 0, 0]),
            Refused::Shape(ShapeError::Answers) => (ANSWERS, MailboxName::NOBODY, [0; 3]),
            Refused::Shape(ShapeError::Memory(bytes, slots, senders)) => {
                (MEMORY, MailboxName::NOBODY, [bytes, slots, senders])
            }
        };
        (self.what, self.name, self.detail) = (what, U32::new(name.0), detail.map(|n| U64::new(n as u64)));
    }

    fn refused(&self) -> Option<Refused> {
        let name = MailboxName(self.name.get());
        let [n, slots, senders] = self.detail.map(|n| n.get() as usize);
        Some(match self.what {
            TAKEN => Refused::Taken(name),
            NO_NAME => Refused::NoName(name),
            TOO_MANY => Refused::TooMany,
            NO_MAILBOX => Refused::NoMailbox(name),
            NOT_OWN => Refused::NotOwn(name),
            NO_LANE => Refused::NoLane(name, n),
            SLOTS => Refused::Shape(ShapeError::Slots(n)),
            BODY => Refused::Shape(ShapeError::Body(n)),
            SENDERS => Refused::Shape(ShapeError::Senders(n)),
            ANSWERS => Refused::Shape(ShapeError::Answers),
            MEMORY => Refused::Shape(ShapeError::Memory(n, slots, senders)),
            _ => return None,
        })
    }
}

impl RawShape {
    /// Numbers that do not fit are larger than any that can be.
    fn of(shape: &Shape) -> Self {
        let number = |n: usize| U32::new(u32::try_from(n).unwrap_or(u32::MAX));
        Self {
            when_full: match shape.when_full {
                WhenFull::Refuse => 0,
                WhenFull::Replace => 1,
                WhenFull::Answer => 2,
            },
            slots: number(shape.slots),
            largest_body: number(shape.largest_body),
            senders: number(shape.senders),
        }
    }

    fn shape(&self) -> Option<Shape> {
        let when_full = match self.when_full {
            0 => WhenFull::Refuse,
            1 => WhenFull::Replace,
            2 => WhenFull::Answer,
            _ => return None,
        };
        let [slots, largest_body, senders] =
            [self.slots, self.largest_body, self.senders].map(|n| n.get() as usize);
        Some(Shape { slots, largest_body, senders, when_full })
    }
}

impl RawLane {
    fn of(lane: Lane) -> Self {
        Self {
            place: U32::new(lane.place as u32),
            lane: U32::new(lane.lane as u32),
            mailbox: U64::new(lane.mailbox),
            generation: U32::new(lane.generation),
        }
    }
    fn lane(&self) -> Lane {
        Lane {
            place: self.place.get() as usize,
            lane: self.lane.get() as usize,
            mailbox: self.mailbox.get(),
            generation: self.generation.get(),
        }
    }
}

#[cfg(test)]
mod tests;
