//! Every state of a calibration against everything that can happen to it, at a slave as a whole.

use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Claimed, Discipline, EventKind, Sent, SyncState};
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::Address;

use super::Calibration;
use crate::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, NewRounds, Refused, Role, RoleConfig, SlaveConfig,
    SlotConfig, Tdma, TdmaCommand, TdmaConfig,
};
use crate::wire::{self, Message, Rtmac};

const OWN: Address = Address([2, 0, 0, 0, 0, 1]);
const MASTER: Address = Address([2, 0, 0, 0, 0, 2]);
const BACKUP: Address = Address([2, 0, 0, 0, 0, 3]);
const SLOT: u64 = 400;
const ROUNDS: u32 = 2;
/// Three for each round, and 20.
const ATTEMPTS: u32 = 26;

/// Where a calibration can be.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    /// Done, and measured anew: the same again.
    Anew,
    AnewOutstanding,
    AnewLastOutstanding,
    AnewExhausted,
}

const PLACES: [Place; 10] = [
    Place::NoLine,
    Place::Idle,
    Place::Outstanding,
    Place::LastOutstanding,
    Place::Exhausted,
    Place::Done,
    Place::Anew,
    Place::AnewOutstanding,
    Place::AnewLastOutstanding,
    Place::AnewExhausted,
];

/// What can happen.
#[derive(Clone, Copy, Debug)]
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

const HAPPENINGS: [Happening; 12] = [
    Happening::Sent,
    Happening::Stalled,
    Happening::Late,
    Happening::Guarded,
    Happening::Failed,
    Happening::Reply,
    Happening::ForeignReply,
    Happening::ImplausibleReply,
    Happening::SyncLost,
    Happening::LineMoved,
    Happening::MasterChanged,
    Happening::Command,
];

/// What can be seen of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Idle,
    Outstanding,
    Done,
    AnewIdle,
    AnewOutstanding,
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

/// Where it is then, with so many samples, attempts and repeats; what it answers; what it tells of, if of calibration.
type Outcome = (Phase, (usize, u32, u64), Answer, Option<EventKind>);

/// A slave in its place, and the cycle that it is.
struct Seat {
    slave: Tdma,
    cycle: u32,
    /// When its last request left.
    asked: u64,
}

impl Place {
    fn take(self) -> Seat {
        let mut seat = Seat::new();
        if self != Place::NoLine {
            seat.hear_sync(MASTER, 0);
            seat.hear_sync(MASTER, 0);
        }
        match self {
            Place::NoLine | Place::Idle => {}
            Place::Done => seat.calibrate(),
            Place::Anew | Place::AnewOutstanding | Place::AnewLastOutstanding | Place::AnewExhausted => {
                seat.calibrate();
                seat.command();
            }
            Place::Outstanding | Place::LastOutstanding | Place::Exhausted => {}
        }
        match self {
            Place::NoLine | Place::Idle | Place::Done | Place::Anew => {}
            Place::Outstanding | Place::AnewOutstanding => {
                seat.ask(Happening::Sent);
            }
            Place::LastOutstanding | Place::AnewLastOutstanding => {
                seat.ask(Happening::Sent);
                seat.reply(0, 0);
                seat.ask(Happening::Sent);
            }
            Place::Exhausted | Place::AnewExhausted => {
                for _ in 0..ATTEMPTS {
                    seat.ask(Happening::Sent);
                }
            }
        }
        while seat.slave.next_event().is_some() {}
        seat
    }

    /// What there is to be seen of it before anything happens.
    fn seen(self) -> (Phase, (usize, u32, u64)) {
        match self {
            Place::NoLine | Place::Idle => (Phase::Idle, (0, 0, 0)),
            Place::Outstanding => (Phase::Outstanding, (0, 1, 0)),
            Place::LastOutstanding => (Phase::Outstanding, (1, 2, 0)),
            Place::Exhausted => (Phase::Outstanding, (0, ATTEMPTS, u64::from(ATTEMPTS) - 1)),
            Place::Done => (Phase::Done, (0, 0, 0)),
            Place::Anew => (Phase::AnewIdle, Place::Idle.seen().1),
            Place::AnewOutstanding => (Phase::AnewOutstanding, Place::Outstanding.seen().1),
            Place::AnewLastOutstanding => (Phase::AnewOutstanding, Place::LastOutstanding.seen().1),
            Place::AnewExhausted => (Phase::AnewOutstanding, Place::Exhausted.seen().1),
        }
    }
}

fn at(micros: u64) -> Instant {
    Instant::from_nanos(micros * 1_000)
}

impl Seat {
    fn new() -> Self {
        let latest = Span::from_micros(20);
        let offset = Span::from_micros(SLOT as i64);
        let slave = Tdma::new(&TdmaConfig {
            address: OWN,
            role: RoleConfig::Slave(SlaveConfig { rounds: ROUNDS, ..SlaveConfig::default() }),
            slots: vec![SlotConfig { id: 0, offset, phase: 0, period: 1, size: 100, joint: None, latest }],
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        });
        Self { slave: slave.unwrap(), cycle: 0, asked: 0 }
    }

