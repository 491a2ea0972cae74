//! The table of slaves.

use super::*;

pub(super) fn expected(happening: Happening, place: Place) -> Outcome {
    use Place::*;
    let stays = |answer, told| (place.sync_state(Servo::Linear), answer, Vec::from_iter(told));
    let calibrates = |answer| (SyncState::Calibrating, answer, vec![]);
    let locked = |answer, told| (SyncState::Locked, answer, Vec::from_iter(told));
    let lost = (SyncState::Lost, Answer::Nothing, vec![EventKind::SyncLost]);
    let bridges = (SyncState::Holdover, Answer::Nothing, vec![EventKind::Holdover]);
    let step = stays(PENDING, Some(EventKind::TimeStep));
    let nothing = stays(Answer::Nothing, None);
    let refused = |reason| stays(Answer::Refused(reason), None);
    match happening {
        Happening::NextSync | Happening::AnothersSync => match place {
            Nothing | GivenUp => stays(PENDING, None),
            First | GivenUpFirst => locked(NEW_LINE, Some(EventKind::Locked)),
            Calibrating | CalibratingUnbridged | CalibratingMoved | Locked | Unbridged | Anew | Doubled
            | HeldUp | Moved => stays(AGREES, None),
            HeldUpTwice | Holdover | Bridging => locked(AGREES, None),
            Lost | LostMoved | LostLate => locked(AGREES, Some(EventKind::Locked)),
            LostUncalibrated => calibrates(AGREES),
        },
        Happening::HeldUpSync => match place {
            Nothing | First | GivenUp | GivenUpFirst => stays(PENDING, None),
            LostLate => locked(NEW_LINE, Some(EventKind::Locked)),
            Calibrating | CalibratingUnbridged | CalibratingMoved | Locked | Unbridged | Anew | Doubled
            | HeldUp | HeldUpTwice | Moved | Holdover | Bridging | Lost | LostMoved | LostUncalibrated => {
                step
            }
        },
        Happening::JumpedSync => match place {
            Nothing | First | GivenUp | GivenUpFirst => stays(PENDING, None),
            Moved => locked(NEW_LINE, None),
            CalibratingMoved => calibrates(NEW_LINE),
            LostMoved => locked(NEW_LINE, Some(EventKind::Locked)),
            Calibrating | CalibratingUnbridged | Locked | Unbridged | Anew | Doubled | HeldUp
            | HeldUpTwice | Holdover | Bridging | Lost | LostLate | LostUncalibrated => step,
        },
        Happening::RenumberedSync => match place {
            Nothing | First | GivenUp | GivenUpFirst => stays(PENDING, None),
            Calibrating | CalibratingUnbridged | CalibratingMoved | Locked | Unbridged | Anew | Doubled
            | HeldUp | HeldUpTwice | Moved | Holdover | Bridging | Lost | LostMoved | LostLate
            | LostUncalibrated => step,
        },
        Happening::RepeatedSync | Happening::BackupsRepeat => match place {
            Nothing | First | GivenUp | GivenUpFirst => stays(PENDING, None),
            Calibrating | CalibratingUnbridged | Locked | Unbridged | Anew | Doubled | Holdover
            | Bridging | Lost | LostUncalibrated => {
                stays(Answer::Refused(Refusal::DuplicateCycle), Some(EventKind::DuplicateCycle))
            }
            // The other one of that number was beside the line.
            CalibratingMoved | HeldUp | Moved => stays(AGREES, Some(EventKind::DuplicateCycle)),
            HeldUpTwice => locked(AGREES, Some(EventKind::DuplicateCycle)),
            LostMoved | LostLate => {
                (SyncState::Locked, AGREES, vec![EventKind::DuplicateCycle, EventKind::Locked])
            }
        },
        Happening::ImplausibleSync => refused(Refusal::ImplausibleSync),
        Happening::Reply => match place {
            // The line counts, whatever is doubted.
            Calibrating | CalibratingUnbridged | CalibratingMoved => {
                locked(Answer::Calibrated, Some(EventKind::Locked))
            }
            LostUncalibrated => stays(Answer::Calibrated, None),
            // It goes on as before, with another delay.
            Anew => stays(Answer::Nothing, Some(EventKind::CalibratedAnew)),
            Nothing | First | Locked | Unbridged | Doubled | HeldUp | HeldUpTwice | Moved | Holdover
            | Bridging | Lost | LostMoved | LostLate | GivenUp | GivenUpFirst => {
                refused(Refusal::UnexpectedReply)
            }
        },
        Happening::ForeignReply => refused(Refusal::UnexpectedReply),
        Happening::ImplausibleReply => match place {
            Calibrating | CalibratingUnbridged | CalibratingMoved | LostUncalibrated | Anew => {
                refused(Refusal::ImplausibleReply)
            }
            Nothing | First | Locked | Unbridged | Doubled | HeldUp | HeldUpTwice | Moved | Holdover
            | Bridging | Lost | LostMoved | LostLate | GivenUp | GivenUpFirst => {
                refused(Refusal::UnexpectedReply)
            }
        },
        Happening::HalfACycle => match place {
            // What may be held up, or is of another line, is missing.
            HeldUp | Moved => bridges,
            HeldUpTwice => lost,
            Nothing | First | Calibrating | CalibratingUnbridged | CalibratingMoved | Locked | Unbridged
            | Anew | Doubled | Holdover | Bridging | Lost | LostMoved | LostLate | LostUncalibrated
            | GivenUp | GivenUpFirst => nothing,
        },
        Happening::OneCycleMore => match place {
            Locked | Anew | Doubled => bridges,
            CalibratingMoved | Unbridged | HeldUp | HeldUpTwice | Moved | Holdover => lost,
            // One that is missing does not interrupt a calibration.
            Nothing | First | Calibrating | CalibratingUnbridged | Bridging | Lost | LostMoved | LostLate
            | LostUncalibrated | GivenUp | GivenUpFirst => nothing,
        },
        Happening::TwoCyclesMore => match place {
            Calibrating | CalibratingUnbridged | CalibratingMoved | Locked | Unbridged | Anew | Doubled
            | HeldUp | HeldUpTwice | Moved | Holdover => lost,
            Nothing | First | Bridging | Lost | LostMoved | LostLate | LostUncalibrated | GivenUp
            | GivenUpFirst => nothing,
        },
        Happening::AThousandCyclesMore => match place {
            Calibrating | CalibratingUnbridged | CalibratingMoved | Locked | Unbridged | Anew | Doubled
            | HeldUp | HeldUpTwice | Moved | Holdover | Bridging => lost,
            Lost | LostMoved | LostLate | LostUncalibrated => {
                stays(Answer::Nothing, Some(EventKind::LineGivenUp))
            }
            Nothing | First | GivenUp | GivenUpFirst => nothing,
        },
        Happening::Forget => (SyncState::Waiting, Answer::Nothing, vec![]),
        Happening::Resume => match place {
            Calibrating | CalibratingUnbridged | CalibratingMoved | LostUncalibrated => {
                calibrates(Answer::Nothing)
            }
            Nothing | First | Locked | Unbridged | Anew | Doubled | HeldUp | HeldUpTwice | Moved
            | Holdover | Bridging | Lost | LostMoved | LostLate | GivenUp | GivenUpFirst => {
                locked(Answer::Nothing, None)
            }
        },
        // Whatever it was: a slave is handed back as it is, and one that is attached is at the begin.
        Happening::Detach => stays(Answer::Becomes(RoleName::Detached), None),
        Happening::DetachAndAttach => (SyncState::Waiting, Answer::Becomes(RoleName::Slave), vec![]),
        Happening::BecomePrimary => stays(Answer::Becomes(RoleName::Master), None),
        Happening::BecomeBackup => stays(Answer::Becomes(RoleName::Backup), None),
    }
}
