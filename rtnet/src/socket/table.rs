//! A station's sockets, and which of them a frame is for.

use core::net::{Ipv4Addr, SocketAddrV4};
use core::ops::RangeInclusive;

use super::udp::Udp;
use super::{Kind, LinkType, Socket, SocketError, SocketId};
use crate::ip::route::Interface;
use crate::wire::ethernet::EtherType;

/// Sockets by their places; none is ever made or freed here.
pub(crate) struct Table {
    places: Vec<Place>,
    most: usize,
    /// Ports that are taken, in order, and by which place: those who hear at different addresses may have the same.
    ports: Vec<(u16, u16)>,
    /// Places of packet sockets, in the order in which they were opened.
    packet: Vec<u16>,
    automatic: RangeInclusive<u16>,
}

struct Place {
    generation: u32,
    socket: Option<Box<Socket>>,
}

impl Table {
    /// None yet, at most so many. Those of UDP's get their ports from a range.
    pub fn new(most: u16, automatic: RangeInclusive<u16>) -> Self {
        let most = usize::from(most);
        let empty = || Place { generation: 0, socket: None };
        Self {
            places: (0..most).map(|_| empty()).collect(),
            most,
            ports: Vec::with_capacity(most),
            packet: Vec::with_capacity(most),
            automatic,
        }
    }

    /// Takes a socket in; one of UDP's has a port from then on. Where it cannot be taken it comes back.
    pub fn open(&mut self, mut socket: Box<Socket>) -> Result<SocketId, (SocketError, Box<Socket>)> {
        let Some(free) = self.places.iter().position(|place| place.socket.is_none()) else {
            return Err((SocketError::TooMany(self.most), socket));
        };
        let place = free as u16;
        match &mut socket.kind {
            Kind::Udp(udp) => match self.free_port() {
                Ok(port) => {
                    udp.port = port;
                    self.take_port(port, place);
                }
                Err(error) => return Err((error, socket)),
            },
            Kind::Packet(_) => self.packet.push(place),
        }
        let entry = &mut self.places[free];
        entry.socket = Some(socket);
        Ok(SocketId { place, generation: entry.generation })
    }

    /// Takes a socket out, with all that waits in it.
    pub fn close(&mut self, id: SocketId) -> Result<Box<Socket>, SocketError> {
        self.get(id)?;
        let entry = &mut self.places[usize::from(id.place)];
        entry.generation = entry.generation.wrapping_add(1);
        self.ports.retain(|&(_, place)| place != id.place);
        self.packet.retain(|&place| place != id.place);
        entry.socket.take().ok_or(SocketError::NoSuchSocket)
    }

    /// The socket of that name.
    pub fn get(&self, id: SocketId) -> Result<&Socket, SocketError> {
        let place = self.places.get(usize::from(id.place)).filter(|place| place.generation == id.generation);
        place.and_then(|place| place.socket.as_deref()).ok_or(SocketError::NoSuchSocket)
    }

    /// The same, to change it.
    pub fn get_mut(&mut self, id: SocketId) -> Result<&mut Socket, SocketError> {
        let place =
            self.places.get_mut(usize::from(id.place)).filter(|place| place.generation == id.generation);
        place.and_then(|place| place.socket.as_deref_mut()).ok_or(SocketError::NoSuchSocket)
    }

    /// All that are open.
    pub fn all(&self) -> impl Iterator<Item = (SocketId, &Socket)> {
        let numbered = self.places.iter().zip(0..);
        numbered.filter_map(|(entry, place)| {
            Some((SocketId { place, generation: entry.generation }, entry.socket.as_deref()?))
        })
    }

    /// Gives a UDP socket another port; 0 leaves it the one that it has.
    pub fn bind(&mut self, id: SocketId, ip: Ipv4Addr, port: u16) -> Result<(), SocketError> {
        let udp = self.get(id)?.as_udp()?;
        if udp.is_bound {
            return Err(SocketError::AlreadyBound(udp.port));
        }
        let own = udp.port;
        let port = if port == 0 { own } else { port };
        let hears_there =
            |other: &Udp| other.local == ip || other.local.is_unspecified() || ip.is_unspecified();
        if self.holders(port).any(|(other, udp)| other != id && hears_there(udp)) {
            return Err(SocketError::PortInUse(port));
        }
        if port != own {
            self.ports.retain(|&(_, place)| place != id.place);
            self.take_port(port, id.place);
        }
        let udp = self.get_mut(id)?.as_udp_mut()?;
        (udp.local, udp.port, udp.is_bound) = (ip, port, true);
        Ok(())
    }

    /// Whom a datagram is for: the socket with its port that hears at its address, unless that is connected to another peer.
    /// What is sent to all of the network is for one that hears there before it is for one that hears at the own address.
    pub fn udp_for(&self, own: &Interface, from: SocketAddrV4, to: SocketAddrV4) -> Option<SocketId> {
        // What is sent to all of the network is sent to this station, too; to all of the world, only to who listens to that.
        let destination = if Some(*to.ip()) == own.broadcast() { own.ip } else { *to.ip() };
        let is_address =
            |local: Ipv4Addr| local.is_unspecified() || local == destination || local == *to.ip();
        let is_peer = |udp: &Udp| udp.peer.is_none_or(|peer| peer == from);
        let fitting = self.holders(to.port()).filter(|(_, udp)| is_address(udp.local) && is_peer(udp));
        fitting.min_by_key(|(_, udp)| udp.local != *to.ip()).map(|(id, _)| id)
    }

    /// How many packet sockets there are.
    pub fn packet_sockets(&self) -> usize {
        self.packet.len()
    }

    /// Of packet sockets, in the order in which they were opened, this one, if it wants frames of this type.
    pub fn packet_for(&self, number: usize, ether_type: EtherType) -> Option<SocketId> {
        let id = self.id(*self.packet.get(number)?);
        let wants = match self.get(id).ok()?.as_packet().ok()?.link_type {
            LinkType::Nothing => false,
            LinkType::Only(only) => only == ether_type,
            LinkType::All => true,
        };
        wants.then_some(id)
    }

    fn id(&self, place: u16) -> SocketId {
        SocketId { place, generation: self.places[usize::from(place)].generation }
    }

    /// Who has a port: several, if each hears at another address.
    fn holders(&self, port: u16) -> impl Iterator<Item = (SocketId, &Udp)> {
        let first = self.ports.partition_point(|&(taken, _)| taken < port);
        let taken = self.ports[first..].iter().take_while(move |&&(taken, _)| taken == port);
        taken.filter_map(|&(_, place)| {
            let id = self.id(place);
            Some((id, self.get(id).ok()?.as_udp().ok()?))
        })
    }

    fn take_port(&mut self, port: u16, place: u16) {
        let at = self.ports.partition_point(|&(taken, _)| taken < port);
        self.ports.insert(at, (port, place));
    }

    /// The lowest that is not taken.
    fn free_port(&self) -> Result<u16, SocketError> {
        let (first, last) = (*self.automatic.start(), *self.automatic.end());
        let mut free = first;
        for &(taken, _) in self.ports.iter().skip_while(|&&(port, _)| port < first) {
            if taken > free {
                break;
            }
            if taken < free {
                continue;
            }
            free = free.checked_add(1).ok_or(SocketError::NoPortLeft { first, last })?;
        }
        if self.automatic.contains(&free) { Ok(free) } else { Err(SocketError::NoPortLeft { first, last }) }
    }
}
