//! Whether the router's loop stays awake while it waits for events.
//!
//! A wake-up takes 5 us to 50 us, many times what a package takes in the router. While events are less than 50 us apart, the loop
//! polls. It polls in vain where the sender has paused, or needs this core. It sleeps for one short wait then, and for twice as many
//! after each further failure in a row.

/// Nanoseconds that it stays awake at the most: what Linux recommends for its own polling of several sockets (`net.core.busy_poll`).
pub const AWAKE_AT_MOST: u64 = 50_000;
/// Nanoseconds of a short wait asleep. The wake-up at its end takes as long as polling may.
const SHORT: u64 = 2 * AWAKE_AT_MOST;
/// Short waits asleep after a failure, at the most.
const SLEEPS_AT_MOST: u32 = 4_096;

/// Decides for each wait whether the loop polls, by how earlier waits ended.
#[derive(Debug)]
pub struct Awake {
    /// Short waits asleep until it stays awake again.
    sleeps: u32,
    /// The same after its next failure.
    after_failure: u32,
}

impl Awake {
    pub fn new() -> Self {
        Self { sleeps: 1, after_failure: 1 }
    }

    /// Whether it stays awake in the next wait.
    pub fn is_due(&self) -> bool {
        self.sleeps == 0
    }

    /// An event came while it was awake.
    pub fn succeeded(&mut self) {
        self.after_failure = 1;
    }

    /// No event came while it was awake.
    pub fn failed(&mut self) {
        self.sleeps = self.after_failure;
        self.after_failure = (2 * self.after_failure).min(SLEEPS_AT_MOST);
    }

    /// It slept for `ns` nanoseconds, its own wake-up included. A long wait is not counted: it ended a pause.
    pub fn slept(&mut self, ns: u64) {
        if ns <= SHORT {
            self.sleeps = self.sleeps.saturating_sub(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loop_polls_while_events_are_close() {
        let mut awake = Awake::new();
        assert!(!awake.is_due(), "nothing has come yet");
        awake.slept(SHORT + 1);
        assert!(!awake.is_due(), "events are rare");
        awake.slept(SHORT);
        assert!(awake.is_due());
        awake.succeeded();
        assert!(awake.is_due());
        // A pause: asleep until events follow closely again.
        awake.failed();
        awake.slept(1_000_000);
        assert!(!awake.is_due());
        awake.slept(10_000);
        assert!(awake.is_due());
    }

    /// On a core that senders need, too: each time awake delays them.
    #[test]
    fn polls_become_rare_where_they_are_in_vain() {
        let (mut awake, mut failures) = (Awake::new(), 0);
        for _ in 0..100_000 {
            if awake.is_due() {
                awake.failed();
                failures += 1;
            } else {
                awake.slept(10_000);
            }
        }
        assert!((12..40).contains(&failures), "{failures}");
        // One success, and a single failure costs one wait again.
        while !awake.is_due() {
            awake.slept(10_000);
        }
        awake.succeeded();
        awake.failed();
        awake.slept(10_000);
        assert!(awake.is_due());
    }
}
