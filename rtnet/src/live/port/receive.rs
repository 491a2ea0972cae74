//! What a port hears, and how frames come from a socket into its buffers.

use core::ops::Deref;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};

use socket2::Socket;

use super::{Port, PortCounters};
use crate::buf::{Buf, Pool, ROOM};
use crate::clock::EmulatedClock;
use crate::live::clock::WallClock;
use crate::live::filter;
use crate::live::interface::Interface;
use crate::live::packet::{self, Nothing, Received};
use crate::time::Instant;
use crate::wire::ethernet::EtherType;
use crate::wire::offload::{CannotCut, Cut, LONGEST, Offload};

/// Frames taken from one socket in one turn at the most, so that a flood cannot hold up a slot.
pub(super) const DRAIN_AT_MOST: usize = 32;

/// Of so many looks of a station without slots, which does not sleep, one is for its control socket, too.
const CONTROL_EVERY: u32 = 16;

/// What a port hears besides RTmac's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Data<'a> {
    /// Frames of these EtherTypes, [`ETHER_TYPES_AT_MOST`](super::ETHER_TYPES_AT_MOST).
    Only(&'a [EtherType]),
    /// All that is for this host, alone or in a group, but of no VLAN: what a station with sockets hears.
    All,
}

impl<'a, const N: usize> From<&'a [EtherType; N]> for Data<'a> {
    fn from(only: &'a [EtherType; N]) -> Self {
        Data::Only(only)
    }
}

impl Port {
    /// Hands over what has come, data first, as long as `to` says that there may be more of it: a station without slots
    /// answers a frame before it looks at the next one. A socket that was found empty is not asked again before the next wait
    /// for frames.
    pub fn hear(&mut self, mut to: impl FnMut(Option<Instant>, Buf) -> bool) {
        let Self { control, data, pool, clock, wall, trusted, counters, empty, .. } = self;
        let mut is_sampled = false;
        for (place, socket) in (1..).zip(data).chain([(0, control)]) {
            let is_empty = *empty >> place & 1 != 0;
            for _ in 0..if is_empty { 0 } else { DRAIN_AT_MOST } {
                let mut goes_on = true;
                let to = |stamp, frame| {
                    if !is_sampled {
                        (is_sampled, *trusted) = (true, wall.sample());
                    }
                    goes_on = to(on_clock(stamp, *trusted, clock, wall), frame);
                };
                if drain(socket, pool, counters, 1, to) == 0 {
                    *empty |= 1 << place;
                    break;
                }
                if !goes_on {
                    return;
                }
            }
        }
    }

    /// Has the sockets asked again without a wait; that of RTmac's frames, none of which is urgent without slots, one time
    /// in so many.
    pub fn look_again(&mut self) {
        self.looks = self.looks.wrapping_add(1);
        self.empty = u64::from(!self.looks.is_multiple_of(CONTROL_EVERY));
    }
}

/// The sockets of data.
pub(super) fn data(interface: &Interface, data: Data<'_>) -> io::Result<Vec<Inlet>> {
    match data {
        Data::Only(only) => {
            only.iter().map(|only| receiver(interface, only.0, filter::accept_only_ours)).collect()
        }
        Data::All => {
            let all = receiver(interface, libc::ETH_P_ALL as u16, |socket| {
                // Where the kernel is too old for it, the filter keeps them out, a little later.
                let _ = packet::ignore_outgoing(socket);
                packet::show_offloads(socket)?;
                filter::accept_only_our_data(socket)
            })?;
            Ok(vec![Inlet { uncut: Some(Box::new(Uncut::none())), ..all }])
        }
    }
}

pub(super) fn on_clock(
    stamp: Option<u64>,
    trusted: bool,
    clock: &EmulatedClock,
    wall: &WallClock,
) -> Option<Instant> {
    stamp.filter(|_| trusted).map(|stamp| clock.local(wall.truth(stamp)))
}

/// A socket that hears frames of one EtherType, as far as its filter lets it, which is in place before the first.
pub(super) fn receiver(
    interface: &Interface,
    protocol: u16,
    filter: impl FnOnce(&Socket) -> io::Result<()>,
) -> io::Result<Inlet> {
    let socket = packet::open()?;
    filter(&socket)?;
    packet::stamp_received(&socket)?;
    packet::bind(&socket, interface.index, protocol)?;
    Ok(Inlet { socket, uncut: None })
}

