//! Stations without time slots on a real medium.

use std::time::{Duration, Instant};

use rtmac::nomac::NoMac;
use rtmac::token::{Ring, RingConfig, Token};
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::direct::Direct;
use rtnet::discipline::Discipline;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;
use tests::host::alone;

use crate::live::{Medium, clock};

/// Frames that a test waits for: one each millisecond.
const FRAMES: u64 = 200;
const PATIENCE: Duration = Duration::from_secs(30);

/// Until each has heard enough of the other: for how long, and how many frames the first has heard.
fn exchanged<D: Discipline + 'static>(discipline: impl Fn(Address) -> D) -> (Duration, u64) {
    let mut medium = Medium::new();
    let a = medium.start(clock(Span::from_millis(300), 20_000), 1, &discipline);
    let b = medium.start(clock(Span::from_millis(-200), -30_000), 0, &discipline);
    let begun = Instant::now();
    while a.tally.received().min(b.tally.received()) < FRAMES {
        assert!(begun.elapsed() < PATIENCE, "{} and {} frames", a.tally.received(), b.tally.received());
        std::thread::sleep(Duration::from_millis(5));
    }
    let received = a.tally.received();
    (begun.elapsed(), received)
}

fn exchange<D: Discipline + 'static>(discipline: impl Fn() -> D) {
    let (took, received) = exchanged(|_| discipline());
    // Each frame that comes wakes the other: no reason to send another one.
    let at_most = took.as_millis() as u64 + FRAMES;
    assert!(received <= at_most, "{received} frames, and no more than {at_most}");
}

#[test]
fn stations_without_slots_exchange_frames_over_veth() {
    alone("stations_without_slots_exchange_frames_over_veth", || {
        exchange(|| NoMac::new(DEFAULT_ASK_EVERY));
        exchange(|| Direct::new(DEFAULT_ASK_EVERY));
    });
}

#[test]
fn stations_in_a_ring_exchange_frames_over_veth() {
    alone("stations_in_a_ring_exchange_frames_over_veth", || {
        let ms = Span::from_millis;
        let ring = RingConfig {
            late: ms(20),
            delay: ms(5),
            ..RingConfig::new((0..2).map(Medium::address).collect())
        };
        let (took, received) =
            exchanged(|address| Token::new(Ring::new(ring.clone(), address).expect("it is in it")));
        // One in each round, in which both rest.
        let at_most = took.as_nanos() as i64 / (ring.rest * 2).nanos() + 2;
        assert!(received as i64 <= at_most, "{received} frames, and no more than {at_most}");
    });
}
