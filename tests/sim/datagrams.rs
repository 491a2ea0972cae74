//! Datagrams between stations in slots: both ways, in fragments, while slots change.

use std::cell::RefCell;
use std::rc::Rc;

use rtmac::tdma::{SlotConfig, Tdma, TdmaCommand};
use rtnet::clock::True;
use rtnet::discipline::{Discipline, TimeView};
use rtnet::sim::Network;
use rtnet::socket::{Access, Flags, Received, Sender, SocketError, SocketId};
use rtnet::time::Instant;
use rtnet::wire::ethernet::{EtherType, HEADER_LEN, Header};
use tests::stacks::{
    CYCLE, Does, Notes, Own, assert_pools_full, at, bytes, cycles, is_settled, settled, slot, stack, udp,
};

/// IP and UDP.
const HEADERS: usize = 28;
const IP: usize = 20;

/// A frame with IP: when it was on the air, and its bytes.
type Aired = Rc<RefCell<Vec<(True, Vec<u8>)>>>;

fn aired(network: &mut Network<Tdma>) -> Aired {
    let aired = Aired::default();
    let notes = aired.clone();
    network.observe(move |frame| {
        let is_ip =
            Header::parse(frame.bytes).is_some_and(|(header, _)| header.ether_type() == EtherType::IPV4);
        if is_ip {
            notes.borrow_mut().push((frame.at, frame.bytes.to_vec()));
        }
    });
    aired
}

fn send(network: &mut Network<Tdma>, id: usize, from: SocketId, data: &[u8], to: (usize, u16)) {
    let (stack, exit) = network.member_mut(id).station.stack_mut().unwrap();
    stack.send_to(from, data, Some(at(to.0, to.1)), Flags::NONE, exit).unwrap();
}

fn receive(network: &mut Network<Tdma>, id: usize, socket: SocketId) -> Option<(Vec<u8>, Instant)> {
    let (stack, _) = network.member_mut(id).station.stack_mut().unwrap();
    let mut room = vec![0; 65_536];
    match stack.receive(socket, &mut room, Flags::NONE, &TimeView::default()) {
        Ok(received) => {
            room.truncate(received.len);
            Some((room, received.rx.expect("stamps are sound here")))
        }
        Err(SocketError::WouldBlock) => None,
        Err(error) => panic!("{error}"),
    }
}

/// Asks the next station, with a number, as long as it has had all answers but some; and answers whoever asks.
fn asks_and_answers(id: usize, answers: Notes<(usize, u32)>) -> Does<impl FnMut(&mut Access<'_>) + Send> {
    let (mut asks, mut hears, mut asked) = (Own::udp(2_000, 16), Own::udp(2_001, 16), 0u32);
    Does(move |sockets: &mut Access<'_>| {
        let (asks, hears) = (asks.id(sockets), hears.id(sockets));
        let mut room = [0; 4];
        while let Ok(Received { from: Sender::Udp(from), len, .. }) =
            sockets.receive(hears, &mut room, Flags::NONE)
        {
            sockets.send_to(hears, &room[..len], from).unwrap();
        }
        while sockets.receive(asks, &mut room, Flags::NONE).is_ok() {
            answers.lock().unwrap().push((id, u32::from_be_bytes(room)));
        }
        if is_settled(sockets) && asked < 1_000 && sockets.counters(asks).unwrap().received + 4 > asked.into()
        {
            sockets.send_to(asks, &asked.to_be_bytes(), at((id + 1) % 3, 2_001)).unwrap();
            asked += 1;
        }
    })
}

#[test]
fn programs_of_three_stations_ask_and_answer_each_in_its_slot() {
    let answers = Notes::default();
    let station = |id: usize| {
        let program = Box::new(asks_and_answers(id, answers.clone()));
        (vec![slot(0, 200 + 250 * id as i64)], stack(id, vec![program]))
    };
    let mut network = settled((0..3).map(station).collect());
    // A turn for each question and one for each answer.
    cycles(&mut network, 2_100);
    let answers = answers.lock().unwrap();
    for id in 0..3 {
        let of_it: Vec<u32> = answers.iter().filter(|(of, _)| *of == id).map(|answer| answer.1).collect();
        assert_eq!(of_it, (0..1_000).collect::<Vec<_>>(), "station {id} has all answers, in order");
        assert_eq!(network.member(id).station.refusals().total(), 0);
        assert_pools_full(network.member(id).station.stack().unwrap(), "a station that is done");
    }
}

