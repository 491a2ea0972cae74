//! Where the token is, as one station knows: the state machine, without frames.
//!
//! ```text
//!               silence, a step longer for each place                    settled
//! Listening ─────────────────────────────────────────► Claiming ───────────────────► Holding ◄──┐
//!   ▲    │                                                │                          │   │      │
//!   │    │  a token for this station                      │ another claim            │   │      │
//!   │    └────────────────────────────────────────────────┼──────────────────────────┼───┼──────┤
//!   │                                                     │       too late to pass it│   │      │ alone
//!   ├─────────────────────────────────────────────────────┴──────────────────────────┘   │passed│
//!   │                                                                                    ▼      │
//!   └────────────────────────────────────────────────────────────────────────────────  Passed ──┘
//!                           it was passed on, or another one stays                    │    ▲
//!                                                                                     └────┘
//!                                              nothing heard: once more, then to the one behind
//! ```

use rtnet::counters::Refusal;
use rtnet::time::{Instant, Span};

use super::ring::Ring;
use super::wire::{Kind, Mark, Token, all};

/// Where the token is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// With others, or nowhere.
    Listening,
    /// Taken, and not used before this: another one may have been faster.
    Claiming(Instant),
    /// Here.
    Holding(Visit),
    /// With the next one, who has shown no sign of it.
    Passed(Passed),
}

/// The token is here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Visit {
    /// Since when.
    pub since: Instant,
    /// When the medium is free for the next frame.
    pub free_from: Instant,
    /// Time on the air that was used of it.
    pub spent: Span,
}

/// The token was passed on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Passed {
    /// What was sent.
    pub token: Token,
    /// Who has it should have shown that by then.
    pub due: Instant,
    /// It is not sent once more: it was already, or the station was only invited.
    pub is_last_try: bool,
}

/// What is sent of the token, when it is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Act {
    /// On to the next.
    Pass,
    /// On to one that was absent.
    Invite,
    /// The same once more: the next one has shown no sign of it.
    Repeat,
    /// On to the one behind: the next one is absent.
    Skip,
    /// It was lost.
    Claim,
}

/// What a token that was heard means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Heard {
    /// It is on its way. If this station held one, that is void now.
    OnItsWay {
        /// Whether it did.
        gave_up: bool,
    },
    /// It was told of before.
    Repeated,
}

pub(super) struct Rotation {
    ring: Ring,
    place: Place,
    /// The token that stays of all that were heard or sent.
    seen: Option<Mark>,
    /// It was for this station, which let it go: told of once more, it is taken again.
    let_go: bool,
    present: u64,
    since: u16,
    invite: u8,
    /// Since when nothing was heard. None before the first look at the clock.
    silent_since: Option<Instant>,
}

impl Rotation {
    pub fn new(ring: Ring) -> Self {
        let present = all(usize::from(ring.size()));
        Self {
            ring,
            place: Place::Listening,
            seen: None,
            let_go: false,
            present,
            since: 0,
            invite: 0,
            silent_since: None,
        }
    }

    pub fn ring(&self) -> &Ring {
        &self.ring
    }
    pub fn place(&self) -> &Place {
        &self.place
    }
    pub fn seen(&self) -> Option<Mark> {
        self.seen
    }
    pub fn present(&self) -> u64 {
        self.present
    }

    /// Who has shown no sign of the token that it was sent.
    pub fn waits_for(&self) -> Option<u8> {
        match &self.place {
            Place::Passed(passed) => Some(passed.token.to),
            _ => None,
        }
    }

    pub fn visit_mut(&mut self) -> Option<&mut Visit> {
        match &mut self.place {
            Place::Holding(visit) => Some(visit),
            _ => None,
        }
    }

