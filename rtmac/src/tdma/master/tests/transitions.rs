//! Every phase of a primary and of a backup, with its sub-states, against everything that can happen to it.

use super::*;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Primary,
    Backup,
}

/// Where a master can be: its phase, and what it knows besides.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    Yielded,
}

const PLACES: [Place; 12] = [
    Place::Attached,
    Place::Listening,
    Place::ListeningAgain,
    Place::Unsure,
    Place::FollowingPrimary,
    Place::FollowingBackup,
    Place::Calibrating,
    Place::Outlasted,
    Place::StandBy,
    Place::Active,
    Place::BesideRival,
    Place::Yielded,
];

/// What can happen.
#[derive(Clone, Copy, Debug)]
enum Happening {
    /// The next Synchronisation, as early as a primary's, as late as a backup's.
    PrimarysSync,
    BackupsSync,
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
}

const HAPPENINGS: [Happening; 12] = [
    Happening::PrimarysSync,
    Happening::BackupsSync,
    Happening::OwnInTime,
    Happening::OwnHeldUp,
    Happening::OwnMissed,
    Happening::Request,
    Happening::Reply,
    Happening::Turn,
    Happening::TurnWithoutSlots,
    Happening::TwoMissing,
    Happening::LongSilence,
    Happening::AThousandMissing,
];

/// What comes of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Answer {
    Nothing,
    /// The Synchronisation is followed, or not.
    Follows(bool),
    /// It had a Synchronisation of its own to send.
    Speaks,
    /// Slots are to be aligned.
    Aligns,
    Promises,
    Calibrated,
    Refused(Refusal),
}

