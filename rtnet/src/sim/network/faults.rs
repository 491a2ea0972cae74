//! What can be done to a network while it runs.

use super::{Action, Discipline, Network, StationId};
use crate::clock::EmulatedClock;
use crate::sim::latency::nanos;
use crate::sim::link::Link;
use crate::station::Station;
use crate::time::Span;

/// A clock whose rate changes a little from time to time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wander {
    /// How often.
    pub every: Span,
    /// By how much at most, in parts per billion, either way.
    pub step_ppb: i64,
    /// How far its rate may be from `around_ppb`, in parts per billion.
    pub within_ppb: i64,
    /// The rate error that it wanders around.
    pub around_ppb: i64,
}

impl<D: Discipline> Network<D> {
    /// Puts a foreign frame on the medium now, as a station outside the network would.
    pub fn inject(&mut self, bytes: &[u8]) {
        self.babble(StationId::MAX, bytes);
    }

    /// A station's interface sends a frame now, without its station having any part in it.
    pub fn babble(&mut self, id: StationId, bytes: &[u8]) {
        let Some(mut frame) = self.foreign.take() else {
            self.traffic.lost += 1;
            return;
        };
        frame.fill(bytes);
        self.air(id, frame);
    }

    /// Stops a station as a crash would: it sends nothing more and hears nothing more.
    pub fn stop(&mut self, id: StationId) {
        self.members[id].stopped = true;
    }

    /// Puts a new station in the place of one that was stopped, or not: it starts now.
    pub fn restart(&mut self, id: StationId, station: Station<D>) {
        let seat = &mut self.members[id];
        seat.clear(&mut self.frames);
        (seat.stopped, seat.frozen_until, seat.stall, seat.busy_until) = (false, 0, 0, 0);
        seat.member.station = station;
        seat.turn_at(&mut self.agenda, id, self.now);
    }

    /// A station's thread does not run for so long: what arrives meanwhile it finds then.
    pub fn freeze(&mut self, id: StationId, span: Span) {
        let seat = &mut self.members[id];
        seat.frozen_until = seat.frozen_until.max(self.now + nanos(span));
    }

    /// The next frame of a station is held up for so long behind its last look at the clock.
    pub fn stall_next(&mut self, id: StationId, span: Span) {
        self.members[id].stall = nanos(span);
    }

    /// Cuts the medium: these stations hear each other, and the others each other. None: it is whole again.
    pub fn cut_off(&mut self, stations: &[StationId]) {
        self.cut_off = stations.to_vec();
    }

    /// The two directions of a station's wire, to change while the network runs: what it sends by, and what it hears by.
    pub fn wire_mut(&mut self, id: StationId) -> (&mut Link, &mut Link) {
        let [sends_by, hears_by] = self.members[id].wire.links_mut();
        (sends_by, hears_by)
    }

    /// Gives a station another clock from now on. What it waited for it looks for anew, once it is out of a send.
    pub fn set_clock(&mut self, id: StationId, clock: EmulatedClock) {
        let seat = &mut self.members[id];
        seat.set_clock(self.now, clock);
        let waits = !seat.blocked || seat.wakes.is_some();
        if !seat.stopped && seat.chosen.is_none() && waits && seat.busy_until < self.now {
            seat.turn_at(&mut self.agenda, id, self.now);
        }
    }

    /// Lets a station's clock wander from now on, and no longer as before.
    pub fn wander(&mut self, id: StationId, wander: Wander) {
        let seat = &mut self.members[id];
        (seat.wander, seat.wanders) = (Some(wander), seat.wanders + 1);
        self.agenda.put(self.now + nanos(wander.every), Action::Wander(id, seat.wanders));
    }

    /// The rate error of a station's clock, or the one that it wanders around, in parts per billion.
    pub fn rate_around(&self, id: StationId) -> i64 {
        let seat = &self.members[id];
        seat.wander.map_or(seat.member.clock.drift_ppb, |wander| wander.around_ppb)
    }

    /// If a station's clock wanders, it does so around this rate error from now on.
    pub fn wander_around(&mut self, id: StationId, ppb: i64) {
        if let Some(wander) = &mut self.members[id].wander {
            wander.around_ppb = ppb;
        }
    }

    pub(super) fn wander_on(&mut self, id: StationId, number: u32) {
        let (now, seat) = (self.now, &mut self.members[id]);
        let Some(wander) = seat.wander.filter(|_| number == seat.wanders) else { return };
        let Wander { every, step_ppb, within_ppb, around_ppb } = wander;
        let clock = seat.member.clock;
        let drift = clock.drift_ppb + self.random.between(-step_ppb, step_ppb);
        // What it waits for is off by no more than this rate makes of one wait.
        let drift_ppb = drift.clamp(around_ppb - within_ppb, around_ppb + within_ppb);
        seat.set_clock(now, clock.at_rate(now, drift_ppb));
        self.agenda.put(now + nanos(every), Action::Wander(id, number));
    }
}