/// Hands over so many frames at the most; tells how many there were.
pub(super) fn drain(
    inlet: &mut Inlet,
    pool: &Pool,
    counters: &mut PortCounters,
    most: usize,
    mut to: impl FnMut(Option<u64>, Buf),
) -> usize {
    for n in 0..most {
        let Some(buf) = pool.take() else {
            counters.pool_empty += 1;
            return n;
        };
        match inlet.take(buf, counters) {
            Ok((stamp, frame)) => to(stamp, frame),
            Err(Lack::Dropped) => {}
            Err(Lack::Empty) => return n,
        }
    }
    most
}

/// A socket that frames come in by.
pub(super) struct Inlet {
    socket: Socket,
    /// Where frames are cut that came uncut. Without it the socket hears only what nobody leaves uncut.
    uncut: Option<Box<Uncut>>,
}

/// A frame that is several, of which some have been handed over. The memory for it is there before it is needed.
struct Uncut {
    bytes: [u8; LONGEST],
    stamp: Option<u64>,
    /// None when all have been handed over.
    cut: Option<Cut>,
    next: usize,
}

/// Why a turn brings no frame.
enum Lack {
    /// None waits.
    Empty,
    /// One that came cannot be handed over, and is counted.
    Dropped,
}

impl Inlet {
    /// Whether a part of a frame waits that the socket does not know of any more.
    pub fn has_parts(&self) -> bool {
        self.uncut.as_ref().is_some_and(|uncut| uncut.cut.is_some())
    }

    /// The next frame, in this buffer, with the kernel's stamp.
    #[inline]
    fn take(&mut self, mut buf: Buf, counters: &mut PortCounters) -> Result<(Option<u64>, Buf), Lack> {
        let Self { socket, uncut } = self;
        let Some(uncut) = uncut else {
            let received = packet::receive(socket, &mut buf).ok_or(Lack::Empty)?;
            counters.received += 1;
            return whole(received, buf, counters);
        };
        if uncut.cut.is_none() {
            let mut offload = Offload::default();
            let received =
                packet::receive_offloaded(socket, &mut offload, &mut buf, &mut uncut.bytes[ROOM..]);
            let received = received.map_err(|nothing| match nothing {
                Nothing::Empty => Lack::Empty,
                Nothing::Unreadable => not_cut(counters),
            })?;
            counters.received += 1;
            if !offload.is_uncut() && received.len <= ROOM {
                offload.complete(&mut buf);
                return whole(received, buf, counters);
            }
            uncut.keep(&received, &offload, &buf).map_err(|CannotCut| match offload.is_uncut() {
                true => not_cut(counters),
                false => oversize(counters),
            })?;
            counters.uncut += 1;
        }
        uncut.write_next(&mut buf);
        Ok((uncut.stamp, buf))
    }
}

/// A frame, if there was room for it.
#[inline]
fn whole(received: Received, buf: Buf, counters: &mut PortCounters) -> Result<(Option<u64>, Buf), Lack> {
    if received.truncated || received.len > ROOM {
        return Err(oversize(counters));
    }
    Ok((received.stamp, buf))
}

fn oversize(counters: &mut PortCounters) -> Lack {
    counters.oversize += 1;
    Lack::Dropped
}

fn not_cut(counters: &mut PortCounters) -> Lack {
    counters.not_cut += 1;
    Lack::Dropped
}

impl Uncut {
    fn none() -> Self {
        Self { bytes: [0; LONGEST], stamp: None, cut: None, next: 0 }
    }

    /// Takes what `begin` had no room for, and its begin.
    fn keep(&mut self, received: &Received, offload: &Offload, begin: &[u8]) -> Result<(), CannotCut> {
        let whole = self.bytes.get_mut(..received.len).filter(|_| !received.truncated).ok_or(CannotCut)?;
        whole[..begin.len()].copy_from_slice(begin);
        self.cut = Some(if offload.is_uncut() {
            offload.cut(whole)?
        } else {
            offload.complete(whole);
            Cut::into_fragments(whole)?
        });
        (self.stamp, self.next) = (received.stamp, 0);
        Ok(())
    }

    fn write_next(&mut self, buf: &mut Buf) {
        let Some(cut) = self.cut else { return };
        let len = cut.write(&self.bytes, self.next, buf.room_mut());
        buf.set_len(len);
        self.next += 1;
        self.cut = Some(cut).filter(|cut| self.next < cut.count());
    }
}

impl AsFd for Inlet {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl Deref for Inlet {
    type Target = Socket;

    fn deref(&self) -> &Socket {
        &self.socket
    }
}
