//! Replies and calls in virtual time.

use super::calls::{Call, Calls, Next};
use super::*;
use crate::wire::{ERROR, NOT_AVAILABLE, OK, TIMEOUT};
use proptest::collection::vec;
use proptest::prelude::*;

const OWN: MailboxName = MailboxName(0x0018_0001);
const SERVER: MailboxName = MailboxName(0x0012_0000);
const OTHER: MailboxName = MailboxName(0x0013_0000);
const MS: u64 = 1_000_000;

fn calls(most: usize) -> Calls {
    Calls::new(OWN, SERVER, most, 8)
}

fn reply(from: MailboxName, kind: i8, id: u8) -> Head {
    Head { id, priority: 7, ..Head::new(kind, OWN, from) }
}

/// A package comes, with this body.
fn comes(calls: &mut Calls, head: Head, now: u64, body: &[u8]) {
    let head = head.with_body(body.len()).unwrap();
    calls.on_package(&head, now, |room| {
        room[..body.len()].copy_from_slice(body);
        body.len()
    });
}

fn answered(calls: &mut Calls, call: Call) -> Result<Vec<u8>, CallError> {
    calls.reply(call).map(|reply| reply.body().to_vec())
}

#[test]
fn replies_in_any_order_reach_the_calls_whose_they_are() {
    let mut calls = calls(3);
    let begun = [10, 20, 30].map(|now| calls.begin(now).unwrap());
    for at in [2, 0, 1] {
        comes(&mut calls, reply(SERVER, -6, begun[at].id()), 100, &[at as u8; 5]);
    }
    for (at, call) in begun.into_iter().enumerate() {
        let took = 90 - 10 * at as u64;
        let reply = calls.reply(call).unwrap();
        assert_eq!((reply.kind(), reply.head().priority, reply.took()), (-6, 7, took));
        assert_eq!(reply.body(), [at as u8; 5]);
    }
    assert_eq!((calls.open(), calls.dropped()), (0, Dropped::default()));
}

#[test]
fn who_waits_is_told_how_long_yet_and_when_it_is_over() {
    let mut calls = calls(2);
    let (first, second) = (calls.begin(0).unwrap(), calls.begin(0).unwrap());
    let next = |calls: &Calls, now| calls.next(&first, 5 * MS, now);
    assert_eq!(next(&calls, 0), Ok(Next::Wait(Duration::from_millis(5))));
    comes(&mut calls, reply(SERVER, OK, second.id()), MS, &[]);
    assert_eq!(next(&calls, 4 * MS), Ok(Next::Wait(Duration::from_millis(1))), "it was another's");
    assert_eq!(next(&calls, 5 * MS - 1), Ok(Next::Wait(Duration::from_nanos(1))));
    assert_eq!(next(&calls, 5 * MS), Ok(Next::Over));
    assert_eq!(next(&calls, u64::MAX), Ok(Next::Over));
    comes(&mut calls, reply(SERVER, OK, first.id()), 6 * MS, &[]);
    assert_eq!(next(&calls, 6 * MS), Ok(Next::Answered), "it has come before anybody gave up");
}

#[test]
fn a_reply_that_is_late_or_doubled_or_not_asked_for_is_counted_and_dropped() {
    let mut calls = calls(2);
    let (late, twice) = (calls.begin(0).unwrap(), calls.begin(0).unwrap());
    let (late_id, twice_id) = (late.id(), twice.id());
    calls.give_up(&late);
    comes(&mut calls, reply(SERVER, OK, late_id), MS, b"late");
    assert_eq!(calls.dropped(), Dropped { late: 1, ..Dropped::default() });
    // From somebody else, a command of the server's, and to no call.
    comes(&mut calls, reply(OTHER, OK, twice_id), MS, b"forged");
    comes(&mut calls, reply(SERVER, 5, twice_id), MS, b"asks");
    comes(&mut calls, reply(SERVER, OK, 0), MS, b"no call");
    comes(&mut calls, reply(SERVER, OK, 200), MS, b"no call");
    assert_eq!(calls.dropped().unasked, 4);
    assert_eq!(calls.next(&twice, 2 * MS, MS), Ok(Next::Wait(Duration::from_millis(1))));
    comes(&mut calls, reply(SERVER, OK, twice_id), MS, b"once");
    comes(&mut calls, reply(SERVER, OK, twice_id), MS, b"twice");
    assert_eq!(answered(&mut calls, twice), Ok(b"once".to_vec()), "the first one counts");
    comes(&mut calls, reply(SERVER, OK, twice_id), MS, b"thrice");
    assert_eq!(calls.dropped(), Dropped { late: 1, doubled: 2, unasked: 4 });
}

