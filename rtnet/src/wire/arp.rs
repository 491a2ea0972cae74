//! ARP for IPv4 on Ethernet (RFC 826).
//!
//! ```text
//! 0        2        4     5     6          8         14          18        24          28
//! +--------+--------+-----+-----+----------+---------+-----------+---------+-----------+---------
//! |hardware|protocol|  6  |  4  |operation | sender  | sender's  | target  | target's  | padding
//! |1: Ethernet      | lengths   |1: request|         | IPv4      |0: asked | IPv4      |
//! |6: IEEE |0x0800  |           |2: reply  |         | address   |for      | address   |
//! +--------+--------+-----+-----+----------+---------+-----------+---------+-----------+---------
//! ```

use core::net::Ipv4Addr;

use zerocopy::byteorder::network_endian::U16;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::ethernet::{Address, EtherType};
use crate::counters::Refusal;

/// Bytes of an ARP packet.
pub const LEN: usize = size_of::<Packet>();

/// What follows the Ethernet header.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Packet {
    hardware: U16,
    protocol: U16,
    hardware_len: u8,
    protocol_len: u8,
    operation: U16,
    sender: Address,
    sender_ip: [u8; 4],
    target: Address,
    target_ip: [u8; 4],
}

/// What the sender wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// Who has the target's IPv4 address?
    Request,
    /// The sender has its own.
    Reply,
}

const _: () = assert!(LEN == 28);

const ETHERNET: u16 = 1;
/// IEEE 802 networks; the rest is as with Ethernet.
const IEEE_802: u16 = 6;
const REQUEST: u16 = 1;
const REPLY: u16 = 2;

/// Reads what follows the Ethernet header; what is behind the packet is padding.
pub fn parse(payload: &[u8]) -> Result<&Packet, Refusal> {
    let (packet, _) = Packet::ref_from_prefix(payload).map_err(|_| Refusal::Truncated)?;
    let is_ours = matches!(packet.hardware.get(), ETHERNET | IEEE_802)
        && packet.protocol.get() == EtherType::IPV4.0
        && (packet.hardware_len, packet.protocol_len) == (6, 4)
        && matches!(packet.operation.get(), REQUEST | REPLY);
    if is_ours { Ok(packet) } else { Err(Refusal::ArpFormat) }
}

impl Packet {
    /// Asks for the Ethernet address of `target_ip`.
    pub fn request(sender: Address, sender_ip: Ipv4Addr, target_ip: Ipv4Addr) -> Self {
        Self {
            hardware: U16::new(ETHERNET),
            protocol: U16::new(EtherType::IPV4.0),
            hardware_len: 6,
            protocol_len: 4,
            operation: U16::new(REQUEST),
            sender,
            sender_ip: sender_ip.octets(),
            target: Address::default(),
            target_ip: target_ip.octets(),
        }
    }

    /// Answers who asked: the address asked for is that of `own`. The hardware type is theirs, which they
    /// understand for sure.
    pub fn reply_to(request: &Packet, own: Address) -> Self {
        Self {
            operation: U16::new(REPLY),
            sender: own,
            sender_ip: request.target_ip,
            target: request.sender,
            target_ip: request.sender_ip,
            ..*request
        }
    }

    /// What the sender wants.
    pub fn operation(&self) -> Operation {
        if self.operation.get() == REQUEST { Operation::Request } else { Operation::Reply }
    }
    /// Who sent it, as it says.
    pub fn sender(&self) -> Address {
        self.sender
    }
    /// And its IPv4 address.
    pub fn sender_ip(&self) -> Ipv4Addr {
        self.sender_ip.into()
    }
    /// Who it is for; nobody yet in a request.
    pub fn target(&self) -> Address {
        self.target
    }
    /// Whose address is asked for, or who asked.
    pub fn target_ip(&self) -> Ipv4Addr {
        self.target_ip.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ASKING: Address = Address([2, 0, 0, 0, 0, 1]);
    const ASKED: Address = Address([2, 0, 0, 0, 0, 3]);
    const ASKING_IP: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
    const ASKED_IP: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 3);
    /// Of example frames 26 and 27.
    const REQUEST_BYTES: [u8; LEN] =
        [0, 1, 8, 0, 6, 4, 0, 1, 2, 0, 0, 0, 0, 1, 10, 0, 0, 1, 0, 0, 0, 0, 0, 0, 10, 0, 0, 3];
    const REPLY_BYTES: [u8; LEN] =
        [0, 1, 8, 0, 6, 4, 0, 2, 2, 0, 0, 0, 0, 3, 10, 0, 0, 3, 2, 0, 0, 0, 0, 1, 10, 0, 0, 1];

