//! How far the clocks were off over time: the least and the largest error of each bin, a strip per station.

use std::cmp::Reverse;
use std::fmt::Write;

use super::Sheet;
use super::markup::{count, escape, section, us};
use super::scale::Linear;
use super::series::Series;
use crate::judge::closely::envelope::Envelope;

/// Height of a strip, in pixels.
const STRIP: usize = 42;
const X_STEPS: usize = 6;
/// Strips at the most; of more stations the worst have one.
const STRIPS_MAX: usize = 12;
/// For so many cycles a station may tell nothing of its time, and its strip has no gap.
const GAP_CYCLES: u64 = 3;
/// Units in which a strip is drawn.
const WIDTH: f64 = 1_000.0;

/// The strips, one below the other, with one scale for all; nothing if no station told of its time.
pub fn html(sheet: &Sheet<'_>, series: &Series) -> String {
    let strips: Vec<Strip> = strips(sheet, series);
    let range = strips.iter().filter_map(|strip| strip.envelope.range());
    let Some((min, max)) = range.reduce(|(a, b), (c, d)| (a.min(c), b.max(d))) else { return String::new() };
    let begin = sheet.kept.begin;
    let measured = sheet.figures.cycles.saturating_mul(sheet.figures.cycle_ns);
    let bins = |strip: &Strip| strip.envelope.iter().map(|(_, to, ..)| to.saturating_sub(begin)).max();
    let end = strips.iter().filter_map(bins).max().unwrap_or(0).min(measured).max(1);
    let along = Linear { from: 0, to: end as i64 };
    // 0 is always there, and the middle of every strip.
    let most = min.abs().max(max.abs()).max(1);
    let up = Linear { from: most, to: -most };
    let height = strips.len() * STRIP;
    let gap = sheet.figures.cycle_ns.saturating_mul(GAP_CYCLES);

    let mut area = String::new();
    for at in along.ticks(X_STEPS) {
        let x = along.percent(at);
        let anchor = match x {
            ..1.0 => "start",
            97.0.. => "end",
            _ => "middle",
        };
        let _ = writeln!(
            area,
            "<line class=\"grid\" x1=\"{x:.3}%\" x2=\"{x:.3}%\" y1=\"0\" y2=\"{height}\"/>\
             <text x=\"{x:.3}%\" y=\"{}\" text-anchor=\"{anchor}\">{}</text>",
            height + 14,
            seconds(at)
        );
    }
    for (i, strip) in strips.iter().enumerate() {
        let y = i * STRIP;
        let _ = writeln!(
            area,
            "<line class=\"zero\" x1=\"0\" x2=\"100%\" y1=\"{0}\" y2=\"{0}\"/>\n\
             <svg x=\"0\" y=\"{y}\" width=\"100%\" height=\"{STRIP}\" viewBox=\"0 0 {WIDTH} {STRIP}\" preserveAspectRatio=\"none\">\
             <path class=\"band {1}\" d=\"{2}\"/></svg>",
            y + STRIP / 2,
            strip.class,
            strip.path(begin, along, up, gap)
        );
    }
    let labels: String = strips.iter().map(Strip::label).collect();
    let note = format!(
        "Sync error = estimated − true global time: the least and the largest in each of up to {} bins. \
         Every strip is from −{most} to +{most} µs high, with 0 in its middle; time in s since the measurement began.",
        crate::judge::closely::envelope::BINS_MAX,
        most = us(Some(most)),
    );
    let body = format!(
        "<div class=\"gantt strips\">\n<ol class=\"rows\">{labels}</ol>\n\
         <svg width=\"100%\" height=\"{}\" role=\"img\" aria-label=\"sync error over time, a strip for each station\">\n{area}</svg>\n</div>\n",
        height + 18
    );
    section("sync", "Clocks", &note, &body)
}

struct Strip {
    name: String,
    class: String,
    envelope: Envelope,
}

/// Of stations that told of their time.
fn strips(sheet: &Sheet<'_>, series: &Series) -> Vec<Strip> {
    let all = &sheet.kept.sync_error;
    let one = |(place, &station): (usize, &usize)| {
        let envelope = all.get(station)?.clone();
        Some(Strip { name: escape(sheet.name(station)), class: Series::class(place), envelope })
    };
    let mut strips: Vec<Strip> = series.stations.iter().enumerate().filter_map(one).collect();
    if !series.others.is_empty() {
        let mut envelope = Envelope::default();
        series.others.iter().filter_map(|&station| all.get(station)).for_each(|one| envelope.merge(one));
        let name = format!("{} others together", count(series.others.len() as u64));
        strips.push(Strip { name, class: Series::OTHERS.into(), envelope });
    }
    strips.retain(|strip| strip.envelope.range().is_some());
    few(strips)
}

