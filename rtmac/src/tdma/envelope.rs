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
//! sibling is busy, delivers all frames later, behind a bridge of many ports by tens of microseconds: what it did before
//! and after shows the clocks.
//!
//! Calibration shows them, too, since its rounds go both ways: it knows the rate of the clocks to some 10^-6 if it took a
//! second. Where the rate is **known** well, lateness cannot be mistaken for it: the line has the known rate, made surer by an
//! edge that agrees with it, and lies below all, of which what is old counts for less the less sure the rate is. What is
//! clearly earlier shows then that all before was late.
//!
//! Where it is not, the line is wrong, and all begins anew, if frames are clearly earlier; or if they have long been clearly
//! late. And known or not: if the early ones come later and later, or earlier and earlier, by about as much, since then a
//! clock has changed its rate: a host is busy less evenly.

use std::collections::VecDeque;

use rtnet::time::{Instant, Span};

use super::edge::{Edge, Point};
use super::line::{DRIFT_PARTS, Drift};
use super::rate::Rate;
use super::running::{self, GROUPS, LOOKS_BACK};

/// Most Synchronisations of a window.
const WINDOW: usize = 64;
/// Crystals change their rate: a window is no longer, and of cycles above 31 ms it has fewer Synchronisations.
const WINDOW_AT_MOST: Span = Span::from_millis(2_000);
/// The early one of a window has this part of it before it: the very first may be a stamp's error.
const EARLY_PARTS: usize = 8;
/// So many windows are kept: less than half of them may be of a busy host, eight seconds at a cycle of 1 ms.
const WINDOWS: usize = 256;
/// Of longer cycles fewer, down to this many: crystals change their rate...
const WINDOWS_KEPT_AT_LEAST: usize = 64;
/// ... and what is older shows another.
pub const OLDEST: Span = Span::from_micros(16_384_000);
/// Fewer do not show a line: what becomes quiet looks like drift.
const WINDOWS_AT_LEAST: usize = 8;
/// A drift that is surer than this is clear: over two cycles of 5 ms it is off by 20 ns, over a second by 2 us.
const CLEAR: f64 = 2e-6;
/// A rate that is surer than this is known well, if over two windows it is off by no more than noise...
const KNOWN_WELL: f64 = 20e-6;
/// ... and an edge that is surer by this is what is known from then on.
const CLEARLY_SURER: f64 = 0.5;
/// What is earlier than the line by less is a stamp's noise, and so are a few of a window.
const NOISE: Span = Span::from_micros(10);
const NOISE_AT_MOST: usize = 2;
/// Without a line, what is earlier than expected by less, or by less than this part of a cycle, shows that what was
/// expected had been late.
const UNSURE: Span = Span::from_micros(20);
const UNSURE_PARTS: i64 = 1_000;
/// So many windows, each later (or earlier) than the one before by about as much, are another rate. They follow each
/// other, or, for what comes slowly, one of so many does.
const RUNNING: usize = 8;
const STRIDES: [usize; 4] = [1, 2, 4, 8];
/// A busy host delivers later by so many times what a frame needs: measured behind 32 ports.
const SLOWER: i64 = 4;
/// And by no more than this part of a cycle: what is later is a time step.
const SLOWER_PARTS: i64 = 16;
/// What clocks do at most.
const GAINS_AT_MOST: f64 = 1.0 / DRIFT_PARTS as f64;
/// So many windows that are sure of another rate are right, or as many times fewer as they are surer than what is known.
const AGAINST_AT_MOST: f64 = 64.0;
/// So many windows that are all clearly later than the line are not a busy host.
const LEFT: usize = 32;

/// The early Synchronisations, and the line through them. What every turn looks at comes first, together.
#[repr(C)]
pub struct Envelope {
    /// The last ones: those of this window, and of those before as many as it takes to see a clock run off.
    last: Vec<Point>,
    /// How many of them are of windows before this one.
    before: usize,
    /// Of this window, those that are clearly earlier than the line.
    too_early: usize,
    /// Since this cycle the clocks have been the same.
    since: Option<u32>,
    edge: Option<Edge>,
    known: Option<Known>,
    early: VecDeque<Point>,
    /// Where the line lies: half of the early ones are later by so much, or the last is, and the earliest earlier, together.
    scatter: Span,
}

