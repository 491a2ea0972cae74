//! The least and the largest of a value over time, in a bounded number of bins, however long that is.

use rtnet::clock::True;

/// Bins at the most; when more are needed, every two become one.
pub const BINS_MAX: usize = 256;
/// The shortest bin, as a power of two of nanoseconds: 1 ms.
const SHORTEST: u32 = 20;

/// Bins of one length, which begin at multiples of it: those of several are comparable.
#[derive(Clone, Debug, PartialEq)]
pub struct Envelope {
    /// Length of a bin: so many powers of two of nanoseconds.
    power: u32,
    /// The number of the first bin.
    first: u64,
    bins: Vec<Option<(i64, i64)>>,
}

impl Default for Envelope {
    fn default() -> Self {
        Self { power: SHORTEST, first: 0, bins: Vec::new() }
    }
}

impl Envelope {
    /// A value at a moment.
    pub fn note(&mut self, at: True, value: i64) {
        if self.bins.is_empty() {
            self.first = at >> self.power;
        }
        // What is told late may be of before the first.
        while (at >> self.power).abs_diff(self.first) as usize >= BINS_MAX
            || self.bins.len() as u64 + self.first.saturating_sub(at >> self.power) > BINS_MAX as u64
        {
            self.halve();
        }
        let bin = at >> self.power;
        if bin < self.first {
            let missing = (self.first - bin) as usize;
            self.bins.splice(0..0, vec![None; missing]);
            self.first = bin;
        }
        let place = (bin - self.first) as usize;
        if place >= self.bins.len() {
            self.bins.resize(place + 1, None);
        }
        let bin = &mut self.bins[place];
        *bin = Some(bin.map_or((value, value), |(min, max)| (min.min(value), max.max(value))));
    }

    /// Bins of twice the length.
    fn halve(&mut self) {
        let mut bins: Vec<Option<(i64, i64)>> = Vec::new();
        for (i, bin) in self.bins.iter().enumerate() {
            let place = ((self.first + i as u64) / 2 - self.first / 2) as usize;
            bins.resize(bins.len().max(place + 1), None);
            bins[place] = union(bins[place], *bin);
        }
        (self.power, self.first, self.bins) = (self.power + 1, self.first / 2, bins);
    }

    /// The envelope of both.
    pub fn merge(&mut self, other: &Self) {
        for (from, _, min, max) in other.iter() {
            self.note(from, min);
            self.note(from, max);
        }
    }

    /// Each bin in which there was a value: its begin and its end, the least and the largest.
    pub fn iter(&self) -> impl Iterator<Item = (True, True, i64, i64)> {
        let bins = (self.first..).zip(&self.bins);
        bins.filter_map(|(i, bin)| bin.map(|(min, max)| (i << self.power, (i + 1) << self.power, min, max)))
    }

    /// The least and the largest of all.
    pub fn range(&self) -> Option<(i64, i64)> {
        self.bins.iter().copied().fold(None, union)
    }
}

fn union(one: Option<(i64, i64)>, other: Option<(i64, i64)>) -> Option<(i64, i64)> {
    match (one, other) {
        (Some((a, b)), Some((c, d))) => Some((a.min(c), b.max(d))),
        (some, None) | (None, some) => some,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn every_value_is_in_the_bin_of_its_moment_and_bins_stay_few(
            values in prop::collection::vec((0..5_000_000_000_000_u64, -1_000..1_000_i64), 1..300),
        ) {
            let mut envelope = Envelope::default();
            values.iter().for_each(|&(at, value)| envelope.note(at, value));
            prop_assert!(envelope.bins.len() <= BINS_MAX);
            for (at, value) in values {
                let holds = |&(from, to, min, max): &(u64, u64, i64, i64)| {
                    (from..to).contains(&at) && (min..=max).contains(&value)
                };
                prop_assert!(envelope.iter().any(|bin| holds(&bin)), "{at} {value}");
            }
        }
    }

    #[test]
    fn bins_are_no_longer_than_they_must_be_and_say_nothing_where_nothing_was() {
        let mut envelope = Envelope::default();
        let bin = 1 << SHORTEST;
        [(10 * bin, 5), (10 * bin + 7, -5), (12 * bin, 1)]
            .iter()
            .for_each(|&(at, value)| envelope.note(at, value));
        let all: Vec<_> = envelope.iter().collect();
        assert_eq!(all, [(10 * bin, 11 * bin, -5, 5), (12 * bin, 13 * bin, 1, 1)]);
        envelope.note((10 + BINS_MAX as u64) * bin, 9);
        assert_eq!((envelope.power, envelope.range()), (SHORTEST + 1, Some((-5, 9))));
    }

    #[test]
    fn the_envelope_of_two_holds_both() {
        let (mut one, mut other) = (Envelope::default(), Envelope::default());
        one.note(0, 3);
        other.note(3 << 40, -4);
        one.merge(&other);
        assert_eq!(one.range(), Some((-4, 3)));
        assert_eq!(Envelope::default().range(), None);
    }
}
