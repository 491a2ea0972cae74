//! Invariant 9: real-time traffic does not notice tunnels, however many frames go through them (`isolation.rs` shows the same
//! of sockets).
//!
//! A network runs twice: without tunnels, and with tunnels in all stations that are saturated with largest frames to one and
//! to all, and never read at one of them. What is compared is every other frame, to the nanosecond. A frame of the tunnel that
//! is on the wire already would delay one that becomes urgent meanwhile, in its station's own slot and by that frame only; but
//! a slot's frame is chosen a lead before it, and with nothing to send the slot passes empty: what comes later waits for the
//! next one either way.

use std::collections::BTreeMap;

use rtmac::tdma::{Counters, SlotConfig, Tdma};
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, SyncState};
use rtnet::ip::StackCounters;
use rtnet::queue::Priority;
use rtnet::sim::{Joint, Medium};
use rtnet::socket::{Access, Flags, Options, Program, SocketCounters};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;
use tests::stacks::{
    CYCLE, Does, Notes, Own, SETTLES, address, at, bytes, in_slots, is_settled, slot, stack, udp,
};
use tests::tunnels::{Habits, Kind, OnAir, Tunnelled};
use vnic::tunnel::DEFAULT_BUFFERS;

const STATIONS: usize = 4;
/// The one whose Linux never reads.
const NEVER_READ: usize = 3;
const CYCLES: u64 = 500;
const PORT: u16 = 2_000;
/// Priorities of what is sent in slot 0, a frame of each in a burst; in slot 1 it is the last but the tunnel's.
const LEVELS: [u8; 4] = [0, 10, 20, 30];
/// Cycles from one burst to the next, and from one frame in slot 1 to the next.
const BURST_EVERY: u64 = 8;
const NON_RT_EVERY: u64 = 3;

/// Which number came of whom, in which slot with which priority, and its receive stamp.
type Arrivals = Notes<([u8; 8], u64)>;

/// Sends to the next station, and notes what comes.
fn works(id: usize, arrivals: Arrivals) -> Box<dyn Program> {
    let urgent = LEVELS.map(|level| Own::udp(PORT + u16::from(level), 16).with_priority(level));
    let mut sockets = Vec::from(urgent);
    sockets.push(Own::udp(PORT + 99, 16).with_priority(30).in_channel(1));
    let (mut sent_in, mut number, data) = (0, 0u32, bytes(1_000));
    Box::new(Does(move |access: &mut Access<'_>| {
        let ids: Vec<_> = sockets.iter_mut().map(|socket| socket.id(access)).collect();
        let mut room = [0; 1_000];
        for &socket in &ids {
            while let Ok(received) = access.receive(socket, &mut room, Flags::NONE) {
                let stamp = received.rx.expect("stamps are sound here");
                arrivals.lock().unwrap().push((*room.first_chunk().unwrap(), stamp.nanos()));
            }
        }
        let part = access.now().nanos() / CYCLE.nanos() as u64;
        if !is_settled(access) || part == sent_in {
            return;
        }
        sent_in = part;
        for (place, &socket) in ids.iter().enumerate() {
            let (every, channel) = if place < LEVELS.len() { (BURST_EVERY, 0) } else { (NON_RT_EVERY, 1) };
            if (part + id as u64).is_multiple_of(every) {
                room.copy_from_slice(&data);
                room[..4].copy_from_slice(&number.to_be_bytes());
                room[4..8].copy_from_slice(&[id as u8, channel, place as u8, 0]);
                let len = 64 + number as usize * 37 % 900;
                let port = PORT + if channel == 0 { u16::from(LEVELS[place]) } else { 99 };
                let to = at((id + 1) % STATIONS, port);
                access.send_to(socket, &room[..len], to).expect("nobody takes its buffers or its turn");
                number += 1;
            }
        }
    }))
}

/// Largest frames to the next, the one that never reads, and all: three buffers of four wait for a turn.
fn floods(id: usize) -> Habits {
    let to = vec![address((id + 1) % STATIONS), address(NEVER_READ), Address::BROADCAST];
    Habits { reads: id != NEVER_READ, leaves: DEFAULT_BUFFERS / 4, ..Habits::saturated(to) }
}

fn two_slots(id: usize) -> Vec<SlotConfig> {
    let begin = 100 + id as i64 * 200;
    vec![slot(0, begin), slot(1, begin + 70)]
}

fn the_alias(id: usize) -> Vec<SlotConfig> {
    two_slots(id)[..1].to_vec()
}

fn a_joint_slot(id: usize) -> Vec<SlotConfig> {
    let [rt, non_rt] = two_slots(id)[..] else { unreachable!("two of them") };
    vec![
        rt,
        non_rt,
        SlotConfig { id: 2, joint: Some(1), offset: non_rt.offset + Span::from_micros(50), ..non_rt },
    ]
}

