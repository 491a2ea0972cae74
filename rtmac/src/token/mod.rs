//! The token discipline: the right to send goes round a ring of stations. It needs no clock that is synchronised, only
//! local timers, and no master.
//!
//! ```text
//!        ┌──────── token ───────┐
//!        ▼                      │            all hear each token: who passed it on, that it is in good hands; all others,
//!   station 0 ──► station 1 ──► station 2    that it is not lost
//!   holds it: sends for so long at the most, then passes it on
//! ```
//!
//! | what goes wrong | what becomes of it |
//! |---|---|
//! | the next station is dead, or the token was lost on its way | it is sent once more, then to the one behind |
//! | its holder and who passed it on are dead | after a silence the first in the ring claims it, of a later generation |
//! | there are two | the one that [stays](Mark::outlasts) makes the other void as soon as it is heard |
//! | its holder was held up | it has lost it, and sends nothing |
//! | a station was absent | it is invited, one every so many rounds |
//!
//! How long each takes at the most is in [`bound`].

pub mod bound;
mod ring;
mod rotation;
mod status;
pub mod wire;

use core::convert::Infallible;

use arrayvec::ArrayVec;
use rtnet::at_once::Rules;
use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{
    Channel, Claimed, Discipline, Event, EventKind, Opportunity, Returned, SendError, Sent, TimeView,
    Transmission,
};
use rtnet::queue::{Priority, PriorityQueue};
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::{self, Header};

use crate::nomac::Unslotted;
pub use ring::{LONGEST_FRAME, Ring, RingConfig, RingRefused};
use rotation::{Act, Heard, Place, Rotation};
pub use status::{Counters, TokenState, TokenStatus};
#[cfg(doc)]
use wire::Mark;
use wire::Token as Message;

/// Tokens that may be under way to the port at once.
const POOL: usize = 2;
/// Events of one turn of the loop, which takes them, and some more.
const EVENTS: usize = 16;

/// A station of a ring.
pub struct Token {
    rotation: Rotation,
    queue: PriorityQueue,
    pending: Option<Pending>,
    asking: Asking,
    pool: Pool,
    events: ArrayVec<Event, EVENTS>,
    /// When time was last told of.
    looked: Instant,
    /// When the token came here last.
    came: Option<Instant>,
    rounds: Rounds,
    counters: Counters,
}

/// Services are asked when the token comes, and once more each time that the loop has waited while it is here.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Asking {
    /// The loop is about to wait.
    Waits,
    /// It has woken, or the token has come.
    Due,
    Done,
}

/// What is being sent.
enum Pending {
    Data { priority: Priority, air: Span },
    Token(Act, Message),
}

/// How often the token was here, and how long it took to come back.
#[derive(Clone, Copy, Default)]
struct Rounds {
    visits: u32,
    last: Option<Span>,
    longest: Option<Span>,
}

impl Token {
    /// A station in its place of a ring.
    pub fn new(ring: Ring) -> Self {
        Self {
            rotation: Rotation::new(ring),
            queue: PriorityQueue::new(),
            pending: None,
            asking: Asking::Waits,
            pool: Pool::new(POOL),
            events: ArrayVec::new(),
            looked: Instant::default(),
            came: None,
            rounds: Rounds::default(),
            counters: Counters::default(),
        }
    }

    fn hear(&mut self, rx: Option<Instant>, frame: &[u8]) -> Result<(), Refusal> {
        let message = Message::parse(frame)?;
        let (header, _) = Header::parse(frame).ok_or(Refusal::Runt)?;
        // A time-out cannot be kept to by who does not know when it began: it is sent once more.
        let rx = rx.ok_or(Refusal::NoStamp)?;
        let ring = self.rotation.ring();
        if (message.size, message.digest) == (ring.size(), ring.digest())
            && ring.address(message.from) != Some(header.source)
        {
            return Err(Refusal::ForgedSource);
        }
        match self.rotation.hear(rx, &message)? {
            Heard::Repeated => self.counters.repeats_heard += 1,
            Heard::OnItsWay { gave_up } => {
                self.counters.tokens_heard += 1;
                if gave_up {
                    self.counters.given_up += 1;
                    self.note(EventKind::TokenGivenUp, Span::ZERO);
                }
            }
        }
        self.welcome();
        Ok(())
    }

    /// Notes that the token has come.
    fn welcome(&mut self) {
        let Place::Holding(visit) = self.rotation.place() else { return };
        let (now, rounds) = (visit.since, &mut self.rounds);
        let before = self.came.replace(now);
        if before == Some(now) {
            return;
        }
        self.asking = Asking::Due;
        rounds.visits = rounds.visits.wrapping_add(1);
        rounds.last = before.map(|before| now - before);
        rounds.longest = rounds.longest.max(rounds.last);
    }

