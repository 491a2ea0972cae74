//! The loop of a live station.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crossbeam::queue::ArrayQueue;
use nix::sys::eventfd::EventFd;

use crate::buf::Pool;
use crate::clock::True;
use crate::counters::Refusals;
use crate::discipline::{Cause, Discipline, Event, Sent, SyncState};
use crate::station::Station;
use crate::time::{GlobalTime, Instant, Span};
use crate::wire::ethernet::MTU;

use super::clock::{monotonic, thread_cpu_time};
use super::clock_order::ClockOrder;
use super::errands::Errands;
use super::port::{Port, PortCounters};
use super::time_board::{TimeBoard, TimePublisher};
use super::visit::{NoSockets, Visits};

/// Longest sleep: how soon the loop notices that it is to stop.
const LONGEST_SLEEP: True = 100_000_000;
/// How often a snapshot is published.
const SNAPSHOT_EVERY: True = 100_000_000;
/// Snapshots that wait; with none looked at, the oldest stay. One at every change of state, too.
const SNAPSHOTS: usize = 16;
/// Records that wait for the control thread: a second of what eight slots a millisecond can tell.
const RECORDS: usize = 16_384;

/// Frames that a station with sockets takes in before it chooses a slot's: an answer to what came by then leaves in it.
const BEFORE_A_SLOT: usize = 8;
/// A station that data has woken, and that was awake for it so long, lets data wait for three times that: what floods it
/// takes a quarter of its core, whatever comes. Slots do not wait.
const RESTS: True = 3;
/// Whatever held it up, data waits no longer.
const LONGEST_REST: True = 250_000;

/// What a driver is given besides station and port.
#[derive(Clone)]
pub struct DriverConfig {
    /// Set to end the loop.
    pub stop: Arc<AtomicBool>,
    /// Whether to record the estimate of global time at each transmission, and how late that was.
    pub sample_time: bool,
    /// Becomes readable at every change of state, so that the control thread need not look all the time.
    pub changed: Option<Arc<EventFd>>,
}

/// What the loop tells the control thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Record {
    /// Something happened in a cycle; if something was missed by it, why.
    Event(Event, Option<Cause>),
    /// The station's estimate of global time at a moment of CLOCK_MONOTONIC.
    Time(True, GlobalTime),
    /// How much later than it was to be the last look at the clock before a send was, nanoseconds, sent or not.
    Late(u64),
}

/// A driver's state as the control thread sees it.
#[derive(Clone, Copy, Debug)]
pub struct Snapshot<S> {
    /// When the station had last looked at the clock, CLOCK_MONOTONIC: what it missed until then is told.
    pub at: True,
    /// The discipline's.
    pub status: S,
    /// Frames refused, by reason.
    pub refusals: Refusals,
    /// Frames that missed their slot and were not worth sending later.
    pub stale: u64,
    /// The port's.
    pub port: PortCounters,
    /// Processor time of the real-time thread so far, nanoseconds.
    pub cpu: u64,
    /// Records that found the queue full.
    pub records_lost: u64,
}

/// Drives a station on a port. [`Driver::run`] is the real-time thread.
pub struct Driver<D: Discipline> {
    station: Station<D>,
    port: Port,
    config: DriverConfig,
    records: Arc<ArrayQueue<Record>>,
    snapshots: Arc<ArrayQueue<Snapshot<D::Status>>>,
    errands: Arc<Errands<D::Command, D::Refused>>,
    visits: Arc<Visits>,
    time: TimePublisher,
    clock_order: Arc<ClockOrder>,
    /// The interface's MTU, by the last look of whoever looks.
    mtu: Arc<AtomicUsize>,
    records_lost: u64,
    next_snapshot: True,
    /// The state in the last snapshot.
    shown: SyncState,
    /// Whether it is data that has woken it.
    woken_by_data: bool,
    /// Whether it never waits, where there are no slots to wait for.
    spins: bool,
    /// When this turn looked at what is due, and when it had woken for that.
    looked: True,
    woke: True,
}

impl<D: Discipline> Driver<D> {
    /// A driver that has not started.
    pub fn new(station: Station<D>, port: Port, config: DriverConfig) -> Self {
        let (time, bell) = (TimePublisher::new(*port.clock()), port.bell());
        Self {
            station,
            port,
            config,
            records: Arc::new(ArrayQueue::new(RECORDS)),
            snapshots: Arc::new(ArrayQueue::new(SNAPSHOTS)),
            errands: Arc::new(Errands::new(bell.clone())),
            visits: Arc::new(Errands::new(bell)),
            time,
            clock_order: Arc::default(),
            mtu: Arc::new(AtomicUsize::new(MTU)),
            records_lost: 0,
            next_snapshot: 0,
            shown: SyncState::Waiting,
            woken_by_data: false,
            spins: false,
            looked: 0,
            woke: 0,
        }
    }

