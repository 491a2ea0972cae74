//! Every state of a slave, with its sub-states, against everything that can happen to it.

use super::*;

/// Where a slave can be: its state, and what it knows or doubts besides.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Place {
    /// Waiting: nothing was heard.
    Nothing,
    /// Waiting: one Synchronisation was heard.
    First,
    Calibrating,
    Locked,
    /// Locked, and the delay is measured anew.
    Anew,
    /// Locked: the number of this cycle came twice.
    Doubled,
    /// Locked: the last Synchronisation was late as if it had been held up.
    HeldUp,
    /// Holdover: the last two were, by as much.
    HeldUpTwice,
    /// Locked: the last Synchronisation was later than hold-ups are.
    Moved,
    Holdover,
    /// Holdover, with two more cycles that are bridged as configured.
    Bridging,
    Lost,
    /// Lost, and not calibrated yet.
    LostUncalibrated,
    /// Lost: its line was too old, and given up.
    GivenUp,
}

const PLACES: [Place; 14] = [
    Place::Nothing,
    Place::First,
    Place::Calibrating,
    Place::Locked,
    Place::Anew,
    Place::Doubled,
    Place::HeldUp,
    Place::HeldUpTwice,
    Place::Moved,
    Place::Holdover,
    Place::Bridging,
    Place::Lost,
    Place::LostUncalibrated,
    Place::GivenUp,
];

/// What can happen.
#[derive(Clone, Copy, Debug)]
enum Happening {
    /// The next Synchronisation, in time.
    NextSync,
    /// The same from another master.
    AnothersSync,
    /// The next one, late by as much as a hold-up explains.
    HeldUpSync,
    /// The next one, later than that.
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
}

const HAPPENINGS: [Happening; 17] = [
    Happening::NextSync,
    Happening::AnothersSync,
    Happening::HeldUpSync,
    Happening::JumpedSync,
    Happening::RenumberedSync,
    Happening::RepeatedSync,
    Happening::BackupsRepeat,
    Happening::ImplausibleSync,
    Happening::Reply,
    Happening::ForeignReply,
    Happening::ImplausibleReply,
    Happening::HalfACycle,
    Happening::OneCycleMore,
    Happening::TwoCyclesMore,
    Happening::AThousandCyclesMore,
    Happening::Forget,
    Happening::Resume,
];

/// What comes of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Answer {
    Nothing,
    Sync(Followed),
    Calibrated,
    Refused(Refusal),
}

/// The state that it is in then, what it answers, and what it tells of.
type Outcome = (SyncState, Answer, Option<EventKind>);

const BACKUP: Address = Address([2, 0, 0, 0, 0, 7]);
const HELD_UP: i64 = 200_000;
const JUMPED: i64 = 500_000;

/// A slave in its place, with the last cycle that it heard of and the next that is due.
struct Seat {
    bench: Bench,
    heard: u32,
    next: u32,
}

impl Place {
    fn state(self) -> SyncState {
        match self {
            Place::Nothing | Place::First => SyncState::Waiting,
            Place::Calibrating => SyncState::Calibrating,
            Place::Locked | Place::Anew | Place::Doubled | Place::HeldUp | Place::Moved => SyncState::Locked,
            Place::HeldUpTwice | Place::Holdover | Place::Bridging => SyncState::Holdover,
            Place::Lost | Place::LostUncalibrated | Place::GivenUp => SyncState::Lost,
        }
    }

