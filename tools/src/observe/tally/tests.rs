//! What an observer counts, frame by frame.

use rtnet::buf::Pool;
use rtnet::time::GlobalTime;
use rtnet::wire::ethernet::Header;
use zerocopy::IntoBytes;

use super::*;
use crate::observe::watch::Watch;

const MASTER: Address = Address([2, 0, 0, 0, 0, 1]);
const PERIOD: u64 = 1_000_000;

/// A sync that was sent at its scheduled time.
pub(in crate::observe) fn sync(cycle: u32, sched: GlobalTime) -> Vec<u8> {
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, MASTER, &mut frame);
    frame.to_vec()
}

/// Test traffic, the 78th of a station.
pub(in crate::observe) fn data(station: u8, slot: u8, cycle: u32, scheduled: GlobalTime) -> Vec<u8> {
    let header = Header::new(MASTER, Address([2, 0, 0, 0, 0, station + 1]), EtherType::EXPERIMENTAL);
    let scheduled = scheduled.nanos().to_be_bytes();
    let parts: [&[u8]; 6] = [
        header.as_bytes(),
        &[0, station, slot, 0],
        &cycle.to_be_bytes(),
        &77_u64.to_be_bytes(),
        &scheduled,
        &[0; 40],
    ];
    parts.concat()
}

fn sched(cycle: u32) -> GlobalTime {
    GlobalTime::from_nanos(u64::from(cycle) * PERIOD)
}

struct Medium(Watch, Tally);

impl Medium {
    fn new() -> Self {
        Self(Watch::default(), Tally::new(Rate::from_bits_per_second(1_000_000_000)))
    }
    fn pass(&mut self, at: u64, frame: &[u8]) {
        let sight = self.0.frame(Some(at), frame, frame.len());
        self.1.frame(Some(at), frame.len(), &sight);
    }
    fn sync(&mut self, cycle: u32, late: u64) {
        self.pass(u64::from(cycle) * PERIOD + late, &sync(cycle, sched(cycle)));
    }
    fn data(&mut self, cycle: u32, late: u64) {
        let scheduled = sched(cycle) + Span::from_micros(300);
        self.pass(scheduled.nanos() + late, &data(2, 0, cycle, scheduled));
    }
    fn seen(&self, which: Which) -> &Seen {
        self.1.streams.iter().find(|(stream, _)| stream.which == which).unwrap().1
    }
}

const DATA: Which = Which::Slot { station: 2, slot: 0 };

#[test]
fn errors_are_kept_by_station_and_slot() {
    let mut medium = Medium::new();
    for cycle in 1..=100 {
        medium.sync(cycle, 5_000);
        medium.data(cycle, if cycle == 50 { 12_000 } else { 5_500 });
    }
    let summary = medium.seen(DATA).times.summary();
    assert_eq!((summary.n, summary.min, summary.p50, summary.max), (100, Some(500), Some(500), Some(7_000)));
    assert_eq!(medium.seen(Which::Sync).times.summary().max, Some(0));
    assert_eq!(medium.1.kinds, BTreeMap::from([("data", 100), ("sync", 100)]));
    assert_eq!((medium.1.not_judged, medium.1.overlaps), (0, 0));
}

#[test]
fn turns_without_a_frame_are_missed_at_the_stream_s_own_step() {
    let mut medium = Medium::new();
    for cycle in (1..=101).filter(|cycle| ![20, 21].contains(cycle)) {
        medium.sync(cycle, 0);
        // Every second cycle; 41 and 43 are missing.
        if cycle % 2 == 1 && ![41, 43].contains(&cycle) {
            medium.data(cycle, 0);
        }
    }
    // With 21 there are three.
    assert_eq!((medium.seen(DATA).frames, medium.seen(DATA).missed()), (48, 3));
    assert_eq!((medium.1.sync_gaps, medium.seen(Which::Sync).missed()), (2, 2));
}

