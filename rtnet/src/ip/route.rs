//! Where a packet goes: static tables, as in RTnet; nothing is asked of the medium.
//!
//! ```text
//! destination ─► own address, 127/8 ─► loopback
//!             ─► broadcast          ─► ff:ff:ff:ff:ff:ff
//!             ─► host table         ─► its station's address            longest prefix: a host route is one of 32 bits
//!             ─► network table      ─► gateway ─► host table
//!             ─► no route
//! ```

use core::fmt;
use core::net::Ipv4Addr;
use core::str::FromStr;

use crate::wire::ethernet::Address;

/// Host routes: RTnet's table has 32, which its users outgrow.
pub const DEFAULT_HOSTS: usize = 256;
/// Network routes: RTnet has 16.
pub const DEFAULT_NETWORKS: usize = 64;

/// An IPv4 network: an address and how many of its leading bits count.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Network {
    address: Ipv4Addr,
    prefix: u8,
}

/// How a station on the medium is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HostRoute {
    /// Its IP address.
    pub ip: Ipv4Addr,
    /// Its station's address on the medium.
    pub address: Address,
    /// How that is known.
    pub origin: Origin,
}

/// How a host route came to be known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// Said by hand or in a file: only by hand is it changed.
    Static,
    /// The answer to a question that was asked by hand.
    Solicited,
    /// Its station asked for this one's address.
    Learned,
}

/// A network behind a station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkRoute {
    /// Which.
    pub network: Network,
    /// A host of the host table.
    pub gateway: Ipv4Addr,
}

/// The next stop of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hop {
    /// This station itself.
    Loopback,
    /// A station on the medium, or all of them.
    Medium(Address),
}

/// Why a route could not be changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RouteError {
    /// No room.
    #[error(
        "the table of {what} is full: it takes {capacity}; delete one (`rtnet route del`), or start the station with a larger \
         one (`rtnet station --hosts`, `--networks`; the tables of a lab's stations are as they are)"
    )]
    TableFull {
        /// Host routes or network routes.
        what: &'static str,
        /// Entries.
        capacity: usize,
    },
    /// It is not there.
    #[error("there is no route to {0}")]
    Unknown(Network),
    /// It could lead nowhere.
    #[error("{0} is no station's address: {1}")]
    NotAHost(Ipv4Addr, &'static str),
    /// A group is nobody who could be sent to.
    #[error("{0} is a group: a route leads to one station")]
    Group(Address),
    /// Told, but not by hand, of a host whose route was said by hand.
    #[error("the route to {0} was said by hand")]
    IsStatic(Ipv4Addr),
}

/// The tables, in the order of addresses; their memory is reserved at the start.
pub struct Routes {
    own: Interface,
    hosts: Vec<HostRoute>,
    networks: Vec<NetworkRoute>,
}

/// A station's place in the Internet Protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Interface {
    /// Its address on the medium.
    pub address: Address,
    /// Its IP address.
    pub ip: Ipv4Addr,
    /// Leading bits that all stations of its network share, 0 to 32.
    pub prefix: u8,
}

impl Interface {
    /// The address of all stations of its network; none where a network has but one or two addresses.
    pub fn broadcast(&self) -> Option<Ipv4Addr> {
        (self.prefix < 31).then(|| Ipv4Addr::from_bits(self.ip.to_bits() | !mask(self.prefix)))
    }

    /// Whether a packet to `destination` is for every station.
    pub fn is_broadcast(&self, destination: Ipv4Addr) -> bool {
        destination == Ipv4Addr::BROADCAST || Some(destination) == self.broadcast()
    }

    /// Whether a packet to `destination` is for this station, alone or among all.
    pub fn takes(&self, destination: Ipv4Addr) -> bool {
        destination == self.ip || self.is_broadcast(destination)
    }

    /// Its network.
    pub fn network(&self) -> Network {
        Network::new(self.ip, self.prefix)
    }
}

impl Routes {
    /// Empty tables for at most so many hosts and networks.
    pub fn new(own: Interface, hosts: usize, networks: usize) -> Self {
        Self { own, hosts: Vec::with_capacity(hosts), networks: Vec::with_capacity(networks) }
    }

    /// This station's own place.
    pub fn own(&self) -> &Interface {
        &self.own
    }

    /// Where a packet to `destination` goes.
    #[inline]
    pub fn lookup(&self, destination: Ipv4Addr) -> Option<Hop> {
        if destination == self.own.ip || destination.is_loopback() {
            return Some(Hop::Loopback);
        }
        if self.own.is_broadcast(destination) {
            return Some(Hop::Medium(Address::BROADCAST));
        }
        let host = self.host(destination).or_else(|| self.host(self.gateway(destination)?));
        host.map(|host| Hop::Medium(host.address))
    }

    /// Whether a packet to `destination` goes there without a gateway.
    pub fn is_direct(&self, destination: Ipv4Addr) -> bool {
        let own = destination.is_loopback() || self.own.takes(destination);
        own || self.host(destination).is_some()
    }

    /// The host route to exactly this address.
    pub fn host(&self, ip: Ipv4Addr) -> Option<&HostRoute> {
        self.hosts.binary_search_by_key(&ip, |host| host.ip).ok().map(|place| &self.hosts[place])
    }

    /// All host routes, in the order of addresses.
    pub fn hosts(&self) -> &[HostRoute] {
        &self.hosts
    }
    /// All network routes, the longest prefix first.
    pub fn networks(&self) -> &[NetworkRoute] {
        &self.networks
    }

