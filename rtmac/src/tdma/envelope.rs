//! When cycles start: the line below the Synchronisations, and how fast two clocks run apart.
//!
//! ```text
//!  start of a cycle on this clock, less cycles x period
//!   ▲  ·     ·      ·    ·  ·           ·  a Synchronisation
//!   │    ·    · ·      ·     · · ·      o  the early one of its window
//!   │  · ·   ·     ·  ·   ·   ·
//!   │   ·  ·    · o════════════════o──► the edge below the middle, and on
//!   │ o─────────      │       │
//!   └─────────┴───────┴───────┴──────► cycle
//! ```
//!
//! Frames are held up on their way, by a busy host for seconds on end, but never early. So the early ones show the
//! clocks, and all others the host: of every window an early one is kept, and the edge of their lower convex hull
//! that lies below their middle is the line. A host that does everything more slowly for seconds, as a core does whose
//! sibling is busy, delivers all frames later by some microseconds: what it did before and after shows the clocks.
//!
//! The line is wrong, and all begins anew, if frames are clearly earlier; if the early ones come later and later by about
//! as much, since then a clock has changed its rate: a host is busy less evenly; and if they have long been clearly late.

use std::collections::VecDeque;

use rtnet::time::{Instant, Span};

use super::line::Drift;

/// Synchronisations of a window.
const WINDOW: usize = 64;
/// Crystals change their rate: where a window would be longer, at cycles above 31 ms, the few that it may have of
/// this time do not show a line, and there is none.
const WINDOW_AT_MOST: Span = Span::from_millis(2_000);
/// The early one of a window has this part of it before it: the very first may be a stamp's error.
const EARLY_PARTS: usize = 8;
/// So many windows are kept: less than half of them may be of a busy host, eight seconds at a cycle of 1 ms.
const WINDOWS: usize = 256;
/// Of longer cycles fewer, down to this many: crystals change their rate...
const WINDOWS_KEPT_AT_LEAST: usize = 64;
/// ... and what is older shows another.
const OLDEST: Span = Span::from_micros(16_384_000);
/// Fewer do not show a line: what becomes quiet looks like drift.
const WINDOWS_AT_LEAST: usize = 8;
/// After so long that has passed: in records of 28 slaves lines were within 0.5 us from then on, and off by 2 us before.
const CLEAR_AFTER: Span = Span::from_millis(1_280);
/// What is earlier than the line by less is a stamp's noise, and so are a few of a window.
const NOISE: Span = Span::from_micros(10);
const NOISE_AT_MOST: usize = 2;
/// Without a line, what is earlier than expected by less, or by less than this part of a cycle, shows that what was
/// expected had been late.
const UNSURE: Span = Span::from_micros(20);
const UNSURE_PARTS: i64 = 1_000;
/// So many windows, each later than the one before by about as much, are another rate. They follow each other, or, for
/// what comes slowly, one of so many does.
const RISING: usize = 8;
const STRIDES: [usize; 4] = [1, 2, 4, 8];
/// So many windows that are all clearly later than the line are not a busy host.
const LEFT: usize = 32;

/// A cycle's start on this clock, as its Synchronisation told.
#[derive(Clone, Copy, Debug, Default)]
struct Point {
    cycle: u32,
    start: Instant,
}

/// The early Synchronisations, and the line through them.
pub struct Envelope {
    window: Vec<Point>,
    /// Of this window, those that are clearly earlier than the line.
    too_early: usize,
    early: VecDeque<Point>,
    /// Since this cycle the clocks have been the same.
    since: Option<u32>,
    edge: Option<Edge>,
}

/// A line of cycles' starts.
#[derive(Clone, Copy)]
struct Edge {
    /// Its ends: the cycle of the first, and the last.
    from: u32,
    through: Point,
    drift: Drift,
    period: Span,
}

impl Envelope {
    pub fn new() -> Self {
        let (window, early) = (Vec::with_capacity(WINDOW), VecDeque::with_capacity(WINDOWS));
        Self { window, too_early: 0, early, since: None, edge: None }
    }

    /// Whether there is ever a line at cycles of this length.
    pub fn serves(period: Span) -> bool {
        period * WINDOW as i64 <= WINDOW_AT_MOST
    }

    /// All that is known is of another line.
    pub fn restart(&mut self) {
        self.forget_edge();
        self.since = None;
    }

    /// The line was late, or the way has become quicker: the clocks are the same.
    fn forget_edge(&mut self) {
        self.window.clear();
        self.too_early = 0;
        self.early.clear();
        self.edge = None;
    }

    /// All starts were wrong by as much.
    pub fn shift(&mut self, by: Span) {
        let edge = self.edge.iter_mut().map(|edge| &mut edge.through);
        let points = self.window.iter_mut().chain(&mut self.early).chain(edge);
        points.for_each(|point| point.start += by);
    }

    /// One more Synchronisation, of a cycle that was `expected` to start by what is followed now. Whether the line is
    /// another since.
    pub fn note(&mut self, cycle: u32, start: Instant, expected: Instant, period: Span) -> bool {
        if !Self::serves(period) {
            return false;
        }
        if self.is_disproved(expected - start, period) {
            self.forget_edge();
        }
        self.since.get_or_insert(cycle);
        self.window.push(Point { cycle, start });
        let full = self.window.len() == WINDOW;
        if full {
            self.end_window(period);
        }
        full
    }

