//! Every place of a token, as one station knows it, against everything that can happen.

use super::super::ring::RingConfig;
use super::*;
use rtnet::wire::ethernet::Address;

const OWN: u8 = 1;
const BEGIN: Instant = Instant::from_nanos(10_000_000_000);

/// Where a token can be.
#[derive(Clone, Copy, Debug, PartialEq)]
enum At {
    Elsewhere,
    /// It was here, and could not be passed on in time.
    LetGo,
    Claimed,
    Here,
    PassedOn,
    /// It was sent once more.
    PassedTwice,
}

const PLACES: [At; 6] = [At::Elsewhere, At::LetGo, At::Claimed, At::Here, At::PassedOn, At::PassedTwice];

/// What can happen.
#[derive(Clone, Copy, Debug)]
enum Happening {
    /// The next token is heard, for this station.
    ForUs,
    /// The same for another.
    ForOthers,
    /// The last one is told of once more, by another.
    Again,
    /// The one before the last.
    Stale,
    OfAnotherRing,
    /// Somebody says that he has our place.
    FromUs,
    /// The next instant has come; what is due then is sent.
    Due,
    /// The host runs again after a second.
    HeldUp,
}

const HAPPENINGS: [Happening; 8] = [
    Happening::ForUs,
    Happening::ForOthers,
    Happening::Again,
    Happening::Stale,
    Happening::OfAnotherRing,
    Happening::FromUs,
    Happening::Due,
    Happening::HeldUp,
];

/// What comes of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Answer {
    Nothing,
    Heard(Heard),
    Refused(Refusal),
    Sends(Act),
    Lost,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Then {
    Listening,
    Claiming,
    Holding,
    Passed,
}

struct Seat {
    rotation: Rotation,
    now: Instant,
}

impl Seat {
    fn new() -> Self {
        let stations: Vec<_> = (1..=4).map(|last| Address([2, 0, 0, 0, 0, last])).collect();
        let ring = Ring::new(RingConfig::new(stations.clone()), stations[usize::from(OWN)]).unwrap();
        let mut seat = Self { rotation: Rotation::new(ring), now: BEGIN };
        seat.rotation.look(BEGIN);
        let token = seat.rotation.token(0b1111, 0);
        let first = Token { generation: 5, sequence: 9, from: 2, to: 3, ..token };
        seat.rotation.hear(BEGIN, &first).unwrap();
        seat
    }

    fn take(at: At) -> Self {
        let mut seat = Self::new();
        match at {
            At::Elsewhere => seat.hears(3, 0, 1),
            _ => seat.hears(0, OWN, 1),
        };
        match at {
            At::Elsewhere | At::Here => {}
            At::LetGo => assert_eq!(seat.is_held_up(), Answer::Lost),
            At::Claimed => {
                seat.is_held_up();
                // It has listened for long enough.
                assert_eq!(seat.waits(), Answer::Sends(Act::Claim));
            }
            At::PassedOn => assert_eq!(seat.waits(), Answer::Sends(Act::Pass)),
            At::PassedTwice => {
                assert_eq!(seat.waits(), Answer::Sends(Act::Pass));
                assert_eq!(seat.waits(), Answer::Sends(Act::Repeat));
            }
        }
        seat
    }

    fn meet(&mut self, happening: Happening) -> Answer {
        match happening {
            Happening::ForUs => self.hears(0, OWN, 1),
            Happening::ForOthers => self.hears(3, 0, 1),
            Happening::Again => {
                let to = self.rotation.seen().unwrap().to;
                self.hears(3, to, 0)
            }
            Happening::Stale => self.hears(3, 2, -1),
            Happening::OfAnotherRing => {
                let digest = self.rotation.ring.digest() + 1;
                let token = Token { digest, ..self.token(3, 0, 1) };
                self.rotation.hear(self.now, &token).map_or_else(Answer::Refused, Answer::Heard)
            }
            Happening::FromUs => self.hears(OWN, 2, 1),
            Happening::Due => self.waits(),
            Happening::HeldUp => self.is_held_up(),
        }
    }

    fn token(&self, from: u8, to: u8, later: i32) -> Token {
        let seen = self.rotation.seen().unwrap();
        let token = self.rotation.token(0b1111, to);
        Token { from, sequence: seen.sequence.wrapping_add_signed(later), ..token }
    }

