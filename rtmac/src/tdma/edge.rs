//! A line below points, each of which is on it or late.

use std::collections::VecDeque;

use rtnet::time::{Instant, Span};

use super::line::{DRIFT_PARTS, Drift};
use super::rate::Rate;

/// Points no later than this are on the line.
const ON_IT: Span = Span::from_micros(2);
/// So many of either half are on a line that is the clocks'; where fewer are, one half may be of a busy host.
const ON_IT_AT_LEAST: usize = 6;

/// A cycle's start on this clock, as its Synchronisation told.
#[derive(Clone, Copy, Debug, Default)]
pub struct Point {
    pub cycle: u32,
    pub start: Instant,
}

/// Points in the order of their cycles.
pub trait Points<'a>: DoubleEndedIterator<Item = &'a Point> + ExactSizeIterator + Clone {}

impl<'a, T: DoubleEndedIterator<Item = &'a Point> + ExactSizeIterator + Clone> Points<'a> for T {}

/// A line of cycles' starts.
#[derive(Clone, Copy)]
pub struct Edge {
    through: Point,
    pub period: Span,
    pub drift: Drift,
    /// By how much the drift may be wrong, in parts of one.
    pub unsure: f64,
}

impl Edge {
    /// The line of one drift through a point.
    pub fn through(through: Point, drift: Drift, period: Span) -> Self {
        Self { through, period, drift, unsure: 0.0 }
    }

    /// The line of a rate that is known, through the lowest point. The older one is, the less sure it is how low it lies
    /// now: by that it counts as later, and twice, for a calibration of a busy host may be wrong by more than it says.
    pub fn of_rate(points: &VecDeque<Point>, rate: Rate, period: Span) -> Option<Self> {
        let last = *points.back()?;
        let flat = Self::through(last, Drift::of_rate(rate.gains, period), period);
        let now = |&point: &&Point| {
            let ago = period * i64::from(cycles(*point, last));
            flat.late(point) + Span::from_nanos((2.0 * rate.unsure * ago.nanos() as f64) as i64)
        };
        let through = *points.iter().min_by_key(now)?;
        Some(Self { through, unsure: rate.unsure, ..flat })
    }

