//! Which station has an address, where only packets go through the tunnel: what was configured, and what ARP has told.

use core::fmt;
use core::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use core::str::FromStr;

use rtnet::wire::arp::{self, Operation};
use rtnet::wire::ethernet::{Address, NotAnAddress};

/// Networks that a table takes, and as many neighbours that it learns of.
pub const MOST: usize = 256;

/// Addresses that begin alike.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Prefix {
    /// One of them.
    pub ip: IpAddr,
    /// How many bits of it they have in common.
    pub length: u8,
}

/// A station, and the addresses that are reached by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peer {
    /// What is reached.
    pub network: Prefix,
    /// By whom.
    pub station: Address,
}

/// Who has which addresses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Peers {
    /// The longest prefixes first.
    all: Vec<Peer>,
    /// Neighbours by their ARP, the one that has been there for longest first.
    learned: Vec<(Ipv4Addr, Address)>,
    /// The networks that the device is part of: what is for all of one is for all stations.
    own: Vec<Prefix>,
    /// Whose table it is.
    itself: Address,
}

/// Why a table does not take a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PeerError {
    /// There is no room.
    #[error("the table of a VNIC's stations is full: it takes {MOST}")]
    Full,
    /// A group's address is no station's.
    #[error("{0} is the address of a group: name a station's")]
    Group(Address),
    /// Nothing is tunnelled to oneself.
    #[error("{0} is this station itself: name another")]
    Itself(Address),
}

/// Not an address that a host may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} is the address of a group, of all or of nobody: a device has one of its own, as 10.0.0.2/24")]
pub struct NotAHosts(pub Prefix);

impl Peers {
    /// A table for this station's device, with these addresses.
    pub fn new(itself: Address, own: Vec<Prefix>) -> Self {
        Self { all: Vec::new(), learned: Vec::new(), own, itself }
    }

    /// The same for a device with other addresses.
    pub fn with_own(self, own: Vec<Prefix>) -> Self {
        let mut table = Self { own, ..self };
        let Self { learned, own, .. } = &mut table;
        learned.retain(|&(ip, _)| own.iter().any(|own| own.contains(ip.into())));
        table
    }

    /// Enters a station; one for the same addresses is replaced.
    pub fn add(&mut self, peer: Peer) -> Result<(), PeerError> {
        if peer.station.is_group() {
            return Err(PeerError::Group(peer.station));
        }
        if peer.station == self.itself {
            return Err(PeerError::Itself(peer.station));
        }
        self.all.retain(|other| other.network.masked() != peer.network.masked());
        if self.all.len() == MOST {
            return Err(PeerError::Full);
        }
        let place = self.all.partition_point(|other| other.network.length >= peer.network.length);
        self.all.insert(place, peer);
        Ok(())
    }

    /// All that are known: those that were configured, and then those that were learned.
    pub fn all(&self) -> impl Iterator<Item = Peer> + '_ {
        let learned =
            |&(ip, station): &(Ipv4Addr, Address)| Peer { network: Prefix::of_one(ip.into()), station };
        self.all.iter().copied().chain(self.learned.iter().map(learned))
    }

    /// Hears what a station says by ARP: where its address is learned, and what it is answered, if anything.
    pub fn hear(&mut self, heard: &arp::Packet) -> Option<arp::Packet> {
        let (ip, station) = (heard.sender_ip(), heard.sender());
        if station.is_group() || station == self.itself {
            return None;
        }
        let is_asked = self.is_own(heard.target_ip());
        let is_neighbour = self.neighbours(ip).is_some();
        let known = self.learned.iter().position(|&(known, _)| known == ip);
        // Whoever asks for this station will be sent to; others say something new only of whom is sent to already.
        if is_neighbour && (is_asked || known.is_some()) {
            match known {
                Some(place) => self.learned[place].1 = station,
                None => {
                    if self.learned.len() == MOST {
                        self.learned.remove(0);
                    }
                    self.learned.push((ip, station));
                }
            }
        }
        let is_request = heard.operation() == Operation::Request;
        (is_asked && is_request).then(|| arp::Packet::reply_to(heard, self.itself))
    }

    /// What to ask all stations for a packet that nobody is known to take; none if its destination is no neighbour.
    pub fn question(&self, packet: &[u8]) -> Option<arp::Packet> {
        let Some(IpAddr::V4(to)) = destination(packet).filter(|_| self.station_of(packet).is_none()) else {
            return None;
        };
        self.neighbours(to).map(|own| arp::Packet::request(self.itself, own, to))
    }

    fn is_own(&self, ip: Ipv4Addr) -> bool {
        self.own.iter().any(|own| own.ip == IpAddr::V4(ip))
    }

    /// The device's own address in the network of another host.
    fn neighbours(&self, ip: Ipv4Addr) -> Option<Ipv4Addr> {
        let is_of = |own: &&Prefix| {
            let other = Prefix { ip: ip.into(), length: own.length };
            own.contains(other.ip) && other.of_a_host().is_ok()
        };
        let own = self.own.iter().find(is_of).filter(|_| !self.is_own(ip))?;
        match own.ip {
            IpAddr::V4(own) => Some(own),
            IpAddr::V6(_) => None,
        }
    }

    /// Whom a packet goes to: a station, a group of them, or nobody who is known.
    pub fn station_of(&self, packet: &[u8]) -> Option<Address> {
        match destination(packet)? {
            IpAddr::V4(ip) if ip.is_multicast() => {
                let [_, b, c, d] = ip.octets();
                Some(Address([0x01, 0x00, 0x5e, b & 0x7f, c, d]))
            }
            IpAddr::V6(ip) if ip.is_multicast() => {
                let [.., a, b, c, d] = ip.octets();
                Some(Address([0x33, 0x33, a, b, c, d]))
            }
            IpAddr::V4(ip) if ip.is_broadcast() || self.own.iter().any(|own| own.is_all(ip)) => {
                Some(Address::BROADCAST)
            }
            ip => {
                // A neighbour has an address of its own: what was configured for it alone goes before what it says.
                let configured = self.all.iter().find(|peer| peer.network.contains(ip));
                let learned = || self.learned.iter().find(|&&(known, _)| IpAddr::V4(known) == ip);
                match configured.filter(|peer| peer.network.is_of_one()) {
                    Some(peer) => Some(peer.station),
                    None => learned().map(|&(_, station)| station).or(configured.map(|peer| peer.station)),
                }
            }
        }
    }
}