/// What is known of the clocks.
#[derive(Clone, Copy)]
struct Known {
    /// When: a master that starts over may count its cycles anew.
    at: Instant,
    rate: Rate,
    /// So long a Synchronisation is on its way.
    delay: Span,
    /// So much, in edges that are as sure as it is, has been against it since the last that agreed.
    against: f64,
}

impl Envelope {
    pub fn new() -> Self {
        Self {
            last: Vec::with_capacity(LOOKS_BACK + WINDOW),
            before: 0,
            too_early: 0,
            early: VecDeque::with_capacity(WINDOWS),
            since: None,
            edge: None,
            scatter: Span::ZERO,
            known: None,
        }
    }

    /// All that is known is of other clocks.
    pub fn restart(&mut self) {
        self.begin_line();
        self.known = None;
    }

    /// Another line of the same clocks.
    pub fn begin_line(&mut self) {
        self.forget_edge();
        self.since = None;
    }

    /// The line was late, or the way has become quicker: the clocks are the same.
    fn forget_edge(&mut self) {
        self.forget_last();
        self.early.clear();
        self.edge = None;
    }

    fn forget_last(&mut self) {
        self.last.clear();
        (self.before, self.too_early) = (0, 0);
    }

    fn window(&self) -> &[Point] {
        &self.last[self.before..]
    }

    /// A Synchronisation is on its way for longer by so much than was believed: all cycles start that much earlier.
    pub fn lengthen(&mut self, by: Span) {
        let points = self.last.iter_mut().chain(&mut self.early);
        points.for_each(|point| point.start = point.start - by);
        if let Some(edge) = &mut self.edge {
            edge.shift(-by);
        }
        if let Some(known) = &mut self.known {
            known.delay = known.delay + by;
        }
    }

    /// Synchronisations are on their way for a time that is shorter by `by` than before. The clocks are the same.
    pub fn quicken(&mut self, by: Span) {
        self.forget_edge();
        if let Some(known) = &mut self.known {
            known.delay = known.delay - by;
        }
    }

    /// A Synchronisation is on its way for so long by now.
    pub fn know_delay(&mut self, delay: Span) {
        if let Some(known) = &mut self.known {
            known.delay = delay;
        }
    }

    /// What calibration has shown by now: the clocks' rate, and that a Synchronisation is on its way for `delay`.
    pub fn know(&mut self, at: Instant, rate: Rate, delay: Span, period: Span) {
        let known = Known { at, rate, delay, against: 0.0 };
        let windows = (window_of(period) * 2).nanos() as f64;
        let is_known = rate.unsure <= KNOWN_WELL
            && rate.unsure * windows <= NOISE.nanos() as f64
            && rate.gains.abs() <= GAINS_AT_MOST;
        self.known = Some(known).filter(|_| is_known);
        self.draw(period);
    }

    /// The clocks' rate by now, if it is known well.
    fn known_at(&self, now: Instant) -> Option<Rate> {
        let known = self.known.as_ref()?;
        let rate = known.rate.after(now - known.at);
        (rate.unsure <= KNOWN_WELL).then_some(rate)
    }

    /// One more Synchronisation, of a cycle that was `expected` to start by what is followed now. Whether the line is
    /// another since.
    pub fn note(&mut self, cycle: u32, start: Instant, expected: Instant, period: Span) -> bool {
        let mut point = Point { cycle, start };
        let mut ends = false;
        if self.is_disproved(expected - start, period) {
            match self.edge.filter(|_| self.known_at(start).is_some()) {
                // What they all say: the least early of them.
                Some(edge) => {
                    let too_early = self.window().iter().filter(|&before| edge.late(before) < -NOISE);
                    point = too_early.fold(point, |a, &b| if edge.late(&a) < edge.late(&b) { b } else { a });
                    self.forget_last();
                    ends = true;
                }
                None => self.forget_edge(),
            }
        }
        self.since.get_or_insert(cycle);
        self.last.push(point);
        if let Some(early) = self.running() {
            self.run_off(early, period);
            return true;
        }
        // With a rate that is known any point makes a line.
        ends |= self.window().len() >= syncs_of_window(period)
            || self.edge.is_none() && self.known_at(start).is_some();
        if ends {
            self.end_window(period);
        }
        ends
    }

    /// The last ones, if they leave the line as a clock does.
    fn running(&self) -> Option<[Point; GROUPS]> {
        let (edge, last) = (self.edge.as_ref()?, self.last.last()?);
        let by = self.slower().max(NOISE).max(self.unsure_over(1));
        let is_late = edge.late(last) > by;
        is_late.then(|| running::running(&self.last, edge, by)).flatten()
    }

