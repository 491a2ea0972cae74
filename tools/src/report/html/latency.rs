//! The latency plot in the form that OSADL made familiar: how many frames, in a log scale, over microseconds, a line per
//! station.

use std::fmt::Write;
use std::ops::Range;

use super::Sheet;
use super::chart::Chart;
use super::markup::{count, escape, section, us};
use super::scale::{Counts, Linear};
use super::series::{Series, swatch};
use crate::report::histogram::SignedHistogram;

const HEIGHT: u32 = 300;
/// Bins of 1 us: what is beyond them is counted, not drawn.
const BINS_MAX: i64 = 400;
/// A plot is no narrower.
const BINS_MIN: i64 = 20;
/// So far to the left at the most it begins.
const EARLIEST_US: i64 = -100;
const X_STEPS: usize = 8;

/// How often which slot error was seen.
#[derive(Clone, Debug, PartialEq)]
struct Bins {
    counts: Vec<u64>,
    before: u64,
    beyond: u64,
}

impl Bins {
    /// One for each whole microsecond of the range, and what is outside.
    fn of<'a>(histograms: impl Iterator<Item = &'a SignedHistogram>, range: &Range<i64>) -> Self {
        let counts = vec![0; (range.end - range.start) as usize];
        let mut bins = Self { counts, before: 0, beyond: 0 };
        for histogram in histograms {
            // The middle of a histogram's bin may lie beyond its last value.
            let (min, max) = (histogram.min(), histogram.max());
            for (value, n) in histogram.iter() {
                match value.clamp(min, max).div_euclid(1_000) {
                    us if us < range.start => bins.before += n,
                    us if us >= range.end => bins.beyond += n,
                    us => bins.counts[(us - range.start) as usize] += n,
                }
            }
        }
        bins
    }
}

/// From the earliest to the latest, as far as there is room; 0 is always there.
fn range<'a>(histograms: impl Iterator<Item = &'a SignedHistogram>) -> Range<i64> {
    let all = histograms.filter(|histogram| !histogram.is_empty());
    let (min, max) = all.fold((0, 0), |(min, max), one| (one.min().min(min), one.max().max(max)));
    let from = min.div_euclid(1_000).max(EARLIEST_US);
    from..(max.div_euclid(1_000) + 1).clamp(from + BINS_MIN, from + BINS_MAX)
}

/// The plot and its legend; a line that there is none, if no frame was seen.
pub fn html(sheet: &Sheet<'_>, series: &Series) -> String {
    let all = &sheet.kept.slot_error;
    let note = "Slot error = actual − scheduled transmit, in bins of 1 µs. What lies beyond the axis is counted in the legend.";
    let head = "How late frames were";
    if all.iter().all(SignedHistogram::is_empty) {
        return section("latency", head, "", "<p>No frame was seen in a slot.</p>\n");
    }
    let range = range(all.iter());
    let lines: Vec<Line> = lines(sheet, series, &range);
    let most = lines.iter().flat_map(|line| &line.bins.counts).copied().max().unwrap_or(0);
    let (up, along) = (Counts::up_to(most, HEIGHT), Linear { from: range.start, to: range.end });
    let y = up.ticks().map(|n| (up.below_top(n), count(n))).collect();
    let x = along.ticks(X_STEPS).into_iter().map(|us| (along.percent(us), minus(us))).collect();
    let chart = Chart {
        label: "frames by slot error, a line for each station",
        height: HEIGHT,
        y,
        x,
        y_title: "frames per µs, log scale",
        x_title: "slot error, µs",
    };
    // The worst lie above the others.
    let curves: String = lines.iter().rev().map(|line| line.curve(up)).collect();
    let legend: String = lines.iter().map(|line| line.legend(&range)).collect();
    let body = chart.html((range.end - range.start) as f64, &curves)
        + &format!("<ul class=\"legend\">\n{legend}</ul>\n");
    section("latency", head, note, &body)
}

struct Line {
    name: String,
    class: String,
    bins: Bins,
    n: u64,
    max: i64,
}

fn lines(sheet: &Sheet<'_>, series: &Series, range: &Range<i64>) -> Vec<Line> {
    let all = &sheet.kept.slot_error;
    let line = |name: String, class: String, stations: &[usize]| {
        let its = || stations.iter().map(|&station| &all[station]).filter(|its| !its.is_empty());
        let (n, max) = (its().map(SignedHistogram::len).sum(), its().map(SignedHistogram::max).max());
        Line { name, class, bins: Bins::of(its(), range), n, max: max.unwrap_or(0) }
    };
    let one = |(place, &station): (usize, &usize)| {
        line(escape(sheet.name(station)), Series::class(place), &[station])
    };
    let mut lines: Vec<Line> = series.stations.iter().enumerate().map(one).collect();
    if !series.others.is_empty() {
        let name = format!("{} others together", count(series.others.len() as u64));
        lines.push(line(name, Series::OTHERS.into(), &series.others));
    }
    lines
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

    fn legend(&self, range: &Range<i64>) -> String {
        let Self { name, class, bins, n, max } = self;
        let mut outside = String::new();
        if bins.before > 0 {
            let _ = write!(outside, ", {} before {} µs", count(bins.before), minus(range.start));
        }
        if bins.beyond > 0 {
            let _ =
                write!(outside, ", <strong>{} beyond {} µs</strong>", count(bins.beyond), minus(range.end));
        }
        let max = if *n == 0 { "no frame".to_owned() } else { format!("max {} µs", us(Some(*max))) };
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

    #[test]
    fn a_bin_is_a_whole_microsecond_also_below_zero_and_nothing_is_lost_outside() {
        let seen = histogram(&[-1, -1_000, -1_001, 0, 999, 1_000, 5_000_000, -900_000]);
        let bins = Bins::of([&seen].into_iter(), &(-2..3));
        assert_eq!(bins, Bins { counts: vec![1, 2, 2, 1, 0], before: 1, beyond: 1 });
    }

    #[test]
    fn the_axis_holds_zero_and_ends_where_there_is_no_room() {
        let range = |values: &[i64]| range([&histogram(values)].into_iter());
        assert_eq!(range(&[3_000, 30_500]), 0..31);
        assert_eq!(range(&[-1, 2_000]), -1..19, "no narrower than {BINS_MIN}");
        assert_eq!(range(&[-5_000_000, 5_000_000]), -100..300);
        assert_eq!(range(&[]), 0..20);
    }

    #[test]
    fn a_curve_is_steps_from_bin_to_bin_and_ends_at_the_bottom() {
        let bins = Bins { counts: vec![0, 10, 10, 1], before: 0, beyond: 0 };
        let line = Line { name: "a".into(), class: "s0 d0".into(), bins, n: 21, max: 3_000 };
        let curve = line.curve(Counts::up_to(10, HEIGHT));
        assert!(curve.contains("d=\"M0 300H0V300.0H1V0.0H3V222.2H4V300\""), "{curve}");
    }
}
