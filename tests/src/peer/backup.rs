//! What makes a master a backup: it looks, in every cycle, whether there was a Synchronisation, and sends one if not.
//!
//! ```text
//!        ┌─────────────────────────────────────────────────────────────┐
//!        ▼                               heard: forget it, stand by ───┤
//!   sleep until the cycle after the last                               │
//!   one known begins, and B longer ────► not heard: send it, on the ───┘
//!                                        line of the one who did not
//! ```
//!
//! There is no vote and no hold-off: one missing Synchronisation is replaced in the very cycle in which it is
//! missing, and whoever is heard again is made way for in that very cycle.

use rtnet::time::{Instant, Span};

/// What a backup remembers from one look to the next.
pub struct Watch {
    /// B.
    after: Span,
    /// The next look, fixed when the worker goes to sleep: what is heard meanwhile moves the clock, not the alarm.
    at: Instant,
    heard: bool,
}

impl Watch {
    pub fn new(after: Span) -> Self {
        Self { after, at: Instant::default(), heard: false }
    }

    /// The worker goes to sleep in the cycle before the one that begins at `next`.
    pub fn sleep(&mut self, next: Instant) {
        self.at = next + self.after;
    }

    pub fn at(&self) -> Instant {
        self.at
    }

    /// Somebody has sent a Synchronisation.
    pub fn hear(&mut self) {
        self.heard = true;
    }

    /// Whether somebody has, since the last look.
    pub fn look(&mut self) -> bool {
        core::mem::take(&mut self.heard)
    }
}
