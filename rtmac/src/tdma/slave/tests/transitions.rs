//! Every state of a slave, with its sub-states, against everything that can happen to it: the table is `expected.rs`, that
//! of a slave without a filter `overwritten.rs`, how a slave gets to a place `places.rs`, how things happen to it
//! `happenings.rs`.

mod expected;
mod happenings;
mod overwritten;
mod places;

use super::*;
use crate::tdma::RoleName;
use crate::tdma::tests::every::every;

every! {
    /// What the protocol tells apart: how far it is, with nothing, with one Synchronisation, with a line, or with one that is
    /// doubted.
    enum State {
        WaitingForAny,
        WaitingForSecond,
        Calibrating,
        CalibratingInDoubt,
        Locked,
        LockedInDoubt,
        Holdover,
        HoldoverInDoubt,
        Lost,
        LostInDoubt,
        LostForAny,
        LostForSecond,
    }
}

/// A new state, or one more of what it may know of a line, has no name here, and then no place. `None`: none is ever so.
fn state_of(slave: &Slave) -> Option<State> {
    use SyncState::*;
    let state = match (slave.state, &slave.track) {
        (Waiting, Track::Nothing) => State::WaitingForAny,
        (Waiting, Track::First(_)) => State::WaitingForSecond,
        (Calibrating, Track::On { line: _, step: None }) => State::Calibrating,
        (Calibrating, Track::On { line: _, step: Some(_) }) => State::CalibratingInDoubt,
        (Locked, Track::On { line: _, step: None }) => State::Locked,
        (Locked, Track::On { line: _, step: Some(_) }) => State::LockedInDoubt,
        (Holdover, Track::On { line: _, step: None }) => State::Holdover,
        (Holdover, Track::On { line: _, step: Some(_) }) => State::HoldoverInDoubt,
        (Lost, Track::On { line: _, step: None }) => State::Lost,
        (Lost, Track::On { line: _, step: Some(_) }) => State::LostInDoubt,
        (Lost, Track::Nothing) => State::LostForAny,
        (Lost, Track::First(_)) => State::LostForSecond,
        // Who has a line waits no more, and who has none is at the begin or lost.
        (Waiting, Track::On { .. }) => return None,
        (Calibrating | Locked | Holdover, Track::Nothing | Track::First(_)) => return None,
    };
    Some(state)
}

every! {
    /// Where a slave can be: its state, and what it knows or doubts besides.
    enum Place {
        /// Waiting: nothing was heard.
        Nothing,
        /// Waiting: one Synchronisation was heard.
        First,
        Calibrating,
        /// The same, and nothing will be bridged as configured.
        CalibratingUnbridged,
        /// Calibrating: the last Synchronisation was early.
        CalibratingMoved,
        Locked,
        /// Locked, and nothing is bridged as configured.
        Unbridged,
        /// Locked, and the delay is measured anew.
        Anew,
        /// Locked: the number of this cycle came twice.
        Doubled,
        /// Locked: the last Synchronisation was late as if it had been held up.
        HeldUp,
        /// Holdover: the last two were, by as much.
        HeldUpTwice,
        /// Locked: the last Synchronisation was early.
        Moved,
        Holdover,
        /// Holdover, with two more cycles that are bridged as configured.
        Bridging,
        Lost,
        /// Lost: one Synchronisation was heard since, and it was early.
        LostMoved,
        /// Lost: all but one of the late Synchronisations were heard that are a later line.
        LostLate,
        /// Lost, and not calibrated yet.
        LostUncalibrated,
        /// Lost: its line was too old, and given up.
        GivenUp,
        /// The same, and one Synchronisation was heard since.
        GivenUpFirst,
    }
}

every! {
    /// What can happen.
    enum Happening {
        /// The next Synchronisation, in time.
        NextSync,
        /// The same from another master.
        AnothersSync,
        /// The next one, late by as much as a hold-up explains.
        HeldUpSync,
        /// The next one, early.
        JumpedSync,
        /// One in time whose number is of another count.
        RenumberedSync,
        /// The last number once more.
        RepeatedSync,
        /// The last one once more, as a backup says it that has not heard it.
        BackupsRepeat,
        /// One whose times cannot be meant.
        ImplausibleSync,
        /// The reply that was asked for, of the last round.
        Reply,
        /// A reply to something else.
        ForeignReply,
        /// The reply that was asked for, with stamps that cannot be.
        ImplausibleReply,
        /// Time, from the last Synchronisation that was due.
        HalfACycle,
        OneCycleMore,
        TwoCyclesMore,
        AThousandCyclesMore,
        /// As the follower of a master: it is to begin anew.
        Forget,
        /// As the follower of a master that gave the time until now.
        Resume,
        /// Commands: to take no part, and to be a slave again after that; to give the time, or to stand by for that.
        Detach,
        DetachAndAttach,
        BecomePrimary,
        BecomeBackup,
    }
}

/// What comes of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Answer {
    Nothing,
    Sync(Followed),
    Calibrated,
    Refused(Refusal),
    /// The station is something else from now on, and whoever asked has the slave back.
    Becomes(RoleName),
}

/// The state that it is in then, what it answers, and what it tells of.
type Outcome = (SyncState, Answer, Vec<EventKind>);

const AGREES: Answer = Answer::Sync(Followed::Agrees);
const NEW_LINE: Answer = Answer::Sync(Followed::NewLine);
const PENDING: Answer = Answer::Sync(Followed::Pending);

const BACKUP: Address = Address([2, 0, 0, 0, 0, 7]);
const HELD_UP: i64 = 200_000;
const JUMPED: i64 = -400_000;

/// A slave in its place, with the last cycle that it heard of and the next that is due.
struct Seat {
    bench: Bench,
    heard: u32,
    next: u32,
}

fn check(servo: Servo, expected: impl Fn(Happening, Place) -> Outcome) {
    for &place in Place::ALL {
        for &happening in Happening::ALL {
            let mut seat = place.take(servo);
            let (answer, cycle) = seat.meet(happening);
            let Bench { slave, .. } = &seat.bench;
            assert!(state_of(slave).is_some(), "{happening:?} while {place:?}");
            let (state, sends) = (slave.state(), slave.may_send(cycle));
            let told: Vec<EventKind> = seat.bench.told().into_iter().map(|(_, kind)| kind).collect();
            assert_eq!((state, answer, told), expected(happening, place), "{happening:?} while {place:?}");
            let silent = matches!(state, SyncState::Waiting | SyncState::Lost);
            assert!(!(silent && sends), "{happening:?} while {place:?}: it sends while {state:?}");
        }
    }
}

#[test]
fn every_state_answers_every_event() {
    check(Servo::Linear, expected::expected);
}

#[test]
fn every_state_without_a_filter_answers_every_event() {
    check(Servo::None, overwritten::expected);
}

#[test]
fn every_state_of_a_slave_is_a_place_of_its_table() {
    for &state in State::ALL {
        let is_there = Place::ALL.iter().any(|place| place.state(Servo::Linear) == state);
        assert!(is_there, "no place is {state:?}");
    }
}
