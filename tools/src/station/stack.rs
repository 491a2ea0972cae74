//! What a station's stack is to be.

use std::net::Ipv4Addr;
use std::ops::RangeInclusive;
use std::str::FromStr;

use anyhow::Result;
use rtnet::api::line::Lines;
use rtnet::ip::route::{Interface, Routes};
use rtnet::ip::{Stack, StackConfig};
use rtnet::live::RECEIVE_POOL;
use rtnet::socket::{DEFAULT_BUFFERS, Program};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::echoes::Asker;
use super::packages::{self, PackagesOptions};
use super::sockets::{Room, Route};

/// What is said of a station's stack.
#[derive(Clone, Debug)]
pub struct StackOptions {
    /// Its address.
    pub ip: OwnIp,
    /// Where others are, with what is told of a route that cannot be.
    pub routes: Vec<(String, Route)>,
    /// Sockets at the most.
    pub sockets: u16,
    /// Ports that are given out.
    pub ports: RangeInclusive<u16>,
    /// Whether datagrams in fragments must have the right checksum, too.
    pub strict_checksums: bool,
    /// How long the next fragment is waited for.
    pub fragment_timeout: Span,
    /// Host routes at the most.
    pub hosts: usize,
    /// Network routes at the most.
    pub networks: usize,
    /// Buffers of a socket whose program does not say how many.
    pub socket_buffers: u16,
    /// Buffers for frames that have just come.
    pub receive_buffers: usize,
    /// Buffers for echoes.
    pub icmp_buffers: usize,
    /// Buffers for address resolution.
    pub arp_buffers: usize,
    /// Whether what programs send with times, as packages are, says when it was sent, and when it left.
    pub package_times: bool,
}

impl StackOptions {
    /// Of a station with this address, of which nothing else was said.
    pub fn usual(ip: OwnIp) -> Self {
        let config = StackConfig::new(ip.interface(Address::default()));
        Self {
            ip,
            routes: Vec::new(),
            sockets: config.sockets,
            ports: config.ports,
            strict_checksums: config.fragment_checksums,
            fragment_timeout: config.fragment_timeout,
            hosts: config.hosts,
            networks: config.networks,
            socket_buffers: DEFAULT_BUFFERS as u16,
            receive_buffers: RECEIVE_POOL,
            icmp_buffers: config.icmp_buffers,
            arp_buffers: config.arp_buffers,
            package_times: false,
        }
    }

    /// How much it can have.
    pub fn room(&self) -> Room {
        Room { sockets: self.sockets.into(), hosts: self.hosts, networks: self.networks }
    }

    /// The stack of a station whose interface has this address, with what asks for echoes, and with a router of packages if there are any.
    pub fn stack(
        &self,
        address: Address,
        asker: Option<Asker>,
        packages: Option<&PackagesOptions>,
    ) -> Result<Stack> {
        let config = StackConfig {
            interface: self.ip.interface(address),
            hosts: self.hosts,
            networks: self.networks,
            sockets: self.sockets,
            ports: self.ports.clone(),
            icmp_buffers: self.icmp_buffers,
            arp_buffers: self.arp_buffers,
            fragment_timeout: self.fragment_timeout,
            fragment_checksums: self.strict_checksums,
        };
        let mut programs: Vec<Box<dyn Program>> = vec![Box::new(Lines::new(self.sockets.into()))];
        programs.extend(asker.map(|asker| Box::new(asker) as Box<dyn Program>));
        programs.extend(packages.map(|options| packages::router(options) as Box<dyn Program>));
        let mut stack = Stack::new(config, programs);
        if packages.is_some() {
            packages::listen(&mut stack)?;
        }
        self.add_to(stack.routes_mut())?;
        Ok(stack)
    }

    /// Refuses routes that cannot be, before anything is opened.
    pub fn check(&self) -> Result<()> {
        let own = self.ip.interface(Address::default());
        self.add_to(&mut Routes::new(own, self.hosts, self.networks))
    }

    fn add_to(&self, routes: &mut Routes) -> Result<()> {
        for (whence, route) in &self.routes {
            add(routes, route).map_err(|error| anyhow::anyhow!("{whence}: {error}"))?;
        }
        Ok(())
    }
}

/// Adds a route that was said by hand.
pub fn add(routes: &mut Routes, route: &Route) -> Result<(), rtnet::ip::route::RouteError> {
    match *route {
        Route::Host(host) => routes.add_host(host),
        Route::Network(network) => routes.add_network(network),
    }
}

