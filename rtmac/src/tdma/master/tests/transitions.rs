//! Every phase of a primary and of a backup, with its sub-states, against everything that can happen to it: the table is
//! `expected.rs`, how a master gets to a place `places.rs`, how things happen to it `happenings.rs`.

mod expected;
mod happenings;
mod places;

use super::*;
use crate::tdma::RoleName;
use crate::tdma::tests::every::every;
use expected::expected;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Primary,
    Backup,
}

every! {
    /// What the protocol tells apart.
    enum State {
        Attached,
        Listening,
        Following,
        StandBy,
        Active,
        Yielded,
    }
}

/// A new phase has no name here, and then no place.
fn state_of(phase: &Phase) -> State {
    match phase {
        Phase::Attached => State::Attached,
        Phase::Listening { until: _ } => State::Listening,
        Phase::Following { until: _ } => State::Following,
        Phase::StandBy { passed: _ } => State::StandBy,
        Phase::Active { line: _ } => State::Active,
        Phase::Yielded { to: _ } => State::Yielded,
    }
}

every! {
    /// Where a master can be: its phase, and what it knows besides.
    enum Place {
        Attached,
        /// For the first time.
        Listening,
        /// It has lost whom it followed, and has the line.
        ListeningAgain,
        /// Following: one Synchronisation was heard.
        Unsure,
        /// Following another primary, locked.
        FollowingPrimary,
        /// Following a backup, locked.
        FollowingBackup,
        /// Following a backup, not calibrated yet.
        Calibrating,
        /// Following whom it has made way for, locked.
        Outlasted,
        StandBy,
        Active,
        /// Active, and has heard a primary of a lower address in two cycles.
        BesideRival,
        /// Active, and has heard a primary of a higher address in nine cycles.
        BesideHigher,
        Yielded,
    }
}

every! {
    /// What can happen.
    enum Happening {
        /// The next Synchronisation, as early as a primary's, as late as a backup's.
        PrimarysSync,
        BackupsSync,
        /// As early as a primary's, and of a higher address.
        HighersSync,
        /// A primary's, beside the line; and the next of that line, which is numbered otherwise.
        SyncBeside,
        TwoBeside,
        /// The instant of its own next one, if it has any; it leaves in time, held up, or not at all.
        OwnInTime,
        OwnHeldUp,
        OwnMissed,
        Request,
        /// The reply of the last round.
        Reply,
        /// A turn of the loop, with slots and without.
        Turn,
        TurnWithoutSlots,
        /// Time without a Synchronisation.
        TwoMissing,
        LongSilence,
        AThousandMissing,
        /// Commands: to take no part, to follow, and to be what it is from the begin.
        Detach,
        BecomeSlave,
        BecomeAnew,
    }
}

/// What comes of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Answer {
    Nothing,
    /// The Synchronisation is followed, or not.
    Follows(bool),
    /// The same, and its own next one is due in so many cycles, if it has one.
    Beside(bool, Option<i64>),
    /// It had a Synchronisation of its own to send.
    Speaks,
    /// Slots are to be aligned.
    Aligns,
    Promises,
    Calibrated,
    Refused(Refusal),
    /// The station is something else from now on, and whoever asked has the master back.
    Becomes(RoleName),
}

/// What it is doing then, what it answers, and what it tells of.
type Outcome = (Mastery, Answer, &'static [EventKind]);

/// A master in its place, and the cycle whose Synchronisation is due next.
struct Seat {
    bench: Bench,
    next: u32,
}

const KINDS: [Kind; 2] = [Kind::Primary, Kind::Backup];

#[test]
fn every_phase_answers_every_event() {
    for kind in KINDS {
        for &place in Place::ALL {
            for &happening in Happening::ALL {
                let Some(mut seat) = place.take(kind) else { continue };
                let answer = seat.meet(happening);
                let mastery = seat.bench.master.mastery();
                let told = seat.bench.told();
                let (expected_mastery, expected_answer, expected_told) = expected(happening, place, kind);
                let expected = (expected_mastery, expected_answer, expected_told.to_vec());
                assert_eq!((mastery, answer, told), expected, "{happening:?} of a {kind:?} while {place:?}");
            }
        }
    }
}

#[test]
fn every_phase_of_a_master_is_a_place_of_its_table() {
    let is_taken = |place: &Place| KINDS.into_iter().any(|kind| place.take(kind).is_some());
    for place in Place::ALL {
        assert!(is_taken(place), "no master is ever {place:?}");
    }
    for &state in State::ALL {
        assert!(Place::ALL.iter().any(|place| place.state() == state), "no place is {state:?}");
    }
}
