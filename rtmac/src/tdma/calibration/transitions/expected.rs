//! The table of calibrations.

use super::*;

pub(super) fn expected(happening: Happening, place: Place, config: Config) -> Outcome {
    use Place::*;
    let (state, (samples, attempts, repeats)) = place.seen();
    let stays = |answer| (state, (samples, attempts, repeats), answer, None);
    let unexpected = stays(Answer::Refused(Refusal::UnexpectedReply));
    // A delay that is known stays meanwhile.
    let (idle, outstanding) = match state {
        State::Idle | State::Outstanding | State::Done => (State::Idle, State::Outstanding),
        State::AnewIdle | State::AnewOutstanding => (State::AnewIdle, State::AnewOutstanding),
    };
    // The rounds so far count, and no reply that is still to come.
    let other_line = (idle, (samples, 0, repeats), Answer::Kept, None);
    // One that had no reply is repeated.
    let asked = |state, told| match place {
        NoLine | Done | WithoutRounds => stays(Answer::Nothing),
        Idle | Anew => (state, (samples, attempts + 1, repeats), Answer::Asked, told),
        Outstanding | LastOutstanding | AnewOutstanding | AnewLastOutstanding => {
            (state, (samples, attempts + 1, repeats + 1), Answer::Asked, told)
        }
        Exhausted => (State::Idle, (0, 0, repeats + 1), Answer::Nothing, Some(EventKind::CalibrationTimeout)),
        AnewExhausted => {
            (State::Done, (0, 0, repeats + 1), Answer::Nothing, Some(EventKind::CalibrationTimeout))
        }
    };
    match happening {
        Happening::Sent => asked(outstanding, None),
        // The reply to one that was held up would measure that; the others have none.
        Happening::Stalled => asked(idle, Some(EventKind::StalledInSend)),
        Happening::Late => asked(idle, Some(EventKind::Overrun)),
        Happening::Guarded => asked(idle, Some(EventKind::GuardDropped)),
        Happening::Failed => asked(idle, Some(EventKind::SendFailed)),
        Happening::Reply => match place {
            NoLine | Idle | Done | WithoutRounds | Anew => unexpected,
            Outstanding | Exhausted | AnewOutstanding | AnewExhausted => {
                (idle, (samples + 1, attempts, repeats), Answer::Kept, None)
            }
            LastOutstanding => (State::Done, (0, 0, repeats), Answer::Kept, Some(EventKind::Locked)),
            AnewLastOutstanding => {
                (State::Done, (0, 0, repeats), Answer::Kept, Some(EventKind::CalibratedAnew))
            }
        },
        Happening::ForeignReply => unexpected,
        Happening::ImplausibleReply => match place {
            NoLine | Idle | Done | WithoutRounds | Anew => unexpected,
            Outstanding | LastOutstanding | Exhausted | AnewOutstanding | AnewLastOutstanding
            | AnewExhausted => {
                let refused = Answer::Refused(Refusal::ImplausibleReply);
                (idle, (samples, attempts, repeats), refused, None)
            }
        },
        Happening::SyncLost => match place {
            NoLine => stays(Answer::Nothing),
            Idle | Outstanding | LastOutstanding | Exhausted | Done | WithoutRounds | Anew
            | AnewOutstanding | AnewLastOutstanding | AnewExhausted => {
                (state, (samples, attempts, repeats), Answer::Nothing, Some(EventKind::SyncLost))
            }
        },
        // There is no other line: what it says is the one that is followed.
        Happening::LineMoved if config.servo == Servo::None => stays(Answer::Kept),
        Happening::LineMoved => match place {
            NoLine => stays(Answer::Kept),
            Idle | Outstanding | LastOutstanding | Exhausted => other_line,
            // Whose slot had a turn on the line that was left.
            WithoutRounds => (state, (samples, attempts, repeats), Answer::Kept, Some(EventKind::Overrun)),
            // That one was left to the last reply, which had come before it.
            Done => stays(Answer::Kept),
            Anew => (idle, (samples, 0, repeats), Answer::Kept, None),
            // That one was left to the reply.
            AnewOutstanding | AnewLastOutstanding | AnewExhausted => other_line,
        },
        Happening::MasterChanged if config.on_master_change == OnMasterChange::Repeat => match place {
            NoLine | WithoutRounds => stays(Answer::Kept),
            Done => (State::AnewIdle, (0, 0, repeats), Answer::Kept, None),
            // Of what is under way nothing stays.
            Idle | Outstanding | LastOutstanding | Exhausted | Anew | AnewOutstanding
            | AnewLastOutstanding | AnewExhausted => (idle, (0, 0, repeats), Answer::Kept, None),
        },
        Happening::MasterChanged => match place {
            NoLine | Done | WithoutRounds => stays(Answer::Kept),
            Idle | Outstanding | LastOutstanding | Exhausted | Anew | AnewOutstanding
            | AnewLastOutstanding | AnewExhausted => other_line,
        },
        Happening::Command => match place {
            Done | WithoutRounds => (State::AnewIdle, (0, 0, repeats), Answer::Begun, None),
            NoLine | Idle | Outstanding | LastOutstanding | Exhausted | Anew | AnewOutstanding
            | AnewLastOutstanding | AnewExhausted => stays(Answer::Busy),
        },
    }
}

/// The delay that is in use then: the quicker round's, or the mean.
pub(super) fn expected_delay(happening: Happening, place: Place, servo: Servo) -> Option<i64> {
    use Place::*;
    let of = |[quick, slow]: [i64; 2]| match servo {
        Servo::Linear => Some(quick),
        Servo::None => Some((quick + slow) / 2),
    };
    match (place, happening) {
        (LastOutstanding, Happening::Reply) => of(DELAYS),
        (AnewLastOutstanding, Happening::Reply) => of(DELAYS_ANEW),
        (NoLine | Idle | Outstanding | LastOutstanding | Exhausted, _) => None,
        (WithoutRounds, _) => Some(0),
        // Until the last round the one before.
        (Done | Anew | AnewOutstanding | AnewLastOutstanding | AnewExhausted, _) => of(DELAYS),
    }
}