    /// The same that never sleeps where it waits for frames, not for slots: it takes a whole core, and neither a frame nor a
    /// program has to wake it. Not for SCHED_FIFO: the kernel would take the core from it for 50 ms of every second.
    pub fn spinning(self, spins: bool) -> Self {
        Self { spins, ..self }
    }

    /// The station, before it runs.
    pub fn station_mut(&mut self) -> &mut Station<D> {
        &mut self.station
    }

    /// Where the loop leaves its records.
    pub fn records(&self) -> Arc<ArrayQueue<Record>> {
        self.records.clone()
    }

    /// Where the loop leaves its snapshots, oldest first.
    pub fn snapshots(&self) -> Arc<ArrayQueue<Snapshot<D::Status>>> {
        self.snapshots.clone()
    }

    /// The way of commands: one is carried out in a turn, after the slot's send.
    pub fn errands(&self) -> Arc<Errands<D::Command, D::Refused>> {
        self.errands.clone()
    }

    /// The way to the station's sockets: one visitor is let in in a turn, after the slot's send.
    pub fn visits(&self) -> Arc<Visits> {
        self.visits.clone()
    }

    /// The buffers that frames are received into.
    pub fn receive_pool(&self) -> Arc<Pool> {
        self.port.pool().clone()
    }

    /// Where the loop shows the time, for every thread of the process that wants to know it or to wait for a cycle.
    pub fn time(&self) -> Arc<TimeBoard> {
        self.time.board()
    }

    /// The way to another clock, for whoever plays what happens to a station's clock.
    pub fn clock_order(&self) -> Arc<ClockOrder> {
        self.clock_order.clone()
    }

    /// Where another thread writes the interface's MTU, whenever that changes: no frame is longer from the next turn on.
    pub fn mtu(&self) -> Arc<AtomicUsize> {
        self.mtu.clone()
    }

    /// Runs until told to stop, then leaves a last snapshot.
    pub fn run(&mut self) {
        while !self.config.stop.load(Ordering::Relaxed) {
            self.turn();
        }
        // What arrived during the last sleep is not lost.
        let Self { station, port, .. } = self;
        port.drain_control(|rx, frame| station.on_frame(rx, frame));
        port.drain_data(|rx, frame| station.on_frame(rx, frame));
        // Nobody publishes again: the oldest snapshot goes if nobody has looked at it.
        let last = self.snapshot();
        self.snapshots.force_push(last);
    }

    /// One turn: drain, choose, send or wait.
    fn turn(&mut self) {
        let for_data = std::mem::take(&mut self.woken_by_data);
        let Self { station, port, .. } = self;
        let wakes_on_frames = station.discipline().wakes_on_frames();
        if !wakes_on_frames {
            port.drain_control(|rx, frame| station.on_frame(rx, frame));
        }
        if let Some(clock) = self.clock_order.take() {
            port.set_clock(clock);
            self.time.set_clock(clock);
        }
        station.set_mtu(self.mtu.load(Ordering::Relaxed));
        if wakes_on_frames {
            // No slot waits: what has come is answered in this turn, before anything else is looked at.
            port.hear(|rx, frame| {
                station.on_frame(rx, frame);
                !station.discipline().has_queued()
            });
        } else if station.stack().is_some() {
            // Half of what it is awake for before the slot: the rest is for choosing, and for being held up.
            let until = station.next_deadline().map(|deadline| deadline + port.spin() / 2);
            port.drain_before(until, BEFORE_A_SLOT, |rx, frame| station.on_frame(rx, frame));
        }
        (self.looked, self.woke) = (monotonic(), port.woke());
        let now = port.clock().local(self.looked);
        station.on_timeout(now);
        if let Some(transmission) = station.next_transmission(now) {
            let sent = port.transmit(transmission);
            let sampled = matches!(sent, Sent::At(_) | Sent::StalledUntil(_));
            if let Sent::Late(at, _) = &sent {
                // What is told of last was judged by that look at the clock.
                (self.looked, self.woke) = (port.clock().truth(*at), port.woke());
            }
            let late = port.late();
            station.on_sent(sent);
            if !wakes_on_frames {
                port.drain_data(|rx, frame| station.on_frame(rx, frame));
            }
            if self.config.sample_time {
                self.record(Record::Late(late));
            }
            self.tell(sampled);
            return;
        }
        // Who was woken by data has taken its share, and has the next one after a rest.
        if !wakes_on_frames && !for_data {
            port.drain_data(|rx, frame| station.on_frame(rx, frame));
        }
        // A visitor may have left something to be sent.
        if !self.tell(false) {
            self.wait(wakes_on_frames, for_data);
        }
    }

