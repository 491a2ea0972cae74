//! What a program waits for.
//!
//! ```text
//! the station's waker ─► by its edge ─┐
//! this program itself ─► again ───────┼─► gate, an epoll that both have
//! the station's end   ─► line ────────┘
//! ```
//!
//! Whoever waits has said first that he sleeps, and looked once more. The gate is readable until somebody takes note of what
//! was told, and who does either says that he sleeps, or leaves nobody waiting who does not know. One thread that waits alone
//! takes note by waiting, in one system call; several only look whether the gate is readable, so that all are told.

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};
use nix::sys::eventfd::{EfdFlags, EventFd};
use socket2::Socket;

use crate::live::clock::Deadline;

/// Which event it is that something may have come, as the station calls it...
const COME: u64 = 0;
/// ... that the station has hung up...
const HUNG_UP: u64 = 1;
/// ... and that this program has woken itself.
const AGAIN: u64 = 2;

/// Readable when something may have come, or the station is gone.
pub struct Ready {
    gate: Epoll,
    again: EventFd,
    /// The control socket.
    line: Socket,
    /// Threads that wait, or are about to.
    waiting: AtomicU32,
    /// Others may wait by means of their own.
    is_shared: AtomicBool,
    /// Note was taken of all that was told, and nobody has said that he sleeps since.
    is_quiet: AtomicBool,
}

/// Somebody who is about to wait: he is counted before he says that he sleeps.
pub struct Waiter<'a>(&'a Ready);

/// That the station has hung up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HungUp(pub bool);

impl Ready {
    /// By the gate that came with a socket, and the control socket that it came by.
    pub fn new(gate: OwnedFd, line: Socket) -> io::Result<Self> {
        let gate = Epoll(gate);
        let again = EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC)?;
        gate.add(&again, EpollEvent::new(EpollFlags::EPOLLIN, AGAIN))?;
        gate.add(&line, EpollEvent::new(EpollFlags::EPOLLRDHUP, HUNG_UP))?;
        let (waiting, [is_shared, is_quiet]) = (AtomicU32::new(0), [(); 2].map(|()| AtomicBool::new(false)));
        Ok(Self { gate, again, line, waiting, is_shared, is_quiet })
    }

    /// From now on others may wait until the gate is readable: nobody takes note for them.
    pub fn share(&self) {
        self.is_shared.store(true, Ordering::SeqCst);
        if self.is_quiet.swap(false, Ordering::SeqCst) {
            // Who has taken note for himself has not said since then that he sleeps.
            self.ring_again();
        }
    }

    /// Somebody who finds nothing is about to say that he sleeps, and to wait.
    pub fn waiter(&self) -> Waiter<'_> {
        self.waiting.fetch_add(1, Ordering::SeqCst);
        Waiter(self)
    }

    /// Whoever waits looks again.
    pub fn ring_again(&self) {
        let _ = self.again.write(1);
    }

    /// Ends the connection: the station hears of it, and so does who waits here.
    pub fn hang_up(&self) {
        let _ = self.line.shutdown(std::net::Shutdown::Both);
        self.ring_again();
    }

    /// Whether the station has hung up by now.
    pub fn has_hung_up(&self) -> io::Result<bool> {
        is_ready(self.line.as_fd(), PollFlags::POLLHUP, PollTimeout::ZERO)
    }

    /// Takes note of all that was told, as soon as there is anything, no later than that: whether that was something, and that
    /// the station has hung up.
    fn take_note(&self, no_later: PollTimeout) -> io::Result<(bool, HungUp)> {
        let mut events = [EpollEvent::empty(); 3];
        let found = match self.gate.wait(&mut events, no_later) {
            // A signal is nothing to be told: whoever asks looks again.
            Err(Errno::EINTR) => 0,
            found => found?,
        };
        let is = |what| events[..found].iter().any(|event| event.data() == what);
        if is(AGAIN) {
            let _ = self.again.read();
        }
        if is(COME) {
            self.is_quiet.store(true, Ordering::SeqCst);
        }
        Ok((found > 0, HungUp(is(HUNG_UP))))
    }

    fn has_others(&self) -> bool {
        self.is_shared.load(Ordering::SeqCst) || self.waiting.load(Ordering::SeqCst) > 1
    }
}

