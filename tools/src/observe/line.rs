//! Where cycles begin, for an observer that knows no clock but its own.
//!
//! ```text
//!   offset = stamp - max(sched_xmit, xmit_stamp)
//!    │ x         x      x           x          late is possible: a frame was held up on its way;
//!    │    x   x     x       x   x              early is not
//!    │_x___________________x___________x____   the line: the smallest of the last 16, the clocks' drift
//!    └──────────────────────────► sched_xmit   taken out
//! ```
//!
//! - *Slot error*, of a frame that tells when it was scheduled: stamp - (scheduled + offset).
//! - *Place*, of any other: stamp - (the cycle's start + offset).
//!
//! A master that sends late says so in xmit_stamp, and real ones are late by hundreds of microseconds: their slaves
//! take it off, and so does this. One that sends early, so that the frame is on the medium at sched_xmit, has it
//! there. What the quickest of syncs takes from the master to here is in the offset, and so in no error. The
//! drift is the slope from the lowest sync of the oldest sixteen remembered to the lowest of the newest; it
//! is known after 64.

use std::collections::VecDeque;

use rtnet::clock::True;
use rtnet::time::{GlobalTime, Span};

/// Syncs of which the smallest offset counts, and that make a block.
const WINDOW: usize = 16;
/// Blocks remembered for the drift: a second or two at cycles of 1 or 2 ms.
const BLOCKS: usize = 64;
/// Blocks before there is a drift: over fewer, a microsecond more or less makes too steep a slope.
const BLOCKS_AT_LEAST: usize = 4;
/// Syncs this much off the line are of another line: of a new master, or of one whose clock was set.
const STEP: i64 = 100_000;
/// By so much two clocks may drift, in 10^-9: what is left of the drift that is taken out.
const DRIFT_AT_MOST: i64 = 200_000;
/// Cycles that a line is believed without a sync.
const HOLD_CYCLES: i64 = 1_000;

/// The observer's line.
#[derive(Debug, Default)]
pub struct Line {
    /// The offset of the first sync; the others are counted from there, modulo 2^64.
    base: u64,
    last: VecDeque<Point>,
    lowest: VecDeque<Point>,
    /// Syncs in the block at hand, and the lowest of them.
    block: (usize, Option<Point>),
    /// Syncs in a row that came too late for this line.
    late: usize,
    drift: f64,
    current: Option<(u32, GlobalTime)>,
    period: Option<Span>,
    restarts: u64,
}

#[derive(Clone, Copy, Debug)]
struct Point {
    sent: GlobalTime,
    offset: i64,
}

impl Line {
    /// A sync was stamped `at`. It is part of the line from now on.
    pub fn sync(&mut self, at: True, cycle: u32, sched: GlobalTime, xmit: GlobalTime) {
        let sent = if xmit - sched > Span::ZERO { xmit } else { sched };
        if self.is_elsewhere(at, sent) {
            self.forget();
            self.restarts += 1;
        }
        if self.last.is_empty() {
            self.base = at.wrapping_sub(sent.nanos());
        }
        let point = Point { sent, offset: self.offset_of(at, sent) };
        push(&mut self.last, point, WINDOW);
        self.enter_into_block(point);
        if let Some((before, began)) = self.current
            && cycle.wrapping_sub(before) == 1
            && sched - began > Span::ZERO
        {
            self.period = Some(sched - began);
        }
        self.current = Some((cycle, sched));
    }

    /// Nothing that was seen can be compared with what comes.
    pub fn forget(&mut self) {
        *self = Self { restarts: self.restarts, ..Self::default() };
    }

    /// stamp - (scheduled + offset); none before the first sync.
    pub fn error(&self, at: True, scheduled: GlobalTime) -> Option<Span> {
        let lowest =
            self.last.iter().map(|point| point.offset.saturating_add(self.drifted(point, scheduled)));
        let line = lowest.min()?;
        Some(Span::from_nanos(self.offset_of(at, scheduled).saturating_sub(line)))
    }

