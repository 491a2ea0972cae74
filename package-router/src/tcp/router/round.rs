//! The work of every [`LIFESIGN_EVERY`] milliseconds.

use super::links::Role;
use super::{Connection, Ending, LIFESIGN_EVERY, Life, Router, Trust};
use crate::name::MailboxName;
use crate::tcp::control::LIFESIGN;
use crate::wire::Head;

/// Connections of a part of a round, and milliseconds from one part to the next: 10,000 take 400 ms.
const PART: usize = 256;
const PART_EVERY: u64 = 10;

impl Router {
    /// When [`Self::round`] is due.
    pub fn next_round(&self) -> u64 {
        self.next_round
    }

    /// Ends connections that have sent nothing since the last round, and asks the others for a sign of life; measures rates. Many
    /// connections have their turn in parts: packages pass in between. The caller hands over all bytes that have come before: so
    /// a router that was stopped for a while ends no connection that is alive.
    pub fn round(&mut self, now: u64) {
        if self.round_at == 0 {
            self.measure(now);
        }
        let (begin, end) = (self.round_at, self.clients.len().min(self.round_at + PART));
        // The last part has as long until its next turn as all others.
        let before = (begin / PART) as u64 * PART_EVERY;
        (self.round_at, self.next_round) = match end == self.clients.len() {
            true => (0, now + LIFESIGN_EVERY.saturating_sub(before)),
            false => (end, now + PART_EVERY),
        };
        let lifesign = Head::new(LIFESIGN, MailboxName::NOBODY, MailboxName::NOBODY);
        for place in begin as u32..end as u32 {
            let Some(client) = &mut self.clients[place as usize] else { continue };
            client.outgoing.shrink();
            if !client.watchdog {
                continue;
            }
            let is_link = matches!(client.role, Role::Link(_));
            let is_trusted = client.trust == Trust::Full;
            let life = core::mem::replace(&mut client.life, Life::Asked);
            if life == Life::Asked {
                self.end(Connection(place), Ending::Silent);
            } else if is_link {
                self.ask_again(Connection(place), now);
            } else if is_trusted && !self.own(Connection(place), &lifesign, now) {
                self.has_no_room(Connection(place), life);
            }
        }
    }

    /// A connection leaves no room for the question: it does not read the answers to its own. It is ended if the next round finds the same,
    /// and nothing has come from it.
    fn has_no_room(&mut self, connection: Connection, life: Life) {
        match self.client(connection) {
            Some(client) if life == Life::Shown => client.life = Life::Unasked,
            _ => self.end(connection, Ending::Silent),
        }
    }

    fn measure(&mut self, now: u64) {
        let mut all = self.counters;
        for client in self.clients.iter_mut().flatten() {
            client.meter.round(&client.counters, now);
            all.add(&client.counters);
        }
        self.meter.round(&all, now);
    }
}
