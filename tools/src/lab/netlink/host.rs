//! What makes a namespace's kernel a host of the Internet Protocol, as the peer of a station.

use std::net::{IpAddr, Ipv4Addr};

use anyhow::Result;
use netlink_packet_route::address::{AddressAttribute, AddressMessage};
use netlink_packet_route::neighbour::{
    NeighbourAddress, NeighbourAttribute, NeighbourMessage, NeighbourState,
};
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use nix::errno::Errno;

use super::{Netlink, check_mac};

impl Netlink {
    /// Gives the interface with this index an address, and all of its network is reached by it.
    ///
    /// # Errors
    /// There is no such interface, or it has the address.
    pub fn add_address(&mut self, index: u32, ip: Ipv4Addr, prefix: u8) -> Result<()> {
        let mut message = AddressMessage::default();
        message.header.family = AddressFamily::Inet;
        (message.header.index, message.header.prefix_len) = (index, prefix);
        let ip = IpAddr::V4(ip);
        message.attributes = vec![AddressAttribute::Local(ip), AddressAttribute::Address(ip)];
        self.create(
            &format!("give interface #{index} the address {ip}/{prefix}"),
            RouteNetlinkMessage::NewAddress(message),
            &[(Errno::EEXIST, "it has this address")],
        )
    }

    /// Tells the kernel for good where a host is, so that it never asks.
    ///
    /// # Errors
    /// There is no such interface, or it knows the host.
    pub fn add_neighbour(&mut self, index: u32, ip: Ipv4Addr, mac: [u8; 6]) -> Result<()> {
        check_mac(mac)?;
        let mut entry = NeighbourMessage::default();
        entry.header.family = AddressFamily::Inet;
        (entry.header.ifindex, entry.header.state) = (index, NeighbourState::Permanent);
        entry.attributes = vec![
            NeighbourAttribute::Destination(NeighbourAddress::Inet(ip)),
            NeighbourAttribute::LinkLocalAddress(mac.to_vec()),
        ];
        self.create(
            &format!("tell interface #{index} where {ip} is"),
            RouteNetlinkMessage::NewNeighbour(entry),
            &[(Errno::EEXIST, "it knows this host")],
        )
    }
}
