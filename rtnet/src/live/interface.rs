//! Network interfaces of the calling thread's namespace, as far as a port needs them.

use std::io;
use std::os::fd::AsRawFd;

use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::net::if_::{InterfaceFlags, if_nametoindex};
use nix::sys::socket::{SockaddrStorage, getsockname};
use socket2::Socket;

use super::packet;
use crate::wire::ethernet::Address;

/// An interface that a station can run on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Interface {
    /// Its name, as in `ip link`.
    pub name: String,
    /// The kernel's number for it.
    pub index: u32,
    /// Its Ethernet address.
    pub address: Address,
}

/// An interface as it is right now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    /// Its name, which may change while it is in use.
    pub name: String,
    /// It was set up.
    pub up: bool,
    /// It is up, and so is the other end: frames can pass. By IFF_LOWER_UP; IFF_RUNNING follows it only when the
    /// kernel's link watch gets to it, up to a second later.
    pub carrier: bool,
}

/// Why there is no such interface.
#[derive(Debug, thiserror::Error)]
pub enum InterfaceError {
    /// No interface has this name.
    #[error("there is no interface '{name}' here; there are: {}", present.join(", "))]
    Absent {
        /// What was asked for.
        name: String,
        /// What there is.
        present: Vec<String>,
    },
    /// It is down.
    #[error("the interface '{0}' is down: bring it up with `ip link set {0} up`")]
    Down(String),
    /// It has no Ethernet address.
    #[error("the interface '{0}' is not an Ethernet interface: it has no address of 6 bytes")]
    NotEthernet(String),
    /// The kernel did not answer.
    #[error("the interfaces cannot be listed: {0}")]
    Unlisted(#[from] io::Error),
}

impl Interface {
    /// The interface of this name, which must be up and Ethernet.
    pub fn find(name: &str) -> Result<Self, InterfaceError> {
        let all: Vec<_> = getifaddrs().map_err(io::Error::from)?.collect();
        let Some(found) = all.iter().find(|entry| entry.interface_name == name) else {
            let mut present: Vec<_> = all.into_iter().map(|entry| entry.interface_name).collect();
            present.sort();
            present.dedup();
            return Err(InterfaceError::Absent { name: name.into(), present });
        };
        if !found.flags.contains(InterfaceFlags::IFF_UP) {
            return Err(InterfaceError::Down(name.into()));
        }
        let link = all.iter().filter(|entry| entry.interface_name == name);
        let address = link.filter_map(|entry| entry.address?.as_link_addr()?.addr()).next();
        let is_loopback = found.flags.contains(InterfaceFlags::IFF_LOOPBACK);
        match address {
            Some(bytes) if !is_loopback => {
                let index = if_nametoindex(name).map_err(io::Error::from)?;
                Ok(Self { name: name.into(), index, address: Address(bytes) })
            }
            _ => Err(InterfaceError::NotEthernet(name.into())),
        }
    }
}

/// An eye on an interface that a port is open on. It has a socket bound as the port's are: when the interface goes,
/// if only for a moment, the kernel unbinds them all, and they stay so whatever comes back under its name or index.
pub struct Watch {
    index: usize,
    socket: Socket,
}

impl Watch {
    /// Of an interface that was found. Needs CAP_NET_RAW.
    pub fn open(interface: &Interface) -> io::Result<Self> {
        let socket = packet::open()?;
        packet::bind(&socket, interface.index, 0)?;
        Ok(Self { index: interface.index as usize, socket })
    }

    /// How the interface is; `None` if it was removed, or has moved to another namespace.
    ///
    /// # Errors
    /// The kernel did not answer, or without this interface: lists that change while they are read may lack what is
    /// there. The next look tells.
    pub fn look(&self) -> io::Result<Option<Link>> {
        let is_its = |address: &SockaddrStorage| {
            address.as_link_addr().is_some_and(|link| link.ifindex() == self.index)
        };
        if !is_its(&getsockname(self.socket.as_raw_fd())?) {
            return Ok(None);
        }
        let is_it = |entry: &InterfaceAddress| entry.address.as_ref().is_some_and(is_its);
        let entry = getifaddrs()?.find(is_it).ok_or(io::ErrorKind::NotFound)?;
        let InterfaceAddress { interface_name: name, flags, .. } = entry;
        let up = flags.contains(InterfaceFlags::IFF_UP);
        Ok(Some(Link { name, up, carrier: up && flags.contains(InterfaceFlags::IFF_LOWER_UP) }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::ring::tests::{in_a_namespace, loopback_up};

    #[test]
    fn an_absent_interface_is_named_with_those_there_are() {
        let error = Interface::find("nosuch0").unwrap_err().to_string();
        assert!(error.contains("'nosuch0'") && error.contains("lo"), "{error}");
    }

    #[test]
    fn loopback_is_not_ethernet() {
        let error = Interface::find("lo").unwrap_err();
        assert!(matches!(error, InterfaceError::NotEthernet(_) | InterfaceError::Down(_)), "{error}");
    }
    #[test]
    fn an_interface_is_seen_to_go_down_and_up() {
        in_a_namespace(|| {
            let index = if_nametoindex("lo").unwrap();
            let lo = Interface { name: "lo".into(), index, address: Address::default() };
            let watch = Watch::open(&lo).unwrap();
            for up in [true, false, true] {
                loopback_up(up);
                let seen = watch.look().unwrap();
                assert_eq!(seen, Some(Link { name: "lo".into(), up, carrier: up }));
            }
        });
    }
}
