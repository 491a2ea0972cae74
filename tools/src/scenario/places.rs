//! Addresses that stations have by their places in one network: the master the first, the others the next.

use std::net::Ipv4Addr;

use rtnet::ip::route::Network;

use crate::station::stack::{NotOwnIp, OwnIp};

/// It has not enough addresses.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{network} has addresses for {room} stations, and there are {stations}")]
pub struct TooSmall {
    network: Network,
    room: u64,
    stations: usize,
    /// One that has.
    pub larger: Network,
}

/// Addresses of a network with so many leading bits that stations may have: neither its own nor the one of all.
fn room(prefix: u8) -> u64 {
    (1_u64 << (32 - u32::from(prefix.min(32)))).saturating_sub(2)
}

/// Whether it has an address for each of so many stations.
pub fn check(network: Network, stations: usize) -> Result<(), TooSmall> {
    let (room_of, needed) = (room(network.prefix()), stations as u64);
    if room_of >= needed {
        return Ok(());
    }
    let enough = (1..=30).rev().find(|&prefix| room(prefix) >= needed).unwrap_or(8);
    let larger = Network::new(network.address(), enough);
    Err(TooSmall { network, room: room_of, stations, larger })
}

/// The address of the station at this place; the master's is 0.
pub fn address(network: Network, place: u32) -> Result<OwnIp, NotOwnIp> {
    let ip = Ipv4Addr::from_bits(network.address().to_bits() + place + 1);
    format!("{ip}/{}", network.prefix()).parse()
}
