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
//! that lies below their middle is the line. It is wrong, and all begins anew, if frames are clearly earlier; and if the
//! early ones come later from window to window by about as much, since then a clock has changed its rate: a host is
//! busy less evenly.

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
/// So many windows are kept. Less than half of them may be of a busy host, two seconds at a cycle of 1 ms.
const WINDOWS: usize = 64;
/// Fewer do not show a line: what becomes quiet looks like drift.
const WINDOWS_AT_LEAST: usize = 8;
/// What is earlier than the line by less is a stamp's noise, and so are a few of a window.
const NOISE: Span = Span::from_micros(10);
const NOISE_AT_MOST: usize = 2;
/// Without a line, what is earlier than expected by less, or by less than this part of a cycle, shows that what was
/// expected had been late.
const UNSURE: Span = Span::from_micros(20);
const UNSURE_PARTS: i64 = 1_000;
/// So many windows, each later than the one before by about as much, are another rate.
const RISING: usize = 8;

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
    /// The first cycle that is remembered.
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

    /// All that is known is of another line.
    pub fn restart(&mut self) {
        self.window.clear();
        self.too_early = 0;
        self.early.clear();
        self.since = None;
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
        if period * WINDOW as i64 > WINDOW_AT_MOST {
            return false;
        }
        if self.is_disproved(expected - start, period) {
            self.restart();
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
        if self.early.len() == WINDOWS {
            self.early.pop_front();
            self.since = self.early.front().map(|point| point.cycle);
        }
        let early = self.early_one(period);
        self.early.push_back(early);
        self.window.clear();
        self.too_early = 0;
        if self.rises() {
            self.early.drain(..self.early.len() - RISING);
            self.since = self.early.front().map(|point| point.cycle);
        }
        self.edge = self.edge_below_the_middle(period);
    }

    /// Whether the last windows have left the line as evenly as clocks do.
    fn rises(&self) -> bool {
        let (Some(edge), Some(begin)) = (self.edge, self.early.len().checked_sub(RISING)) else {
            return false;
        };
        let late = |of: usize| self.early[of].start - edge.start_of(self.early[of].cycle);
        let risen = late(self.early.len() - 1) - late(begin);
        let step_at_most = risen * 2 / (RISING as i64 - 1);
        let mut steps = (begin + 1..self.early.len()).map(|of| late(of) - late(of - 1));
        risen > NOISE && steps.all(|step| step > Span::ZERO && step < step_at_most)
    }

    /// When a cycle starts, and how fast the clocks run apart; `None` until that is known.
    pub fn start_of(&self, cycle: u32) -> Option<(Instant, Drift)> {
        self.edge.map(|edge| (edge.start_of(cycle), edge.drift))
    }

    /// Whether this cycle is remembered, of the line that is followed now.
    pub fn is_unbroken_since(&self, cycle: u32) -> bool {
        self.since.is_some_and(|since| cycle.wrapping_sub(since) as i32 >= 0)
    }

    /// Whether the line is known well enough for a cycle so long ago: not farther from it than it is long.
    pub fn reaches_back_to(&self, cycle: u32) -> bool {
        self.edge.is_some_and(|Edge { from, through, .. }| {
            from.wrapping_sub(cycle) as i32 <= through.cycle.wrapping_sub(from) as i32
        })
    }

    /// How fast the clocks run apart, once known.
    pub fn drift(&self) -> Option<Drift> {
        self.edge.map(|edge| edge.drift)
    }

    /// Of this window's, by the drift that is known so far.
    fn early_one(&mut self, period: Span) -> Point {
        let through = self.window[0];
        let flat = Edge { from: through.cycle, through, drift: self.drift().unwrap_or(Drift::NONE), period };
        let late = |point: &Point| point.start - flat.start_of(point.cycle);
        *self.window.select_nth_unstable_by_key(WINDOW / EARLY_PARTS, late).1
    }

    fn edge_below_the_middle(&self, period: Span) -> Option<Edge> {
        if self.early.len() < WINDOWS_AT_LEAST {
            return None;
        }
        let (&first, &last) = (self.early.front()?, self.early.back()?);
        let place = |point: Point| {
            let x = i64::from(cycles(first, point));
            (x, (point.start - first.start - period * x).nanos())
        };
        let mut hull = [Point::default(); WINDOWS];
        let mut corners = 0;
        for &point in &self.early {
            while corners >= 2 && !is_below([hull[corners - 2], hull[corners - 1], point].map(place)) {
                corners -= 1;
            }
            hull[corners] = point;
            corners += 1;
        }
        let middle = cycles(first, last) / 2;
        let edge = hull[..corners].windows(2).find(|edge| cycles(first, edge[1]) > middle)?;
        let [(x0, y0), (x1, y1)] = [place(edge[0]), place(edge[1])];
        let drift = Drift::new(Span::from_nanos(y1 - y0), x1 - x0, period)?;
        Some(Edge { from: edge[0].cycle, through: edge[1], drift, period })
    }
}

