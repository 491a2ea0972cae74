use super::*;

const SLOT: SlotRequest = SlotRequest { id: 2, offset_ns: 100_000, phase: 0, period: 1, size: 128 };

#[test]
fn a_request_reads_back() {
    let moved = SlotChange { id: 2, offset_ns: 1, phase: None, period: None, size: None };
    let set = [Request::SetSlot(SLOT.into()), Request::SetSlot(moved)];
    for request in set.into_iter().chain([Request::Status, Request::Become(RoleRequest::Detached)]) {
        assert_eq!(read::<Request>(&Envelope::pack(request.clone())), Ok(request));
    }
}

#[test]
fn what_is_not_given_of_a_slot_stays_as_it_was() {
    let whole = SlotRequest { phase: 1, period: 4, ..SLOT };
    let moved = SlotChange { id: 2, offset_ns: 7, phase: None, period: None, size: None };
    assert_eq!(moved.over(Some(&whole)), SlotRequest { offset_ns: 7, ..whole });
    assert_eq!(moved.over(None), SlotRequest { id: 2, offset_ns: 7, phase: 0, period: 1, size: 1500 });
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
