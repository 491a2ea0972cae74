//! Whole networks with tunnels: what goes in at one mouth comes out at the others, byte for byte, and leaves in the slot of
//! what is not real-time only.

use std::collections::BTreeMap;

use rtmac::nomac::NoMac;
use rtmac::tdma::{SlotConfig, Tdma, TdmaCommand};
use rtmac::wire::{self, Message, Rtmac};
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, SyncState};
use rtnet::sim::{Host, Joint, Medium};
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, HEADER_LEN, MTU};
use tests::rings::in_a_ring;
use tests::stacks::{SETTLES, address, in_slots, slot, stack};
use tests::tunnels::{Habits, Kind, Linux, OnAir, PADDED_TO, Tunnelled, constant};
use vnic::tunnel::{AT_ONCE, FRAME, HEAD, Loss};

const STATIONS: usize = 4;
/// Cycles that are looked at, once all have settled.
const CYCLES: u64 = 300;
/// How far from its instant a frame may leave: clocks are known to each other by less.
const NEAR: u64 = 1_000;

/// Frames of all lengths to each of the others and to all.
fn talkative(id: usize) -> Habits {
    let others = (0..STATIONS).filter(|&other| other != id).map(address);
    Habits {
        to: others.chain([Address::BROADCAST]).collect(),
        lens: vec![1, 46, 1496, 0, 700, 41, 42, 43, 1495, 28],
        notes: true,
        ..Habits::saturated(Vec::new())
    }
}

/// Four stations with slots 0 and 1, as in the first plan of all.
fn slots_of(id: usize) -> Vec<SlotConfig> {
    let begin = 100 + id as i64 * 200;
    vec![slot(0, begin), slot(1, begin + 70)]
}

/// A network of such stations that has settled, which is watched from its begin.
fn in_slots_of(
    kind: &Kind,
    slots: fn(usize) -> Vec<SlotConfig>,
    habits: fn(usize) -> Habits,
) -> Tunnelled<Tdma> {
    let station = |id| (in_slots(id, &slots(id)), stack(id, Vec::new()), Some(habits(id)));
    let mut lab = Tunnelled::new(kind, (0..STATIONS).map(station).collect());
    lab.watch();
    lab.run_cycles(SETTLES);
    for id in 0..STATIONS {
        assert_eq!(lab.network.member(id).station.discipline().time().state, SyncState::Locked);
    }
    lab
}

/// Each of the others has read what it was sent, in the order in which it was, and nothing else; all buffers are at home.
fn check_exchanged<D: Discipline>(lab: &Tunnelled<D>, at_least: usize) {
    let linuxes = lab.linuxes.borrow();
    let linuxes: Vec<&Linux> = linuxes.iter().flatten().collect();
    for (id, reader) in linuxes.iter().enumerate() {
        for (other, sender) in linuxes.iter().enumerate().filter(|&(other, _)| other != id) {
            let from = |frame: &&Vec<u8>| frame[6..12] == address(other).0;
            let read: Vec<_> = reader.received.iter().filter(from).collect();
            let sent = sender.sent_to(address(id));
            assert!(sent.len() >= at_least, "{} from {other} to {id}", sent.len());
            assert_eq!(read, sent.iter().collect::<Vec<_>>(), "from {other} to {id}");
        }
        let sources = |frame: &Vec<u8>| frame[6..12] != address(id).0 && frame[11] <= STATIONS as u8;
        assert!(reader.received.iter().all(sources), "station {id} has read something else");
        let counts = reader.mouth.counts();
        assert_eq!((counts.sent, counts.put_off), (reader.sent.len() as u64, 0), "station {id}");
        assert_eq!(counts.received, reader.received.len() as u64);
        assert_eq!(counts.losses().collect::<Vec<_>>(), [], "station {id}");
        assert_eq!(reader.mouth.pool().available(), reader.mouth.config().buffers);
        let station = &lab.network.member(id).station;
        assert_eq!(station.refusals().total(), 0, "station {id}");
        assert_eq!(lab.network.dropped(id), 0);
    }
}

/// Where each tunnelled frame left: its sender, its place in the cycle, and the number of the cycle.
fn places(lab: &Tunnelled<Tdma>) -> BTreeMap<(usize, u32), Vec<u64>> {
    let (mut places, mut begun) = (BTreeMap::<_, Vec<u64>>::new(), None);
    for frame in lab.aired.borrow().iter() {
        if let Ok(Rtmac::Tdma(Message::Sync { cycle, xmit, sched })) = wire::parse(&frame.bytes) {
            begun = Some((cycle, frame.at - (xmit - sched).nanos() as u64));
        } else if frame.is_tunnelled() {
            let (cycle, start) = begun.expect("nobody sends before there is a master");
            places.entry((frame.from, cycle)).or_default().push(frame.at - start);
        }
    }
    places
}

