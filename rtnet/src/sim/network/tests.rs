use std::sync::{Arc, Mutex};

use super::*;
use crate::at_once::DEFAULT_ASK_EVERY;
use crate::counters::Refusal;
use crate::direct::Direct;
use crate::discipline::{Opportunity, Outlet, Service};
use crate::sim::{Joint, Latency, Link};
use crate::time::{Instant, Span};
use crate::wire::ethernet::{EtherType, Header, MIN_FRAME};
use zerocopy::IntoBytes;

const US: u64 = 1_000;
const BEGIN: True = 1_000 * US;
/// Of the smallest frame, at 1 Gbit/s: its bits, and they and the gap behind them.
const BITS: u64 = 576;
const AIR: u64 = 672;
const PROPAGATION: u64 = 500;

/// Notes when each frame came, and when its station had it.
struct Ear(Arc<Mutex<Vec<Instant>>>);

impl Service for Ear {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::EXPERIMENTAL
    }
    fn on_frame(&mut self, rx: Option<Instant>, _frame: Buf) -> Result<(), Refusal> {
        self.0.lock().unwrap().extend(rx);
        Ok(())
    }
    fn poll(&mut self, _slot: &Opportunity, _out: &mut Outlet<'_>) {}
}

/// Three stations that only listen, on hosts that are never late, with the clock of the network.
struct Bench {
    network: Network<Direct>,
    came: Arc<Mutex<Vec<Instant>>>,
    had: Arc<Mutex<Vec<(True, usize)>>>,
}

/// Who listens; the others send.
const EAR: StationId = 2;

fn address(id: StationId) -> Address {
    Address([2, 0, 0, 0, 0, id as u8])
}

impl Bench {
    fn new(joint: Joint) -> Self {
        Self::with_ear_from(joint, 0)
    }

    /// The one that listens is started so late.
    fn with_ear_from(joint: Joint, begins: True) -> Self {
        let mut network = Network::new(Medium { joint, ..Medium::default() }, 1);
        let (came, had): (Arc<Mutex<Vec<Instant>>>, Arc<Mutex<Vec<_>>>) = Default::default();
        for id in 0..=EAR {
            let services: Vec<Box<dyn Service>> =
                if id == EAR { vec![Box::new(Ear(came.clone()))] } else { Vec::new() };
            let (address, clock, station) = (
                address(id),
                EmulatedClock::default(),
                Station::new(Direct::new(DEFAULT_ASK_EVERY), services),
            );
            network.add(
                Member { address, clock, host: Host::IDEAL.into(), station },
                if id == EAR { begins } else { 0 },
            );
        }
        let (so_far, seen) = (came.clone(), had.clone());
        network.attend(move |moment, _| {
            let n = so_far.lock().unwrap().len();
            if moment.id == EAR && seen.lock().unwrap().last().is_none_or(|&(_, before)| before < n) {
                seen.lock().unwrap().push((moment.at, n));
            }
        });
        network.run_until(BEGIN);
        Self { network, came, had }
    }

    /// A frame of a station leaves so long after the begin.
    fn send(&mut self, from: StationId, after: u64) {
        self.network.run_until(BEGIN + after);
        let header = Header::new(address(EAR), address(from), EtherType::EXPERIMENTAL);
        let mut frame = [0; MIN_FRAME];
        frame[..header.as_bytes().len()].copy_from_slice(header.as_bytes());
        self.network.babble(from, &frame);
    }

    /// When frames came, after the begin.
    fn came(&mut self) -> Vec<u64> {
        self.network.run_until(BEGIN + 100_000 * US);
        self.came.lock().unwrap().iter().map(|at| at.nanos() - BEGIN).collect()
    }

    /// Notes what is lost from now on, whose and why.
    fn mourn(&mut self) -> Arc<Mutex<Vec<(StationId, Loss)>>> {
        let lost: Arc<Mutex<Vec<_>>> = Default::default();
        let told = lost.clone();
        self.network.mourn(move |to, bytes, why| {
            assert_eq!(
                Header::parse(bytes).unwrap().0.ether_type(),
                EtherType::EXPERIMENTAL,
                "as it was sent"
            );
            told.lock().unwrap().push((to, why));
        });
        lost
    }

    /// When the station had one more, or several, after the begin.
    fn had(&mut self) -> Vec<(u64, usize)> {
        self.came();
        let had = self.had.lock().unwrap();
        had.iter().filter(|&&(at, _)| at > BEGIN).map(|&(at, n)| (at - BEGIN, n)).collect()
    }
}

fn slow(by: u64) -> Link {
    Link { delay: Latency::Constant(Span::from_nanos(by as i64)), ..Link::default() }
}