/// A station's own address, and how much of it is its network's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OwnIp {
    /// The address.
    pub ip: Ipv4Addr,
    /// Leading bits of its network.
    pub prefix: u8,
}

impl OwnIp {
    fn interface(self, address: Address) -> Interface {
        Interface { address, ip: self.ip, prefix: self.prefix }
    }
}

/// What cannot be a station's address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{text}' {why}: write an address of one station, as 10.0.0.1/24")]
pub struct NotOwnIp {
    text: String,
    why: &'static str,
}

impl FromStr for OwnIp {
    type Err = NotOwnIp;

    fn from_str(text: &str) -> Result<Self, NotOwnIp> {
        let refused = |why| NotOwnIp { text: text.to_owned(), why };
        let (ip, prefix) = match text.split_once('/') {
            Some((ip, prefix)) => (ip, Some(prefix)),
            None => (text, None),
        };
        let ip: Ipv4Addr = ip.parse().map_err(|_| refused("is no IPv4 address"))?;
        let prefix = match prefix {
            None => prefix_of_class(ip),
            Some(bits) => {
                let digits = bits.bytes().all(|byte| byte.is_ascii_digit());
                let bits = bits.parse().ok().filter(|bits| digits && (1..=32).contains(bits));
                bits.ok_or_else(|| refused("has no prefix of 1 to 32 bits"))?
            }
        };
        let own = Interface { address: Address::default(), ip, prefix };
        let network = own.network().address();
        match ip {
            _ if ip.is_unspecified() || ip.octets()[0] == 0 => Err(refused("is no station's")),
            _ if ip.is_loopback() => Err(refused("is a loopback address")),
            _ if ip.octets()[0] >= 224 => Err(refused("is a multicast or a reserved address")),
            _ if own.is_broadcast(ip) => Err(refused("is the broadcast address of its network")),
            _ if prefix < 31 && ip == network => Err(refused("is its network's own address")),
            _ => Ok(Self { ip, prefix }),
        }
    }
}

/// RTnet's: by the address's class.
fn prefix_of_class(ip: Ipv4Addr) -> u8 {
    match ip.octets()[0] {
        0..128 => 8,
        128..192 => 16,
        192.. => 24,
    }
}

/// Reads `A-B`.
pub fn parse_ports(text: &str) -> Result<RangeInclusive<u16>, String> {
    let range = || {
        let (first, last) = text.split_once('-')?;
        // A number may have a sign, a port has none.
        let port = |text: &str| text.parse::<u16>().ok().filter(|_| !text.starts_with('+'));
        let (first, last) = (port(first)?, port(last)?);
        (first > 0 && first <= last).then_some(first..=last)
    };
    range().ok_or_else(|| {
        format!("'{text}' is no range of ports: write the first and the last, from 1 to 65535, as 1024-1087")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_station_that_says_no_prefix_has_that_of_its_address_class_as_with_rtnet() {
        for (text, ip, prefix) in [
            ("10.0.0.1/24", [10, 0, 0, 1], 24),
            ("10.0.0.1", [10, 0, 0, 1], 8),
            ("172.16.0.1", [172, 16, 0, 1], 16),
            ("192.168.0.1", [192, 168, 0, 1], 24),
            ("10.0.0.0/31", [10, 0, 0, 0], 31),
        ] {
            assert_eq!(text.parse(), Ok(OwnIp { ip: ip.into(), prefix }), "{text}");
        }
    }

    #[test]
    fn what_cannot_be_a_station_s_address_says_why_and_what_to_write() {
        for (text, why) in [
            ("10.0.0", "is no IPv4 address"),
            ("10.0.0.1/33", "has no prefix of 1 to 32 bits"),
            ("10.0.0.1/+8", "has no prefix"),
            ("10.0.0.1/", "has no prefix"),
            ("0.0.0.0/8", "is no station's"),
            ("127.0.0.1/8", "loopback"),
            ("224.0.0.1/24", "multicast"),
            ("255.255.255.255", "reserved"),
            ("10.0.0.255/24", "broadcast"),
            ("10.0.0.0/24", "network's own"),
        ] {
            let error = text.parse::<OwnIp>().unwrap_err().to_string();
            assert!(error.contains(why) && error.ends_with("as 10.0.0.1/24"), "{error}");
        }
    }

    #[test]
    fn ports_are_a_range() {
        assert_eq!(parse_ports("2000-2099"), Ok(2000..=2099));
        for text in ["", "2000", "0-9", "9-8", "1-65536", "a-b", "+1-9", "1-+9"] {
            assert!(parse_ports(text).unwrap_err().contains(&format!("'{text}'")), "{text}");
        }
    }
}
