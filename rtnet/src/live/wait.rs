//! Waiting for the cycle, as RTnet's WAITONCYCLE does, but never for ever.
//!
//! A waiter costs the real-time thread nothing: it works the moment out from what the board shows, sleeps by itself,
//! and looks again, since the line may have moved, or been lost.

use std::sync::Arc;
use std::time::Duration;

use crate::clock::True;
use crate::discipline::SyncState;
use crate::time::{Instant, Offset, Span};

use super::clock::{later, monotonic, sleep_until};
use super::time_board::TimeBoard;

/// Longest sleep between two looks: how soon a waiter notices that sync is lost, the line another, the station gone, be it
/// killed.
const LOOK_EVERY: True = 10_000_000;

/// A cycle that has begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cycle {
    /// Its number. Whoever was held up sees by a gap what it has missed.
    pub number: u32,
    /// Its start on the station's clock: how late the waiter woke is seen by it.
    pub start: Instant,
    /// From the station's clock to the master's, at that start.
    pub offset: Offset,
}

/// Why a wait ended without its moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WaitError {
    /// The moment did not come in time.
    #[error("nothing to wait for came within {0:?}: wait for longer than a cycle takes")]
    TimedOut(Duration),
    /// The station does not know the cycle, or does not know it any more.
    #[error("the station is not synchronised ({state}): wait until it is, or see why with `rtnet tdma status`", state = .0.name())]
    NotSynchronised(SyncState),
    /// The station's loop has ended.
    #[error("the station has ended: start it anew, and wait at the new one")]
    Ended,
}

/// One thread's way of waiting for cycles; see [`TimeBoard::waiter`]. It never returns the same moment twice, unless the
/// station's clock is set back in between: until the station notices, it takes cycles that are over for those to come.
///
/// How late it wakes is up to its thread: the host's timers, and the thread's scheduling
/// ([`RealTime`](super::realtime::RealTime) sets that up).
pub struct Waiter {
    board: Arc<TimeBoard>,
    /// The cycle and offset that were returned last.
    last: Option<(u32, Span)>,
}

impl Waiter {
    pub(super) fn new(board: Arc<TimeBoard>) -> Self {
        Self { board, last: None }
    }

    /// Waits for the start of the next cycle, `timeout` at the most.
    ///
    /// # Errors
    /// [`WaitError::TimedOut`]; [`WaitError::NotSynchronised`] at once, or as soon as sync is lost;
    /// [`WaitError::Ended`].
    pub fn wait_cycle(&mut self, timeout: Duration) -> Result<Cycle, WaitError> {
        self.wait_slot(Span::ZERO, timeout)
    }

    /// Waits for the next moment that lies `offset` behind a cycle's start, or before it if that is negative.
    ///
    /// # Errors
    /// As [`Waiter::wait_cycle`].
    pub fn wait_slot(&mut self, offset: Span, timeout: Duration) -> Result<Cycle, WaitError> {
        let begun = monotonic();
        let deadline = later(begun, timeout);
        loop {
            let (cycle, at) = self.next(begun, offset)?;
            let now = monotonic();
            if at <= now {
                self.last = Some((cycle.number, offset));
                return Ok(cycle);
            }
            // Asked before it sleeps, not when it has woken: that may ask the kernel.
            if self.board.has_ended() {
                return Err(WaitError::Ended);
            }
            if now >= deadline {
                return Err(WaitError::TimedOut(timeout));
            }
            sleep_until(at.min(deadline).min(now + LOOK_EVERY));
        }
    }

    /// Waits until the station is synchronised.
    ///
    /// # Errors
    /// [`WaitError::NotSynchronised`] when it is not in time; [`WaitError::Ended`].
    pub fn wait_synchronised(&self, timeout: Duration) -> Result<(), WaitError> {
        let deadline = later(monotonic(), timeout);
        loop {
            let state = self.board.state();
            let now = monotonic();
            match self.board.has_ended() {
                true => return Err(WaitError::Ended),
                false if state.is_synchronised() => return Ok(()),
                false if now >= deadline => return Err(WaitError::NotSynchronised(state)),
                false => sleep_until(deadline.min(now + LOOK_EVERY)),
            }
        }
    }

    /// The cycle whose moment is the first from `begun` on, and that moment, by what is known now: the station's clock may
    /// have been set since, and its line is by the clock that it has.
    fn next(&self, begun: True, offset: Span) -> Result<(Cycle, True), WaitError> {
        let (view, clock) = self.board.view_and_clock();
        let unknown = || match self.board.has_ended() {
            true => WaitError::Ended,
            false => WaitError::NotSynchronised(view.state),
        };
        let next = view.next_moment(clock.local(begun), offset, self.last);
        let next = next.filter(|_| view.state.is_synchronised());
        let (number, at) = next.ok_or_else(unknown)?;
        let start = at - offset;
        let global = view.to_global(start).ok_or_else(unknown)?;
        Ok((Cycle { number, start, offset: Offset::between(start, global) }, clock.truth(at)))
    }
}

#[cfg(test)]
pub(crate) mod tests;
