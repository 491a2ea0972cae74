//! Stations on a medium, driven through virtual time as `live` drives them through real time.

mod carriage;
mod copies;
mod faults;
mod frames;
mod seat;

use std::sync::Arc;

use super::agenda::Agenda;
use super::host::Host;
use super::medium::{Aired, Medium, Traffic};
use super::random::Random;
use crate::buf::{Buf, Pool};
use crate::clock::{EmulatedClock, True};
use crate::discipline::{Discipline, Sent, Transmission};
use crate::station::Station;
use crate::wire::ethernet::Address;

use carriage::Flight;
use copies::Later;
use frames::{Frames, Kept};
use seat::Seat;

pub use carriage::Loss;
pub use faults::Wander;

/// Which station, in the order they were added.
pub type StationId = usize;

/// What one station brings to a network. What every turn looks at comes first, together.
#[repr(C, align(64))]
pub struct Member<D: Discipline> {
    /// Its interface's address: it hears frames to it and to groups.
    pub address: Address,
    /// Its clock.
    pub clock: EmulatedClock,
    /// Its host: many have the same habits.
    pub host: Arc<Host>,
    /// The station.
    pub station: Station<D>,
}

/// A network in virtual time.
pub struct Network<D: Discipline> {
    medium: Medium,
    members: Vec<Seat<D>>,
    /// Who has which address, in the order of addresses.
    addresses: Vec<(Address, StationId)>,
    agenda: Agenda<Action>,
    random: Random,
    now: True,
    traffic: Traffic,
    observer: Option<Observer>,
    attendant: Option<Attendant<D>>,
    mourner: Option<Mourner>,
    /// Who is on the other side of a cut.
    cut_off: Vec<StationId>,
    /// Frames that a hub or a switch has not received wholly.
    flights: Vec<Flight>,
    /// Frames that stations are still to hear.
    frames: Frames,
    /// Of which copies take longer than others.
    later: Later,
    /// Of frames that no station has queued.
    foreign: Pool,
}

/// Frames of nobody's that are on the medium at once; one more is lost.
const FOREIGN_POOL: usize = 64;
/// Longest sleep, as of a live station: how soon it notices that its clock was set back.
const LONGEST_SLEEP: u64 = 100_000_000;

type Observer = Box<dyn FnMut(&Aired<'_>)>;
type Mourner = Box<dyn FnMut(StationId, &[u8], Loss)>;
type Attendant<D> = Box<dyn FnMut(&Moment, &mut Member<D>)>;

/// A station has taken its turn, or sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moment {
    /// Which station.
    pub id: StationId,
    /// When it was done, in true time.
    pub at: True,
    /// When it looked at the clock for that, and when it had woken before.
    pub looked: True,
    /// See `looked`.
    pub woke: True,
    /// Whether a frame of it has left.
    pub sent: bool,
}

enum Action {
    /// A station's thread runs: it drains, chooses, and waits. One that was put off since is void, by its number.
    Turn(StationId, u64),
    /// A station has spun up to its frame's instant.
    Send(StationId, u64),
    /// A frame is on the wire.
    Air { from: StationId, number: u64, frame: Buf },
    /// A hub or a switch has received a frame wholly.
    Landed(u64),
    /// A copy of a frame that was long on its way is at a station; its number among those that are to be told of.
    Arrived { to: StationId, frame: Kept, number: Option<usize> },
    /// A clock changes its rate a little; one that was told otherwise since does not, by its number.
    Wander(StationId, u32),
}

impl<D: Discipline> Network<D> {
    /// An empty network at true time 0; everything random follows from `seed`.
    pub fn new(medium: Medium, seed: u64) -> Self {
        Self {
            medium,
            members: Vec::new(),
            addresses: Vec::new(),
            agenda: Agenda::new(),
            random: Random::new(seed),
            now: 0,
            traffic: Traffic::default(),
            observer: None,
            attendant: None,
            mourner: None,
            cut_off: Vec::new(),
            flights: Vec::new(),
            frames: Frames::new(),
            later: Later::default(),
            foreign: Pool::new(FOREIGN_POOL),
        }
    }

    /// Adds a station, which starts at true time `at`.
    pub fn add(&mut self, member: Member<D>, at: True) -> StationId {
        let id = self.members.len();
        let place = self.addresses.partition_point(|entry| *entry < (member.address, id));
        self.addresses.insert(place, (member.address, id));
        let at = at.max(self.now);
        let mut seat = Seat::new(member, at);
        seat.turn_at(&mut self.agenda, id, at);
        self.members.push(seat);
        id
    }