    /// The most urgent frame, if it is still for this visit.
    fn next_data(&mut self, now: Instant) -> Option<Transmission> {
        let config = self.rotation.ring().config();
        let (rate, hold, ends) = (config.rate, config.hold, config.data());
        let visit = self.rotation.visit_mut()?;
        let (priority, frame) = self.queue.pop()?;
        let air = rate.air_time(frame.len());
        let (at, latest) = (now.max(visit.free_from), visit.since + ends - air);
        if visit.spent + air > hold || at > latest {
            self.queue.push_front(priority, frame);
            return None;
        }
        self.pending = Some(Pending::Data { priority, air });
        Some(Transmission { frame, at, latest, stamp: None })
    }

    /// The token itself, if it is due.
    fn next_token(&mut self, now: Instant) -> Option<Transmission> {
        let (act, message, at, latest) = self.rotation.next(now)?;
        let mut frame = self.pool.take()?;
        let ring = self.rotation.ring();
        message.write(ring.address(ring.index())?, &mut frame);
        self.pending = Some(Pending::Token(act, message));
        Some(Transmission { frame, at, latest, stamp: None })
    }

    /// What became of a frame of data. One that was late, or that the kernel did not take, ends the visit: it is the first
    /// of the next one.
    fn data_sent(&mut self, outcome: Sent, priority: Priority, air: Span) -> Option<Returned> {
        let hold = self.rotation.ring().config().hold;
        let (at, frame) = match outcome {
            Sent::At(at) => (Some(at), None),
            Sent::StalledUntil(at) => {
                self.counters.stalled_in_send += 1;
                self.note(EventKind::StalledInSend, self.too_late(at, air));
                (Some(at), None)
            }
            Sent::Late(at, frame) => {
                self.counters.overruns += 1;
                self.note(EventKind::Overrun, self.too_late(at, air));
                (None, Some(frame))
            }
            Sent::Guarded(at, frame) => {
                self.counters.guard_drops += 1;
                self.note(EventKind::GuardDropped, self.too_late(at, air));
                (None, Some(frame))
            }
            Sent::Failed(errno, frame) => {
                self.counters.send_failed += 1;
                self.note(EventKind::SendFailed, Span::from_nanos(i64::from(errno)));
                (None, Some(frame))
            }
        };
        if let Some(visit) = self.rotation.visit_mut() {
            visit.spent = if at.is_some() { visit.spent + air } else { hold };
            visit.free_from = at.map_or(visit.free_from, |at| at + air);
        }
        self.counters.frames_sent += u64::from(at.is_some());
        frame.map(|frame| Returned { frame, priority, channel: 0 })
    }

    /// What became of the token.
    fn token_sent(&mut self, outcome: Sent, act: Act, message: &Message) {
        let at = match outcome {
            Sent::At(at) => at,
            Sent::StalledUntil(at) => {
                self.counters.stalled_in_send += 1;
                self.note(EventKind::StalledInSend, self.beyond(at));
                at
            }
            Sent::Late(at, _) | Sent::Guarded(at, _) => return self.missed(at),
            Sent::Failed(errno, _) => {
                self.counters.send_failed += 1;
                self.note(EventKind::SendFailed, Span::from_nanos(i64::from(errno)));
                return self.rotation.failed(self.looked);
            }
        };
        let skipped = self.rotation.waits_for();
        self.rotation.sent(act, message, at);
        let (count, kind) = match act {
            Act::Pass => (&mut self.counters.passes, None),
            Act::Invite => (&mut self.counters.invitations, None),
            Act::Repeat => (&mut self.counters.repeats, Some(EventKind::TokenRepeated)),
            Act::Skip => (&mut self.counters.skips, Some(EventKind::StationSkipped)),
            Act::Claim => (&mut self.counters.claims, Some(EventKind::TokenClaimed)),
        };
        *count += 1;
        // A skipped one is the last that was waited for.
        let slot = skipped.filter(|_| act == Act::Skip);
        kind.into_iter().for_each(|kind| self.note_of(slot, kind, Span::ZERO));
        self.welcome();
    }

    /// It was too late to send a token. Who was to pass it on has lost it; all others look again.
    fn missed(&mut self, now: Instant) {
        if self.rotation.visit_mut().is_some() {
            self.lost(now, self.beyond(now));
        }
    }

    fn lost(&mut self, now: Instant, late: Span) {
        self.rotation.let_go(now);
        self.counters.overdue += 1;
        self.note(EventKind::TokenOverdue, late);
    }

    /// How much later than the end of the visit a moment is.
    fn beyond(&self, at: Instant) -> Span {
        let Place::Holding(visit) = self.rotation.place() else { return Span::ZERO };
        at - (visit.since + self.rotation.ring().config().visit())
    }

