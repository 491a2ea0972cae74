//! Stations without time slots on a real medium.

use std::time::{Duration, Instant};

use rtmac::nomac::NoMac;
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::direct::Direct;
use rtnet::discipline::Discipline;
use rtnet::time::Span;

use crate::live::{Medium, as_root, clock};

/// Frames that a test waits for: one each millisecond.
const FRAMES: u64 = 200;
const PATIENCE: Duration = Duration::from_secs(30);

fn exchange<D: Discipline + 'static>(discipline: impl Fn() -> D) {
    let mut medium = Medium::new();
    let a = medium.start(clock(Span::from_millis(300), 20_000), 1, |_| discipline());
    let b = medium.start(clock(Span::from_millis(-200), -30_000), 0, |_| discipline());
    let begun = Instant::now();
    while a.tally.received().min(b.tally.received()) < FRAMES {
        assert!(begun.elapsed() < PATIENCE, "{} and {} frames", a.tally.received(), b.tally.received());
        std::thread::sleep(Duration::from_millis(5));
    }
    // Each frame that comes wakes the other: no reason to send another one.
    let at_most = begun.elapsed().as_millis() as u64 + FRAMES;
    assert!(a.tally.received() <= at_most, "{} frames, and no more than {at_most}", a.tally.received());
}

#[test]
fn stations_without_slots_exchange_frames_over_veth() {
    if !as_root("stations_without_slots_exchange_frames_over_veth") {
        return;
    }
    exchange(|| NoMac::new(DEFAULT_ASK_EVERY));
    exchange(|| Direct::new(DEFAULT_ASK_EVERY));
}
