//! Calibration on demand: who may, who may not, and what the first slot carries meanwhile.

use super::*;

fn calibrate(rounds: u32) -> TdmaCommand {
    TdmaCommand::Calibrate(NewRounds::of(rounds).unwrap())
}

/// Which of the turns from cycle 4 on carried what, with a frame waiting for each.
fn turns(slave: &mut Tdma, cycles: core::ops::RangeInclusive<u32>) -> Vec<&'static str> {
    let pool = Pool::new(1);
    let turn = |cycle| {
        hear_syncs(slave, cycle..=cycle);
        if slave.status().slots[0].unwrap().queued == 0 {
            queue(slave, &pool, 60);
        }
        let slot = at(u64::from(cycle) * 1_000 + 400);
        slave.on_timeout(slot);
        match slave.next_transmission(slot) {
            None => "nothing",
            Some(sent) => {
                let parsed = wire::parse(&sent.frame);
                slave.on_sent(Sent::At(sent.at));
                if matches!(parsed, Ok(Rtmac::Tdma(Message::Request { .. }))) { "request" } else { "data" }
            }
        }
    };
    cycles.map(turn).collect()
}

#[test]
fn a_round_takes_two_of_four_turns_of_the_first_slot() {
    let mut slave = locked_slave();
    hear_syncs(&mut slave, 3..=3);
    assert_eq!(slave.command(at(3_500), &mut calibrate(2)), Ok(4));
    let expected = ["request", "nothing", "data", "data"];
    assert_eq!(turns(&mut slave, 4..=7), expected);
    assert_eq!(turns(&mut slave, 8..=11), expected, "nobody has answered: once more");
    let status = slave.status();
    assert_eq!((status.state, status.calibrating), (SyncState::Locked, Some((0, 2))));
    assert_eq!((status.counters.slots_calibrating, status.counters.requests_sent), (4, 2));
    let turns: Vec<_> =
        told(&mut slave).into_iter().filter(|(_, kind, _)| *kind == EventKind::CalibrationTurn).collect();
    assert!(turns.iter().map(|&(cycle, ..)| cycle).eq([4, 5, 8, 9]), "each is told of: {turns:?}");
}

#[test]
fn who_has_had_the_last_reply_anew_sends_from_the_next_turn_on() {
    let mut slave = locked_slave();
    hear_syncs(&mut slave, 3..=3);
    assert!(slave.next_transmission(at(3_400)).is_none(), "nothing was queued");
    slave.command(at(3_500), &mut calibrate(1)).unwrap();
    hear_syncs(&mut slave, 4..=4);
    queue(&mut slave, &Pool::new(1), 60);
    let request_xmit = sent_next(&mut slave).nanos();
    hear_syncs(&mut slave, 5..=5);
    // By its line, which is a little late, the reply comes before its turn.
    let [reception, xmit] = [4_401_000, 5_397_000];
    let mut frame = Pool::new(1).take().unwrap();
    Message::Reply { request_xmit, reception, xmit }.write(OWN, OTHER, &mut frame);
    assert!(matches!(slave.on_frame(Some(at(5_398)), frame), Claimed::Kept));
    assert_eq!((slave.status().delay, slave.status().calibrating), (Some(Span::from_micros(1)), None));
    assert!(slave.next_transmission(at(5_400)).is_none(), "the reply is still on the air");
    hear_syncs(&mut slave, 6..=6);
    assert!(slave.next_transmission(at(6_400)).is_some(), "what is queued");
    let told = told(&mut slave).into_iter().filter(|(_, kind, _)| *kind == EventKind::CalibrationTurn);
    assert_eq!(told.map(|(cycle, ..)| cycle).collect::<Vec<_>>(), [4, 5], "each is told of");
}

