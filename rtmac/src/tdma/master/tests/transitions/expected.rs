//! The table of masters.

use super::*;

/// The table.
pub(super) fn expected(happening: Happening, place: Place, kind: Kind) -> Outcome {
    const STEP: &[EventKind] = &[EventKind::TimeStep];
    use Answer::{Aligns, Beside, Follows, Speaks};
    use Kind::*;
    use Place::*;
    let stays = |answer| (place.mastery(), answer, &[][..]);
    let follows = (Mastery::Following, Follows(true), &[][..]);
    let is_locked = (Mastery::Following, Follows(true), &[EventKind::Locked][..]);
    let yields = |answer| (Mastery::Yielded, answer, &[EventKind::OtherMaster][..]);
    let listens = (Mastery::Listening, Answer::Nothing, &[EventKind::SyncLost][..]);
    let stands_by = (Mastery::StandBy, Answer::Nothing, &[][..]);
    let gives_time = |answer| (Mastery::Active, answer, &[EventKind::MasterActive][..]);
    // The other's is of another line than its own.
    let steps_down = (Mastery::StandBy, Follows(true), &[EventKind::SteppedDown, EventKind::TimeStep][..]);
    let not_alone = (Mastery::Active, Follows(false), &[EventKind::OtherMaster][..]);
    let makes_way = (Mastery::Following, Follows(true), &[EventKind::OtherMaster, EventKind::Yielded][..]);
    match happening {
        Happening::PrimarysSync => match (place, kind) {
            (Attached | Listening, Primary) => yields(Follows(false)),
            (Attached | Listening, Backup) => follows,
            (ListeningAgain | Unsure, _) => is_locked,
            (FollowingPrimary | FollowingBackup | Calibrating | Outlasted | StandBy, _) => {
                stays(Follows(true))
            }
            (Active | BesideHigher, Primary) => not_alone,
            (Active | BesideRival | BesideHigher, Backup) => steps_down,
            (BesideRival, Primary) => makes_way,
            (Yielded, _) => stays(Follows(false)),
        },
        Happening::BackupsSync => match (place, kind) {
            (Attached | Listening, _) => follows,
            (ListeningAgain | Unsure, _) => is_locked,
            (FollowingPrimary | FollowingBackup | Calibrating | Outlasted | StandBy, _) => {
                stays(Follows(true))
            }
            // One that is not deaf steps down by itself.
            (Active | BesideRival | BesideHigher, Primary) => not_alone,
            (Active | BesideRival | BesideHigher, Backup) => steps_down,
            (Yielded, _) => stays(Follows(false)),
        },
        Happening::HighersSync => match (place, kind) {
            (BesideHigher, Primary) => makes_way,
            (Active | BesideRival, Primary) => not_alone,
            // Only who gives the time compares addresses.
            (Active | BesideRival | BesideHigher, Backup)
            | (Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup, _)
            | (Calibrating | Outlasted | StandBy | Yielded, _) => {
                expected(Happening::PrimarysSync, place, kind)
            }
        },
        Happening::SyncBeside => match (place, kind) {
            (Attached | Listening, Primary) => yields(Beside(false, None)),
            (Attached | Listening, Backup) => (Mastery::Following, Beside(true, None), &[][..]),
            (ListeningAgain, _) => (Mastery::Following, Beside(true, None), STEP),
            // Of two alone no line is known to be the other's.
            (Unsure, _) => stays(Beside(true, None)),
            (FollowingPrimary | FollowingBackup | Calibrating | Outlasted, _) => {
                (Mastery::Following, Beside(true, None), STEP)
            }
            // Its own is silent until the next of that line would have told.
            (StandBy, _) => (Mastery::StandBy, Beside(true, Some(2)), STEP),
            (Active | BesideRival | BesideHigher, Backup) => {
                (Mastery::StandBy, Beside(true, Some(2)), &[EventKind::SteppedDown, EventKind::TimeStep][..])
            }
            // Its grid never moves.
            (Active | BesideHigher, Primary) => {
                (Mastery::Active, Beside(false, Some(1)), &[EventKind::OtherMaster][..])
            }
            (BesideRival, Primary) => {
                let told = &[EventKind::OtherMaster, EventKind::Yielded][..];
                (Mastery::Following, Beside(true, None), told)
            }
            (Yielded, _) => stays(Beside(false, None)),
        },
        Happening::TwoBeside => match (place, kind) {
            (Attached | Listening, Primary) => yields(Beside(false, None)),
            (Attached | Listening, Backup) | (Unsure, _) => {
                (Mastery::Following, Beside(true, None), &[EventKind::Locked][..])
            }
            (ListeningAgain, _) => {
                (Mastery::Following, Beside(true, None), &[EventKind::TimeStep, EventKind::Locked][..])
            }
            (FollowingPrimary | FollowingBackup | Calibrating | Outlasted, _) => {
                (Mastery::Following, Beside(true, None), STEP)
            }
            // On the other line, and by its numbers, the next is its own again.
            (StandBy, _) => (Mastery::StandBy, Beside(true, Some(1)), STEP),
            (Active | BesideRival | BesideHigher, Backup) => {
                (Mastery::StandBy, Beside(true, Some(1)), &[EventKind::SteppedDown, EventKind::TimeStep][..])
            }
            // The second came when its own was due.
            (Active | BesideHigher, Primary) => {
                (Mastery::Active, Beside(false, Some(0)), &[EventKind::OtherMaster; 2][..])
            }
            (BesideRival, Primary) => {
                let told = &[EventKind::OtherMaster, EventKind::Yielded, EventKind::Locked][..];
                (Mastery::Following, Beside(true, None), told)
            }
            (Yielded, _) => stays(Beside(false, None)),
        },
        Happening::OwnInTime | Happening::OwnHeldUp => match place {
            StandBy => (Mastery::Active, Speaks, &[EventKind::TookOver][..]),
            Active | BesideRival | BesideHigher => stays(Speaks),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Calibrating | Outlasted | Yielded => stays(Answer::Nothing),
        },
        Happening::OwnMissed => match place {
            StandBy | Active | BesideRival | BesideHigher => stays(Speaks),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Calibrating | Outlasted | Yielded => stays(Answer::Nothing),
        },
        Happening::Request => match place {
            Active | BesideRival | BesideHigher => stays(Answer::Promises),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Calibrating | Outlasted | StandBy | Yielded => stays(Answer::Refused(Refusal::NotMaster)),
        },
        Happening::Reply => match place {
            Calibrating => (Mastery::Following, Answer::Calibrated, &[EventKind::Locked][..]),
            Active | BesideRival | BesideHigher => stays(Answer::Nothing),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Outlasted | StandBy | Yielded => stays(Answer::Refused(Refusal::UnexpectedReply)),
        },
        Happening::Turn => match (place, kind) {
            (FollowingBackup, Primary) => gives_time(Answer::Nothing),
            (FollowingBackup | FollowingPrimary, Backup) => stands_by,
            (Attached | Listening | ListeningAgain | Unsure | FollowingPrimary, _)
            | (Calibrating | Outlasted | StandBy | Active | BesideRival | BesideHigher | Yielded, _) => {
                stays(Answer::Nothing)
            }
        },
        Happening::TurnWithoutSlots => match (place, kind) {
            // Who has no slot cannot calibrate, and does without.
            (FollowingBackup | Calibrating, Primary) => gives_time(Answer::Nothing),
            (FollowingBackup | FollowingPrimary | Calibrating, Backup) => stands_by,
            (Attached | Listening | ListeningAgain | Unsure | FollowingPrimary, _)
            | (Outlasted | StandBy | Active | BesideRival | BesideHigher | Yielded, _) => {
                stays(Answer::Nothing)
            }
        },
        Happening::TwoMissing => match place {
            FollowingPrimary | FollowingBackup | Calibrating | Outlasted => listens,
            // It had its own instants meanwhile, and slept through them.
            StandBy => (Mastery::StandBy, Answer::Nothing, &[EventKind::SyncLost][..]),
            Attached | Listening | ListeningAgain | Unsure | Active | BesideRival | BesideHigher
            | Yielded => stays(Answer::Nothing),
        },
        Happening::LongSilence => match place {
            FollowingPrimary | FollowingBackup | Calibrating | Outlasted => listens,
            Unsure => (Mastery::Listening, Answer::Nothing, &[][..]),
            Listening => gives_time(Aligns),
            ListeningAgain => gives_time(Answer::Nothing),
            StandBy => (Mastery::StandBy, Answer::Nothing, &[EventKind::SyncLost][..]),
            Attached | Active | BesideRival | BesideHigher | Yielded => stays(Answer::Nothing),
        },
        Happening::AThousandMissing => match place {
            Attached | Listening => gives_time(Aligns),
            ListeningAgain => gives_time(Answer::Nothing),
            FollowingPrimary | FollowingBackup | Outlasted => {
                (Mastery::Active, Answer::Nothing, &[EventKind::SyncLost, EventKind::MasterActive][..])
            }
            // Calibration used one slot alone.
            Calibrating => (Mastery::Active, Aligns, &[EventKind::SyncLost, EventKind::MasterActive][..]),
            Unsure => (Mastery::Listening, Answer::Nothing, &[][..]),
            StandBy => {
                let told = &[EventKind::SyncLost, EventKind::LineGivenUp][..];
                (Mastery::Listening, Answer::Nothing, told)
            }
            Active | BesideRival | BesideHigher | Yielded => stays(Answer::Nothing),
        },
        // As it was it is handed back.
        Happening::Detach => stays(Answer::Becomes(RoleName::Detached)),
        Happening::BecomeSlave => stays(Answer::Becomes(RoleName::Slave)),
        Happening::BecomeAnew => {
            let name = match kind {
                Primary => RoleName::Master,
                Backup => RoleName::Backup,
            };
            (Mastery::Listening, Answer::Becomes(name), &[][..])
        }
    }
}