    fn hears(&mut self, from: u8, to: u8, later: i32) -> Answer {
        let token = self.token(from, to, later);
        self.rotation.hear(self.now, &token).map_or_else(Answer::Refused, Answer::Heard)
    }

    /// Waits for the next instant at which there is something to do.
    fn waits(&mut self) -> Answer {
        self.now = self.rotation.deadline().expect("it waits for something").max(self.now);
        self.acts()
    }

    fn is_held_up(&mut self) -> Answer {
        self.now += Span::from_millis(1_000);
        self.acts()
    }

    fn acts(&mut self) -> Answer {
        if self.rotation.look(self.now).is_some() {
            return Answer::Lost;
        }
        let Some((act, token, at, latest)) = self.rotation.next(self.now) else { return Answer::Nothing };
        assert!(at >= self.now && latest >= at);
        self.now = at;
        self.rotation.sent(act, &token, at);
        Answer::Sends(act)
    }

    fn then(&self) -> Then {
        match self.rotation.place() {
            Place::Listening => Then::Listening,
            Place::Claiming(_) => Then::Claiming,
            Place::Holding(_) => Then::Holding,
            Place::Passed(_) => Then::Passed,
        }
    }
}

/// The table.
fn expected(at: At, happening: Happening) -> (Then, Answer) {
    use At::*;
    use Then::*;
    let stays = match at {
        Elsewhere | LetGo => Listening,
        Claimed => Claiming,
        Here => Holding,
        PassedOn | PassedTwice => Passed,
    };
    let on_its_way = Answer::Heard(super::Heard::OnItsWay { gave_up: matches!(at, Claimed | Here) });
    let again = Answer::Heard(super::Heard::Repeated);
    match happening {
        Happening::ForUs => (Holding, on_its_way),
        Happening::ForOthers => (Listening, on_its_way),
        Happening::Again if at == LetGo => (Holding, again),
        Happening::Again => (stays, again),
        Happening::Stale => (stays, Answer::Refused(Refusal::TokenStale)),
        Happening::OfAnotherRing => (stays, Answer::Refused(Refusal::TokenRing)),
        Happening::FromUs => (stays, Answer::Refused(Refusal::ForgedSource)),
        Happening::Due => match at {
            Elsewhere | LetGo => (Claiming, Answer::Sends(Act::Claim)),
            // It rests first.
            Claimed => (Holding, Answer::Nothing),
            Here => (Passed, Answer::Sends(Act::Pass)),
            PassedOn => (Passed, Answer::Sends(Act::Repeat)),
            PassedTwice => (Passed, Answer::Sends(Act::Skip)),
        },
        Happening::HeldUp => match at {
            // It may have missed what there was to be heard.
            Elsewhere | LetGo => (Listening, Answer::Nothing),
            Claimed | Here => (Listening, Answer::Lost),
            PassedOn => (Passed, Answer::Sends(Act::Repeat)),
            PassedTwice => (Passed, Answer::Sends(Act::Skip)),
        },
    }
}

#[test]
fn every_place_of_a_token_answers_every_event() {
    for at in PLACES {
        for happening in HAPPENINGS {
            let mut seat = Seat::take(at);
            let answer = seat.meet(happening);
            assert_eq!((seat.then(), answer), expected(at, happening), "{happening:?} while {at:?}");
        }
    }
}

#[test]
fn a_claim_is_of_the_next_generation_and_a_skip_of_the_next_pass() {
    let mut seat = Seat::take(At::Elsewhere);
    let before = seat.rotation.seen().unwrap();
    seat.waits();
    let claim = seat.rotation.seen().unwrap();
    assert_eq!(
        (claim.generation, claim.sequence, claim.from, claim.to),
        (before.generation + 1, 0, OWN, OWN)
    );
    let mut seat = Seat::take(At::PassedTwice);
    let before = seat.rotation.seen().unwrap();
    seat.waits();
    let skip = seat.rotation.seen().unwrap();
    assert_eq!((skip.sequence, skip.to, seat.rotation.present()), (before.sequence + 1, 3, 0b1011));
}

#[test]
fn what_is_told_once_more_is_waited_for_anew() {
    let mut seat = Seat::take(At::PassedOn);
    let due = seat.rotation.deadline().unwrap();
    seat.now += Span::from_micros(100);
    seat.meet(Happening::Again);
    assert_eq!(seat.rotation.deadline().unwrap() - due, Span::from_micros(100));
}
