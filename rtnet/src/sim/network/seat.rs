//! A member of a network, and where it is in its loop.

use std::collections::VecDeque;

use super::frames::{Frames, Kept};
use super::{Action, Agenda, Member, StationId, Wander};
use crate::clock::{EmulatedClock, True};
use crate::discipline::{Discipline, Transmission};
use crate::sim::link::{Fate, Link};
use crate::sim::random::Random;

/// Frames that wait for a station at the most: as many buffers as its network card has, as RTnet's receive ring and
/// transmit descriptors.
pub const RECEIVE_POOL: usize = 32;
/// Turns without any time passing after which a station is taken to be stuck.
const STUCK: u32 = 10_000;

pub struct Seat<D: Discipline> {
    /// In a box: who only hears a frame touches nothing of it.
    pub member: Box<Member<D>>,
    /// What has arrived, or is about to, in the order of its arrival.
    inbox: VecDeque<(True, Kept)>,
    /// The clocks that stamped the first of those, each until when: a card stamps a frame when it arrives.
    clocks_before: Vec<(True, EmulatedClock)>,
    pub chosen: Option<Transmission>,
    /// When it had woken to choose that.
    pub woke: True,
    /// Sleeps until a frame arrives, at the latest until `wakes`.
    pub blocked: bool,
    /// When it wakes, as far as that is known.
    pub wakes: Option<True>,
    /// When the frame arrives that wakes it, if one is on its way.
    woken_by: Option<True>,
    pub stopped: bool,
    /// When it was started first.
    begins: True,
    /// Its thread does not run before this.
    pub frozen_until: True,
    /// For so long its next frame is held up behind its last look at the clock.
    pub stall: u64,
    /// It is in a send until then.
    pub busy_until: True,
    pub dropped: u64,
    pub wire: Wire,
    /// Whom it has sent to last: the place in the order of addresses, as long as nobody has come.
    pub sends_to: usize,
    /// Its port of a switch.
    pub port: Port,
    /// How its clock wanders, if it does, and which time that was said.
    pub wander: Option<Wander>,
    pub wanders: u32,
    /// The number of what it does next: what was put down before under another one is void.
    number: u64,
    turns_now: (True, u32),
}

/// The wire of a station: what it sends by, and what it hears by. Most wires do nothing, and take no memory.
#[derive(Default)]
pub struct Wire(Option<Box<[Link; 2]>>);

impl Wire {
    pub fn is_down(&self) -> bool {
        self.0.as_ref().is_some_and(|links| links[0].down)
    }

    /// What becomes of a frame that the station sends; `None`: it is lost.
    pub fn sends(&self, frame: &[u8], random: &mut Random) -> Option<Fate> {
        self.0.as_ref().map_or(Some(Fate::default()), |links| links[0].carry(frame, random))
    }

    /// The same of one that comes to it.
    pub fn hears(&self, frame: &[u8], random: &mut Random) -> Option<Fate> {
        self.0.as_ref().map_or(Some(Fate::default()), |links| links[1].carry(frame, random))
    }

    pub fn links_mut(&mut self) -> &mut [Link; 2] {
        self.0.get_or_insert_default()
    }
}

/// A port of a switch.
#[derive(Default)]
pub struct Port {
    pub free_from: True,
    /// When those that wait for it begin.
    pub waiting: VecDeque<True>,
}

impl<D: Discipline> Seat<D> {
    pub fn new(member: Member<D>, begins: True) -> Self {
        Self {
            member: Box::new(member),
            inbox: VecDeque::with_capacity(RECEIVE_POOL),
            clocks_before: Vec::new(),
            chosen: None,
            woke: 0,
            blocked: false,
            wakes: None,
            woken_by: None,
            stopped: false,
            begins,
            frozen_until: 0,
            stall: 0,
            busy_until: 0,
            dropped: 0,
            wire: Wire::default(),
            sends_to: 0,
            port: Port::default(),
            wander: None,
            wanders: 0,
            number: 0,
            turns_now: (0, 0),
        }
    }

