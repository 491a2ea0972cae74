//! The turn in which a calibration reply was asked for is left to it, whatever the station is by then.

use super::*;

/// A slave of so many rounds whose only slot is used in every third cycle, which has asked in cycle 3.
fn has_asked(rounds: u32) -> Tdma {
    let mut slave = Tdma::new(&with_slots(rounds, &[(0, 3)])).unwrap();
    hear_syncs(&mut slave, 1..=3);
    let request = slave.next_transmission(at(3_400)).expect("a request");
    slave.on_sent(Sent::At(request.at));
    slave
}

fn become_slave(tdma: &mut Tdma, rounds: u32) {
    let role = RoleConfig::Slave(SlaveConfig { rounds, ..SlaveConfig::default() });
    tdma.command(at(3_450), &mut TdmaCommand::Become(NewRole::attached(role).unwrap())).unwrap();
}

/// What the slot carried in its turns, one in each of these cycles, with a frame waiting.
fn carried(tdma: &mut Tdma, cycles: impl Iterator<Item = u32>) -> Vec<&'static str> {
    let pool = Pool::new(1);
    let turn = |cycle: u32| {
        if tdma.status().slots[0].unwrap().queued == 0 {
            queue(tdma, &pool, 60);
        }
        hear_syncs(tdma, (cycle - 1).max(tdma.time().cycle + 1)..=cycle);
        let slot = at(u64::from(cycle) * 1_000 + 400);
        tdma.on_timeout(slot);
        let Some(sent) = tdma.next_transmission(slot) else { return "nothing" };
        tdma.on_sent(Sent::At(sent.at));
        if wire::parse(&sent.frame).is_ok() { "request" } else { "data" }
    };
    cycles.map(turn).collect()
}

#[test]
fn a_station_in_another_role_leaves_the_turn_that_it_asked_for() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 0);
    assert_eq!(carried(&mut slave, (6..=15).step_by(3)), ["nothing", "data", "data", "data"]);
    let status = slave.status();
    assert_eq!((status.counters.slots_calibrating, status.counters.overruns), (1, 0));
}

#[test]
fn a_station_that_calibrates_in_another_role_asks_a_turn_later() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 5);
    let carried = carried(&mut slave, (6..=18).step_by(3));
    assert_eq!(carried, ["nothing", "request", "nothing", "request", "nothing"]);
    assert_eq!(slave.status().counters.slots_calibrating, 0, "it has no turns yet");
}

#[test]
fn a_station_answered_in_another_role_has_all_turns_again() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 0);
    hear_syncs(&mut slave, 4..=6);
    let reply = Message::Reply { request_xmit: 3_400_000, reception: 3_401_000, xmit: 6_400_000 };
    let mut frame = Pool::new(1).take().unwrap();
    reply.write(OWN, OTHER, &mut frame);
    let claimed = slave.on_frame(Some(at(6_401)), frame);
    assert!(matches!(claimed, Claimed::Refused(Refusal::UnexpectedReply)), "of no use by now: {claimed:?}");
    queue(&mut slave, &Pool::new(1), 60);
    assert!(slave.next_transmission(at(6_401)).is_none(), "the reply is still on the air");
    assert_eq!(carried(&mut slave, (9..=15).step_by(3)), ["data"; 3]);
}

#[test]
fn a_slot_stays_until_the_reply_would_have_come() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 0);
    hear_syncs(&mut slave, 4..=5);
    let refused = Err(Refused::Calibrating { id: 0 });
    let changed = |slave: &mut Tdma, now| slave.command(at(now), &mut moved(500, 100)).map(drop);
    assert_eq!(changed(&mut slave, 5_500), refused);
    slave.command(at(5_500), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    let removed = slave.command(at(5_600), &mut TdmaCommand::RemoveSlot(0)).map(drop);
    assert_eq!(removed, refused, "whose it would be next might send there");
    // Asked in cycle 3 for cycle 6, and a cycle for the slot itself.
    assert_eq!(changed(&mut slave, 7_400), refused);
    assert_eq!(changed(&mut slave, 7_401), Ok(()));
}

#[test]
fn a_turn_that_is_left_to_a_reply_and_slept_through_was_not_late() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 0);
    hear_syncs(&mut slave, 4..=8);
    told(&mut slave);
    assert!(slave.next_transmission(at(8_000)).is_none(), "it wakes long behind cycle 6");
    assert_eq!(told(&mut slave), [(6, EventKind::CalibrationTurn, Span::ZERO)]);
    let counters = slave.status().counters;
    assert_eq!((counters.overruns, counters.slots_calibrating), (0, 1));
}

#[test]
fn a_reply_that_comes_after_its_turn_is_taken() {
    let mut slave = has_asked(2);
    hear_syncs(&mut slave, 4..=6);
    slave.on_timeout(at(6_400));
    assert!(slave.next_transmission(at(6_400)).is_none(), "the turn is left to it");
    hear_syncs(&mut slave, 7..=8);
    let reply = Message::Reply { request_xmit: 3_400_000, reception: 3_401_000, xmit: 8_100_000 };
    let mut frame = Pool::new(1).take().unwrap();
    reply.write(OWN, OTHER, &mut frame);
    assert!(matches!(slave.on_frame(Some(at(8_101)), frame), Claimed::Kept));
    assert_eq!(slave.status().calibrating, Some((1, 2)));
    assert_eq!(carried(&mut slave, (9..=12).step_by(3)), ["request", "nothing"], "the next round");
    assert_eq!(slave.status().calibration_repeats, 0);
}

#[test]
fn no_reply_is_asked_for_where_the_wrap_moves_the_phase() {
    let wrap = 1u64 << 32;
    let asked = |period: u32, from: u64| {
        let mut slave = Tdma::new(&with_slots(50, &[(0, period)])).unwrap();
        let mut asked = Vec::new();
        for n in wrap - from..wrap + 30 {
            let sched = GlobalTime::from_nanos(n * 1_000_000);
            let mut frame = Pool::new(1).take().unwrap();
            let sync = Message::Sync { cycle: n as u32, xmit: sched, sched };
            sync.write(Address::BROADCAST, OTHER, &mut frame);
            slave.on_frame(Some(at(n * 1_000)), frame);
            slave.on_timeout(at(n * 1_000 + 400));
            if let Some(request) = slave.next_transmission(at(n * 1_000 + 400)) {
                slave.on_sent(Sent::At(request.at));
                asked.push(n);
            }
        }
        let before = asked.iter().filter(|&&n| n < wrap).max().map(|&n| wrap - n);
        (before, asked.iter().find(|&&n| n >= wrap).map(|&n| n - wrap))
    };
    // 2^32 - 1 is a turn of every third cycle, and 0 is the next one.
    assert_eq!(asked(3, 90), (Some(4), Some(0)), "in its own turn the last reply comes");
    assert_eq!(asked(3, 93), (Some(7), Some(0)), "the reply to 2^32 - 1 would come in cycle 2");
    assert_eq!(asked(2, 90), (Some(4), Some(0)), "a part of 2^32: phases go on as they were");
}