    /// The cycle of a moment, and how long after its start that is; none without a sync for long.
    pub fn place(&self, at: True) -> Option<(u32, Span)> {
        let ((cycle, began), period) = (self.current?, self.period?);
        let cycles = self.error(at, began)?.nanos().div_euclid(period.nanos());
        if cycles.abs() > HOLD_CYCLES {
            return None;
        }
        let within = self.error(at, began + period * cycles)?;
        Some((cycle.wrapping_add(cycles as u32), within))
    }

    /// Whether the drift is known: until then, errors are off by up to what the clocks drift in 16 cycles.
    pub fn is_settled(&self) -> bool {
        self.lowest.len() >= BLOCKS_AT_LEAST
    }

    /// How much faster the master's clock runs than this host's, in 10^-9; none before it is settled.
    pub fn drift_ppb(&self) -> Option<i64> {
        self.is_settled().then(|| (-self.drift * 1e9).round() as i64)
    }

    /// From one cycle's start to the next.
    pub fn period(&self) -> Option<Span> {
        self.period
    }

    /// How often the line was given up for another.
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Early by a step at once, since nothing is early; late by a step only if nothing else comes any more.
    fn is_elsewhere(&mut self, at: True, sent: GlobalTime) -> bool {
        let (Some(error), Some((_, began))) = (self.error(at, sent), self.current) else { return false };
        let silence = (sent - began).abs().nanos();
        let tolerance =
            STEP.saturating_add((i128::from(silence) * i128::from(DRIFT_AT_MOST) / 1_000_000_000) as i64);
        self.late = if error.nanos() > tolerance { self.late + 1 } else { 0 };
        error.nanos() < -tolerance || self.late >= WINDOW
    }

    fn enter_into_block(&mut self, point: Point) {
        let (count, lowest) = &mut self.block;
        *count += 1;
        if lowest.is_none_or(|lowest| point.offset < lowest.offset) {
            *lowest = Some(point);
        }
        if let (WINDOW, Some(lowest)) = (*count, *lowest) {
            push(&mut self.lowest, lowest, BLOCKS);
            self.block = (0, None);
            self.drift = if self.is_settled() { slope(&self.lowest) } else { 0.0 };
        }
    }

    /// By how much the line rises from a point to a moment.
    fn drifted(&self, point: &Point, until: GlobalTime) -> i64 {
        ((until - point.sent).nanos() as f64 * self.drift).round() as i64
    }

    fn offset_of(&self, at: True, global: GlobalTime) -> i64 {
        at.wrapping_sub(global.nanos()).wrapping_sub(self.base) as i64
    }
}

fn push(points: &mut VecDeque<Point>, point: Point, at_most: usize) {
    if points.len() == at_most {
        points.pop_front();
    }
    points.push_back(point);
}

