//! The kernel's clocks.
//!
//! Timers run on CLOCK_MONOTONIC, which is this module's *true* time; the kernel stamps received frames
//! with CLOCK_REALTIME. The difference of the two is sampled anew at each wake-up, so that a step of the
//! wall clock moves nothing.

use std::time::Duration;

use crate::clock::True;

/// A change of the difference above this is a step of the wall clock (NTP, a resumed virtual machine).
const STEP: u64 = 1_000;
/// A sample whose two outer readings are further apart was interrupted and is taken again.
const INTERRUPTED: u64 = 1_000;
/// After so many interrupted samples the least interrupted is taken.
const TRIES: u32 = 4;

/// CLOCK_MONOTONIC, nanoseconds.
#[inline]
pub fn monotonic() -> True {
    read(libc::CLOCK_MONOTONIC)
}

/// CLOCK_REALTIME, nanoseconds since 1970.
#[inline]
pub fn realtime() -> u64 {
    read(libc::CLOCK_REALTIME)
}

/// Until when something is waited for, if not for ever.
#[derive(Clone, Copy, Debug)]
pub struct Deadline(Option<True>);

impl Deadline {
    /// So long from now on; `None`: never.
    pub fn after(timeout: Option<Duration>) -> Self {
        Self(timeout.map(|timeout| later(monotonic(), timeout)))
    }

    /// How long is left, if it is not for ever.
    pub fn left(self) -> Option<Duration> {
        self.0.map(|deadline| Duration::from_nanos(deadline.saturating_sub(monotonic())))
    }
}

/// So much later, or the last moment that there is.
pub fn later(at: True, by: Duration) -> True {
    at.saturating_add(True::try_from(by.as_nanos()).unwrap_or(True::MAX))
}

/// Processor time that the calling thread has used, nanoseconds.
pub fn thread_cpu_time() -> u64 {
    read(libc::CLOCK_THREAD_CPUTIME_ID)
}

/// Sleeps until a moment of CLOCK_MONOTONIC; returns at once when it has passed.
#[inline]
pub fn sleep_until(at: True) {
    let until = timespec(at);
    // SAFETY: `until` is a valid timespec that outlives the call; no remainder is asked for.
    // A signal ends the sleep early, which the caller's loop makes up for.
    unsafe {
        libc::clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &until, core::ptr::null_mut())
    };
}

/// Spins until a moment of CLOCK_MONOTONIC, and returns the first reading that is not before it.
#[inline]
pub fn spin_until(at: True) -> True {
    loop {
        let now = monotonic();
        if now >= at {
            return now;
        }
        core::hint::spin_loop();
    }
}

/// What REALTIME is ahead of MONOTONIC, and how often that stepped.
#[derive(Clone, Copy, Debug, Default)]
pub struct WallClock {
    /// By the best sample since the last step, which may be wrong by half its width: the two clocks run alike.
    ahead: u64,
    width: u64,
    sampled: bool,
    steps: u64,
}

impl WallClock {
    /// Samples the difference; `false` when it has stepped since the last sample, so that stamps taken
    /// in between mean nothing.
    pub fn sample(&mut self) -> bool {
        let (mut ahead, mut width) = (0, u64::MAX);
        for _ in 0..TRIES {
            let before = monotonic();
            let wall = realtime();
            let after = monotonic();
            if after - before < width {
                width = after - before;
                ahead = wall.wrapping_sub(before + width / 2);
            }
            if width < INTERRUPTED {
                break;
            }
        }
        self.take(ahead, width)
    }

    /// Takes in a sample. An interrupted one, be it this or the last, is no step.
    fn take(&mut self, ahead: u64, width: u64) -> bool {
        let moved = (ahead.wrapping_sub(self.ahead) as i64).unsigned_abs();
        let doubt = self.width / 2 + width / 2;
        let stepped = self.sampled && moved > STEP + doubt;
        // One that was interrupted says nothing that is not known better, as long as it says the same.
        if !self.sampled || moved > doubt || width <= self.width {
            *self = Self { ahead, width, sampled: true, steps: self.steps + u64::from(stepped) };
        }
        !stepped
    }

    /// The true moment of a kernel stamp, by what is known best.
    #[inline]
    pub fn truth(&self, stamp: u64) -> True {
        stamp.wrapping_sub(self.ahead)
    }

    /// Steps of the wall clock seen so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    #[cfg(test)]
    fn step(&mut self, by: u64) {
        self.ahead = self.ahead.wrapping_add(by);
    }
}

/// So many nanoseconds, as the kernel takes them.
#[inline]
pub(super) fn timespec(nanos: u64) -> libc::timespec {
    libc::timespec {
        tv_sec: (nanos / 1_000_000_000) as libc::time_t,
        tv_nsec: (nanos % 1_000_000_000) as libc::c_long,
    }
}

#[inline]
fn read(clock: libc::clockid_t) -> u64 {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `now` is a valid timespec for the kernel to fill; these clocks exist on every Linux.
    unsafe { libc::clock_gettime(clock, &mut now) };
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stamp is of the time between two looks at the clock of timers, however long a busy host makes that, give or take the
    /// width of the sample.
    fn assert_converts(wall: &WallClock) {
        let (before, stamp, after) = (monotonic(), realtime(), monotonic());
        let known = before - wall.width..=after + wall.width;
        assert!(known.contains(&wall.truth(stamp)), "{} is not in {known:?}", wall.truth(stamp));
    }

    #[test]
    fn a_kernel_stamp_is_converted_to_the_clock_of_timers() {
        let mut wall = WallClock::default();
        assert!(wall.sample());
        assert_converts(&wall);
    }

    #[test]
    fn a_step_of_the_wall_clock_is_counted_and_moves_nothing_afterwards() {
        let mut wall = WallClock::default();
        wall.sample();
        // As if the wall clock had stood an hour elsewhere at the last sample.
        wall.step(3_600_000_000_000);
        assert!(!wall.sample(), "what was stamped in between is not to be used");
        assert_eq!(wall.steps(), 1);
        assert_converts(&wall);
    }

    #[test]
    fn a_sample_that_was_interrupted_makes_no_step_of_itself_or_of_the_next() {
        let (narrow, wide) = (100, 40_000);
        let mut wall = WallClock::default();
        for (ahead, width) in [(500_000, narrow), (519_000, wide), (500_000, narrow), (500_900, narrow)] {
            assert!(wall.take(ahead, width), "{ahead} by a sample of {width} ns");
        }
        assert!(!wall.take(502_100, narrow), "more than two narrow samples can be wrong by");
        assert!(wall.take(521_000, wide));
        assert!(!wall.take(500_000 - STEP, narrow), "nor can wide ones hide what is beyond their width");
        assert_eq!(wall.steps(), 2);
    }

    #[test]
    fn sleeping_and_spinning_end_at_their_moment() {
        let start = monotonic();
        sleep_until(start + 2_000_000);
        assert!(monotonic() >= start + 2_000_000);
        assert!(spin_until(start + 2_100_000) >= start + 2_100_000);
        let past = monotonic();
        assert!(spin_until(0) >= past);
    }
}
