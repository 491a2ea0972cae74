//! One station at an interface: a second one would send in slots that it does not have, and take frames from the first.
//!
//! The first station binds two abstract Unix addresses, which are of the network namespace that the interface is in and go
//! with the process, however it ends: one by which it holds the interface, one that says which station it is.

use std::fs;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::process;

use anyhow::{Result, anyhow};
use rtnet::live::interface::Interface;

/// Where the kernel lists the Unix sockets of the calling thread's network namespace.
const LIST: &str = "/proc/thread-self/net/unix";

/// An interface that is this station's as long as this lives.
pub struct Claim {
    _held: UnixListener,
    _named: Option<UnixListener>,
}

impl Claim {
    /// Claims an interface for the station of this name.
    ///
    /// # Errors
    /// Another station has it: the error names that one.
    pub fn of(interface: &Interface, name: &str) -> Result<Self> {
        let held = bind(&address(interface)).map_err(|error| match error.kind() {
            io::ErrorKind::AddrInUse => {
                let holder = fs::read_to_string(LIST).ok().and_then(|list| holder(&list, interface));
                let holder = holder.unwrap_or_else(|| "another station".into());
                anyhow!(
                    "the interface '{}' has a station already, {holder}: end that one, or use another interface",
                    interface.name
                )
            }
            _ => anyhow!("the interface '{}' cannot be claimed: {error}", interface.name),
        })?;
        // Without it the next station is refused without this one's name.
        let named = bind(&format!("{}/{name} (process {})", address(interface), process::id())).ok();
        Ok(Self { _held: held, _named: named })
    }
}

fn address(interface: &Interface) -> String {
    format!("rtnet/interface/{}", interface.index)
}

fn bind(name: &str) -> io::Result<UnixListener> {
    UnixListener::bind_addr(&SocketAddr::from_abstract_name(name)?)
}

/// The station that holds the interface, by the kernel's list: `@` stands for the zero byte that abstract addresses begin with.
fn holder(list: &str, interface: &Interface) -> Option<String> {
    let before = format!("@{}/", address(interface));
    list.lines().find_map(|line| Some(line.split_once(&before)?.1.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::wire::ethernet::Address;

    fn interface(index: u32) -> Interface {
        Interface { name: "rt0".into(), index, address: Address::default() }
    }

    #[test]
    fn a_second_station_is_refused_and_the_first_is_named() {
        // Numbers that no interface of this host has.
        let (one, other) = (interface(0x7fff_ff01), interface(0x7fff_ff02));
        let claim = Claim::of(&one, "left").unwrap();
        let refused = Claim::of(&one, "right").err().unwrap().to_string();
        let expected = format!(
            "the interface 'rt0' has a station already, left (process {}): end that one, or use another interface",
            process::id()
        );
        assert_eq!(refused, expected);
        let _of_another = Claim::of(&other, "right").unwrap();
        drop(claim);
        Claim::of(&one, "right").unwrap();
    }

    #[test]
    fn the_holder_is_read_from_the_list_of_the_kernel() {
        let list = "Num RefCount Protocol Flags Type St Inode Path\n\
            0: 2 0 10000 1 1 7 @rtnet/interface/7\n\
            0: 2 0 10000 1 1 8 @rtnet/interface/77/other (process 1)\n\
            0: 2 0 10000 1 1 9 @rtnet/interface/7/left arm (process 12)\n";
        assert_eq!(holder(list, &interface(7)).as_deref(), Some("left arm (process 12)"));
        assert_eq!(holder(list, &interface(8)), None);
    }
}