    /// A clock has another rate since these.
    fn run_off(&mut self, early: [Point; GROUPS], period: Span) {
        self.forget_edge();
        self.early.extend(early);
        (self.since, self.known) = (Some(early[0].cycle), None);
        self.draw(period);
    }

    fn is_disproved(&mut self, early: Span, period: Span) -> bool {
        if self.edge.is_none() {
            return early > UNSURE.max(period / UNSURE_PARTS);
        }
        self.too_early += usize::from(early > NOISE);
        self.too_early > NOISE_AT_MOST
    }

    fn end_window(&mut self, period: Span) {
        while self.early.len() >= kept(period) {
            self.early.pop_front();
        }
        let early = self.early_one(period);
        self.early.push_back(early);
        self.last.drain(..self.last.len().saturating_sub(LOOKS_BACK));
        self.before = self.last.len();
        // Of a window that has few it may take the next one to tell.
        if self.edge.is_none_or(|edge| edge.late(&early) >= -NOISE) {
            self.too_early = 0;
        }
        if let Some(stride) = STRIDES.into_iter().find(|&stride| self.runs_off(stride)) {
            self.keep_last(stride * (RUNNING - 1) + 1);
            self.known = None;
        } else if self.known.is_some_and(|known| known.against > AGAINST_AT_MOST) {
            self.known = None;
        } else if self.known_at(early.start).is_none() && self.is_left() {
            self.keep_last(LEFT);
        }
        self.draw(period);
    }

    /// The line: of the rate that is known, or the edge alone.
    fn draw(&mut self, period: Span) {
        let edge = (self.early.len() >= WINDOWS_AT_LEAST)
            .then(|| Edge::below_the_middle::<WINDOWS>(self.early.iter(), period))
            .flatten();
        let last = self.early.back().map(|point| point.start);
        self.edge = match last.and_then(|last| Some((last, self.known_at(last)?))) {
            Some((last, known)) => {
                let rate = self.learn(last, known, edge);
                Edge::of_rate(&self.early, rate, period)
            }
            None => edge,
        };
        self.scatter = self.scattered();
    }

    fn scattered(&self) -> Span {
        let mut late = [Span::ZERO; WINDOWS];
        let count = late.iter_mut().zip(self.late()).map(|(place, late)| *place = late).count();
        let late = &mut late[..count];
        let earliest = late.iter().fold(Span::ZERO, |a, &b| a.min(b));
        // Nothing tells a clock that was set a little ahead from a host that is busy, until that ends.
        let last = late.first().copied().unwrap_or_default();
        let median = (count > 0).then(|| *late.select_nth_unstable(count / 2).1);
        median.unwrap_or_default().max(last).max(Span::ZERO) - earliest
    }

    /// The rate that is known, with what an edge shows of it. One that does not agree is of a busy host, if not all of
    /// them are that come.
    fn learn(&mut self, at: Instant, rate: Rate, edge: Option<Edge>) -> Rate {
        let (Some(shown), Some(known)) = (edge.map(|edge| edge.rate()), &mut self.known) else { return rate };
        if !shown.agrees_with(rate) {
            if shown.unsure <= CLEAR {
                known.against += (rate.unsure / shown.unsure).max(1.0);
            }
            return rate;
        }
        known.against = 0.0;
        if shown.unsure < rate.unsure * CLEARLY_SURER {
            *known = Known { at, rate: shown, ..*known };
        }
        rate.and(shown)
    }

    fn keep_last(&mut self, windows: usize) {
        self.early.drain(..self.early.len() - windows);
        self.since = self.early.front().map(|point| point.cycle);
    }

    /// How much later than the line the windows were, the last first.
    fn late(&self) -> impl Iterator<Item = Span> + Clone {
        self.edge.into_iter().flat_map(move |edge| self.early.iter().rev().map(move |point| edge.late(point)))
    }

    /// Whether the last windows have left the line as evenly as clocks do.
    fn runs_off(&self, stride: usize) -> bool {
        let late = self.late().step_by(stride).take(RUNNING);
        let (Some(last), Some(first)) = (late.clone().next(), late.clone().nth(RUNNING - 1)) else {
            return false;
        };
        let off = last - first;
        let step_at_most = off.abs() * 2 / (RUNNING as i64 - 1);
        let mut steps = late.clone().zip(late.skip(1)).map(|(later, before)| later - before);
        let is_even = |step: Span| step.nanos().signum() == off.nanos().signum() && step.abs() < step_at_most;
        let unsure = self.unsure_over(stride * (RUNNING - 1));
        off.abs() > self.slower().max(NOISE).max(unsure) && steps.all(is_even)
    }