#[test]
fn what_a_server_cannot_do_is_told_from_what_it_has_not_said() {
    let mut calls = calls(1);
    let told = [
        (ERROR, CallError::Failed(SERVER)),
        (TIMEOUT, CallError::NotInTime(SERVER)),
        (NOT_AVAILABLE, CallError::NotAvailable(SERVER)),
    ];
    for (kind, error) in told {
        let call = calls.begin(0).unwrap();
        comes(&mut calls, reply(SERVER, kind, call.id()), MS, b"why");
        assert_eq!(answered(&mut calls, call), Err(error));
    }
    let call = calls.begin(0).unwrap();
    assert_eq!(answered(&mut calls, call), Err(CallError::TimedOut(SERVER)));
    for kind in [OK, -4, -128] {
        let call = calls.begin(0).unwrap();
        comes(&mut calls, reply(SERVER, kind, call.id()), MS, b"fine");
        assert_eq!(calls.reply(call).unwrap().kind(), kind);
    }
    assert_eq!((calls.open(), calls.dropped()), (0, Dropped::default()));
}

#[test]
fn one_call_too_many_is_refused_and_fits_once_another_is_over() {
    let mut calls = calls(MOST_CALLS);
    let mut begun: Vec<_> = (0..MOST_CALLS).map(|_| calls.begin(0).unwrap()).collect();
    assert_eq!(calls.begin(0).err(), Some(CallError::TooMany(MOST_CALLS)));
    // An answer alone makes no room: it is kept.
    comes(&mut calls, reply(SERVER, OK, begun[3].id()), MS, b"kept");
    assert_eq!(calls.begin(0).err(), Some(CallError::TooMany(MOST_CALLS)));
    assert_eq!(answered(&mut calls, begun.remove(3)), Ok(b"kept".to_vec()));
    let call = calls.begin(0).unwrap();
    assert_eq!(calls.begin(0).err(), Some(CallError::TooMany(MOST_CALLS)));
    calls.give_up(&call);
    assert!(calls.begin(0).is_ok());
    assert!(Calls::new(OWN, SERVER, 1_000, 8).begin(0).is_ok());
}

#[test]
fn ids_come_round_after_255_calls_and_pass_over_those_that_are_open() {
    let mut calls = calls(2);
    let open = calls.begin(0).unwrap();
    assert_eq!(open.id(), 1);
    let mut ids = Vec::new();
    for count in 0..3 * 254u32 {
        let call = calls.begin(0).unwrap();
        ids.push(call.id());
        comes(&mut calls, reply(SERVER, OK, call.id()), 0, &count.to_le_bytes());
        assert_eq!(answered(&mut calls, call), Ok(count.to_le_bytes().to_vec()));
    }
    let round: Vec<u8> = (2..=255).collect();
    assert_eq!(ids, round.repeat(3), "neither 0 nor the open one's");
    comes(&mut calls, reply(SERVER, OK, open.id()), 9, b"at last");
    assert_eq!(answered(&mut calls, open), Ok(b"at last".to_vec()));
    let call = calls.begin(0).unwrap();
    assert_eq!(call.id(), 1, "it is free again");
}

#[test]
fn a_call_is_its_own_proxys_and_over_once() {
    let (mut ours, mut theirs) = (calls(2), Calls::new(OTHER, SERVER, 2, 8));
    let (call, other) = (ours.begin(0).unwrap(), theirs.begin(0).unwrap());
    assert_eq!(call.id(), other.id());
    comes(&mut ours, reply(SERVER, OK, call.id()), 0, b"ours");
    assert_eq!(ours.next(&other, MS, 0), Err(CallError::NotOpen));
    ours.give_up(&other);
    assert_eq!(answered(&mut ours, other), Err(CallError::NotOpen));
    assert_eq!(answered(&mut ours, call), Ok(b"ours".to_vec()));
}

