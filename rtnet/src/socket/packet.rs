//! Packet sockets: frames as they are, for protocols of one's own and for those who listen.

use core::net::Ipv4Addr;

use super::{Datagram, Flags, Sender, SocketError, SocketId};
use crate::buf::{Buf, Chain, hand_over};
use crate::counters::Refusal;
use crate::discipline::SendError;
use crate::ip::output::no_buffers;
use crate::ip::{Exit, Stack};
use crate::time::Instant;
use crate::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME};
use zerocopy::IntoBytes;

/// Whether programs see the Ethernet header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkMode {
    /// They write and read whole frames (`SOCK_RAW`).
    Raw,
    /// The station writes and takes off the header (`SOCK_DGRAM`).
    Datagram,
}

/// Which frames come to a packet socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkType {
    /// None: it only sends.
    Nothing,
    /// Those of one EtherType.
    Only(EtherType),
    /// All that the station receives, its discipline's own among them (`ETH_P_ALL`).
    All,
}

/// The other end of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinkAddress {
    /// Who has sent it, or is to receive it.
    pub address: Address,
    /// What it carries.
    pub ether_type: EtherType,
    /// Whether it was for all, or many.
    pub to_group: bool,
}

/// What a packet socket has besides its buffers.
pub(crate) struct Packet {
    pub mode: LinkMode,
    pub link_type: LinkType,
}

impl Stack {
    /// From now on frames of another type come to a packet socket.
    pub fn bind_link(&mut self, id: SocketId, link_type: LinkType) -> Result<(), SocketError> {
        self.sockets.get_mut(id)?.as_packet_mut()?.link_type = link_type;
        Ok(())
    }

    /// Sends a frame: with `SOCK_RAW` as it is, else with a header to `to`. It is padded to 60 bytes.
    pub fn send_frame(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<(Address, EtherType)>,
        flags: Flags,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        let result = self.try_send_frame(id, data, to, flags, exit);
        self.count_send(id, result)
    }

    fn try_send_frame(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<(Address, EtherType)>,
        flags: Flags,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        flags.check(Flags::DONTWAIT)?;
        let socket = self.sockets.get(id)?;
        let header = match (socket.as_packet()?.mode, to) {
            (LinkMode::Raw, _) if data.len() < HEADER_LEN => return Err(SocketError::NoFrame(data.len())),
            (LinkMode::Raw, _) => None,
            (LinkMode::Datagram, None) => return Err(SocketError::NotConnected),
            (LinkMode::Datagram, Some((_, EtherType(0)))) => {
                return Err(SocketError::NoDestination(Ipv4Addr::UNSPECIFIED, 0));
            }
            (LinkMode::Datagram, Some((address, ether_type))) => {
                Some(Header::new(address, self.routes.own().address, ether_type))
            }
        };
        let channel = socket.options.channel;
        let got = if header.is_some() { data.len() } else { data.len() - HEADER_LEN };
        let limit = exit.limit(channel)?;
        if got > limit {
            return Err(SendError::TooLong { channel, got, limit }.into());
        }
        let Some(mut frame) = socket.pool.take() else { return Err(no_buffers(1, &socket.pool)) };
        let head = header.as_ref().map_or(&[][..], IntoBytes::as_bytes);
        frame.room_mut()[..head.len()].copy_from_slice(head);
        frame.room_mut()[head.len()..head.len() + data.len()].copy_from_slice(data);
        frame.set_len(head.len() + data.len());
        frame.pad_to(MIN_FRAME);
        let leaves = Header::parse(&frame).is_some_and(|(header, _)| header.ether_type() != EtherType::RTMAC);
        if !leaves {
            // Whoever forges a discipline's frames takes the medium from all.
            return Err(SendError::Lethal.into());
        }
        exit.send(frame, socket.options.priority, channel).map_err(|(error, _)| error.into())
    }

    /// Gives a copy of a frame that is somebody else's to the packet sockets that want it.
    pub fn overhear(&mut self, rx: Option<Instant>, frame: &[u8]) {
        if self.sockets.packet_sockets() == 0 {
            return;
        }
        let Some((header, _)) = Header::parse(frame) else { return };
        if let Some(last) = self.copy_to_all_but_last(header, rx, frame) {
            self.copy_to(last, header, rx, frame);
        }
    }

    /// Copies to all that want it but the last, which it tells: in one pass, however many there are.
    fn copy_to_all_but_last(
        &mut self,
        header: &Header,
        rx: Option<Instant>,
        frame: &[u8],
    ) -> Option<SocketId> {
        let mut last = None;
        // The table cannot be lent while a socket changes.
        for number in 0..self.sockets.packet_sockets() {
            let Some(id) = self.sockets.packet_for(number, header.ether_type()) else { continue };
            if let Some(before) = last.replace(id) {
                self.copy_to(before, header, rx, frame);
            }
        }
        last
    }

    fn copy_to(&mut self, id: SocketId, header: &Header, rx: Option<Instant>, frame: &[u8]) {
        let Ok(socket) = self.sockets.get_mut(id) else { return };
        let Some(mut copy) = socket.pool.take() else {
            socket.counters.dropped += 1;
            return;
        };
        copy.fill(frame);
        let _ = self.keep_frame(id, header, rx, copy);
    }

    /// A frame that is nobody else's: each packet socket that wants it has a copy, the last one the frame itself.
    pub(crate) fn packet_input(&mut self, rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        let (&header, _) = Header::parse(&frame).ok_or(Refusal::Runt)?;
        let id = self.copy_to_all_but_last(&header, rx, &frame).ok_or(Refusal::UnclaimedEtherType)?;
        let socket = self.sockets.get_mut(id).map_err(|_| Refusal::NoSocket)?;
        match hand_over(frame, &socket.pool) {
            Ok(kept) => self.keep_frame(id, &header, rx, kept),
            Err(_) => {
                socket.counters.dropped += 1;
                Err(Refusal::PoolEmpty)
            }
        }
    }

    fn keep_frame(
        &mut self,
        id: SocketId,
        header: &Header,
        rx: Option<Instant>,
        frame: Buf,
    ) -> Result<(), Refusal> {
        let from = Sender::Link(LinkAddress {
            address: header.source,
            ether_type: header.ether_type(),
            to_group: header.destination.is_group(),
        });
        let socket = self.sockets.get_mut(id).map_err(|_| Refusal::NoSocket)?;
        let begin = match socket.as_packet() {
            Ok(Packet { mode: LinkMode::Datagram, .. }) => HEADER_LEN,
            _ => 0,
        };
        let len = frame.len() - begin;
        socket.keep(Datagram { chain: Chain::of(frame), begin, len, from, rx, times: None });
        self.delivered = true;
        Ok(())
    }
}
