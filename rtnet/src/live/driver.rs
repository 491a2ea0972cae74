//! The loop of a live station.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam::queue::ArrayQueue;
use nix::sys::eventfd::EventFd;

use crate::clock::True;
use crate::counters::Refusals;
use crate::discipline::{Cause, Discipline, Event, Sent, SyncState};
use crate::station::Station;
use crate::time::{GlobalTime, Span};

use super::clock::{monotonic, thread_cpu_time};
use super::clock_order::ClockOrder;
use super::errands::Errands;
use super::port::{Port, PortCounters};
use super::time_board::{TimeBoard, TimePublisher};

/// Longest sleep: how soon the loop notices that it is to stop.
const LONGEST_SLEEP: True = 100_000_000;
/// How often a snapshot is published.
const SNAPSHOT_EVERY: True = 100_000_000;
/// Snapshots that wait; with none looked at, the oldest stay. One at every change of state, too.
const SNAPSHOTS: usize = 16;
/// Records that wait for the control thread: a second of what eight slots a millisecond can tell.
const RECORDS: usize = 16_384;

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
    /// When it was taken, CLOCK_MONOTONIC.
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
    time: TimePublisher,
    clock_order: Arc<ClockOrder>,
    records_lost: u64,
    next_snapshot: True,
    /// The state in the last snapshot.
    shown: SyncState,
    /// When this turn looked at what is due, and when it had woken for that.
    looked: True,
    woke: True,
}

impl<D: Discipline> Driver<D> {
    /// A driver that has not started.
    pub fn new(station: Station<D>, port: Port, config: DriverConfig) -> Self {
        let time = TimePublisher::new(*port.clock());
        Self {
            station,
            port,
            config,
            records: Arc::new(ArrayQueue::new(RECORDS)),
            snapshots: Arc::new(ArrayQueue::new(SNAPSHOTS)),
            errands: Arc::new(Errands::new()),
            time,
            clock_order: Arc::default(),
            records_lost: 0,
            next_snapshot: 0,
            shown: SyncState::Waiting,
            looked: 0,
            woke: 0,
        }
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

    /// Where the loop shows the time, for every thread of the process that wants to know it or to wait for a cycle.
    pub fn time(&self) -> Arc<TimeBoard> {
        self.time.board()
    }

    /// The way to another clock, for whoever plays what happens to a station's clock.
    pub fn clock_order(&self) -> Arc<ClockOrder> {
        self.clock_order.clone()
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
        let last = self.snapshot(monotonic());
        self.snapshots.force_push(last);
    }

    /// One turn: drain, choose, send or wait.
    fn turn(&mut self) {
        let Self { station, port, .. } = self;
        port.drain_control(|rx, frame| station.on_frame(rx, frame));
        if let Some(clock) = self.clock_order.take() {
            port.set_clock(clock);
            self.time.set_clock(clock);
        }
        let wakes_on_frames = station.discipline().wakes_on_frames();
        if wakes_on_frames {
            // No slot waits: what has come may be answered in this turn.
            port.drain_data(|rx, frame| station.on_frame(rx, frame));
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
        if !wakes_on_frames {
            port.drain_data(|rx, frame| station.on_frame(rx, frame));
        }
        self.tell(false);
        let no_later = monotonic() + LONGEST_SLEEP;
        match self.station.next_deadline() {
            Some(deadline) if !wakes_on_frames => self.port.sleep_until(deadline, no_later),
            deadline => self.port.wait_for_frame_until(deadline, no_later),
        }
    }

    /// Leaves what happened where the control thread finds it. After the slot's send, never before.
    fn tell(&mut self, sample_time: bool) {
        let now = monotonic();
        while let Some(event) = self.station.discipline_mut().next_event() {
            let late = event.kind.is_miss().then(|| self.why_late(event.span));
            self.record(Record::Event(event, event.kind.cause().or(late)));
        }
        // What is shown then is what is after a command.
        let commanded = self.obey();
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
            let snapshot = self.snapshot(now);
            let _ = self.snapshots.push(snapshot);
            if let (true, Some(waker)) = (changed, &self.config.changed) {
                // It does not block: one that was not read is readable already.
                let _ = waker.write(1);
            }
        }
    }

    /// Carries out a command, if there is one. It goes back with what it replaced: nothing is freed here.
    fn obey(&mut self) -> bool {
        let Some(mut errand) = self.errands.next() else { return false };
        errand.result = Some(self.station.discipline_mut().command(self.port.now(), &mut errand.command));
        self.errands.answer(errand);
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

    fn snapshot(&mut self, now: True) -> Snapshot<D::Status> {
        Snapshot {
            at: now,
            status: self.station.discipline().status(),
            refusals: *self.station.refusals(),
            stale: self.station.stale(),
            port: self.port.counters(),
            cpu: thread_cpu_time(),
            records_lost: self.records_lost,
        }
    }
}
