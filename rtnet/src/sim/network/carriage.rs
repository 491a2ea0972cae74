//! How a frame gets from its sender to those that hear it.
//!
//! ```text
//!   air ──bridge─────────────────────────────► deliver ──► arrive, for each that is addressed and lucky
//!    └───hub, switch──► Landed ──not collided──►┘   │  └─switch──► behind what waits for the port ─┐
//!         (its sender's wire first)                 └─a slow wire──► Arrived ◄──────────────────────┘
//! ```

use std::ops::Range;

use super::copies::Copies;
use super::frames::Kept;
use super::seat::Port;
use super::{Action, Network, StationId};
use crate::buf::Buf;
use crate::clock::True;
use crate::discipline::Discipline;
use crate::sim::latency::nanos;
use crate::sim::link::{Fate, is_control};
use crate::sim::medium::{Joint, Medium};
use crate::wire::ethernet::{Address, Header};

/// A frame that a hub or a switch is receiving.
pub struct Flight {
    number: u64,
    from: StationId,
    frame: Buf,
    /// When its last bit has left.
    until: True,
    collided: bool,
    /// Who sent while it came there, though it met nothing elsewhere.
    deaf: Vec<StationId>,
    /// What its sender's wire has made of it.
    sent: Result<Fate, Loss>,
}

/// What arrives so soon arrives at once: meanwhile nobody gives a buffer back.
const SOON: u64 = 1_000;

/// Why a frame does not reach a station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Loss {
    /// A wire lost it, or the medium, as it was told to.
    Wire,
    /// The station is on the other side of a cut.
    Cut,
    /// A hub destroyed it.
    Collision,
    /// Its port of a switch had no room for it.
    QueueFull,
    /// It found the station's receive pool empty.
    NoBuffer,
    /// It came, but not as it was sent: not from this byte on.
    Changed(usize),
}

impl Loss {
    /// Whether somebody wanted it so; all else a network brings about itself, or, of what was changed, its receiver notices.
    pub fn is_on_purpose(self) -> bool {
        matches!(self, Loss::Wire | Loss::Cut)
    }
}

impl<D: Discipline> Network<D> {
    /// A frame of a process that is gone meanwhile does not leave any more.
    pub(super) fn air_of(&mut self, from: StationId, number: u64, frame: Buf) {
        if !self.members[from].is_void(number) {
            self.air(from, frame);
        }
    }

    pub(super) fn air(&mut self, from: StationId, frame: Buf) {
        let now = self.now;
        if self.members.get(from).is_some_and(|seat| seat.wire.is_down()) {
            self.traffic.lost += 1;
            return;
        }
        let air = self.medium.air_time(frame.len());
        let part = usize::from(self.cut_off.contains(&from));
        let aired = self.traffic.put_on_air((from, part), now, air, &frame);
        if let Some(observer) = &mut self.observer {
            observer(&aired);
        }
        let propagation = nanos(self.medium.propagation);
        let mut sent = self.leave(from, &frame);
        if self.medium.joint == Joint::Bridge {
            return self.deliver(from, &frame, now + propagation, sent, &[]);
        }
        let (number, until) = (self.traffic.frames, now + self.medium.bits_time(frame.len()));
        let mut lands = until + propagation;
        // What comes to a switch later waits behind what has come to it by then.
        if let (Joint::Switch { .. }, Ok(fate)) = (self.medium.joint, &mut sent) {
            lands += std::mem::take(&mut fate.later);
        }
        let collided = self.medium.joint == Joint::Hub && self.meet(from);
        self.flights.push(Flight { number, from, frame, until, collided, deaf: Vec::new(), sent });
        self.agenda.put(lands, Action::Landed(number));
    }

    /// A station begins to send on a hub: whether its frame meets another there. One whose bits have all left, but not come,
    /// only this station does not hear.
    fn meet(&mut self, from: StationId) -> bool {
        let Self { now, medium, members, cut_off, flights, .. } = self;
        let is_beside = |other: StationId| cut_off.contains(&other) == cut_off.contains(&from);
        let hears = |frame: &[u8]| {
            let Some((seat, (header, _))) = members.get(from).zip(Header::parse(frame)) else { return false };
            header.destination.is_group() || header.destination == seat.member.address
        };
        let mut collided = false;
        for other in flights.iter_mut().filter(|other| is_beside(other.from)) {
            let is_coming = other.until + nanos(medium.propagation) > *now;
            if other.until > *now {
                (other.collided, collided) = (true, true);
            } else if is_coming && other.from != from && hears(&other.frame) {
                other.deaf.push(from);
            }
        }
        collided
    }

