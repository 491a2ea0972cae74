//! Every state of a change, as this station leads it or follows another, against everything that can happen; in `tests/rules.rs`
//! what may be sent when, and what is refused; in `tests/model.rs` whole networks by chance.

mod model;
mod rules;

use super::*;
use crate::tdma::tests::every::every;
use crate::wire::change::{Answer, Verdict};

const OWN: Address = Address([2, 0, 0, 0, 0, 1]);
const BACKUP: Address = Address([2, 0, 0, 0, 0, 2]);
const SLAVE: Address = Address([2, 0, 0, 0, 0, 3]);
/// The cycle in which everything begins.
pub(super) const NOW: u32 = 0xffff_ffe0;

pub(super) fn slot(micros: i64) -> SlotConfig {
    let (offset, latest) = (Span::from_micros(micros), Span::from_micros(10));
    SlotConfig { id: 0, offset, phase: 0, period: 1, size: 46, joint: None, latest }
}

/// A schedule in which all slots are so much later.
pub(super) fn book(shift: i64, stations: &[Address]) -> Book {
    let slots = stations.iter().zip(1i64..).map(|(&station, n)| (station, slot(n * 100 + shift)));
    Book::of(Span::from_micros(1_000), slots).unwrap()
}

pub(super) fn config(masters: &[Address], stations: &[Address]) -> ChangeConfig {
    let (first, masters) = (Some(book(0, stations).into()), masters.to_vec());
    ChangeConfig {
        capacity: 16,
        is_reserved: true,
        first,
        masters,
        behind: Span::from_micros(10),
        latest: Span::from_micros(10),
    }
}

every! {
    /// Where a station can be.
    enum Place {
        LeadsIdle,
        /// One of two has acknowledged; it is to be activated once all have.
        LeadsAsking,
        /// All have acknowledged, and it is not said when to switch.
        LeadsReady,
        LeadsCommitted,
        /// It took over from who had committed it, and had confirmed.
        LeadsInherited,
        LeadsSealed,
        LeadsSwitched,
        LeadsCancelled,
        /// It slept for long.
        LeadsUnsure,
        FollowsIdle,
        FollowsProposed,
        /// It has not confirmed.
        FollowsCommitted,
        FollowsConfirmed,
        FollowsSealed,
        FollowsSwitched,
        FollowsCancelled,
        FollowsUnsure,
    }
}

every! {
    enum Happening {
        /// Its next Synchronisation, if it gives the time; else it takes over.
        Speaks,
        /// The one of a cycle in which all that is waited for must have come.
        SpeaksMuchLater,
        /// The one of the activation cycle.
        SpeaksInActivation,
        /// The first after a long sleep.
        SleepsThenSpeaks,
        AllAcknowledge,
        OneRefuses,
        AllConfirm,
        Propose,
        Activate,
        Cancel,
        HearsIdle,
        HearsProposed,
        HearsSealed,
        HearsUnsure,
    }
}

struct Seat {
    change: Change,
    cycle: u32,
}

impl Seat {
    fn new() -> Self {
        let config = config(&[OWN, BACKUP], &[OWN, BACKUP, SLAVE]);
        Seat { change: Change::new(&config, 7), cycle: NOW }
    }

    fn id(&self) -> ScheduleId {
        book(50, &[OWN, BACKUP, SLAVE]).numbered(1).id()
    }

    fn speak(&mut self) -> Status {
        self.cycle = self.cycle.wrapping_add(1);
        let said = self.change.say(self.cycle, true);
        self.change.spoke(self.cycle);
        said
    }

    fn propose(&mut self, activation: Option<Activation>) -> Result<(), super::super::Refused> {
        self.change.propose(self.cycle, OWN, &book(50, &[OWN, BACKUP, SLAVE]), activation)
    }

    fn answer(&mut self, from: Address, verdict: Verdict) {
        let digest = self.change.admin.digest();
        let answer = Answer { id: self.id(), digest, verdict, gives_time: from == BACKUP };
        let _ = self.change.on_answer(self.cycle, from, &answer);
    }

    fn answers(&mut self, verdict: Verdict) {
        self.answer(BACKUP, verdict);
        self.answer(SLAVE, verdict);
    }

    fn hear(&mut self, state: State, activation: u32) {
        self.hear_of(state, activation, true);
    }