/// What the real-time side of a station has counted.
#[derive(Debug, PartialEq)]
struct Counted {
    of_tdma: Counters,
    queued_and_dropped: (usize, u64),
    of_stack: StackCounters,
    of_sockets: Vec<SocketCounters>,
    refused: BTreeMap<Refusal, u64>,
    /// Of its network card's receive pool.
    dropped: u64,
}

struct Outcome {
    lab: Tunnelled<Tdma>,
    arrivals: Vec<Vec<([u8; 8], u64)>>,
    counted: Vec<Counted>,
}

impl Outcome {
    fn of(medium: Medium, slots: fn(usize) -> Vec<SlotConfig>, floods: Option<fn(usize) -> Habits>) -> Self {
        let arrivals: Vec<Arrivals> = (0..STATIONS).map(|_| Arrivals::default()).collect();
        let station = |id: usize| {
            let stack = stack(id, vec![works(id, arrivals[id].clone())]);
            (in_slots(id, &slots(id)), stack, floods.map(|floods| floods(id)))
        };
        let kind = Kind { medium, ..Kind::default() };
        let mut lab = Tunnelled::new(&kind, (0..STATIONS).map(station).collect());
        // From the first frame on: what calibrates is real-time, too.
        lab.watch();
        lab.run_cycles(SETTLES + CYCLES);
        let counted = (0..STATIONS).map(|id| count(&lab, id)).collect();
        let arrivals = arrivals.iter().map(|notes| std::mem::take(&mut *notes.lock().unwrap())).collect();
        Self { lab, arrivals, counted }
    }

    /// What is real-time, and what is not.
    fn aired(&self) -> (Vec<OnAir>, Vec<OnAir>) {
        let (non_rt, rt) = self.lab.aired.borrow().iter().cloned().partition(OnAir::is_tunnelled);
        (rt, non_rt)
    }
}

fn count(lab: &Tunnelled<Tdma>, id: usize) -> Counted {
    let station = &lab.network.member(id).station;
    let status = station.discipline().status();
    assert_eq!(status.state, SyncState::Locked);
    let stack = station.stack().expect("it has one");
    Counted {
        of_tdma: status.counters,
        queued_and_dropped: (status.slots.iter().flatten().map(|slot| slot.queued).sum(), station.stale()),
        of_stack: stack.counters(),
        of_sockets: stack.sockets().map(|(_, socket)| socket.counters()).collect(),
        refused: station.refusals().nonzero().collect(),
        dropped: lab.network.dropped(id),
    }
}

/// The same frames in both, all at their times, the same to be read, and the same counts, but for turns that were empty.
fn check_unnoticed(medium: Medium, slots: fn(usize) -> Vec<SlotConfig>) -> Outcome {
    let (calm, mut flooded) = (Outcome::of(medium, slots, None), Outcome::of(medium, slots, Some(floods)));
    let ((calm_rt, none), (flooded_rt, tunnelled)) = (calm.aired(), flooded.aired());
    assert!(none.is_empty() && tunnelled.len() as u64 > STATIONS as u64 * CYCLES / 4, "{}", tunnelled.len());
    assert!(tunnelled.iter().all(|frame| frame.bytes.len() == 1514));
    assert_eq!(calm_rt.len(), flooded_rt.len());
    for (calm, flooded) in calm_rt.iter().zip(&flooded_rt) {
        assert_eq!(calm, flooded);
    }
    for (calm, flooded) in calm.arrivals.iter().zip(&flooded.arrivals) {
        assert!(calm.len() as u64 > (CYCLES - 50) * LEVELS.len() as u64 / BURST_EVERY, "{}", calm.len());
        assert!(calm.iter().any(|(of, _)| of[5] == 1) && calm == flooded);
    }
    let linuxes = flooded.lab.linuxes.borrow();
    for (id, (mut calm, flooded)) in calm.counted.into_iter().zip(&mut flooded.counted).enumerate() {
        let mouth = &linuxes[id].as_ref().expect("it has a tunnel").mouth;
        let (sent, received) = (mouth.counts().sent, mouth.counts().received);
        // A turn has a frame that would have been empty: that is all that TDMA sees.
        calm.of_tdma.frames_sent += sent;
        calm.of_tdma.slots_empty -= sent;
        let for_it = |frame: &&OnAir| {
            frame.from != id && [address(id).0, [0xff; 6]].contains(frame.bytes.first_chunk().unwrap())
        };
        let came = tunnelled.iter().filter(for_it).count() as u64;
        // What is exhausted is the tunnel's own pool: its own frames are lost, and no others.
        let lost = flooded.refused.remove(&Refusal::PoolEmpty).unwrap_or(0);
        // Some may still be in its network card.
        assert!(
            (came - 4..=came).contains(&(received + lost)),
            "station {id}: {received} and {lost} of {came}"
        );
        if id == NEVER_READ {
            assert!(
                received == DEFAULT_BUFFERS as u64 && lost > CYCLES / 4,
                "{received} and {lost} of {came}"
            );
        } else {
            assert_eq!(lost, 0, "station {id}");
        }
        assert_eq!(&calm, flooded, "station {id}");
        assert_eq!(flooded.dropped, 0, "its network card has room");
    }
    drop(linuxes);
    flooded
}

