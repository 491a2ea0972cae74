//! What a calibration request of this station leaves behind: a reply, promised in a later use of its first slot.
//!
//! ```text
//! uses of the first slot   0         1         2      3             4      5             ...  17
//!                          request   (reply)   data   (put off 1x)  data   (put off 2x)       (8x)
//! ```
//!
//! Nothing takes a request back. Whom it was sent to answers it, whatever this station is by then: given up, master itself,
//! in another role, detached and back. So until there is an answer, or the last would have come, those uses carry nothing,
//! and the slot stays where it is. The next request to a master takes the place of the one before, which it forgets; one to
//! another master does not, for the first may only be asleep.

use arrayvec::ArrayVec;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;

use super::Tdma;
use super::replies::LAST_USE;
use super::slot::Turn;

/// Masters that are asked within the time of one promise: a primary and its backups. Of more, the first are forgotten.
const MASTERS: usize = 4;

/// The last request that a master has not answered.
#[derive(Clone, Copy, Debug)]
struct Promise {
    by: Address,
    /// The use of the slot in which it was asked.
    asked: Instant,
    /// The request's stamp, unless it was held up.
    xmit: Option<Instant>,
    /// From one use of the slot to the next.
    every: Span,
}

impl Promise {
    /// Whether a reply may come in the slot's use at this instant: cycles may be numbered anew since.
    fn may_be_kept_at(&self, at: Instant) -> bool {
        let uses = (at - self.asked + self.every / 2).nanos().div_euclid(self.every.nanos());
        (1..=LAST_USE).contains(&uses) && uses % 2 == 1
    }

    /// Nor does it last on a clock that was set back behind it: no use of the slot is known for the reply any more.
    fn is_over(&self, now: Instant) -> bool {
        now > self.asked + self.every * (LAST_USE + 1) || now < self.asked - self.every
    }
}

/// The replies that are still to come, whatever has become of this station since it asked.
#[derive(Default)]
pub struct Promises(ArrayVec<Promise, MASTERS>);

impl Promises {
    fn add(&mut self, promise: Promise) {
        self.0.retain(|other| other.by != promise.by && !other.is_over(promise.asked));
        if self.0.is_full() {
            self.0.remove(0);
        }
        self.0.push(promise);
    }

    /// A reply has come, whoever waits for it.
    pub fn is_kept(&mut self, request_xmit: u64) {
        self.0.retain(|promise| promise.xmit.is_none_or(|xmit| xmit.nanos() != request_xmit));
    }

    /// Whether a turn of the first slot is left to a reply that may still come.
    pub fn claim(&self, turn: &Turn) -> bool {
        self.0.iter().any(|promise| promise.may_be_kept_at(turn.at))
    }

    /// Whether a reply may still come in the first slot, as that is.
    pub fn hold(&self, now: Instant) -> bool {
        self.0.iter().any(|promise| !promise.is_over(now))
    }
}

impl Tdma {
    /// A request has left in its turn, with this stamp unless it was held up.
    pub(super) fn await_reply(&mut self, turn: &Turn, xmit: Option<Instant>) {
        let Some((line, slot)) = self.line().zip(self.slots.get(turn.id)) else { return };
        let every = line.period * i64::from(slot.period);
        if let Some(by) = self.follower().map(|follower| follower.master()) {
            self.promises.add(Promise { by, asked: turn.at, xmit, every });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_promise_lasts_until_the_last_use_that_it_may_be_kept_in_or_the_clock_is_set_back_behind_it() {
        let at = |millis: u64| Instant::from_nanos(millis * 1_000_000);
        let promise =
            Promise { by: Address::default(), asked: at(100), xmit: None, every: Span::from_millis(1) };
        let is_over = [98, 99, 100, 117, 118, 119].map(|millis| promise.is_over(at(millis)));
        assert_eq!(is_over, [true, false, false, false, false, true]);
    }
}