/// Every tunnelled frame left in a slot of its sender's that begins so many microseconds behind its first: one in each turn.
fn check_places(lab: &Tunnelled<Tdma>, behind: &[u64]) {
    for ((from, cycle), places) in places(lab) {
        let begin = |behind: &u64| (100 + from as u64 * 200 + behind) * 1_000 + 300;
        let mut unused: Vec<u64> = behind.iter().map(begin).collect();
        for place in places {
            let slot = unused.iter().position(|begin| place.abs_diff(*begin) <= NEAR);
            let slot = slot.unwrap_or_else(|| panic!("station {from} in cycle {cycle}: at {place} ns"));
            unused.remove(slot);
        }
    }
}

fn kinds() -> Vec<Kind> {
    let of = |joint| Kind { medium: Medium { joint, ..Medium::default() }, ..Kind::default() };
    let switch = Joint::Switch { latency: Span::from_micros(2), queue: 8 };
    vec![of(Joint::Bridge), of(Joint::Hub), of(switch)]
}

#[test]
fn frames_of_all_lengths_come_out_of_the_other_tunnels_as_they_went_in_one_in_each_turn_of_slot_1() {
    for kind in kinds() {
        let mut lab = in_slots_of(&kind, slots_of, talkative);
        let before = lab.aired.borrow().len();
        lab.run_cycles(CYCLES);
        let since = lab.aired.borrow()[before..].iter().filter(|frame| frame.is_tunnelled()).count();
        assert_eq!(since, STATIONS * CYCLES as usize, "every turn has its frame");
        lab.quiet(50);
        check_exchanged(&lab, 200);
        // Slaves have slots once they are calibrated.
        let all: Vec<usize> = places(&lab).keys().map(|(from, _)| *from).collect();
        assert!((0..STATIONS).all(|id| all.contains(&id)));
        check_places(&lab, &[70]);
        assert_eq!((lab.network.traffic().overlaps, lab.network.traffic().collided), (0, 0));
        assert_eq!(lab.network.traffic().queue_full, 0);
    }
}

#[test]
fn without_a_slot_1_tunnels_use_what_slot_0_leaves_to_them() {
    let mut lab = in_slots_of(&Kind::default(), |id| slots_of(id)[..1].to_vec(), talkative);
    lab.run_cycles(CYCLES);
    lab.quiet(50);
    check_exchanged(&lab, 200);
    check_places(&lab, &[0]);
}

#[test]
fn slots_that_are_joined_to_slot_1_take_a_frame_of_the_tunnel_each() {
    let slots = |id| {
        let [rt, non_rt] = slots_of(id)[..] else { unreachable!("two of them") };
        let joint = |id, micros| SlotConfig {
            joint: Some(1),
            offset: non_rt.offset + Span::from_micros(micros),
            id,
            ..non_rt
        };
        vec![rt, non_rt, joint(2, 40), joint(3, 80)]
    };
    let mut lab = in_slots_of(&Kind::default(), slots, talkative);
    lab.run_cycles(CYCLES);
    let full = places(&lab).values().filter(|places| places.len() == 3).count() as u64;
    assert!(full >= (CYCLES - 2) * STATIONS as u64, "three in a cycle: {full} times");
    lab.quiet(50);
    check_exchanged(&lab, 600);
    check_places(&lab, &[70, 110, 150]);
}

#[test]
fn nomac_stations_exchange_what_is_tunnelled_at_once() {
    // As many may come at once as all the others send in a turn.
    let kind = Kind {
        buffers: 128,
        per_turn: AT_ONCE,
        host: Host { send: constant(12_000), ..Kind::default().host },
        ..Kind::default()
    };
    let habits = |id| Habits { leaves: 100, ..talkative(id) };
    let station = |id| (NoMac::new(DEFAULT_ASK_EVERY), stack(id, Vec::new()), Some(habits(id)));
    let mut lab = Tunnelled::new(&kind, (0..STATIONS).map(station).collect());
    lab.watch();
    lab.run_cycles(20);
    lab.quiet(20);
    check_exchanged(&lab, 100);
}

