//! A station: a discipline, the services beside it, and what was refused.

use crate::buf::Buf;
use crate::counters::{Refusal, Refusals};
use crate::discipline::{Claimed, Discipline, Opportunity, Sent, Service, SyncState, Transmission};
use crate::time::Instant;
use crate::wire::ethernet::Header;

/// One participant of the network. The same object runs in virtual time and live.
pub struct Station<D: Discipline> {
    discipline: D,
    services: Vec<Box<dyn Service>>,
    refusals: Refusals,
    stale: u64,
    announced: SyncState,
}

impl<D: Discipline> Station<D> {
    /// A station that shares the medium by `discipline`.
    pub fn new(discipline: D, services: Vec<Box<dyn Service>>) -> Self {
        Self { discipline, services, refusals: Refusals::default(), stale: 0, announced: SyncState::Waiting }
    }

    /// A frame has arrived, stamped `rx` on this station's clock.
    pub fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) {
        if let Err(reason) = self.dispatch(rx, frame) {
            self.refusals.count(reason);
        }
    }

    /// Time has passed.
    pub fn on_timeout(&mut self, now: Instant) {
        self.discipline.on_timeout(now);
        self.announce_sync_state();
    }

    /// The next frame to send. Every [`Transmission`] is answered by [`Station::on_sent`].
    pub fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        while let Some(slot) = self.discipline.opportunity(now) {
            self.ask(&slot);
            let chosen = self.discipline.next_transmission(now);
            self.announce_sync_state();
            if let Some(mut chosen) = chosen {
                self.leaves(&slot, &mut chosen.frame);
                return Some(chosen);
            }
        }
        let chosen = self.discipline.next_transmission(now);
        self.announce_sync_state();
        chosen
    }

    /// What became of the transmission.
    pub fn on_sent(&mut self, outcome: Sent) {
        let Some(returned) = self.discipline.on_sent(outcome) else { return };
        if self.services.iter_mut().all(|service| service.still_wanted(&returned.frame)) {
            self.discipline.put_back(returned);
        } else {
            self.stale += 1;
        }
    }

    /// When to wake next; `None` means on the next frame.
    pub fn next_deadline(&self) -> Option<Instant> {
        self.discipline.next_deadline()
    }

    /// The way this station shares the medium.
    pub fn discipline(&self) -> &D {
        &self.discipline
    }
    /// The way this station shares the medium, to command it and to take its events.
    pub fn discipline_mut(&mut self) -> &mut D {
        &mut self.discipline
    }
    /// Frames that were refused, by reason.
    pub fn refusals(&self) -> &Refusals {
        &self.refusals
    }
    /// Frames that missed their slot and were not worth sending later.
    pub fn stale(&self) -> u64 {
        self.stale
    }

    fn dispatch(&mut self, rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        let (header, _) = Header::parse(&frame).ok_or(Refusal::Runt)?;
        if self.discipline.claims(header) {
            return match self.discipline.on_frame(rx, frame) {
                Claimed::Kept => Ok(()),
                Claimed::Tunnel(_) => Err(Refusal::NoTunnel),
                Claimed::Refused(reason) => Err(reason),
            };
        }
        let ether_type = header.ether_type();
        let service = self.services.iter_mut().find(|service| service.claims(ether_type));
        service.ok_or(Refusal::UnclaimedEtherType)?.on_frame(rx, frame)
    }

    /// Lets services queue what they have for a slot, and fill it if there is nothing.
    fn ask(&mut self, slot: &Opportunity) {
        let Self { discipline, services, .. } = self;
        for service in services.iter_mut() {
            service.poll(slot, &mut |frame, priority, channel| discipline.enqueue(frame, priority, channel));
        }
        for service in services {
            if !discipline.is_waiting(slot.channel) {
                service
                    .fill(slot, &mut |frame, priority, channel| discipline.enqueue(frame, priority, channel));
            }
        }
    }

    /// Tells whose frame it is that it was chosen for a slot.
    fn leaves(&mut self, slot: &Opportunity, frame: &mut [u8]) {
        let Some((header, _)) = Header::parse(frame) else { return };
        let ether_type = header.ether_type();
        if let Some(service) = self.services.iter_mut().find(|service| service.claims(ether_type)) {
            service.leaves(slot, frame);
        }
    }

    fn announce_sync_state(&mut self) {
        let view = self.discipline.time();
        if view.state != self.announced {
            self.announced = view.state;
            for service in &mut self.services {
                service.on_sync_state(&view);
            }
        }
    }
}