impl Prefix {
    /// That of one address.
    fn of_one(ip: IpAddr) -> Self {
        Self { ip, length: if ip.is_ipv4() { 32 } else { 128 } }
    }

    fn is_of_one(&self) -> bool {
        *self == Self::of_one(self.ip)
    }

    /// Whether an address is one of these.
    pub fn contains(&self, ip: IpAddr) -> bool {
        Prefix { ip, ..*self }.masked() == self.masked() && ip.is_ipv4() == self.ip.is_ipv4()
    }

    /// The same, if its address may be a host's.
    pub fn of_a_host(self) -> Result<Self, NotAHosts> {
        let is_of_one = match self.ip {
            IpAddr::V4(ip) => !(ip.is_multicast() || ip.is_broadcast() || self.is_all(ip)),
            IpAddr::V6(ip) => !ip.is_multicast(),
        };
        if is_of_one && !self.ip.is_unspecified() { Ok(self) } else { Err(NotAHosts(self)) }
    }

    /// Whether it is the address of all hosts of an IPv4 network.
    fn is_all(&self, ip: Ipv4Addr) -> bool {
        self.length < 31 && self.contains(ip.into()) && ip.to_bits() | self.mask() == u32::MAX
    }

    /// What an IPv4 network's addresses have in common, as ones.
    fn mask(&self) -> u32 {
        u32::MAX.checked_shl(32 - u32::from(self.length)).unwrap_or(0)
    }

    /// What they have in common.
    fn masked(&self) -> (u128, u8) {
        let (bits, width) = match self.ip {
            IpAddr::V4(ip) => (u128::from(ip.to_bits()), 32),
            IpAddr::V6(ip) => (ip.to_bits(), 128),
        };
        let rest = width - u32::from(self.length).min(width);
        (bits.checked_shr(rest).unwrap_or(0), self.length)
    }
}

/// Where a packet of either version goes; none if it is too short to tell, or of another.
fn destination(packet: &[u8]) -> Option<IpAddr> {
    match packet.first()? >> 4 {
        4 => Some(Ipv4Addr::from(<[u8; 4]>::try_from(packet.get(16..20)?).ok()?).into()),
        6 => Some(Ipv6Addr::from(<[u8; 16]>::try_from(packet.get(24..40)?).ok()?).into()),
        _ => None,
    }
}

impl fmt::Display for Prefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.ip, self.length)
    }
}

impl fmt::Debug for Prefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Not addresses of IP.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no IP address with a prefix length: write it as 10.0.0.2/24 or fd00::2/64")]
pub struct NotAPrefix(String);

impl FromStr for Prefix {
    type Err = NotAPrefix;

    /// Without a length it is the address alone.
    fn from_str(text: &str) -> Result<Self, NotAPrefix> {
        let refuse = || NotAPrefix(text.to_owned());
        let (ip, length) = text.split_once('/').map_or((text, None), |(ip, length)| (ip, Some(length)));
        let ip: IpAddr = ip.parse().map_err(|_| refuse())?;
        let most = if ip.is_ipv4() { 32 } else { 128 };
        let is_number = |length: &&str| length.bytes().all(|byte| byte.is_ascii_digit());
        let length = match length {
            None => most,
            Some(length) => {
                Some(length).filter(is_number).and_then(|length| length.parse().ok()).ok_or_else(refuse)?
            }
        };
        if length > most { Err(refuse()) } else { Ok(Self { ip, length }) }
    }
}

/// Not a peer.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotAPeer {
    /// The two parts are not there.
    #[error("'{0}' says not who has which address: write it as 10.0.0.3=02:00:00:00:00:03")]
    Parts(String),
    /// The addresses are none.
    #[error(transparent)]
    Prefix(#[from] NotAPrefix),
    /// The station is none.
    #[error(transparent)]
    Station(#[from] NotAnAddress),
}

impl FromStr for Peer {
    type Err = NotAPeer;

    fn from_str(text: &str) -> Result<Self, NotAPeer> {
        let (network, station) = text.split_once('=').ok_or_else(|| NotAPeer::Parts(text.to_owned()))?;
        Ok(Self { network: network.parse()?, station: station.parse()? })
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.network, self.station)
    }
}

#[cfg(test)]
mod tests;
