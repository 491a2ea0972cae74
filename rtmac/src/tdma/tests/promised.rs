//! Whom this station has asked for a calibration reply may still answer, whatever it is by then.

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
fn who_becomes_something_else_leaves_its_turn_to_every_reply_that_may_still_come() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 0);
    let carried = carried(&mut slave, (6..=60).step_by(3));
    // In the first use behind the one that asked, and eight times put off by two.
    let expected = (1..=19).map(|uses| if uses <= 17 && uses % 2 == 1 { "nothing" } else { "data" });
    assert!(expected.eq(carried.iter().copied()), "{carried:?}");
    let status = slave.status();
    assert_eq!((status.counters.slots_calibrating, status.counters.overruns), (9, 0));
}

#[test]
fn who_calibrates_in_another_role_asks_where_no_reply_to_the_one_before_may_come() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 5);
    let carried = carried(&mut slave, (6..=18).step_by(3));
    assert_eq!(carried, ["nothing", "request", "nothing", "request", "nothing"]);
    assert_eq!(slave.status().counters.slots_calibrating, 0, "it has no turns yet");
}

#[test]
fn who_is_answered_in_another_role_has_all_of_its_turns_again() {
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
fn a_slot_in_which_a_reply_may_still_come_stays_until_it_would_have_come() {
    let mut slave = has_asked(5);
    become_slave(&mut slave, 0);
    hear_syncs(&mut slave, 4..=5);
    let refused = Err(Refused::Calibrating { id: 0 });
    let changed = |slave: &mut Tdma, now| slave.command(at(now), &mut moved(500, 100)).map(drop);
    assert_eq!(changed(&mut slave, 5_500), refused);
    slave.command(at(5_500), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    let removed = slave.command(at(5_600), &mut TdmaCommand::RemoveSlot(0)).map(drop);
    assert_eq!(removed, refused, "whose it would be next might send there");
    // Asked in cycle 3, the last in cycle 54, and a use for the slot itself.
    assert_eq!(changed(&mut slave, 57_400), refused);
    assert_eq!(changed(&mut slave, 57_401), Ok(()));
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
fn who_has_its_answer_uses_the_turn_that_is_kept_for_one_that_was_late() {
    let mut slave = locked_slave();
    slave.command(at(2_600), &mut TdmaCommand::Calibrate(NewRounds::of(2).unwrap())).unwrap();
    assert_eq!(carried(&mut slave, 4..=5), ["request", "nothing"]);
    let mut frame = Pool::new(1).take().unwrap();
    let reply = Message::Reply { request_xmit: 4_400_000, reception: 4_401_000, xmit: 5_400_000 };
    reply.write(OWN, OTHER, &mut frame);
    assert!(matches!(slave.on_frame(Some(at(5_402)), frame), Claimed::Kept));
    assert_eq!(carried(&mut slave, 6..=8), ["data", "data", "request"]);
}

#[test]
fn who_is_answered_by_one_master_still_leaves_its_turns_to_another_that_it_asked_before() {
    let mut slave = locked_slave();
    slave.command(at(2_600), &mut TdmaCommand::Calibrate(NewRounds::of(9).unwrap())).unwrap();
    assert_eq!(carried(&mut slave, 4..=7), ["request", "nothing", "data", "nothing"]);
    // A backup has taken over, since the one that was asked first slept.
    let backup = Address([2, 0, 0, 0, 0, 3]);
    let hear = |slave: &mut Tdma, at: Instant, message: Message| {
        let mut frame = Pool::new(1).take().unwrap();
        message.write(OWN, backup, &mut frame);
        assert!(matches!(slave.on_frame(Some(at), frame), Claimed::Kept));
    };
    for (cycle, carries) in [(8, "request"), (9, "nothing")] {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
        hear(&mut slave, at(u64::from(cycle) * 1_000), Message::Sync { cycle, xmit: sched, sched });
        assert_eq!(carried(&mut slave, cycle..=cycle), [carries]);
    }
    let reply = Message::Reply { request_xmit: 8_400_000, reception: 8_401_000, xmit: 9_400_000 };
    hear(&mut slave, at(9_402), reply);
    assert_eq!(
        carried(&mut slave, 10..=12),
        ["data", "nothing", "request"],
        "the first may have woken by now"
    );
}

#[test]
fn nobody_asks_for_a_reply_that_would_come_when_cycles_are_numbered_anew_where_its_phase_is_anothers_then() {
    let wrap = 1u64 << 32;
    let asked = |period: u32| {
        let mut slave = Tdma::new(&with_slots(50, &[(0, period)])).unwrap();
        let mut asked = Vec::new();
        for n in wrap - 90..wrap + 30 {
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
    // The last reply may be put off by 17 turns.
    assert_eq!(asked(3), (Some(52), Some(3)));
    assert_eq!(asked(2), (Some(4), Some(0)), "a part of 2^32: phases go on as they were");
}
