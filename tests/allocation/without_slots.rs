//! Stations that send at once, turned by hand, with the traffic of a lab.

use std::sync::Arc;

use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Discipline, Sent};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;
use tests::rings;
use tests::traffic::of_a_lab;
use tools::station::access::{Access, AccessConfig};
use tools::station::traffic::TrafficCounts;

use crate::calls;

const TURNS: u64 = 1_000;
const ADDRESS: Address = Address([2, 0, 0, 0, 0, 1]);

#[test]
fn stations_without_slots_allocate_nothing_from_their_first_turn_on() {
    for config in [AccessConfig::NoMac, AccessConfig::Direct] {
        let (took, received) = check_allocates_nothing(&config);
        assert!(took >= DEFAULT_ASK_EVERY * TURNS as i64);
        assert_eq!(received, TURNS, "it was at work");
    }
}

#[test]
fn stations_in_a_ring_allocate_nothing_from_their_first_turn_on() {
    let ring = rings::quick(vec![ADDRESS]);
    let (took, received) = check_allocates_nothing(&AccessConfig::Token(ring.clone()));
    // A token that the kernel refuses is lost, and claimed after a silence.
    assert!(took >= ring.rest * (TURNS / 2) as i64);
    assert!(received >= TURNS / 2, "it was at work: {received}");
}

/// How long the turns of one that talks to itself took, and how many frames of data came.
fn check_allocates_nothing(config: &AccessConfig) -> (Span, u64) {
    let counts = Arc::new(TrafficCounts::default());
    let traffic = of_a_lab((0, ADDRESS), ADDRESS, 0, counts.clone());
    let mut station = Station::new(Access::new(config, ADDRESS).unwrap(), vec![Box::new(traffic)]);
    let pool = Pool::new(1);
    let begin = Instant::from_nanos(1);
    let mut now = begin;

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
    assert_eq!(calls() - before, 0);
    (now - begin, counts.arrived(None).received)
}
