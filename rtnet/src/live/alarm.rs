//! A timer that a wait for frames has beside its descriptors.
//!
//! A wait with a time-out sets a timer when it begins and takes it back when a frame ends it, and each of both leaves a
//! virtual machine: 16 us of 65 for two hops between cores. One that stands until it rings is set once for many frames.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use nix::sys::time::TimeSpec;
use nix::sys::timerfd::{ClockId, Expiration, TimerFd, TimerFlags, TimerSetTimeFlags};

use crate::clock::True;

/// Becomes readable at a moment of CLOCK_MONOTONIC.
pub struct Alarm {
    timer: TimerFd,
    /// When it rings, or did.
    at: True,
}

impl Alarm {
    /// One that is not set.
    pub fn new() -> io::Result<Self> {
        let flags = TimerFlags::TFD_NONBLOCK | TimerFlags::TFD_CLOEXEC;
        Ok(Self { timer: TimerFd::new(ClockId::CLOCK_MONOTONIC, flags)?, at: 0 })
    }

    /// Has it ring at `until`, or before: what it was set to before and has not come yet is good enough, since whoever wakes
    /// too early looks again. `false`: the kernel does not set it.
    pub fn rings_by(&mut self, until: True, now: True) -> bool {
        if now < self.at && self.at <= until {
            return true;
        }
        // What has passed is set, too, so that it rings at once; nothing is zero but what is to be switched off.
        let at = Expiration::OneShot(TimeSpec::from_duration(Duration::from_nanos(until.max(1))));
        let is_set = self.timer.set(at, TimerSetTimeFlags::TFD_TIMER_ABSTIME).is_ok();
        self.at = if is_set { until } else { 0 };
        is_set
    }
}

impl AsFd for Alarm {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.timer.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::clock::{monotonic, sleep_until};
    use crate::live::packet::wait_any;

    fn rings_within(alarm: &Alarm, nanos: True) -> bool {
        wait_any([alarm.as_fd()].into_iter(), Some(nanos)) != 0
    }

    #[test]
    fn an_alarm_stands_until_it_rings_and_is_set_anew_only_for_what_comes_before() {
        let mut alarm = Alarm::new().unwrap();
        let now = monotonic();
        let (soon, late) = (now + 20_000_000, now + 60_000_000_000);
        for until in [late, soon, late] {
            assert!(alarm.rings_by(until, now));
            assert_eq!(alarm.at, if until == late && alarm.at == late { late } else { soon });
        }
        assert!(rings_within(&alarm, 10_000_000_000) && monotonic() >= soon);
        assert!(rings_within(&alarm, 0), "until it is set anew");
        assert!(alarm.rings_by(late, monotonic()));
        assert!(!rings_within(&alarm, 0));
    }

    #[test]
    fn an_alarm_for_what_has_passed_rings_at_once() {
        let mut alarm = Alarm::new().unwrap();
        let now = monotonic();
        for passed in [0, now - 1, now] {
            sleep_until(now + 1);
            assert!(alarm.rings_by(passed, monotonic()));
            assert!(rings_within(&alarm, 1_000_000_000), "{passed} at {now}");
        }
    }
}
