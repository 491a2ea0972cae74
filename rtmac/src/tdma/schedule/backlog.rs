//! How long frames wait for a slot that are queued again and again, behind those that are more urgent.
//!
//! ```text
//!              choice, missed       choice      choice      choice
//!   ---------------|--[#]-------------|--[#]------|--[#]------|--[#]----
//!   all are queued at once ▲           most       more        the
//!   right behind it        │           urgent     urgent      last
//!                          |<--------- waits ------------------->|
//! ```

use rtnet::time::Span;

use super::Turns;

/// Turns until a queue is empty that are looked through. One that is not by then is as good as never so.
const TURNS_AT_MOST: u64 = 1 << 16;
/// Of the sum of some shares.
const ROUNDING: f64 = 1e-9;

/// Frames that a program queues again and again, each of which takes a turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Demand {
    /// How often.
    pub every: Span,
    /// So many at a time.
    pub burst: u32,
}

/// Turns that demands want on average, as a share of those that there are: above 1 the queue only grows.
pub fn load(turns: &Turns, demands: &[Demand]) -> f64 {
    let wanted = demands.iter().map(|of| f64::from(of.burst) / of.every.nanos() as f64);
    wanted.sum::<f64>() * turns.round().nanos() as f64 / turns.count() as f64
}

/// The longest that a frame of the last of some demands takes from being queued to when it begins in its slot, where those before it are
/// more urgent, and the frame of a turn is chosen `lead` before it.
///
/// It is the worst there is, and exact for programs whose moments may come to be the same: all queue their frames in the instant of
/// a choice, and are too late for it. Nothing is late or lost: what hosts and misses add is not in it.
///
/// `None` without demands, and where they want more turns than there are, or so nearly all that no end of the queue is found.
///
/// ```
/// use rtmac::tdma::schedule::{Demand, Slot, Turns, worst_queueing};
/// use rtnet::time::Span;
///
/// let us = Span::from_micros;
/// let slot = Slot { owner: "arm".into(), id: 0, offset: us(100), phase: 0, period: 1, size: 1500 };
/// let turns = Turns::of(us(1_000), &[slot]).unwrap();
/// // Two alarms every 10 ms go before a state every 4 ms: that leaves in the third turn.
/// let (alarms, state) = (Demand { every: us(10_000), burst: 2 }, Demand { every: us(4_000), burst: 1 });
/// assert_eq!(worst_queueing(&turns, us(50), &[alarms]), Some(us(2_050)));
/// assert_eq!(worst_queueing(&turns, us(50), &[alarms, state]), Some(us(3_050)));
/// ```
pub fn worst_queueing(turns: &Turns, lead: Span, demands: &[Demand]) -> Option<Span> {
    let (own, urgent) = demands.split_last()?;
    let of_start = |missed| Busy { turns, missed, urgent, own }.longest_wait();
    of_all_starts(turns, demands, of_start).map(|wait| wait + lead)
}

/// The most frames that wait at once, the one of the turn that is chosen for among them. `None` as of [`worst_queueing`].
pub fn most_waiting(turns: &Turns, demands: &[Demand]) -> Option<u64> {
    let (own, urgent) = demands.split_last()?;
    of_all_starts(turns, demands, |missed| Busy { turns, missed, urgent, own }.most_waiting())
}

/// The largest, whichever turn it is that was missed.
fn of_all_starts<T: Ord>(turns: &Turns, demands: &[Demand], of: impl Fn(usize) -> Option<T>) -> Option<T> {
    if load(turns, demands) > 1.0 + ROUNDING {
        return None;
    }
    let all: Option<Vec<T>> = (0..turns.count()).map(of).collect();
    all?.into_iter().max()
}

/// From when all queue their frames, in the instant in which that of a turn is chosen, to when none waits any more.
struct Busy<'a> {
    turns: &'a Turns,
    /// For which they are too late.
    missed: usize,
    urgent: &'a [Demand],
    own: &'a Demand,
}

impl Busy<'_> {
    /// Of an own frame, to the choice of the turn in which it leaves.
    fn longest_wait(&self) -> Option<Span> {
        let (mut longest, mut turn) = (Span::ZERO, 0);
        for before in 0.. {
            // A burst's last frame waits longest.
            turn = self.leaves(turn, (before + 1) * u64::from(self.own.burst))?;
            let gone = self.turns.after(self.missed, turn);
            longest = longest.max(gone - self.own.every * before as i64);
            if gone <= self.own.every * (before + 1) as i64 {
                break;
            }
        }
        Some(longest)
    }

    /// The turn in which so many own frames have left, at least `turn`; the one that was missed is 0.
    fn leaves(&self, mut turn: u64, own: u64) -> Option<u64> {
        turn = turn.max(own);
        while turn <= TURNS_AT_MOST {
            let needed = own + queued(self.urgent, self.turns.after(self.missed, turn));
            if needed <= turn {
                return Some(turn);
            }
            turn = needed;
        }
        None
    }

    fn most_waiting(&self) -> Option<u64> {
        let mut most = 0;
        for turn in 1..=TURNS_AT_MOST {
            let until = self.turns.after(self.missed, turn);
            let all = queued(self.urgent, until) + queued(&[*self.own], until);
            if all < turn {
                return Some(most);
            }
            most = most.max(all + 1 - turn);
        }
        None
    }
}

/// Frames that are queued from the moment that all have in common on, and before `end`.
fn queued(demands: &[Demand], end: Span) -> u64 {
    let moments = |of: &Demand| (end.nanos().max(0) as u64).div_ceil(of.every.nanos().max(1) as u64);
    demands.iter().map(|of| u64::from(of.burst) * moments(of)).sum()
}

#[cfg(test)]
mod tests;