    fn hear_of(&mut self, state: State, activation: u32, is_sure: bool) {
        self.cycle = self.cycle.wrapping_add(1);
        let (oper, admin) = (ScheduleId::default(), self.id());
        let oper = if state == State::Switched { admin } else { oper };
        self.change.hear(self.cycle, Some(Status { oper, admin, activation, state, is_sure }));
    }

    /// All of the schedule has come, and can be used.
    fn collect(&mut self) {
        let whole = book(50, &[OWN, BACKUP, SLAVE]).numbered(1);
        (0..3).for_each(|i| _ = self.change.take(&whole.part(i).unwrap()).unwrap());
        self.change.judged(Ok(()));
    }

    fn at(place: Place) -> Self {
        let mut seat = Seat::new();
        let activation = NOW.wrapping_add(60);
        match place {
            Place::LeadsIdle => _ = seat.speak(),
            Place::LeadsAsking => {
                seat.speak();
                seat.propose(Some(Activation::Soon)).unwrap();
                seat.answer(SLAVE, Verdict::Acknowledged);
            }
            Place::LeadsReady => {
                seat.speak();
                seat.propose(None).unwrap();
                seat.answers(Verdict::Acknowledged);
            }
            Place::LeadsCommitted => {
                seat = Seat::at(Place::LeadsReady);
                seat.change.activate(seat.cycle, Activation::Soon).unwrap();
                seat.speak();
            }
            Place::LeadsInherited => {
                seat = Seat::at(Place::FollowsConfirmed);
                seat.speak();
            }
            Place::LeadsSealed => {
                seat = Seat::at(Place::LeadsCommitted);
                seat.answers(Verdict::Confirmed);
                seat.speak();
            }
            Place::LeadsSwitched => {
                seat = Seat::at(Place::LeadsSealed);
                seat.meet(Happening::SpeaksInActivation);
            }
            Place::LeadsCancelled => {
                seat = Seat::at(Place::LeadsCommitted);
                seat.change.cancel(seat.cycle).unwrap();
            }
            Place::LeadsUnsure => {
                seat.speak();
                seat.meet(Happening::SleepsThenSpeaks);
            }
            Place::FollowsIdle => seat.hear(State::Idle, 0),
            Place::FollowsProposed => {
                seat.hear(State::Proposed, NOW);
                seat.collect();
            }
            Place::FollowsCommitted | Place::FollowsConfirmed => {
                seat = Seat::at(Place::FollowsProposed);
                seat.hear(State::Committed, activation);
                if place == Place::FollowsConfirmed {
                    let confirmed = seat.change.answer(true).unwrap();
                    assert_eq!(confirmed.verdict, Verdict::Confirmed);
                    seat.change.answers(&confirmed);
                }
            }
            Place::FollowsSealed => {
                seat = Seat::at(Place::FollowsConfirmed);
                seat.hear(State::Sealed, activation);
            }
            Place::FollowsSwitched => {
                seat = Seat::at(Place::FollowsSealed);
                seat.hear(State::Switched, activation);
            }
            Place::FollowsCancelled => {
                seat = Seat::at(Place::FollowsConfirmed);
                seat.hear(State::Cancelled, activation);
            }
            Place::FollowsUnsure => {
                seat = Seat::at(Place::FollowsConfirmed);
                seat.hear_of(State::Committed, activation, false);
            }
        }
        seat
    }

    fn meet(&mut self, happening: Happening) {
        let activation = self.change.told.activation;
        match happening {
            Happening::Speaks => _ = self.speak(),
            Happening::SpeaksMuchLater => (0..400).for_each(|_| _ = self.speak()),
            Happening::SpeaksInActivation => {
                let ahead = activation.wrapping_sub(self.cycle) as i32;
                (0..ahead.max(1)).for_each(|_| _ = self.speak());
            }
            Happening::SleepsThenSpeaks => {
                self.cycle = self.cycle.wrapping_add(DEAF + 3);
                self.speak();
            }
            Happening::AllAcknowledge => {
                self.answers(Verdict::Acknowledged);
                self.speak_if_leading();
            }
            Happening::OneRefuses => {
                self.answer(SLAVE, Verdict::Refused(Why::SlotId, 9));
                self.speak_if_leading();
            }
            Happening::AllConfirm => {
                self.answers(Verdict::Confirmed);
                self.speak_if_leading();
            }
            Happening::Propose => drop(self.propose(Some(Activation::Soon))),
            Happening::Activate => _ = self.change.activate(self.cycle, Activation::Soon),
            Happening::Cancel => drop(self.change.cancel(self.cycle)),
            Happening::HearsIdle => self.hear(State::Idle, 0),
            Happening::HearsProposed => self.hear(State::Proposed, self.cycle),
            Happening::HearsSealed => self.hear(State::Sealed, self.cycle.wrapping_add(50)),
            Happening::HearsUnsure => self.hear_of(State::Sealed, self.cycle.wrapping_add(50), false),
        }
    }