#[test]
fn a_frame_that_overtakes_another_wakes_its_station_when_it_is_there() {
    let mut bench = Bench::new(Joint::Bridge);
    *bench.network.wire_mut(0).0 = slow(300 * US);
    bench.send(0, 0);
    bench.send(1, 10 * US);
    assert_eq!(bench.had(), [(10 * US + PROPAGATION, 1), (300 * US + PROPAGATION, 2)]);
}

#[test]
fn a_frame_that_is_on_its_way_when_its_station_goes_to_sleep_wakes_it() {
    let mut bench = Bench::new(Joint::Bridge);
    bench.send(0, 0);
    bench.send(1, 200);
    assert_eq!(bench.had(), [(PROPAGATION, 1), (200 + PROPAGATION, 2)]);
}

#[test]
fn a_slow_wire_takes_no_buffers_of_the_card_behind_it() {
    let mut bench = Bench::new(Joint::Bridge);
    *bench.network.wire_mut(EAR).1 = slow(10_000 * US);
    (0..40).for_each(|n| bench.send(0, n * 20 * US));
    let came = bench.came();
    assert_eq!((came.len(), bench.network.dropped(EAR)), (40, 0));
    assert_eq!(came[39], 39 * 20 * US + 10_000 * US + PROPAGATION);
}

#[test]
fn a_card_has_buffers_for_32_frames_that_nobody_takes_also_from_a_slow_wire() {
    let mut bench = Bench::new(Joint::Bridge);
    *bench.network.wire_mut(EAR).1 = slow(1_000 * US);
    let lost = bench.mourn();
    bench.network.freeze(EAR, Span::from_millis(20));
    (0..40).for_each(|n| bench.send(0, n * 20 * US));
    assert_eq!((bench.came().len(), bench.network.dropped(EAR)), (32, 8));
    assert_eq!(*lost.lock().unwrap(), [(EAR, Loss::NoBuffer); 8]);
}

fn doubles() -> Link {
    Link { duplicate_ppm: 1_000_000, ..Link::default() }
}

#[test]
fn a_doubled_frame_is_not_lost_for_its_second_copy() {
    let mut bench = Bench::new(Joint::Bridge);
    *bench.network.wire_mut(EAR).1 = slow(1_000 * US);
    *bench.network.wire_mut(1).0 = doubles();
    let lost = bench.mourn();
    bench.network.freeze(EAR, Span::from_millis(20));
    (0..31).for_each(|n| bench.send(0, n * 20 * US));
    bench.send(1, 700 * US);
    assert_eq!(
        (bench.came().len(), bench.network.dropped(EAR)),
        (32, 1),
        "there was room for one of the two"
    );
    assert_eq!(*lost.lock().unwrap(), []);
}

#[test]
fn a_doubled_frame_is_not_lost_for_its_first_copy_if_the_second_comes() {
    let mut bench = Bench::new(Joint::Switch { latency: Span::ZERO, queue: 8 });
    *bench.network.wire_mut(EAR).1 = slow(1_000 * US);
    *bench.network.wire_mut(1).0 = doubles();
    let lost = bench.mourn();
    let first = 700 * US + 2 * (BITS + PROPAGATION) + 1_000 * US;
    bench.network.freeze(EAR, Span::from_nanos((first + AIR / 2) as i64));
    (0..32).for_each(|n| bench.send(0, n * 20 * US));
    bench.send(1, 700 * US);
    assert_eq!(bench.came().last(), Some(&(first + AIR)));
    assert_eq!((bench.came().len(), bench.network.dropped(EAR)), (33, 1));
    assert_eq!(*lost.lock().unwrap(), []);
}

#[test]
fn a_doubled_frame_of_which_no_copy_comes_is_lost_once() {
    for wire in [slow(1_000 * US), Link::default()] {
        let mut bench = Bench::new(Joint::Bridge);
        *bench.network.wire_mut(EAR).1 = wire;
        *bench.network.wire_mut(1).0 = doubles();
        let lost = bench.mourn();
        bench.network.freeze(EAR, Span::from_millis(20));
        (0..32).for_each(|n| bench.send(0, n * 20 * US));
        bench.send(1, 700 * US);
        assert_eq!((bench.came().len(), bench.network.dropped(EAR)), (32, 2));
        assert_eq!(*lost.lock().unwrap(), [(EAR, Loss::NoBuffer)]);
    }
}

#[test]
fn a_changed_frame_that_comes_is_told_of_with_what_was_sent_and_once() {
    for by in [0, 1_000 * US] {
        let mut bench = Bench::new(Joint::Bridge);
        *bench.network.wire_mut(EAR).1 = Link { corrupt_ppm: 1_000_000, ..slow(by) };
        *bench.network.wire_mut(1).0 = doubles();
        let lost = bench.mourn();
        (0..20).for_each(|n| bench.send(1, n * 20 * US));
        bench.came();
        let lost = lost.lock().unwrap();
        let is_change =
            |lost: &(StationId, Loss)| matches!(lost, (EAR, Loss::Changed(byte)) if *byte < MIN_FRAME);
        assert!(lost.len() == 20 && lost.iter().all(is_change), "{lost:?}");
    }
}

