//! What may be sent when, what is refused, and who is believed.

use rtnet::counters::Refusal;

use super::super::hear::is_later;
use super::*;

#[test]
fn of_what_masters_know_that_are_not_sure_that_counts_which_is_furthest_on() {
    let mut seat = Seat::at(Place::FollowsSwitched);
    let before = seat.change.told;
    for state in [State::Idle, State::Committed, State::Sealed, State::Cancelled] {
        seat.hear_of(state, NOW, false);
        assert_eq!(
            seat.change.told,
            Status { is_sure: false, ..before },
            "it knows of the switch, {state:?} does not"
        );
    }
    seat.hear(State::Idle, NOW);
    assert_eq!(seat.change.told.oper, ScheduleId::default(), "who is sure is believed");

    let mut seat = Seat::at(Place::LeadsUnsure);
    let id = seat.id();
    let switched = Status { oper: id, admin: id, activation: NOW, state: State::Switched, is_sure: false };
    let known = |seat: &Seat| (seat.change.told.oper, seat.change.told.is_sure);
    seat.change.overhear(switched);
    assert_eq!(known(&seat), (id, false));
    seat.change.overhear(Status { is_sure: false, ..seat.change.told });
    (0..ALONE).for_each(|_| _ = seat.speak());
    assert_eq!(
        known(&seat),
        (ScheduleId::default(), true),
        "it has nothing of that schedule: all go back to its own"
    );
}

#[test]
fn a_master_that_hears_another_be_sure_of_something_else_is_not_sure_any_more() {
    let mut seat = Seat::at(Place::LeadsIdle);
    let id = seat.id();
    let idle = seat.change.told;
    seat.change.overhear(idle);
    assert!(seat.speak().is_sure, "that is the same");
    seat.change.overhear(Status {
        oper: id,
        admin: id,
        activation: NOW,
        state: State::Switched,
        is_sure: true,
    });
    assert!(!seat.speak().is_sure);
    assert!(!seat.change.may_send(seat.cycle, true));
}

#[test]
fn numbers_of_changes_go_round_and_leave_0_out() {
    assert!(is_later(1, 0) && !is_later(0, 1) && is_later(2, 1) && !is_later(1, 2) && !is_later(1, 1));
    assert!(is_later(1, u16::MAX) && is_later(u16::MAX, 0) && !is_later(0, u16::MAX));
    let mut seat = Seat::new();
    let id = ScheduleId { number: u16::MAX, sum: 1 };
    let status = Status {
        oper: ScheduleId::default(),
        admin: id,
        activation: NOW,
        state: State::Cancelled,
        is_sure: true,
    };
    seat.change.hear(seat.cycle.wrapping_add(1), Some(status));
    seat.cycle = seat.cycle.wrapping_add(1);
    seat.speak();
    seat.propose(None).unwrap();
    assert_eq!(seat.change.told.admin.number, 1);
}

#[test]
fn a_schedule_is_used_only_where_who_gives_the_time_has_named_it_and_never_across_an_activation() {
    // Heard in a cycle; may be sent so many cycles later.
    let at = |state, activation: u32, later: u32| {
        let mut seat = Seat::new();
        seat.hear(state, NOW.wrapping_add(1).wrapping_add(activation));
        seat.change.may_send(seat.cycle.wrapping_add(later), true)
    };
    for later in 0..4 {
        assert!(at(State::Idle, 2, later), "{later} cycles later, nothing is pending");
        assert!(at(State::Proposed, 2, later), "nobody is committed");
        for named in [State::Committed, State::Sealed, State::Cancelled] {
            assert_eq!(at(named, 2, later), later < 2, "{named:?} to the second, {later} cycles later");
        }
        assert!(!at(State::Switched, 0, later), "another schedule than its own");
    }
    assert!(!Seat::new().change.may_send(NOW, true), "nothing was heard");
    let mut seat = Seat::at(Place::FollowsIdle);
    seat.hear_of(State::Idle, 0, false);
    assert!(
        (0..4).all(|later| !seat.change.may_send(seat.cycle.wrapping_add(later), true)),
        "nobody is sure"
    );
}

#[test]
fn two_masters_that_say_different_things_in_one_cycle_silence_it() {
    let mut seat = Seat::at(Place::FollowsIdle);
    let cycle = seat.cycle;
    assert!(seat.change.may_send(cycle, true));
    let other = Status {
        oper: seat.id(),
        admin: seat.id(),
        activation: cycle,
        state: State::Switched,
        is_sure: true,
    };
    seat.change.hear(cycle, Some(other));
    assert!(!seat.change.may_send(cycle, true));
    seat.hear(State::Idle, 0);
    assert!(seat.change.may_send(seat.cycle, true));
}

#[test]
fn a_master_that_says_nothing_of_schedules_silences_who_waits_for_it() {
    let mut seat = Seat::at(Place::FollowsIdle);
    seat.change.hear(seat.cycle.wrapping_add(1), None);
    assert!(!seat.change.may_send(seat.cycle.wrapping_add(1), true));
}

#[test]
fn an_answer_is_repeated_ever_more_seldom_until_the_master_goes_on() {
    let mut seat = Seat::at(Place::FollowsProposed);
    let mut turns = Vec::new();
    for turn in 0..60 {
        if let Some(answer) = seat.change.answer(true) {
            seat.change.answers(&answer);
            turns.push(turn);
        }
        seat.change.turn_is_over();
    }
    assert_eq!(turns, [0, 2, 6, 14, 30, 46]);
    seat.hear(State::Committed, NOW.wrapping_add(90));
    assert!(seat.change.answer(true).is_some(), "at once");
}

