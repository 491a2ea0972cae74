//! The time line: which cycle it is, on this station's clock, and the formulas of TDMA's times.

use rtnet::time::{GlobalTime, Instant, Offset, Span};

/// A line is good for so many cycles without a Synchronisation.
pub const LINE_GOOD_FOR: i32 = 1_000;
/// Periods outside this are nobody's.
pub const PERIODS: core::ops::RangeInclusive<Span> = Span::from_micros(1)..=Span::from_millis(100_000);

/// From this station's clock to the master's, by one Synchronisation: what the master's clock showed
/// when it sent, plus the delay to here, less what this clock showed on reception.
pub fn offset(xmit: GlobalTime, delay: Span, rx: Instant) -> Offset {
    Offset::between(rx, xmit + delay)
}

/// A cycle's start on this station's clock.
pub fn cycle_start(sched: GlobalTime, offset: Offset) -> Instant {
    offset.local(sched)
}

/// One calibration round: half of what the round trip took besides the master's own time. Stamps
/// count nanoseconds, the outer two on the slave's clock, the inner two on the master's.
pub fn delay(request_xmit: u64, reception: u64, reply_xmit: u64, reply_rx: u64) -> Span {
    let round_trip = reply_rx.wrapping_sub(request_xmit);
    let at_master = reply_xmit.wrapping_sub(reception);
    let both_ways = round_trip.wrapping_sub(at_master) as i64;
    Span::from_nanos(both_ways.wrapping_add(1) >> 1)
}

/// A cycle and its start, from which all others follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeLine {
    /// The cycle that is known best.
    pub cycle: u32,
    /// Its start on this station's clock.
    pub start: Instant,
    /// Its start on the master's clock, as scheduled.
    pub sched: GlobalTime,
    /// From one start to the next.
    pub period: Span,
    /// From this station's clock to the master's.
    pub offset: Offset,
    /// How fast the two run apart, as far as that is known.
    pub drift: Drift,
}

/// How fast this station's clock gains on the master's: so much in so many cycles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Drift {
    gained: Span,
    cycles: i64,
}

/// Clocks run apart by no more than this part.
pub const DRIFT_PARTS: i64 = 5_000;

impl Drift {
    /// Two clocks that run together, or of which nothing is known.
    pub const NONE: Drift = Drift { gained: Span::ZERO, cycles: 1 };

    /// `gained` in so many cycles of one `period`. `None` if that is more than clocks do.
    pub fn new(gained: Span, cycles: i64, period: Span) -> Option<Self> {
        let at_most = period * cycles / DRIFT_PARTS;
        (cycles > 0 && gained.abs() <= at_most).then_some(Self { gained, cycles })
    }

    /// A part of time, in cycles of one `period`.
    pub fn of_rate(gains: f64, period: Span) -> Self {
        const CYCLES: i64 = 1 << 20;
        let gained = gains * (period * CYCLES).nanos() as f64;
        Self { gained: Span::from_nanos(gained as i64), cycles: CYCLES }
    }

    /// As a part of time, in cycles of one `period`.
    pub fn rate(self, period: Span) -> f64 {
        self.gained.nanos() as f64 / (self.cycles as f64 * period.nanos().max(1) as f64)
    }

    /// Time gained in `cycles` cycles. Every job calls this: it divides 128 bits only if the product does not fit 64.
    pub fn over(self, cycles: i32) -> Span {
        let (gained, cycles, of) = (self.gained.nanos(), i64::from(cycles), self.cycles);
        Span::from_nanos(match gained.checked_mul(cycles) {
            Some(product) => product / of,
            None => (i128::from(gained) * i128::from(cycles) / i128::from(of)) as i64,
        })
    }

    /// In parts per 10^9 of a cycle.
    pub fn parts_per_billion(self, period: Span) -> i64 {
        let lasted = i128::from(self.cycles) * i128::from(period.nanos().max(1));
        (i128::from(self.gained.nanos()) * 1_000_000_000 / lasted) as i64
    }
}

impl TimeLine {
    /// From `from` on cycles are this long.
    pub fn run_at(&mut self, period: Span, from: u32) {
        let (start, sched) = (self.start_of(from), self.sched_of(from));
        let drift = Drift::of_rate(self.drift.rate(self.period), period);
        *self = TimeLine { cycle: from, start, sched, period, offset: self.offset, drift };
    }

