//! What ends a station's wait for frames: frames, an alarm, and bells that anybody may have been given.

use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;

use nix::poll::PollTimeout;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use nix::sys::eventfd::EventFd;

/// What sockets may be called: their places. Names are bits of a word.
pub(super) const PLACES: usize = 62;
/// All bells have one name: whoever rang, all programs are looked at.
const A_BELL: u64 = 62;
/// And so has the alarm, which nobody asks for.
pub(super) const THE_ALARM: u64 = 63;
/// What is taken note of at a time; more ends the next wait at once.
const AT_ONCE: usize = 16;

/// Where a station hears who rings for it.
#[derive(Clone, Debug)]
pub struct Bells(Arc<Epoll>);

impl Bells {
    /// Without a bell.
    pub fn new() -> io::Result<Self> {
        Ok(Self(Arc::new(Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?)))
    }

    /// From now on a wait is over, too, when this one is written. By edge: who rings, or does to it what else he can, keeps
    /// no other from being heard, and nobody has to silence it.
    pub fn hang(&self, bell: &EventFd) -> io::Result<()> {
        Ok(self.0.add(bell, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, A_BELL))?)
    }

    /// It is heard no more, whoever still has it.
    pub fn take_down(&self, bell: &EventFd) {
        let _ = self.0.delete(bell);
    }

    /// A wait is over as long as there is something to be read from it.
    pub(super) fn watch(&self, socket: impl AsFd, name: u64) -> io::Result<()> {
        Ok(self.0.add(socket, EpollEvent::new(EpollFlags::EPOLLIN, name))?)
    }

    /// Waits, no longer than that, and tells what has ended it: a bit for each name, all if there may be others.
    pub fn wait(&self, no_later: PollTimeout) -> u64 {
        let mut events = [EpollEvent::empty(); AT_ONCE];
        match self.0.wait(&mut events, no_later).unwrap_or(0) {
            AT_ONCE => u64::MAX,
            found => events[..found].iter().fold(0, |names, event| names | 1 << event.data()),
        }
    }
}

#[cfg(test)]
mod tests {
    use nix::sys::eventfd::EfdFlags;

    use super::*;

    fn eventfd() -> EventFd {
        EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC).unwrap()
    }

    #[test]
    fn however_many_ring_a_socket_that_has_something_is_never_taken_for_empty() {
        let (bells, socket) = (Bells::new().unwrap(), eventfd());
        let hung: Vec<EventFd> = (0..3 * AT_ONCE).map(|_| eventfd()).collect();
        hung.iter().for_each(|bell| bells.hang(bell).unwrap());
        bells.watch(&socket, 5).unwrap();
        assert_eq!(bells.wait(PollTimeout::ZERO), 0);
        for bell in hung.iter().chain([&socket]) {
            bell.write(1).unwrap();
        }
        for _ in 0..10 {
            assert_ne!(bells.wait(PollTimeout::ZERO) & 1 << 5, 0);
        }
        assert_eq!(
            bells.wait(PollTimeout::ZERO),
            1 << 5,
            "all bells have been heard, and the socket was not read"
        );
        for bell in &hung {
            bell.write(1).unwrap();
            bells.take_down(bell);
        }
        socket.read().unwrap();
        assert_eq!(bells.wait(PollTimeout::ZERO), 0, "they were taken down");
    }
}
