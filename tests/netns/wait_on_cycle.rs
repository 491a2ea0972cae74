//! Programs on two stations wait for the cycle.

use std::sync::Arc;
use std::time::Duration;

use rtnet::live::clock::monotonic;
use rtnet::live::realtime::{RealTime, SLAVE_PRIORITY};
use rtnet::live::{TimeBoard, WaitError};
use rtnet::time::{GlobalTime, Span};
use tests::host::alone;

use crate::live::{CYCLE, Medium, clock, our_master, our_slave};

const WITHIN: Duration = Duration::from_secs(30);
const CYCLES: usize = 100;

/// What a program sees of a cycle: its number, its start on the master's clock, and when it woke (CLOCK_MONOTONIC).
type Seen = (u32, GlobalTime, u64);

fn program(time: Arc<TimeBoard>) -> Vec<Seen> {
    // Less urgent than stations, as programs are, and more than all else that the host runs.
    RealTime { priority: Some(SLAVE_PRIORITY - 10), cpu: None }.apply();
    let mut waiter = time.waiter();
    let cycle = || loop {
        match waiter.wait_cycle(WITHIN) {
            Ok(cycle) => return (cycle.number, cycle.offset.global(cycle.start), monotonic()),
            // A busy host may have held up two syncs in a row.
            Err(WaitError::NotSynchronised(_)) => waiter.wait_synchronised(WITHIN).unwrap(),
            Err(error) => panic!("{error}"),
        }
    };
    std::iter::repeat_with(cycle).take(CYCLES).collect()
}

#[test]
fn programs_on_two_stations_wake_in_the_same_cycle_by_the_same_number() {
    alone("programs_on_two_stations_wake_in_the_same_cycle_by_the_same_number", || {
        let mut medium = Medium::new();
        let ahead = clock(Span::from_millis(300), 20_000);
        let master = medium.start(ahead, 1, |address| our_master(address, &ahead, Span::from_micros(1_000)));
        let slave = medium.start(clock(Span::from_millis(-700), -30_000), 0, |address| {
            our_slave(address, 20, Span::from_micros(3_000))
        });
        slave.time.waiter().wait_synchronised(WITHIN).unwrap();
        let programs = [&master, &slave].map(|station| station.time.clone());
        let programs = programs.map(|time| std::thread::spawn(move || program(time)));
        let [at_master, at_slave] = programs.map(|program| program.join().unwrap());

        let both = |&(number, global, woke): &Seen| {
            let there = at_slave.iter().find(|(other, ..)| *other == number)?;
            Some(((there.1 - global).abs(), there.2.abs_diff(woke)))
        };
        let mut seen: Vec<(Span, u64)> = at_master.iter().filter_map(both).collect();
        assert!(seen.len() > CYCLES / 2, "only {} cycles were seen by both", seen.len());
        seen.sort_unstable();
        let (apart, _) = seen[seen.len() / 2];
        // What these slaves take for a time step; calibrated ones are within some microseconds on a quiet machine.
        assert!(apart < Span::from_micros(500), "the same number is the same cycle, not one {apart} later");
        seen.sort_unstable_by_key(|&(_, woken)| woken);
        let (_, woken) = seen[seen.len() / 2];
        assert!(woken < CYCLE.nanos() as u64, "they wake within the same cycle: {woken} ns apart");

        // Of the master's end the slave's programs are told, and so are its own.
        let mut ended = master.time.waiter();
        drop(master);
        assert_eq!(ended.wait_cycle(WITHIN), Err(WaitError::Ended));
        let mut waiter = slave.time.waiter();
        let lost = (0..CYCLES).find_map(|_| waiter.wait_cycle(WITHIN).err());
        assert!(matches!(lost, Some(WaitError::NotSynchronised(_))), "{lost:?}");
    });
}
