//! Where values lie in a picture. Pure arithmetic.

/// The decade below 1, of which so much is shown: a count of 1 is to be seen, too.
const BELOW_ONE: f64 = 0.35;

/// Whole values along a line, from one to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Linear {
    /// At 0 %.
    pub from: i64,
    /// At 100 %.
    pub to: i64,
}

impl Linear {
    /// Where a value lies, in per cent; outside of the line, too.
    pub fn percent(self, value: i64) -> f64 {
        let (from, to) = (self.from as f64, self.to as f64);
        if self.to == self.from { 0.0 } else { (value as f64 - from) / (to - from) * 100.0 + 0.0 }
    }

    /// The round values on it, at most `most` steps apart: of 1, 2 or 5 times a power of ten.
    pub fn ticks(self, most: usize) -> Vec<i64> {
        let step = round_step(self.to - self.from, most);
        let first = self.from.div_euclid(step) * step;
        (0..)
            .map(|i| first + i * step)
            .skip_while(|&at| at < self.from)
            .take_while(|&at| at <= self.to)
            .collect()
    }
}

/// The least of 1, 2, 5, 10, 20 ... that divides a length into at most `most` steps.
pub fn round_step(length: i64, most: usize) -> i64 {
    let most = most.max(1) as i64;
    let mut decade = 1;
    loop {
        if let Some(step) =
            [1, 2, 5].map(|first| first * decade).into_iter().find(|step| length / step <= most)
        {
            return step;
        }
        decade *= 10;
    }
}

/// Counts up a picture of this height: each decade is as high as any other, and none of a count is at the bottom.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Counts {
    decades: u32,
    height: f64,
}

impl Counts {
    /// Up to that count.
    pub fn up_to(most: u64, height: u32) -> Self {
        let decades = (0..)
            .find(|&decades| 10_u64.checked_pow(decades).is_none_or(|all| all >= most.max(10)))
            .unwrap_or(19)
            .min(19);
        Self { decades, height: height.into() }
    }

    /// How far below the top a count lies.
    pub fn below_top(self, count: u64) -> f64 {
        if count == 0 {
            return self.height;
        }
        let all = f64::from(self.decades) + BELOW_ONE;
        self.height * (1.0 - ((count as f64).log10() + BELOW_ONE) / all)
    }

    /// The powers of ten in it.
    pub fn ticks(self) -> impl Iterator<Item = u64> {
        (0..=self.decades).map(|decade| 10_u64.pow(decade))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_no_more_than_asked_for() {
        let ticks = |from, to, most| Linear { from, to }.ticks(most);
        assert_eq!(ticks(-7, 23, 6), [-5, 0, 5, 10, 15, 20]);
        assert_eq!(ticks(0, 400, 8), [0, 50, 100, 150, 200, 250, 300, 350, 400]);
        assert_eq!(ticks(0, 1, 5), [0, 1]);
        assert_eq!(ticks(0, 2_000_000, 10).len(), 11);
        assert_eq!(ticks(3, 3, 5), [3]);
    }

    #[test]
    fn a_value_lies_where_its_share_says() {
        let line = Linear { from: -100, to: 300 };
        assert_eq!([-100, 0, 300, 500].map(|at| line.percent(at)), [0.0, 25.0, 100.0, 150.0]);
        assert_eq!(Linear { from: 5, to: 5 }.percent(5), 0.0);
    }

    #[test]
    fn every_decade_is_as_high_and_one_frame_is_seen() {
        let scale = Counts::up_to(1_000, 300);
        assert_eq!(scale.ticks().collect::<Vec<_>>(), [1, 10, 100, 1_000]);
        let at: Vec<f64> = scale.ticks().map(|n| scale.below_top(n)).collect();
        assert!(at.windows(2).all(|two| (two[0] - two[1] - (at[0] - at[1])).abs() < 1e-9), "{at:?}");
        assert_eq!((scale.below_top(0), at[3].abs() < 1e-9), (300.0, true));
        assert!(at[0] < 280.0, "one frame is above none: {at:?}");
        assert_eq!(Counts::up_to(0, 10).ticks().count(), 2);
        assert_eq!(Counts::up_to(u64::MAX, 10).ticks().last(), Some(10_000_000_000_000_000_000));
    }
}