    /// Adds a host route, or changes the one there is. What was said by hand only hands change, also where that was to which
    /// gateway its network goes. In a full table one that was learned makes room for one that was not.
    pub fn add_host(&mut self, route: HostRoute) -> Result<(), RouteError> {
        self.check_host(route.ip)?;
        if route.address.is_group() {
            return Err(RouteError::Group(route.address));
        }
        if route.origin == Origin::Learned && self.is_said_by_hand(route.ip) {
            return Err(RouteError::IsStatic(route.ip));
        }
        if let Ok(place) = self.hosts.binary_search_by_key(&route.ip, |host| host.ip) {
            self.hosts[place] = route;
            return Ok(());
        }
        if self.hosts.len() == self.hosts.capacity() {
            self.make_room(route.origin)?;
        }
        let place = self.hosts.partition_point(|host| host.ip < route.ip);
        self.hosts.insert(place, route);
        Ok(())
    }

    /// Adds a network route, or gives the one there is another gateway.
    pub fn add_network(&mut self, route: NetworkRoute) -> Result<(), RouteError> {
        self.check_host(route.gateway)?;
        match self.place(route.network) {
            Ok(place) => self.networks[place] = route,
            Err(_) if self.networks.len() == self.networks.capacity() => {
                let capacity = self.networks.capacity();
                return Err(RouteError::TableFull { what: "network routes", capacity });
            }
            Err(place) => self.networks.insert(place, route),
        }
        Ok(())
    }

    /// Deletes the route to a host (a network of 32 bits) or to a network.
    pub fn delete(&mut self, network: Network) -> Result<(), RouteError> {
        if network.prefix == 32
            && let Ok(place) = self.hosts.binary_search_by_key(&network.address, |host| host.ip)
        {
            self.hosts.remove(place);
            return Ok(());
        }
        let place = self.place(network).map_err(|_| RouteError::Unknown(network))?;
        self.networks.remove(place);
        Ok(())
    }

    /// Whether a host, or the network that it is in before this station's own, has a route by hand.
    fn is_said_by_hand(&self, ip: Ipv4Addr) -> bool {
        let own = self.own.network();
        let is_nearer = |network: Network| !own.contains(ip) || network.prefix > own.prefix;
        let mut networks = self.networks.iter().map(|route| route.network);
        self.host(ip).is_some_and(|there| there.origin == Origin::Static)
            || networks.any(|network| network.contains(ip) && is_nearer(network))
    }

    /// Whoever asks is learned, so anybody can fill the table: not against who is named here.
    fn make_room(&mut self, origin: Origin) -> Result<(), RouteError> {
        let learned = self.hosts.iter().position(|host| host.origin == Origin::Learned);
        let full = RouteError::TableFull { what: "host routes", capacity: self.hosts.capacity() };
        let place = learned.filter(|_| origin != Origin::Learned).ok_or(full)?;
        self.hosts.remove(place);
        Ok(())
    }

    fn gateway(&self, destination: Ipv4Addr) -> Option<Ipv4Addr> {
        let network = self.networks.iter().find(|route| route.network.contains(destination));
        network.map(|route| route.gateway)
    }

    /// The longest prefix first, so that the first that contains an address is the one.
    fn place(&self, network: Network) -> Result<usize, usize> {
        let order = |of: Network| (32 - of.prefix, of.address);
        self.networks.binary_search_by_key(&order(network), |route| order(route.network))
    }

    fn check_host(&self, ip: Ipv4Addr) -> Result<(), RouteError> {
        let why = match ip {
            _ if ip == self.own.ip => "it is this station's own",
            _ if ip.is_loopback() => "it is a loopback address",
            _ if ip.is_multicast() => "it is a multicast address",
            _ if ip.is_unspecified() => "it is the unspecified address",
            _ if self.own.is_broadcast(ip) => "it is the broadcast address",
            _ => return Ok(()),
        };
        Err(RouteError::NotAHost(ip, why))
    }
}

impl Network {
    /// The network of `address` whose stations share so many leading bits, at most 32.
    pub fn new(address: Ipv4Addr, prefix: u8) -> Self {
        let prefix = prefix.min(32);
        Self { address: Ipv4Addr::from_bits(address.to_bits() & mask(prefix)), prefix }
    }
    /// A single host.
    pub fn host(ip: Ipv4Addr) -> Self {
        Self::new(ip, 32)
    }
    /// Its first address.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }
    /// How many leading bits its addresses share.
    pub fn prefix(&self) -> u8 {
        self.prefix
    }
    /// Whether `ip` is one of its addresses.
    pub fn contains(&self, ip: Ipv4Addr) -> bool {
        ip.to_bits() & mask(self.prefix) == self.address.to_bits()
    }
}

const fn mask(prefix: u8) -> u32 {
    if prefix == 0 { 0 } else { u32::MAX << (32 - prefix) }
}

impl fmt::Display for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.prefix {
            32 => self.address.fmt(f),
            prefix => write!(f, "{}/{prefix}", self.address),
        }
    }
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// What is not an IPv4 network.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "'{0}' is no IPv4 address or network: expected one as 10.0.0.7 or 10.1.0.0/16, without bits behind the prefix"
)]
pub struct NotANetwork(String);

impl FromStr for Network {
    type Err = NotANetwork;

    fn from_str(text: &str) -> Result<Self, NotANetwork> {
        let parse = || {
            let (address, prefix) = text.split_once('/').unwrap_or((text, "32"));
            let digits = prefix.bytes().all(|byte| byte.is_ascii_digit());
            let (address, prefix) = (address.parse().ok()?, prefix.parse().ok().filter(|_| digits)?);
            let network = Network::new(address, prefix);
            (prefix <= 32 && network.address == address).then_some(network)
        };
        parse().ok_or_else(|| NotANetwork(text.to_owned()))
    }
}

#[cfg(test)]
mod tests;