/// Station 0 hears on port 2000, station 1 sends in a slot of this size.
fn pair(size: usize, buffers: usize) -> (Network<Tdma>, SocketId, SocketId) {
    let (mut hears, mut sends) = (stack(0, Vec::new()), stack(1, Vec::new()));
    let sockets = (udp(&mut hears, 2_000, buffers), udp(&mut sends, 2_000, buffers));
    let network =
        settled(vec![(vec![slot(0, 200)], hears), (vec![SlotConfig { size, ..slot(0, 500) }], sends)]);
    (network, sockets.0, sockets.1)
}

/// How many fragments a datagram has where so many bytes of a frame are for IP.
fn fragments(data: usize, size: usize) -> usize {
    let whole = data + HEADERS - IP;
    if whole + IP <= size { 1 } else { whole.div_ceil((size - IP) & !7) }
}

#[test]
fn a_datagram_takes_as_many_cycles_as_fragments() {
    assert_eq!((fragments(60_000, 1_500), fragments(60_000, 500), fragments(60_000, 100)), (41, 126, 751));
    for (size, data) in
        [(1_500, 60_000), (1_500, 65_507), (500, 60_000), (100, 60_000), (1_500, 1_472), (1_500, 1_473)]
    {
        let (mut network, hears, sends) = pair(size, 800);
        let aired = aired(&mut network);
        send(&mut network, 1, sends, &bytes(data), (0, 2_000));
        let count = fragments(data, size);
        cycles(&mut network, count as u64);
        let aired = aired.borrow();
        assert_eq!(aired.len(), count, "{data} bytes in slots of {size}");
        let cycle = CYCLE.nanos() as u64;
        assert!(aired.windows(2).all(|two| two[1].0 - two[0].0 == cycle), "one each cycle, none left out");
        assert!(
            aired[..count - 1].iter().all(|(_, frame)| frame.len() == HEADER_LEN + IP + ((size - IP) & !7))
        );
        cycles(&mut network, 1);
        let (received, rx) = receive(&mut network, 0, hears).expect("it is whole");
        assert_eq!(received, bytes(data));
        let clock = network.member(0).clock;
        assert_eq!(clock.truth(rx) - aired[count - 1].0, 500, "stamped when its last fragment comes");
        for id in [0, 1] {
            assert_pools_full(network.member(id).station.stack().unwrap(), "a station");
        }
    }
}

#[test]
fn a_slot_that_changes_takes_the_rest_of_a_datagram_if_it_fits_and_the_next_one_is_cut_for_it() {
    for (before, after) in [(500, 1_500), (200, 200), (1_500, 500), (1_500, 68)] {
        let (mut network, hears, sends) = pair(before, 64);
        let aired = aired(&mut network);
        let data = bytes(((before - IP) & !7) * 5 - 8);
        send(&mut network, 1, sends, &data, (0, 2_000));
        cycles(&mut network, 2);
        change_slot(&mut network, 1, SlotConfig { size: after, ..slot(0, 500) });
        cycles(&mut network, 5);
        let sent = aired.borrow_mut().drain(..).count() as u64;
        assert_eq!(sent + network.member(1).station.discipline().status().counters.returned_dropped, 5);
        if after >= before {
            assert_eq!((sent, receive(&mut network, 0, hears).expect("it is whole").0), (5, data));
        } else {
            assert!((2..=3).contains(&sent), "what is too large for the slot does not wait for ever: {sent}");
            assert_eq!(receive(&mut network, 0, hears), None);
        }
        send(&mut network, 1, sends, &bytes(1_000), (0, 2_000));
        cycles(&mut network, fragments(1_000, after) as u64 + 1);
        assert_eq!(aired.borrow().len(), fragments(1_000, after), "in slots of {after}");
        assert_eq!(receive(&mut network, 0, hears).expect("it is whole").0, bytes(1_000));
        // What was never whole is given up in time.
        cycles(&mut network, 1_100);
        for id in [0, 1] {
            assert_pools_full(network.member(id).station.stack().unwrap(), "a station");
        }
    }
}

fn change_slot(network: &mut Network<Tdma>, id: usize, slot: SlotConfig) {
    let now = network.now();
    let member = network.member_mut(id);
    let now = member.clock.local(now);
    member.station.discipline_mut().command(now, &mut TdmaCommand::set_slot(slot)).unwrap();
}