    /// The edge of the points' lower convex hull below their middle. From the earlier half to the later one so that
    /// nothing lies below: from whichever points it is drawn, the lowest of either half, seen along the edge, are better
    /// ends, until they are the ends. No more than `N` points.
    pub fn below_the_middle<'a, const N: usize>(points: impl Points<'a>, period: Span) -> Option<Self> {
        let first = *points.clone().next()?;
        let mut places = [(0, 0); N];
        for (place, &point) in places.iter_mut().zip(points.clone()) {
            let x = i64::from(cycles(first, point));
            *place = (x, (point.start - first.start - period * x).nanos());
        }
        let places = &places[..points.len()];
        let half = places.partition_point(|&(x, _)| x <= places[places.len() - 1].0 / 2);
        let (mut from, mut to) = (0, places.len() - 1);
        for _ in 0..places.len() {
            let (dx, dy) = (places[to].0 - places[from].0, places[to].1 - places[from].1);
            let height = |&of: &usize| {
                let (x, y) = places[of];
                y.saturating_mul(dx).saturating_sub(x.saturating_mul(dy))
            };
            let lowest = |of, half| core::iter::once(of).chain(half).min_by_key(height);
            let ends = (lowest(from, 0..half)?, lowest(to, half..places.len())?);
            if ends == (from, to) {
                // Two clocks may differ by the limit. The delays of the ends make the edge steeper by `ON_IT` at most.
                let at_most = (period * dx / DRIFT_PARTS).nanos();
                let gained =
                    Some(dy.clamp(-at_most, at_most)).filter(|gained| (dy - gained).abs() <= ON_IT.nanos());
                let drift = Drift::new(Span::from_nanos(gained?), dx, period)?;
                let ends = [*points.clone().nth(from)?, *points.clone().nth(to)?];
                let edge = Self::through(ends[1], drift, period);
                return Some(Self { unsure: edge.unsure(points, half, ends)?, ..edge });
            }
            (from, to) = ends;
        }
        None
    }

    /// Bound of the error of its drift, in parts of one; `through` are its two ends. The delays of two points on the edge
    /// differ by 2 us at most, or by the largest delay if one half has few points on the edge. The bound is this difference,
    /// plus the distance of the two points from the edge, divided by the time between them. The outermost points on the edge
    /// may give a smaller bound than its ends: if many points are on it, rounding decides which are the ends.
    fn unsure<'a>(&self, points: impl Points<'a>, half: usize, through: [Point; 2]) -> Option<f64> {
        let is_on_it = |point: &&Point| self.late(point) <= ON_IT;
        let on_it = points.clone().take(half).filter(is_on_it).count();
        let on_it_later = points.clone().skip(half).filter(is_on_it).count();
        let off = if on_it.min(on_it_later) >= ON_IT_AT_LEAST {
            ON_IT
        } else {
            points.clone().map(|point| self.late(point)).fold(ON_IT, Span::max)
        };
        let outermost = [*points.clone().find(is_on_it)?, *points.clone().rfind(is_on_it)?];
        let wrong = |[from, to]: [Point; 2]| {
            let apart = (self.late(&to) - self.late(&from)).abs();
            (off + apart).nanos() as f64 / (self.period * i64::from(cycles(from, to))).nanos().max(1) as f64
        };
        Some(wrong(through).min(wrong(outermost)))
    }

    /// A cycle's start.
    pub fn start_of(&self, cycle: u32) -> Instant {
        let ahead = cycle.wrapping_sub(self.through.cycle) as i32;
        self.through.start + self.period * i64::from(ahead) + self.drift.over(ahead)
    }

    /// How much later than the line a point is.
    pub fn late(&self, point: &Point) -> Span {
        point.start - self.start_of(point.cycle)
    }

    pub fn rate(&self) -> Rate {
        Rate { gains: self.drift.rate(self.period), unsure: self.unsure }
    }

    /// By how much it may be wrong in a cycle, in which the rate may have been another.
    pub fn unsure_in(&self, cycle: u32) -> Span {
        let ago = (self.period * i64::from(cycle.wrapping_sub(self.through.cycle) as i32)).abs();
        let unsure = (self.unsure + self.rate().after(ago).unsure) / 2.0;
        Span::from_nanos((unsure * ago.nanos() as f64) as i64)
    }

    /// All starts were wrong by as much.
    pub fn shift(&mut self, by: Span) {
        self.through.start += by;
    }
}

/// Cycles from one to another, shortest way round 2^32.
fn cycles(from: Point, to: Point) -> i32 {
    to.cycle.wrapping_sub(from.cycle) as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Span = Span::from_millis(1);

    /// Drift of the edge of two clocks 200 ppm apart, in parts per 10^9. The first point is later by `delay` nanoseconds.
    fn drift_of(delay: i64) -> Option<i64> {
        let point = |i: u32| {
            let late = if i == 0 { delay } else { 0 };
            let start = Instant::from_nanos(1 << 40) + PERIOD * i64::from(i * 64);
            Point { cycle: i * 64, start: start - Span::from_nanos(i64::from(i) * 64 * 200 - late) }
        };
        let points: Vec<Point> = (0..2).map(point).collect();
        Edge::below_the_middle::<2>(points.iter(), PERIOD).map(|edge| edge.drift.parts_per_billion(PERIOD))
    }

    #[test]
    fn the_fastest_clocks_have_an_edge_whatever_delays_do() {
        assert_eq!([0, 1, ON_IT.nanos()].map(drift_of), [Some(-200_000); 3]);
        assert_eq!(drift_of(ON_IT.nanos() + 1), None, "no clocks run apart so fast");
        assert_eq!(drift_of(-640), Some(-190_000));
    }
}