    #[test]
    fn bytes_and_packet_are_the_same_thing_in_both_directions() {
        let request = Packet::request(ASKING, ASKING_IP, ASKED_IP);
        assert_eq!(request.as_bytes(), REQUEST_BYTES);
        assert_eq!(Packet::reply_to(&request, ASKED).as_bytes(), REPLY_BYTES);

        let request = parse(&REQUEST_BYTES).unwrap();
        assert_eq!(request.operation(), Operation::Request);
        assert_eq!((request.sender(), request.sender_ip()), (ASKING, ASKING_IP));
        assert_eq!((request.target(), request.target_ip()), (Address([0; 6]), ASKED_IP));
        let reply = parse(&REPLY_BYTES).unwrap();
        assert_eq!(reply.operation(), Operation::Reply);
        assert_eq!((reply.sender(), reply.sender_ip()), (ASKED, ASKED_IP));
        assert_eq!((reply.target(), reply.target_ip()), (ASKING, ASKING_IP));
    }

    #[test]
    fn who_asks_as_ieee_802_is_answered_as_ieee_802() {
        let mut bytes = REQUEST_BYTES;
        bytes[1] = 6;
        let reply = Packet::reply_to(parse(&bytes).unwrap(), ASKED);
        assert_eq!(reply.as_bytes()[..8], [0, 6, 8, 0, 6, 4, 0, 2]);
    }

    #[test]
    fn other_hardware_protocols_lengths_and_operations_are_refused() {
        for at in 0..8 {
            for byte in 0..=u8::MAX {
                let mut bytes = REQUEST_BYTES;
                bytes[at] = byte;
                let is_ours = byte == REQUEST_BYTES[at] || matches!((at, byte), (1, 6) | (7, 2));
                let expected = if is_ours { None } else { Some(Refusal::ArpFormat) };
                assert_eq!(parse(&bytes).err(), expected, "{byte} at {at}");
            }
        }
    }

    proptest! {
        #[test]
        fn no_bytes_whatever_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..60), plausible in 0..=8usize) {
            let plausible = plausible.min(bytes.len());
            bytes[..plausible].copy_from_slice(&REQUEST_BYTES[..plausible]);
            let parsed = parse(&bytes);
            prop_assert_eq!(parsed == Err(Refusal::Truncated), bytes.len() < LEN);
            if let Ok(packet) = parsed {
                let reply = Packet::reply_to(packet, ASKED);
                prop_assert_eq!(reply.target_ip(), packet.sender_ip());
                prop_assert!(parse(reply.as_bytes()).is_ok());
            }
        }

        #[test]
        fn what_is_built_is_parsed_whatever_follows_and_every_part_of_it_is_refused(
            (sender, own) in (any::<[u8; 6]>(), any::<[u8; 6]>()),
            (sender_ip, target_ip) in (any::<u32>(), any::<u32>()),
            padding in prop::collection::vec(any::<u8>(), 0..30),
        ) {
            let request = Packet::request(Address(sender), sender_ip.into(), target_ip.into());
            for packet in [request, Packet::reply_to(&request, Address(own))] {
                let mut bytes = [packet.as_bytes(), &padding].concat();
                prop_assert_eq!(parse(&bytes), Ok(&packet));
                bytes.truncate(LEN);
                while bytes.pop().is_some() {
                    prop_assert_eq!(parse(&bytes), Err(Refusal::Truncated));
                }
            }
        }
    }
}
