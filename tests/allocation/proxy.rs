//! A station whose Linux has its address, turned by hand: what comes for that, and what that sends.

use rtnet::buf::Pool;
use rtnet::discipline::Sent;
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{EtherType, Header};
use rtnet::wire::ipv4::{self, Fields, Protocol};
use tests::stacks::{address, ip, stack};
use tools::station::access::{Access, AccessConfig};
use vnic::proxy::{self, PACKET};
use vnic::tunnel::{Config, Loss};
use zerocopy::IntoBytes;

use crate::calls;

const TURNS: u64 = 1_000;

/// A segment of TCP's, by its look, from one station to another.
fn packet(from: usize, to: usize) -> Vec<u8> {
    let header = ipv4::Header::new(&Fields {
        source: ip(from),
        destination: ip(to),
        protocol: Protocol(6),
        tos: 0,
        identification: 1,
        dont_fragment: true,
        more_fragments: false,
        offset: 0,
        payload_len: 40,
    });
    [header.as_bytes(), &[7; 40]].concat()
}

#[test]
fn a_proxy_allocates_nothing() {
    let (proxy, mouth) = proxy::new(Config::of(address(1)));
    let service = Box::new(proxy.ringing(Box::new(|| ())));
    let discipline = Access::new(&AccessConfig::Direct, address(1)).unwrap();
    let mut station = Station::new(discipline, vec![service]).with_stack(stack(1, Vec::new()));
    let header = Header::new(address(1), address(0), EtherType::IPV4);
    let comes = [header.as_bytes(), &packet(0, 1)].concat();
    let leaves = [packet(1, 0), packet(1, 99)];
    let (pool, mut now, mut sent) = (Pool::new(1), Instant::from_nanos(1), 0);

    let before = calls();
    for turn in 0..TURNS {
        mouth.sleeps(true);
        for packet in &leaves {
            let mut room = mouth.take_for_packet().expect("they leave");
            room.room_mut()[PACKET..][..packet.len()].copy_from_slice(packet);
            mouth.send_plain(room, packet.len()).unwrap();
        }
        let mut frame = pool.take().expect("who keeps it pays for it");
        frame.fill(&comes);
        station.on_frame(Some(now), frame);
        station.on_timeout(now);
        while let Some(chosen) = station.next_transmission(now) {
            sent += 1;
            station.on_sent(Sent::At(now));
            drop(chosen);
        }
        station.rest();
        // Now and then nobody reads, and all buffers are taken.
        while turn % 100 > 50 && mouth.received().is_some() {}
        now = station.next_deadline().expect("it asks again") + Span::from_nanos(1);
    }
    let allocations = calls() - before;

    let counts = mouth.counts();
    // The last one that leads nowhere is not looked at any more.
    assert_eq!((sent, counts.sent, counts.lost(Loss::NoStation)), (TURNS, TURNS, TURNS - 1));
    assert!(counts.lost(Loss::NoBuffer) > 0 && counts.received > TURNS / 2);
    assert_eq!(allocations, 0);
}
