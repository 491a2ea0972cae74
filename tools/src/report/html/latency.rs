//! The latency plot in the form that OSADL made familiar: how many, in a log scale, over microseconds, a line per station.

use std::fmt::Write;
use std::ops::Range;

use super::Sheet;
use super::chart::Chart;
use super::markup::{count, escape, section, us};
use super::scale::{Counts, Linear, round_step};
use super::series::{Series, swatch};
use crate::report::histogram::SignedHistogram;

const HEIGHT: u32 = 300;
/// What is beyond so many bins is counted, not drawn.
const BINS_MAX: i64 = 400;
/// A plot is no narrower.
const BINS_MIN: i64 = 20;
/// So far to the left at the most it begins, in bins.
const EARLIEST: i64 = -100;
const X_STEPS: usize = 8;

/// What is drawn.
pub struct Plot<'a> {
    /// How often which time was seen, in nanoseconds, by station.
    pub times: &'a [SignedHistogram],
    /// The names of the stations.
    pub names: &'a [&'a str],
    /// How wide a bin is, in microseconds.
    pub bin_us: i64,
    /// Of what there are so many: `frames`.
    pub what: &'a str,
    /// What is measured of each: `slot error`.
    pub measured: &'a str,
}

/// How many there were in each bin.
#[derive(Clone, Debug, PartialEq)]
struct Bins {
    counts: Vec<u64>,
    before: u64,
    beyond: u64,
}

impl Bins {
    /// One for each whole `bin` (in nanoseconds) of the range, and what is outside.
    fn of<'a>(histograms: impl Iterator<Item = &'a SignedHistogram>, range: &Range<i64>, bin: i64) -> Self {
        let counts = vec![0; (range.end - range.start) as usize];
        let mut bins = Self { counts, before: 0, beyond: 0 };
        for histogram in histograms {
            // The middle of a histogram's bin may lie beyond its last value.
            let (min, max) = (histogram.min(), histogram.max());
            for (value, n) in histogram.iter() {
                match value.clamp(min, max).div_euclid(bin) {
                    at if at < range.start => bins.before += n,
                    at if at >= range.end => bins.beyond += n,
                    at => bins.counts[(at - range.start) as usize] += n,
                }
            }
        }
        bins
    }
}

/// How slot errors were, and what that is; a line that there is none, if no frame was seen.
pub fn html(sheet: &Sheet<'_>, series: &Series) -> String {
    let note = "Slot error = actual − scheduled transmit, in bins of 1 µs. What lies beyond the axis is counted in the legend.";
    let head = "How late frames were";
    let times = &sheet.kept.slot_error;
    if times.iter().all(SignedHistogram::is_empty) {
        return section("latency", head, "", "<p>No frame was seen in a slot.</p>\n");
    }
    let names: Vec<&str> = (0..times.len()).map(|station| sheet.name(station)).collect();
    let plot = Plot { times, names: &names, bin_us: 1, what: "frames", measured: "slot error" };
    section("latency", head, note, &plot.html(series))
}

/// The least of 1, 2, 5, 10, 20 ... microseconds of which a plot can hold a time of so many nanoseconds.
pub fn bin_for(longest: i64) -> i64 {
    round_step(longest / 1_000 + 1, BINS_MAX as usize - 1)
}

impl Plot<'_> {
    /// The plot and its legend.
    pub fn html(&self, series: &Series) -> String {
        let range = self.range();
        let lines: Vec<Line> = self.lines(series, &range);
        let most = lines.iter().flat_map(|line| &line.bins.counts).copied().max().unwrap_or(0);
        let (up, along) = (Counts::up_to(most, HEIGHT), self.axis(&range));
        let y = up.ticks().map(|n| (up.below_top(n), count(n))).collect();
        let x = along.ticks(X_STEPS).into_iter().map(|us| (along.percent(us), minus(us))).collect();
        let per =
            if self.bin_us == 1 { "µs".to_owned() } else { format!("{} µs", count(self.bin_us as u64)) };
        let chart = Chart {
            label: &format!("{} by {}, a line for each station", self.what, self.measured),
            height: HEIGHT,
            y,
            x,
            y_title: &format!("{} per {per}, log scale", self.what),
            x_title: &format!("{}, µs", self.measured),
        };
        // The worst lie above the others.
        let curves: String = lines.iter().rev().map(|line| line.curve(up)).collect();
        let legend: String = lines.iter().map(|line| line.legend(along)).collect();
        chart.html((range.end - range.start) as f64, &curves)
            + &format!("<ul class=\"legend\">\n{legend}</ul>\n")
    }

    fn bin(&self) -> i64 {
        self.bin_us * 1_000
    }

    /// The bins from the earliest to the latest, as far as there is room; 0 is always there.
    fn range(&self) -> Range<i64> {
        let all = self.times.iter().filter(|times| !times.is_empty());
        let (min, max) = all.fold((0, 0), |(min, max), one| (one.min().min(min), one.max().max(max)));
        let from = min.div_euclid(self.bin()).max(EARLIEST);
        from..(max.div_euclid(self.bin()) + 1).clamp(from + BINS_MIN, from + BINS_MAX)
    }

    fn axis(&self, range: &Range<i64>) -> Linear {
        Linear { from: range.start * self.bin_us, to: range.end * self.bin_us }
    }

    fn lines(&self, series: &Series, range: &Range<i64>) -> Vec<Line> {
        let line = |name: String, class: String, stations: &[usize]| {
            let its = || stations.iter().map(|&station| &self.times[station]).filter(|its| !its.is_empty());
            let (n, max) = (its().map(SignedHistogram::len).sum(), its().map(SignedHistogram::max).max());
            Line { name, class, bins: Bins::of(its(), range, self.bin()), n, max: max.unwrap_or(0) }
        };
        let one = |(place, &station): (usize, &usize)| {
            line(escape(self.names[station]), Series::class(place), &[station])
        };
        let mut lines: Vec<Line> = series.stations.iter().enumerate().map(one).collect();
        if !series.others.is_empty() {
            let name = format!("{} others together", count(series.others.len() as u64));
            lines.push(line(name, Series::OTHERS.into(), &series.others));
        }
        lines
    }
}