    /// Sleeps until there is something to do.
    fn wait(&mut self, wakes_on_frames: bool, was_for_data: bool) {
        let now = monotonic();
        let no_later = now + LONGEST_SLEEP;
        let awake = now.saturating_sub(self.port.woke());
        let rested = if was_for_data { now + rest_after(awake) } else { now };
        let has_sockets = self.station.stack().is_some();
        match self.station.next_deadline() {
            _ if wakes_on_frames && self.spins => self.port.look_again(),
            deadline if wakes_on_frames => self.wait_to_be_rung(deadline, no_later),
            Some(deadline) if has_sockets => {
                self.woken_by_data = self.port.sleep_unless_data(deadline, no_later, rested);
            }
            Some(deadline) => self.port.sleep_until(deadline, no_later),
            None => {
                // Without a slot nothing is urgent, not even a sync.
                self.woken_by_data = has_sockets;
                self.port.rest_until(rested);
                self.wait_to_be_rung(None, no_later);
            }
        }
    }

    /// What a program sends need not wait for a slot: it rings.
    fn wait_to_be_rung(&mut self, deadline: Option<Instant>, no_later: True) {
        match self.station.sleeps(true) {
            true => self.port.look_again(),
            false => self.port.wait_for_frame_until(deadline, no_later),
        }
        self.station.sleeps(false);
    }

    /// Leaves what happened where the control thread finds it. After the slot's send, never before. Tells whether a visitor
    /// was let in.
    fn tell(&mut self, sample_time: bool) -> bool {
        self.station.rest();
        let now = monotonic();
        while let Some(event) = self.station.discipline_mut().next_event() {
            let late = event.kind.is_miss().then(|| self.why_late(event.span));
            self.record(Record::Event(event, event.kind.cause().or(late)));
        }
        // What is shown then is what is after a command.
        let (commanded, visited) = (self.obey(), self.let_in());
        let time = self.station.discipline().time();
        self.time.publish(&time);
        if self.config.sample_time && sample_time && time.state.is_synchronised() {
            // What a program that asks would be told.
            let global = time.to_global(self.port.clock().local(now));
            global.into_iter().for_each(|global| self.record(Record::Time(now, global)));
        }
        let changed = time.state != self.shown;
        let due = now >= self.next_snapshot || changed || commanded;
        // A full queue means that nobody looks: it is tried again. Replacing the oldest would wait for a reader that was
        // preempted in the middle.
        if due && !self.snapshots.is_full() {
            self.shown = time.state;
            self.next_snapshot = now + SNAPSHOT_EVERY;
            let snapshot = self.snapshot();
            let _ = self.snapshots.push(snapshot);
            if let (true, Some(waker)) = (changed, &self.config.changed) {
                // It does not block: one that was not read is readable already.
                let _ = waker.write(1);
            }
        }
        visited
    }

    /// Carries out a command, if there is one. It goes back with what it replaced: nothing is freed here.
    fn obey(&mut self) -> bool {
        let Some(mut errand) = self.errands.next() else { return false };
        errand.result = Some(self.station.discipline_mut().command(self.port.now(), &mut errand.command));
        self.errands.answer(errand);
        true
    }

    /// Lets a visitor see the sockets, if there is one.
    fn let_in(&mut self) -> bool {
        let Some(mut errand) = self.visits.next() else { return false };
        let seen = self.station.stack_mut().map(|(stack, exit)| errand.command.visit(stack, exit));
        errand.result = Some(seen.map(|()| 0).ok_or(NoSockets));
        self.visits.answer(errand);
        true
    }

    /// Why the loop was `late` beyond the last moment when it looked: it had woken after that moment already, or only got
    /// to it later.
    fn why_late(&self, late: Span) -> Cause {
        let last_moment = self.looked.saturating_sub(late.nanos().max(0) as u64);
        if self.woke > last_moment { Cause::TimerLate } else { Cause::Preempted }
    }

    fn record(&mut self, record: Record) {
        if self.records.push(record).is_err() {
            self.records_lost += 1;
        }
    }

    fn snapshot(&mut self) -> Snapshot<D::Status> {
        Snapshot {
            at: self.looked,
            status: self.station.discipline().status(),
            refusals: *self.station.refusals(),
            stale: self.station.stale(),
            port: self.port.counters(),
            cpu: thread_cpu_time(),
            records_lost: self.records_lost,
        }
    }
}

/// How long data waits that comes after some for which the station was awake so long.
fn rest_after(awake: True) -> True {
    awake.saturating_mul(RESTS).min(LONGEST_REST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_takes_a_quarter_of_a_core_at_most_and_is_not_kept_waiting_for_a_hold_up() {
        for (awake, rest) in [(0, 0), (10_000, 30_000), (80_000, 240_000), (4_000_000, 250_000)] {
            assert_eq!(rest_after(awake), rest, "awake for {awake} ns");
        }
    }
}
