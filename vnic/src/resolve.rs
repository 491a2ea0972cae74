//! ARP where Linux speaks none: by a device for packets alone it neither asks who has an IPv4 address nor answers, but the
//! VNICs of other stations do, and send nothing before they have heard an answer.
//!
//! ```text
//!   tunnelled request for an address of the device ──► its sender is learned, a tunnelled reply leaves
//!   tunnelled reply to this station                ──► its sender is learned
//!   packet to a neighbour that nobody knows        ──► a tunnelled request leaves in its place; the packet is lost
//! ```
//!
//! The lost packet is counted ([`Loss::NoStation`]); what Linux sends after the reply goes to the station. How
//! often it asks [`Asked`] limits.

use core::net::Ipv4Addr;

use rtnet::buf::Buf;
use rtnet::time::{Instant, Span};
use rtnet::wire::arp;
use rtnet::wire::ethernet::{Address, EtherType};
use zerocopy::IntoBytes;

use crate::peers::Peers;
use crate::tunnel::{HEAD, Inner, Loss, Mouth};

/// Shortest time between two questions for one neighbour, as in Linux.
const ASK_EVERY: Span = Span::from_millis(1_000);
/// Largest number of neighbours asked for in that time.
const ASK_AT_MOST: usize = 16;

/// The neighbours that were asked for last, and when.
#[derive(Default)]
pub struct Asked([Option<(Ipv4Addr, Instant)>; ASK_AT_MOST]);

impl Asked {
    /// Whether this one may be asked for now: it counts as asked then.
    pub fn may_ask(&mut self, neighbour: Ipv4Addr, now: Instant) -> bool {
        let last = self.0.iter().position(|asked| asked.is_some_and(|(of, _)| of == neighbour));
        let oldest = || (0..ASK_AT_MOST).min_by_key(|&place| self.0[place].map(|(_, at)| at));
        let Some(place) = last.or_else(oldest) else { return false };
        let is_due = self.0[place].is_none_or(|(_, at)| now - at >= ASK_EVERY);
        if is_due {
            self.0[place] = Some((neighbour, now));
        }
        is_due
    }
}

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
    use rtnet::time::GlobalTime;

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

    #[test]
    fn each_neighbour_is_asked_for_once_a_second_and_16_in_all() {
        let asks = |neighbours: u8, packets_a_second: u32| {
            let mut asked = Asked::default();
            let packets = (0..10 * packets_a_second).map(|n| (n, 1_000_000 / packets_a_second * n));
            let is_asked = |(n, micros): &(u32, u32)| {
                let neighbour = Ipv4Addr::new(10, 0, 0, (n % u32::from(neighbours)) as u8);
                asked.may_ask(neighbour, Instant::from_nanos(u64::from(*micros) * 1_000))
            };
            packets.filter(is_asked).count()
        };
        assert_eq!([asks(1, 1_000), asks(2, 1_000), asks(16, 1_000)], [10, 20, 160]);
        assert!((144..=160).contains(&asks(200, 1_000)), "{}", asks(200, 1_000));
        assert_eq!(asks(1, 1), 10, "whoever is slower asks each time");
    }
}