impl Edge {
    fn start_of(&self, cycle: u32) -> Instant {
        let ahead = cycle.wrapping_sub(self.through.cycle) as i32;
        self.through.start + self.period * i64::from(ahead) + self.drift.over(ahead)
    }
}

/// Cycles from one to another, shortest way round 2^32.
fn cycles(from: Point, to: Point) -> i32 {
    to.cycle.wrapping_sub(from.cycle) as i32
}

/// Whether the middle one lies below the line from the first to the last.
fn is_below([(x0, y0), (x1, y1), (x2, y2)]: [(i64, i64); 3]) -> bool {
    i128::from(x2 - x0) * i128::from(y1 - y0) < i128::from(x1 - x0) * i128::from(y2 - y0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Span = Span::from_millis(1);

    /// Feeds Synchronisations of a master that is slower by `ppb`, each held up by `late` of its number.
    fn hear(envelope: &mut Envelope, cycles: core::ops::Range<u32>, ppb: i64, late: impl Fn(u32) -> i64) {
        for cycle in cycles {
            let start = truth(cycle, ppb) + Span::from_nanos(late(cycle));
            let expected = envelope.start_of(cycle).map_or(start, |(expected, _)| expected);
            envelope.note(cycle, start, expected, PERIOD);
        }
    }

    fn truth(cycle: u32, ppb: i64) -> Instant {
        let ideal = Instant::from_nanos(1 << 40) + PERIOD * i64::from(cycle as i32);
        ideal + Span::from_nanos(i64::from(cycle as i32) * ppb / 1_000)
    }

    fn error(envelope: &Envelope, cycle: u32, ppb: i64) -> i64 {
        let (start, _) = envelope.start_of(cycle).expect("known by now");
        (start - truth(cycle, ppb)).nanos()
    }

    #[test]
    fn eight_windows_show_the_drift() {
        for ppb in [-100_000, -50_000, 0, 3_000, 100_000] {
            let mut envelope = Envelope::new();
            hear(&mut envelope, 0..511, ppb, |_| 0);
            assert!(envelope.start_of(511).is_none());
            hear(&mut envelope, 511..512, ppb, |_| 0);
            assert!(error(&envelope, 512, ppb).abs() <= 2, "{ppb}");
            hear(&mut envelope, 512..1_000, ppb, |_| 0);
            assert!(error(&envelope, 1_000, ppb).abs() <= 2, "{ppb}");
            assert!(error(&envelope, 2_000, ppb).abs() <= 3, "{ppb}");
        }
    }

    #[test]
    fn a_host_that_is_busy_for_seconds_moves_nothing() {
        let mut envelope = Envelope::new();
        let late = |cycle: u32| match cycle {
            // Busy: all are late by about as much.
            2_500..4_300 => 5_000 + i64::from(cycle * 7_919 % 4_001),
            // As ever: one in ten in time, for this is no steady host.
            _ if cycle % 10 == 3 => i64::from(cycle % 3) * 20,
            _ => i64::from(cycle * 7_919 % 9_001),
        };
        hear(&mut envelope, 0..1_000, 37_000, late);
        for cycle in 1_000..9_000 {
            hear(&mut envelope, cycle..cycle + 1, 37_000, late);
            let error = error(&envelope, cycle, 37_000);
            assert!((-400..400).contains(&error), "cycle {cycle}: {error}");
        }
    }

    #[test]
    fn what_is_earlier_than_the_line_proves_it_wrong() {
        let mut envelope = Envelope::new();
        hear(&mut envelope, 0..1_000, 0, |_| 0);
        hear(&mut envelope, 1_000..1_001, 0, |_| -9_900);
        assert!(envelope.start_of(1_001).is_some(), "a stamp's noise");
        hear(&mut envelope, 1_001..1_003, 0, |_| -20_000);
        assert!(envelope.start_of(1_003).is_some(), "so are two of a window");
        hear(&mut envelope, 1_003..1_004, 0, |_| -20_000);
        assert!(envelope.start_of(1_004).is_none());
        hear(&mut envelope, 1_004..1_600, 0, |_| -20_000);
        assert_eq!(error(&envelope, 1_600, 0), -20_000);
    }

    #[test]
    fn a_line_that_was_left_is_forgotten_in_time() {
        let mut envelope = Envelope::new();
        hear(&mut envelope, 0..1_000, 0, |_| 0);
        hear(&mut envelope, 1_000..6_000, 0, |_| 8_000);
        assert_eq!(error(&envelope, 6_000, 0), 8_000);
    }

    #[test]
    fn a_delay_that_becomes_known_shifts_all_of_it() {
        let mut envelope = Envelope::new();
        hear(&mut envelope, 0..600, 20_000, |_| 0);
        envelope.shift(Span::from_nanos(-700));
        assert!((error(&envelope, 600, 20_000) + 700).abs() <= 2);
        hear(&mut envelope, 600..1_000, 20_000, |_| -700);
        assert!((error(&envelope, 1_000, 20_000) + 700).abs() <= 2);
    }

    #[test]
    fn lost_ones_and_the_number_that_starts_over_do_not_matter() {
        let mut envelope = Envelope::new();
        for cycle in (u32::MAX - 500..=u32::MAX).chain(0..500).filter(|cycle| cycle % 7 != 0) {
            envelope.note(cycle, truth(cycle, -40_000), truth(cycle, -40_000), PERIOD);
        }
        assert!(error(&envelope, 500, -40_000).abs() <= 2);
    }

    #[test]
    fn cycles_too_long_for_windows_have_no_line() {
        let (mut envelope, period) = (Envelope::new(), Span::from_millis(32));
        let start = |cycle: u32| Instant::from_nanos(0) + period * i64::from(cycle);
        assert!((0..1_000).all(|cycle| !envelope.note(cycle, start(cycle), start(cycle), period)));
        assert_eq!(envelope.start_of(1_000), None);
    }

    #[test]
    fn a_step_before_there_is_a_line_begins_anew() {
        let mut envelope = Envelope::new();
        hear(&mut envelope, 0..300, 0, |_| 0);
        envelope.note(300, truth(300, 0) - Span::from_micros(25), truth(300, 0), PERIOD);
        hear(&mut envelope, 301..811, 0, |_| -25_000);
        assert!(envelope.start_of(811).is_none(), "what was before does not count");
        hear(&mut envelope, 811..812, 0, |_| -25_000);
        assert_eq!(error(&envelope, 812, 0), -25_000);
    }

    #[test]
    fn a_clock_that_changes_its_rate_is_followed() {
        for (before, after) in [(0, 30_000), (0, -30_000), (-60_000, 10_000)] {
            let mut envelope = Envelope::new();
            let jitter = |cycle: u32| i64::from(cycle * 7_919 % 1_001);
            hear(&mut envelope, 0..4_096, before, jitter);
            let kink = (truth(4_096, before) - truth(4_096, after)).nanos();
            for cycle in 4_096..6_000 {
                hear(&mut envelope, cycle..cycle + 1, after, |cycle| kink + jitter(cycle));
                if let Some((start, _)) = envelope.start_of(cycle) {
                    let error = (start - truth(cycle, after)).nanos() - kink;
                    // Until it has been noticed: eight windows, and one that had begun.
                    let at_first = if cycle < 4_700 { (after - before).max(0) * 576 / 1_000 } else { 1_000 };
                    assert!(
                        (-at_first..3_000).contains(&error),
                        "from {before} to {after}, {cycle}: {error}"
                    );
                }
            }
            assert!(envelope.start_of(6_000).is_some());
        }
    }

    #[test]
    fn what_no_clock_does_is_no_line() {
        let mut envelope = Envelope::new();
        hear(&mut envelope, 0..2_000, 300_000, |_| 0);
        assert!(envelope.start_of(2_000).is_none());
    }
}