impl Waiter<'_> {
    /// Who says that he sleeps is not to be told again of what he was told of before.
    pub fn silence(&self) -> io::Result<HungUp> {
        let Waiter(ready) = self;
        if ready.is_quiet.swap(false, Ordering::SeqCst) {
            return Ok(HungUp(false));
        }
        let (_, hung_up) = ready.take_note(PollTimeout::ZERO)?;
        ready.is_quiet.store(false, Ordering::SeqCst);
        Ok(hung_up)
    }

    /// Until there may be something to be told; an error once that has taken too long.
    pub fn wait(&self, deadline: Deadline) -> io::Result<HungUp> {
        // Rounded up: who wakes too early looks again.
        let left = deadline.left();
        let no_later = match left {
            Some(left) if left.is_zero() => PollTimeout::ZERO,
            Some(left) => PollTimeout::try_from(left + Duration::from_millis(1)).unwrap_or(PollTimeout::MAX),
            None => PollTimeout::NONE,
        };
        let Waiter(ready) = self;
        let (is_told, hung_up) = if ready.has_others() {
            (is_ready(ready.as_fd(), PollFlags::POLLIN, no_later)?, HungUp(false))
        } else {
            let told = ready.take_note(no_later)?;
            if told.0 && ready.has_others() {
                // Who has come meanwhile waits for what was taken note of.
                ready.is_quiet.store(false, Ordering::SeqCst);
                ready.ring_again();
            }
            told
        };
        if !is_told && left.is_some_and(|left| left.is_zero()) {
            return Err(Errno::ETIMEDOUT.into());
        }
        Ok(hung_up)
    }
}

impl Drop for Waiter<'_> {
    fn drop(&mut self) {
        self.0.waiting.fetch_sub(1, Ordering::SeqCst);
    }
}

impl AsFd for Ready {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.gate.0.as_fd()
    }
}

fn is_ready(fd: BorrowedFd<'_>, what: PollFlags, no_later: PollTimeout) -> io::Result<bool> {
    match poll(&mut [PollFd::new(fd, what)], no_later) {
        Err(Errno::EINTR) => Ok(false),
        found => Ok(found? > 0),
    }
}

#[cfg(test)]
mod tests {
    use nix::sys::epoll::EpollCreateFlags;
    use socket2::{Domain, Type};

    use super::*;

    /// With the waker, and the station's end of the control socket.
    fn ready() -> (Ready, EventFd, Socket) {
        let (gate, waker) = (Epoll::new(EpollCreateFlags::empty()).unwrap(), EventFd::new().unwrap());
        gate.add(&waker, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, COME)).unwrap();
        let (station, line) = Socket::pair(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        (Ready::new(gate.0, line).unwrap(), waker, station)
    }

    fn is_readable(ready: &Ready) -> bool {
        is_ready(ready.as_fd(), PollFlags::POLLIN, PollTimeout::ZERO).unwrap()
    }

    fn at_once() -> Deadline {
        Deadline::after(Some(Duration::ZERO))
    }

    #[test]
    fn what_was_told_is_told_until_somebody_takes_note_of_it() {
        let (ready, waker, _station) = ready();
        let waiter = ready.waiter();
        waker.write(1).unwrap();
        assert!(is_readable(&ready) && is_readable(&ready));
        waiter.silence().unwrap();
        assert!(!is_readable(&ready));
        ready.ring_again();
        assert!(is_readable(&ready));
        waiter.silence().unwrap();
        assert!(!is_readable(&ready) && waiter.wait(at_once()).is_err());
    }

    #[test]
    fn who_waits_alone_takes_note_by_waiting_and_one_of_several_for_nobody() {
        let (ready, waker, _station) = ready();
        let waiter = ready.waiter();
        waker.write(1).unwrap();
        waiter.wait(at_once()).unwrap();
        assert!(!is_readable(&ready));
        let other = ready.waiter();
        waker.write(1).unwrap();
        waiter.wait(at_once()).unwrap();
        assert!(is_readable(&ready));
        other.wait(at_once()).unwrap();
        drop(other);
        waiter.wait(at_once()).unwrap();
        assert!(!is_readable(&ready));
        ready.share();
        assert!(is_readable(&ready), "others wait by means of their own, and more may have come with it");
        waiter.wait(at_once()).unwrap();
        assert!(is_readable(&ready));
    }

    #[test]
    fn who_comes_while_another_waits_alone_is_told_of_what_that_has_taken_note_of() {
        let (ready, waker, _station) = ready();
        // Sooner or later in each of its steps.
        for _ in 0..1_000 {
            std::thread::scope(|scope| {
                let waits = scope.spawn(|| ready.waiter().wait(Deadline::after(None)).unwrap());
                let other = ready.waiter();
                waker.write(1).unwrap();
                waits.join().unwrap();
                other.wait(at_once()).unwrap();
                other.silence().unwrap();
            });
        }
    }

    #[test]
    fn a_station_that_hangs_up_is_told_of_also_where_nobody_waits() {
        let (ready, _waker, station) = ready();
        assert!(!ready.has_hung_up().unwrap());
        drop(station);
        assert!(ready.has_hung_up().unwrap());
        let waiter = ready.waiter();
        assert_eq!(waiter.wait(at_once()).ok(), Some(HungUp(true)));
        let other = ready.waiter();
        assert_eq!(other.wait(at_once()).ok(), Some(HungUp(false)), "that is for who takes note");
        assert_eq!(other.silence().ok(), Some(HungUp(true)));
    }
}
