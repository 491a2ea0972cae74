//! How an owner sleeps until something comes, and how it is woken: by futexes, which are words that each sender writes anyway.
//! So a sender that scribbles wakes for nothing, and nobody misses what another sent.

#![allow(unsafe_code)]

use core::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use core::time::Duration;

use nix::errno::Errno;
use rtnet::live::clock::monotonic;

/// How often who has no `futex_waitv` (before Linux 5.16, or under a filter) looks for himself: as long as a cycle, so that nobody is late by more.
const LOOKS_EVERY: Duration = Duration::from_millis(1);

/// `FUTEX2_SIZE_U32`: shared with other processes.
const SIZE_U32: u32 = 2;

/// As the kernel wants it.
#[repr(C)]
#[derive(Clone, Copy)]
struct Waiter {
    value: u64,
    address: u64,
    flags: u32,
    reserved: u32,
}

/// Words to wait for, and what they were. Room for all is there from the beginning.
pub struct Waits(Vec<Waiter>);

/// Wakes whoever waits for a word, after it was written.
pub fn wake(word: &AtomicU64) {
    // SAFETY: the address is that of a word that lives; the kernel reads nothing of it but where it is.
    unsafe { libc::syscall(libc::SYS_futex, low_half(word), libc::FUTEX_WAKE, i32::MAX) };
}

impl Waits {
    /// Room for so many.
    pub fn with_room(most: usize) -> Self {
        Self(Vec::with_capacity(most))
    }

    /// Waits until one of these words is not what it was, at most so long; or for nothing, sometimes. In `true` it is over time.
    pub fn wait<'a>(
        &mut self,
        words: impl Iterator<Item = (&'a AtomicU64, u64)>,
        until: Option<u64>,
    ) -> bool {
        self.0.clear();
        // As far as there is room: it is for all.
        for (word, was) in words.take(self.0.capacity()) {
            let address = low_half(word) as u64;
            self.0.push(Waiter { value: u64::from(was as u32), address, flags: SIZE_U32, reserved: 0 });
        }
        static HAS_WAITV: AtomicBool = AtomicBool::new(true);
        if HAS_WAITV.load(Ordering::Relaxed) {
            match self.waitv(until) {
                Ok(_) | Err(Errno::EAGAIN | Errno::EINTR) => return false,
                Err(Errno::ETIMEDOUT) => return true,
                // The kernel has it not, or does not let us.
                Err(_) => HAS_WAITV.store(false, Ordering::Relaxed),
            }
        }
        let soon = monotonic() + LOOKS_EVERY.as_nanos() as u64;
        rtnet::live::clock::sleep_until(until.map_or(soon, |until| until.min(soon)));
        until.is_some_and(|until| monotonic() >= until)
    }

    fn waitv(&self, until: Option<u64>) -> Result<i64, Errno> {
        let time = until.map(|until| libc::timespec {
            tv_sec: (until / 1_000_000_000).min(i64::MAX as u64) as i64,
            tv_nsec: (until % 1_000_000_000) as i64,
        });
        let time = time.as_ref().map_or(core::ptr::null(), core::ptr::from_ref);
        let (waiters, count) = (self.0.as_ptr(), self.0.len());
        // SAFETY: the waiters are as many as is said, of the kernel's layout, and name words that live; so does the time.
        let told =
            unsafe { libc::syscall(libc::SYS_futex_waitv, waiters, count, 0, time, libc::CLOCK_MONOTONIC) };
        Errno::result(told)
    }
}

/// A futex has 32 bits: the lower ones, which move with each change.
fn low_half(word: &AtomicU64) -> *const u32 {
    let halves = core::ptr::from_ref(word).cast::<u32>();
    halves.wrapping_add(usize::from(cfg!(target_endian = "big")))
}

#[cfg(test)]
#[allow(clippy::disallowed_methods)]
mod tests {
    use super::*;
    use std::thread;

    #[test]
    fn who_waits_for_several_words_is_woken_by_any_of_them() {
        let words = [const { AtomicU64::new(7) }; 3];
        for which in 0..words.len() {
            let was = words.each_ref().map(|word| word.load(Ordering::Relaxed));
            thread::scope(|scope| {
                let waits = scope.spawn(|| {
                    let mut waits = Waits::with_room(3);
                    while words.iter().zip(was).all(|(word, was)| word.load(Ordering::Acquire) == was) {
                        assert!(!waits.wait(words.iter().zip(was), None));
                    }
                });
                thread::sleep(Duration::from_millis(5));
                words[which].fetch_add(1, Ordering::Release);
                wake(&words[which]);
                waits.join().unwrap();
            });
        }
    }

    #[test]
    fn who_waits_too_long_is_told_so_and_what_has_moved_is_not_waited_for() {
        let word = AtomicU64::new(7);
        let mut waits = Waits::with_room(1);
        let until = monotonic() + 2_000_000;
        while !waits.wait([(&word, 7)].into_iter(), Some(until)) {}
        assert!(monotonic() >= until);
        assert!(!waits.wait([(&word, 6)].into_iter(), None));
    }
}
