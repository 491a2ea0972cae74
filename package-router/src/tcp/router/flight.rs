//! Packages in flight: the socket of a connection has taken them, and its peer's kernel has not confirmed them.
//!
//! A router that dies may take them with it. Its accounts count them among those that wait.

use std::collections::BTreeMap;

use super::{Connection, Router};
use crate::tcp::outgoing::Source;

/// Packages by the connection that they came by.
type Packages = BTreeMap<Source, u64>;

/// The packages in flight to a connection.
#[derive(Debug, Default)]
pub(super) struct Flight {
    /// Packages in front of a place in the stream, and this place.
    marked: Packages,
    mark: u64,
    /// Packages behind it.
    fresh: Packages,
}

impl Flight {
    /// The socket has taken some.
    pub fn takes(&mut self, source: Source, count: u64) {
        if source != Source::ROUTER {
            *self.fresh.entry(source).or_default() += count;
        }
    }

    /// All that it has taken ends there in the stream. A mark stays until the stream has arrived up to it.
    pub fn ends_at(&mut self, place: u64) {
        if self.marked.is_empty() {
            (self.marked, self.mark) = (core::mem::take(&mut self.fresh), place);
        }
    }

    /// The stream has arrived up to there: returns the packages that have.
    pub fn arrived(&mut self, place: u64) -> Packages {
        if place < self.mark { Packages::new() } else { core::mem::take(&mut self.marked) }
    }

    /// Whether there are any.
    pub fn is_in_flight(&self) -> bool {
        !self.marked.is_empty() || !self.fresh.is_empty()
    }

    /// All of them; a connection may be there twice.
    pub fn all(self) -> impl Iterator<Item = (Source, u64)> {
        self.marked.into_iter().chain(self.fresh)
    }
}

impl Router {
    /// All that [`Self::write`] has handed over for a connection ends there in its stream.
    pub fn written(&mut self, to: Connection, end: u64) {
        self.client(to).into_iter().for_each(|client| client.flight.ends_at(end));
    }

    /// The kernel of a connection's peer has its stream up to there.
    pub fn arrived(&mut self, to: Connection, end: u64) {
        let Some(client) = self.client(to) else { return };
        for (source, count) in client.flight.arrived(end) {
            self.source(source).into_iter().for_each(|sender| sender.waits -= count);
        }
    }

    /// Whether packages are in flight to a connection.
    pub fn has_in_flight(&mut self, to: Connection) -> bool {
        self.client(to).is_some_and(|client| client.flight.is_in_flight())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packages_are_in_flight_until_their_mark_has_arrived() {
        let [one, other] = [1, 2].map(|number| Source { place: 7, number });
        let mut flight = Flight::default();
        flight.takes(Source::ROUTER, 9);
        assert!(!flight.is_in_flight(), "an answer of the router is not a package of a client");
        flight.takes(one, 2);
        flight.ends_at(100);
        flight.takes(other, 1);
        flight.takes(one, 3);
        flight.ends_at(200);
        assert_eq!(flight.arrived(99), Packages::new());
        assert_eq!(flight.arrived(150), [(one, 2)].into());
        assert!(flight.is_in_flight());
        assert_eq!(flight.arrived(200), Packages::new(), "no mark has been set behind them");
        flight.ends_at(300);
        flight.takes(one, 1);
        assert_eq!(flight.all().collect::<Vec<_>>(), [(one, 3), (other, 1), (one, 1)]);
    }

    #[test]
    fn memory_does_not_grow_while_a_peer_reads_nothing() {
        let source = Source { place: 0, number: 1 };
        let mut flight = Flight::default();
        for place in 1..100_000 {
            flight.takes(source, 1);
            flight.ends_at(place);
        }
        assert_eq!((flight.marked.len(), flight.fresh.len()), (1, 1));
        assert_eq!(flight.arrived(1), [(source, 1)].into());
        flight.ends_at(100_000);
        assert_eq!(flight.arrived(100_000), [(source, 99_998)].into());
        assert!(!flight.is_in_flight());
    }
}
