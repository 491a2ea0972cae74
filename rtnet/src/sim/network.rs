//! Stations on a medium, driven through virtual time as `live` drives them through real time.

use std::collections::VecDeque;

use super::agenda::Agenda;
use super::host::Host;
use super::medium::{Aired, Medium, Traffic};
use super::random::Random;
use crate::buf::{Buf, Pool};
use crate::clock::{EmulatedClock, True};
use crate::discipline::{Discipline, Sent, Transmission};
use crate::station::Station;
use crate::wire::ethernet::{Address, Header};

/// Which station, in the order they were added.
pub type StationId = usize;

/// Buffers of a station's network card, as RTnet's receive ring and transmit descriptors.
const NIC_POOL: usize = 32;
/// Turns without any time passing after which a station is taken to be stuck.
const STUCK: u32 = 10_000;

/// What one station brings to a network.
pub struct Member<D: Discipline> {
    /// Its interface's address: it hears frames to it and to groups.
    pub address: Address,
    /// Its clock.
    pub clock: EmulatedClock,
    /// Its host.
    pub host: Host,
    /// The station.
    pub station: Station<D>,
}

/// A network in virtual time.
pub struct Network<D: Discipline> {
    medium: Medium,
    members: Vec<Seat<D>>,
    agenda: Agenda<Action>,
    random: Random,
    now: True,
    traffic: Traffic,
    observer: Option<Observer>,
    /// Who is on the other side of a cut.
    cut_off: Vec<StationId>,
}

