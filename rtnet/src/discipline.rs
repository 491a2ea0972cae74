//! The two hooks: how a station shares the medium, and what sits beside its sockets.
//!
//! ```text
//!            on_frame ┌────────────┐ opportunity, next_transmission
//!   medium ─────────► │ Discipline │ ─────────────────────────────► medium
//!              │      └────────────┘        ▲
//!              │            ▲ enqueue       │ next_deadline: one wake-up per slot
//!              ▼            │
//!           ┌─────────┐ poll│
//!           │ Service │ ────┘
//!           └─────────┘
//! ```
//!
//! Both are pure: they are given the time with every call and never ask for it.

mod event;
mod time_view;

use crate::buf::{Blank, Buf};
use crate::counters::Refusal;
use crate::ip::route::Routes;
use crate::queue::Priority;
use crate::time::{GlobalTime, Instant};
use crate::wire::checksum;
use crate::wire::ethernet::{EtherType, Header};

pub use event::{Cause, Event, EventKind};
pub use time_view::{SyncState, TimeView};

/// The slot id that a frame is to leave in: 0 real-time, 1 non-real-time, 2.. the user's.
pub type Channel = u8;

/// A way to share the medium.
pub trait Discipline: Send {
    /// What the control thread asks for; applied between two slots.
    type Command: Send;
    /// Why it was not: plain data, put into words by the control thread.
    type Refused: core::fmt::Display + Send;
    /// What there is to be seen.
    type Status: Copy + Send;

    /// Whether a frame with this header is the discipline's own. TDMA: EtherType 0x9021.
    fn claims(&self, header: &Header) -> bool;
    /// A frame that it claims. `rx` is the kernel's stamp on this station's clock, or `None` when
    /// the stamp could not be trusted.
    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Claimed;
    /// Time has passed. All timers live inside; one deadline is seen outside.
    fn on_timeout(&mut self, now: Instant);
    /// The data slot about to come, once `now` has reached it less the lead.
    fn opportunity(&mut self, now: Instant) -> Option<Opportunity>;
    /// The next frame to send, once `now` has reached its instant less the lead. It must be answered
    /// by [`Discipline::on_sent`] before the next is asked for. `None` also ends an opportunity for
    /// which nothing was queued.
    fn next_transmission(&mut self, now: Instant) -> Option<Transmission>;
    /// What became of the transmission. A frame that missed its slot comes back with where it was
    /// queued: its maker decides whether it is still worth sending.
    fn on_sent(&mut self, outcome: Sent) -> Option<Returned>;
    /// Queues a frame for the slot `channel`.
    fn enqueue(&mut self, frame: Buf, priority: Priority, channel: Channel) -> Result<(), (SendError, Buf)>;
    /// Whether a frame waits that the slot `channel` would take. Without slots none takes another's turn.
    fn is_waiting(&self, _channel: Channel) -> bool {
        false
    }
    /// Whether a frame waits that leaves in this very turn. With slots none does: it waits for its own.
    fn has_queued(&self) -> bool {
        false
    }
    /// Whether what the kernel refused is tried again: in the next slot.
    fn tries_again(&self) -> bool {
        true
    }
    /// Puts a frame that missed its slot back before the others of its priority.
    fn put_back(&mut self, frame: Returned);
    /// Largest payload behind the Ethernet header that fits the slot.
    fn payload_limit(&self, channel: Channel) -> Result<usize, SendError>;
    /// When to wake next. `None`: nothing to do until a frame arrives.
    fn next_deadline(&self) -> Option<Instant>;
    /// Whether a frame that arrives wakes the station before its deadline. Who waits for a slot is not: it would be for
    /// nothing, and all stations would wake at once.
    fn wakes_on_frames(&self) -> bool {
        false
    }
    /// What is known of the master's time.
    fn time(&self) -> TimeView;
    /// The oldest thing worth telling that has not been told.
    fn next_event(&mut self) -> Option<Event>;
    /// Applies what the control thread asked for; tells the first cycle in which it holds. What is
    /// replaced is left in `command`: whoever asked frees it, not the real-time thread.
    fn command(&mut self, now: Instant, command: &mut Self::Command) -> Result<u32, Self::Refused>;
    /// Counters and state.
    fn status(&self) -> Self::Status;
}

