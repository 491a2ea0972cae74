//! UDP sockets: bind, connect, send.

use core::net::{Ipv4Addr, SocketAddrV4};

use super::{Flags, Options, SocketError, SocketId};
use crate::discipline::SendError;
use crate::ip::output::{Content, Route};
use crate::ip::{Exit, Stack};
use crate::time::GlobalTime;
use crate::wire::ipv4::{HEADER_LEN, MAX_TOTAL, Protocol};
use crate::wire::udp::{self, Header, MAX_PAYLOAD};
use crate::wire::udp_options::{self, Surplus, Times};
use zerocopy::IntoBytes;

/// What a UDP socket has besides its buffers.
pub(crate) struct Udp {
    /// The address that what comes must be sent to; unspecified: any of the station's.
    pub local: Ipv4Addr,
    pub port: u16,
    /// Whether a program has said which.
    pub is_bound: bool,
    pub peer: Option<SocketAddrV4>,
}

impl Default for Udp {
    fn default() -> Self {
        Self { local: Ipv4Addr::UNSPECIFIED, port: 0, is_bound: false, peer: None }
    }
}

/// Too few of a socket's buffers are free for what is to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lack {
    /// So many places of its pool were looked at to know it.
    pub looked: usize,
    /// As many as it takes are on their way, and come home by themselves: not so those in which something waits to be read.
    pub is_passing: bool,
}

impl Stack {
    /// Binds a UDP socket to an address of this station's, or any (0.0.0.0), and to a port, or the one it has (0). Once.
    pub fn bind(&mut self, id: SocketId, to: SocketAddrV4) -> Result<(), SocketError> {
        let ip = *to.ip();
        let ours = ip.is_unspecified() || ip.is_loopback() || self.routes.own().takes(ip);
        if !ours {
            return Err(SocketError::NotOurAddress(ip));
        }
        self.sockets.bind(id, ip, to.port())
    }

    /// From now on the socket sends to this peer and hears nobody else; `None`: to nobody, and all.
    pub fn connect(&mut self, id: SocketId, peer: Option<SocketAddrV4>) -> Result<(), SocketError> {
        peer.map_or(Ok(()), check_destination)?;
        self.sockets.get_mut(id)?.as_udp_mut()?.peer = peer;
        Ok(())
    }

    /// Where a UDP socket hears.
    pub fn local_address(&self, id: SocketId) -> Result<SocketAddrV4, SocketError> {
        let udp = self.sockets.get(id)?.as_udp()?;
        Ok(SocketAddrV4::new(udp.local, udp.port))
    }

    /// Whom it is connected to.
    pub fn peer_address(&self, id: SocketId) -> Result<SocketAddrV4, SocketError> {
        self.sockets.get(id)?.as_udp()?.peer.ok_or(SocketError::NotConnected)
    }

    /// Sends a datagram of at most 65 507 bytes, to the peer that the socket is connected to unless another is named. It
    /// waits in the discipline's queue, in as many frames as it takes, for the socket's slot: all of it, or none.
    pub fn send_to(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
        flags: Flags,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        self.send_sent_at(id, data, to, flags, None, exit)
    }

    /// The same of what its program has sent at this moment: the datagram says so, and when it leaves, where that costs no
    /// frame more, and the longest IP packet has room for it.
    pub fn send_sent_at(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
        flags: Flags,
        sent: Option<GlobalTime>,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        let result = self.try_send_to(id, data, to, flags, sent, exit);
        self.count_send(id, result)
    }