    fn calibration(&self) -> &Calibration {
        match &self.slave.role {
            Role::Slave(slave) => slave.calibration(),
            _ => unreachable!("it is a slave"),
        }
    }

    fn seen(&self) -> (Phase, (usize, u32, u64)) {
        let calibration = self.calibration();
        let phase = match (calibration.measures_anew(), calibration.delay, calibration.outstanding) {
            (true, _, Some(_)) => Phase::AnewOutstanding,
            (true, _, None) => Phase::AnewIdle,
            (false, Some(_), _) => Phase::Done,
            (false, None, Some(_)) => Phase::Outstanding,
            (false, None, None) => Phase::Idle,
        };
        (phase, (calibration.room.samples.len(), calibration.attempts, calibration.repeats()))
    }

    fn hear(&mut self, from: Address, to: Address, rx: Instant, message: Message) -> Answer {
        let mut frame = Pool::new(1).take().unwrap();
        message.write(to, from, &mut frame);
        match self.slave.on_frame(Some(rx), frame) {
            Claimed::Kept => Answer::Kept,
            Claimed::Refused(reason) => Answer::Refused(reason),
            Claimed::Tunnel(_) => unreachable!("it is no tunnel's"),
        }
    }

    /// The next Synchronisation, so many microseconds beside the line.
    fn hear_sync(&mut self, from: Address, beside: u64) -> Answer {
        self.cycle += 1;
        let start = at(u64::from(self.cycle) * 1_000 + beside);
        let sched = GlobalTime::from_nanos(start.nanos());
        let sync = Message::Sync { cycle: self.cycle, xmit: sched, sched };
        let answer = self.hear(from, Address::BROADCAST, start, sync);
        self.slave.on_timeout(start);
        answer
    }

    /// All rounds.
    fn calibrate(&mut self) {
        for _ in 0..ROUNDS {
            self.ask(Happening::Sent);
            self.reply(0, 0);
        }
    }

    fn command(&mut self) -> Answer {
        let now = at(u64::from(self.cycle) * 1_000 + SLOT + 100);
        match self.slave.command(now, &mut TdmaCommand::Calibrate(NewRounds::of(ROUNDS).unwrap())) {
            Ok(_) => Answer::Begun,
            Err(refused) => {
                assert_eq!(refused, Refused::CalibratesAlready);
                Answer::Busy
            }
        }
    }

    /// Up to its next turn, with Synchronisations; where it follows nobody, there are none. Anew it asks in every fourth.
    fn ask(&mut self, outcome: Happening) -> Answer {
        let cycles = if self.calibration().measures_anew() { 5 } else { 3 };
        for _ in 0..cycles {
            let now = at(u64::from(self.cycle) * 1_000 + SLOT);
            self.slave.on_timeout(now);
            if let Some(request) = self.slave.next_transmission(now) {
                let is_request =
                    matches!(wire::parse(&request.frame), Ok(Rtmac::Tdma(Message::Request { .. })));
                assert!(is_request, "there is nothing else to send");
                self.asked = now.nanos();
                let late = now + Span::from_micros(30);
                self.slave.on_sent(match outcome {
                    Happening::Stalled => Sent::StalledUntil(late),
                    Happening::Late => Sent::Late(late, request.frame),
                    Happening::Guarded => Sent::Guarded(late, request.frame),
                    Happening::Failed => Sent::Failed(105, request.frame),
                    _ => Sent::At(now),
                });
                return Answer::Asked;
            }
            if self.slave.time().state != SyncState::Waiting {
                self.hear_sync(MASTER, 0);
            }
        }
        Answer::Nothing
    }

    /// A reply to a request that left `other` nanoseconds later, received at the master's time `reception`.
    fn reply(&mut self, other: u64, reception: u64) -> Answer {
        let request_xmit = self.asked + other;
        let rx = Instant::from_nanos(self.asked + 1_400);
        self.hear(MASTER, OWN, rx, Message::Reply { request_xmit, reception, xmit: 0 })
    }

    fn meet(&mut self, happening: Happening) -> Answer {
        match happening {
            Happening::Sent
            | Happening::Stalled
            | Happening::Late
            | Happening::Guarded
            | Happening::Failed => self.ask(happening),
            Happening::Reply => self.reply(0, 0),
            Happening::ForeignReply => self.reply(1, 0),
            Happening::ImplausibleReply => self.reply(0, u64::MAX / 4),
            Happening::SyncLost => {
                self.slave.on_timeout(at(u64::from(self.cycle) * 1_000 + 2_500));
                Answer::Nothing
            }
            Happening::LineMoved => {
                self.hear_sync(MASTER, 300);
                self.hear_sync(MASTER, 300)
            }
            Happening::MasterChanged => self.hear_sync(BACKUP, 0),
            Happening::Command => self.command(),
        }
    }
}

