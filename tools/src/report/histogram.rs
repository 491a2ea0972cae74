//! Histograms of signed times.
//!
//! ```text
//!   negative half (magnitudes)          non-negative half
//!  -100 s ........ -2 ns  -1 ns | 0  1 ns  2 ns ........ 100 s
//! ```
//!
//! An error keeps its sign until after the quantiles are taken: early and late are different faults.

use std::iter;

use hdrhistogram::{CreationError, Histogram};
use serde::{Deserialize, Serialize};

/// The largest magnitude, 100 s in nanoseconds. Values beyond it are recorded as it.
pub const HIGHEST: i64 = 100_000_000_000;

/// A bin is at most 0.1 % of its value wide, and 1 ns up to 2047 ns.
const SIGNIFICANT_DIGITS: u8 = 3;

/// How often each value was seen, in nanoseconds of either sign.
///
/// It grows with its values; one that is [`for_real_time`](Self::for_real_time) never allocates. Minimum, maximum, mean and standard deviation are exact; all else is
/// exact to half a bin, that is to 0.05 % of the value (and to the nanosecond up to 2047 ns).
#[derive(Clone, Debug)]
pub struct SignedHistogram {
    negative: Histogram<u64>,
    non_negative: Histogram<u64>,
    min: i64,
    max: i64,
    sum: i128,
    sum_of_squares: i128,
}

impl SignedHistogram {
    /// An empty histogram of 32 KiB, which grows with the magnitude of its values.
    pub fn new() -> Self {
        Self::of_halves(|| Histogram::new(SIGNIFICANT_DIGITS))
    }

    /// The same for a thread that may not allocate: about half a megabyte, touched only where values fall.
    pub fn for_real_time() -> Self {
        Self::of_halves(|| Histogram::new_with_bounds(1, HIGHEST as u64, SIGNIFICANT_DIGITS))
    }

    fn of_halves(half: impl Fn() -> Result<Histogram<u64>, CreationError>) -> Self {
        let half = || half().expect("the bounds are constants");
        Self {
            negative: half(),
            non_negative: half(),
            min: i64::MAX,
            max: i64::MIN,
            sum: 0,
            sum_of_squares: 0,
        }
    }

    /// Records one value, in nanoseconds.
    pub fn record(&mut self, value: i64) {
        self.record_n(value, 1);
    }

    /// Records `count` times the same value, in nanoseconds.
    pub fn record_n(&mut self, value: i64, count: u64) {
        if count == 0 {
            return;
        }
        let value = value.clamp(-HIGHEST, HIGHEST);
        let half = if value < 0 { &mut self.negative } else { &mut self.non_negative };
        half.record_n(value.unsigned_abs(), count).expect("no value is beyond the bounds");
        self.min = self.min.min(value);
        self.max = self.max.max(value);
        let (value, count) = (i128::from(value), i128::from(count));
        self.sum = self.sum.saturating_add(value * count);
        self.sum_of_squares = self.sum_of_squares.saturating_add((value * value).saturating_mul(count));
    }

    /// Adds all that the other one has recorded.
    pub fn merge(&mut self, other: &Self) {
        self.negative.add(&other.negative).expect("no value is beyond the bounds");
        self.non_negative.add(&other.non_negative).expect("no value is beyond the bounds");
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
        self.sum = self.sum.saturating_add(other.sum);
        self.sum_of_squares = self.sum_of_squares.saturating_add(other.sum_of_squares);
    }

    /// The number of recorded values.
    pub fn len(&self) -> u64 {
        self.negative.len() + self.non_negative.len()
    }

    /// Whether nothing is recorded.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The least value, exactly, in nanoseconds: the most negative one. 0 if nothing is recorded.
    pub fn min(&self) -> i64 {
        if self.is_empty() { 0 } else { self.min }
    }

    /// The greatest value, exactly, in nanoseconds. 0 if nothing is recorded.
    pub fn max(&self) -> i64 {
        if self.is_empty() { 0 } else { self.max }
    }

    /// The least value that a share of at least `q` (0 to 1) of all values does not exceed, in
    /// nanoseconds. 0 if nothing is recorded.
    pub fn quantile(&self, q: f64) -> i64 {
        if self.is_empty() {
            return 0;
        }
        let rank = (q.clamp(0.0, 1.0) * self.len() as f64).ceil() as u64;
        self.at_rank(rank.clamp(1, self.len()))
    }

    /// The quantile 0.5, in nanoseconds.
    pub fn median(&self) -> i64 {
        self.quantile(0.5)
    }

    /// The arithmetic mean in nanoseconds, signs kept. 0 if nothing is recorded.
    pub fn mean(&self) -> f64 {
        if self.is_empty() { 0.0 } else { self.sum as f64 / self.len() as f64 }
    }