/// What sits beside the sockets: the tunnel, the lab's test traffic, later the package router. Who is named first is
/// asked first.
pub trait Service: Send {
    /// Whether frames of this EtherType are for it.
    fn claims(&self, ether_type: EtherType) -> bool;
    /// A frame that it claims. To keep it, it must be handed over to a pool of the service's own.
    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Result<(), Refusal>;
    /// A sound packet for this station that its sockets and echoes have no part in, behind its Ethernet header and without
    /// what it was padded by. Who has the station's address, too, takes it as it takes a frame that it claims; else it comes back.
    fn on_unwanted(&mut self, packet: Buf) -> Result<(), Buf> {
        Err(packet)
    }
    /// Synchronisation was gained, bridged or lost.
    fn on_sync_state(&mut self, _view: &TimeView) {}
    /// A slot is about to come: the last moment to queue a frame for it.
    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>);
    /// All have been asked, and nothing waits for the slot: it is empty unless there is a frame now. Who sends packets finds
    /// their way by the routes of the station's sockets, if it has some.
    fn fill(&mut self, _slot: &Opportunity, _routes: Option<&Routes>, _out: &mut Outlet<'_>) {}
    /// A frame of its own was chosen for the slot: the last moment to say so in it. It stays as long as it is.
    fn leaves(&mut self, _slot: &Opportunity, _frame: &mut [u8]) {}
    /// Whether a frame of its own that missed its slot is still worth sending in the next.
    fn still_wanted(&mut self, _frame: &[u8], _priority: Priority) -> bool {
        true
    }
    /// A frame of its own that the kernel refused does not leave any more.
    fn given_up(&mut self, _frame: &[u8], _priority: Priority) {}
    /// The slot's frame has left: time for what takes longer.
    fn rest(&mut self) {}
    /// The station is about to wait until it is rung for, or is awake again. Tells whether it should not wait.
    fn sleeps(&mut self, _is_asleep: bool) -> bool {
        false
    }
}

/// Where a service leaves its frames.
pub type Outlet<'a> = dyn FnMut(Buf, Priority, Channel) -> Result<(), (SendError, Buf)> + 'a;

/// A data slot about to come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opportunity {
    /// Which slot.
    pub channel: Channel,
    /// In which cycle.
    pub cycle: u32,
    /// Its begin on this station's clock.
    pub begin: Instant,
    /// Its begin on the master's clock, as the schedule has it.
    pub scheduled: GlobalTime,
    /// If what is not real-time may leave in it: the largest payload behind the Ethernet header.
    pub non_rt: Option<usize>,
}

/// What became of a frame that the discipline claimed.
#[derive(Debug)]
pub enum Claimed {
    /// It was the discipline's, and is done with.
    Kept,
    /// A tunnelled frame for the VNIC.
    Tunnel(Buf),
    /// Not acceptable, for this reason.
    Refused(Refusal),
}

/// A frame to be sent at an instant, and not later than another.
#[derive(Debug)]
pub struct Transmission {
    /// The bytes, from the Ethernet header on.
    pub frame: Buf,
    /// When it is to be on the wire.
    pub at: Instant,
    /// After this instant it must not be sent any more.
    pub latest: Instant,
    /// Where to write the time as the last act before sending.
    pub stamp: Option<Stamp>,
}

/// Eight big-endian bytes that the port writes immediately before it sends: its clock plus `add`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// Offset of the field from the frame's first byte.
    pub at_byte: u16,
    /// Added to the local clock, modulo 2^64.
    pub add: u64,
    /// Offset of an Internet checksum that is over the field, too, and stays right; both are whole words of what it is over.
    pub sum_at: Option<u16>,
}

impl Stamp {
    /// That of a frame which is to say when it left, by this line at this moment; `None`: it is not, or nobody knows.
    pub fn of(frame: &Buf, line: &TimeView, at: Instant) -> Option<Self> {
        let Blank { at_byte, sum_at } = frame.blank()?;
        let add = line.to_global(at)?.nanos().wrapping_sub(at.nanos());
        Some(Self { at_byte, add, sum_at: Some(sum_at) })
    }

    /// Writes the stamp into its frame; one outside the frame is not written.
    #[inline]
    pub fn write(&self, frame: &mut [u8], now: Instant) {
        let at = usize::from(self.at_byte);
        let Some(field) = frame.get_mut(at..at + 8).and_then(|field| field.as_mut_array()) else { return };
        let after = now.nanos().wrapping_add(self.add).to_be_bytes();
        // One that comes back and leaves later was stamped before.
        let before = core::mem::replace(field, after);
        let Some(at) = self.sum_at.map(usize::from) else { return };
        if let Some(sum) = frame.get_mut(at..at + 2).and_then(|sum| sum.as_mut_array()) {
            *sum = checksum::replaced(u16::from_be_bytes(*sum), &before, &after).to_be_bytes();
        }
    }
}