/// The table.
fn expected(happening: Happening, place: Place) -> Outcome {
    use Place::*;
    let (phase, (samples, attempts, repeats)) = place.seen();
    let stays = |answer| (phase, (samples, attempts, repeats), answer, None);
    let unexpected = stays(Answer::Refused(Refusal::UnexpectedReply));
    // A delay that is known stays meanwhile.
    let (idle, outstanding) = match phase {
        Phase::Idle | Phase::Outstanding | Phase::Done => (Phase::Idle, Phase::Outstanding),
        Phase::AnewIdle | Phase::AnewOutstanding => (Phase::AnewIdle, Phase::AnewOutstanding),
    };
    // The rounds so far count, and no reply that is still to come.
    let other_line = (idle, (samples, 0, repeats), Answer::Kept, None);
    // One that had no reply is repeated.
    let asked = |phase, told| match place {
        NoLine | Done => stays(Answer::Nothing),
        Idle | Anew => (phase, (samples, attempts + 1, repeats), Answer::Asked, told),
        Outstanding | LastOutstanding | AnewOutstanding | AnewLastOutstanding => {
            (phase, (samples, attempts + 1, repeats + 1), Answer::Asked, told)
        }
        Exhausted => (Phase::Idle, (0, 0, repeats + 1), Answer::Nothing, Some(EventKind::CalibrationTimeout)),
        AnewExhausted => {
            (Phase::Done, (0, 0, repeats + 1), Answer::Nothing, Some(EventKind::CalibrationTimeout))
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
            NoLine | Idle | Done | Anew => unexpected,
            Outstanding | Exhausted | AnewOutstanding | AnewExhausted => {
                (idle, (samples + 1, attempts, repeats), Answer::Kept, None)
            }
            LastOutstanding => (Phase::Done, (0, 0, repeats), Answer::Kept, Some(EventKind::Locked)),
            AnewLastOutstanding => {
                (Phase::Done, (0, 0, repeats), Answer::Kept, Some(EventKind::CalibratedAnew))
            }
        },
        Happening::ForeignReply => unexpected,
        Happening::ImplausibleReply => match place {
            NoLine | Idle | Done | Anew => unexpected,
            Outstanding | LastOutstanding | Exhausted | AnewOutstanding | AnewLastOutstanding
            | AnewExhausted => {
                let refused = Answer::Refused(Refusal::ImplausibleReply);
                (idle, (samples, attempts, repeats), refused, None)
            }
        },
        Happening::SyncLost => match place {
            NoLine => stays(Answer::Nothing),
            Idle | Outstanding | LastOutstanding | Exhausted | Done | Anew | AnewOutstanding
            | AnewLastOutstanding | AnewExhausted => {
                (phase, (samples, attempts, repeats), Answer::Nothing, Some(EventKind::SyncLost))
            }
        },
        Happening::LineMoved => match place {
            NoLine => stays(Answer::Kept),
            Idle | Outstanding | LastOutstanding | Exhausted => other_line,
            // Whose slot had a turn on the line that was left.
            Done => (phase, (samples, attempts, repeats), Answer::Kept, Some(EventKind::Overrun)),
            Anew => (idle, (samples, 0, repeats), Answer::Kept, Some(EventKind::Overrun)),
            // That one was left to the reply.
            AnewOutstanding | AnewLastOutstanding | AnewExhausted => other_line,
        },
        Happening::MasterChanged => match place {
            NoLine | Done => stays(Answer::Kept),
            Idle | Outstanding | LastOutstanding | Exhausted | Anew | AnewOutstanding
            | AnewLastOutstanding | AnewExhausted => other_line,
        },
        Happening::Command => match place {
            Done => (Phase::AnewIdle, (0, 0, repeats), Answer::Begun, None),
            NoLine | Idle | Outstanding | LastOutstanding | Exhausted | Anew | AnewOutstanding
            | AnewLastOutstanding | AnewExhausted => stays(Answer::Busy),
        },
    }
}

#[test]
fn every_state_of_a_calibration_answers_every_event() {
    for place in PLACES {
        for happening in HAPPENINGS {
            let mut seat = place.take();
            assert_eq!(seat.seen(), place.seen(), "{place:?}");
            let answer = seat.meet(happening);
            let (phase, counts) = seat.seen();
            let events = std::iter::from_fn(|| seat.slave.next_event()).map(|event| event.kind);
            let of_the_line = |kind: &EventKind| matches!(kind, EventKind::TimeStep | EventKind::Holdover);
            let of_turns =
                |kind: &EventKind| matches!(kind, EventKind::SlotEmpty | EventKind::CalibrationTurn);
            let told = events.filter(|kind| !of_the_line(kind) && !of_turns(kind));
            let told: Vec<EventKind> = told.collect();
            let (expected_phase, expected_counts, expected_answer, expected_told) =
                expected(happening, place);
            let expected = (expected_phase, expected_counts, expected_answer, Vec::from_iter(expected_told));
            assert_eq!((phase, counts, answer, told), expected, "{happening:?} while {place:?}");
        }
    }
}
