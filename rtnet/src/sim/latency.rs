//! How long something takes: drawn anew every time, from a named distribution or from what was measured.

use std::sync::Arc;

use super::random::Random;
use crate::time::Span;

/// A distribution of times, none of them below zero.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Latency {
    /// Always the same.
    Constant(Span),
    /// Anything between the two, both included.
    Uniform(Span, Span),
    /// Mostly short, at times long: with this mean, and at most ten times as long.
    Exponential(Span),
    /// The mean and the standard deviation; what would be below zero is zero.
    Normal(Span, Span),
    /// As it was measured.
    Recorded(Arc<Recorded>),
}

/// A measured distribution: so many values in each range.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// Lowest and highest value, and how many values there are up to and with this range.
    ranges: Vec<(u64, u64, u64)>,
}

/// An hour: nobody is later.
const LONGEST: u64 = 3_600_000_000_000;

impl Latency {
    /// No time at all.
    pub const NONE: Latency = Latency::Constant(Span::ZERO);

    /// Nothing takes longer.
    pub fn longest(&self) -> Span {
        match self {
            Latency::Constant(span) | Latency::Uniform(_, span) => *span,
            Latency::Exponential(mean) => *mean * 10,
            Latency::Normal(mean, deviation) => *mean + *deviation * 6,
            Latency::Recorded(recorded) => {
                Span::from_nanos(recorded.ranges.last().map_or(0, |&(_, high, _)| high) as i64)
            }
        }
    }

    pub(super) fn draw(&self, random: &mut Random) -> u64 {
        match self {
            Latency::Constant(span) => nanos(*span),
            Latency::Uniform(from, to) => {
                let (from, to) = (nanos(*from), nanos(*to));
                from + random.below(to.saturating_sub(from) + 1)
            }
            Latency::Exponential(mean) => random.exponential(nanos(*mean)),
            Latency::Normal(mean, deviation) => {
                (mean.nanos() as f64 + random.normal() * deviation.nanos() as f64).max(0.0) as u64
            }
            Latency::Recorded(recorded) => recorded.draw(random),
        }
    }
}

impl Default for Latency {
    fn default() -> Self {
        Latency::NONE
    }
}

impl Recorded {
    /// From ranges of nanoseconds in ascending order, each with its lowest and highest value and how many there were;
    /// `None` if there were none at all, or more or longer ones than can be.
    pub fn new(ranges: impl IntoIterator<Item = (u64, u64, u64)>) -> Option<Self> {
        let mut total = 0_u64;
        let filled = ranges.into_iter().filter(|&(.., n)| n > 0);
        let ranges: Vec<_> = filled
            .map(|(low, high, n)| {
                total = total.checked_add(n)?;
                (low <= high && high <= LONGEST).then_some((low, high, total))
            })
            .collect::<Option<_>>()?;
        (total > 0).then_some(Self { ranges })
    }

    fn draw(&self, random: &mut Random) -> u64 {
        let total = self.ranges.last().map_or(0, |&(.., total)| total);
        let drawn = random.below(total);
        let (low, high, _) = self.ranges[self.ranges.partition_point(|&(.., up_to)| up_to <= drawn)];
        low + random.below(high - low + 1)
    }
}

pub(super) fn nanos(span: Span) -> u64 {
    span.nanos().max(0) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: Span = Span::from_micros(1);

    fn drawn(latency: &Latency) -> Vec<u64> {
        let mut random = Random::new(5);
        let mut all: Vec<u64> = (0..10_000).map(|_| latency.draw(&mut random)).collect();
        all.sort_unstable();
        all
    }

    fn mean(of: &[u64]) -> u64 {
        of.iter().sum::<u64>() / of.len() as u64
    }

    #[test]
    fn each_distribution_is_what_its_name_says() {
        let uniform = drawn(&Latency::Uniform(US, US * 3));
        assert!(uniform[0] >= 1_000 && uniform[9_999] <= 3_000);
        assert!((1_970..2_030).contains(&mean(&uniform)), "{}", mean(&uniform));
        let exponential = drawn(&Latency::Exponential(US * 13));
        assert!((12_500..13_500).contains(&mean(&exponential)), "{}", mean(&exponential));
        let normal = drawn(&Latency::Normal(US * 10, US));
        assert!((9_950..10_050).contains(&mean(&normal)), "{}", mean(&normal));
        assert!((10_900..11_100).contains(&normal[8_413]), "one deviation above: {}", normal[8_413]);
        assert_eq!(drawn(&Latency::Constant(US)), [1_000; 10_000]);
        assert!(drawn(&Latency::Normal(Span::ZERO, US)).first() == Some(&0), "never below zero");
    }

    #[test]
    fn what_was_recorded_is_drawn_as_often_as_it_was() {
        let recorded = Recorded::new([(0, 0, 0), (10, 19, 900), (1_000, 1_999, 100)]).unwrap();
        let drawn = drawn(&Latency::Recorded(Arc::new(recorded)));
        let short = drawn.iter().filter(|&&at| at < 20).count();
        assert!((8_900..9_100).contains(&short), "{short}");
        assert!(drawn[0] >= 10 && drawn[short] >= 1_000 && drawn[9_999] <= 1_999);
        for cannot_be in [(1, 2, 0), (0, u64::MAX, 1), (2, 1, 1)] {
            assert_eq!(Recorded::new([cannot_be]), None, "{cannot_be:?}");
        }
        assert_eq!(Recorded::new([(1, 2, u64::MAX), (1, 2, 1)]), None);
    }
}
