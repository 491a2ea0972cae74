//! One station by hand: frames in at their stamps, transmissions out at their instants, no medium.

use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Discipline, Event, Sent, Transmission};
use rtnet::station::Station;
use rtnet::time::Instant;

/// Turns without any time passing after which a station is taken to be stuck.
const STUCK: u32 = 1_000;

/// A station on an ideal host whose clock only this moves.
pub struct Bench<D: Discipline> {
    /// The station.
    pub station: Station<D>,
    /// What it has sent, with the instant at which it left.
    pub sent: Vec<(Instant, Vec<u8>)>,
    pool: Pool,
    now: Instant,
    inbox: Vec<(Instant, Buf)>,
    chosen: Option<Transmission>,
}

impl<D: Discipline> Bench<D> {
    /// A station that starts at `now`.
    pub fn new(station: Station<D>, now: Instant) -> Self {
        Self { station, sent: Vec::new(), pool: Pool::new(64), now, inbox: Vec::new(), chosen: None }
    }

    /// A frame is stamped at `rx`; until then time passes. It is read at once unless the station waits
    /// for the instant of a transmission.
    pub fn frame(&mut self, rx: Instant, bytes: &[u8]) {
        self.advance(rx);
        let mut frame = self.pool.take().expect("the station gives every buffer back");
        frame.fill(bytes);
        self.inbox.push((rx, frame));
        if self.chosen.is_none() {
            self.turn();
        }
        self.advance(rx);
    }

    /// Time passes up to and including `until`.
    pub fn advance(&mut self, until: Instant) {
        let mut turns = 0;
        loop {
            let due = match &self.chosen {
                Some(chosen) => Some(chosen.at),
                None => self.station.next_deadline(),
            };
            let Some(due) = due.filter(|&due| due.max(self.now) <= until) else { break };
            turns = if due > self.now { 0 } else { turns + 1 };
            assert!(turns < STUCK, "the station takes turn after turn at {:?}", self.now);
            self.now = due.max(self.now);
            match self.chosen.take() {
                Some(chosen) => self.send(chosen),
                None => self.turn(),
            }
        }
        self.now = until.max(self.now);
    }

    /// Events since the last time.
    pub fn events(&mut self) -> Vec<Event> {
        core::iter::from_fn(|| self.station.discipline_mut().next_event()).collect()
    }

    fn turn(&mut self) {
        for (rx, frame) in self.inbox.drain(..) {
            self.station.on_frame(Some(rx), frame);
        }
        self.station.on_timeout(self.now);
        self.chosen = self.station.next_transmission(self.now);
    }

    fn send(&mut self, chosen: Transmission) {
        let Transmission { mut frame, stamp, .. } = chosen;
        if let Some(stamp) = stamp {
            stamp.write(&mut frame, self.now);
        }
        self.sent.push((self.now, frame.to_vec()));
        drop(frame);
        self.station.on_sent(Sent::At(self.now));
        self.turn();
    }
}
