//! What a program waits for.
//!
//! ```text
//! the station's waker ─► gate, an epoll that both have ─┐
//! this program itself ─► again ─────────────────────────┼─► ready
//! the station's end   ─► the control socket ────────────┘
//! ```

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::PollTimeout;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use nix::sys::eventfd::{EfdFlags, EventFd};

use crate::live::clock::Deadline;

/// Which event it is that something may have come...
const COME: u64 = 0;
/// ... that the station has hung up...
const HUNG_UP: u64 = 1;
/// ... and that this program has woken itself.
const AGAIN: u64 = 2;

/// Readable when something has come, or the station is gone.
pub struct Ready {
    ready: Epoll,
    gate: Epoll,
    again: EventFd,
}

/// What was told of, besides that something may have come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Told {
    /// The station has hung up.
    pub hung_up: bool,
    /// This program has woken itself.
    pub again: bool,
}

impl Ready {
    /// By the gate that came with a socket, and the control socket that it came by.
    pub fn new(gate: OwnedFd, control: impl AsFd) -> io::Result<Self> {
        let again = EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC)?;
        let ready = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        ready.add(&gate, EpollEvent::new(EpollFlags::EPOLLIN, COME))?;
        ready.add(&again, EpollEvent::new(EpollFlags::EPOLLIN, AGAIN))?;
        ready.add(control, EpollEvent::new(EpollFlags::EPOLLRDHUP, HUNG_UP))?;
        Ok(Self { ready, gate: Epoll(gate), again })
    }

    /// Who looks for himself from now on needs not be told again of what he was told of. That this program has woken itself
    /// is read away only by who was told of it: it is seldom, and costs a system call.
    pub fn silence(&self, told: Told) {
        let _ = self.gate.wait(&mut [EpollEvent::empty()], PollTimeout::ZERO);
        if told.again {
            let _ = self.again.read();
        }
    }

    /// Whoever waits looks again.
    pub fn ring_again(&self) {
        let _ = self.again.write(1);
    }

    /// Until there is something to be told; an error once that has taken too long.
    pub fn wait(&self, deadline: Deadline) -> io::Result<Told> {
        let left = deadline.left();
        if left.is_some_and(|left| left.is_zero()) {
            let told = self.told(PollTimeout::ZERO)?;
            return if told == Told::default() { Err(Errno::ETIMEDOUT.into()) } else { Ok(told) };
        }
        // Rounded up: who wakes too early looks again.
        self.told(match left {
            Some(left) => PollTimeout::try_from(left + Duration::from_millis(1)).unwrap_or(PollTimeout::MAX),
            None => PollTimeout::NONE,
        })
    }

    /// Whether the station has hung up by now.
    pub fn has_hung_up(&self) -> io::Result<bool> {
        Ok(self.told(PollTimeout::ZERO)?.hung_up)
    }

    /// What there is to be told, as soon as there is anything; no later than that.
    fn told(&self, no_later: PollTimeout) -> io::Result<Told> {
        let mut events = [EpollEvent::empty(); 3];
        let found = match self.ready.wait(&mut events, no_later) {
            // A signal is nothing to be told: whoever asks looks again.
            Err(Errno::EINTR) => 0,
            found => found?,
        };
        let is = |what| events[..found].iter().any(|event| event.data() == what);
        Ok(Told { hung_up: is(HUNG_UP), again: is(AGAIN) })
    }
}

impl AsFd for Ready {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.ready.0.as_fd()
    }
}

#[cfg(test)]
impl Ready {
    /// What the station has, too.
    pub fn gate(&self) -> BorrowedFd<'_> {
        self.gate.0.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixStream;

    use super::*;

    /// With the waker, and either end of the control socket.
    fn ready() -> (Ready, EventFd, [UnixStream; 2]) {
        let (gate, waker) = (Epoll::new(EpollCreateFlags::empty()).unwrap(), EventFd::new().unwrap());
        gate.add(&waker, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, 0)).unwrap();
        let (station, control) = UnixStream::pair().unwrap();
        (Ready::new(gate.0, &control).unwrap(), waker, [station, control])
    }

    #[test]
    fn what_was_told_of_is_told_until_somebody_looks_for_himself() {
        let (ready, waker, _ends) = ready();
        let is_quiet = || ready.ready.wait(&mut [EpollEvent::empty()], PollTimeout::ZERO) == Ok(0);
        waker.write(1).unwrap();
        assert!(!is_quiet() && !is_quiet());
        ready.silence(Told::default());
        assert!(is_quiet());
        ready.ring_again();
        ready.silence(Told::default());
        assert!(!is_quiet(), "nobody was told of that");
        let told = ready.wait(Deadline::after(Some(Duration::ZERO))).unwrap();
        assert_eq!(told, Told { hung_up: false, again: true }, "who does not wait is told, too");
        ready.silence(told);
        assert!(is_quiet());
        assert!(ready.wait(Deadline::after(Some(Duration::ZERO))).is_err());
    }

    #[test]
    fn a_station_that_hangs_up_is_told_of_also_where_nobody_waits() {
        let (ready, _waker, [station, _control]) = ready();
        assert!(!ready.has_hung_up().unwrap());
        drop(station);
        assert!(ready.has_hung_up().unwrap());
        let none = Deadline::after(Some(Duration::ZERO));
        assert_eq!(ready.wait(none).ok(), Some(Told { hung_up: true, again: false }));
    }
}