type Observer = Box<dyn FnMut(&Aired<'_>)>;

/// A member and where it is in its loop.
struct Seat<D: Discipline> {
    member: Member<D>,
    pool: Pool,
    inbox: VecDeque<(True, Buf)>,
    chosen: Option<Transmission>,
    /// Sleeps until a frame arrives, at the latest until its deadline if it has one.
    blocked: bool,
    /// When its thread runs next; a wake-up for any other time was for a deadline that a frame came before.
    wakes: Option<True>,
    stopped: bool,
    dropped: u64,
    turns_now: (True, u32),
}

enum Action {
    /// A station's thread runs: it drains, chooses, and waits.
    Turn(StationId),
    /// A station has spun up to its frame's instant.
    Send(StationId),
    /// A frame is on the wire.
    Air { from: StationId, frame: Buf },
    /// A frame has arrived.
    Arrive { to: StationId, frame: Buf },
}

impl<D: Discipline> Network<D> {
    /// An empty network at true time 0; everything random follows from `seed`.
    pub fn new(medium: Medium, seed: u64) -> Self {
        Self {
            medium,
            members: Vec::new(),
            agenda: Agenda::new(),
            random: Random::new(seed),
            now: 0,
            traffic: Traffic::default(),
            observer: None,
            cut_off: Vec::new(),
        }
    }

    /// Adds a station, which starts at true time `at`.
    pub fn add(&mut self, member: Member<D>, at: True) -> StationId {
        let id = self.members.len();
        self.members.push(Seat {
            member,
            pool: Pool::new(NIC_POOL),
            inbox: VecDeque::with_capacity(NIC_POOL),
            chosen: None,
            blocked: false,
            wakes: None,
            stopped: false,
            dropped: 0,
            turns_now: (0, 0),
        });
        self.wake(id, at.max(self.now));
        id
    }

    /// Lets `observer` see every frame as it goes on the air.
    pub fn observe(&mut self, observer: impl FnMut(&Aired<'_>) + 'static) {
        self.observer = Some(Box::new(observer));
    }

    /// Lets virtual time pass up to and including `until`.
    pub fn run_until(&mut self, until: True) {
        while let Some((at, action)) = self.agenda.take(until) {
            self.now = at;
            match action {
                Action::Turn(id) if self.members[id].wakes == Some(at) => self.turn(id),
                Action::Turn(_) => {}
                Action::Send(id) => self.send(id),
                Action::Air { from, frame } => self.air(from, &frame),
                Action::Arrive { to, frame } => self.arrive(to, frame),
            }
        }
        self.now = until;
    }

    /// Stops a station as a crash would: it sends nothing more and hears nothing more.
    pub fn stop(&mut self, id: StationId) {
        self.members[id].stopped = true;
    }

    /// Cuts the medium: these stations hear each other, and the others each other. None: it is whole again.
    pub fn cut_off(&mut self, stations: &[StationId]) {
        self.cut_off = stations.to_vec();
    }

    /// Puts a foreign frame on the medium now, as a station outside the network would.
    pub fn inject(&mut self, bytes: &[u8]) {
        let mut frame = Pool::new(1).take().expect("a new pool is full");
        frame.fill(bytes);
        self.air(StationId::MAX, &frame);
    }

    /// Virtual time.
    pub fn now(&self) -> True {
        self.now
    }
    /// What has happened on the medium.
    pub fn traffic(&self) -> &Traffic {
        &self.traffic
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

    /// Lets a station's thread run at true time `at`, and not before.
    fn wake(&mut self, id: StationId, at: True) {
        self.members[id].wakes = Some(at);
        self.agenda.put(at, Action::Turn(id));
    }

    fn turn(&mut self, id: StationId) {
        let (now, random) = (self.now, &mut self.random);
        let seat = &mut self.members[id];
        (seat.wakes, seat.blocked) = (None, false);
        if seat.stopped {
            return;
        }
        seat.note_progress(now);
        let Member { clock, station, host, .. } = &mut seat.member;
        while let Some((at, frame)) = seat.inbox.pop_front() {
            station.on_frame(Some(clock.local(at)), frame);
        }
        let local = clock.local(now);
        station.on_timeout(local);
        if let Some(chosen) = station.next_transmission(local) {
            let at = clock.truth(chosen.at).max(now);
            seat.chosen = Some(chosen);
            self.agenda.put(at, Action::Send(id));
            return;
        }
        let deadline = station.next_deadline();
        seat.blocked = deadline.is_none() || station.discipline().wakes_on_frames();
        if let Some(deadline) = deadline {
            let wake = clock.truth(deadline).max(now) + host.wake_delay(random);
            self.wake(id, wake);
        }
    }

    /// The last act of a transmission: look at the clock, stamp, send, look again.
    fn send(&mut self, id: StationId) {
        let (now, random) = (self.now, &mut self.random);
        let seat = &mut self.members[id];
        let Some(Transmission { mut frame, latest, stamp, .. }) = seat.chosen.take() else { return };
        if seat.stopped {
            return;
        }
        let Member { clock, station, host, .. } = &mut seat.member;
        let before = clock.local(now);
        if before > latest {
            station.on_sent(Sent::Late(before, frame));
            self.wake(id, now);
            return;
        }
        if let Some(stamp) = stamp {
            stamp.write(&mut frame, before);
        }
        let on_wire = now + host.send_delay(random);
        let after = clock.local(on_wire);
        station.on_sent(if after > latest { Sent::StalledUntil(after) } else { Sent::At(before) });
        self.agenda.put(on_wire, Action::Air { from: id, frame });
        self.wake(id, on_wire);
    }

    fn air(&mut self, from: StationId, frame: &[u8]) {
        let air = self.medium.air_time(frame.len());
        let aired = self.traffic.put_on_air(from, self.now, air, frame);
        if let Some(observer) = &mut self.observer {
            observer(&aired);
        }
        let Some((header, _)) = Header::parse(frame) else { return };
        let arrives = self.now + self.medium.propagation.nanos().max(0) as u64;
        for (to, seat) in self.members.iter_mut().enumerate() {
            let addressed = header.destination.is_group() || header.destination == seat.member.address;
            if to == from || !addressed || seat.stopped {
                continue;
            }
            if self.cut_off.contains(&to) != self.cut_off.contains(&from) {
                self.traffic.lost += 1;
                continue;
            }
            if !self.medium.hears(frame, &mut self.random) {
                self.traffic.lost += 1;
                continue;
            }
            match seat.pool.take() {
                Some(mut copy) => {
                    copy.fill(frame);
                    self.agenda.put(arrives, Action::Arrive { to, frame: copy });
                }
                None => seat.dropped += 1,
            }
        }
    }

    fn arrive(&mut self, to: StationId, frame: Buf) {
        let seat = &mut self.members[to];
        seat.inbox.push_back((self.now, frame));
        if std::mem::take(&mut seat.blocked) {
            let wake = self.now + seat.member.host.wake_delay(&mut self.random);
            // The deadline may be nearer.
            let wake = seat.wakes.map_or(wake, |deadline| deadline.min(wake));
            self.wake(to, wake);
        }
    }
}

impl<D: Discipline> Seat<D> {
    fn note_progress(&mut self, now: True) {
        let (since, turns) = self.turns_now;
        self.turns_now = if since == now { (now, turns + 1) } else { (now, 0) };
        assert!(turns < STUCK, "a station takes turn after turn at {now} ns and never waits");
    }
}
