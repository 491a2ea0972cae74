//! The Internet addresses of a device.

use std::net::{IpAddr, Ipv4Addr};

use netlink_packet_core::{NLM_F_ACK, NLM_F_CREATE, NLM_F_DUMP, NLM_F_EXCL};
use netlink_packet_route::address::{AddressAttribute, AddressHeaderFlags, AddressMessage};
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use nix::errno::Errno;

use super::{Links, Refused};

impl Links {
    /// The addresses of the device with this index, each with its prefix's length in bits: none of a device that is not
    /// there.
    ///
    /// # Errors
    /// The kernel's answer cannot be understood.
    pub fn addresses(&mut self, index: u32) -> Result<Vec<(IpAddr, u8)>, Refused> {
        let question = RouteNetlinkMessage::GetAddress(AddressMessage::default());
        let what = format!("list the addresses of interface #{index}");
        let replies = self.kernel.request(&what, question, NLM_F_DUMP, &[])?;
        let of_it = |reply| match reply {
            RouteNetlinkMessage::NewAddress(message) if message.header.index == index => own(&message),
            _ => None,
        };
        Ok(replies.into_iter().filter_map(of_it).collect())
    }

    /// Gives the device an address at once, without asking whether another has it, and its network is reached by it. One
    /// that it has already is no error.
    ///
    /// # Errors
    /// There is no such device, the prefix is too long, the device has no IPv6, or the address with another prefix.
    pub fn add_address(&mut self, index: u32, ip: IpAddr, prefix: u8) -> Result<(), Refused> {
        let mut message = message(index, ip, prefix);
        match ip {
            IpAddr::V4(ip) => {
                message.attributes.extend(broadcast(ip, prefix).map(AddressAttribute::Broadcast))
            }
            IpAddr::V6(_) => message.header.flags = AddressHeaderFlags::Nodad,
        }
        let added = self.kernel.request(
            &format!("give interface #{index} the address {ip}/{prefix}"),
            RouteNetlinkMessage::NewAddress(message),
            NLM_F_ACK | NLM_F_CREATE | NLM_F_EXCL,
            &[
                (
                    Errno::EINVAL,
                    "the prefix has at most 32 bits, with IPv6 128, and the address is a single station's",
                ),
                (Errno::EACCES, "IPv6 must be on there: sysctl net.ipv6.conf.NAME.disable_ipv6=0"),
                (Errno::EOPNOTSUPP, "the kernel must have CONFIG_IPV6"),
            ],
        );
        match added {
            Err(refused) if refused.errno() == Some(Errno::EEXIST) => {
                // With IPv6 the kernel says so of the address alone, whatever its prefix.
                if self.addresses(index)?.contains(&(ip, prefix)) {
                    return Ok(());
                }
                let remedy = "it has this address with another prefix length: take that away";
                Err(Refused { remedy: Some(remedy.into()), ..refused })
            }
            other => other.map(drop),
        }
    }

    /// Takes an address from the device.
    ///
    /// # Errors
    /// There is no such device, or it has no such address.
    pub fn remove_address(&mut self, index: u32, ip: IpAddr, prefix: u8) -> Result<(), Refused> {
        let what = format!("take the address {ip}/{prefix} from interface #{index}");
        let message = RouteNetlinkMessage::DelAddress(message(index, ip, prefix));
        let remedies = &[(Errno::EADDRNOTAVAIL, "it has no such address")];
        self.kernel.request(&what, message, NLM_F_ACK, remedies).map(drop)
    }
}

fn message(index: u32, ip: IpAddr, prefix: u8) -> AddressMessage {
    let mut message = AddressMessage::default();
    message.header.family = if ip.is_ipv4() { AddressFamily::Inet } else { AddressFamily::Inet6 };
    (message.header.index, message.header.prefix_len) = (index, prefix);
    message.attributes = vec![AddressAttribute::Local(ip), AddressAttribute::Address(ip)];
    message
}

/// The device's own address: with a peer's beside it, IFA_ADDRESS is the peer's; IPv6 mostly has no IFA_LOCAL.
fn own(message: &AddressMessage) -> Option<(IpAddr, u8)> {
    let attributes = || message.attributes.iter();
    let local = attributes().find_map(|a| if let AddressAttribute::Local(ip) = a { Some(*ip) } else { None });
    let address =
        || attributes().find_map(|a| if let AddressAttribute::Address(ip) = a { Some(*ip) } else { None });
    Some((local.or_else(address)?, message.header.prefix_len))
}

/// That of a network with room for one: all bits of the hosts are ones.
fn broadcast(ip: Ipv4Addr, prefix: u8) -> Option<Ipv4Addr> {
    let hosts = u32::MAX.checked_shr(prefix.into())?;
    (prefix <= 30).then(|| Ipv4Addr::from_bits(ip.to_bits() | hosts))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_network_has_a_broadcast_address_if_there_is_room_for_one() {
        let ip = Ipv4Addr::new(10, 1, 2, 3);
        for (prefix, address) in [
            (0, Some([255, 255, 255, 255])),
            (8, Some([10, 255, 255, 255])),
            (24, Some([10, 1, 2, 255])),
            (30, Some([10, 1, 2, 3])),
            (31, None),
            (32, None),
            (200, None),
        ] {
            assert_eq!(broadcast(ip, prefix), address.map(Ipv4Addr::from), "{prefix}");
        }
    }
}