    /// The standard deviation from the mean, of the values as a whole (not as a sample), in
    /// nanoseconds. 0 if nothing is recorded.
    pub fn sd(&self) -> f64 {
        if self.is_empty() {
            return 0.0;
        }
        // Moved next to zero in integers first: far from zero, the squares would cancel in f64.
        let n = i128::from(self.len());
        let centre = self.sum / n;
        let moved = self
            .sum_of_squares
            .saturating_sub(2 * centre * self.sum)
            .saturating_add((centre * centre).saturating_mul(n));
        let rest = (self.sum - centre * n) as f64 / n as f64;
        (moved as f64 / n as f64 - rest * rest).max(0.0).sqrt()
    }

    /// The recorded values in nanoseconds, ascending, each with its count.
    ///
    /// A value stands for its bin; recorded again it falls into the same one.
    pub fn iter(&self) -> impl Iterator<Item = (i64, u64)> {
        let mut negative: Vec<_> = bins(&self.negative).map(|(value, count)| (-value, count)).collect();
        negative.reverse();
        negative.into_iter().chain(bins(&self.non_negative))
    }

    /// The histogram of |value - center|.
    ///
    /// A deviation is as sharp as the value that it comes from (0.05 % of the value, not of the
    /// deviation), except that the maximum is exact.
    pub fn deviation_from(&self, center: i64) -> Self {
        let away = |value: i64| {
            i64::try_from(value.abs_diff(center)).map_or(HIGHEST, |deviation| deviation.min(HIGHEST))
        };
        let mut deviations = Self::new();
        for (value, count) in self.iter() {
            deviations.record_n(away(value), count);
        }
        if !self.is_empty() {
            deviations.max = away(self.min).max(away(self.max));
            deviations.min = deviations.min.min(deviations.max);
        }
        deviations
    }

    /// The figures of a report.
    pub fn summary(&self) -> Summary {
        let some = |value: i64| (!self.is_empty()).then_some(value);
        Summary {
            n: self.len(),
            min: some(self.min()),
            p50: some(self.quantile(0.5)),
            p99: some(self.quantile(0.99)),
            p999: some(self.quantile(0.999)),
            p9999: some(self.quantile(0.9999)),
            max: some(self.max()),
            sd: some(self.sd().round() as i64),
            gaps: None,
            longest_gap_ns: None,
        }
    }

    /// The value with that many values up to and including it, from 1 to `len`.
    fn at_rank(&self, rank: u64) -> i64 {
        let negatives = self.negative.len();
        let value = if rank > negatives {
            nth(&self.non_negative, rank - negatives)
        } else {
            -nth(&self.negative, negatives - rank + 1)
        };
        value.clamp(self.min, self.max)
    }
}

impl Default for SignedHistogram {
    fn default() -> Self {
        Self::new()
    }
}

/// What a report says of a [`SignedHistogram`]: integers in nanoseconds, none of them if `n` is 0.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Summary {
    /// The number of values.
    pub n: u64,
    /// The least value, exactly.
    pub min: Option<i64>,
    /// The median.
    pub p50: Option<i64>,
    /// The value that 99 % do not exceed.
    pub p99: Option<i64>,
    /// The value that 99.9 % do not exceed.
    pub p999: Option<i64>,
    /// The value that 99.99 % do not exceed.
    pub p9999: Option<i64>,
    /// The greatest value, exactly.
    pub max: Option<i64>,
    /// The standard deviation, rounded.
    pub sd: Option<i64>,
    /// How many more there would be, had nothing been missed; none where nothing can be.
    #[serde(default)]
    pub gaps: Option<u64>,
    /// The longest time without one, where what was missed has a length.
    #[serde(default)]
    pub longest_gap_ns: Option<i64>,
}

impl Summary {
    /// The same with what was missed, and so has no value.
    pub fn with_gaps(self, gaps: u64) -> Self {
        Self { gaps: Some(gaps), ..self }
    }
}

/// The magnitudes of one half, ascending: the middle of each bin that holds any, and how many.
fn bins(half: &Histogram<u64>) -> impl Iterator<Item = (i64, u64)> {
    let mut recorded = half.iter_recorded();
    iter::from_fn(move || {
        let bin = recorded.next()?;
        let middle = half.median_equivalent(bin.value_iterated_to());
        Some((middle as i64, bin.count_at_value()))
    })
}