#[test]
fn a_record_is_read_in_the_order_of_who_wrote_it() {
    let body = 1_000u32.to_be_bytes();
    let head = Head { body_order: crate::wire::Endian::Big, ..reply(SERVER, OK, 1) };
    let reply = Reply { head, body: &body, took: 0 };
    assert_eq!(reply.record::<u32>(), Ok(1_000));
    assert_eq!(reply.record::<()>(), Err(BodyError::WrongLen { expected: 0, got: 4 }));
}

/// What happens: a call is begun; of those in flight one, by its place, is answered, answered again, or given up.
#[derive(Clone, Copy, Debug)]
enum Event {
    Begin,
    Answer(usize),
    FromAnother(usize),
    Finish(usize),
    GiveUp(usize),
    Repeat(u8),
}

fn event() -> impl Strategy<Value = Event> {
    let place = 0..MOST_CALLS;
    prop_oneof![
        4 => Just(Event::Begin),
        3 => place.clone().prop_map(Event::Answer),
        1 => place.clone().prop_map(Event::FromAnother),
        3 => place.clone().prop_map(Event::Finish),
        1 => place.prop_map(Event::GiveUp),
        1 => any::<u8>().prop_map(Event::Repeat),
    ]
}

proptest! {
    // Each of them lets ids come round.
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases / 4))]

    /// Whatever comes in whatever order: nobody has another's reply, no two open calls have one id, and all that came is either
    /// somebody's reply or counted.
    #[test]
    fn no_call_has_anothers_reply(events in vec(event(), 0..1_500)) {
        let mut calls = calls(MOST_CALLS);
        // Of each call what it is to be answered with, and whether it was.
        let mut open: Vec<(Call, u64, bool)> = Vec::new();
        let (mut count, mut kept, mut came) = (0u64, 0u64, 0u64);
        for event in events {
            match event {
                Event::Begin => match calls.begin(count) {
                    Ok(call) => {
                        prop_assert!(call.id() != 0 && open.iter().all(|(other, ..)| other.id() != call.id()));
                        count += 1;
                        open.push((call, count, false));
                    }
                    Err(error) => {
                        prop_assert_eq!(error, CallError::TooMany(MOST_CALLS));
                        prop_assert_eq!(open.len(), MOST_CALLS);
                    }
                },
                Event::Answer(at) if at < open.len() => {
                    let (call, number, is_answered) = &mut open[at];
                    // A second answer says something else.
                    let says = if *is_answered { u64::MAX } else { *number };
                    comes(&mut calls, reply(SERVER, OK, call.id()), count, &says.to_le_bytes());
                    (kept, came) = (kept + u64::from(!*is_answered), came + 1);
                    *is_answered = true;
                }
                Event::FromAnother(at) if at < open.len() => {
                    comes(&mut calls, reply(OTHER, OK, open[at].0.id()), count, &[0xff; 8]);
                    came += 1;
                }
                Event::Finish(at) if at < open.len() => {
                    let (call, number, is_answered) = open.swap_remove(at);
                    let expected = is_answered.then(|| number.to_le_bytes().to_vec());
                    prop_assert_eq!(answered(&mut calls, call), expected.ok_or(CallError::TimedOut(SERVER)));
                }
                Event::GiveUp(at) if at < open.len() => {
                    let (call, ..) = open.swap_remove(at);
                    calls.give_up(&call);
                }
                Event::Repeat(id) if open.iter().all(|(call, ..)| call.id() != id) => {
                    comes(&mut calls, reply(SERVER, OK, id), count, &[0xee; 8]);
                    came += 1;
                }
                _ => {}
            }
            prop_assert_eq!(calls.open(), open.len());
        }
        let Dropped { late, doubled, unasked } = calls.dropped();
        prop_assert_eq!(kept + late + doubled + unasked, came);
    }
}