    /// What a rate that is known may be off by over so many windows.
    fn unsure_over(&self, windows: usize) -> Span {
        let known = self.edge.as_ref().filter(|_| self.known.is_some());
        known.map_or(Span::ZERO, |edge| {
            Span::from_nanos((edge.unsure * (window_of(edge.period) * windows as i64).nanos() as f64) as i64)
        })
    }

    /// By how much later than the line frames may come of a busy host.
    pub fn slower(&self) -> Span {
        let known = self.edge.as_ref().zip(self.known.as_ref());
        known.map_or(Span::ZERO, |(edge, known)| (known.delay * SLOWER).min(edge.period / SLOWER_PARTS))
    }

    /// Whether the line is the past's.
    fn is_left(&self) -> bool {
        self.early.len() > LEFT && self.late().take(LEFT).all(|late| late > NOISE)
    }

    /// When a cycle starts, and how fast the clocks run apart; `None` until that is known.
    pub fn start_of(&self, cycle: u32) -> Option<(Instant, Drift)> {
        self.edge.map(|edge| (edge.start_of(cycle), edge.drift))
    }

    /// Whether the clocks have been the same since this cycle, as far as is known.
    pub fn is_unbroken_since(&self, cycle: u32) -> bool {
        self.since.is_some_and(|since| cycle.wrapping_sub(since) as i32 >= 0)
    }

    /// By how much the line may be wrong in a cycle, if that is little. It is late where it is above what has come.
    pub fn unsure_in(&self, cycle: u32) -> Option<Span> {
        let above = -self.late().fold(Span::ZERO, Span::min);
        self.edge.map(|edge| edge.unsure_in(cycle) + above).filter(|&unsure| unsure <= NOISE)
    }

    /// By how much the line may be off in a cycle, near or far. What lately `disagreed` says more where windows are few.
    pub fn off_in(&self, cycle: u32, disagreed: Span) -> Option<Span> {
        let is_young = self.early.len() < WINDOWS_AT_LEAST;
        let place = self.scatter + if is_young { disagreed } else { Span::ZERO };
        self.edge.map(|edge| edge.unsure_in(cycle) + place)
    }

    /// Whether the clocks' rate is known at least as well as this.
    pub fn knows_better(&self, now: Instant, than: Rate) -> bool {
        self.known_at(now).is_some_and(|known| known.unsure <= than.unsure)
    }

    /// Whether the drift of the line is clear.
    pub fn is_clear(&self) -> bool {
        self.edge.is_some_and(|edge| edge.unsure <= CLEAR)
    }

    /// How fast the clocks run apart, once known.
    pub fn drift(&self) -> Option<Drift> {
        self.edge.map(|edge| edge.drift)
    }

    /// The early sync of this window, measured along the line's drift. Before there is a line, the drift comes from the
    /// window itself: fast clocks gain as much in a window as a host delays frames, so without it the first syncs seem early.
    fn early_one(&self, period: Span) -> Point {
        let window = self.window();
        let of_window = || Edge::below_the_middle::<WINDOW>(window.iter(), period).map(|edge| edge.drift);
        let flat = Edge::through(window[0], self.drift().or_else(of_window).unwrap_or(Drift::NONE), period);
        let mut late = [(Span::ZERO, window[0]); WINDOW];
        for (late, &point) in late.iter_mut().zip(window) {
            *late = (flat.late(&point), point);
        }
        let noted = &mut late[..window.len()];
        noted.select_nth_unstable_by_key(window.len() / EARLY_PARTS, |&(late, _)| late).1.1
    }
}

/// How many Synchronisations a window has at cycles of this length: one at the least.
pub fn syncs_of_window(period: Span) -> usize {
    let fit = WINDOW_AT_MOST.nanos() / period.nanos().max(1);
    (fit as usize).clamp(1, WINDOW)
}

/// How long that is.
fn window_of(period: Span) -> Span {
    period * syncs_of_window(period) as i64
}

/// How many windows are remembered at cycles of this length.
fn kept(period: Span) -> usize {
    let young = OLDEST.nanos() / window_of(period).nanos().max(1);
    (young as usize).clamp(WINDOWS_KEPT_AT_LEAST, WINDOWS)
}

#[cfg(test)]
mod tests;