#[test]
fn stations_in_a_ring_exchange_what_is_tunnelled() {
    let all: Vec<usize> = (0..STATIONS).collect();
    let kind = Kind { buffers: 128, ..Kind::default() };
    let station = |id| (in_a_ring(id, &all), stack(id, Vec::new()), Some(talkative(id)));
    let mut lab = Tunnelled::new(&kind, (0..STATIONS).map(station).collect());
    lab.watch();
    lab.run_cycles(200);
    lab.quiet(50);
    check_exchanged(&lab, 100);
}

#[test]
fn a_station_without_a_tunnel_counts_what_others_tunnel_to_it_and_is_not_disturbed() {
    let station = |id| (in_slots(id, &slots_of(id)), stack(id, Vec::new()), (id > 0).then(|| talkative(id)));
    let mut lab = Tunnelled::new(&Kind::default(), (0..STATIONS).map(station).collect());
    lab.watch();
    lab.run_cycles(SETTLES + CYCLES);
    lab.quiet(50);
    let for_it = |frame: &&OnAir| {
        frame.is_tunnelled() && [address(0).0, [0xff; 6]].contains(frame.bytes.first_chunk().unwrap())
    };
    let tunnelled = lab.aired.borrow().iter().filter(for_it).count() as u64;
    let refusals = lab.network.member(0).station.refusals();
    assert!(tunnelled > CYCLES, "{tunnelled}");
    assert_eq!((refusals.get(Refusal::NoTunnel), refusals.total()), (tunnelled, tunnelled));
}

/// Sends a frame of this payload as the device would that was told of another MTU before.
fn send(lab: &Tunnelled<Tdma>, id: usize, len: usize) -> Result<(), Loss> {
    let linuxes = lab.linuxes.borrow();
    let mouth = &linuxes[id].as_ref().expect("it has a tunnel").mouth;
    let mut room = mouth.take().expect("a buffer");
    room.room_mut()[FRAME..][..6].copy_from_slice(&address(0).0);
    mouth.send_frame(room, HEADER_LEN + len)
}

fn mtu(lab: &Tunnelled<Tdma>, id: usize) -> usize {
    lab.linuxes.borrow()[id].as_ref().expect("it has a tunnel").mouth.mtu()
}

#[test]
fn the_mtu_follows_slot_1_down_and_up_again_and_what_does_not_fit_any_more_is_counted() {
    const ID: usize = 2;
    let silent = |id| Habits { to: Vec::new(), ..talkative(id) };
    let mut lab = in_slots_of(&Kind::default(), slots_of, silent);
    assert_eq!(mtu(&lab, ID), MTU - 4);
    // What leaves of two that were as large as could be and as small.
    let changes = [
        (500, vec![42]),
        (1500, vec![496, 42]),
        (46, vec![42]),
        (104, vec![42, 42]),
        (1499, vec![100, 42]),
        (500, vec![42]),
    ];
    for (size, expected) in changes {
        let before = mtu(&lab, ID);
        // They fit as yet, and wait while the slot changes.
        assert_eq!([send(&lab, ID, before), send(&lab, ID, PADDED_TO)], [Ok(()), Ok(())]);
        let discipline = lab.network.member_mut(ID).station.discipline_mut();
        let (now, slot) = (discipline.time().start, slots_of(ID)[1]);
        discipline.command(now, &mut TdmaCommand::set_slot(SlotConfig { size, ..slot })).expect("a slot");
        let sent = lab.aired.borrow().len();
        lab.run_cycles(5);
        assert_eq!(mtu(&lab, ID), size - 4);
        let payload = |frame: &OnAir| frame.is_tunnelled().then(|| frame.bytes.len() - HEAD);
        let left: Vec<usize> = lab.aired.borrow()[sent..].iter().filter_map(payload).collect();
        assert_eq!(left, expected, "with {size}");
        assert_eq!([send(&lab, ID, size - 3), send(&lab, ID, size - 4)], [Err(Loss::TooLong), Ok(())]);
        lab.run_cycles(3);
    }
    let linuxes = lab.linuxes.borrow();
    let mouth = &linuxes[ID].as_ref().expect("it has a tunnel").mouth;
    // Six at the mouth, three for which the slot had become too small.
    assert_eq!(mouth.counts().losses().collect::<Vec<_>>(), [(Loss::TooLong, 9)]);
    assert_eq!((mouth.counts().sent, mouth.pool().available()), (15, mouth.config().buffers));
}
