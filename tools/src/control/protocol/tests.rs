use super::*;

const SLOT: SlotRequest =
    SlotRequest { id: 2, offset_ns: 100_000, phase: 0, period: 1, size: 128, joint: None };
const MOVED: SlotChange =
    SlotChange { id: 2, offset_ns: 7, phase: None, period: None, size: None, joint: None };

#[test]
fn a_request_reads_back() {
    let joint = |joint| Request::SetSlot(SlotChange { joint, ..MOVED });
    let set = [Request::SetSlot(SLOT.into()), joint(None), joint(Some(None)), joint(Some(Some(0)))];
    let slave = RoleRequest::Slave {
        rounds: 7,
        servo: Some(ServoName::None),
        delay: Some(DelayName::Median),
        holdover: Some(20),
        on_master_change: Some(DelayPolicy::Repeat),
    };
    let calibrate = [None, Some(10)].map(|rounds| Request::Calibrate { rounds });
    let roles = [RoleRequest::Detached, slave].map(Request::Become);
    let others = [Request::Status].into_iter().chain(roles).chain(calibrate);
    for request in set.into_iter().chain(others) {
        assert_eq!(read::<Request>(&Envelope::pack(request.clone())), Ok(request));
    }
}

#[test]
fn what_is_not_given_of_a_slave_need_not_be_said() {
    let packet = br#"{"version":1,"body":{"become":{"slave":{"rounds":3}}}}"#;
    let (servo, delay, holdover, on_master_change) = (None, None, None, None);
    let slave = RoleRequest::Slave { rounds: 3, servo, delay, holdover, on_master_change };
    assert_eq!(read::<Request>(packet), Ok(Request::Become(slave)));
}

#[test]
fn what_is_not_given_of_a_slot_stays_as_it_was() {
    let whole = SlotRequest { phase: 1, period: 4, joint: Some(0), ..SLOT };
    assert_eq!(MOVED.over(Some(&whole)), SlotRequest { offset_ns: 7, ..whole });
    assert_eq!(MOVED.over(None), SlotRequest { offset_ns: 7, size: 1500, ..SLOT });
    let unjoined = SlotChange { joint: Some(None), ..MOVED };
    assert_eq!(unjoined.over(Some(&whole)), SlotRequest { offset_ns: 7, joint: None, ..whole });
    assert_eq!(SlotChange::from(SLOT).over(Some(&whole)), SLOT);
}

#[test]
fn what_is_no_request_is_refused_in_a_line() {
    for (packet, expected) in [
        ("", "unreadable"),
        ("{", "unreadable"),
        (r#"{"body":"status"}"#, "missing field `version`"),
        (r#"{"version":2,"body":"status"}"#, "version 2 is not spoken here, only 1"),
        (r#"{"version":1,"body":"reboot"}"#, "unknown variant `reboot`"),
        (r#"{"version":1,"body":{"set_slot":{"id":1}}}"#, "missing field `offset_ns`"),
        (r#"{"version":1,"body":"status","more":1}"#, "unknown field `more`"),
    ] {
        let error = read::<Request>(packet.as_bytes()).unwrap_err();
        assert!(error.contains(expected) && !error.contains('\n'), "{packet}: {error}");
    }
}

#[test]
fn every_shortened_request_is_refused() {
    let packet = Envelope::pack(Request::SetSlot(SLOT.into()));
    for end in 0..packet.len() {
        assert!(read::<Request>(&packet[..end]).is_err(), "{end}");
    }
}
