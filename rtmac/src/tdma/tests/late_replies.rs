//! A calibration reply that cannot make the instant asked for goes where the master may send anyway.

use super::*;

const ROOM: BehindSync = BehindSync { after: Span::from_micros(8), latest: Span::from_micros(4) };

/// A master whose first cycle begins at 4 ms, asked for a reply 100 us into it, and what the Synchronisation left behind.
fn asked(slots: bool, behind_sync: Option<BehindSync>) -> Tdma {
    let whole = config(RoleConfig::Master(MasterConfig { behind_sync, ..master_config() }));
    let slots = if slots { whole.slots.clone() } else { Vec::new() };
    let mut master = Tdma::new(&TdmaConfig { slots, ..whole }).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let request = Message::Request { xmit: 7, reply_cycle: 1, reply_offset: 100_000 };
    assert!(matches!(hear(&mut master, OTHER, request), Claimed::Kept));
    let sync = master.next_transmission(at(3_960)).unwrap();
    master.on_sent(Sent::At(sync.at));
    assert!(master.next_transmission(at(4_250)).is_none(), "it slept through the reply's instant");
    master
}

/// What leaves next at this look at the clock, and when.
fn leaves(master: &mut Tdma, now: u64) -> Option<(Instant, Instant, bool)> {
    master.on_timeout(at(now));
    let sent = master.next_transmission(at(now))?;
    let is_reply =
        matches!(wire::parse(&sent.frame), Ok(Rtmac::Tdma(Message::Reply { request_xmit: 7, .. })));
    master.on_sent(Sent::At(sent.at));
    Some((sent.at, sent.latest, is_reply))
}

#[test]
fn a_late_reply_goes_once_in_the_masters_next_slot() {
    let mut master = asked(true, Some(ROOM));
    told(&mut master);
    queue(&mut master, &Pool::new(1), 60);
    let turn = master.opportunity(at(4_360));
    assert_eq!(turn, None, "it is not for data");
    assert_eq!(leaves(&mut master, 4_360), Some((at(4_400), at(4_420), true)), "held to its slot's bounds");
    assert_eq!(told(&mut master), [(1, EventKind::CalibrationTurn, Span::ZERO)], "each turn is told of");
    assert_eq!(leaves(&mut master, 4_960).map(|(at, ..)| at), Some(at(5_000)), "the Synchronisation");
    assert_eq!(leaves(&mut master, 5_360), Some((at(5_400), at(5_420), false)), "what was queued");
    let Counters { replies_sent, replies_late, replies_given_up, slots_calibrating, overruns, .. } =
        master.status().counters;
    assert_eq!((replies_sent, replies_late, replies_given_up, slots_calibrating, overruns), (1, 1, 0, 1, 0));
}

#[test]
fn a_late_reply_waits_for_a_slot_that_the_master_makes() {
    let mut master = asked(true, None);
    for cycle in 5..8 {
        let slept_until = cycle * 1_000 - 500;
        assert_eq!(leaves(&mut master, slept_until), None, "too late for its slot, too");
        assert_eq!(leaves(&mut master, slept_until + 460).map(|(at, ..)| at), Some(at(cycle * 1_000)));
    }
    assert_eq!(leaves(&mut master, 7_360), Some((at(7_400), at(7_420), true)));
    let counters = master.status().counters;
    assert_eq!((counters.replies_sent, counters.replies_late, counters.overruns), (1, 1, 3));
}

#[test]
fn a_master_without_slots_sends_a_late_reply_behind_its_sync() {
    let mut master = asked(false, Some(ROOM));
    assert_eq!(leaves(&mut master, 4_960), Some((at(5_000), at(5_040), false)), "the Synchronisation");
    assert!(leaves(&mut master, 5_013).is_none(), "beyond what the window has room for");
    assert_eq!(leaves(&mut master, 5_960).map(|(at, ..)| at), Some(at(6_000)));
    assert_eq!(leaves(&mut master, 6_001), Some((at(6_008), at(6_012), true)));
    assert_eq!(leaves(&mut master, 6_960).map(|(at, ..)| at), Some(at(7_000)));
    assert!(leaves(&mut master, 7_001).is_none(), "it is sent once");
    let counters = master.status().counters;
    assert_eq!(
        (counters.replies_sent, counters.replies_late, counters.replies_given_up),
        (1, 1, 0),
        "it is late once"
    );
}

#[test]
fn a_master_without_slots_or_room_drops_a_late_reply() {
    let mut master = asked(false, None);
    for cycle in 5..10 {
        assert_eq!(leaves(&mut master, cycle * 1_000 - 40).map(|(at, ..)| at), Some(at(cycle * 1_000)));
        assert!(leaves(&mut master, cycle * 1_000 + 1).is_none());
    }
    let counters = master.status().counters;
    assert_eq!((counters.replies_sent, counters.replies_late, counters.replies_given_up), (0, 1, 1));
}

#[test]
fn a_station_that_asks_again_has_no_late_reply_any_more() {
    let mut master = asked(false, Some(ROOM));
    let third = Address([2, 0, 0, 0, 0, 33]);
    let ask = |cycle, offset| Message::Request { xmit: 7, reply_cycle: cycle, reply_offset: offset };
    assert!(matches!(hear_at(&mut master, 4_260, third, ask(1, 400_000)), Claimed::Kept));
    assert_eq!(leaves(&mut master, 4_400), Some((at(4_400), at(4_400) + master_config().reply_latest, true)));
    assert_eq!(
        leaves(&mut master, 4_960).map(|(at, ..)| at),
        Some(at(5_000)),
        "the late one is to follow it"
    );
    told(&mut master);
    assert!(matches!(hear_at(&mut master, 5_004, OTHER, ask(3, 100_000)), Claimed::Kept));
    assert_eq!(leaves(&mut master, 5_050), None);
    assert_eq!(told(&mut master), [], "nothing was missed");
    assert_eq!(leaves(&mut master, 5_960).map(|(at, ..)| at), Some(at(6_000)));
    assert_eq!(leaves(&mut master, 6_100).map(|(at, ..)| at), Some(at(6_100)));
    let counters = master.status().counters;
    assert_eq!((counters.replies_sent, counters.replies_late, counters.replies_given_up), (2, 1, 1));
}

#[test]
fn a_late_reply_is_dropped_with_the_masters_last_slot() {
    let mut master = asked(true, None);
    master.command(at(4_300), &mut TdmaCommand::RemoveSlot(0)).unwrap();
    for cycle in 5..10 {
        assert_eq!(leaves(&mut master, cycle * 1_000 - 40).map(|(at, ..)| at), Some(at(cycle * 1_000)));
        assert!(leaves(&mut master, cycle * 1_000 + 1).is_none());
    }
    let counters = master.status().counters;
    assert_eq!((counters.replies_sent, counters.replies_late, counters.replies_given_up), (0, 1, 1));
}