    fn try_send_to(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
        flags: Flags,
        sent: Option<GlobalTime>,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        flags.check(Flags::DONTWAIT | Flags::DONTROUTE)?;
        let socket = self.sockets.get(id)?;
        let udp = socket.as_udp()?;
        let to = to.or(udp.peer).ok_or(SocketError::NotConnected)?;
        check_destination(to)?;
        if data.len() > MAX_PAYLOAD {
            return Err(SocketError::TooLong(data.len()));
        }
        let route = Route::find(&self.routes, *to.ip(), flags.contains(Flags::DONTROUTE))?
            .for_who_hears_at(udp.local);
        let (head, options) = (header(route.source, to, udp.port, data), socket.options);
        let surplus = sent.and_then(|sent| times_for(&route, usize::from(head.len()), sent, options, exit));
        let behind = surplus.as_ref().map_or(&[][..], Surplus::as_bytes);
        let parts = &[head.as_bytes(), data, behind];
        let content = Content { protocol: Protocol::UDP, parts, ends_in_times: surplus.is_some() };
        let frames = self.output.datagram(&route, options, &content, &socket.pool, exit)?;
        self.dispatch(&route, options, frames, exit).inspect_err(|_| {
            // The discipline's queue has room for all buffers there are: only a slot that goes in between comes here.
            let socket = self.sockets.get_mut(id);
            socket.into_iter().for_each(|socket| socket.counters.cut_short += 1);
        })
    }

    /// Whether what is sent now would be refused for want of the socket's buffers.
    pub(crate) fn lacks_buffers(
        &self,
        id: SocketId,
        len: usize,
        to: Option<SocketAddrV4>,
        flags: Flags,
        exit: &dyn Exit,
    ) -> Result<Option<Lack>, SocketError> {
        let socket = self.sockets.get(id)?;
        let needed = match socket.as_udp() {
            Ok(udp) => {
                let to = to.or(udp.peer).ok_or(SocketError::NotConnected)?;
                let route = Route::find(&self.routes, *to.ip(), flags.contains(Flags::DONTROUTE))?;
                route.shares(size_of::<Header>() + len, socket.options, exit)?.1
            }
            Err(_) => 1,
        };
        Ok(socket.pool.lacks(needed).map(|looked| {
            let waiting = socket.waiting();
            Lack { looked: looked + waiting, is_passing: needed + waiting <= socket.pool.capacity() }
        }))
    }

    pub(crate) fn count_send(
        &mut self,
        id: SocketId,
        result: Result<(), SocketError>,
    ) -> Result<(), SocketError> {
        if let Ok(socket) = self.sockets.get_mut(id) {
            let counters = &mut socket.counters;
            let count = match result {
                Ok(()) => &mut counters.sent,
                Err(SocketError::NoBuffers { .. } | SocketError::Discipline(SendError::QueueFull(_))) => {
                    &mut counters.no_buffers
                }
                Err(error) => {
                    counters.refused += 1;
                    match error {
                        SocketError::NoRoute(_) => &mut counters.no_route,
                        SocketError::TooLong(_)
                        | SocketError::NeverFits { .. }
                        | SocketError::Discipline(SendError::TooLong { .. }) => &mut counters.too_long,
                        SocketError::Discipline(SendError::NoSlot(_) | SendError::UnknownChannel { .. }) => {
                            &mut counters.no_slot
                        }
                        _ => return result,
                    }
                }
            };
            *count += 1;
        }
        result
    }
}

/// What is to be behind a datagram of so many bytes: nothing, if that would take another frame, and so another turn.
fn times_for(
    route: &Route,
    udp_len: usize,
    sent: GlobalTime,
    options: Options,
    exit: &dyn Exit,
) -> Option<Surplus> {
    let whole = udp_len + udp_options::len_behind(udp_len);
    let frames = |len| route.shares(len, options, exit).ok().map(|(_, count)| count);
    let is_free = whole <= MAX_TOTAL - HEADER_LEN && frames(whole)? == frames(udp_len)?;
    is_free.then(|| Surplus::new(udp_len, &Times { sent, left: None }))
}

/// With the checksum over everything.
fn header(source: Ipv4Addr, to: SocketAddrV4, port: u16, data: &[u8]) -> Header {
    let mut head = Header::new(port, to.port(), data.len() as u16);
    let mut sum = udp::pseudo_header(source, *to.ip(), head.len());
    sum.add(head.as_bytes());
    sum.add(data);
    head.set_checksum(udp::to_field(sum));
    head
}

fn check_destination(to: SocketAddrV4) -> Result<(), SocketError> {
    let is_one = !to.ip().is_unspecified() && to.port() != 0;
    is_one.then_some(()).ok_or(SocketError::NoDestination(*to.ip(), to.port()))
}