struct Line {
    name: String,
    class: String,
    bins: Bins,
    n: u64,
    max: i64,
}

impl Line {
    /// Steps, one for each bin.
    fn curve(&self, up: Counts) -> String {
        let mut path = format!("M0 {HEIGHT}");
        let mut at = None;
        for (i, &n) in self.bins.counts.iter().enumerate() {
            if at != Some(n) {
                let _ = write!(path, "H{i}V{:.1}", up.below_top(n));
                at = Some(n);
            }
        }
        let _ = write!(path, "H{}V{HEIGHT}", self.bins.counts.len());
        format!("<path class=\"curve {}\" d=\"{path}\"><title>{}</title></path>\n", self.class, self.name)
    }

    fn legend(&self, along: Linear) -> String {
        let Self { name, class, bins, n, max } = self;
        let mut outside = String::new();
        if bins.before > 0 {
            let _ = write!(outside, ", {} before {} µs", count(bins.before), minus(along.from));
        }
        if bins.beyond > 0 {
            let _ =
                write!(outside, ", <strong>{} beyond {} µs</strong>", count(bins.beyond), minus(along.to));
        }
        let max = if *n == 0 { "none".to_owned() } else { format!("max {} µs", us(Some(*max))) };
        format!("<li>{} <b>{name}</b> <span>{max}{outside}</span></li>\n", swatch(class))
    }
}

fn minus(value: i64) -> String {
    value.to_string().replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn histogram(values: &[i64]) -> SignedHistogram {
        let mut histogram = SignedHistogram::new();
        values.iter().for_each(|&value| histogram.record(value));
        histogram
    }

    fn plot(times: &[SignedHistogram]) -> Plot<'_> {
        Plot { times, names: &["a"], bin_us: 1, what: "frames", measured: "slot error" }
    }

    #[test]
    fn a_bin_is_a_whole_microsecond_also_below_zero_and_nothing_is_lost_outside() {
        let seen = histogram(&[-1, -1_000, -1_001, 0, 999, 1_000, 5_000_000, -900_000]);
        let bins = Bins::of([&seen].into_iter(), &(-2..3), 1_000);
        assert_eq!(bins, Bins { counts: vec![1, 2, 2, 1, 0], before: 1, beyond: 1 });
    }

    #[test]
    fn the_axis_holds_zero_and_ends_where_there_is_no_room() {
        let range = |values: &[i64]| plot(&[histogram(values)]).range();
        assert_eq!(range(&[3_000, 30_500]), 0..31);
        assert_eq!(range(&[-1, 2_000]), -1..19, "no narrower than {BINS_MIN}");
        assert_eq!(range(&[-5_000_000, 5_000_000]), -100..300);
        assert_eq!(range(&[]), 0..20);
    }

    #[test]
    fn bins_are_as_wide_as_what_is_to_be_shown_needs() {
        assert_eq!([0, 398_999, 399_000, 5_400_000].map(bin_for), [1, 1, 2, 20]);
        let times = [histogram(&[-30_000, 1_990_000, 9_000_000])];
        let plot = Plot { bin_us: 20, ..plot(&times) };
        assert_eq!(plot.range(), -2..398);
        assert_eq!(plot.axis(&plot.range()), Linear { from: -40, to: 7_960 });
        let bins = Bins::of(times.iter(), &plot.range(), plot.bin());
        assert_eq!((bins.counts[0], bins.counts[2 + 99], bins.beyond), (1, 1, 1));
    }

    #[test]
    fn a_curve_is_steps_from_bin_to_bin_and_ends_at_the_bottom() {
        let bins = Bins { counts: vec![0, 10, 10, 1], before: 0, beyond: 0 };
        let line = Line { name: "a".into(), class: "s0 d0".into(), bins, n: 21, max: 3_000 };
        let curve = line.curve(Counts::up_to(10, HEIGHT));
        assert!(curve.contains("d=\"M0 300H0V300.0H1V0.0H3V222.2H4V300\""), "{curve}");
    }
}