/// The worst, in their order, and all others together.
fn few(mut strips: Vec<Strip>) -> Vec<Strip> {
    let most = |strip: &Strip| strip.envelope.range().map_or(0, |(min, max)| min.abs().max(max.abs()));
    let mut ranked: Vec<i64> = strips.iter().map(most).collect();
    ranked.sort_unstable_by_key(|&most| Reverse(most));
    let Some(&least) = ranked.get(STRIPS_MAX).and(ranked.get(STRIPS_MAX - 1)) else { return strips };
    let mut others = Strip {
        name: "all others together".into(),
        class: Series::OTHERS.into(),
        envelope: Envelope::default(),
    };
    strips.retain(|strip| {
        let is_worse = strip.class != Series::OTHERS && most(strip) > least;
        if !is_worse {
            others.envelope.merge(&strip.envelope);
        }
        is_worse
    });
    strips.push(others);
    strips
}

impl Strip {
    /// A box for each bin, as far as the next one, if that is not farther than `gap`.
    fn path(&self, begin: u64, along: Linear, up: Linear, gap: u64) -> String {
        let x = |at: u64| (along.percent(at.saturating_sub(begin) as i64) / 100.0 * WIDTH).min(WIDTH);
        let y = |value: i64| up.percent(value) / 100.0 * STRIP as f64;
        let mut path = String::new();
        let mut bins = self.envelope.iter().peekable();
        while let Some((from, to, min, max)) = bins.next() {
            let next = bins.peek().map_or(to, |next| next.0);
            let to = if next - to <= gap { next } else { to };
            let _ = write!(path, "M{:.1} {:.1}H{:.1}V{:.1}H{:.1}Z", x(from), y(max), x(to), y(min), x(from));
        }
        path
    }

    fn label(&self) -> String {
        let (min, max) = self.envelope.range().unwrap_or((0, 0));
        let sign = |ns: i64| if ns > 0 { "+" } else { "" };
        format!(
            "<li>{}<small>{}{} … {}{} µs</small></li>",
            self.name,
            sign(min),
            us(Some(min)),
            sign(max),
            us(Some(max))
        )
    }
}

/// Of nanoseconds, all that a tick has.
fn seconds(ns: i64) -> String {
    (ns as f64 / 1e9).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_has_a_box_for_each_bin_with_the_largest_above() {
        let mut envelope = Envelope::default();
        envelope.note(0, 50);
        envelope.note(0, -100);
        envelope.note(3 << 20, 100);
        let strip = Strip { name: "a".into(), class: String::new(), envelope };
        let path = |gap| strip.path(0, Linear { from: 0, to: 4 << 20 }, Linear { from: 100, to: -100 }, gap);
        assert_eq!(path(1 << 20), "M0.0 10.5H250.0V42.0H0.0ZM750.0 0.0H1000.0V0.0H750.0Z");
        assert_eq!(path(2 << 20), "M0.0 10.5H750.0V42.0H0.0ZM750.0 0.0H1000.0V0.0H750.0Z");
        assert_eq!(strip.label(), "<li>a<small>−0.10 … +0.10 µs</small></li>");
        assert_eq!((seconds(2_000_000_000), seconds(500_000_000)), ("2".into(), "0.5".into()));
    }

    #[test]
    fn of_many_stations_the_worst_have_a_strip() {
        let strip = |i: i64| {
            let mut envelope = Envelope::default();
            envelope.note(0, if i == 7 { -900 } else { i });
            Strip { name: i.to_string(), class: Series::class(0), envelope }
        };
        let names = |n| few((1..=n).map(strip).collect()).into_iter().map(|of| of.name).collect::<Vec<_>>();
        assert_eq!(names(12).len(), 12);
        let of_many = names(40);
        assert_eq!(
            (of_many.len(), &of_many[0], &of_many[1]),
            (STRIPS_MAX, &"7".to_owned(), &"31".to_owned())
        );
        assert_eq!(of_many[STRIPS_MAX - 1], "all others together");
    }
}