#[test]
fn saturated_tunnels_move_no_real_time_frame_by_a_nanosecond() {
    let switch = Joint::Switch { latency: Span::from_micros(2), queue: 8 };
    for joint in [Joint::Bridge, Joint::Hub, switch] {
        let outcome = check_unnoticed(Medium { joint, ..Medium::default() }, two_slots);
        let traffic = outcome.lab.network.traffic();
        assert_eq!((traffic.overlaps, traffic.collided, traffic.queue_full), (0, 0, 0));
    }
}

#[test]
fn saturated_tunnels_in_joint_slots_move_no_real_time_frame_either() {
    check_unnoticed(Medium::default(), a_joint_slot);
}

/// Where slot 1 is but another name of slot 0, tunnels have the turns that nothing else wants.
#[test]
fn saturated_tunnels_in_the_only_slot_move_no_real_time_frame_either() {
    check_unnoticed(Medium::default(), the_alias);
}

/// All of its buffers hold what it does not read, in the end: then it has none to send by either.
#[test]
fn a_linux_that_never_reads_silences_its_own_tunnel_only_and_has_all_buffers_back_once_it_reads() {
    let mut lab = check_unnoticed(Medium::default(), two_slots).lab;
    let of_it = |lab: &Tunnelled<Tdma>| lab.linuxes.borrow()[NEVER_READ].as_ref().unwrap().mouth.counts();
    let before = of_it(&lab);
    lab.run_cycles(50);
    assert_eq!(of_it(&lab), before, "neither sent nor received any more");
    lab.linuxes.borrow_mut()[NEVER_READ].as_mut().unwrap().habits.reads = true;
    lab.run_cycles(50);
    let after = of_it(&lab);
    assert!(after.sent >= before.sent + 30 && after.received >= before.received + 32, "{before:?} {after:?}");
    lab.quiet(50);
    for linux in lab.linuxes.borrow().iter().flatten() {
        assert_eq!(linux.mouth.pool().available(), DEFAULT_BUFFERS);
    }
}

/// When a frame left that station 1 was given when its slot 0 was still so far away.
fn left(floods: Option<fn(usize) -> Habits>, ahead: u64) -> OnAir {
    let station = |id: usize| {
        let mut stack = stack(id, Vec::new());
        if id == 1 {
            udp(&mut stack, PORT, 4);
        }
        (in_slots(id, &the_alias(id)), stack, floods.map(|floods| floods(id)))
    };
    let mut lab = Tunnelled::new(&Kind::default(), (0..STATIONS).map(station).collect());
    lab.run_cycles(SETTLES);
    lab.watch();
    lab.run_cycles(1);
    let start = lab.aired.borrow().iter().find(|frame| frame.from == 0).expect("a Synchronisation").at - 300;
    lab.network.run_until(start + CYCLE.nanos() as u64 + 300_000 - ahead);
    let (stack, exit) = lab.network.member_mut(1).station.stack_mut().expect("it has one");
    let (id, _) = stack.sockets().next().expect("it has one");
    stack.set_options(id, Options { priority: Priority::FIRST, ..Options::default() }).unwrap();
    stack.send_to(id, &[7; 100], Some(at(2, PORT)), Flags::NONE, exit).expect("there is a route");
    lab.run_cycles(3);
    let aired = lab.aired.borrow();
    let urgent = aired.iter().find(|frame| frame.from == 1 && !frame.is_tunnelled()).expect("it has left");
    OnAir { at: urgent.at - start, ..urgent.clone() }
}

/// What was chosen for a slot, the tunnel's frame or nothing, stays so whatever becomes urgent then.
#[test]
fn what_becomes_urgent_after_a_turn_was_given_to_the_tunnel_waits_for_the_next_as_it_would_without_one() {
    // Who wakes a lead before its slot looks 13 us later.
    for (ahead, cycle) in [(60_000, 1), (38_000, 1), (36_000, 2), (2_000, 2)] {
        let [flooded, calm] = [Some(floods as fn(usize) -> Habits), None].map(|floods| left(floods, ahead));
        assert_eq!(flooded, calm);
        assert!(calm.at.abs_diff(cycle * 1_000_000 + 300_300) < 1_000, "{ahead} ns before: at {}", calm.at);
    }
}
