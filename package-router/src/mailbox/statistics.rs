//! How long packages take, in words that others may read: counts of logarithmic classes, four to the octave.

use super::word::Segment;

/// Sub-classes of each octave: a figure is a quarter too long at the most.
const PARTS: u64 = 4;
/// Classes: up to 2^42 ns, more than an hour; what takes longer is in the last.
pub const BUCKETS: usize = 41 * PARTS as usize;

/// The class of a time in nanoseconds.
#[inline]
pub fn bucket(nanos: u64) -> usize {
    if nanos < PARTS {
        return nanos as usize;
    }
    let octave = u64::from(nanos.ilog2());
    let part = nanos >> (octave - 2) & (PARTS - 1);
    (((octave - 1) * PARTS + part) as usize).min(BUCKETS - 1)
}

/// The longest time in a class.
pub fn upper(bucket: usize) -> u64 {
    let bucket = bucket as u64;
    if bucket < PARTS {
        return bucket;
    }
    let (octave, part) = (bucket / PARTS + 1, bucket % PARTS);
    ((PARTS + part + 1) << (octave - 2)) - 1
}

/// Times, counted by classes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Latencies(Vec<u64>);

impl Latencies {
    /// As they stand in a segment, from there on.
    pub fn read(segment: &impl Segment, begin: usize) -> Self {
        Self((begin..begin + BUCKETS).map(|place| super::word::Word::get(segment.at(place))).collect())
    }

    /// How many there are.
    pub fn count(&self) -> u64 {
        self.0.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// The time that such a share of them does not exceed, in nanoseconds; `None` of none.
    pub fn quantile(&self, share: f64) -> Option<u64> {
        let wanted = (share * self.count() as f64).ceil().max(1.0);
        let mut seen = 0u64;
        let found = self.0.iter().position(|n| {
            seen = seen.saturating_add(*n);
            seen as f64 >= wanted
        });
        found.map(upper)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::sync::atomic::AtomicU64;
    use proptest::prelude::*;
    use std::sync::Arc;

    #[test]
    fn classes_follow_each_other_without_a_gap() {
        for class in 1..BUCKETS - 1 {
            assert_eq!(bucket(upper(class)), class);
            assert_eq!(bucket(upper(class - 1) + 1), class);
        }
        assert_eq!((bucket(0), bucket(u64::MAX)), (0, BUCKETS - 1));
    }

    proptest! {
        #[test]
        fn a_class_is_a_quarter_too_long_at_the_most(nanos in 0..1u64 << 42) {
            let longest = upper(bucket(nanos));
            prop_assert!(nanos <= longest && longest - nanos <= nanos / 4, "{nanos}: {longest}");
        }
    }

    #[test]
    fn quantiles_are_of_what_was_counted() {
        let words: Arc<[AtomicU64]> = (0..BUCKETS + 3).map(|_| AtomicU64::new(0)).collect();
        assert_eq!(Latencies::read(&words, 3).quantile(0.5), None);
        for nanos in 1..=1000u64 {
            words[3 + bucket(nanos)].fetch_add(1, core::sync::atomic::Ordering::Relaxed);
        }
        let latencies = Latencies::read(&words, 3);
        assert_eq!(latencies.count(), 1000);
        let p50 = latencies.quantile(0.5).unwrap();
        assert!((500..=625).contains(&p50), "{p50}");
        assert_eq!(latencies.quantile(0.0), Some(1));
        assert!(latencies.quantile(1.0).unwrap() >= 1000);
    }
}
