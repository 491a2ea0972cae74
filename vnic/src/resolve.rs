//! ARP where Linux speaks none: by a device for packets alone it neither asks who has an IPv4 address nor answers, but the
//! VNICs of other stations do, and send nothing before they have heard an answer.
//!
//! ```text
//!   tunnelled request for an address of the device ──► its sender is learned, a tunnelled reply leaves
//!   tunnelled reply to this station                ──► its sender is learned
//!   packet to a neighbour that nobody knows        ──► a tunnelled request leaves in its place; the packet is lost
//! ```
//!
//! The lost packet is counted ([`Loss::NoStation`]); what Linux sends after the reply goes to the station. Pure: the caller
//! limits how often it asks.

use rtnet::buf::Buf;
use rtnet::wire::arp;
use rtnet::wire::ethernet::{Address, EtherType};
use zerocopy::IntoBytes;

use crate::peers::Peers;
use crate::tunnel::{HEAD, Inner, Loss, Mouth};

/// Takes the ARP packet inside a tunnelled frame.
///
/// # Errors
/// It is none of IPv4, or no buffer is free for the answer.
pub fn hear(mouth: &Mouth, peers: &mut Peers, inner: &Inner<'_>) -> Result<(), Loss> {
    let heard = arp::parse(inner.payload()).map_err(|_| Loss::NotIp)?;
    let Some(reply) = peers.hear(heard) else { return Ok(()) };
    let frame = mouth.take().ok_or(Loss::NoBuffer)?;
    // What is lost on this way is counted there.
    let _ = send(mouth, frame, &reply, reply.target());
    Ok(())
}

/// Asks all stations, by a frame in this buffer.
pub fn ask(mouth: &Mouth, frame: Buf, question: &arp::Packet) -> Result<(), Loss> {
    send(mouth, frame, question, Address::BROADCAST)
}

fn send(mouth: &Mouth, mut frame: Buf, packet: &arp::Packet, to: Address) -> Result<(), Loss> {
    frame.room_mut()[HEAD..HEAD + arp::LEN].copy_from_slice(packet.as_bytes());
    mouth.send_packet(frame, arp::LEN, to, EtherType::ARP)
}

#[cfg(test)]
mod tests {
    use rtnet::discipline::{Opportunity, Service};
    use rtnet::time::{GlobalTime, Instant};

    use super::*;
    use crate::tunnel::{Config, Tunnel, new};

    const OWN: Address = Address([2, 0, 0, 0, 0, 1]);
    const OTHER: Address = Address([2, 0, 0, 0, 0, 3]);
    /// Example frame 8: Linux behind the VNIC of station 3, 10.0.0.3, asks who has 10.0.0.1.
    const REQUEST: [u8; 60] = [
        0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 2, 0, 0, 0, 0, 3, 0x90, 0x21, 0x08, 0x06, 2, 1, 0, 1, 8, 0, 6, 4,
        0, 1, 2, 0, 0, 0, 0, 3, 10, 0, 0, 3, 0, 0, 0, 0, 0, 0, 10, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        0, 0, 0,
    ];
    const REPLY: [u8; 60] = [
        2, 0, 0, 0, 0, 3, 2, 0, 0, 0, 0, 1, 0x90, 0x21, 0x08, 0x06, 2, 1, 0, 1, 8, 0, 6, 4, 0, 2, 2, 0, 0, 0,
        0, 1, 10, 0, 0, 1, 2, 0, 0, 0, 0, 3, 10, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
    ];

    fn with(address: Address, own: &str) -> (Tunnel, Mouth, Peers) {
        let (tunnel, mouth) = new(Config { buffers: 2, ..Config::of(address) });
        (tunnel, mouth, Peers::new(address, vec![own.parse().unwrap()]))
    }

    /// What leaves in the next turn of slot 1.
    fn leaves(tunnel: &mut Tunnel) -> Option<Vec<u8>> {
        let (begin, scheduled) = (Instant::default(), GlobalTime::default());
        let slot = Opportunity { channel: 1, cycle: 7, begin, scheduled, non_rt: Some(1500) };
        let mut left = None;
        tunnel.fill(&slot, None, &mut |frame, _, _| {
            left = Some(frame.to_vec());
            Ok(())
        });
        left
    }

    /// An IPv4 packet to 10.0.0.`to`.
    fn packet(to: u8) -> [u8; 20] {
        let mut packet = [0x45; 20];
        packet[16..].copy_from_slice(&[10, 0, 0, to]);
        packet
    }

    #[test]
    fn a_tunnelled_request_is_answered_and_its_sender_learned() {
        let (mut tunnel, mouth, mut peers) = with(OWN, "10.0.0.1/24");
        assert_eq!(peers.station_of(&packet(3)), None);
        hear(&mouth, &mut peers, &Inner::of(&REQUEST).unwrap()).unwrap();
        assert_eq!(leaves(&mut tunnel).as_deref(), Some(&REPLY[..]));
        assert_eq!(peers.station_of(&packet(3)), Some(OTHER));
    }

    #[test]
    fn a_request_for_another_address_gets_no_answer() {
        let (mut tunnel, mouth, mut peers) = with(OWN, "10.0.0.2/24");
        hear(&mouth, &mut peers, &Inner::of(&REQUEST).unwrap()).unwrap();
        assert_eq!((leaves(&mut tunnel), peers.station_of(&packet(3))), (None, None));
    }

    #[test]
    fn an_unknown_neighbour_is_asked_for_and_known_by_its_reply() {
        let (mut tunnel, mouth, mut peers) = with(OTHER, "10.0.0.3/24");
        let question = peers.question(&packet(1)).unwrap();
        ask(&mouth, mouth.take().unwrap(), &question).unwrap();
        assert_eq!(leaves(&mut tunnel).as_deref(), Some(&REQUEST[..]));
        hear(&mouth, &mut peers, &Inner::of(&REPLY).unwrap()).unwrap();
        assert_eq!((peers.station_of(&packet(1)), leaves(&mut tunnel)), (Some(OWN), None));
        assert_eq!(peers.question(&packet(1)), None);
    }

    #[test]
    fn what_is_no_arp_and_what_finds_no_buffer_is_lost() {
        let (_tunnel, mouth, mut peers) = with(OWN, "10.0.0.1/24");
        let mut other = REQUEST;
        other[20] = 0x86;
        assert_eq!(hear(&mouth, &mut peers, &Inner::of(&other).unwrap()), Err(Loss::NotIp));
        assert_eq!(hear(&mouth, &mut peers, &Inner::of(&REQUEST[..40]).unwrap()), Err(Loss::NotIp));
        let all: Vec<_> = std::iter::from_fn(|| mouth.take()).collect();
        assert_eq!(
            (all.len(), hear(&mouth, &mut peers, &Inner::of(&REQUEST).unwrap())),
            (2, Err(Loss::NoBuffer))
        );
    }
}
