//! Times of different clocks are different types; all count nanoseconds.
//!
//! ```text
//! Instant     this station's own clock, monotonic     Instant - Instant       = Span
//! GlobalTime  the master's clock, since 1970          GlobalTime - GlobalTime = Span
//! Offset      GlobalTime - Instant of one moment      Instant + Offset        = GlobalTime
//! ```
//!
//! Arithmetic is modulo 2^64, as on the wire: a hostile stamp gives a wrong time, never a panic.

use core::fmt;
use core::ops::{Add, AddAssign, Mul, Neg, Sub};

/// A moment on this station's own clock, in nanoseconds since that clock's epoch.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Instant(u64);

/// A moment on the master's clock, in nanoseconds since 1970, as frames carry it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct GlobalTime(u64);

/// A signed difference of two times of one clock, in nanoseconds.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Span(i64);

/// What to add to an [`Instant`] to get the [`GlobalTime`] of the same moment.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Offset(u64);

impl Instant {
    /// The moment `nanos` after the clock's epoch.
    #[inline]
    pub const fn from_nanos(nanos: u64) -> Self {
        Self(nanos)
    }
    /// Nanoseconds since the clock's epoch.
    #[inline]
    pub const fn nanos(self) -> u64 {
        self.0
    }
}

impl GlobalTime {
    /// The moment `nanos` after 1970.
    #[inline]
    pub const fn from_nanos(nanos: u64) -> Self {
        Self(nanos)
    }
    /// Nanoseconds since 1970, as on the wire.
    #[inline]
    pub const fn nanos(self) -> u64 {
        self.0
    }
}

impl Span {
    /// No time at all.
    pub const ZERO: Span = Span(0);

    /// `nanos` nanoseconds; negative is earlier.
    #[inline]
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }
    /// `micros` microseconds.
    #[inline]
    pub const fn from_micros(micros: i64) -> Self {
        Self(micros * 1_000)
    }
    /// `millis` milliseconds.
    #[inline]
    pub const fn from_millis(millis: i64) -> Self {
        Self(millis * 1_000_000)
    }
    /// The difference in nanoseconds.
    #[inline]
    pub const fn nanos(self) -> i64 {
        self.0
    }
    /// The distance, without its direction.
    #[inline]
    pub const fn abs(self) -> Span {
        Span(self.0.saturating_abs())
    }
}

impl Offset {
    /// The offset that makes `local` the same moment as `global`.
    #[inline]
    pub const fn between(local: Instant, global: GlobalTime) -> Self {
        Self(global.0.wrapping_sub(local.0))
    }
    /// Modulo 2^64, as a transmit stamp's addend.
    #[inline]
    pub const fn nanos(self) -> u64 {
        self.0
    }
    /// The local moment at which the master's clock shows `global`.
    #[inline]
    pub const fn local(self, global: GlobalTime) -> Instant {
        Instant(global.0.wrapping_sub(self.0))
    }
    /// What the master's clock shows at `local`.
    #[inline]
    pub const fn global(self, local: Instant) -> GlobalTime {
        GlobalTime(local.0.wrapping_add(self.0))
    }
}

macro_rules! moment {
    ($time:ident) => {
        impl Add<Span> for $time {
            type Output = $time;
            #[inline]
            fn add(self, span: Span) -> $time {
                $time(self.0.wrapping_add_signed(span.0))
            }
        }
        impl Sub<Span> for $time {
            type Output = $time;
            #[inline]
            fn sub(self, span: Span) -> $time {
                $time(self.0.wrapping_sub(span.0 as u64))
            }
        }
        impl Sub for $time {
            type Output = Span;
            #[inline]
            fn sub(self, earlier: $time) -> Span {
                Span(self.0.wrapping_sub(earlier.0) as i64)
            }
        }
        impl AddAssign<Span> for $time {
            #[inline]
            fn add_assign(&mut self, span: Span) {
                *self = *self + span;
            }
        }
        impl fmt::Debug for $time {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{}({}ns)", stringify!($time), self.0)
            }
        }
    };
}
moment!(Instant);
moment!(GlobalTime);

impl Add for Span {
    type Output = Span;
    #[inline]
    fn add(self, other: Span) -> Span {
        Span(self.0.wrapping_add(other.0))
    }
}
impl Sub for Span {
    type Output = Span;
    #[inline]
    fn sub(self, other: Span) -> Span {
        Span(self.0.wrapping_sub(other.0))
    }
}
impl Neg for Span {
    type Output = Span;
    #[inline]
    fn neg(self) -> Span {
        Span(self.0.wrapping_neg())
    }
}
impl Mul<i64> for Span {
    type Output = Span;
    #[inline]
    fn mul(self, times: i64) -> Span {
        Span(self.0.wrapping_mul(times))
    }
}
impl core::ops::Div<i64> for Span {
    type Output = Span;
    #[inline]
    fn div(self, parts: i64) -> Span {
        Span(self.0 / parts)
    }
}
impl fmt::Debug for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}ns", self.0)
    }
}
impl fmt::Display for Span {
    /// The largest unit that keeps it readable: `250us`, `-1.5ms`, `10s`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanos = self.0 as f64;
        match self.0.unsigned_abs() {
            n if n >= 1_000_000_000 => write!(f, "{}s", nanos / 1e9),
            n if n >= 1_000_000 => write!(f, "{}ms", nanos / 1e6),
            n if n >= 1_000 => write!(f, "{}us", nanos / 1e3),
            _ => write!(f, "{}ns", self.0),
        }
    }
}
impl fmt::Debug for Offset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Offset({}ns)", self.0 as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_signed_and_modulo_2_64() {
        let late = Instant::from_nanos(5);
        let early = Instant::from_nanos(u64::MAX - 4);
        assert_eq!(late - early, Span::from_nanos(10));
        assert_eq!(early - late, Span::from_nanos(-10));
        assert_eq!(early + Span::from_nanos(10), late);
        assert_eq!(late - Span::from_nanos(10), early);
    }

    #[test]
    fn an_offset_takes_local_to_global_and_back() {
        let local = Instant::from_nanos(600_099_924_794);
        let global = GlobalTime::from_nanos(1_000_100_003_250);
        let offset = Offset::between(local, global);
        assert_eq!(offset.global(local), global);
        assert_eq!(offset.local(global), local);
    }

    #[test]
    fn spans_print_in_the_largest_unit() {
        assert_eq!(Span::from_micros(250).to_string(), "250us");
        assert_eq!(Span::from_nanos(-1_500_000).to_string(), "-1.5ms");
        assert_eq!(Span::from_millis(10_000).to_string(), "10s");
        assert_eq!(Span::from_nanos(999).to_string(), "999ns");
    }
}
