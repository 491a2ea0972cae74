//! An independent station with the habits of real ones joins ours, and ours joins it, over veth.

use rtnet::discipline::SyncState;
use rtnet::time::Span;
use tests::host::alone;
use tests::peer::{Peer, PeerConfig, PeerSlot};

use crate::live::{CYCLE, Medium, clock, our_master, our_slave};

const ROUNDS: u32 = 20;
/// Nobody's frame takes longer over veth; what is measured above it is a host that was held up.
const DELAY_AT_MOST: Span = Span::from_micros(500);

fn peer(address: rtnet::wire::ethernet::Address, master: Option<Span>, offset: Span) -> Peer {
    let slot = PeerSlot { id: 0, offset, phase: 0, period: 1, size: 100 };
    let (backup, lead) = (None, Span::from_micros(50));
    Peer::new(PeerConfig { address, master, backup, rounds: ROUNDS, slots: vec![slot], lead })
}

#[test]
fn peer_joins_our_master() {
    alone("peer_joins_our_master", || {
        let mut medium = Medium::new();
        let ahead = clock(Span::from_millis(300), 20_000);
        let master = medium.start(ahead, 1, |address| our_master(address, &ahead, Span::from_micros(1_000)));
        let mut peer = medium.start(clock(Span::from_millis(-200), -30_000), 0, |address| {
            peer(address, None, Span::from_micros(3_000))
        });
        // It waits for ever for the reply to a request that the host held up by a cycle.
        let status = peer.wait_until("the peer has calibrated", |status| status.delay.is_some());
        assert!(status.delay.unwrap().abs() < DELAY_AT_MOST, "{status:?}");
        assert!(status.requests_sent >= u64::from(ROUNDS));
        master.wait_for_frames(50);
        peer.wait_for_frames(50);
    });
}

#[test]
fn our_slave_joins_a_peer_master() {
    alone("our_slave_joins_a_peer_master", || {
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
    });
}
