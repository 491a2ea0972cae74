//! How an owner sleeps until something comes, and how it is woken.
//!
//! ```text
//!   a sender ── its bell ──┐                         each bell is an eventfd, hung by the broker
//!   the router ── its bell ┼─► the owner's set: one wait ◄── the broker's connection: over with the station
//!   the broker ── its bell ┘
//! ```
//!
//! By edge: whatever a ringer does to its own bell keeps no other from being heard, and nobody has to silence one. A bell goes
//! with its ringer, and with it a ring that was not heard yet: so the broker rings when a sender has gone. An owner may have
//! its set waited at by as many threads as it likes, and each makes it take longer to ring there: that is kept from nobody.

#![allow(unsafe_code)]

use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};
use nix::sys::time::TimeSpec;
use rtnet::live::clock::monotonic;

const A_BELL: u64 = 0;
const THE_STATION: u64 = 1;
/// What is taken note of at a time; more ends the next wait at once.
const AT_ONCE: usize = 16;

/// What an owner sleeps at.
pub struct Bells(Epoll);

/// What somebody may wake it with.
pub struct Bell(OwnedFd);

/// What has ended a wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woken {
    /// Somebody rang, or it was for nothing.
    Rung,
    /// It is over time.
    TooLate,
    /// The station has hung up.
    StationGone,
}

impl Bells {
    /// Without a bell, and over with the station at the other end of this connection.
    pub fn new(station: &impl AsFd) -> io::Result<Self> {
        let all = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        // Answers do not end a wait. By level: who waits again is told again.
        all.add(station, EpollEvent::new(EpollFlags::EPOLLRDHUP, THE_STATION))?;
        Ok(Self(all))
    }

    /// Those that an owner has brought.
    pub fn of(brought: OwnedFd) -> Self {
        Self(Epoll(brought))
    }

    /// Another bell; an error if what an owner has brought has none.
    pub fn hang(&self) -> io::Result<Bell> {
        let bell = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
        self.0.add(&bell, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, A_BELL))?;
        Ok(Bell(bell.into()))
    }

    /// Waits until somebody rings, or has done since the last wait; at most until then on this host's monotonic clock.
    pub fn wait(&self, until: Option<u64>) -> Woken {
        let mut events = [EpollEvent::empty(); AT_ONCE];
        let found = match until {
            None => self.0.wait(&mut events, EpollTimeout::NONE),
            Some(until) => {
                self.wait_for(Duration::from_nanos(until.saturating_sub(monotonic())), &mut events)
            }
        };
        match found {
            Ok(0) => Woken::TooLate,
            Ok(found) if events[..found].iter().any(|event| event.data() == THE_STATION) => {
                Woken::StationGone
            }
            _ => Woken::Rung,
        }
    }

    fn wait_for(&self, time: Duration, events: &mut [EpollEvent]) -> nix::Result<usize> {
        static HAS_PWAIT2: AtomicBool = AtomicBool::new(true);
        if HAS_PWAIT2.load(Ordering::Relaxed) {
            match self.pwait2(time, events) {
                // Before Linux 5.11, or under a filter.
                Err(Errno::ENOSYS | Errno::EPERM) => HAS_PWAIT2.store(false, Ordering::Relaxed),
                found => return found,
            }
        }
        self.poll_first(time, events)
    }

    fn pwait2(&self, time: Duration, events: &mut [EpollEvent]) -> nix::Result<usize> {
        let (all, first, count) = (self.0.0.as_raw_fd(), events.as_mut_ptr(), events.len());
        let time = TimeSpec::from_duration(time);
        let (time, no_signals) = (core::ptr::from_ref(time.as_ref()), core::ptr::null::<libc::sigset_t>());
        // SAFETY: there is room for as many events as is said, as the kernel writes them, and the time lives; no signals.
        let found =
            unsafe { libc::syscall(libc::SYS_epoll_pwait2, all, first, count, time, no_signals, 0usize) };
        Errno::result(found).map(|found| found as usize)
    }

    /// The same by two calls.
    fn poll_first(&self, time: Duration, events: &mut [EpollEvent]) -> nix::Result<usize> {
        let mut set = [PollFd::new(self.as_fd(), PollFlags::POLLIN)];
        match ppoll(&mut set, Some(TimeSpec::from_duration(time)), None)? {
            0 => Ok(0),
            _ => self.0.wait(events, EpollTimeout::ZERO),
        }
    }
}

impl AsFd for Bells {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.0.as_fd()
    }
}

impl Bell {
    /// One that was given.
    pub fn of(given: OwnedFd) -> Self {
        Self(given)
    }

    /// Wakes the owner, or keeps it from falling asleep.
    #[inline]
    pub fn ring(&self) {
        // One that overflows was rung before: 2^64 times.
        let _ = nix::unistd::write(&self.0, &1u64.to_ne_bytes());
    }
}

