//! A station: a discipline, the sockets above it, the services beside them, and what was refused.

use crate::buf::Buf;
use crate::counters::{Refusal, Refusals};
use crate::discipline::{
    Channel, Claimed, Discipline, Opportunity, Returned, SendError, Sent, Service, SyncState, TimeView,
    Transmission,
};
use crate::ip::{Exit, Refused, Stack};
use crate::queue::Priority;
use crate::time::Instant;
use crate::wire::ethernet::{HEADER_LEN, Header, MTU};

/// One participant of the network. The same object runs in virtual time and live.
///
/// What every turn looks at comes first, together: a thousand of them share a processor's cache in virtual time.
#[repr(C)]
pub struct Station<D: Discipline> {
    services: Vec<Box<dyn Service>>,
    stack: Option<Box<Stack>>,
    announced: SyncState,
    /// Whether there was an opportunity since it last had nothing to send.
    was_asked: bool,
    stale: u64,
    out: Out<D>,
    refusals: Refusals,
    /// The turn in which more frames leave than the one that was chosen for it, where there are no slots.
    turn: Option<Opportunity>,
}

/// Where frames leave: the discipline's queue, and a medium that may take less than the discipline does.
struct Out<D> {
    discipline: D,
    mtu: usize,
}

impl<D: Discipline> Exit for Out<D> {
    fn send(&mut self, frame: Buf, priority: Priority, channel: Channel) -> Result<(), (SendError, Buf)> {
        let got = frame.len().saturating_sub(HEADER_LEN);
        if got > self.mtu {
            return Err((SendError::TooLong { channel, got, limit: self.mtu }, frame));
        }
        self.discipline.enqueue(frame, priority, channel)
    }
    fn limit(&self, channel: Channel) -> Result<usize, SendError> {
        Ok(self.discipline.payload_limit(channel)?.min(self.mtu))
    }
    fn time(&self) -> TimeView {
        self.discipline.time()
    }
}

impl<D: Discipline> Station<D> {
    /// A station that shares the medium by `discipline`.
    pub fn new(discipline: D, services: Vec<Box<dyn Service>>) -> Self {
        Self {
            out: Out { discipline, mtu: MTU },
            services,
            stack: None,
            refusals: Refusals::default(),
            stale: 0,
            announced: SyncState::Waiting,
            was_asked: false,
            turn: None,
        }
    }

    /// The same with sockets.
    pub fn with_stack(self, stack: Stack) -> Self {
        Self { stack: Some(Box::new(stack)), ..self }
    }

    /// From now on frames carry this many bytes behind their Ethernet header at the most, whatever the discipline takes: the
    /// medium's MTU.
    pub fn set_mtu(&mut self, mtu: usize) {
        self.out.mtu = mtu.min(MTU);
    }

