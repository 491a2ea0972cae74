//! Which packages have arrived at the kernels of their receivers.

use std::io;
use std::time::Duration;

use mio::Events;

use super::{LINKS, Server};
use crate::tcp::router::Connection;

/// Milliseconds from one look for packages that have arrived to the next, at the least.
const LOOKS_EVERY: u64 = 10;
/// Connections in flight that make it a millisecond longer: a look takes a microsecond for each at the most.
const CONNECTIONS_A_MILLISECOND: u64 = 100;
/// Milliseconds that a router takes at its end, at the most.
const ENDS_WITHIN: u64 = 1_000;

impl Server {
    /// Something was written to a connection: it is looked at if packages are in flight to it.
    pub(super) fn flies_to(&mut self, connection: Connection) {
        let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut) else {
            return;
        };
        if !socket.is_in_flight && self.router.has_in_flight(connection) {
            socket.is_in_flight = true;
            self.in_flight.push(connection);
        }
    }

    /// Looks for packages that have arrived. The next read may bring a question for an account, which counts the others.
    pub(super) fn look_for_arrivals(&mut self) {
        if self.in_flight.is_empty() {
            return;
        }
        let now = self.now();
        if now < self.looks_again {
            return;
        }
        self.looks_again = now + LOOKS_EVERY + self.in_flight.len() as u64 / CONNECTIONS_A_MILLISECOND;
        let mut in_flight = core::mem::take(&mut self.in_flight);
        in_flight.retain(|connection| {
            let flies = self.looks_at(*connection);
            let socket = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut);
            socket.into_iter().for_each(|socket| socket.is_in_flight = flies);
            flies
        });
        self.in_flight = in_flight;
    }

    /// Looks whether packages have arrived at a connection's peer; returns whether some are still in flight.
    pub(super) fn looks_at(&mut self, connection: Connection) -> bool {
        let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut) else {
            return false;
        };
        // TLS that has to wait for room in the socket is looked at another time.
        let is_flushed = socket.stream.flush_tls().unwrap_or(false);
        let (taken, arrived) = (socket.stream.taken(), socket.stream.arrived());
        // The packages in front of the mark, then the others.
        for _ in 0..2 {
            if is_flushed {
                self.router.written(connection, taken);
            }
            self.router.arrived(connection, arrived);
        }
        self.router.has_in_flight(connection)
    }

    /// Writes what waits, until all of it has arrived, for a second at the most. Nothing is read any more.
    pub(super) fn finish(&mut self, events: &mut Events) -> io::Result<()> {
        let until = self.now() + ENDS_WITHIN;
        while self.now() < until && (self.router.has_waiting() || !self.in_flight.is_empty()) {
            // Answers for packages that will not arrive, too.
            self.write();
            self.close();
            match self.poll.poll(events, Some(Duration::from_millis(LOOKS_EVERY))) {
                Err(error) if error.kind() != io::ErrorKind::Interrupted => return Err(error),
                _ => {}
            }
            let writable = events.iter().filter(|event| event.is_writable()).map(|event| event.token().0);
            for place in writable.filter(|place| *place < LINKS) {
                self.write_to(Connection(place as u32));
            }
            self.look_for_arrivals();
        }
        Ok(())
    }
}