    /// The same line, told from another cycle.
    pub fn at(&self, cycle: u32) -> TimeLine {
        TimeLine { cycle, start: self.start_of(cycle), sched: self.sched_of(cycle), ..*self }
    }

    /// Cycles from the one known best to `cycle`, shortest way round 2^32.
    pub fn ahead(&self, cycle: u32) -> i32 {
        cycle.wrapping_sub(self.cycle) as i32
    }
    /// A cycle's start on this station's clock.
    pub fn start_of(&self, cycle: u32) -> Instant {
        let ahead = self.ahead(cycle);
        self.start + self.period * i64::from(ahead) + self.drift.over(ahead)
    }
    /// The cycle of a moment on this station's clock.
    pub fn cycle_at(&self, at: Instant) -> u32 {
        let cycles = |since: Span| since.nanos().div_euclid(self.period.nanos().max(1)) as i32;
        let near = cycles(at - self.start);
        self.cycle.wrapping_add(cycles(at - self.start - self.drift.over(near)) as u32)
    }
    /// A cycle's start on the master's clock.
    pub fn sched_of(&self, cycle: u32) -> GlobalTime {
        self.sched + self.period * i64::from(self.ahead(cycle))
    }
}

/// The first cycle from `from` on with `cycle mod period == phase`. After 2^32 - 1 comes 0.
pub fn next_cycle(from: u32, phase: u32, period: u32) -> u32 {
    let (period, from64) = (u64::from(period.max(1)), u64::from(from));
    let wait = (u64::from(phase) + period - from64 % period) % period;
    u32::try_from(from64 + wait).unwrap_or(phase)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_arithmetic_of_the_example_frames_holds() {
        let global = GlobalTime::from_nanos;
        let rx = Instant::from_nanos(600_101_924_444);
        assert_eq!(
            delay(600_100_323_344, 1_000_100_492_000, 1_000_101_402_000, 600_101_323_344).nanos(),
            45_000
        );
        let offset = offset(global(1_000_102_002_900), Span::from_nanos(45_000), rx);
        assert_eq!(offset.nanos(), 400_000_123_456);
        assert_eq!(cycle_start(global(1_000_102_000_000), offset).nanos(), 600_101_876_544);
    }

    #[test]
    fn the_uncalibrated_offset_of_the_first_example_is_45_us_too_small() {
        let rx = Instant::from_nanos(600_099_924_794);
        let offset = offset(GlobalTime::from_nanos(1_000_100_003_250), Span::ZERO, rx);
        assert_eq!(offset.nanos(), 400_000_078_456);
        assert_eq!(cycle_start(GlobalTime::from_nanos(1_000_100_000_000), offset).nanos(), 600_099_921_544);
    }

    proptest! {
        #[test]
        fn drift_over_any_cycles_is_as_128_bits_divide_it(
            gained in any::<i64>(), shift in 0u32..64, cycles in any::<i32>(), of in 1i64..=i64::MAX,
        ) {
            let gained = gained >> shift;
            let expected = i128::from(gained) * i128::from(cycles) / i128::from(of);
            let over = Drift { gained: Span::from_nanos(gained), cycles: of }.over(cycles);
            prop_assert_eq!(over.nanos(), expected as i64);
        }
    }

    #[test]
    fn delay_rounds_half_up_and_may_be_negative() {
        assert_eq!(delay(0, 0, 0, 3).nanos(), 2);
        assert_eq!(delay(0, 0, 5, 0).nanos(), -2);
        assert_eq!(delay(u64::MAX, 7, 7, 1).nanos(), 1, "modulo 2^64");
    }

    #[test]
    fn cycles_count_on_across_the_wrap() {
        let line = TimeLine {
            cycle: u32::MAX,
            start: Instant::from_nanos(10_000),
            sched: GlobalTime::from_nanos(50_000),
            period: Span::from_nanos(1_000),
            offset: Offset::default(),
            drift: Drift::NONE,
        };
        assert_eq!(line.start_of(1).nanos(), 12_000);
        assert_eq!(line.sched_of(u32::MAX - 1).nanos(), 49_000);
    }

    #[test]
    fn the_next_cycle_of_a_phase_starts_over_after_the_wrap() {
        assert_eq!(next_cycle(7, 0, 1), 7);
        assert_eq!(next_cycle(7, 1, 4), 9);
        assert_eq!(next_cycle(9, 1, 4), 9);
        assert_eq!(next_cycle(u32::MAX, 1, 3), 1, "2^32 - 1 is 0 mod 3");
    }
}