#[test]
fn a_backup_that_takes_over_leaves_the_turn_of_the_reply_that_it_asked_for_free() {
    let follow = SlaveConfig { rounds: 0, ..SlaveConfig::default() };
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), follow, ..master_config() };
    let mut tdma = Tdma::new(&config(RoleConfig::Master(backup))).unwrap();
    tdma.on_timeout(at(500));
    hear_syncs(&mut tdma, 1..=3);
    tdma.on_timeout(at(3_300));
    assert_eq!(tdma.status().mastery, Some(Mastery::StandBy));
    assert!(tdma.next_transmission(at(3_400)).is_none(), "nothing was queued");
    tdma.command(at(3_500), &mut calibrate(2)).unwrap();
    hear_syncs(&mut tdma, 4..=4);
    assert_eq!(sent_next(&mut tdma), at(4_400), "the request");
    // Whatever it is to measure by now.
    tdma.role.follower_mut().unwrap().calibration_mut().leave_master();
    queue(&mut tdma, &Pool::new(1), 60);
    assert_eq!(sent_next(&mut tdma), at(5_100), "there was no Synchronisation");
    assert_eq!(tdma.status().mastery, Some(Mastery::Active));
    assert!(tdma.next_transmission(at(5_400)).is_none(), "who has not heard that answers");
    assert_eq!(sent_next(&mut tdma), at(6_100));
    assert_eq!(sent_next(&mut tdma), at(6_400), "what is queued");
    let told = told(&mut tdma).into_iter().filter(|(_, kind, _)| *kind == EventKind::CalibrationTurn);
    assert_eq!(told.map(|(cycle, ..)| cycle).collect::<Vec<_>>(), [4, 5], "each is told of");
}

#[test]
fn who_gets_no_answer_at_all_is_told_of_and_goes_on_as_before() {
    let mut slave = locked_slave();
    hear_syncs(&mut slave, 3..=3);
    slave.command(at(3_500), &mut calibrate(1)).unwrap();
    let turns = turns(&mut slave, 4..=120);
    assert_eq!(turns.iter().filter(|turn| **turn == "request").count(), 23);
    // The last asked in cycle 92, and gave up in cycle 96.
    assert_eq!(turns[88..=92], ["request", "nothing", "data", "data", "nothing"]);
    assert!(turns[93..].iter().all(|turn| *turn == "data"), "{turns:?}");
    let status = slave.status();
    assert_eq!((status.counters.calibration_timeouts, status.delay), (1, Some(Span::ZERO)));
}

#[test]
fn other_slots_are_used_as_ever_meanwhile() {
    let mut slave = locked_slave();
    let slot =
        SlotConfig { id: 2, offset: Span::from_micros(600), ..slave.status().slots[0].unwrap().config };
    slave.command(at(2_650), &mut TdmaCommand::set_slot(slot)).unwrap();
    hear_syncs(&mut slave, 3..=3);
    assert!(slave.next_transmission(at(3_600)).is_none(), "nothing was queued");
    slave.command(at(3_700), &mut calibrate(50)).unwrap();
    let pool = Pool::new(1);
    for cycle in 4..12u64 {
        hear_syncs(&mut slave, cycle as u32..=cycle as u32);
        let mut frame = pool.take().unwrap();
        frame.fill(&[0; 60]);
        slave.enqueue(frame, Priority::DEFAULT, 2).unwrap();
        if cycle % 4 == 0 {
            assert_eq!(sent_next(&mut slave), at(cycle * 1_000 + 400), "the request");
        }
        assert_eq!(sent_next(&mut slave), at(cycle * 1_000 + 600));
    }
}

#[test]
fn the_slot_in_which_it_is_measured_anew_stays_the_first() {
    let mut slave = locked_slave();
    let slot = SlotConfig { id: 2, ..slave.status().slots[0].unwrap().config };
    slave.command(at(2_600), &mut TdmaCommand::set_slot(slot)).unwrap();
    slave.command(at(2_600), &mut TdmaCommand::RemoveSlot(0)).unwrap();
    slave.command(at(2_600), &mut calibrate(2)).unwrap();
    for id in [1, 2] {
        let refused = slave.command(at(2_600), &mut TdmaCommand::set_slot(SlotConfig { id, ..slot }));
        assert_eq!(refused, Err(Refused::Calibrating { id: 2 }));
    }
    assert_eq!(
        slave.command(at(2_600), &mut TdmaCommand::set_slot(SlotConfig { id: 3, ..slot })),
        Ok(3),
        "one behind it may come"
    );
}

