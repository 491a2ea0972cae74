//! Stations that send at once, turned by hand, with the traffic of a lab.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Discipline, Sent};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;
use tests::traffic::of_a_lab;
use tools::station::access::{Access, AccessConfig};
use tools::station::traffic::TrafficCounts;

use crate::calls;

const TURNS: u64 = 1_000;

#[test]
fn stations_without_slots_allocate_nothing_from_their_first_turn_on() {
    for config in [AccessConfig::NoMac, AccessConfig::Direct] {
        // It talks to itself.
        let address = Address([2, 0, 0, 0, 0, 1]);
        let counts = Arc::new(TrafficCounts::default());
        let traffic = of_a_lab((0, address), address, 0, counts.clone());
        let mut station = Station::new(Access::new(&config, address).unwrap(), vec![Box::new(traffic)]);
        let pool = Pool::new(1);
        let mut now = Instant::from_nanos(1);

        let before = calls();
        for turn in 0..TURNS {
            station.on_timeout(now);
            while let Some(chosen) = station.next_transmission(now) {
                let mut heard: Buf = pool.take().expect("every buffer comes back");
                heard.fill(&chosen.frame);
                // The kernel refuses every tenth.
                let failed = turn % 10 == 9;
                station.on_sent(if failed { Sent::Failed(100, chosen.frame) } else { Sent::At(now) });
                station.on_frame(Some(now), heard);
                while station.discipline_mut().next_event().is_some() {}
            }
            now = station.next_deadline().expect("it asks again") + Span::from_nanos(1);
        }
        let allocations = calls() - before;

        assert!(now - Instant::from_nanos(1) >= DEFAULT_ASK_EVERY * TURNS as i64);
        assert_eq!(counts.usual.received.load(Ordering::Relaxed), TURNS, "it was at work");
        assert_eq!(allocations, 0);
    }
}