fn slope(points: &VecDeque<Point>) -> f64 {
    let (Some(first), Some(last)) = (points.front(), points.back()) else { return 0.0 };
    let run = (last.sent - first.sent).nanos();
    let rise = last.offset.saturating_sub(first.offset);
    // Forged times may make any slope; real clocks do not.
    let limit = DRIFT_AT_MOST as f64 / 1e9;
    if run > 0 { (rise as f64 / run as f64).clamp(-limit, limit) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: u64 = 2_000_000;
    /// Global time is far from the observer's.
    const AHEAD: u64 = 1_700_000_000_000_000_000;

    fn sched(cycle: u32) -> GlobalTime {
        GlobalTime::from_nanos(AHEAD + u64::from(cycle) * PERIOD)
    }

    /// When a sync of a master whose clock runs `ppb` faster is on the wire, `late` after its cycle's start.
    fn wire(cycle: u32, ppb: i64, late: i64) -> True {
        let elapsed = i64::from(cycle) * PERIOD as i64;
        (1_000_000_000 + elapsed - elapsed * ppb / 1_000_000_000 + late) as u64
    }

    /// Mostly late by 1 to 7 us, now and then by nothing, as a busy host is.
    fn lateness(cycle: u32) -> i64 {
        if cycle.is_multiple_of(5) { 0 } else { i64::from(cycle * 37 % 7 + 1) * 1_000 }
    }

    fn line(cycles: u32, ppb: i64) -> Line {
        let mut line = Line::default();
        (0..cycles).for_each(|cycle| {
            line.sync(wire(cycle, ppb, lateness(cycle)), cycle, sched(cycle), sched(cycle))
        });
        line
    }

    #[test]
    fn the_quickest_sync_of_the_last_draws_the_line() {
        let line = line(20, 0);
        let scheduled = sched(19) + Span::from_micros(300);
        let error = |late: i64| line.error(wire(19, 0, 300_000 + late), scheduled).unwrap().nanos();
        assert_eq!((error(0), error(1_234), error(-50)), (0, 1_234, -50));
        assert_eq!(line.period(), Some(Span::from_nanos(PERIOD as i64)));
    }

    #[test]
    fn drift_is_taken_out_once_it_is_known() {
        for ppb in [-50_000, 50_000] {
            let young = line(16 * BLOCKS_AT_LEAST as u32 - 1, ppb);
            assert!(!young.is_settled() && young.drift_ppb().is_none());
            let old = line(2_000, ppb);
            assert!((old.drift_ppb().unwrap() - ppb).abs() < 20, "{:?}", old.drift_ppb());
            let error = old.error(wire(2_000, ppb, 700), sched(2_000)).unwrap().nanos();
            assert!((error - 700).abs() < 20, "{error}");
        }
    }

    #[test]
    fn a_late_sync_moves_nothing() {
        let mut line = line(100, 0);
        line.sync(wire(100, 0, 3_000_000), 100, sched(100), sched(100));
        assert_eq!(line.error(wire(100, 0, 0), sched(100)), Some(Span::ZERO));
        assert_eq!(line.restarts(), 0);
    }

    #[test]
    fn what_a_master_says_to_be_late_by_is_no_offset_and_being_early_on_purpose_is_none_either() {
        // All are late, or all early: nothing on the medium shows it, but they say so.
        for (xmit, on_the_wire) in [(300_000, 300_000), (-2_400, 0)] {
            let mut line = Line::default();
            for cycle in 0..20 {
                let sent = sched(cycle) + Span::from_nanos(xmit);
                line.sync(wire(cycle, 0, on_the_wire), cycle, sched(cycle), sent);
            }
            assert_eq!(line.error(wire(19, 0, on_the_wire), sched(19)), Some(Span::from_nanos(on_the_wire)));
        }
    }

    #[test]
    fn a_master_whose_time_is_another_begins_a_new_line() {
        // Its syncs would be early: known at once. They are late: known when no others come.
        for (moved, after) in [(1_000_000_i64, 1), (-1_000_000, WINDOW as u32)] {
            let mut line = line(100, 0);
            for cycle in 100..100 + after {
                assert_eq!(line.restarts(), 0);
                let sched = sched(cycle) + Span::from_nanos(moved);
                line.sync(wire(cycle, 0, 0), cycle, sched, sched);
            }
            assert_eq!(line.restarts(), 1);
            let error = line.error(wire(200, 0, 55), sched(200) + Span::from_nanos(moved));
            assert_eq!(error, Some(Span::from_nanos(55)));
        }
    }

    #[test]
    fn a_moment_has_its_place_in_a_cycle_also_where_syncs_are_missing() {
        let line = line(100, 0);
        let place = |at| line.place(at).map(|(cycle, span)| (cycle, span.nanos()));
        assert_eq!(place(wire(99, 0, 300_000)), Some((99, 300_000)));
        assert_eq!(place(wire(104, 0, 5)), Some((104, 5)));
        assert_eq!(place(wire(99, 0, -5)), Some((98, PERIOD as i64 - 5)));
        assert_eq!(place(wire(99 + 1_002, 0, 0)), None, "for long nobody has said where cycles begin");
        assert_eq!(Line::default().place(7), None);
        assert_eq!(Line::default().error(7, sched(0)), None);
    }

    #[test]
    fn times_that_nobody_means_give_wrong_figures_but_no_panic() {
        let mut line = line(100, 0);
        for (i, wild) in [0, u64::MAX, 1 << 63, AHEAD, 1].into_iter().cycle().take(200).enumerate() {
            let (sched, xmit) = (GlobalTime::from_nanos(wild), GlobalTime::from_nanos(wild.swap_bytes()));
            line.sync(wild.rotate_left(i as u32), i as u32, sched, xmit);
            let _ = (line.error(i as u64, GlobalTime::from_nanos(!wild)), line.place(wild), line.drift_ppb());
        }
    }
}