    /// Lets `observer` see every frame as it goes on the air.
    pub fn observe(&mut self, observer: impl FnMut(&Aired<'_>) + 'static) {
        self.observer = Some(Box::new(observer));
    }

    /// Lets `attendant` look at every station after each of its turns.
    pub fn attend(&mut self, attendant: impl FnMut(&Moment, &mut Member<D>) + 'static) {
        self.attendant = Some(Box::new(attendant));
    }

    /// Tells `mourner` of every frame that is lost on its way to a station, with what was sent, and why: once none of its
    /// copies can come any more.
    pub fn mourn(&mut self, mourner: impl FnMut(StationId, &[u8], Loss) + 'static) {
        self.mourner = Some(Box::new(mourner));
    }

    /// Lets nobody look at it any more.
    pub fn forget_watchers(&mut self) {
        (self.observer, self.attendant, self.mourner) = (None, None, None);
    }

    /// Lets virtual time pass up to and including `until`.
    pub fn run_until(&mut self, until: True) {
        while let Some((at, action)) = self.agenda.take(until) {
            self.now = at;
            match action {
                Action::Turn(id, number) => self.turn(id, number),
                Action::Send(id, number) => self.send(id, number),
                Action::Air { from, number, frame } => self.air_of(from, number, frame),
                Action::Landed(flight) => self.landed(flight),
                Action::Arrived { to, frame, number } => self.arrived(to, frame, number),
                Action::Wander(id, number) => self.wander_on(id, number),
            }
        }
        self.now = until;
    }

    /// Virtual time.
    pub fn now(&self) -> True {
        self.now
    }
    /// What has happened on the medium.
    pub fn traffic(&self) -> &Traffic {
        &self.traffic
    }
    /// Counts from here on.
    pub fn start_over(&mut self) {
        self.traffic.start_over();
    }
    /// The medium, to change while the network runs.
    pub fn medium_mut(&mut self) -> &mut Medium {
        &mut self.medium
    }
    /// A member.
    pub fn member(&self, id: StationId) -> &Member<D> {
        &self.members[id].member
    }
    /// A member, to command it.
    pub fn member_mut(&mut self, id: StationId) -> &mut Member<D> {
        &mut self.members[id].member
    }
    /// Frames that found a station's receive pool empty.
    pub fn dropped(&self, id: StationId) -> u64 {
        self.members[id].dropped
    }

    fn turn(&mut self, id: StationId, number: u64) {
        let now = self.now;
        let seat = &mut self.members[id];
        if seat.is_void(number) || seat.is_frozen(&mut self.agenda, Action::Turn(id, number), now) {
            return;
        }
        seat.note_progress(now);
        seat.blocked = false;
        seat.drain(now, &mut self.frames);
        let Member { clock, station, host, .. } = &mut *seat.member;
        let local = clock.local(now);
        station.on_timeout(local);
        if let Some(chosen) = station.next_transmission(local) {
            let at = clock.truth(chosen.at);
            // Who is late already does not sleep again.
            let at = if at > now { at + host.late.draw(&mut self.random) } else { now };
            (seat.chosen, seat.woke) = (Some(chosen), now);
            self.agenda.put(at, Action::Send(id, number));
        } else {
            let deadline = station.next_deadline().map(|deadline| clock.truth(deadline).max(now));
            let wakes = deadline.map(|at| at.min(now + LONGEST_SLEEP) + host.wake_delay(&mut self.random));
            if let Some(at) = wakes {
                self.agenda.put(at, Action::Turn(id, number));
            }
            if (wakes.is_none() || station.discipline().wakes_on_frames())
                && let Some(at) = seat.block(wakes)
            {
                let wake = at + seat.member.host.wake_delay(&mut self.random);
                seat.wake_for(&mut self.agenda, id, at, wake);
            }
        }
        self.attend_to(Moment { id, at: now, looked: now, woke: now, sent: false });
    }

    /// The last act of a transmission: look at the clock, stamp, send, look again.
    fn send(&mut self, id: StationId, number: u64) {
        let now = self.now;
        let seat = &mut self.members[id];
        if seat.is_void(number) || seat.is_frozen(&mut self.agenda, Action::Send(id, number), now) {
            return;
        }
        let Member { clock, station, host, .. } = &mut *seat.member;
        let before = clock.local(now);
        let Some(chosen) = seat.chosen.take_if(|chosen| chosen.at <= before) else {
            // The clock was set back meanwhile.
            let at = seat.chosen.as_ref().map_or(now, |chosen| clock.truth(chosen.at));
            return self.agenda.put(at, Action::Send(id, number));
        };
        let Transmission { mut frame, latest, stamp, .. } = chosen;
        let mut moment = Moment { id, at: now, looked: now, woke: seat.woke, sent: false };
        if before > latest {
            station.on_sent(Sent::Late(before, frame));
            self.agenda.put(now, Action::Turn(id, number));
            return self.attend_to(moment);
        }
        if let Some(stamp) = stamp {
            stamp.write(&mut frame, before);
        }
        let on_wire = now + host.send_delay(&mut self.random) + std::mem::take(&mut seat.stall);
        let after = clock.local(on_wire);
        let leaves = if host.guard.is_some_and(|tolerance| after > latest + tolerance) {
            station.on_sent(Sent::Guarded(after, frame));
            None
        } else {
            station.on_sent(if after > latest { Sent::StalledUntil(after) } else { Sent::At(before) });
            Some(frame)
        };
        moment.sent = leaves.is_some();
        self.attend_to(moment);
        if on_wire > now {
            let air = leaves.map(|frame| Action::Air { from: id, number, frame });
            self.members[id].busy_until = on_wire;
            air.into_iter().for_each(|air| self.agenda.put(on_wire, air));
            return self.agenda.put(on_wire, Action::Turn(id, number));
        }
        // Nothing happens in between: the agenda need not know.
        if let Some(frame) = leaves {
            self.air(id, frame);
        }
        self.turn(id, number);
    }

    fn attend_to(&mut self, moment: Moment) {
        if let Some(attendant) = &mut self.attendant {
            attendant(&moment, &mut self.members[moment.id].member);
        }
    }
}

#[cfg(test)]
mod tests;
