//! What waits for a station that does not run: as many frames as its receive pool has room for.

use std::cell::RefCell;
use std::rc::Rc;

use rtnet::clock::EmulatedClock;
use rtnet::counters::Refusal;
use rtnet::sim::{Host, Medium, Member, Network};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, MIN_FRAME};
use tests::seeds;
use tools::station::access::{Access, AccessConfig};

const STATIONS: usize = 3;
const BEGIN: u64 = 1_000_000_000;
/// Buffers of a station's network card.
const POOL: u64 = 32;

fn address(id: usize) -> Address {
    Address([2, 0, 0, 0, 0, id as u8])
}

fn station(id: usize) -> Station<Access> {
    Station::new(Access::new(&AccessConfig::Direct, address(id)).unwrap(), Vec::new())
}

fn network() -> Network<Access> {
    let mut network = Network::new(Medium::default(), seeds::one("receive_pool"));
    network.run_until(BEGIN);
    for id in 0..STATIONS {
        let clock = EmulatedClock { anchor: BEGIN, ..EmulatedClock::default() };
        let (address, station) = (address(id), station(id));
        network.add(Member { address, clock, host: Host::IDEAL.into(), station }, BEGIN);
    }
    network
}

/// Frames that nobody claims, for all.
fn inject(network: &mut Network<Access>, frames: u64) {
    let mut frame = [0xff; MIN_FRAME];
    frame[6..14].copy_from_slice(&[2, 0, 0, 0, 0, 0xa, 0x12, 0x34]);
    for _ in 0..frames {
        network.inject(&frame);
        network.run_until(network.now() + 10_000);
    }
}

fn heard(network: &Network<Access>, id: usize) -> u64 {
    network.member(id).station.refusals().get(Refusal::UnclaimedEtherType)
}

#[test]
fn who_does_not_run_finds_as_many_frames_as_there_was_room_for_and_others_lose_none() {
    let mut network = network();
    let lost = Rc::new(RefCell::new(Vec::new()));
    let noted = lost.clone();
    network.mourn(move |id, _, _| noted.borrow_mut().push(id));
    network.freeze(1, Span::from_millis(100));
    inject(&mut network, POOL + 8);
    assert_eq!(heard(&network, 1), 0);
    network.run_until(network.now() + 200_000_000);

    assert_eq!([0, 1, 2].map(|id| heard(&network, id)), [POOL + 8, POOL, POOL + 8]);
    assert_eq!([0, 1, 2].map(|id| network.dropped(id)), [0, 8, 0]);
    assert_eq!(*lost.borrow(), [1; 8], "each was told of");
    inject(&mut network, POOL);
    assert_eq!(heard(&network, 1), POOL * 2, "there is room again");
}

#[test]
fn what_waits_for_a_station_is_gone_with_it() {
    let mut network = network();
    network.freeze(1, Span::from_millis(100));
    inject(&mut network, POOL);
    network.restart(1, station(1));
    inject(&mut network, POOL);
    assert_eq!(
        (heard(&network, 1), network.dropped(1)),
        (POOL, 0),
        "what came since, for which there was room"
    );
    assert_eq!(heard(&network, 0), POOL * 2);
}
