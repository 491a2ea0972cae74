//! What a slave does when its master is gone, on a real medium.

use rtnet::discipline::SyncState;
use rtnet::time::Span;
use tests::host::alone;

use crate::live::{Medium, clock, our_master, our_slave};

#[test]
fn a_slave_falls_silent_without_its_master() {
    alone("a_slave_falls_silent_without_its_master", || {
        let mut medium = Medium::new();
        let ideal = clock(Span::ZERO, 0);
        let master = medium.start(ideal, 1, |address| our_master(address, &ideal, Span::from_micros(1_000)));
        let mut slave = medium.start(clock(Span::from_millis(700), 50_000), 0, |address| {
            our_slave(address, 5, Span::from_micros(3_000))
        });
        slave.wait_until("locked", |status| status.state == SyncState::Locked);
        master.wait_for_frames(20);
        drop(master);
        let lost = slave.wait_until("lost", |status| status.state == SyncState::Lost);
        // A busy host may have lost the master before it ended, and found it again since.
        let silent = lost.counters.slots_silent;
        let lost = slave.wait_until("slots pass", |status| status.counters.slots_silent >= silent + 20);
        let sent = lost.counters.frames_sent;
        let silent = lost.counters.slots_silent;
        let later = slave.wait_until("slots pass", |status| status.counters.slots_silent >= silent + 20);
        assert_eq!(later.counters.frames_sent, sent);
    });
}
