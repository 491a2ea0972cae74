//! Stations with slots that have no turn: no master was heard, no slot is defined, or they were detached.

use std::sync::{Arc, Mutex};

use rtmac::tdma::{NewRole, Tdma, TdmaCommand};
use rtnet::buf::Pool;
use rtnet::discipline::{Channel, Discipline, SendError, SyncState};
use rtnet::socket::{Access, Options, SocketError};
use rtnet::station::Station;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{EtherType, HEADER_LEN, Header};
use rtnet::wire::ipv4::{self, Fields, Protocol};
use rtnet::wire::udp;
use tests::stacks::{Does, Own, address, at, in_slots, ip, slot, stack, udp as bound};
use zerocopy::IntoBytes;

type Told = Arc<Mutex<Vec<Result<(), SocketError>>>>;

/// A slave with slot 0 whose program sends in this one each time that it is looked at, and notes what becomes of it.
fn slave(channel: Channel) -> (Station<Tdma>, Told) {
    let told = Told::default();
    let (mut own, notes) = (Own::udp(2_000, 4), told.clone());
    let sends = Does(move |sockets: &mut Access<'_>| {
        let socket = own.id(sockets);
        sockets.set_options(socket, Options { channel, ..Options::default() }).unwrap();
        notes.lock().unwrap().push(sockets.send_to(socket, b"now", at(0, 2_000)));
    });
    (Station::new(in_slots(1, &[slot(0, 200)]), Vec::new()).with_stack(stack(1, vec![Box::new(sends)])), told)
}

/// It is awake, and has nothing to send.
fn is_awake(station: &mut Station<Tdma>, micros: u64) {
    let now = Instant::from_nanos(10_000_000_000 + micros * 1_000);
    station.on_timeout(now);
    assert!(station.next_transmission(now).is_none());
}

#[test]
fn what_programs_send_without_a_slot_is_refused_for_want_of_it() {
    let (mut station, told) = slave(2);
    for turn in 0..3 {
        is_awake(&mut station, turn * 100);
    }
    let refused: Result<(), SocketError> = Err(SendError::NoSlot(2).into());
    assert_eq!(*told.lock().unwrap(), [refused, refused, refused]);
}

#[test]
fn what_programs_send_before_a_master_is_heard_waits_and_is_refused_once_detached() {
    let (mut station, told) = slave(0);
    for turn in 0..5 {
        is_awake(&mut station, turn * 100);
    }
    assert_eq!(station.discipline().time().state, SyncState::Waiting);
    let full = SocketError::NoBuffers { needed: 1, free: 0, capacity: 4 };
    assert_eq!(*told.lock().unwrap(), [Ok(()), Ok(()), Ok(()), Ok(()), Err(full)]);
    let now = Instant::from_nanos(10_000_600_000);
    let mut command = TdmaCommand::Become(NewRole::detached());
    station.discipline_mut().command(now, &mut command).unwrap();
    let before = told.lock().unwrap().len();
    is_awake(&mut station, 700);
    assert_eq!(told.lock().unwrap().len(), before + 1, "it is still looked at");
}

#[test]
fn a_lost_tail_is_given_up_in_time_where_no_slot_comes() {
    let mut stack = stack(1, Vec::new());
    let socket = bound(&mut stack, 3_000, 4);
    let mut station = Station::new(in_slots(1, &[slot(0, 200)]), Vec::new()).with_stack(stack);
    is_awake(&mut station, 0);
    let nic = Pool::new(1);
    let mut frame = nic.take().unwrap();
    frame.fill(&first_fragment());
    station.on_frame(Some(Instant::from_nanos(10_000_000_000)), frame);
    let collecting = |station: &Station<Tdma>| station.stack().unwrap().collecting(socket);
    assert_eq!(collecting(&station), 1);
    is_awake(&mut station, 999_000);
    assert_eq!(collecting(&station), 1);
    is_awake(&mut station, 1_001_000);
    assert_eq!((collecting(&station), station.stack().unwrap().counters().collectors.timed_out), (0, 1));
}

/// Eight bytes and a header of UDP, to be followed by more.
fn first_fragment() -> Vec<u8> {
    let link = Header::new(address(1), address(0), EtherType::IPV4);
    let packet = ipv4::Header::new(&Fields {
        source: ip(0),
        destination: ip(1),
        protocol: Protocol::UDP,
        tos: 0,
        identification: 1,
        dont_fragment: false,
        more_fragments: true,
        offset: 0,
        payload_len: 16,
    });
    let head = udp::Header::new(2_000, 3_000, 1_000);
    let frame = [link.as_bytes(), packet.as_bytes(), head.as_bytes(), &[0; 22]].concat();
    assert_eq!(frame.len(), HEADER_LEN + 20 + 8 + 22);
    frame
}

#[test]
fn a_master_is_looked_at_for_its_slot_and_after_its_synchronisation_once_each() {
    let looked = Arc::<Mutex<Vec<Instant>>>::default();
    let notes = looked.clone();
    let looks = Does(move |sockets: &mut Access<'_>| notes.lock().unwrap().push(sockets.now()));
    let programs: Vec<Box<dyn rtnet::socket::Program>> = vec![Box::new(looks)];
    let mut network = tests::stacks::settled(vec![(vec![slot(0, 200)], stack(0, programs))]);
    looked.lock().unwrap().clear();
    tests::stacks::cycles(&mut network, 10);
    let looked = looked.lock().unwrap();
    assert!(looked.len() == 20 && looked.windows(2).all(|pair| pair[0] < pair[1]), "{looked:?}");
}