    /// How much later than it may be a frame of data is.
    fn too_late(&self, at: Instant, air: Span) -> Span {
        let config = self.rotation.ring().config();
        self.beyond(at + air) + (config.visit() - config.data())
    }

    fn note(&mut self, kind: EventKind, span: Span) {
        self.note_of(None, kind, span);
    }

    /// Something of a station of the ring, by its place.
    fn note_of(&mut self, slot: Option<u8>, kind: EventKind, span: Span) {
        let event = Event { cycle: self.rounds.visits, kind, slot, span };
        self.counters.events_lost += u64::from(self.events.try_push(event).is_err());
    }
}

impl Discipline for Token {
    type Command = Infallible;
    type Refused = Infallible;
    type Status = TokenStatus;

    /// Its own frames, and RTmac's, of which it takes what is tunnelled.
    fn claims(&self, header: &Header) -> bool {
        header.ether_type() == wire::TOKEN || Unslotted::claims(header)
    }

    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Claimed {
        let is_token = Header::parse(&frame).is_some_and(|(header, _)| header.ether_type() == wire::TOKEN);
        if !is_token {
            return Unslotted::on_frame(frame);
        }
        self.hear(rx, &frame).map_or_else(Claimed::Refused, |()| Claimed::Kept)
    }

    fn on_timeout(&mut self, now: Instant) {
        if let Some(late) = self.rotation.look(now) {
            self.counters.overdue += 1;
            self.note(EventKind::TokenOverdue, late);
        }
        self.welcome();
        if self.asking == Asking::Waits {
            self.asking = Asking::Due;
        }
    }

    /// Each time that it is awake while the token is here.
    fn opportunity(&mut self, now: Instant) -> Option<Opportunity> {
        if !matches!(self.rotation.place(), Place::Holding(_)) || self.asking != Asking::Due {
            return None;
        }
        self.asking = Asking::Done;
        // There is no time but its own.
        let scheduled = GlobalTime::from_nanos(now.nanos());
        let non_rt = Some(ethernet::MTU);
        Some(Opportunity { channel: 0, cycle: self.rounds.visits, begin: now, scheduled, non_rt })
    }

    fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        self.looked = now;
        let next = self.next_data(now).or_else(|| self.next_token(now));
        if next.is_none() && self.asking == Asking::Done {
            self.asking = Asking::Waits;
        }
        next
    }

    fn on_sent(&mut self, outcome: Sent) -> Option<Returned> {
        match self.pending.take()? {
            Pending::Data { priority, air } => self.data_sent(outcome, priority, air),
            Pending::Token(act, message) => {
                self.token_sent(outcome, act, &message);
                None
            }
        }
    }

    fn enqueue(&mut self, frame: Buf, priority: Priority, _ch: Channel) -> Result<(), (SendError, Buf)> {
        let ether_type = Header::parse(&frame).map(|(header, _)| header.ether_type());
        if ether_type == Some(wire::TOKEN) {
            return Err((SendError::Forged(wire::TOKEN), frame));
        }
        if !Unslotted::may_leave(&frame) {
            return Err((SendError::Lethal, frame));
        }
        self.queue.push(priority, frame);
        Ok(())
    }

    fn is_waiting(&self, _channel: Channel) -> bool {
        !self.queue.is_empty()
    }

    fn has_queued(&self) -> bool {
        matches!(self.rotation.place(), Place::Holding(_)) && !self.queue.is_empty()
    }

    fn put_back(&mut self, frame: Returned) {
        self.queue.push_front(frame.priority, frame.frame);
    }

    fn payload_limit(&self, _ch: Channel) -> Result<usize, SendError> {
        Ok(ethernet::MTU)
    }

    fn next_deadline(&self) -> Option<Instant> {
        self.rotation.deadline()
    }

    /// The token may come any time.
    fn wakes_on_frames(&self) -> bool {
        true
    }

    fn time(&self) -> TimeView {
        TimeView::default()
    }

    fn next_event(&mut self) -> Option<Event> {
        self.events.pop_at(0)
    }

    fn command(&mut self, _now: Instant, command: &mut Infallible) -> Result<u32, Infallible> {
        match *command {}
    }

    fn status(&self) -> TokenStatus {
        let ring = self.rotation.ring();
        TokenStatus {
            state: TokenState::of(self.rotation.place()),
            index: ring.index(),
            size: ring.size(),
            present: self.rotation.present(),
            mark: self.rotation.seen(),
            visits: self.rounds.visits,
            rotation: self.rounds.last,
            longest_rotation: self.rounds.longest,
            queued: self.queue.len(),
            pool: self.pool.statistics(),
            counters: self.counters,
        }
    }
}
