//! Stations with saturated tunnels, one of which nobody reads.

use rtmac::nomac::NoMac;
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::discipline::Discipline;
use rtnet::wire::ethernet::Address;
use tests::rings::in_a_ring;
use tests::stacks::{SETTLES, address, in_slots, slot, stack};
use tests::tunnels::{Habits, Kind, Tunnelled};
use vnic::tunnel::AT_ONCE;

use crate::calls;

const STATIONS: usize = 4;

fn floods(id: usize) -> Option<Habits> {
    let to = vec![address((id + 1) % STATIONS), Address::BROADCAST];
    Some(Habits { reads: id != STATIONS - 1, ..Habits::saturated(to) })
}

/// Frames that went through, out and in.
fn gone_through<D: Discipline>(lab: &Tunnelled<D>) -> (u64, u64) {
    let counts = lab.linuxes.borrow();
    let counts = counts.iter().flatten().map(|linux| linux.mouth.counts());
    counts.fold((0, 0), |(sent, received), of| (sent + of.sent, received + of.received))
}

/// For so many cycles, once the simulator's own lists are as long as they will be.
fn check_allocates_nothing<D: Discipline>(lab: &mut Tunnelled<D>, settles: u64, count: u64, least: u64) {
    lab.run_cycles(settles);
    let before = (calls(), gone_through(lab));
    lab.run_cycles(count);
    let (allocations, after) = (calls() - before.0, gone_through(lab));
    assert!(after.0 > before.1.0 + least && after.1 > before.1.1 + least, "{:?} {after:?}", before.1);
    assert_eq!(allocations, 0);
}

#[test]
fn stations_with_saturated_tunnels_allocate_nothing() {
    let slots = |id: usize| [slot(0, 100 + id as i64 * 200), slot(1, 170 + id as i64 * 200)];
    let station = |id| (in_slots(id, &slots(id)), stack(id, Vec::new()), floods(id));
    let mut lab = Tunnelled::new(&Kind::default(), (0..STATIONS).map(station).collect());
    check_allocates_nothing(&mut lab, SETTLES + 100, 500, 1_000);
}

#[test]
fn stations_in_a_ring_whose_tunnels_are_saturated_allocate_nothing() {
    let station = |id| (in_a_ring(id, &[0, 1]), stack(id, Vec::new()), floods(id));
    let mut lab = Tunnelled::new(&Kind::default(), (0..2).map(station).collect());
    check_allocates_nothing(&mut lab, 50, 100, 1_000);
}

#[test]
fn stations_without_slots_whose_tunnels_are_saturated_allocate_nothing() {
    let station = |id| (NoMac::new(DEFAULT_ASK_EVERY), stack(id, Vec::new()), floods(id));
    let kind = Kind { per_turn: AT_ONCE, ..Kind::default() };
    let mut lab = Tunnelled::new(&kind, (0..2).map(station).collect());
    check_allocates_nothing(&mut lab, 50, 50, 1_000);
}
