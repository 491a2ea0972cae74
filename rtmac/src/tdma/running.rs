//! A clock that has changed its rate, seen in fewer Synchronisations than a window has.
//!
//! ```text
//!  later than
//!  the line ▲               · o      the early one of each group
//!           │            o ·         lies on a straight line up
//!           │       · o
//!           │  · o
//!           │o·
//!           └──────────────────► cycle
//! ```
//!
//! A busy host delivers frames later by this and that; a clock leaves the line evenly. So many groups in a row do not lie as
//! near to a straight line by chance once in a year.

use rtnet::time::Span;

use super::edge::{Edge, Point};

/// In a row.
pub const GROUPS: usize = 12;
/// Synchronisations of a group: few where one says much, more where hosts are busy.
const SIZES: [usize; 4] = [1, 2, 4, 5];
/// So far back it looks at most.
pub const LOOKS_BACK: usize = GROUPS * SIZES[SIZES.len() - 1];
/// Beside the straight line each is by no more than this part of what it has left.
const BESIDE_PARTS: i64 = 16;

/// The early ones of the last groups of points, if they have left the edge evenly, by more than `at_least`.
pub fn running(points: &[Point], edge: &Edge, at_least: Span) -> Option<[Point; GROUPS]> {
    SIZES.into_iter().find_map(|size| {
        let last = points.len().checked_sub(GROUPS * size)?;
        let mut groups = points[last..].chunks(size);
        let early = |group: &[Point]| group.iter().copied().min_by_key(|point| edge.late(point));
        let points = core::array::from_fn(|_| groups.next().and_then(early).unwrap_or_default());
        is_straight(&points, edge, at_least).then_some(points)
    })
}

fn is_straight(points: &[Point; GROUPS], edge: &Edge, at_least: Span) -> bool {
    let late = |point: &Point| edge.late(point).nanos();
    let cycles = |point: &Point| i64::from(point.cycle.wrapping_sub(points[0].cycle));
    let (from, to) = (late(&points[0]), late(&points[GROUPS - 1]));
    let (off, long) = (to - from, cycles(&points[GROUPS - 1]));
    let beside = |point| {
        late(point) - from - (i128::from(off) * i128::from(cycles(point)) / i128::from(long.max(1))) as i64
    };
    off > at_least.nanos() && points.iter().all(|point| beside(point).abs() <= off / BESIDE_PARTS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tdma::line::Drift;
    use rtnet::time::Instant;

    const PERIOD: Span = Span::from_millis(20);

    fn is_running(late: impl Fn(u32) -> i64) -> bool {
        let start = Instant::from_nanos(1 << 40);
        let point =
            |cycle| Point { cycle, start: start + PERIOD * i64::from(cycle) + Span::from_nanos(late(cycle)) };
        let edge = Edge::through(Point { cycle: 0, start }, Drift::NONE, PERIOD);
        let window: Vec<Point> = (0..64).map(point).collect();
        running(&window, &edge, Span::from_micros(10)).is_some()
    }

    #[test]
    fn a_clock_that_runs_off_is_seen_through_jitter_and_a_busy_host_is_not_one() {
        let jitter = |cycle: u32| i64::from(cycle * 7_919 % 1_001);
        assert!(is_running(|cycle| i64::from(cycle) * 2_000), "100 ppm");
        assert!(is_running(|cycle| i64::from(cycle) * 1_000 + jitter(cycle) * 3));
        assert!(!is_running(|cycle| i64::from(cycle) * 100), "what is little is a stamp's noise");
        assert!(!is_running(|cycle| -i64::from(cycle) * 2_000), "what is earlier is seen otherwise");
        assert!(!is_running(|cycle| jitter(cycle) * 100));
        assert!(!is_running(|cycle| if cycle < 32 { 0 } else { 50_000 }), "a step");
        assert!(!is_running(|cycle| if cycle < 58 { 0 } else { i64::from(cycle - 58) * 20_000 }));
    }
}
