//! How far a slave's time may be off, as far as it can know.
//!
//! ```text
//! bound = delay + place + rate x time
//!
//! delay   half of a round trip, since nothing tells which way took longer
//! place   of the line: where it lies below the Synchronisations, half of the windows' early ones, or the last one's, are
//!         later by so much or more, and none is earlier; where there are few of them, or none, what lately disagreed with it
//! rate    by which the clocks may run apart otherwise than believed: what is known of it, and what crystals change
//!         since; 200 ppm where nothing is known
//! time    since the cycle in which the line is known, or the last Synchronisation
//! ```
//!
//! It holds for when cycles start, as long as one in eight Synchronisations of one window in two was not held up by more
//! than the others show, no clock is faster than another by more than 200 ppm, and none was set within this window. Nor may one
//! have been set forward by a step that is no longer than Synchronisations are slower than frames for one station.

use rtnet::time::{Instant, Span};

use super::line::DRIFT_PARTS;
use super::slave::Slave;

/// Of what disagreed this part is forgotten with each Synchronisation.
const FORGOTTEN_PARTS: i64 = 16;

/// By how much Synchronisations that were followed have lately disagreed with the line, whichever way.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disagreement(Span);

impl Disagreement {
    /// Of a line that has just begun: what disagrees by less than a time step was not noticed.
    pub fn at_first(step_limit: Span) -> Self {
        Self(step_limit)
    }

    /// One more.
    pub fn note(&mut self, deviation: Span) {
        self.0 = deviation.abs().max(self.0 - self.0 / FORGOTTEN_PARTS);
    }
}

impl Slave {
    /// By how much cycles may start earlier or later than this slave believes, at an instant. `None` without a line, or a
    /// delay that was measured.
    pub fn error_bound(&self, now: Instant) -> Option<Span> {
        let line = self.line()?;
        let delay = self.calibration().delay().filter(|_| self.calibration().report().is_some())?;
        let since = (now - line.start).max(Span::ZERO);
        let cycle = line.cycle.wrapping_add((since.nanos() / line.period.nanos() + 1) as u32);
        let Disagreement(disagreed) = self.disagreement();
        let alone = disagreed + since / DRIFT_PARTS;
        Some(delay.abs() + self.envelope().off_in(cycle, disagreed).unwrap_or(alone))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_disagreed_is_forgotten_little_by_little() {
        let mut disagreement = Disagreement::at_first(Span::from_micros(20));
        disagreement.note(Span::from_micros(-50));
        assert_eq!(disagreement.0, Span::from_micros(50), "whichever way");
        for _ in 0..100 {
            disagreement.note(Span::from_micros(1));
        }
        assert_eq!(disagreement.0, Span::from_micros(1));
    }
}