    /// What its own wire does to a frame that a station sends.
    fn leave(&mut self, from: StationId, frame: &[u8]) -> Result<Fate, Loss> {
        let Some(seat) = self.members.get(from) else { return Ok(Fate::default()) };
        seat.wire.sends(frame, &mut self.random).ok_or(Loss::Wire)
    }

    pub(super) fn landed(&mut self, number: u64) {
        let Some(place) = self.flights.iter().position(|flight| flight.number == number) else { return };
        let Flight { from, frame, collided, deaf, sent, .. } = self.flights.swap_remove(place);
        self.traffic.collided += u64::from(collided || !deaf.is_empty());
        let sent = if collided { Err(Loss::Collision) } else { sent };
        self.deliver(from, &frame, self.now, sent, &deaf);
    }

    /// A frame reaches those that it is for at a time, or as much later as their wires want it, or never.
    fn deliver(
        &mut self,
        from: StationId,
        frame: &[u8],
        at: True,
        sent: Result<Fate, Loss>,
        deaf: &[StationId],
    ) {
        let Some((header, _)) = Header::parse(frame) else { return };
        self.count(sent.unwrap_or_default());
        let to_all = header.destination.is_group();
        let frame = self.frames.keep(frame);
        let range = if to_all { 0..self.members.len() } else { self.who_has(header.destination, from) };
        for place in range {
            let to = if to_all { place } else { self.addresses[place].1 };
            if to == from || !self.members[to].is_there(self.now) {
                continue;
            }
            let mut copies = Copies::default();
            match sent {
                Err(why) => copies.note(Err(why)),
                Ok(_) if deaf.contains(&to) => copies.note(Err(Loss::Collision)),
                Ok(fate) => {
                    for _ in 0..=u8::from(fate.comes_twice) {
                        self.hand_to(to, from, &frame, at, fate, &mut copies);
                    }
                }
            }
            if let Some(why) = copies.conclude(&mut self.later) {
                self.lose(to, &frame, why);
            }
        }
        self.frames.leave(frame);
    }

    /// The places in the order of addresses of those with this one. Most stations send to the same one all the time.
    fn who_has(&mut self, address: Address, from: StationId) -> Range<usize> {
        let has = |place: usize| self.addresses.get(place).is_some_and(|entry| entry.0 == address);
        let is_first = |&place: &usize| has(place) && (place == 0 || !has(place - 1));
        let known = self.members.get(from).map(|seat| seat.sends_to).filter(is_first);
        let first = known.unwrap_or_else(|| self.addresses.partition_point(|entry| entry.0 < address));
        if let Some(seat) = self.members.get_mut(from) {
            seat.sends_to = first;
        }
        let behind = self.addresses[first..].iter().take_while(|entry| entry.0 == address).count();
        first..first + behind
    }

    fn lose(&mut self, to: StationId, frame: &Kept, why: Loss) {
        self.traffic.lost += u64::from(why.is_on_purpose());
        if let Some(mourner) = &mut self.mourner {
            mourner(to, self.frames.bytes(frame), why);
        }
    }

    fn count(&mut self, fate: Fate) {
        self.traffic.duplicated += u64::from(fate.comes_twice);
        self.traffic.corrupted += u64::from(fate.corrupt.is_some());
        self.traffic.reordered += u64::from(fate.overtaken);
    }

    /// A copy of a frame that left its sender with this fate is handed to a station.
    fn hand_to(
        &mut self,
        to: StationId,
        from: StationId,
        frame: &Kept,
        at: True,
        sent: Fate,
        copies: &mut Copies,
    ) {
        match self.carry_to(to, from, frame, at) {
            Err(why) => copies.note(Err(why)),
            Ok((at, heard)) => {
                let at = at + sent.later + heard.later;
                for _ in 0..=u8::from(heard.comes_twice) {
                    self.on_its_way(to, frame, at, [sent, heard], copies);
                }
            }
        }
    }