/// What became of a [`Transmission`].
#[derive(Debug)]
pub enum Sent {
    /// The clock read immediately before `send`, which was in time.
    At(Instant),
    /// `send` was called in time, but the clock read after it is beyond `latest`: the frame may have
    /// left late.
    StalledUntil(Instant),
    /// It was too late at this instant: nothing was sent.
    Late(Instant, Buf),
    /// `send` was called in time, but the kernel guard dropped the frame before this instant: nothing left
    /// the station.
    Guarded(Instant, Buf),
    /// The kernel refused it with this error number.
    Failed(i32, Buf),
}

/// A frame that missed its slot, and where it was queued.
#[derive(Debug)]
pub struct Returned {
    /// The frame as it was queued.
    pub frame: Buf,
    /// Its urgency.
    pub priority: Priority,
    /// Its slot.
    pub channel: Channel,
}

/// Why a frame could not be queued.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// The station has no such slot (yet).
    #[error("slot {0} is not defined: define it, or send in another channel")]
    NoSlot(Channel),
    /// The station can have no such slot.
    #[error("channel {channel} is unknown: they go from 0 to {max}")]
    UnknownChannel {
        /// What was asked for.
        channel: Channel,
        /// The highest there is.
        max: Channel,
    },
    /// The frame does not fit the slot.
    #[error("a payload of {got} bytes does not fit slot {channel}, which takes {limit}")]
    TooLong {
        /// Which slot.
        channel: Channel,
        /// Bytes behind the Ethernet header.
        got: usize,
        /// What the slot takes.
        limit: usize,
    },
    /// The queue of the slot is full. Those of TDMA, NoMAC and direct never are: pools bound what waits in them, each
    /// what its owner sends.
    #[error("the queue of slot {0} is full")]
    QueueFull(Channel),
    /// An RTmac frame that real RTnet stations never free (invariant 8).
    #[error("an RTmac frame that is not the discipline's own never leaves: it deafens RTnet stations")]
    Lethal,
    /// A frame of this EtherType, which are the discipline's alone.
    #[error("a frame of EtherType {0:?} is the token's: who forges one takes the medium from all")]
    Forged(EtherType),
}

impl SendError {
    /// The number by which the sockets of an operating system say the same.
    ///
    /// | variant | number | as in RTnet |
    /// |---|---|---|
    /// | [`NoSlot`](Self::NoSlot) | `EAGAIN` | yes: the slot may come |
    /// | [`UnknownChannel`](Self::UnknownChannel) | `EINVAL` | no: RTnet reads beyond its table |
    /// | [`TooLong`](Self::TooLong) | `EMSGSIZE` | yes |
    /// | [`QueueFull`](Self::QueueFull) | `ENOBUFS` | there it is a pool that runs empty |
    /// | [`Lethal`](Self::Lethal) | `EPERM` | no: RTnet sends it |
    /// | [`Forged`](Self::Forged) | `EPERM` | RTnet has no token |
    pub const fn errno(&self) -> i32 {
        match self {
            SendError::NoSlot(_) => libc::EAGAIN,
            SendError::UnknownChannel { .. } => libc::EINVAL,
            SendError::TooLong { .. } => libc::EMSGSIZE,
            SendError::QueueFull(_) => libc::ENOBUFS,
            SendError::Lethal | SendError::Forged(_) => libc::EPERM,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_not_to_queue_a_frame_has_the_number_that_sockets_give() {
        let too_long = SendError::TooLong { channel: 0, got: 2, limit: 1 };
        for (error, number, name) in [
            (SendError::NoSlot(2), 11, "EAGAIN"),
            (SendError::UnknownChannel { channel: 8, max: 7 }, 22, "EINVAL"),
            (too_long, 90, "EMSGSIZE"),
            (SendError::QueueFull(0), 105, "ENOBUFS"),
            (SendError::Lethal, 1, "EPERM"),
            (SendError::Forged(EtherType(0x88b6)), 1, "EPERM"),
        ] {
            assert_eq!(error.errno(), number, "{name}");
            assert_eq!(nix::errno::Errno::from_raw(number).to_string().split(':').next(), Some(name));
        }
    }
}
