use super::*;

/// Slot 0 at 400 us, and slot 2, joined to it, at 700.
fn slots() -> Vec<SlotConfig> {
    let own = config(RoleConfig::Master(master_config())).slots[0];
    vec![SlotConfig { id: 2, offset: Span::from_micros(700), joint: Some(0), ..own }, own]
}

fn slave_with(slots: Vec<SlotConfig>, rounds: u32) -> Tdma {
    let role = RoleConfig::Slave(SlaveConfig { rounds, ..SlaveConfig::default() });
    Tdma::new(&TdmaConfig { slots, ..config(role) }).unwrap()
}

/// One that has heard cycles 1 and 2.
fn locked() -> Tdma {
    let mut slave = slave_with(slots(), 0);
    hear_syncs(&mut slave, 1..=2);
    assert!(slave.next_transmission(at(2_340)).is_none());
    slave
}

#[test]
fn a_frame_waits_for_the_nearest_slot_of_its_queue() {
    let pool = Pool::new(3);
    let mut slave = locked();
    queue(&mut slave, &pool, 60);
    queue(&mut slave, &pool, 61);
    assert_eq!(sent_next(&mut slave), at(2_400));
    assert_eq!(sent_next(&mut slave), at(2_700), "though it was queued for slot 0");
    let mut frame = pool.take().unwrap();
    frame.fill(&[0; 60]);
    slave.enqueue(frame, Priority::DEFAULT, 2).unwrap();
    hear_syncs(&mut slave, 3..=3);
    assert_eq!(sent_next(&mut slave), at(3_400), "though it was queued for slot 2");
    let sent = slave.status().slots.map(|slot| slot.map(|slot| (slot.config.id, slot.sent)));
    assert_eq!(sent[..3], [Some((0, 2)), Some((2, 1)), None]);
}

#[test]
fn a_frame_that_missed_a_joint_slot_leaves_in_the_next_of_its_queue() {
    let pool = Pool::new(1);
    let mut slave = locked();
    queue(&mut slave, &pool, 60);
    let missed = slave.next_transmission(at(2_350)).unwrap();
    let late = slave.on_sent(Sent::Late(at(2_421), missed.frame)).unwrap();
    slave.put_back(late);
    assert_eq!(sent_next(&mut slave), at(2_700));
}

#[test]
fn a_slot_that_others_are_joined_to_changes_with_them_once_their_turns_have_passed() {
    let pool = Pool::new(4);
    let mut slave = locked();
    (0..4).for_each(|_| queue(&mut slave, &pool, 60));
    let grown = SlotConfig { size: 200, ..slots()[1] };
    assert_eq!(slave.command(at(2_100), &mut TdmaCommand::set_slot(grown)), Ok(3));
    assert_eq!([sent_next(&mut slave), sent_next(&mut slave)], [at(2_400), at(2_700)], "as they were");
    hear_syncs(&mut slave, 3..=4);
    assert_eq!(
        [sent_next(&mut slave), sent_next(&mut slave)],
        [at(3_400), at(4_400)],
        "slot 2 is on its own"
    );
    assert_eq!([slave.payload_limit(0), slave.payload_limit(2)], [Ok(200), Ok(100)]);
    let detached = core::iter::from_fn(|| slave.next_event()).find(|e| e.kind == EventKind::JointDetached);
    assert_eq!(detached.map(|event| (event.cycle, event.slot)), Some((3, Some(2))));
    let Counters { joints_detached, returned_dropped, .. } = slave.status().counters;
    assert_eq!((joints_detached, returned_dropped), (1, 0));
}

#[test]
fn what_cannot_be_joined_or_removed_is_refused_and_nothing_changes() {
    let mut slave = locked();
    let [joint, own] = slots()[..] else { panic!() };
    let before = slave.status();
    for (mut command, refused) in [
        (TdmaCommand::RemoveSlot(0), Refused::JoinedTo { id: 0, by: 2 }),
        (TdmaCommand::RemoveSlot(1), Refused::Alias),
        (
            TdmaCommand::set_slot(SlotConfig { joint: Some(2), ..own }),
            Refused::JointRound { id: 0, joint: 2 },
        ),
        (
            TdmaCommand::set_slot(SlotConfig { joint: Some(1), ..joint }),
            Refused::JointUndefined { id: 2, joint: 1 },
        ),
        (
            TdmaCommand::set_slot(SlotConfig { size: 99, ..joint }),
            Refused::JointSize { id: 2, size: 99, joint: 0, other: 100 },
        ),
    ] {
        assert_eq!(slave.command(at(2_100), &mut command), Err(refused));
    }
    assert_eq!(slave.status(), before);
    let alone = vec![SlotConfig { joint: Some(3), ..own }];
    let role = RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() });
    let refused = Tdma::new(&TdmaConfig { slots: alone, ..config(role) }).err();
    assert_eq!(refused, Some(Refused::JointUndefined { id: 0, joint: 3 }));
}

#[test]
fn a_slot_that_would_take_the_one_along_in_which_a_slave_calibrates_stays_for_the_while() {
    let [joint, own] = slots()[..] else { panic!() };
    let slots = vec![SlotConfig { joint: Some(2), ..own }, SlotConfig { joint: None, ..joint }];
    let mut slave = slave_with(slots.clone(), 5);
    hear_syncs(&mut slave, 1..=2);
    assert_eq!(slave.time().state, SyncState::Calibrating);
    let smaller = SlotConfig { size: 60, ..slots[1] };
    let refused = slave.command(at(2_100), &mut TdmaCommand::set_slot(smaller));
    assert_eq!(refused, Err(Refused::Calibrating { id: 0 }));
    let moved = SlotConfig { offset: Span::from_micros(800), ..slots[1] };
    assert!(slave.command(at(2_100), &mut TdmaCommand::set_slot(moved)).is_ok(), "slot 0 stays what it is");
}
