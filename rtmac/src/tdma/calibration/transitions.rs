//! Every state of a calibration against everything that can happen to it, at a slave as a whole, however that is configured:
//! the table is `expected.rs`, how a calibration gets to a place `places.rs`, how things happen to it `happenings.rs`.

mod expected;
mod happenings;
mod places;

use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Claimed, Discipline, EventKind, Sent, SyncState};
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::Address;

use super::Calibration;
use crate::tdma::tests::every::every;
use crate::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, NewRounds, OnMasterChange, Refused, Role, RoleConfig,
    Servo, SlaveConfig, SlotConfig, Tdma, TdmaCommand, TdmaConfig,
};
use crate::wire::{self, Message, Rtmac};
use expected::{expected, expected_delay};

const OWN: Address = Address([2, 0, 0, 0, 0, 1]);
const MASTER: Address = Address([2, 0, 0, 0, 0, 2]);
const BACKUP: Address = Address([2, 0, 0, 0, 0, 3]);
const SLOT: u64 = 400;
const ROUNDS: u32 = 2;
/// Three for each round, and 20.
const ATTEMPTS: u32 = 26;
/// How long a first round takes one way, and a last: a hold-up. The same when it is measured anew.
const DELAYS: [i64; 2] = [700, 1_100];
const DELAYS_ANEW: [i64; 2] = [1_700, 2_100];

every! {
    /// What the protocol tells apart.
    enum State {
        Idle,
        Outstanding,
        Done,
        AnewIdle,
        AnewOutstanding,
    }
}

/// Without `..`: whatever a calibration knows more tells states apart, or is said not to. `None`: none is ever so.
fn state_of(calibration: &Calibration) -> Option<State> {
    #[rustfmt::skip]
    let Calibration {
        is_measuring, delay, outstanding,
        // What is configured, what counts, and what was measured.
        rounds: _, servo: _, delay_of: _, wanted: _,
        room: _, attempts: _, tally: _, line: _, repeats: _,
        one: _, of_line: _, rate: _, done: _, report: _,
    } = calibration;
    match (is_measuring, delay, outstanding) {
        (true, None, None) => Some(State::Idle),
        (true, None, Some(_)) => Some(State::Outstanding),
        (false, Some(_), None) => Some(State::Done),
        (true, Some(_), None) => Some(State::AnewIdle),
        (true, Some(_), Some(_)) => Some(State::AnewOutstanding),
        // Who has no delay measures it, and who does not measure waits for no reply.
        (false, None, _) | (false, Some(_), Some(_)) => None,
    }
}

every! {
    /// Where a calibration can be.
    enum Place {
        /// There is no line to ask on.
        NoLine,
        Idle,
        /// The first of two rounds.
        Outstanding,
        /// The second, and last.
        LastOutstanding,
        /// As many requests as there may be had no reply; the last may still have one.
        Exhausted,
        Done,
        /// As configured, no round was needed.
        WithoutRounds,
        /// Done, and measured anew: the same again.
        Anew,
        AnewOutstanding,
        AnewLastOutstanding,
        AnewExhausted,
    }
}

every! {
    /// What can happen.
    enum Happening {
        /// A request is due, and this becomes of it.
        Sent,
        Stalled,
        Late,
        Guarded,
        Failed,
        /// The reply that is waited for, or would be if there were one.
        Reply,
        /// A reply to something else.
        ForeignReply,
        /// The reply that is waited for, with stamps that cannot be.
        ImplausibleReply,
        /// Two cycles without a Synchronisation.
        SyncLost,
        /// Two Synchronisations on another line.
        LineMoved,
        /// A Synchronisation of another master on the same line.
        MasterChanged,
        /// A command to measure anew.
        Command,
    }
}

/// What comes of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Answer {
    Nothing,
    /// A request was handed out.
    Asked,
    Kept,
    Refused(Refusal),
    Begun,
    /// It is being measured already.
    Busy,
}

/// How the slave follows.
#[derive(Clone, Copy, Debug)]
struct Config {
    servo: Servo,
    on_master_change: OnMasterChange,
}

/// So many samples, attempts and repeats.
type Counts = (usize, u32, u64);

/// Where it is then, with what counts; what it answers; what it tells of, if of calibration.
type Outcome = (State, Counts, Answer, Option<EventKind>);

/// A slave in its place, and the cycle that it is.
struct Seat {
    slave: Tdma,
    cycle: u32,
    /// When its last request left.
    asked: u64,
}

fn at(micros: u64) -> Instant {
    Instant::from_nanos(micros * 1_000)
}

fn check(config: Config) {
    for &place in Place::ALL {
        for &happening in Happening::ALL {
            let what = format!("{happening:?} while {place:?}, {config:?}");
            let mut seat = place.take(config);
            assert_eq!(seat.seen(), place.seen(), "{what}");
            let answer = seat.meet(happening);
            let (state, counts) = seat.seen();
            let told = seat.told_of_calibration();
            let (expected_state, expected_counts, expected_answer, expected_told) =
                expected(happening, place, config);
            let expected = (expected_state, expected_counts, expected_answer, Vec::from_iter(expected_told));
            assert_eq!((state, counts, answer, told), expected, "{what}");
            let delay = seat.calibration().delay().map(Span::nanos);
            assert_eq!(delay, expected_delay(happening, place, config.servo), "{what}");
        }
    }
}

#[test]
fn every_state_of_a_calibration_answers_every_event() {
    for servo in [Servo::Linear, Servo::None] {
        for on_master_change in [OnMasterChange::Keep, OnMasterChange::Repeat] {
            check(Config { servo, on_master_change });
        }
    }
}

#[test]
fn every_state_of_a_calibration_is_a_place_of_its_table() {
    for &state in State::ALL {
        assert!(Place::ALL.iter().any(|place| place.seen().0 == state), "no place is {state:?}");
    }
}