#[test]
fn who_cannot_measure_anew_says_why() {
    let refused = |tdma: &mut Tdma| tdma.command(at(3_500), &mut calibrate(5)).unwrap_err();
    assert_eq!(refused(&mut active_master()), Refused::GivesTheTime);
    let mut lost = locked_slave();
    lost.on_timeout(at(3_500));
    assert_eq!(lost.time().state, SyncState::Holdover);
    assert_eq!(lost.command(at(3_500), &mut calibrate(5)), Ok(4), "one that is missing is bridged");
    let mut lost = locked_slave();
    lost.on_timeout(at(4_500));
    assert_eq!(refused(&mut lost), Refused::NotLocked { state: SyncState::Lost });
    let role = RoleConfig::Slave(SlaveConfig { rounds: 5, ..SlaveConfig::default() });
    assert_eq!(
        refused(&mut Tdma::new(&config(role)).unwrap()),
        Refused::CalibratesAlready,
        "for the first time"
    );
    let mut slave = locked_slave();
    slave.command(at(2_600), &mut calibrate(5)).unwrap();
    assert_eq!(refused(&mut slave), Refused::CalibratesAlready);
    slave.command(at(2_600), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    assert!(matches!(refused(&mut slave), Refused::NotLocked { .. }));
    assert_eq!(NewRounds::of(0).err(), Some(Refused::NoRounds));
    assert!(matches!(NewRounds::of(MAX_ROUNDS + 1), Err(Refused::TooManyRounds { .. })));
}

#[test]
fn a_master_that_will_follow_others_is_judged_by_its_slots_as_a_slave_is() {
    let follow = SlaveConfig { rounds: 5, ..SlaveConfig::default() };
    let primary = MasterConfig { follow, ..master_config() };
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), ..primary };
    let seldom = |master| TdmaConfig { role: RoleConfig::Master(master), ..with_slots(0, &[(0, 1_025)]) };
    let never = Err(Refused::NeverCalibrated { id: 0, period: 1_025 });
    assert_eq!(Tdma::new(&seldom(backup)).map(drop), never);
    let returns = MasterConfig { backups_from: Some(Span::from_micros(100)), ..primary };
    assert_eq!(Tdma::new(&seldom(returns)).map(drop), never);
    assert_eq!(Tdma::new(&seldom(primary)).map(drop), Ok(()), "it follows nobody that it knows of");
    assert!(Tdma::new(&TdmaConfig { slots: Vec::new(), ..seldom(backup) }).is_ok(), "it does without");

    // The same by command, and of a backup's instant, too.
    let become_it = |master| TdmaCommand::Become(NewRole::attached(RoleConfig::Master(master)).unwrap());
    let mut slave = Tdma::new(&with_slots(0, &[(0, 1_025)])).unwrap();
    assert_eq!(slave.command(at(0), &mut become_it(backup)).map(drop), never);
    let late = MasterConfig { backup: Some(Span::from_micros(380)), ..primary };
    let refused = locked_slave().command(at(2_600), &mut become_it(late)).unwrap_err();
    assert!(matches!(refused, Refused::BeforeBackup { id: 0, .. }), "{refused}");
    let mut tdma =
        Tdma::new(&TdmaConfig { role: RoleConfig::Master(backup), ..with_slots(0, &[(0, 1)]) }).unwrap();
    let set = TdmaCommand::set_slot(with_slots(0, &[(0, 1_025)]).slots[0]);
    assert_eq!(tdma.command(at(0), &mut { set }).map(drop), never);
}

#[test]
fn a_backup_keeps_the_slot_in_which_it_calibrates() {
    let follow = SlaveConfig { rounds: 5, ..SlaveConfig::default() };
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), follow, ..master_config() };
    let mut tdma = Tdma::new(&config(RoleConfig::Master(backup))).unwrap();
    tdma.on_timeout(at(500));
    hear_syncs(&mut tdma, 1..=2);
    assert_eq!(tdma.time().state, SyncState::Calibrating);
    let refused = Err(Refused::Calibrating { id: 0 });
    assert_eq!(tdma.command(at(2_600), &mut moved(500, 100)), refused);
    assert_eq!(tdma.command(at(2_600), &mut TdmaCommand::RemoveSlot(0)), refused);
}

#[test]
fn nobody_asks_in_a_turn_behind_which_the_slot_is_another_one() {
    let mut slave = locked_slave();
    hear_syncs(&mut slave, 3..=4);
    assert_eq!(slave.command(at(4_100), &mut moved(500, 100)), Ok(5));
    slave.command(at(4_150), &mut calibrate(2)).unwrap();
    queue(&mut slave, &Pool::new(1), 60);
    slave.on_timeout(at(4_400));
    let sent = slave.next_transmission(at(4_400)).expect("its turn as it was");
    assert!(wire::parse(&sent.frame).is_err(), "data, for a reply would come where the slot is no more");
}
