//! How fast this station's clock gains on the master's, and how well that is known.

use rtnet::time::Span;

/// Crystals change their rate, mostly by less than this in a second.
const WANDER_PER_SECOND: f64 = 0.02e-6;
/// What follows from a straight line is wrong by so many standard deviations at most.
const SURE: f64 = 2.0;
/// Fewer points show no rate.
const POINTS_AT_LEAST: usize = 10;

/// A rate, in parts of one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    pub gains: f64,
    /// It is hardly wrong by more.
    pub unsure: f64,
}

impl Rate {
    /// The straight line that is nearest to points of time and what was gained by then, nanoseconds. From one end to the
    /// other they may all be `askew` by so much. `None` if they are too few, or all of one time.
    pub fn of_points(points: impl Iterator<Item = (f64, f64)> + Clone, askew: Span) -> Option<Self> {
        let count = points.clone().count();
        let mean = |sum: f64| sum / count as f64;
        let (middle_x, middle_y) = (
            mean(points.clone().map(|point| point.0).sum()),
            mean(points.clone().map(|point| point.1).sum()),
        );
        let around = points.map(|(x, y)| (x - middle_x, y - middle_y));
        let (squares, products) = around
            .clone()
            .fold((0.0, 0.0), |(squares, products), (x, y)| (squares + x * x, products + x * y));
        if count < POINTS_AT_LEAST || squares <= 0.0 {
            return None;
        }
        let gains = products / squares;
        let beside: f64 = around.clone().map(|(x, y)| (y - gains * x) * (y - gains * x)).sum();
        let deviation = (beside / (count - 2) as f64 / squares).sqrt();
        let (first, last) = around.fold((0.0, 0.0), |(first, last), (x, _)| (x.min(first), x.max(last)));
        Some(Self { gains, unsure: SURE * deviation + askew.nanos() as f64 / (last - first) })
    }

    /// What it is so much later.
    pub fn after(self, gone: Span) -> Self {
        Self { unsure: self.unsure + WANDER_PER_SECOND * gone.nanos().max(0) as f64 / 1e9, ..self }
    }

    /// Whether both can be.
    pub fn agrees_with(self, other: Self) -> bool {
        (self.gains - other.gains).abs() <= self.unsure + other.unsure
    }

    /// What both say together, each as far as it is sure.
    pub fn and(self, other: Self) -> Self {
        let [a, b] = [self, other].map(|rate| 1.0 / (rate.unsure * rate.unsure));
        Self { gains: (self.gains * a + other.gains * b) / (a + b), unsure: 1.0 / (a + b).sqrt() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a clock that gains 30 ppm, in a second.
    fn points(beside: impl Fn(u32) -> f64 + Clone) -> impl Iterator<Item = (f64, f64)> + Clone {
        (0..50).map(move |i| (f64::from(i) * 2e7, f64::from(i) * 600.0 + beside(i)))
    }

    #[test]
    fn noise_makes_a_rate_less_sure_but_hardly_wrong() {
        let exact = Rate::of_points(points(|_| 0.0), Span::ZERO).unwrap();
        assert!((exact.gains - 30e-6).abs() < 1e-12 && exact.unsure < 1e-12);
        let noisy = Rate::of_points(points(|i| f64::from(i * 7_919 % 2_001)), Span::ZERO).unwrap();
        assert!((noisy.gains - 30e-6).abs() < noisy.unsure, "{noisy:?}");
        assert!((0.1e-6..1e-6).contains(&noisy.unsure), "{noisy:?}");
    }

    #[test]
    fn what_may_be_askew_is_not_sure() {
        let rate = Rate::of_points(points(|_| 0.0), Span::from_micros(1)).unwrap();
        assert!((rate.unsure - 1_000.0 / 0.98e9).abs() < 1e-9, "{rate:?}");
    }

    #[test]
    fn few_points_or_all_of_one_time_show_no_rate() {
        assert_eq!(Rate::of_points(points(|_| 0.0).take(9), Span::ZERO), None);
        assert_eq!(Rate::of_points((0..20).map(|i| (5.0, f64::from(i))), Span::ZERO), None);
    }

    #[test]
    fn the_surer_of_two_counts_for_more_and_both_are_surer_than_one() {
        let [sure, unsure] = [(10e-6, 1e-6), (20e-6, 3e-6)].map(|(gains, unsure)| Rate { gains, unsure });
        let both = sure.and(unsure);
        assert!((both.gains - 11e-6).abs() < 1e-12 && both.unsure < 1e-6, "{both:?}");
        assert!(!sure.agrees_with(unsure));
        assert!(sure.after(Span::from_millis(400_000)).agrees_with(unsure), "8 ppm in 400 s");
    }
}