    fn is_disproved(&mut self, early: Span, period: Span) -> bool {
        if self.edge.is_none() {
            return early > UNSURE.max(period / UNSURE_PARTS);
        }
        self.too_early += usize::from(early > NOISE);
        self.too_early > NOISE_AT_MOST
    }

    fn end_window(&mut self, period: Span) {
        if self.early.len() >= kept(period) {
            self.keep_last(kept(period) - 1);
        }
        let early = self.early_one(period);
        self.early.push_back(early);
        self.window.clear();
        self.too_early = 0;
        if let Some(stride) = STRIDES.into_iter().find(|&stride| self.rises(stride)) {
            self.keep_last(stride * (RISING - 1) + 1);
        } else if self.is_left() {
            self.keep_last(LEFT);
        }
        self.edge = self.edge_below_the_middle(period);
    }

    fn keep_last(&mut self, windows: usize) {
        self.early.drain(..self.early.len() - windows);
        self.since = self.early.front().map(|point| point.cycle);
    }

    /// How much later than the line the windows were, the last first.
    fn late(&self) -> impl Iterator<Item = Span> + Clone {
        let late = |edge: Edge, point: &Point| point.start - edge.start_of(point.cycle);
        self.edge
            .into_iter()
            .flat_map(move |edge| self.early.iter().rev().map(move |point| late(edge, point)))
    }

    /// Whether the last windows have left the line as evenly as clocks do.
    fn rises(&self, stride: usize) -> bool {
        let late = self.late().step_by(stride).take(RISING);
        let (Some(last), Some(first)) = (late.clone().next(), late.clone().nth(RISING - 1)) else {
            return false;
        };
        let risen = last - first;
        let step_at_most = risen * 2 / (RISING as i64 - 1);
        let mut steps = late.clone().zip(late.skip(1)).map(|(later, before)| later - before);
        risen > NOISE && steps.all(|step| step > Span::ZERO && step < step_at_most)
    }

    /// Whether the line is the past's.
    fn is_left(&self) -> bool {
        self.early.len() > LEFT && self.late().take(LEFT).all(|late| late > NOISE)
    }

    /// When a cycle starts, and how fast the clocks run apart; `None` until that is known.
    pub fn start_of(&self, cycle: u32) -> Option<(Instant, Drift)> {
        self.edge.map(|edge| (edge.start_of(cycle), edge.drift))
    }

    /// Whether the clocks have been the same since this cycle, as far as is remembered.
    pub fn is_unbroken_since(&self, cycle: u32) -> bool {
        self.since.is_some_and(|since| cycle.wrapping_sub(since) as i32 >= 0)
    }

    /// Whether the line is known well enough for a cycle so long ago: not farther from it than it is long.
    pub fn reaches_back_to(&self, cycle: u32) -> bool {
        self.edge.is_some_and(|Edge { from, through, .. }| {
            from.wrapping_sub(cycle) as i32 <= through.cycle.wrapping_sub(from) as i32
        })
    }

    /// Whether the line is of time enough.
    pub fn is_clear(&self) -> bool {
        let windows = (self.early.len() * WINDOW) as i64;
        self.edge.is_some_and(|edge| edge.period * windows >= CLEAR_AFTER)
    }

    /// How fast the clocks run apart, once known.
    pub fn drift(&self) -> Option<Drift> {
        self.edge.map(|edge| edge.drift)
    }

    /// Of this window's, by the drift that is known so far.
    fn early_one(&self, period: Span) -> Point {
        let through = self.window[0];
        let flat = Edge { from: through.cycle, through, drift: self.drift().unwrap_or(Drift::NONE), period };
        let mut late = [(Span::ZERO, through); WINDOW];
        for (late, &point) in late.iter_mut().zip(&self.window) {
            *late = (point.start - flat.start_of(point.cycle), point);
        }
        late.select_nth_unstable_by_key(WINDOW / EARLY_PARTS, |&(late, _)| late).1.1
    }

    /// From the earlier half to the later one so that nothing lies below: from whichever points they are drawn, the
    /// lowest of either half, seen along the edge, are better ends, until they are the ends.
    fn edge_below_the_middle(&self, period: Span) -> Option<Edge> {
        if self.early.len() < WINDOWS_AT_LEAST {
            return None;
        }
        let first = *self.early.front()?;
        let mut places = [(0, 0); WINDOWS];
        for (place, &point) in places.iter_mut().zip(&self.early) {
            let x = i64::from(cycles(first, point));
            *place = (x, (point.start - first.start - period * x).nanos());
        }
        let places = &places[..self.early.len()];
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
                let drift = Drift::new(Span::from_nanos(dy), dx, period)?;
                return Some(Edge { from: self.early[from].cycle, through: self.early[to], drift, period });
            }
            (from, to) = ends;
        }
        None
    }
}

impl Edge {
    fn start_of(&self, cycle: u32) -> Instant {
        let ahead = cycle.wrapping_sub(self.through.cycle) as i32;
        self.through.start + self.period * i64::from(ahead) + self.drift.over(ahead)
    }
}

/// How many windows are remembered at cycles of this length.
fn kept(period: Span) -> usize {
    let young = OLDEST.nanos() / (period.nanos() * WINDOW as i64).max(1);
    (young as usize).clamp(WINDOWS_KEPT_AT_LEAST, WINDOWS)
}

/// Cycles from one to another, shortest way round 2^32.
fn cycles(from: Point, to: Point) -> i32 {
    to.cycle.wrapping_sub(from.cycle) as i32
}

#[cfg(test)]
mod tests;
