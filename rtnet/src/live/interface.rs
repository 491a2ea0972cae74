//! Network interfaces of the calling thread's namespace, as far as a port needs them.

use std::io;
use std::os::fd::AsRawFd;

use nix::ifaddrs::getifaddrs;
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

    /// Whether the interface is still there: it was neither removed nor moved to another namespace.
    pub fn is_there(&self) -> io::Result<bool> {
        let address: SockaddrStorage = getsockname(self.socket.as_raw_fd())?;
        Ok(address.as_link_addr().is_some_and(|link| link.ifindex() == self.index))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