/// What it is doing then, what it answers, and what it tells of.
type Outcome = (Mastery, Answer, &'static [EventKind]);

/// A master in its place, and the cycle whose Synchronisation is due next.
struct Seat {
    bench: Bench,
    next: u32,
}

impl Place {
    /// `None` where this kind never is.
    fn take(self, kind: Kind) -> Option<Seat> {
        let (backup, listens) = match kind {
            Kind::Primary => (None, 3),
            Kind::Backup => (Some(BACKUP), 50),
        };
        let mut bench = Bench::new(backup);
        let next = match (self, kind) {
            (Place::Attached, _) => 1,
            (Place::Listening, _) => {
                bench.wait_until(at(0));
                1
            }
            (Place::ListeningAgain, _) => {
                bench = Bench::following(backup, LATE);
                bench.wait_until(at(4_300));
                5
            }
            (Place::Unsure, _) => {
                bench.wait_until(at(0));
                bench.hear(LOWER, 1, LATE);
                2
            }
            (Place::FollowingPrimary, _) => {
                bench = Bench::following(backup, LATE);
                bench.hear(LOWER, 3, PROMPT);
                4
            }
            (Place::FollowingBackup, _) => {
                bench = Bench::following(backup, LATE);
                3
            }
            (Place::Calibrating, _) => {
                let follow = SlaveConfig { rounds: 1, ..SlaveConfig::default() };
                bench.master = Master::new(MasterConfig { follow, ..bench.master.config });
                bench.wait_until(at(500));
                bench.hear(LOWER, 1, LATE);
                bench.hear(LOWER, 2, LATE);
                3
            }
            (Place::Outlasted, Kind::Primary) => {
                bench = Bench::active(None);
                for cycle in 4..7 {
                    bench.send(true);
                    bench.hear(LOWER, cycle, PROMPT);
                }
                bench.hear(LOWER, 7, LATE);
                bench.hear(LOWER, 8, LATE);
                9
            }
            (Place::StandBy, Kind::Backup) => {
                bench = Bench::stand_by();
                3
            }
            (Place::Active, _) => {
                bench = Bench::active(backup);
                bench.send(true);
                listens + 1
            }
            (Place::BesideRival, Kind::Primary) => {
                bench = Bench::active(None);
                for cycle in 4..6 {
                    bench.send(true);
                    bench.hear(LOWER, cycle, PROMPT);
                }
                bench.send(true);
                6
            }
            (Place::Yielded, Kind::Primary) => {
                bench.hear(LOWER, 1, PROMPT);
                2
            }
            (Place::StandBy, Kind::Primary)
            | (Place::Outlasted | Place::BesideRival | Place::Yielded, Kind::Backup) => return None,
        };
        assert_eq!(bench.master.mastery(), self.mastery(), "{self:?}");
        bench.told();
        Some(Seat { bench, next })
    }

    fn mastery(self) -> Mastery {
        match self {
            Place::Attached | Place::Listening | Place::ListeningAgain => Mastery::Listening,
            Place::Unsure
            | Place::FollowingPrimary
            | Place::FollowingBackup
            | Place::Calibrating
            | Place::Outlasted => Mastery::Following,
            Place::StandBy => Mastery::StandBy,
            Place::Active | Place::BesideRival => Mastery::Active,
            Place::Yielded => Mastery::Yielded,
        }
    }
}

impl Seat {
    fn meet(&mut self, happening: Happening) -> Answer {
        match happening {
            Happening::PrimarysSync => Answer::Follows(self.bench.hear(LOWER, self.next, PROMPT)),
            Happening::BackupsSync => Answer::Follows(self.bench.hear(LOWER, self.next, LATE)),
            Happening::OwnInTime => self.own(Some(true)),
            Happening::OwnHeldUp => self.own(Some(false)),
            Happening::OwnMissed => self.own(None),
            Happening::Request => self.request(),
            Happening::Reply => self.reply(),
            Happening::Turn => self.turn(0, 300, true),
            Happening::TurnWithoutSlots => self.turn(0, 300, false),
            Happening::TwoMissing => self.turn(2, 300, true),
            Happening::LongSilence => self.turn(99, 300, true),
            Happening::AThousandMissing => {
                self.turn(2, 300, true);
                self.turn(1_100, 300, true)
            }
        }
    }

    /// Its own Synchronisation, in time or held up if it leaves at all.
    fn own(&mut self, left: Option<bool>) -> Answer {
        let Bench { master, events } = &mut self.bench;
        let Some((cycle, ..)) = master.next_sync() else { return Answer::Nothing };
        master.advance();
        if let Some(in_time) = left {
            master.sent(cycle, in_time, events);
        }
        Answer::Speaks
    }

    /// For a reply in the next cycle but one, as it numbers them.
    fn request(&mut self) -> Answer {
        let (now, master) = (self.last_sync(), &mut self.bench.master);
        let cycle = master.line().map_or(self.next, |line| line.cycle).wrapping_add(3);
        match master.on_request(now, HIGHER, 0, cycle, 400_000) {
            Ok(()) => Answer::Promises,
            Err(reason) => Answer::Refused(reason),
        }
    }

    /// To a request that has just left, by who follows.
    fn reply(&mut self) -> Answer {
        let sent = self.last_sync() + Span::from_micros(400);
        let Bench { master, events } = &mut self.bench;
        let Some(follower) = master.follower_mut() else { return Answer::Nothing };
        follower.calibration_mut().begin_round();
        follower.calibration_mut().sent(sent);
        match follower.on_reply(sent + Span::from_micros(2), sent.nanos(), 0, 0, events) {
            Ok(done) => {
                assert!(done, "it was the only round");
                Answer::Calibrated
            }
            Err(reason) => Answer::Refused(reason),
        }
    }

    /// So long after the last Synchronisation.
    fn turn(&mut self, cycles: u64, micros: u64, has_slots: bool) -> Answer {
        let now = self.last_sync() + Span::from_micros((cycles * 1_000 + micros) as i64);
        let Bench { master, events } = &mut self.bench;
        if master.on_timeout(now, has_slots, events) { Answer::Aligns } else { Answer::Nothing }
    }

    fn last_sync(&self) -> Instant {
        at(u64::from(self.next - 1) * 1_000)
    }
}

/// The table.
fn expected(happening: Happening, place: Place, kind: Kind) -> Outcome {
    use Answer::{Aligns, Follows, Speaks};
    use Kind::*;
    use Place::*;
    let stays = |answer| (place.mastery(), answer, &[][..]);
    let follows = (Mastery::Following, Follows(true), &[][..]);
    let is_locked = (Mastery::Following, Follows(true), &[EventKind::Locked][..]);
    let listens = (Mastery::Listening, Answer::Nothing, &[EventKind::SyncLost][..]);
    let stands_by = (Mastery::StandBy, Answer::Nothing, &[][..]);
    let gives_time = |answer| (Mastery::Active, answer, &[EventKind::MasterActive][..]);
    // The other's is of another line than its own.
    let steps_down = (Mastery::StandBy, Follows(true), &[EventKind::SteppedDown, EventKind::TimeStep][..]);
    let not_alone = (Mastery::Active, Follows(false), &[EventKind::OtherMaster][..]);
    match happening {
        Happening::PrimarysSync => match (place, kind) {
            (Attached | Listening, Primary) => {
                (Mastery::Yielded, Follows(false), &[EventKind::OtherMaster][..])
            }
            (Attached | Listening, Backup) => follows,
            (ListeningAgain | Unsure, _) => is_locked,
            (FollowingPrimary | FollowingBackup | Calibrating | Outlasted | StandBy, _) => {
                stays(Follows(true))
            }
            (Active, Primary) => not_alone,
            (Active | BesideRival, Backup) => steps_down,
            (BesideRival, Primary) => {
                (Mastery::Following, Follows(true), &[EventKind::OtherMaster, EventKind::Yielded][..])
            }
            (Yielded, _) => stays(Follows(false)),
        },
        Happening::BackupsSync => match (place, kind) {
            (Attached | Listening, _) => follows,
            (ListeningAgain | Unsure, _) => is_locked,
            (FollowingPrimary | FollowingBackup | Calibrating | Outlasted | StandBy, _) => {
                stays(Follows(true))
            }
            // One that is not deaf steps down by itself.
            (Active | BesideRival, Primary) => not_alone,
            (Active | BesideRival, Backup) => steps_down,
            (Yielded, _) => stays(Follows(false)),
        },
        Happening::OwnInTime | Happening::OwnHeldUp => match place {
            StandBy => (Mastery::Active, Speaks, &[EventKind::TookOver][..]),
            Active | BesideRival => stays(Speaks),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Calibrating | Outlasted | Yielded => stays(Answer::Nothing),
        },
        Happening::OwnMissed => match place {
            StandBy | Active | BesideRival => stays(Speaks),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Calibrating | Outlasted | Yielded => stays(Answer::Nothing),
        },
        Happening::Request => match place {
            Active | BesideRival => stays(Answer::Promises),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Calibrating | Outlasted | StandBy | Yielded => stays(Answer::Refused(Refusal::NotMaster)),
        },
        Happening::Reply => match place {
            Calibrating => (Mastery::Following, Answer::Calibrated, &[EventKind::Locked][..]),
            Active | BesideRival => stays(Answer::Nothing),
            Attached | Listening | ListeningAgain | Unsure | FollowingPrimary | FollowingBackup
            | Outlasted | StandBy | Yielded => stays(Answer::Refused(Refusal::UnexpectedReply)),
        },
        Happening::Turn => match (place, kind) {
            (FollowingBackup, Primary) => gives_time(Answer::Nothing),
            (FollowingBackup | FollowingPrimary, Backup) => stands_by,
            (Attached | Listening | ListeningAgain | Unsure | FollowingPrimary, _)
            | (Calibrating | Outlasted | StandBy | Active | BesideRival | Yielded, _) => {
                stays(Answer::Nothing)
            }
        },
        Happening::TurnWithoutSlots => match (place, kind) {
            // Who has no slot cannot calibrate, and does without.
            (FollowingBackup | Calibrating, Primary) => gives_time(Answer::Nothing),
            (FollowingBackup | FollowingPrimary | Calibrating, Backup) => stands_by,
            (Attached | Listening | ListeningAgain | Unsure | FollowingPrimary, _)
            | (Outlasted | StandBy | Active | BesideRival | Yielded, _) => stays(Answer::Nothing),
        },
        Happening::TwoMissing => match place {
            FollowingPrimary | FollowingBackup | Calibrating | Outlasted => listens,
            // It had its own instants meanwhile, and slept through them.
            StandBy => (Mastery::StandBy, Answer::Nothing, &[EventKind::SyncLost][..]),
            Attached | Listening | ListeningAgain | Unsure | Active | BesideRival | Yielded => {
                stays(Answer::Nothing)
            }
        },
        Happening::LongSilence => match place {
            FollowingPrimary | FollowingBackup | Calibrating | Outlasted => listens,
            Unsure => (Mastery::Listening, Answer::Nothing, &[][..]),
            Listening => gives_time(Aligns),
            ListeningAgain => gives_time(Answer::Nothing),
            StandBy => (Mastery::StandBy, Answer::Nothing, &[EventKind::SyncLost][..]),
            Attached | Active | BesideRival | Yielded => stays(Answer::Nothing),
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
            Active | BesideRival | Yielded => stays(Answer::Nothing),
        },
    }
}

#[test]
fn every_phase_answers_every_event() {
    for kind in [Kind::Primary, Kind::Backup] {
        for place in PLACES {
            for happening in HAPPENINGS {
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
