//! The slot that calibration uses: what it must be like.

use super::*;

#[test]
fn a_first_slot_in_which_no_master_would_reply_is_refused() {
    let request = |reply_cycle| Message::Request { xmit: 0, reply_cycle, reply_offset: 0 };
    assert!(matches!(hear(&mut active_master(), OTHER, request(MAX_REPLY_AHEAD)), Claimed::Kept));
    let never = hear(&mut active_master(), OTHER, request(MAX_REPLY_AHEAD + 1));
    assert!(matches!(never, Claimed::Refused(Refusal::ReplyImplausible)), "a slave would ask for ever");

    let refused = Refused::NeverCalibrated { id: 1, period: 1_025 };
    assert_eq!(Tdma::new(&with_slots(1, &[(2, 1_024), (1, 1_025)])).err(), Some(refused));
    for (rounds, slots) in [(0, &[(1, 1_025)][..]), (1, &[(2, 1_024)]), (1, &[(0, 1), (1, 1_025)])] {
        assert!(Tdma::new(&with_slots(rounds, slots)).is_ok(), "{slots:?}");
    }
}

#[test]
fn no_command_leaves_a_slave_with_a_first_slot_in_which_no_master_would_reply() {
    let refused = Err(Refused::NeverCalibrated { id: 1, period: 1_025 });
    let set = TdmaCommand::set_slot(with_slots(1, &[(1, 1_025)]).slots[0]);
    let role = RoleConfig::Slave(SlaveConfig { rounds: 1, ..SlaveConfig::default() });
    let calibrate = TdmaCommand::Become(NewRole::attached(role).unwrap());
    for (rounds, slots, mut command) in [
        (1, &[(2, 1_024)][..], set),
        (1, &[(0, 1), (1, 1_025)], TdmaCommand::RemoveSlot(0)),
        (0, &[(1, 1_025)], calibrate),
    ] {
        let mut slave = Tdma::new(&with_slots(rounds, slots)).unwrap();
        assert_eq!(slave.command(at(0), &mut command), refused, "{slots:?}");
    }
}

#[test]
fn slots_that_are_about_to_go_do_not_count() {
    let mut slave = locked_slave();
    let other =
        SlotConfig { id: 2, offset: Span::from_micros(600), ..slave.status().slots[0].unwrap().config };
    slave.command(at(2_650), &mut TdmaCommand::set_slot(other)).unwrap();
    hear_syncs(&mut slave, 3..=3);
    // Both still have their turn in cycle 3.
    assert_eq!(slave.command(at(3_100), &mut TdmaCommand::RemoveSlot(2)), Ok(4));
    let error = slave.command(at(3_100), &mut TdmaCommand::RemoveSlot(0)).unwrap_err();
    assert!(matches!(error, Refused::LastSlot { id: 0 }), "{error}");
}
