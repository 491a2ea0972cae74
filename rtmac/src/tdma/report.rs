//! What the rounds of a calibration have shown.

use rtnet::time::Span;

/// A round longer than so many medians is an outlier: a host held one of its frames up.
const OUTLIER: i64 = 2;

/// What all rounds say together of the delay of a frame for one station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DelayOf {
    /// The lower quartile: hold-ups only ever make a round longer.
    Quartile,
    /// Half of the rounds were longer.
    Median,
    /// The arithmetic mean, as RTnet.
    Mean,
}

impl DelayOf {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            DelayOf::Quartile => "quartile",
            DelayOf::Median => "median",
            DelayOf::Mean => "mean",
        }
    }
}

/// Each round is half of what its two frames were on their way. Until the last it tells of those so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CalibrationReport {
    /// How many were measured.
    pub rounds: u32,
    /// The shortest.
    pub min: Span,
    /// The longest.
    pub max: Span,
    /// The arithmetic mean, which RTnet takes for the delay.
    pub mean: Span,
    /// What is known once all were measured.
    pub whole: Option<Delays>,
}

impl CalibrationReport {
    /// From the shortest to the longest.
    pub fn spread(&self) -> Span {
        self.max - self.min
    }
}

/// What all rounds say together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Delays {
    /// The lower quartile: what is taken for the delay unless something else is configured.
    pub quartile: Span,
    /// Half of the rounds were longer.
    pub median: Span,
    /// Rounds that were longer than twice the median.
    pub outliers: u32,
}

impl Delays {
    /// Of rounds, at least one, in any order; those not longer than the median come first then.
    pub fn of<T>(rounds: &mut [T], delay: impl Fn(&T) -> Span) -> Self {
        let at_quartile = rounds.len() / 4;
        let (quicker, middle, _) = rounds.select_nth_unstable_by_key(rounds.len() / 2, &delay);
        let median = delay(middle);
        let quartile = match quicker {
            [] => median,
            quicker => delay(quicker.select_nth_unstable_by_key(at_quartile, &delay).1),
        };
        let outliers = rounds.iter().filter(|round| delay(round) > median * OUTLIER).count();
        Self { quartile, median, outliers: outliers as u32 }
    }
}

/// The rounds so far, without remembering them.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    rounds: u32,
    min: Span,
    max: Span,
    sum: i64,
}

impl Tally {
    /// One more.
    pub fn note(&mut self, delay: Span) {
        let first = self.rounds == 0;
        self.min = if first { delay } else { self.min.min(delay) };
        self.max = if first { delay } else { self.max.max(delay) };
        self.rounds += 1;
        self.sum = self.sum.saturating_add(delay.nanos());
    }

    /// What they show, if there are any.
    pub fn report(&self, whole: Option<Delays>) -> Option<CalibrationReport> {
        let &Self { rounds, min, max, sum } = self;
        let mean = || Span::from_nanos(sum / i64::from(rounds));
        (rounds > 0).then(|| CalibrationReport { rounds, min, max, mean: mean(), whole })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(delays: &[i64]) -> CalibrationReport {
        let mut tally = Tally::default();
        let mut delays: Vec<_> = delays.iter().map(|&delay| Span::from_nanos(delay)).collect();
        delays.iter().for_each(|&delay| tally.note(delay));
        tally.report(Some(Delays::of(&mut delays, |&delay| delay))).unwrap()
    }

    #[test]
    fn one_held_up_round_moves_the_mean_but_neither_median_nor_quartile() {
        let report = report(&[700, 710, 400_000, 690, 705]);
        let whole = report.whole.unwrap();
        assert_eq!([report.min, report.max, report.mean].map(Span::nanos), [690, 400_000, 80_561]);
        assert_eq!([whole.quartile, whole.median].map(Span::nanos), [700, 705]);
        assert_eq!((report.rounds, whole.outliers, report.spread().nanos()), (5, 1, 399_310));
    }

    #[test]
    fn quartile_median_and_outliers_are_those_of_the_rounds_in_order() {
        for count in 1..=40 {
            let mut delays: Vec<_> = (0..count).map(|i| Span::from_nanos(i * i * 7_919 % 97)).collect();
            let mut in_order = delays.clone();
            in_order.sort_unstable();
            let [quartile, median] = [4, 2].map(|part| in_order[in_order.len() / part]);
            let outliers = in_order.iter().filter(|&&delay| delay > median * OUTLIER).count() as u32;
            assert_eq!(Delays::of(&mut delays, |&delay| delay), Delays { quartile, median, outliers });
        }
    }

    #[test]
    fn the_mean_is_an_integer_division_as_in_rtnet() {
        assert_eq!(report(&[1, 2]).mean.nanos(), 1);
        assert_eq!(report(&[45_000]).mean.nanos(), 45_000);
        assert_eq!(Tally::default().report(None), None, "nothing was measured");
    }
}