    /// When it has left the medium for a station, and what that one's wire makes of it; or why it does not get there.
    fn carry_to(
        &mut self,
        to: StationId,
        from: StationId,
        frame: &Kept,
        at: True,
    ) -> Result<(True, Fate), Loss> {
        if !self.cut_off.is_empty() && self.cut_off.contains(&to) != self.cut_off.contains(&from) {
            return Err(Loss::Cut);
        }
        let Medium { lose_control_ppm, lose_data_ppm, .. } = self.medium;
        let bytes = self.frames.bytes(frame);
        if self.random.happens(if is_control(bytes) { lose_control_ppm } else { lose_data_ppm }) {
            return Err(Loss::Wire);
        }
        let heard = self.members[to].wire.hears(bytes, &mut self.random).ok_or(Loss::Wire)?;
        let len = bytes.len();
        let at = self.through_port(to, len, at).ok_or(Loss::QueueFull)?;
        self.count(heard);
        Ok((at, heard))
    }

    /// A copy is about to arrive at a station, with what has become of it on the way.
    fn on_its_way(&mut self, to: StationId, frame: &Kept, at: True, fates: [Fate; 2], copies: &mut Copies) {
        let changed_from = fates.iter().filter_map(Fate::changed_from).min();
        let frame = match changed_from {
            Some(_) => self.frames.copy(frame),
            None => self.frames.share(frame),
        };
        fates.iter().for_each(|fate| fate.corrupt(self.frames.bytes_mut(&frame)));
        if let Some(byte) = changed_from {
            copies.note(Err(Loss::Changed(byte)));
        }
        if at <= self.now + SOON {
            let reached = self.arrive(to, frame, at);
            if changed_from.is_none() {
                copies.note(reached);
            }
            return;
        }
        // Of what it is now nobody is told, whatever becomes of it.
        let number = changed_from.is_none().then(|| copies.note_later(&mut self.later));
        self.agenda.put(at, Action::Arrived { to, frame, number });
    }

    /// A copy that was long on its way is there.
    pub(super) fn arrived(&mut self, to: StationId, frame: Kept, number: Option<usize>) {
        let is_there = self.members[to].is_there(self.now);
        let taken = is_there.then(|| self.frames.share(&frame));
        let reached = taken.map(|frame| self.arrive(to, frame, self.now));
        let is_lost = number.is_some_and(|number| self.later.end_of_one(number, reached == Some(Ok(()))));
        if let (Some(Err(why)), true) = (reached, is_lost) {
            self.lose(to, &frame, why);
        }
        self.frames.leave(frame);
    }

    /// A frame takes a buffer of a station's card, and wakes the station if it waits for one.
    fn arrive(&mut self, to: StationId, frame: Kept, at: True) -> Result<(), Loss> {
        let seat = &mut self.members[to];
        if seat.is_full() {
            seat.dropped += 1;
            self.frames.leave(frame);
            return Err(Loss::NoBuffer);
        }
        seat.receive(at, frame);
        if seat.is_woken_by(at) {
            let wake = at + seat.member.host.wake_delay(&mut self.random);
            seat.wake_for(&mut self.agenda, to, at, wake);
        }
        Ok(())
    }

    /// When a frame that comes to a switch has left it by a station's port; `None`: there was no room for it.
    fn through_port(&mut self, to: StationId, len: usize, at: True) -> Option<True> {
        let Joint::Switch { latency, queue } = self.medium.joint else { return Some(at) };
        let (air, bits) = (self.medium.air_time(len), self.medium.bits_time(len));
        let Port { free_from, waiting } = &mut self.members[to].port;
        while waiting.pop_front_if(|begins| *begins <= at).is_some() {}
        if waiting.len() >= queue.max(1) {
            self.traffic.queue_full += 1;
            return None;
        }
        let begins = (*free_from).max(at + nanos(latency));
        if begins > at + nanos(latency) {
            waiting.push_back(begins);
        }
        *free_from = begins + air;
        self.traffic.longest_queue = self.traffic.longest_queue.max(waiting.len());
        Some(begins + bits + nanos(self.medium.propagation))
    }
}
