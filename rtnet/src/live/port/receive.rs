//! What a port hears, and how frames come from a socket into its buffers.

use std::io;

use socket2::Socket;

use super::{Port, PortCounters};
use crate::buf::{Buf, Pool};
use crate::clock::EmulatedClock;
use crate::live::clock::WallClock;
use crate::live::interface::Interface;
use crate::live::{filter, packet};
use crate::time::Instant;
use crate::wire::ethernet::EtherType;
use crate::wire::udp;

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
        let control = core::iter::once((0, &*control));
        for (place, socket) in (1..).zip(&*data).chain(control) {
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
pub(super) fn data(interface: &Interface, data: Data<'_>) -> io::Result<Vec<Socket>> {
    match data {
        Data::Only(only) => {
            only.iter().map(|only| receiver(interface, only.0, filter::accept_only_ours)).collect()
        }
        Data::All => {
            let all = receiver(interface, libc::ETH_P_ALL as u16, |socket| {
                // Where the kernel is too old for it, the filter keeps them out, a little later.
                let _ = packet::ignore_outgoing(socket);
                packet::tell_of_checksums(socket)?;
                filter::accept_only_our_data(socket)
            })?;
            Ok(vec![all])
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
) -> io::Result<Socket> {
    let socket = packet::open()?;
    filter(&socket)?;
    packet::stamp_received(&socket)?;
    packet::bind(&socket, interface.index, protocol)?;
    Ok(socket)
}

/// Hands over so many frames at the most; tells how many there were.
pub(super) fn drain(
    socket: &Socket,
    pool: &Pool,
    counters: &mut PortCounters,
    most: usize,
    mut to: impl FnMut(Option<u64>, Buf),
) -> usize {
    for n in 0..most {
        let Some(mut buf) = pool.take() else {
            counters.pool_empty += 1;
            return n;
        };
        let Some(received) = packet::receive(socket, &mut buf) else { return n };
        counters.received += 1;
        if received.truncated {
            counters.oversize += 1;
            continue;
        }
        if received.without_checksum {
            udp::forgo_checksum(&mut buf);
        }
        to(received.stamp, buf);
    }
    most
}