    fn speak_if_leading(&mut self) {
        if self.change.lead.acts {
            self.speak();
        }
    }
}

/// What the station says, or is told, after that; `None`: that is not sure.
fn expected(place: Place, happening: Happening) -> Option<State> {
    use Happening as H;
    use Place as P;
    use State as S;
    let leads = place as u8 <= P::LeadsUnsure as u8;
    let state = match (happening, place) {
        (H::HearsIdle, _) => S::Idle,
        (H::HearsProposed, _) => S::Proposed,
        (H::HearsSealed, _) => S::Sealed,
        (H::HearsUnsure, _) => return None,

        // Who slept while another may have given the time does not know what that one said.
        (H::SleepsThenSpeaks, _) => return None,

        (H::Speaks, P::LeadsIdle | P::FollowsIdle) => S::Idle,
        (H::Speaks, P::LeadsAsking | P::LeadsReady) => S::Proposed,
        (H::Speaks, P::LeadsCommitted | P::LeadsInherited | P::FollowsConfirmed) => S::Committed,
        (H::Speaks, P::LeadsSealed | P::FollowsSealed) => S::Sealed,
        (H::Speaks, P::LeadsSwitched | P::FollowsSwitched) => S::Switched,
        (H::Speaks, P::LeadsCancelled | P::FollowsCancelled) => S::Cancelled,
        // Whoever had not confirmed knows that nobody switches.
        (H::Speaks, P::FollowsProposed | P::FollowsCommitted) => S::Cancelled,
        (H::Speaks, P::LeadsUnsure | P::FollowsUnsure) => return None,

        // It waits for somebody to say when.
        (H::SpeaksMuchLater, P::LeadsReady) => S::Proposed,
        (H::SpeaksMuchLater, _) => S::Idle,

        (H::SpeaksInActivation, P::LeadsSealed | P::FollowsSealed) => S::Switched,
        (
            H::SpeaksInActivation,
            P::LeadsCommitted
            | P::LeadsInherited
            | P::LeadsCancelled
            | P::FollowsCommitted
            | P::FollowsConfirmed
            | P::FollowsCancelled,
        ) => S::Cancelled,
        // Longer than anybody bridges have gone by.
        (H::SpeaksInActivation, P::FollowsUnsure) => S::Cancelled,
        (H::SpeaksInActivation, other) => return expected(other, H::Speaks),

        (H::AllAcknowledge, P::LeadsAsking) => S::Committed,
        (H::AllConfirm, P::LeadsCommitted) => S::Sealed,
        (H::AllConfirm, P::LeadsAsking) => S::Committed,
        (H::OneRefuses, P::LeadsAsking | P::LeadsReady | P::LeadsCommitted) => S::Cancelled,
        (H::AllAcknowledge | H::AllConfirm | H::OneRefuses, other) if leads => {
            return expected(other, H::Speaks);
        }

        (H::Propose, P::LeadsIdle | P::LeadsSwitched | P::LeadsCancelled) => S::Proposed,
        (H::Cancel, P::LeadsAsking | P::LeadsReady | P::LeadsCommitted | P::LeadsInherited) => S::Cancelled,
        // What is said only with the next Synchronisation, and what is refused.
        (_, P::FollowsIdle) => S::Idle,
        (_, P::FollowsProposed) => S::Proposed,
        (_, P::FollowsCommitted | P::FollowsConfirmed) => S::Committed,
        (_, P::FollowsSealed) => S::Sealed,
        (_, P::FollowsSwitched) => S::Switched,
        (_, P::FollowsCancelled) => S::Cancelled,
        (_, P::FollowsUnsure) => return None,
        (_, other) => return expected(other, H::Speaks),
    };
    Some(state)
}

#[test]
fn every_state_answers_every_event() {
    let mut wrong = Vec::new();
    for &place in Place::ALL {
        for &happening in Happening::ALL {
            let mut seat = Seat::at(place);
            seat.meet(happening);
            let told = seat.change.told;
            let (state, expected) = (told.is_sure.then_some(told.state), expected(place, happening));
            if state != expected {
                wrong.push(format!("{happening:?} while {place:?}: {state:?}, not {expected:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