    /// A token was heard, stamped `rx`.
    pub fn hear(&mut self, rx: Instant, token: &Token) -> Result<Heard, Refusal> {
        let ring = &self.ring;
        if (token.size, token.digest) != (ring.size(), ring.digest()) {
            return Err(Refusal::TokenRing);
        }
        if token.from == ring.index() {
            return Err(Refusal::ForgedSource);
        }
        let mark = token.mark();
        match self.seen {
            Some(seen) if mark.repeats(&seen) => {
                self.told_again(rx);
                return Ok(Heard::Repeated);
            }
            Some(seen) if !mark.outlasts(&seen) => return Err(Refusal::TokenStale),
            _ => {}
        }
        let gave_up = matches!(self.place, Place::Holding(_) | Place::Claiming(_));
        self.follow(token);
        self.silent_since = Some(rx);
        if token.kind == Kind::Pass && token.to == self.ring.index() {
            self.hold(rx);
        } else {
            self.place = Place::Listening;
        }
        Ok(Heard::OnItsWay { gave_up })
    }

    /// The same was told once more: by who did not hear it, or by who was skipped.
    fn told_again(&mut self, rx: Instant) {
        self.silent_since = Some(rx);
        if core::mem::take(&mut self.let_go) {
            self.hold(rx);
        } else if let Place::Passed(passed) = &mut self.place {
            // Whoever has it may have it since now.
            passed.due = passed.due.max(rx + self.ring.config().time_out());
        }
    }

    /// Time has passed. Tells by how much it is too late to pass the token on: then it is lost.
    pub fn look(&mut self, now: Instant) -> Option<Span> {
        self.silent_since.get_or_insert(now);
        if let Place::Claiming(settled) = self.place
            && now >= settled
        {
            self.hold(settled);
        }
        let Place::Holding(visit) = self.place else {
            self.listen_again(now);
            return None;
        };
        let late = now - (visit.since + self.ring.config().visit());
        if late <= Span::ZERO {
            return None;
        }
        self.let_go(now);
        Some(late)
    }

    /// Who was held up itself when it was to claim the token may have missed what was there to be heard: it listens for as long
    /// as a token can be with one station.
    fn listen_again(&mut self, now: Instant) {
        let (claims_after, config) = (self.ring.claims_after(), self.ring.config());
        if let (Place::Listening, Some(since)) = (&self.place, &mut self.silent_since)
            && now - (*since + claims_after) > config.late
        {
            *since = now - claims_after + config.time_out() + config.late;
        }
    }

    /// It could not be passed on in time: whoever passed it on here does so once more, or it is claimed.
    pub fn let_go(&mut self, now: Instant) {
        self.place = Place::Listening;
        self.let_go = self.seen.is_some_and(|seen| seen.to == self.ring.index());
        self.silent_since = Some(now);
    }

    /// What is to be sent of the token now, at this instant or no later than the other; data goes first.
    pub fn next(&self, now: Instant) -> Option<(Act, Token, Instant, Instant)> {
        let config = self.ring.config();
        let at_once = now + config.late;
        match &self.place {
            Place::Listening => {
                let is_lost = self.silent_since.is_some_and(|since| now >= since + self.ring.claims_after());
                is_lost.then(|| (Act::Claim, self.claim(), now, at_once))
            }
            Place::Claiming(_) => None,
            Place::Holding(visit) if now < visit.since + config.rest => None,
            Place::Holding(visit) => {
                let (act, token) = self.pass();
                Some((act, token, now.max(visit.free_from), visit.since + config.visit()))
            }
            Place::Passed(passed) if now < passed.due => None,
            Place::Passed(passed) if passed.is_last_try => {
                Some((Act::Skip, self.skip(passed.token.to), now, at_once))
            }
            Place::Passed(passed) => Some((Act::Repeat, passed.token, now, at_once)),
        }
    }

    /// When [`Self::look`] or [`Self::next`] has something to do, if nothing is heard before.
    pub fn deadline(&self) -> Option<Instant> {
        match &self.place {
            Place::Listening => self.silent_since.map(|since| since + self.ring.claims_after()),
            Place::Claiming(settled) => Some(*settled),
            Place::Holding(visit) => Some(visit.since + self.ring.config().rest),
            Place::Passed(passed) => Some(passed.due),
        }
    }

