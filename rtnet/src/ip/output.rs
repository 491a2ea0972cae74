//! From a datagram to frames.

use core::net::Ipv4Addr;

use super::route::{Hop, Routes};
use super::{Exit, Stack};
use crate::buf::{Blank, Chain, Pool};
use crate::discipline::SendError;
use crate::socket::{Options, SocketError};
use crate::wire::ethernet::{
    Address, EtherType, HEADER_LEN as LINK_HEADER, Header as LinkHeader, MIN_FRAME, MTU,
};
use crate::wire::ipv4::{Fields, HEADER_LEN, Header, Protocol};
use crate::wire::udp;
use crate::wire::udp_options;
use zerocopy::IntoBytes;

/// Where a datagram goes, and from where.
pub(crate) struct Route {
    pub source: Ipv4Addr,
    pub destination: Ipv4Addr,
    hop: Hop,
    from: Address,
}

/// What is sent to somebody: one thing in parts that lie in several places.
pub(crate) struct Content<'a> {
    pub protocol: Protocol,
    pub parts: &'a [&'a [u8]],
    /// They end in times, as [`udp_options`] has them: the frame with their end is to say when it left.
    pub ends_in_times: bool,
}

/// What all datagrams of a station have in common.
#[derive(Default)]
pub(crate) struct Output {
    /// One counter for all sockets, as in RTnet.
    identification: u16,
}

impl Route {
    /// The way to `destination`; without a gateway if there must be none.
    pub fn find(routes: &Routes, destination: Ipv4Addr, without_gateway: bool) -> Result<Self, SocketError> {
        let own = routes.own();
        let hop = routes.lookup(destination).filter(|_| !without_gateway || routes.is_direct(destination));
        let hop = hop.ok_or(SocketError::NoRoute(destination))?;
        // What is sent to a loopback address comes from one.
        let source = if destination.is_loopback() { Ipv4Addr::LOCALHOST } else { own.ip };
        Ok(Self { source, destination, hop, from: own.address })
    }

    /// The same for who hears at `local`: of several loopback addresses it sends from its own.
    pub fn for_who_hears_at(self, local: Ipv4Addr) -> Self {
        let is_between = self.destination.is_loopback() && local.is_loopback();
        Self { source: if is_between { local } else { self.source }, ..self }
    }

    /// The most that an IP packet on this way may have.
    fn limit(&self, options: Options, exit: &dyn Exit) -> Result<usize, SendError> {
        match self.hop {
            Hop::Loopback => Ok(MTU),
            Hop::Medium(_) => exit.limit(options.channel),
        }
    }

    /// How many bytes of a datagram each packet takes, and how many packets there are.
    pub fn shares(
        &self,
        whole: usize,
        options: Options,
        exit: &dyn Exit,
    ) -> Result<(usize, usize), SocketError> {
        let each = share(whole, self.limit(options, exit)?, options)?;
        Ok((each, whole.div_ceil(each).max(1)))
    }

    fn link_header(&self) -> LinkHeader {
        let to = match self.hop {
            Hop::Loopback => Address::default(),
            Hop::Medium(address) => address,
        };
        LinkHeader::new(to, self.from, EtherType::IPV4)
    }
}

impl Output {
    /// The frames of a datagram, its parts one after the other, in ascending order, in buffers of `pool`: all of them, or none.
    pub fn datagram(
        &mut self,
        route: &Route,
        options: Options,
        datagram: &Content<'_>,
        pool: &Pool,
        exit: &dyn Exit,
    ) -> Result<Chain, SocketError> {
        let Content { protocol, parts, ends_in_times } = *datagram;
        let whole = parts.iter().map(|part| part.len()).sum();
        let (each, count) = route.shares(whole, options, exit)?;
        let capacity = pool.capacity();
        if count > capacity {
            let most = (each * capacity).saturating_sub(udp::HEADER_LEN);
            return Err(SocketError::NeverFits { needed: count, capacity, most });
        }
        let mut empty = Chain::new();
        for _ in 0..count {
            let Some(buf) = pool.take() else {
                drop(empty);
                return Err(no_buffers(count, pool));
            };
            empty.push(buf);
        }
        let identification = self.identification;
        self.identification = identification.wrapping_add(1);
        let mut frames = Chain::new();
        for begin in (0..whole.max(1)).step_by(each) {
            let Some(mut frame) = empty.pop_front() else { break };
            let len = each.min(whole - begin);
            let header = Header::new(&Fields {
                source: route.source,
                destination: route.destination,
                protocol,
                tos: options.tos,
                identification,
                dont_fragment: count == 1,
                more_fragments: begin + len < whole,
                offset: begin as u16,
                payload_len: len as u16,
            });
            let room = frame.room_mut();
            room[..LINK_HEADER].copy_from_slice(route.link_header().as_bytes());
            let content = LINK_HEADER + HEADER_LEN;
            room[LINK_HEADER..content].copy_from_slice(header.as_bytes());
            copy_part(parts, begin, &mut room[content..content + len]);
            let end = content + len;
            frame.set_len(end);
            if ends_in_times && begin + len == whole {
                frame.set_blank(blank_before(end));
            }
            frame.pad_to(MIN_FRAME);
            frames.push(frame);
        }
        Ok(frames)
    }
}

impl Stack {
    /// Lets frames leave, in their order. What goes to this station itself comes in at once.
    pub(crate) fn dispatch(
        &mut self,
        route: &Route,
        options: Options,
        mut frames: Chain,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        while let Some(frame) = frames.pop_front() {
            match route.hop {
                Hop::Loopback => {
                    let arrived = self.ip_input(Some(self.now), frame, exit);
                    arrived.unwrap_or_else(|refused| self.counters.loopback.count(refused.why));
                }
                Hop::Medium(_) => {
                    exit.send(frame, options.priority, options.channel).map_err(|(error, _)| error)?;
                }
            }
        }
        Ok(())
    }
}

/// Where times that end there say when they left.
fn blank_before(end: usize) -> Blank {
    let (at_byte, sum_at) = (end - udp_options::LEFT_BEFORE_END, end - udp_options::CHECKSUM_BEFORE_END);
    Blank { at_byte: at_byte as u16, sum_at: sum_at as u16 }
}

/// How many bytes of a datagram a packet takes: all, or as many as fit, in units of eight.
fn share(whole: usize, limit: usize, options: Options) -> Result<usize, SocketError> {
    let room = limit.saturating_sub(HEADER_LEN);
    if whole <= room {
        return Ok(whole.max(1));
    }
    match room & !7 {
        0 => {
            let (channel, got) = (options.channel, HEADER_LEN + 8);
            Err(SendError::TooLong { channel, got, limit }.into())
        }
        each => Ok(each),
    }
}

/// The bytes of all parts, taken as one, from `begin` on.
fn copy_part(parts: &[&[u8]], mut begin: usize, mut into: &mut [u8]) {
    for part in parts {
        let wanted = part.get(begin..).unwrap_or_default();
        let (here, rest) = into.split_at_mut(wanted.len().min(into.len()));
        here.copy_from_slice(&wanted[..here.len()]);
        (begin, into) = (begin.saturating_sub(part.len()), rest);
    }
}

/// A pool has not as many as are needed.
pub(crate) fn no_buffers(needed: usize, pool: &Pool) -> SocketError {
    SocketError::NoBuffers { needed, free: pool.available(), capacity: pool.capacity() }
}
