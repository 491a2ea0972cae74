//! What the kernel tells about an interface, and what it takes for its name and MAC.

use anyhow::{Result, ensure};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::link::{
    BridgePortState, InfoBridgePort, InfoPortData, LinkAttribute, LinkInfo, State,
};
use pnet_datalink::MacAddr;

/// The longest interface name, in bytes: IFNAMSIZ (16) less the closing zero.
pub const NAME_MAX: usize = 15;

/// An interface, as the kernel described it at the time of the question.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    /// Number of the interface, unique within its namespace only.
    pub index: u32,
    /// Name of the interface, at most [`NAME_MAX`] bytes.
    pub name: String,
    /// Its MAC, if it has one of six bytes.
    pub mac: Option<[u8; 6]>,
    /// It was set up, and the other end too: frames pass (RFC 2863 ifOperStatus `up`).
    pub operational: bool,
    /// Index of the bridge it is a port of.
    pub bridge: Option<u32>,
    /// As a port of a bridge, it takes frames in and passes them on.
    pub forwarding: bool,
}

impl Link {
    /// The interface that a reply describes, if it describes one.
    pub(super) fn from_reply(reply: RouteNetlinkMessage) -> Option<Self> {
        let RouteNetlinkMessage::NewLink(message) = reply else {
            return None;
        };
        let mut link = Self {
            index: message.header.index,
            name: String::new(),
            mac: None,
            operational: false,
            bridge: None,
            forwarding: false,
        };
        for attribute in message.attributes {
            match attribute {
                LinkAttribute::IfName(name) => link.name = name,
                LinkAttribute::Address(mac) => link.mac = mac.try_into().ok(),
                LinkAttribute::OperState(state) => link.operational = state == State::Up,
                LinkAttribute::Controller(bridge) => link.bridge = Some(bridge),
                LinkAttribute::LinkInfo(infos) => link.forwarding = infos.iter().any(is_forwarding),
                _ => {}
            }
        }
        Some(link)
    }
}

fn is_forwarding(info: &LinkInfo) -> bool {
    let LinkInfo::PortData(InfoPortData::BridgePort(settings)) = info else {
        return false;
    };
    settings.contains(&InfoBridgePort::State(BridgePortState::Forwarding))
}

/// Refuses what dev_valid_name of the kernel refuses, and `%`, which it takes for a pattern.
pub(super) fn check_name(name: &str) -> Result<()> {
    ensure!(!name.is_empty(), "an interface needs a name");
    ensure!(
        name.len() <= NAME_MAX,
        "interface name `{name}` has {} bytes, the kernel takes at most {NAME_MAX}: shorten it",
        name.len()
    );
    let refused = |c: char| c.is_whitespace() || c.is_control() || "/:%".contains(c);
    ensure!(
        name != "." && name != ".." && !name.contains(refused),
        "`{name}` cannot name an interface: no blanks, no `/`, `:` or `%`, not `.` or `..`"
    );
    Ok(())
}

/// Refuses multicast addresses and zero.
pub(super) fn check_mac(mac: [u8; 6]) -> Result<()> {
    ensure!(
        mac != [0; 6] && mac[0] & 1 == 0,
        "MAC {} cannot be a station's: the first byte must be even, and not all bytes zero",
        MacAddr::from(mac)
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_of_one_to_fifteen_harmless_bytes() {
        for good in ["a", "rt0", "fifteen-bytes-x", "ä.1"] {
            assert!(check_name(good).is_ok(), "{good}");
        }
        for bad in ["", ".", "..", "a b", "a/b", "a:1", "rt%d", "sixteen-bytes-xx", "ääääääää"] {
            assert!(check_name(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn macs_are_of_single_stations() {
        assert!(check_mac([0x02, 0, 0, 0, 0, 1]).is_ok());
        assert!(check_mac([0x03, 0, 0, 0, 0, 1]).is_err());
        assert!(check_mac([0; 6]).is_err());
    }
}
