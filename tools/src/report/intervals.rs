//! Times between neighbours of a sequence. Where one is missing in between there is no such time, but a gap: it is counted
//! with the others, so that what was missed is in the same row as what was measured.

use rtnet::time::Span;

use super::histogram::{SignedHistogram, Summary};

/// How regular a sequence is.
#[derive(Clone, Debug, Default)]
pub struct Intervals {
    jitter: SignedHistogram,
    gaps: u64,
    longest: Option<Span>,
}

impl Intervals {
    /// From one to its neighbour it took `actual`, and was to take `nominal`.
    pub fn next(&mut self, actual: Span, nominal: Span) {
        self.jitter.record((actual - nominal).nanos());
    }

    /// From one to the next that was seen, between which some were missing; without a length where it was not measured.
    pub fn gap(&mut self, actual: Option<Span>) {
        self.gaps += 1;
        self.longest = self.longest.max(actual);
    }

    /// The figures of a report.
    pub fn summary(&self) -> Summary {
        let summary = self.jitter.summary().with_gaps(self.gaps);
        Summary { longest_gap_ns: self.longest.map(Span::nanos), ..summary }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_is_no_value_and_is_not_left_out() {
        let (mut intervals, period) = (Intervals::default(), Span::from_millis(1));
        intervals.next(period + Span::from_nanos(30), period);
        intervals.gap(Some(period * 7));
        intervals.gap(None);
        intervals.gap(Some(period * 2));
        intervals.next(period - Span::from_nanos(10), period);
        let summary = intervals.summary();
        assert_eq!((summary.n, summary.min, summary.max), (2, Some(-10), Some(30)));
        assert_eq!((summary.gaps, summary.longest_gap_ns), (Some(3), Some(7_000_000)));
    }
}