#[test]
fn what_cannot_be_proposed_is_refused_by_name() {
    use super::super::super::Refused;
    let all = [OWN, BACKUP, SLAVE];
    let mut seat = Seat::at(Place::FollowsIdle);
    assert_eq!(seat.propose(None), Err(Refused::NotActing));
    let mut seat = Seat::at(Place::LeadsAsking);
    assert_eq!(seat.propose(None), Err(Refused::ChangePending { number: 1 }));
    let mut seat = Seat::at(Place::LeadsIdle);
    let at = seat.cycle.wrapping_add(10);
    let (now, least) = (seat.cycle, AHEAD_AT_LEAST + DEAF);
    assert_eq!(seat.propose(Some(Activation::At(at))), Err(Refused::ActivationTooNear { at, now, least }));
    assert_eq!(seat.change.activate(now, Activation::Soon), Err(Refused::NothingProposed));
    let mut seat = Seat::at(Place::LeadsSealed);
    let at = seat.change.told.activation;
    assert_eq!(seat.change.cancel(seat.cycle), Err(Refused::AlreadySealed { at }));
    let mut change = Change::new(&config(&[OWN, BACKUP], &[OWN, SLAVE]), 7);
    change.say(NOW, true);
    let refused = change.propose(NOW, OWN, &book(50, &all), None);
    assert_eq!(refused, Err(Refused::MasterWithoutSlot { station: BACKUP }));
}

#[test]
fn who_stopped_a_change_and_why_is_told() {
    let stopped = |place, happening| {
        let mut seat = Seat::at(place);
        seat.meet(happening);
        seat.change.status().stopped
    };
    let silent = stopped(Place::LeadsAsking, Happening::SpeaksMuchLater);
    assert!(matches!(silent, Some(Stopped::Silent { station: BACKUP, .. })), "{silent:?}");
    let refused = Stopped::Refused { station: SLAVE, why: Why::SlotId, slot: 9 };
    assert_eq!(stopped(Place::LeadsReady, Happening::OneRefuses), Some(refused));
    let unconfirmed = stopped(Place::LeadsCommitted, Happening::SpeaksMuchLater);
    assert!(matches!(unconfirmed, Some(Stopped::Unconfirmed { station: BACKUP, .. })), "{unconfirmed:?}");
    assert_eq!(stopped(Place::FollowsProposed, Happening::Speaks), Some(Stopped::MasterChanged));
    assert_eq!(stopped(Place::LeadsReady, Happening::Cancel), Some(Stopped::Asked));
}

#[test]
fn who_slept_through_a_switch_uses_what_it_has_before_it_collects_another() {
    let mut seat = Seat::at(Place::FollowsSealed);
    let (oper, now) = (seat.id(), seat.cycle.wrapping_add(100));
    let admin = ScheduleId { number: 2, sum: 7 };
    let status = Status { oper, admin, activation: now, state: State::Proposed, is_sure: true };
    let switch = seat.change.hear(now, Some(status));
    assert_eq!(switch, Some(Switch { from: now, to: oper }));
    seat.change.switch(oper, [slot(100)].into_iter(), None);
    assert_eq!(seat.change.hear(now.wrapping_add(1), Some(status)), None);
    assert_eq!(seat.change.admin().id(), admin, "it is collected from then on");
    assert!(seat.change.may_send(now.wrapping_add(1), true));
}

#[test]
fn no_part_is_sent_before_a_sync_has_named_its_schedule() {
    let mut seat = Seat::at(Place::LeadsIdle);
    seat.cycle = seat.cycle.wrapping_add(1);
    seat.change.say(seat.cycle, true);
    // Its sync waits for its instant meanwhile.
    seat.propose(Some(Activation::Soon)).unwrap();
    seat.change.spoke(seat.cycle);
    (0..8).for_each(|_| seat.change.part_is_owed());
    let part = |seat: &Seat| seat.change.part_in_turn().or(seat.change.part_for(0)).map(|part| part.id);
    assert_eq!(part(&seat), None, "nobody would take it");
    seat.speak();
    assert_eq!(part(&seat), Some(seat.id()));
}

#[test]
fn a_late_answer_is_not_unknown_after_the_switch() {
    let mut seat = Seat::at(Place::LeadsReady);
    let digest = seat.change.admin.digest();
    let answer = Answer { id: seat.id(), digest, verdict: Verdict::Acknowledged, gives_time: false };
    let other = Answer { digest: digest + 1, ..answer };
    let heard = |seat: &mut Seat, answer: &Answer| seat.change.on_answer(seat.cycle, SLAVE, answer);
    assert_eq!(heard(&mut seat, &other), Err(Refusal::ScheduleUnknown), "another schedule of that number");
    let mut seat = Seat::at(Place::LeadsSwitched);
    let switch = seat.change.begins(seat.cycle).unwrap();
    seat.change.switch(switch.to, core::iter::empty(), None);
    assert_eq!(heard(&mut seat, &answer), Ok(()));
    let unknown = Answer { id: ScheduleId { number: 9, sum: 9 }, ..answer };
    assert_eq!(heard(&mut seat, &unknown), Err(Refusal::ScheduleUnknown));
}