    fn take(self) -> Seat {
        let calibrates = matches!(self, Place::Calibrating | Place::LostUncalibrated);
        let holdover = if self == Place::Bridging { 3 } else { 1 };
        let mut bench =
            Bench::of(SlaveConfig { rounds: calibrates.into(), holdover, ..SlaveConfig::default() });
        if !matches!(self, Place::Nothing | Place::First) {
            bench.hear(1, 0).unwrap();
            bench.hear(2, 0).unwrap();
        }
        let middle_of = |cycle: u64| cycle * PERIOD + PERIOD / 2;
        let (heard, next) = match self {
            Place::Nothing | Place::Calibrating | Place::Locked => (2, 3),
            Place::First => {
                bench.hear(2, 0).unwrap();
                (2, 3)
            }
            Place::Anew => {
                bench.slave.calibration_mut().measure_anew(1, &mut Room::of(1));
                (2, 3)
            }
            Place::Doubled => {
                bench.hear(2, 900).unwrap_err();
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
            Place::Moved => {
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
            Place::GivenUp => {
                bench.wait_until(middle_of(4));
                bench.wait_until(middle_of(1_500));
                (2, 1_501)
            }
        };
        assert_eq!(bench.slave.state(), self.state(), "{self:?}");
        bench.told();
        Seat { bench, heard, next }
    }
}

impl Seat {
    /// Lets it happen; what comes of it, and the cycle that it is then.
    fn meet(&mut self, happening: Happening) -> (Answer, u32) {
        let (heard, next) = (self.heard, self.next);
        let of_sync = |result: Result<Followed, Refusal>| result.map_or_else(Answer::Refused, Answer::Sync);
        let synced = |answer| (answer, next);
        match happening {
            Happening::NextSync => synced(of_sync(self.bench.hear(next, 0))),
            Happening::AnothersSync => synced(of_sync(self.hear_backup(next, 0))),
            Happening::HeldUpSync => synced(of_sync(self.bench.hear(next, HELD_UP))),
            Happening::JumpedSync => synced(of_sync(self.bench.hear(next, JUMPED))),
            Happening::RenumberedSync => {
                let start = u64::from(next) * PERIOD;
                synced(of_sync(self.bench.hear_from_line(next + 5_000, start, 0)))
            }
            Happening::RepeatedSync => synced(of_sync(self.bench.hear(heard, 900))),
            Happening::BackupsRepeat => synced(of_sync(self.hear_backup(heard, 200_000))),
            Happening::ImplausibleSync => synced(of_sync(self.hear_hour_off(next))),
            Happening::Reply => (self.reply(0, 0), next - 1),
            Happening::ForeignReply => (self.reply(1, 0), next - 1),
            Happening::ImplausibleReply => (self.reply(0, u64::MAX / 4), next - 1),
            Happening::HalfACycle => self.wait(0),
            Happening::OneCycleMore => self.wait(1),
            Happening::TwoCyclesMore => self.wait(2),
            Happening::AThousandCyclesMore => self.wait(1_000),
            Happening::Forget => {
                self.bench.slave.forget();
                (Answer::Nothing, next - 1)
            }
            Happening::Resume => {
                let line = *Bench::in_state(SyncState::Locked).slave.line().unwrap();
                self.bench.slave.resume(TimeLine { cycle: next - 1, ..line });
                (Answer::Nothing, next - 1)
            }
        }
    }

    /// From a backup on the same line, so much later than its cycle's start.
    fn hear_backup(&mut self, cycle: u32, late: i64) -> Result<Followed, Refusal> {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * PERIOD + AHEAD);
        let late = Span::from_nanos(late);
        let rx = Instant::from_nanos(u64::from(cycle) * PERIOD) + late;
        self.bench.slave.on_sync(rx, BACKUP, cycle, sched + late, sched, &mut self.bench.events)
    }

    /// Scheduled for an hour later.
    fn hear_hour_off(&mut self, cycle: u32) -> Result<Followed, Refusal> {
        let (rx, xmit) = (u64::from(cycle) * PERIOD, GlobalTime::from_nanos(u64::from(cycle) * PERIOD));
        let sched = xmit + Span::from_millis(3_600_000);
        let Bench { slave, events } = &mut self.bench;
        slave.on_sync(Instant::from_nanos(rx), MASTER, cycle, xmit, sched, events)
    }

    /// A request leaves; the reply is to one that left `other` later, and says that it was received then.
    fn reply(&mut self, other: u64, received: u64) -> Answer {
        let Bench { slave, events } = &mut self.bench;
        let sent = u64::from(self.next - 1) * PERIOD + 400_000;
        slave.calibration_mut().begin_round();
        slave.calibration_mut().sent(Instant::from_nanos(sent));
        match slave.on_reply(Instant::from_nanos(sent + 1_400), sent + other, received, 0, events) {
            Ok(true) => Answer::Calibrated,
            Ok(false) => Answer::Nothing,
            Err(reason) => Answer::Refused(reason),
        }
    }

    /// Until the middle of the cycle that it is, or so many later.
    fn wait(&mut self, cycles: u32) -> (Answer, u32) {
        let cycle = self.next - 1 + cycles;
        self.bench.wait_until(u64::from(cycle) * PERIOD + PERIOD / 2);
        (Answer::Nothing, cycle)
    }
}

/// The table.
fn expected(happening: Happening, place: Place) -> Outcome {
    use Place::*;
    const AGREES: Answer = Answer::Sync(Followed::Agrees);
    const NEW_LINE: Answer = Answer::Sync(Followed::NewLine);
    const PENDING: Answer = Answer::Sync(Followed::Pending);
    let stays = |answer, told| (place.state(), answer, told);
    let locked = |answer, told| (SyncState::Locked, answer, told);
    let lost = (SyncState::Lost, Answer::Nothing, Some(EventKind::SyncLost));
    let step = stays(PENDING, Some(EventKind::TimeStep));
    let refused = |reason| stays(Answer::Refused(reason), None);
    match happening {
        Happening::NextSync | Happening::AnothersSync => match place {
            Nothing | GivenUp => stays(PENDING, None),
            First => locked(NEW_LINE, Some(EventKind::Locked)),
            Calibrating | Locked | Anew | Doubled | HeldUp | Moved => stays(AGREES, None),
            HeldUpTwice | Holdover | Bridging => locked(AGREES, None),
            Lost => locked(AGREES, Some(EventKind::Locked)),
            LostUncalibrated => (SyncState::Calibrating, AGREES, None),
        },
        Happening::HeldUpSync => match place {
            Nothing | First | GivenUp => stays(PENDING, None),
            HeldUpTwice => locked(NEW_LINE, None),
            Calibrating | Locked | Anew | Doubled | HeldUp | Moved | Holdover | Bridging | Lost
            | LostUncalibrated => step,
        },
        Happening::JumpedSync => match place {
            Nothing | First | GivenUp => stays(PENDING, None),
            Moved => locked(NEW_LINE, None),
            Calibrating | Locked | Anew | Doubled | HeldUp | HeldUpTwice | Holdover | Bridging | Lost
            | LostUncalibrated => step,
        },
        Happening::RenumberedSync => match place {
            Nothing | First | GivenUp => stays(PENDING, None),
            Calibrating | Locked | Anew | Doubled | HeldUp | HeldUpTwice | Moved | Holdover | Bridging
            | Lost | LostUncalibrated => step,
        },
        Happening::RepeatedSync | Happening::BackupsRepeat => match place {
            Nothing | First | GivenUp => stays(PENDING, None),
            Calibrating | Locked | Anew | Doubled | HeldUp | HeldUpTwice | Moved | Holdover | Bridging
            | Lost | LostUncalibrated => {
                stays(Answer::Refused(Refusal::DuplicateCycle), Some(EventKind::DuplicateCycle))
            }
        },
        Happening::ImplausibleSync => refused(Refusal::ImplausibleSync),
        Happening::Reply => match place {
            Calibrating => locked(Answer::Calibrated, Some(EventKind::Locked)),
            LostUncalibrated => stays(Answer::Calibrated, None),
            // It goes on as before, with another delay.
            Anew => stays(Answer::Nothing, Some(EventKind::CalibratedAnew)),
            Nothing | First | Locked | Doubled | HeldUp | HeldUpTwice | Moved | Holdover | Bridging
            | Lost | GivenUp => refused(Refusal::UnexpectedReply),
        },
        Happening::ForeignReply => refused(Refusal::UnexpectedReply),
        Happening::ImplausibleReply => match place {
            Calibrating | LostUncalibrated | Anew => refused(Refusal::ImplausibleReply),
            Nothing | First | Locked | Doubled | HeldUp | HeldUpTwice | Moved | Holdover | Bridging
            | Lost | GivenUp => refused(Refusal::UnexpectedReply),
        },
        Happening::HalfACycle => match place {
            // What may be held up, or is of another line, is missing.
            HeldUp | Moved => (SyncState::Holdover, Answer::Nothing, Some(EventKind::Holdover)),
            HeldUpTwice => lost,
            Nothing | First | Calibrating | Locked | Anew | Doubled | Holdover | Bridging | Lost
            | LostUncalibrated | GivenUp => stays(Answer::Nothing, None),
        },
        Happening::OneCycleMore => match place {
            Locked | Anew | Doubled => (SyncState::Holdover, Answer::Nothing, Some(EventKind::Holdover)),
            HeldUp | HeldUpTwice | Moved | Holdover => lost,
            // One that is missing does not interrupt a calibration.
            Nothing | First | Calibrating | Bridging | Lost | LostUncalibrated | GivenUp => {
                stays(Answer::Nothing, None)
            }
        },
        Happening::TwoCyclesMore => match place {
            Calibrating | Locked | Anew | Doubled | HeldUp | HeldUpTwice | Moved | Holdover => lost,
            Nothing | First | Bridging | Lost | LostUncalibrated | GivenUp => stays(Answer::Nothing, None),
        },
        Happening::AThousandCyclesMore => match place {
            Calibrating | Locked | Anew | Doubled | HeldUp | HeldUpTwice | Moved | Holdover | Bridging => {
                lost
            }
            Lost | LostUncalibrated => stays(Answer::Nothing, Some(EventKind::LineGivenUp)),
            Nothing | First | GivenUp => stays(Answer::Nothing, None),
        },
        Happening::Forget => (SyncState::Waiting, Answer::Nothing, None),
        Happening::Resume => match place {
            Calibrating | LostUncalibrated => (SyncState::Calibrating, Answer::Nothing, None),
            Nothing | First | Locked | Anew | Doubled | HeldUp | HeldUpTwice | Moved | Holdover
            | Bridging | Lost | GivenUp => locked(Answer::Nothing, None),
        },
    }
}

#[test]
fn every_state_answers_every_event() {
    for place in PLACES {
        for happening in HAPPENINGS {
            let mut seat = place.take();
            let (answer, cycle) = seat.meet(happening);
            let Bench { slave, .. } = &seat.bench;
            let (state, sends) = (slave.state(), slave.may_send(cycle));
            let told: Vec<EventKind> = seat.bench.told().into_iter().map(|(_, kind)| kind).collect();
            let (expected_state, expected_answer, expected_told) = expected(happening, place);
            let expected = (expected_state, expected_answer, Vec::from_iter(expected_told));
            assert_eq!((state, answer, told), expected, "{happening:?} while {place:?}");
            let silent = matches!(state, SyncState::Waiting | SyncState::Lost);
            assert!(!(silent && sends), "{happening:?} while {place:?}: it sends while {state:?}");
        }
    }
}