/// The magnitude at this place, counted from 1, in ascending order.
fn nth(half: &Histogram<u64>, place: u64) -> i64 {
    let mut seen = 0;
    for (magnitude, count) in bins(half) {
        seen += count;
        if seen >= place {
            return magnitude;
        }
    }
    HIGHEST
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn histogram_of(values: &[i64]) -> SignedHistogram {
        let mut histogram = SignedHistogram::new();
        values.iter().for_each(|&value| histogram.record(value));
        histogram
    }

    fn values() -> impl Strategy<Value = Vec<i64>> {
        let value = prop_oneof![-3000..3000i64, -5_000_000..5_000_000i64, -HIGHEST..=HIGHEST];
        prop::collection::vec(value, 1..300)
    }

    fn close(found: i64, exact: i64) -> bool {
        found.abs_diff(exact) <= exact.unsigned_abs() / 1000
    }

    proptest! {
        #[test]
        fn quantiles_are_those_of_the_sorted_values(mut values in values(), q in 0.0..=1.0f64) {
            let histogram = histogram_of(&values);
            values.sort_unstable();
            for q in [0.0, q, 0.5, 0.99, 0.999, 1.0] {
                let rank = (q * values.len() as f64).ceil().max(1.0) as usize;
                let (found, exact) = (histogram.quantile(q), values[rank - 1]);
                prop_assert!(close(found, exact), "quantile {q}: {found}, not {exact}");
            }
            prop_assert_eq!(histogram.min(), values[0]);
            prop_assert_eq!(histogram.max(), values[values.len() - 1]);
        }

        #[test]
        fn mean_and_sd_are_those_of_the_values(values in values()) {
            let histogram = histogram_of(&values);
            let n = values.len() as f64;
            let mean = values.iter().map(|&v| v as f64).sum::<f64>() / n;
            let sd = (values.iter().map(|&v| (v as f64 - mean).powi(2)).sum::<f64>() / n).sqrt();
            prop_assert!((histogram.mean() - mean).abs() <= 1e-6 * mean.abs() + 1e-3);
            prop_assert!((histogram.sd() - sd).abs() <= 1e-6 * sd + 1e-3);
        }

        #[test]
        fn merged_is_recorded_together(a in values(), b in values()) {
            let mut merged = histogram_of(&a);
            merged.merge(&histogram_of(&b));
            let together = histogram_of(&[a, b].concat());
            prop_assert_eq!(merged.summary(), together.summary());
            prop_assert!(merged.iter().eq(together.iter()));
        }

        #[test]
        fn iterates_ascending_and_can_be_recorded_again(values in values()) {
            let histogram = histogram_of(&values);
            prop_assert!(histogram.iter().is_sorted_by(|a, b| a.0 < b.0));
            let mut again = SignedHistogram::new();
            histogram.iter().for_each(|(value, count)| again.record_n(value, count));
            prop_assert!(again.iter().eq(histogram.iter()));
        }

        #[test]
        fn deviations_are_those_of_the_values(values in values(), center in -1000..1000i64) {
            let deviations = histogram_of(&values).deviation_from(center);
            let exact = values.iter().map(|v| v.abs_diff(center).min(HIGHEST as u64)).max();
            prop_assert_eq!(Some(deviations.max() as u64), exact);
            prop_assert_eq!(deviations.len(), values.len() as u64);
            let mut sorted: Vec<_> = values.iter().map(|v| v.abs_diff(center) as i64).collect();
            sorted.sort_unstable();
            let exact = sorted[(values.len() * 99).div_ceil(100) - 1].min(HIGHEST);
            let largest = values.iter().map(|v| v.abs()).max().unwrap_or(0);
            prop_assert!(deviations.quantile(0.99).abs_diff(exact) as i64 <= (largest + exact) / 1000);
        }
    }

    #[test]
    fn far_from_zero_a_small_sd_is_still_seen() {
        assert_eq!(histogram_of(&[HIGHEST, HIGHEST - 2]).sd(), 1.0);
    }

    #[test]
    fn beyond_the_bounds_values_saturate() {
        let histogram = histogram_of(&[i64::MIN, i64::MAX]);
        assert_eq!((histogram.min(), histogram.max()), (-HIGHEST, HIGHEST));
        assert_eq!(histogram.deviation_from(i64::MIN).max(), HIGHEST);
    }

    #[test]
    fn one_that_grows_shows_the_same_as_one_for_real_time_and_is_small_while_its_values_are() {
        let (mut grows, mut fixed) = (SignedHistogram::new(), SignedHistogram::for_real_time());
        let counts = |of: &SignedHistogram| of.negative.distinct_values() + of.non_negative.distinct_values();
        for (values, room) in
            [(&[0, 1, -2_047][..], 4_096), (&[-90_000, 2_048, 123_456_789, HIGHEST], 40_000)]
        {
            for &value in values {
                grows.record_n(value, 3);
                fixed.record_n(value, 3);
            }
            assert_eq!(grows.summary(), fixed.summary());
            assert!(grows.iter().eq(fixed.iter()));
            assert!(counts(&grows) <= room, "{}", counts(&grows));
        }
        let merged = |mut into: SignedHistogram, other: &SignedHistogram| {
            into.merge(other);
            into.summary()
        };
        let both = merged(grows.clone(), &fixed);
        assert_eq!((both.n, merged(fixed.clone(), &grows)), (2 * grows.len(), both));
        assert_eq!(merged(SignedHistogram::new(), &fixed), fixed.summary());
    }

    #[test]
    fn an_empty_summary_is_all_null() {
        let json = serde_json::to_string(&SignedHistogram::new().summary()).unwrap();
        let nulls = r#""min":null,"p50":null,"p99":null,"p999":null,"p9999":null,"max":null,"sd":null"#;
        assert_eq!(json, format!(r#"{{"n":0,{nulls},"gaps":null,"longest_gap_ns":null}}"#));
    }
}