    /// It was sent, at this instant.
    pub fn sent(&mut self, act: Act, token: &Token, at: Instant) {
        self.follow(token);
        self.silent_since = Some(at);
        let config = self.ring.config();
        if act == Act::Claim {
            self.place = Place::Claiming(at + config.settle());
        } else if token.to == self.ring.index() {
            self.hold(at);
        } else {
            let is_last_try = matches!(act, Act::Repeat | Act::Invite);
            let due = at + config.time_out();
            self.place = Place::Passed(Passed { token: *token, due, is_last_try });
        }
    }

    /// It could not be sent at all: others will miss it.
    pub fn failed(&mut self, now: Instant) {
        self.place = Place::Listening;
        self.silent_since = Some(now);
    }

    fn hold(&mut self, since: Instant) {
        let free_from = since + self.ring.config().gap();
        self.place = Place::Holding(Visit { since, free_from, spent: Span::ZERO });
    }

    fn follow(&mut self, token: &Token) {
        (self.seen, self.let_go) = (Some(token.mark()), false);
        (self.present, self.since, self.invite) = (token.present, token.since, token.invite);
    }

    /// The token as it is passed on.
    fn pass(&self) -> (Act, Token) {
        let since = self.since.saturating_add(1);
        let rounds = u32::from(self.ring.config().invite_every) * self.present.count_ones();
        match self.invited() {
            Some(guest) if u32::from(since) >= rounds.min(u16::MAX.into()) => {
                let invite = (guest + 1) % self.ring.size();
                let token = self.token(self.present | 1 << guest, guest);
                (Act::Invite, Token { since: 0, invite, ..token })
            }
            _ => {
                let to = self.behind(self.ring.index(), self.present);
                (Act::Pass, Token { since, ..self.token(self.present, to) })
            }
        }
    }

    /// The token as it goes to the one behind a station that is absent.
    fn skip(&self, absent: u8) -> Token {
        let present = self.present & !(1 << absent);
        self.token(present, self.behind(absent, present))
    }

    fn claim(&self) -> Token {
        let own = self.ring.index();
        let generation = self.seen.map_or(0, |seen| seen.generation).wrapping_add(1);
        Token { kind: Kind::Claim, generation, sequence: 0, ..self.token(self.present | 1 << own, own) }
    }

    fn token(&self, present: u64, to: u8) -> Token {
        let (generation, sequence) = self.seen.map_or((0, 0), |seen| (seen.generation, seen.sequence));
        Token {
            kind: Kind::Pass,
            size: self.ring.size(),
            digest: self.ring.digest(),
            generation,
            sequence: sequence.wrapping_add(1),
            from: self.ring.index(),
            to,
            since: self.since,
            invite: self.invite,
            present: present | 1 << self.ring.index(),
        }
    }

    /// The next station behind a place that is among those that are present, or this one.
    fn behind(&self, place: u8, present: u64) -> u8 {
        let own = self.ring.index();
        let is_next = |&place: &u8| place == own || present >> place & 1 == 1;
        self.places_from(place + 1).find(is_next).unwrap_or(own)
    }

    /// Who is to be invited, if it is this station that passes the token on in front of it.
    fn invited(&self) -> Option<u8> {
        let guest = self.places_from(self.invite).find(|&place| self.present >> place & 1 == 0)?;
        let own = self.ring.index();
        let next = self.behind(own, self.present);
        self.places_from(own + 1).take_while(|&place| place != next).find(|&place| place == guest)
    }

    /// All places from one on, once round.
    fn places_from(&self, first: u8) -> impl Iterator<Item = u8> + use<> {
        let size = self.ring.size();
        (0..size).map(move |n| (first + n) % size)
    }
}

#[cfg(test)]
mod tests;