    /// A frame has arrived, stamped `rx` on this station's clock.
    pub fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) {
        if let Err(reason) = self.dispatch(rx, frame) {
            self.refusals.count(reason);
        }
    }

    /// Time has passed.
    pub fn on_timeout(&mut self, now: Instant) {
        self.out.discipline.on_timeout(now);
        self.announce_sync_state();
    }

    /// The next frame to send. Every [`Transmission`] is answered by [`Station::on_sent`].
    pub fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        while let Some(slot) = self.out.discipline.opportunity(now) {
            self.ask(&slot);
            let chosen = self.out.discipline.next_transmission(now);
            self.announce_sync_state();
            if let Some(mut chosen) = chosen {
                self.leaves(&slot, &mut chosen.frame);
                self.turn = self.out.discipline.has_queued().then_some(slot);
                return Some(chosen);
            }
        }
        let mut chosen = self.out.discipline.next_transmission(now);
        if let (Some(chosen), Some(turn)) = (&mut chosen, self.turn) {
            self.leaves(&turn, &mut chosen.frame);
        }
        self.announce_sync_state();
        if chosen.is_none() && !core::mem::take(&mut self.was_asked) {
            self.looks_without_slot(now);
        }
        chosen
    }

    /// What became of the transmission.
    pub fn on_sent(&mut self, outcome: Sent) {
        let is_refused = matches!(outcome, Sent::Failed(..));
        let Some(returned) = self.out.discipline.on_sent(outcome) else { return };
        if is_refused && !self.out.discipline.tries_again() {
            let Returned { frame, priority, .. } = returned;
            self.services.iter_mut().for_each(|service| service.given_up(&frame, priority));
        } else if self
            .services
            .iter_mut()
            .all(|service| service.still_wanted(&returned.frame, returned.priority))
        {
            self.out.discipline.put_back(returned);
        } else {
            self.stale += 1;
        }
    }

    /// The slot's frame has left: programs with sockets, and services, may do what takes longer.
    pub fn rest(&mut self) {
        self.stack.iter_mut().for_each(|stack| stack.rest());
        self.services.iter_mut().for_each(|service| service.rest());
    }

    /// It is about to wait until it is rung for, or is awake again. Tells whether it should not wait.
    pub fn sleeps(&mut self, is_asleep: bool) -> bool {
        let of_services =
            self.services.iter_mut().filter_map(|service| service.sleeps(is_asleep).then_some(()));
        let stays = of_services.count() > 0;
        self.stack.as_mut().is_some_and(|stack| stack.sleeps(is_asleep)) || stays
    }

    /// When to wake next; `None` means on the next frame.
    pub fn next_deadline(&self) -> Option<Instant> {
        self.out.discipline.next_deadline()
    }

    /// The way this station shares the medium.
    pub fn discipline(&self) -> &D {
        &self.out.discipline
    }
    /// The way this station shares the medium, to command it and to take its events.
    pub fn discipline_mut(&mut self) -> &mut D {
        &mut self.out.discipline
    }
    /// Its sockets, if it has any.
    pub fn stack(&self) -> Option<&Stack> {
        self.stack.as_deref()
    }
    /// Its sockets, and where their frames leave.
    pub fn stack_mut(&mut self) -> Option<(&mut Stack, &mut dyn Exit)> {
        Some((self.stack.as_deref_mut()?, &mut self.out))
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
        let Self { out, services, stack, .. } = self;
        let (header, _) = Header::parse(&frame).ok_or(Refusal::Runt)?;
        let ether_type = header.ether_type();
        let is_disciplines = out.discipline.claims(header);
        let service = services.iter_mut().find(|service| service.claims(ether_type));
        if let Some(stack) = stack {
            if !is_disciplines && service.is_none() {
                let heard = stack.on_frame(rx, frame, out);
                return heard.or_else(|refused| offer(refused, services));
            }
            stack.overhear(rx, &frame);
        }
        if is_disciplines {
            return match out.discipline.on_frame(rx, frame) {
                Claimed::Kept => Ok(()),
                Claimed::Tunnel(frame) => service.ok_or(Refusal::NoTunnel)?.on_frame(rx, frame),
                Claimed::Refused(reason) => Err(reason),
            };
        }
        service.ok_or(Refusal::UnclaimedEtherType)?.on_frame(rx, frame)
    }

    /// Lets services queue what they have for a slot, and fill it if there is nothing.
    fn ask(&mut self, slot: &Opportunity) {
        self.was_asked = true;
        let Self { out, services, stack, .. } = self;
        let slot = &Opportunity { non_rt: slot.non_rt.map(|limit| limit.min(out.mtu)), ..*slot };
        for service in services.iter_mut() {
            service.poll(slot, &mut |frame, priority, channel| out.send(frame, priority, channel));
        }
        if let Some(stack) = stack {
            stack.poll(slot.begin, out);
        }
        let routes = stack.as_deref().map(Stack::routes);
        for service in services {
            if !out.discipline.is_waiting(slot.channel) {
                service
                    .fill(slot, routes, &mut |frame, priority, channel| out.send(frame, priority, channel));
            }
        }
    }

    /// Once each time that it is awake, also where no slot comes: what programs want that needs one is refused, and what is
    /// waited for is given up in time.
    fn looks_without_slot(&mut self, now: Instant) {
        let Self { out, stack, .. } = self;
        stack.iter_mut().for_each(|stack| stack.poll(now, out));
    }

    /// Tells whose frame it is that it was chosen for a slot.
    fn leaves(&mut self, slot: &Opportunity, frame: &mut [u8]) {
        let Some((header, _)) = Header::parse(frame) else { return };
        let ether_type = header.ether_type();
        if let Some(service) = self.services.iter_mut().find(|service| service.claims(ether_type)) {
            service.leaves(slot, frame);
        } else if let Some(stack) = &mut self.stack {
            stack.leaves(slot.begin, frame);
        }
    }

    fn announce_sync_state(&mut self) {
        let view = self.out.discipline.time();
        if view.state != self.announced {
            self.announced = view.state;
            for service in &mut self.services {
                service.on_sync_state(&view);
            }
        }
    }
}

/// What the sockets have no part in is a service's that has it, too.
fn offer(refused: Refused, services: &mut [Box<dyn Service>]) -> Result<(), Refusal> {
    let Refused { why, unwanted } = refused;
    let Some(mut packet) = unwanted else { return Err(why) };
    for service in services {
        match service.on_unwanted(packet) {
            Ok(()) => return Ok(()),
            Err(back) => packet = back,
        }
    }
    Err(why)
}
