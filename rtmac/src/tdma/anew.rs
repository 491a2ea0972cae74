//! Measuring the delay anew, by a station that stays in the cycle.
//!
//! ```text
//! turns of its first slot   0         1         2      3      4
//!                           request   (reply)   data   data   request
//! ```
//!
//! A round needs two turns of the slot, of which the second is the master's; a master that was late with it answers in a
//! slot of its own (`replies.rs`). So of four turns two carry data, and all other slots are as ever. The delay that is known
//! stays in use until the last round, which moves the line by the difference.
//!
//! Nothing on the wire takes a request back. So the turn in which its reply was asked for carries nothing, whatever the
//! station is by then: given up, master itself, in another role, detached and back.

use super::config::{Refused, check_rounds};
use super::job::Job;
use super::round::Room;
use super::slot::Turn;
use super::{MAX_ROUNDS, Role, Tdma};
use rtnet::discipline::SyncState;
use rtnet::time::{Instant, Span};

/// After so many turns all begins again.
const TURNS: u32 = 4;

/// How many rounds to measure anew, with room for them: made by the control thread, since that takes memory.
#[derive(Debug)]
pub struct NewRounds {
    rounds: u32,
    room: Room,
}

impl NewRounds {
    /// At least one round.
    pub fn of(rounds: u32) -> Result<Self, Refused> {
        match rounds {
            0 => Err(Refused::NoRounds),
            1..=MAX_ROUNDS => Ok(Self { rounds, room: Room::of(rounds) }),
            _ => Err(Refused::TooManyRounds { rounds }),
        }
    }
}

/// What a slot's turn is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    Data,
    Request,
    /// It is left to the master.
    Reply,
}

/// A turn of the first slot that is left to a reply.
#[derive(Clone, Copy, Debug)]
pub struct ReplyTurn {
    /// The turn in which it was asked for, and the one that it was asked for: by its cycle's number, for this clock may be
    /// set until then, and by its instant, for cycles may have other numbers.
    asked: Instant,
    number: u32,
    at: Instant,
    /// From one cycle's start to the next.
    cycle: Span,
}

impl ReplyTurn {
    fn is(&self, turn: &Turn) -> bool {
        turn.cycle == self.number || (turn.at - self.at).abs() < self.cycle / 2
    }

    pub(super) fn is_later_than(&self, now: Instant) -> bool {
        self.at > now
    }

    /// Whether it is still to come, or has just been. On a clock that was set back behind the request nothing is known of it.
    fn holds(&self, now: Instant) -> bool {
        (self.asked..=self.at + self.cycle).contains(&now)
    }
}

impl Tdma {
    /// A request has left in its turn.
    pub(super) fn await_reply(&mut self, turn: &Turn) {
        let Some((line, slot)) = self.line().zip(self.slots.get(turn.id)) else { return };
        let (asked, cycle) = (turn.at, line.period);
        let (number, at) = (turn.cycle.wrapping_add(slot.period), asked + cycle * i64::from(slot.period));
        self.reply_turn = Some(ReplyTurn { asked, number, at, cycle });
    }

    /// Whether the first slot stays as it is, since a reply may still come in it.
    pub(super) fn awaits_reply(&self, now: Instant) -> bool {
        self.reply_turn.is_some_and(|turn| turn.holds(now))
    }

    /// Begins to measure the delay anew.
    pub(super) fn measure_anew(&mut self, asked: &mut NewRounds) -> Result<(), Refused> {
        let slots = check_rounds(asked.rounds, self.slots.planned().map(|slot| (slot.id, slot.period)));
        let gives_the_time = matches!(&self.role, Role::Master(master) if master.is_active());
        let Some(follower) = self.role.follower_mut() else {
            let state = SyncState::Waiting;
            return Err(if gives_the_time { Refused::GivesTheTime } else { Refused::NotLocked { state } });
        };
        let state = follower.state();
        if follower.calibration().is_measuring() {
            return Err(Refused::CalibratesAlready);
        }
        // A sync that is missing just now is no reason: its slots are used, too.
        if !matches!(state, SyncState::Locked | SyncState::Holdover) {
            return Err(Refused::NotLocked { state });
        }
        slots?;
        follower.calibration_mut().measure_anew(asked.rounds, &mut asked.room);
        Ok(())
    }

    /// A reply has had its turn of the slot, which a line that is a little late has still to come: that carries no data,
    /// even if no other round follows.
    pub(super) fn leave_turn_to_reply(&mut self, rx: Instant) {
        let Some((line, first)) = self.line().zip(self.slots.first()) else { return };
        let next = self.slots.next_turn(line, Some(first.id));
        if let Some(turn) =
            next.filter(|turn| turn.at - self.lead <= rx && self.purpose(turn) == Purpose::Reply)
        {
            let job = Job::Data(turn);
            self.calibrates_in(&job);
            self.pass(&job, rx);
        }
    }

    /// What a turn is for; of a station that calibrates for the first time, whatever is not left to a reply is a request.
    pub(super) fn purpose(&self, turn: &Turn) -> Purpose {
        let Some(first) = self.slots.first().filter(|first| first.id == turn.id) else {
            return Purpose::Data;
        };
        if self.reply_turn.is_some_and(|of| of.is(turn)) {
            return Purpose::Reply;
        }
        let meets_others = is_broken_off(turn.cycle, first.period);
        if meets_others && self.calibrates() {
            return Purpose::Reply;
        }
        let measures = self.follower().is_some_and(|follower| follower.calibration().measures_anew());
        // The reply would come where the slot is no more.
        let may_ask = measures && !meets_others && !self.slots.is_changing(first.id);
        if may_ask && (turn.cycle / first.period).is_multiple_of(TURNS) {
            Purpose::Request
        } else {
            Purpose::Data
        }
    }
}

/// Whether numbers start over before the reply to a request in this cycle, and phases with them: where the period is no part
/// of 2^32, a period later is another station's turn then.
fn is_broken_off(cycle: u32, period: u32) -> bool {
    !period.is_power_of_two() && cycle.checked_add(period).is_none()
}
