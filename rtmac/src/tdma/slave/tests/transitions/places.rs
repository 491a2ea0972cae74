//! How a slave gets to its places.

use super::*;

impl Place {
    /// Without a filter nothing is doubted: what would be is the line.
    pub(super) fn state(self, servo: Servo) -> State {
        let or = |doubted, as_it_says| match servo {
            Servo::Linear => doubted,
            Servo::None => as_it_says,
        };
        match self {
            Place::Nothing => State::WaitingForAny,
            Place::First => State::WaitingForSecond,
            Place::Calibrating | Place::CalibratingUnbridged => State::Calibrating,
            Place::CalibratingMoved => or(State::CalibratingInDoubt, State::Calibrating),
            Place::Locked | Place::Unbridged | Place::Anew | Place::Doubled => State::Locked,
            Place::HeldUp | Place::Moved => or(State::LockedInDoubt, State::Locked),
            Place::HeldUpTwice => or(State::HoldoverInDoubt, State::Locked),
            Place::Holdover | Place::Bridging => State::Holdover,
            Place::Lost | Place::LostUncalibrated => State::Lost,
            Place::LostMoved | Place::LostLate => or(State::LostInDoubt, State::Locked),
            Place::GivenUp => State::LostForAny,
            Place::GivenUpFirst => State::LostForSecond,
        }
    }

    pub(super) fn sync_state(self, servo: Servo) -> SyncState {
        match self.state(servo) {
            State::WaitingForAny | State::WaitingForSecond => SyncState::Waiting,
            State::Calibrating | State::CalibratingInDoubt => SyncState::Calibrating,
            State::Locked | State::LockedInDoubt => SyncState::Locked,
            State::Holdover | State::HoldoverInDoubt => SyncState::Holdover,
            State::Lost | State::LostInDoubt | State::LostForAny | State::LostForSecond => SyncState::Lost,
        }
    }

    fn config(self, servo: Servo) -> SlaveConfig {
        let rounds = match self {
            Place::Calibrating
            | Place::CalibratingUnbridged
            | Place::CalibratingMoved
            | Place::LostUncalibrated => 1,
            _ => 0,
        };
        let holdover = match self {
            Place::Unbridged | Place::CalibratingUnbridged => 0,
            Place::Bridging => 3,
            _ => 1,
        };
        SlaveConfig { rounds, holdover, servo, ..SlaveConfig::default() }
    }

    pub(super) fn take(self, servo: Servo) -> Seat {
        let mut bench = Bench::of(self.config(servo));
        if !matches!(self, Place::Nothing | Place::First) {
            bench.hear(1, 0).unwrap();
            bench.hear(2, 0).unwrap();
        }
        let middle_of = |cycle: u64| cycle * PERIOD + PERIOD / 2;
        let (heard, next) = match self {
            Place::Nothing
            | Place::Calibrating
            | Place::CalibratingUnbridged
            | Place::Locked
            | Place::Unbridged => (2, 3),
            Place::First => {
                bench.hear(2, 0).unwrap();
                (2, 3)
            }
            Place::Anew => {
                bench.slave.calibration_mut().measure_anew(1, &mut Room::of(1));
                (2, 3)
            }
            Place::Doubled => {
                // Without a filter it is as good as the first.
                let _ = bench.hear(2, 900);
                (2, 3)
            }
            Place::HeldUp => {
                bench.hear(3, HELD_UP).unwrap();
                (3, 4)
            }
            Place::HeldUpTwice => {
                bench.hear(3, HELD_UP).unwrap();
                bench.wait_until(middle_of(3));
                bench.hear(4, HELD_UP).unwrap();
                (4, 5)
            }
            Place::Moved | Place::CalibratingMoved => {
                bench.hear(3, JUMPED).unwrap();
                (3, 4)
            }
            Place::Holdover | Place::Bridging => {
                bench.wait_until(middle_of(3));
                (2, 4)
            }
            Place::Lost | Place::LostUncalibrated => {
                bench.wait_until(middle_of(4));
                (2, 5)
            }
            Place::LostMoved => {
                bench.wait_until(middle_of(4));
                bench.hear(5, JUMPED).unwrap();
                (5, 6)
            }
            Place::LostLate => {
                bench.wait_until(middle_of(4));
                let row = slow_at_most(Span::from_nanos(PERIOD as i64));
                for cycle in 5..4 + row {
                    bench.hear(cycle, HELD_UP).unwrap();
                }
                (3 + row, 4 + row)
            }
            Place::GivenUp | Place::GivenUpFirst => {
                bench.wait_until(middle_of(4));
                bench.wait_until(middle_of(1_500));
                (2, 1_501)
            }
        };
        let (heard, next) = match self {
            Place::GivenUpFirst => {
                bench.hear(next, 0).unwrap();
                (next, next + 1)
            }
            _ => (heard, next),
        };
        assert_eq!(state_of(&bench.slave), Some(self.state(servo)), "{self:?}");
        assert_eq!(bench.slave.state(), self.sync_state(servo), "{self:?}");
        bench.told();
        Seat { bench, heard, next }
    }
}