impl From<Bell> for OwnedFd {
    fn from(bell: Bell) -> Self {
        bell.0
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods)]
mod tests {
    use std::os::unix::net::UnixStream;
    use std::thread;

    use nix::fcntl::{FcntlArg, OFlag, fcntl};
    use nix::unistd::{read, write};

    use super::*;

    const A_WHILE: u64 = 5_000_000;
    const LONG: u64 = 20_000_000_000;

    /// With the connection to a station.
    fn bells() -> (Bells, [UnixStream; 2]) {
        let (own, station) = UnixStream::pair().unwrap();
        (Bells::new(&own).unwrap(), [own, station])
    }

    #[test]
    fn who_waits_is_woken_by_any_bell_and_no_ring_is_missed() {
        let (all, _station) = bells();
        let hung = [(); 3].map(|()| all.hang().unwrap());
        for bell in &hung {
            thread::scope(|scope| {
                let waits = scope.spawn(|| (all.wait(None), all.wait(Some(monotonic() + A_WHILE))));
                thread::sleep(Duration::from_nanos(A_WHILE));
                bell.ring();
                assert_eq!(waits.join().unwrap(), (Woken::Rung, Woken::TooLate), "once");
            });
            bell.ring();
            assert_eq!(all.wait(Some(monotonic() + LONG)), Woken::Rung, "before the wait");
        }
        hung.iter().for_each(Bell::ring);
        assert_eq!((all.wait(None), all.wait(Some(0))), (Woken::Rung, Woken::TooLate), "one wait is for all");
    }

    #[test]
    fn who_is_not_woken_waits_as_long_as_it_may() {
        let (all, _station) = bells();
        let _bell = all.hang().unwrap();
        for until in [0, monotonic(), monotonic() + A_WHILE] {
            assert_eq!(all.wait(Some(until)), Woken::TooLate);
            assert!(monotonic() >= until);
        }
    }

    #[test]
    fn a_kernel_without_epoll_pwait2_waits_as_well() {
        let (all, _station) = bells();
        let bell = all.hang().unwrap();
        let mut events = [EpollEvent::empty(); 2];
        for wait in [Bells::pwait2, Bells::poll_first] {
            let begun = monotonic();
            assert_eq!(wait(&all, Duration::from_nanos(A_WHILE), &mut events), Ok(0));
            assert!(monotonic() >= begun + A_WHILE);
            bell.ring();
            assert_eq!(wait(&all, Duration::from_nanos(LONG), &mut events), Ok(1));
        }
    }

    /// Whatever one does to its bell.
    #[test]
    fn a_bell_that_is_emptied_filled_or_stopped_up_keeps_no_other_from_being_heard() {
        let (all, _station) = bells();
        let [odd, good] = [(); 2].map(|()| all.hang().unwrap());
        let does: [&dyn Fn(); 4] = [
            &|| assert_eq!(write(&odd.0, &(u64::MAX - 1).to_ne_bytes()), Ok(8)),
            &|| odd.ring(),
            &|| assert_eq!(read(&odd.0, &mut [0; 8]), Ok(8)),
            &|| assert_eq!(fcntl(&odd.0, FcntlArg::F_SETFL(OFlag::empty())), Ok(0)),
        ];
        for does in does {
            does();
            while all.wait(Some(monotonic() + A_WHILE)) == Woken::Rung {}
            good.ring();
            assert_eq!(all.wait(Some(monotonic() + LONG)), Woken::Rung);
        }
        drop(odd);
        assert_eq!(all.wait(Some(monotonic() + A_WHILE)), Woken::TooLate, "it is gone, and silent");
        good.ring();
        assert_eq!(all.wait(None), Woken::Rung);
    }

    #[test]
    fn who_waits_for_ever_hears_that_the_station_is_gone_and_again_when_it_waits_again() {
        let (own, station) = UnixStream::pair().unwrap();
        let all = Bells::new(&own).unwrap();
        let _bell = all.hang().unwrap();
        write(&station, b"an answer").unwrap();
        assert_eq!(all.wait(Some(monotonic() + A_WHILE)), Woken::TooLate, "answers are not for who waits");
        thread::scope(|scope| {
            let waits = scope.spawn(|| all.wait(None));
            thread::sleep(Duration::from_nanos(A_WHILE));
            drop(station);
            assert_eq!(waits.join().unwrap(), Woken::StationGone);
        });
        assert_eq!([None, Some(0)].map(|until| all.wait(until)), [Woken::StationGone; 2]);
    }

    #[test]
    fn bells_hang_in_a_set_and_in_nothing_else() {
        let file: OwnedFd = std::fs::File::open("/dev/null").unwrap().into();
        assert!(Bells::of(file).hang().is_err());
        let (all, _station) = bells();
        let brought = Bells::of(all.as_fd().try_clone_to_owned().unwrap());
        let bell = brought.hang().unwrap();
        drop(brought);
        bell.ring();
        assert_eq!(all.wait(None), Woken::Rung);
    }
}
