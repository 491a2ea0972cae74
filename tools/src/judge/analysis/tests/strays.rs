//! Who is named for frames outside its slots.

use super::*;

const STRANGER: Address = Address([2, 0, 0, 0, 9, 9]);
const REQUEST: Message = Message::Request { xmit: 0, reply_cycle: 13, reply_offset: 0 };
const REPLY: Message = Message::Reply { request_xmit: 0, reception: 0, xmit: 0 };

impl Bench {
    /// When a slot of a station begins in cycle 12.
    fn slot(&self, station: usize) -> True {
        12 * CYCLE + self.scenario.stations[station].slots[0].offset.nanos() as u64
    }

    fn message(&mut self, at: True, message: Message, to: Address, from: Address) {
        let mut frame = Pool::new(1).take().unwrap();
        message.write(to, from, &mut frame);
        self.analysis.frame(at, &frame);
    }

    fn strays(&self) -> [u64; 2] {
        [0, 1].map(|station| self.analysis.stations[station].stray)
    }
}

/// In cycle 12, of which nothing was seen so far but that it has begun.
fn bench() -> (Bench, Address, Address) {
    let mut bench = Bench::new();
    let [master, slave] = [0, 1].map(|station| bench.scenario.address(station));
    (FIRST..=12).for_each(|cycle| bench.sync_from(master, cycle, 0));
    (bench, master, slave)
}

#[test]
fn a_station_that_repeats_requests_out_of_its_slot_is_named_with_its_count() {
    let (mut bench, master, slave) = bench();
    let (own, others) = (bench.slot(1), bench.slot(0));
    bench.message(own, REQUEST, master, slave);
    assert_eq!(bench.strays(), [0, 0], "there it may ask");
    for at in [others, own - 40_000, own + 400_000] {
        bench.message(at, REQUEST, master, slave);
    }
    assert_eq!((bench.strays(), bench.analysis.stations[1].strayed), ([0, 3], Some(12)));
}

#[test]
fn a_slot_is_a_stations_only_in_the_cycles_of_its_phase() {
    let mut bench = Bench::of(|scenario| {
        let slot = &mut scenario.stations[1].slots[0];
        (slot.period, slot.phase) = (2, 1);
    });
    let [master, slave] = [0, 1].map(|station| bench.scenario.address(station));
    (FIRST..=12).for_each(|cycle| bench.sync_from(master, cycle, 0));
    let own = bench.slot(1);
    bench.message(own, REQUEST, master, slave);
    bench.message(own - CYCLE, REQUEST, master, slave);
    assert_eq!(bench.strays(), [0, 1]);
}

#[test]
fn a_reply_is_in_place_in_the_askers_slot_or_the_masters() {
    let (mut bench, master, slave) = bench();
    let (own, others) = (bench.slot(1), bench.slot(0));
    bench.message(own, REPLY, slave, master);
    assert_eq!(bench.strays(), [0, 0]);
    bench.message(others, REPLY, slave, master);
    assert_eq!(bench.strays(), [0, 0], "late, in one of its own");
    bench.message(12 * CYCLE + 8_000, REPLY, slave, master);
    assert_eq!(bench.strays(), [0, 0], "late, behind its Synchronisation");
    bench.message(own + 400_000, REPLY, slave, master);
    assert_eq!(bench.strays(), [1, 0], "in nobody's");
    // A stranger is answered where it wants: it is that one who is out of its slot.
    bench.message(others, REPLY, STRANGER, master);
    assert_eq!(bench.strays(), [1, 0]);
    bench.message(others, REPLY, STRANGER, slave);
    assert_eq!(bench.strays(), [1, 1], "but a slave answers nobody");
}

#[test]
fn tunnelled_and_malformed_frames_out_of_slot_are_their_senders() {
    let (mut bench, _, slave) = bench();
    let mut frame = [0; 60];
    frame[6..12].copy_from_slice(&slave.0);
    frame[12..14].copy_from_slice(&[0x90, 0x21]);
    for (version, flags) in [(2, 1), (7, 0)] {
        (frame[16], frame[17]) = (version, flags);
        let own = bench.slot(1);
        bench.analysis.frame(own, &frame);
        bench.analysis.frame(own - 40_000, &frame);
    }
    assert_eq!(bench.strays(), [0, 2]);
}

#[test]
fn syncs_of_who_may_not_give_the_time_are_named() {
    let (mut bench, _, slave) = bench();
    for from in [slave, STRANGER] {
        bench.sync_from(from, 12, 0);
        bench.sync_from(from, 7_000_000, 0);
    }
    assert_eq!(bench.strays(), [0, 1], "where its number says, nobody counts");
    assert_eq!(bench.analysis.strangers.named(), [(STRANGER.to_string(), 1)].into());
    assert!(!bench.analysis.findings.is_empty());
}

#[test]
fn strangers_are_counted_by_address_as_long_as_there_are_few() {
    let (mut bench, master, _) = bench();
    let at = bench.slot(1);
    for last in 0..10 {
        let from = Address([2, 0, 0, 0, 9, last]);
        (0..=last).for_each(|_| bench.message(at, REQUEST, master, from));
    }
    let mut frame = [0; 60];
    frame[6..12].copy_from_slice(&[2, 0, 0, 0, 9, 0]);
    bench.analysis.frame(at, &frame);
    let named = bench.analysis.strangers.named();
    assert_eq!((named.len(), named["02:00:00:00:09:00"], named["02:00:00:00:09:07"]), (9, 2, 8));
    assert_eq!(named["others"], 9 + 10);
    assert_eq!(bench.strays(), [0, 0]);
}

#[test]
fn who_returns_asks_in_its_slots_before_they_are_known_to_be_its_again() {
    let (mut bench, master, slave) = bench();
    let own = bench.slot(1);
    bench.analysis.timetable.leave(1, 11);
    bench.message(own, REQUEST, master, slave);
    assert_eq!(bench.strays(), [0, 1], "it has left");
    bench.analysis.timetable.may_return(1);
    bench.message(own, REQUEST, master, slave);
    bench.message(own - 40_000, REQUEST, master, slave);
    assert_eq!(bench.strays(), [0, 2]);
}
