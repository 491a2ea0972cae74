//! Rules: names that a client may register, and receivers that a sender may send to.

use core::fmt;
use core::net::IpAddr;
use core::str::FromStr;

use serde::{Deserialize, Deserializer};

use crate::name::{MailboxName, Pattern};
use crate::wire::Head;

/// The rules of a router. An empty list allows everything; a list with rules allows nothing else.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rules {
    /// Allowed registrations.
    pub register: Vec<RegisterRule>,
    /// Allowed senders and receivers.
    pub send: Vec<SendRule>,
}

/// Clients from there may register such names.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegisterRule {
    /// Addresses of clients; without it those of all.
    pub peer: Option<Network>,
    /// Allowed names.
    pub names: Vec<Pattern>,
}

/// `from` may send to `to`, and `to` may reply.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SendRule {
    /// The senders.
    pub from: Vec<Pattern>,
    /// The receivers.
    pub to: Vec<Pattern>,
}

impl Rules {
    /// Whether a client at this address may register a name.
    pub fn may_register(&self, peer: IpAddr, name: MailboxName) -> bool {
        let allows = |rule: &RegisterRule| rule.peer.is_none_or(|of| of.has(peer)) && any(&rule.names, name);
        self.register.is_empty() || self.register.iter().any(allows)
    }

    /// Whether two packages have the same answer to [`Self::may_send`].
    pub fn are_alike(one: &Head, other: &Head) -> bool {
        (one.from, one.to, one.is_command()) == (other.from, other.to, other.is_command())
    }

    /// Whether a package may go on. A reply, or data, may go where a command may come from.
    pub fn may_send(&self, head: &Head) -> bool {
        let one_way = |from, to| self.send.iter().any(|rule| any(&rule.from, from) && any(&rule.to, to));
        self.send.is_empty()
            || one_way(head.from, head.to)
            || (!head.is_command() && one_way(head.to, head.from))
    }
}

fn any(patterns: &[Pattern], name: MailboxName) -> bool {
    patterns.iter().any(|pattern| pattern.matches(name))
}

/// Addresses that begin with the same bits: `10.0.0.0/8`, `::1/128`, or one: `10.0.0.3`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Network {
    bits: u128,
    mask: u128,
    is_v4: bool,
}

impl Network {
    /// Whether an address is one of them. An IPv4 address that a socket for both shows as IPv6 is an IPv4 address.
    pub fn has(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        address.is_ipv4() == self.is_v4 && (bits(address) ^ self.bits) & self.mask == 0
    }
}

/// The bits of an IPv4 address are the highest 32.
fn bits(address: IpAddr) -> u128 {
    match address {
        IpAddr::V4(address) => u128::from(address.to_bits()) << 96,
        IpAddr::V6(address) => address.to_bits(),
    }
}

/// No network is written so.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NoNetwork(String);

impl fmt::Display for NoNetwork {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "'{}' is no network: write an address, or ADDRESS/BITS as in 10.0.0.0/8", self.0)
    }
}

impl FromStr for Network {
    type Err = NoNetwork;

    fn from_str(text: &str) -> Result<Self, NoNetwork> {
        let wrong = || NoNetwork(text.into());
        let (address, length) =
            text.split_once('/').map_or((text, None), |(address, length)| (address, Some(length)));
        let address: IpAddr = address.parse().map_err(|_| wrong())?;
        let most = if address.is_ipv4() { 32 } else { 128 };
        let length = length.map_or(Ok(most), str::parse::<u32>).map_err(|_| wrong())?;
        if length > most {
            return Err(wrong());
        }
        let mask = u128::MAX.checked_shl(128 - length).unwrap_or(0);
        Ok(Self { bits: bits(address), mask, is_v4: address.is_ipv4() })
    }
}

impl<'de> Deserialize<'de> for Network {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        String::deserialize(from)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patterns<const N: usize>(all: [&str; N]) -> Vec<Pattern> {
        all.map(|text| text.parse().unwrap()).into()
    }

    fn name(text: &str) -> MailboxName {
        text.parse().unwrap()
    }

    #[test]
    fn a_network_is_all_addresses_that_begin_with_its_bits() {
        let has =
            |network: &str, address: &str| network.parse::<Network>().unwrap().has(address.parse().unwrap());
        for (network, address) in [
            ("10.0.0.0/8", "10.255.0.1"),
            ("10.1.2.3", "10.1.2.3"),
            ("0.0.0.0/0", "192.168.0.1"),
            ("fd00::/8", "fd12::1"),
            ("::/0", "::1"),
            ("10.0.0.0/8", "::ffff:10.0.0.1"),
        ] {
            assert!(has(network, address), "{network} {address}");
        }
        for (network, address) in [
            ("10.0.0.0/8", "11.0.0.1"),
            ("10.1.2.3", "10.1.2.4"),
            ("0.0.0.0/0", "::1"),
            ("::/0", "10.0.0.1"),
            ("::1", "::2"),
        ] {
            assert!(!has(network, address), "{network} {address}");
        }
        for wrong in ["", "here", "10.0.0.0/33", "::/129", "10.0.0.0/-1", "10.0.0.0/", "/8", "10.0.0/8"] {
            assert_eq!(wrong.parse::<Network>(), Err(NoNetwork(wrong.into())));
        }
    }

    #[test]
    fn without_rules_all_is_allowed_and_with_some_nothing_else() {
        let (here, there) = ("127.0.0.1".parse().unwrap(), "10.0.0.1".parse().unwrap());
        let mut rules = Rules::default();
        assert!(rules.may_register(there, name("0.Pilot.0")));
        rules.register = vec![
            RegisterRule { peer: Some("127.0.0.0/8".parse().unwrap()), names: patterns(["0.Pilot.*"]) },
            RegisterRule { peer: None, names: patterns(["0.0x80.1"]) },
        ];
        assert!(rules.may_register(here, name("0.Pilot.7")) && rules.may_register(there, name("0.0x80.1")));
        assert!(
            !rules.may_register(there, name("0.Pilot.7")) && !rules.may_register(here, name("0.Chassis.0"))
        );
    }

    #[test]
    fn a_reply_may_go_where_a_command_may_come_from() {
        let rules = Rules {
            send: vec![SendRule { from: patterns(["0.Pilot.*"]), to: patterns(["0.Chassis.0"]) }],
            ..Rules::default()
        };
        let may = |kind, to, from| rules.may_send(&Head::new(kind, name(to), name(from)));
        assert!(may(21, "0.Chassis.0", "0.Pilot.3") && may(-6, "0.Chassis.0", "0.Pilot.3"));
        assert!(may(0, "0.Pilot.3", "0.Chassis.0"), "its reply");
        assert!(!may(21, "0.Pilot.3", "0.Chassis.0"), "a command the other way");
        assert!(!may(0, "0.Pilot.3", "0.Camera.0") && !may(21, "0.Camera.0", "0.Pilot.3"));
        assert!(Rules::default().may_send(&Head::new(21, name("0.Camera.0"), name("0.Pilot.3"))));
    }
}
