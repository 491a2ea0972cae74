//! The table of slaves without a filter: where there is a line every Synchronisation is it, and nothing is doubted. Whatever
//! is not of Synchronisations is as with a filter, for a slave that is as far.

use super::*;

pub(super) fn expected(happening: Happening, place: Place) -> Outcome {
    use Place::*;
    let stays = |answer, told| (place.sync_state(Servo::None), answer, Vec::from_iter(told));
    let locked = |answer, told| (SyncState::Locked, answer, Vec::from_iter(told));
    let follows = |answer| match place {
        Nothing | First | GivenUp | GivenUpFirst => stays(PENDING, None),
        Calibrating | CalibratingUnbridged | CalibratingMoved | LostUncalibrated => {
            (SyncState::Calibrating, answer, vec![])
        }
        Locked | Unbridged | Anew | Doubled | HeldUp | HeldUpTwice | Moved | LostMoved | LostLate
        | Holdover | Bridging => locked(answer, None),
        Lost => locked(answer, Some(EventKind::Locked)),
    };
    // As far as who doubts is who does not.
    let counterpart = match place {
        Calibrating | CalibratingMoved => Calibrating,
        Locked | Doubled | HeldUp | HeldUpTwice | Moved | LostMoved | LostLate => Locked,
        Nothing | First | CalibratingUnbridged | Unbridged | Anew | Holdover | Bridging | Lost
        | LostUncalibrated | GivenUp | GivenUpFirst => place,
    };
    match happening {
        // Two tell the period.
        Happening::NextSync | Happening::AnothersSync | Happening::HeldUpSync | Happening::JumpedSync => {
            match place {
                First | GivenUpFirst => locked(NEW_LINE, Some(EventKind::Locked)),
                _ => follows(AGREES),
            }
        }
        Happening::RepeatedSync | Happening::BackupsRepeat => follows(AGREES),
        Happening::RenumberedSync => follows(NEW_LINE),
        Happening::ImplausibleSync
        | Happening::Reply
        | Happening::ForeignReply
        | Happening::ImplausibleReply
        | Happening::HalfACycle
        | Happening::OneCycleMore
        | Happening::TwoCyclesMore
        | Happening::AThousandCyclesMore
        | Happening::Forget
        | Happening::Resume
        | Happening::Detach
        | Happening::DetachAndAttach
        | Happening::BecomePrimary
        | Happening::BecomeBackup => expected::expected(happening, counterpart),
    }
}
