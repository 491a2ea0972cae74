//! A token that was lost, and found again.

use rtmac::token::RingConfig;
use rtmac::token::bound::recovery_bound;
use rtnet::clock::True;
use rtnet::time::Span;

/// From the last token that was in good hands to the next frame of who has one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recovery {
    /// When that was sent.
    pub began: True,
    /// When the next frame began; as long as it is open, as `began`.
    pub ended: True,
    /// Whom the tokens were for that nobody passed on, each once.
    pub victims: Vec<usize>,
    /// Token frames that were sent to make up for it.
    pub sends: u64,
    /// Why, as far as is known.
    pub cause: &'static str,
}

/// A time in which something happens to the network, or shows that has happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// From here on.
    pub from: True,
    /// Up to here.
    pub until: True,
}

impl Recovery {
    pub(super) fn new(began: True) -> Self {
        Self { began, ended: began, victims: Vec::new(), sends: 0, cause: "" }
    }

    /// A token was sent to make up for one of this station.
    pub(super) fn note(&mut self, victim: Option<usize>) {
        self.sends += 1;
        if let Some(victim) = victim.filter(|victim| !self.victims.contains(victim)) {
            self.victims.push(victim);
        }
    }

    pub(super) fn over(self, ended: True) -> Self {
        Self { ended, ..self }
    }

    /// How long it took.
    pub fn took(&self) -> Span {
        Span::from_nanos(self.ended.saturating_sub(self.began) as i64)
    }

    /// How long that may take: with as many dead as did not show themselves, and each token frame lost that was sent beyond the
    /// two for each of them.
    pub fn bound(&self, ring: &RingConfig) -> Span {
        let dead = self.victims.len().max(1);
        let lost = self.sends.saturating_sub(2 * dead as u64);
        recovery_bound(ring, dead, lost as usize)
    }

    pub(super) fn has_no_victim(&self) -> bool {
        self.victims.is_empty()
    }

    /// Whether each of its victims has told that it was late; each time that one told so counts once.
    pub(super) fn was_told(&self, late: &mut [u64]) -> bool {
        let has_told = |&victim: &usize| late.get(victim).is_some_and(|&n| n > 0);
        let all = !self.victims.is_empty() && self.victims.iter().all(has_told);
        if all {
            self.victims.iter().for_each(|&victim| late[victim] -= 1);
        }
        all
    }
}

impl Window {
    /// Whether a recovery was in it.
    pub fn meets(&self, recovery: &Recovery) -> bool {
        self.from <= recovery.ended && recovery.began <= self.until
    }
}
