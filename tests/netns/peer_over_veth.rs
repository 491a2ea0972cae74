//! An independent station with the habits of real ones joins ours, and ours joins it, over veth.

use std::time::Duration;

use rtmac::tdma::Tdma;
use rtnet::discipline::SyncState;
use rtnet::time::Span;
use tests::peer::{Peer, PeerConfig, PeerSlot, PeerStatus};

use crate::live::{CYCLE, Medium, Running, as_root, clock, our_master, our_slave};

const ROUNDS: u32 = 20;
const ATTEMPTS: usize = 4;
const JOINS_WITHIN: Duration = Duration::from_secs(10);
/// Nobody's frame takes longer over veth; what is measured above it is a host that was held up.
const DELAY_AT_MOST: Span = Span::from_micros(500);

fn peer(address: rtnet::wire::ethernet::Address, master: Option<Span>, offset: Span) -> Peer {
    let slot = PeerSlot { id: 0, offset, phase: 0, period: 1, size: 100 };
    let (backup, lead) = (None, Span::from_micros(50));
    Peer::new(PeerConfig { address, master, backup, rounds: ROUNDS, slots: vec![slot], lead })
}

/// A master of ours and a peer that has calibrated with it, if the peer's requests came in time: it is no
/// real-time thread, and waits for ever for the reply to one that this machine held up by a cycle.
fn peer_at_our_master(medium: &mut Medium) -> Option<(Running<Tdma>, Running<Peer>, PeerStatus)> {
    let ahead = clock(Span::from_millis(300), 20_000);
    let master = medium.start(ahead, 1, |address| our_master(address, &ahead, Span::from_micros(1_000)));
    let mut peer = medium.start(clock(Span::from_millis(-200), -30_000), 0, |address| {
        peer(address, None, Span::from_micros(3_000))
    });
    let status = peer.within(JOINS_WITHIN, |status| status.delay.is_some())?;
    Some((master, peer, status))
}

#[test]
fn peer_joins_our_master() {
    if !as_root("peer_joins_our_master") {
        return;
    }
    let mut mediums: [Medium; ATTEMPTS] = std::array::from_fn(|_| Medium::new());
    let joined = mediums.iter_mut().find_map(peer_at_our_master);
    let (master, peer, status) = joined.expect("the peer calibrates in one of the attempts");
    assert!(status.delay.unwrap().abs() < DELAY_AT_MOST, "{status:?}");
    assert!(status.requests_sent >= u64::from(ROUNDS));
    master.wait_for_frames(50);
    peer.wait_for_frames(50);
}

#[test]
fn our_slave_joins_a_peer_master() {
    if !as_root("our_slave_joins_a_peer_master") {
        return;
    }
    let mut medium = Medium::new();
    let master = medium.start(clock(Span::from_millis(150), -10_000), 1, |address| {
        peer(address, Some(CYCLE), Span::from_micros(1_000))
    });
    let mut slave = medium.start(clock(Span::from_millis(-400), 40_000), 0, |address| {
        our_slave(address, ROUNDS, Span::from_micros(3_000))
    });
    let status = slave.wait_until("our slave is locked", |status| status.state == SyncState::Locked);
    assert_eq!(status.period, Some(CYCLE));
    assert!(status.delay.unwrap().abs() < DELAY_AT_MOST, "{status:?}");
    master.wait_for_frames(50);
    slave.wait_for_frames(50);
}
