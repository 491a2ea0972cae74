//! Data that comes while a station with sockets sleeps to its slot.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use rtmac::tdma::Tdma;
use rtnet::clock::EmulatedClock;
use rtnet::live::clock::monotonic;
use rtnet::live::interface::Interface;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType, Header};
use rtnet::wire::ipv4::{self, Fields, Protocol};
use rtnet::wire::udp;
use tests::bare::Bare;
use tests::host::alone;
use zerocopy::IntoBytes;

use crate::live::master_of;
use crate::with_sockets::{HOST, HOST_IP, PORT, Pair, STATION, STATION_IP};

/// Longer than the loop looks around by itself would be seen at once.
const CYCLE: Span = Span::from_millis(80);
const PATIENCE: Duration = Duration::from_secs(30);
/// Nobody's.
const NO_PORT: u16 = 9;

fn station() -> (Pair<Tdma>, Bare) {
    let clock = EmulatedClock::default();
    let pair = Pair::start(|address| master_of(CYCLE, address, &clock, Span::from_millis(40), 1_500));
    let open = || Bare::open(&Interface::find("rt0").unwrap()).unwrap();
    let sender = pair.host.run(open).unwrap();
    (pair, sender)
}

/// A datagram to the station, of a byte, without a checksum.
fn datagram(port: u16) -> Vec<u8> {
    let link = Header::new(Address(STATION), Address(HOST), EtherType::IPV4);
    let head = udp::Header::new(1_024, port, 1);
    let packet = ipv4::Header::new(&Fields {
        source: HOST_IP,
        destination: STATION_IP,
        protocol: Protocol::UDP,
        tos: 0,
        identification: 0,
        dont_fragment: true,
        more_fragments: false,
        offset: 0,
        payload_len: 9,
    });
    let mut frame = [link.as_bytes(), packet.as_bytes(), head.as_bytes(), &[7]].concat();
    frame.resize(60, 0);
    frame
}

#[test]
fn a_datagram_that_comes_between_two_slots_is_with_its_program_long_before_the_next() {
    let test = "a_datagram_that_comes_between_two_slots_is_with_its_program_long_before_the_next";
    alone(test, || {
        let (pair, sender) = station();
        // Until it gives the time, it is awake for every frame.
        std::thread::sleep(Duration::from_millis(1_000));
        let mut waits: Vec<Duration> = (0..20)
            .map(|n| {
                let (heard, begun) = (pair.heard.datagrams.load(Ordering::Acquire), Instant::now());
                let sent = monotonic();
                assert!(sender.send(&datagram(PORT)));
                while pair.heard.datagrams.load(Ordering::Acquire) == heard {
                    assert!(begun.elapsed() < PATIENCE, "datagram {n} is lost");
                    std::thread::sleep(Duration::from_micros(100));
                }
                // Who was only heard in a slot is long before the next one then.
                std::thread::sleep(Duration::from_millis(5));
                Duration::from_nanos(pair.heard.last.load(Ordering::Relaxed) - sent)
            })
            .collect();
        waits.sort_unstable();
        // The program says when it had it, and the sender may have been held up before it sent: an eighth of a cycle is more
        // than either takes, and one that waits for its slot waits for half of one in the mean.
        assert!(waits[10] < Duration::from_millis(10), "half of them wait for no slot: {waits:?}");
    });
}

#[test]
fn a_flood_of_data_leaves_a_station_most_of_its_core() {
    let test = "a_flood_of_data_leaves_a_station_most_of_its_core";
    alone(test, || {
        let (pair, sender) = station();
        std::thread::sleep(Duration::from_millis(1_000));
        let newest = || std::iter::from_fn(|| pair.snapshots.pop()).last();
        let frame = datagram(NO_PORT);
        newest();
        let flood_for = |time: Duration| {
            let begun = Instant::now();
            while begun.elapsed() < time {
                // A queue that is full is no reason to stop.
                let _ = sender.send(&frame);
            }
        };
        flood_for(Duration::from_millis(300));
        let before = newest().unwrap();
        let begun = monotonic();
        flood_for(Duration::from_millis(1_000));
        let after = newest().unwrap();
        assert!(monotonic() > begun && after.port.received > before.port.received, "it hears them");
        let share = (after.cpu - before.cpu) as f64 / (after.at - before.at) as f64;
        // A quarter for the data by the limit, and what its wake-ups cost besides. Without a limit it is all of the core.
        assert!(share < 0.5, "{share:.2} of a core for a flood");
    });
}
