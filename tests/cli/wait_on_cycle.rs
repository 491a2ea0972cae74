//! A program that is another process waits for the cycles of running stations, and is told when one is killed.

use std::sync::Arc;

use nix::errno::Errno;
use rtnet::api::Station as Attached;
use rtnet::live::realtime::{RealTime, SLAVE_PRIORITY};
use rtnet::live::{TimeBoard, WaitError};
use rtnet::time::{GlobalTime, Span};

use crate::host::{alone, figure, unique};
use crate::station::{Medium, PATIENCE, Station};

const CYCLES: u32 = 100;
/// The cycles up to this one that a program wakes in: their numbers, their starts on the master's clock, and how late it woke.
fn cycles(time: &Arc<TimeBoard>, last: u32) -> Vec<(u32, GlobalTime, Span)> {
    // Less urgent than stations, as programs are, and more than all else that the host runs.
    RealTime { priority: Some(SLAVE_PRIORITY - 10), cpu: None }.apply();
    let mut waiter = time.waiter();
    let cycle = || loop {
        match waiter.wait_cycle(PATIENCE) {
            Ok(cycle) => return (cycle.number, cycle.offset.global(cycle.start), time.now() - cycle.start),
            // A busy host may have held up two syncs in a row.
            Err(WaitError::NotSynchronised(_)) => waiter.wait_synchronised(PATIENCE).unwrap(),
            Err(error) => panic!("{error}"),
        }
    };
    std::iter::repeat_with(cycle).take_while(|&(number, ..)| number <= last).collect()
}

#[test]
fn a_program_wakes_in_the_same_cycles_of_two_stations_and_is_told_that_one_was_killed() {
    let test = "a_program_wakes_in_the_same_cycles_of_two_stations_and_is_told_that_one_was_killed";
    alone(test, || {
        let medium = Medium::new();
        let names = ["master", "slave"].map(|role| unique(&format!("wait-{role}")));
        // Neither has sockets.
        let mut master = Station::master(&medium, &names[0]);
        let _slave = Station::slave(&medium, &names[1]);
        let times = names.each_ref().map(|name| Attached::named(name).unwrap().time().unwrap());
        // From then on both see the same cycles.
        times.iter().for_each(|time| time.waiter().wait_synchronised(PATIENCE).unwrap());
        let last = times[0].waiter().wait_cycle(PATIENCE).unwrap().number + CYCLES;
        let [at_master, at_slave] = std::thread::scope(|scope| {
            let programs = times.each_ref().map(|time| scope.spawn(move || cycles(time, last)));
            programs.map(|program| program.join().unwrap())
        });
        for seen in [&at_master, &at_slave] {
            assert!(seen.is_sorted_by(|(one, ..), (next, ..)| one < next), "cycles ascend: {seen:?}");
            assert!(seen.iter().all(|(.., late)| *late >= Span::ZERO), "they have begun: {seen:?}");
        }
        let apart = |&(number, global, _): &(u32, GlobalTime, Span)| {
            let there = at_slave.iter().find(|(other, ..)| *other == number)?;
            Some((there.1 - global).abs())
        };
        let mut apart: Vec<Span> = at_master.iter().filter_map(apart).collect();
        // A program sees no cycle while its station is not synchronised: a host may delay two syncs in a row.
        assert!(apart.len() > CYCLES as usize / 2, "only {} cycles were seen by both", apart.len());
        apart.sort_unstable();
        let apart = apart[apart.len() / 2];
        // What is not the same cycle is 5 ms off.
        assert!(apart < Span::from_micros(500), "the same number is the same cycle, not one {apart} later");
        let mut late: Vec<Span> = at_master.iter().chain(&at_slave).map(|(.., late)| *late).collect();
        late.sort_unstable();
        figure(test, &format!("woken {} after the start of a cycle (p50)", late[late.len() / 2]));

        let [time, at_slave] = times;
        assert!(!time.has_ended());
        master.child.kill().unwrap();
        master.child.wait().unwrap();
        assert_eq!(time.waiter().wait_cycle(PATIENCE), Err(WaitError::Ended));
        assert!(time.has_ended() && !time.state().is_synchronised());
        let anew = Attached::named(&names[0]).unwrap().time();
        assert_eq!(anew.err().and_then(|error| error.raw_os_error()), Some(Errno::ENODEV as i32));
        let mut waiter = at_slave.waiter();
        let lost = (0..CYCLES).find_map(|_| waiter.wait_cycle(PATIENCE).err());
        assert!(matches!(lost, Some(WaitError::NotSynchronised(_))), "{lost:?}");
        // Whoever has its name next takes along what it has left.
        drop(Station::master(&medium, &names[0]));
    });
}
