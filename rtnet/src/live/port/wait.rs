//! Waiting: for a frame, a bell, a moment, or whichever comes first.

use std::os::fd::AsFd;

use nix::poll::PollTimeout;

use super::receive::Inlet;
use super::{Port, UNDISTURBED};
use crate::clock::True;
use crate::live::clock::{monotonic, sleep_until, spin_until};
use crate::live::packet;
use crate::time::Instant;

impl Port {
    /// Waits for a frame of any kind, at most `timeout_ms` milliseconds.
    pub fn wait_for_frame(&self, timeout_ms: i32) {
        let at_most = timeout_ms.max(0) as True * 1_000_000;
        let sockets = core::iter::once(&self.control).chain(&self.data).map(|socket| socket.as_fd());
        packet::wait_any(sockets, Some(at_most));
    }

    /// Waits for a frame or a bell until the station's clock shows `at`, at most until the true moment `no_later`.
    pub fn wait_for_frame_until(&mut self, at: Option<Instant>, no_later: True) {
        if self.has_parts() {
            self.empty = 0;
            return;
        }
        let until = at.map_or(no_later, |at| self.clock.truth(at).min(no_later));
        let now = monotonic();
        let at_most = match self.alarm.rings_by(until, now) {
            true => PollTimeout::NONE,
            false => PollTimeout::try_from(until.saturating_sub(now).div_ceil(1_000_000))
                .unwrap_or(PollTimeout::MAX),
        };
        self.empty = !self.bells.wait(at_most);
        self.woke = monotonic();
    }

    /// Sleeps until a data frame waits, but not before `rested`, or until the station's clock shows `at`, at most until
    /// the true moment `no_later`; tells whether one does. Shortly before `at` frames wake nobody any more, so that it wakes
    /// as precisely as if there were none.
    pub fn sleep_unless_data(&mut self, at: Instant, no_later: True, rested: True) -> bool {
        let undisturbed = self.clock.truth(at).min(no_later).saturating_sub(UNDISTURBED);
        if rested < undisturbed {
            self.rest_until(rested);
            if self.has_parts() && monotonic() < undisturbed {
                self.woke = monotonic();
                return true;
            }
            let at_most = undisturbed.saturating_sub(monotonic());
            if at_most > 0
                && packet::wait_any(self.data.iter().map(|socket| socket.as_fd()), Some(at_most)) != 0
                && monotonic() < undisturbed
            {
                self.woke = monotonic();
                return true;
            }
        }
        self.sleep_until(at, no_later);
        false
    }

    /// Whether a part of a frame that came uncut waits to be handed over.
    fn has_parts(&self) -> bool {
        self.data.iter().any(Inlet::has_parts)
    }

    /// Sleeps until a true moment, which may have passed, whatever comes.
    pub(in crate::live) fn rest_until(&mut self, rested: True) {
        if monotonic() < rested {
            sleep_until(rested);
        }
    }

    /// Sleeps until the station's clock shows `at`, at most until the true moment `no_later`.
    /// What is no farther than a frame is spun for is spun for, too.
    pub fn sleep_until(&mut self, at: Instant, no_later: True) {
        let until = self.clock.truth(at).min(no_later);
        if monotonic() + self.spin < until {
            sleep_until(until);
        } else {
            spin_until(until);
        }
        self.woke = monotonic();
    }

    /// When the last sleep ended.
    pub fn woke(&self) -> True {
        self.woke
    }
}