    /// Its next turn is at this time, whatever was put down before.
    pub fn turn_at(&mut self, agenda: &mut Agenda<Action>, id: StationId, at: True) {
        self.number += 1;
        self.blocked = false;
        agenda.put(at, Action::Turn(id, self.number));
    }

    /// Sleeps until a frame arrives, at the latest until then. When the next one arrives that is on its way, if one is: it
    /// wakes the station.
    pub fn block(&mut self, until: Option<True>) -> Option<True> {
        (self.blocked, self.wakes, self.woken_by) = (true, until, None);
        self.inbox.front().map(|&(at, _)| at)
    }

    /// Whether a frame that arrives then wakes it: none before it does.
    pub fn is_woken_by(&self, at: True) -> bool {
        self.blocked && self.woken_by.is_none_or(|by| at < by)
    }

    /// The frame that arrives at a time lets it run at another, unless it does so before.
    pub fn wake_for(&mut self, agenda: &mut Agenda<Action>, id: StationId, at: True, wake: True) {
        self.woken_by = Some(at);
        if self.wakes.is_none_or(|planned| wake < planned) {
            self.turn_at(agenda, id, wake);
            (self.blocked, self.wakes) = (true, Some(wake));
        }
    }

    /// Whether there is a process that frames can reach.
    pub fn is_there(&self, now: True) -> bool {
        !self.stopped && now >= self.begins
    }

    pub fn is_void(&self, number: u64) -> bool {
        self.stopped || number != self.number
    }

    /// Whether its thread does not run now; then it does this when it runs again.
    pub fn is_frozen(&self, agenda: &mut Agenda<Action>, action: Action, now: True) -> bool {
        let is_frozen = now < self.frozen_until;
        if is_frozen {
            agenda.put(self.frozen_until, action);
        }
        is_frozen
    }

    /// It has another clock from now on.
    pub fn set_clock(&mut self, now: True, clock: EmulatedClock) {
        let since = self.clocks_before.last().map_or(0, |&(until, _)| until);
        // No more of them than frames.
        if self.inbox.iter().any(|(at, _)| (since..now).contains(at)) {
            self.clocks_before.push((now, self.member.clock));
        }
        self.member.clock = clock;
    }

    /// Forgets what has arrived and what was chosen.
    pub fn clear(&mut self, frames: &mut Frames) {
        self.inbox.drain(..).for_each(|(_, frame)| frames.leave(frame));
        self.clocks_before.clear();
        self.chosen = None;
    }

    /// Whether its receive pool is empty: all buffers have a frame that waits.
    pub fn is_full(&self) -> bool {
        self.inbox.len() == RECEIVE_POOL
    }

    /// A frame arrives at a time, mostly behind all others.
    pub fn receive(&mut self, at: True, frame: Kept) {
        let place = self.inbox.iter().rposition(|&(before, _)| before <= at).map_or(0, |last| last + 1);
        self.inbox.insert(place, (at, frame));
    }

    /// Gives the station what has arrived by now.
    pub fn drain(&mut self, now: True, frames: &mut Frames) {
        let Member { clock, station, .. } = &mut *self.member;
        while let Some((at, frame)) = self.inbox.pop_front_if(|&mut (at, _)| at <= now) {
            let before = self.clocks_before.iter().find(|(until, _)| at < *until);
            let stamp = before.map_or(&*clock, |(_, clock)| clock).local(at);
            match frames.hear(frame) {
                Some(frame) => station.on_frame(Some(stamp), frame),
                None => self.dropped += 1,
            }
        }
        self.clocks_before.clear();
        if self.inbox.is_empty() {
            // It begins at its place of old: nobody goes through memory that others have no use for.
            self.inbox.clear();
        }
    }

    pub fn note_progress(&mut self, now: True) {
        let (since, turns) = self.turns_now;
        self.turns_now = if since == now { (now, turns + 1) } else { (now, 0) };
        assert!(turns < STUCK, "a station takes turn after turn at {now} ns and never waits");
    }
}