#[test]
fn who_is_not_started_yet_hears_nothing_and_loses_nothing() {
    let mut bench = Bench::with_ear_from(Joint::Bridge, BEGIN + 900 * US);
    (0..50).for_each(|n| bench.send(0, n * 20 * US));
    assert_eq!((bench.came()[0], bench.came().len()), (900 * US + PROPAGATION, 5));
    assert_eq!(bench.network.dropped(EAR), 0);
}

#[test]
fn what_a_slow_wire_brings_to_a_switch_waits_behind_what_is_there_by_then() {
    let mut bench = Bench::new(Joint::Switch { latency: Span::ZERO, queue: 8 });
    *bench.network.wire_mut(0).0 = slow(50 * US);
    bench.send(0, 0);
    bench.send(1, 50 * US);
    let once = 50 * US + 2 * (BITS + PROPAGATION);
    assert_eq!(bench.came(), [once, once + AIR], "they are at the switch at the same time");
}

#[test]
fn frames_on_a_hub_destroy_each_other_only_where_their_bits_meet() {
    for (after, came) in [(BITS - 1, vec![]), (BITS, vec![BITS + PROPAGATION, 2 * BITS + PROPAGATION])] {
        let mut bench = Bench::new(Joint::Hub);
        let lost = bench.mourn();
        bench.send(0, 0);
        bench.send(1, after);
        assert_eq!(bench.came(), came, "{after}");
        let destroyed = 2 - came.len();
        assert_eq!(*lost.lock().unwrap(), vec![(EAR, Loss::Collision); destroyed]);
        assert_eq!(bench.network.traffic().collided, destroyed as u64);
    }
}

#[test]
fn who_sends_on_a_hub_does_not_hear_what_comes_meanwhile() {
    for (after, is_lost) in [(BITS, true), (BITS + PROPAGATION - 1, true), (BITS + PROPAGATION, false)] {
        let mut bench = Bench::new(Joint::Hub);
        let lost = bench.mourn();
        bench.send(0, 0);
        bench.send(EAR, after);
        assert_eq!(bench.came().len(), usize::from(!is_lost), "{after}");
        assert_eq!(*lost.lock().unwrap(), vec![(EAR, Loss::Collision); usize::from(is_lost)]);
        assert_eq!(bench.network.traffic().collided, u64::from(is_lost), "what it sent itself went on");
    }
}

#[test]
fn a_frame_is_stamped_by_the_clock_of_its_arrival() {
    let mut bench = Bench::new(Joint::Bridge);
    bench.network.freeze(EAR, Span::from_millis(1));
    let step = |network: &mut Network<Direct>, after: u64| {
        network.run_until(BEGIN + after);
        let clock = network.member(EAR).clock;
        network.set_clock(EAR, clock.stepped(Span::from_millis(10)));
    };
    bench.send(0, 10 * US);
    step(&mut bench.network, 50 * US);
    // Nothing has come between these two.
    step(&mut bench.network, 60 * US);
    bench.send(0, 70 * US);
    bench.send(1, 90 * US);
    step(&mut bench.network, 100 * US);
    bench.send(1, 2_000 * US);
    let ms = |n: u64| n * 10_000 * US + PROPAGATION;
    assert_eq!(bench.came(), [10 * US + ms(0), 70 * US + ms(2), 90 * US + ms(2), 2_000 * US + ms(3)]);
}

#[test]
fn a_clock_wanders_around_the_rate_that_it_is_given() {
    let mut network = Bench::new(Joint::Bridge).network;
    let wander = Wander { every: Span::from_millis(1), step_ppb: 50, within_ppb: 100, around_ppb: 0 };
    network.wander(0, wander);
    let rates = |network: &mut Network<Direct>, around: i64| {
        let mut all = Vec::new();
        for _ in 0..200 {
            network.run_until(network.now() + 1_000 * US);
            all.push(network.member(0).clock.drift_ppb - around);
        }
        assert!(all.iter().all(|rate| rate.abs() <= 100), "{all:?}");
        assert!(all.iter().any(|rate| rate.abs() > 50), "it wanders: {all:?}");
    };
    rates(&mut network, 0);
    let (now, clock) = (network.now(), network.member(0).clock);
    network.set_clock(0, clock.at_rate(now, 20_000));
    network.wander_around(0, 20_000);
    assert_eq!(network.rate_around(0), 20_000);
    rates(&mut network, 20_000);
    // Told anew, it does no longer what it was told before.
    network.wander(0, Wander { step_ppb: 0, ..wander });
    network.run_until(network.now() + 1_000 * US);
    network.run_until(network.now() + 100_000 * US);
    assert_eq!(network.member(0).clock.drift_ppb, 100, "as near as it may be");
}