#[test]
fn a_turn_that_a_queued_frame_takes_is_not_missed() {
    let mut medium = Medium::new();
    for cycle in 1..=100 {
        medium.sync(cycle, 0);
        let queued_at = sched(cycle);
        let mut frame = data(2, 0, cycle, queued_at);
        match cycle % 4 {
            0 => {
                // Of priority 3.
                frame[17] = 4;
                medium.pass(queued_at.nanos() + 300_500, &frame);
            }
            _ if cycle != 50 => medium.data(cycle, 500),
            _ => {}
        }
    }
    assert_eq!((medium.seen(DATA).frames, medium.seen(DATA).missed()), (74, 1));
    assert_eq!(medium.seen(Which::Sporadic("queued")).frames, 25);
}

#[test]
fn a_turn_that_a_programs_frame_takes_is_not_missed_and_none_of_another_slot() {
    let mut medium = Medium::new();
    let header = |source| Header::new(MASTER, source, EtherType::IPV4);
    let station = Address([2, 0, 0, 0, 0, 3]);
    for cycle in 1..=100 {
        medium.sync(cycle, 0);
        // Slots at 300 us in every cycle, and at 700 us in every second one; some have a program's frame instead.
        for (slot, offset, is_turn) in [(0, 300, true), (1, 700, cycle % 2 == 0)] {
            let scheduled = sched(cycle) + Span::from_micros(offset);
            let (is_taken, is_missed) = (cycle % 10 == 4, cycle == 50);
            match (is_turn && !is_missed, is_taken) {
                (true, true) => {
                    let frame = [header(station).as_bytes(), &[0; 46]].concat();
                    medium.pass(scheduled.nanos() + 700, &frame);
                }
                (true, false) => medium.pass(scheduled.nanos() + 500, &data(2, slot, cycle, scheduled)),
                (false, _) => {}
            }
        }
    }
    let seen = |slot| {
        let seen = medium.seen(Which::Slot { station: 2, slot });
        (seen.frames, seen.missed())
    };
    assert_eq!((seen(0), seen(1)), ((89, 1), (39, 1)));
}

#[test]
fn periods_are_those_of_neighbouring_cycles() {
    let mut medium = Medium::new();
    for (cycle, late) in [(1, 0), (2, 300), (3, 0), (5, 9_000), (5, 9_500), (6, 9_000)] {
        medium.sync(cycle, late);
    }
    let summary = medium.1.sync_period.summary();
    assert_eq!((summary.n, summary.min, summary.max), (3, Some(-500), Some(300)));
    assert_eq!((medium.1.sync_gaps, medium.1.syncs_repeated), (1, 1));
}

#[test]
fn frames_that_are_on_the_air_at_once_overlap() {
    let mut medium = Medium::new();
    medium.sync(1, 0);
    // A sync takes (60 + 24) x 8 ns.
    medium.pass(PERIOD + 671, &[0; 60]);
    assert_eq!(medium.1.overlaps, 1);
    medium.pass(PERIOD + 671 + 672, &[0; 60]);
    assert_eq!(medium.1.overlaps, 1);
}

#[test]
fn what_does_not_say_when_has_its_place_and_forged_sources_are_bounded() {
    let mut medium = Medium::new();
    for cycle in 1..=70 {
        medium.sync(cycle, 0);
        medium.pass(u64::from(cycle) * PERIOD + 400_000, &[1; 60]);
    }
    let seen = medium.seen(Which::Foreign(EtherType(0x0101)));
    // In the first cycle nobody knows yet how long one is.
    assert_eq!((seen.times.summary().n, seen.times.median()), (69, 400_000));
    assert_eq!(medium.1.not_judged, 1);
    for forged in 0..2_000_u32 {
        let mut frame = [2; 60];
        frame[6..10].copy_from_slice(&forged.to_be_bytes());
        medium.pass(71 * PERIOD, &frame);
    }
    assert_eq!(medium.1.streams.len(), STREAMS_AT_MOST);
    assert_eq!(medium.1.frames_beyond, 2_000 - (STREAMS_AT_MOST as u64 - 2));
}
