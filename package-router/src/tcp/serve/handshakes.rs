//! When TLS sessions may begin: they take a quarter of the router's time at the most.
//!
//! A step of a handshake takes as long as a thousand packages. Connections that only begin sessions cannot take the time of clients.

use std::collections::VecDeque;

use rtnet::live::clock::monotonic;

use super::socket::Begun;
use super::{Server, broken};
use crate::tcp::router::Connection;

/// A step is followed by so many times its length without another.
const REST: u64 = 3;

/// The handshakes that wait for their turn.
#[derive(Debug, Default)]
pub struct Handshakes {
    /// Connections whose next step waits, the oldest first.
    waiting: VecDeque<Connection>,
    /// Nanoseconds at which the next step may be taken.
    next: u64,
}

impl Handshakes {
    /// Whether a step may be taken.
    pub fn may(&self, now: u64) -> bool {
        now >= self.next
    }

    /// A step was taken.
    pub fn took(&mut self, begun: u64, ended: u64) {
        self.next = ended + REST * (ended - begun);
    }

    /// A step of this connection waits.
    pub fn postpone(&mut self, connection: Connection) {
        self.waiting.push_back(connection);
    }

    /// The connection whose step may be taken now.
    pub fn due(&mut self, now: u64) -> Option<Connection> {
        if self.may(now) { self.waiting.pop_front() } else { None }
    }

    /// Nanoseconds until one may be taken; none waits.
    pub fn wait(&self, now: u64) -> Option<u64> {
        (!self.waiting.is_empty()).then(|| self.next.saturating_sub(now))
    }

    /// A connection is closed.
    pub fn forget(&mut self, connection: Connection) {
        self.waiting.retain(|waiting| *waiting != connection);
    }
}

impl Server {
    /// Takes a step of a handshake.
    pub(super) fn begin(&mut self, connection: Connection) {
        let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut) else {
            return;
        };
        let from = monotonic();
        let begun = socket.begin();
        self.handshakes.took(from, monotonic());
        match begun {
            Ok(Some(Begun(proof))) => {
                self.router.secured(connection, proof);
                self.readable.push(connection);
            }
            Ok(None) => socket.is_readable = false,
            Err(error) => self.disconnect(connection, broken(&error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn handshakes_take_a_quarter_of_the_time() {
        let mut handshakes = Handshakes::default();
        (0..100).map(Connection).for_each(|stranger| handshakes.postpone(stranger));
        let (mut now, mut steps, mut order) = (0, 0, Vec::new());
        while let Some(wait) = handshakes.wait(now) {
            now += wait;
            let of = handshakes.due(now).unwrap();
            order.push(of.0);
            let took = 100_000 + 1_000 * u64::from(of.0 % 7);
            handshakes.took(now, now + took);
            now += took;
            steps += took;
            assert!(!handshakes.may(now + took) && handshakes.due(now).is_none());
        }
        assert_eq!(order, (0..100).collect::<Vec<_>>());
        assert!(steps * 4 <= now + 3 * 107_000, "{steps} of {now}");
    }

    #[test]
    fn a_connection_that_is_closed_has_no_step() {
        let mut handshakes = Handshakes::default();
        [1, 2, 1].map(Connection).into_iter().for_each(|of| handshakes.postpone(of));
        handshakes.forget(Connection(1));
        assert_eq!(
            (handshakes.due(0), handshakes.due(0), handshakes.wait(0)),
            (Some(Connection(2)), None, None)
        );
    }
}
