//! The peer: an independent TDMA station, written from the description of real RTnet stations
//! (sections 2.3 to 2.9 of the protocol reference) and from nothing of ours but the two hooks.
//!
//! Its habits are theirs, not ours: every Synchronisation is taken as it is; a slot whose instant has
//! passed is sent at once; a lost calibration frame is never repeated; the delay is the mean; short
//! frames end in stale bytes; a request for a cycle that has passed is discarded by plain comparison.
//!
//! ```text
//!        ┌──────────────── lap over ────────────────┐
//!        ▼                                          │
//!   wait for the pulse of a Synchronisation,  ──► request ──► slots and replies by offset
//!   or (master) sleep until it is to be sent,
//!   or (backup) until it should have been
//! ```
//!
//! A master that hears another follows it, calibrates in its first slot as a slave does, and from the next cycle
//! on sends Synchronisations itself on the line that it has inherited; a backup stands by.
//!
//! A Synchronisation that arrives during a lap moves the clock, but its pulse is not remembered.

mod backup;
mod calibration;
mod config;
mod status;
mod wire;
mod worker;

use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{
    Channel, Claimed, Discipline, Event, Opportunity, Returned, SendError, Sent, Stamp, SyncState, TimeView,
    Transmission,
};
use rtnet::queue::{Priority, PriorityQueue};
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header};

use backup::Watch;
use calibration::Samples;
pub use config::{PeerConfig, PeerSlot};
pub use status::PeerStatus;
use wire::Tdma;
use worker::{Job, Worker};

/// Whether real stations would take this frame, whose EtherType is RTmac's, for one of TDMA's.
pub fn understands(frame: &[u8]) -> bool {
    wire::decode(frame).is_some()
}

/// A master holds so many requests, and drops more.
const MAX_REQUESTS: usize = 64;
/// "Late" does not exist for these stations.
const EVER: Span = Span::from_millis(1_000 * 3_600);

/// An independent TDMA station.
pub struct Peer {
    config: PeerConfig,
    start_up: StartUp,
    clock: Option<Clock>,
    master: Address,
    delay: Option<Span>,
    samples: Samples,
    watch: Option<Watch>,
    worker: Worker,
    queues: Vec<PriorityQueue>,
    pool: Pool,
    pending: Option<(Job, Priority)>,
    counts: PeerStatus,
}

/// Overwritten by every Synchronisation, without any doubt.
#[derive(Clone, Copy)]
struct Clock {
    cycle: u32,
    start: Instant,
    offset: Offset,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum StartUp {
    Attached,
    Listening(Instant),
    /// A master that sends Synchronisations, or a backup that would.
    InCharge,
    /// A slave, or a master that heard another and is not calibrated yet.
    Following,
}

impl Peer {
    /// A peer that has not yet begun.
    pub fn new(config: PeerConfig) -> Self {
        let following = config.master.is_none();
        Self {
            start_up: if following { StartUp::Following } else { StartUp::Attached },
            clock: None,
            master: Address::BROADCAST,
            delay: (following && config.rounds == 0).then_some(Span::ZERO),
            samples: Samples::default(),
            watch: config.backup.map(Watch::new),
            worker: Worker::new(),
            queues: config.slots.iter().map(|_| PriorityQueue::new()).collect(),
            pool: Pool::new(4),
            pending: None,
            counts: PeerStatus::default(),
            config,
        }
    }

    fn calibrated(&self) -> bool {
        self.delay.is_some()
    }

    fn on_sync(&mut self, rx: Instant, from: Address, cycle: u32, xmit: u64, sched: u64) {
        let delay = self.delay.unwrap_or(Span::ZERO);
        let offset = Offset::between(rx, GlobalTime::from_nanos(xmit) + delay);
        self.clock = Some(Clock { cycle, start: offset.local(GlobalTime::from_nanos(sched)), offset });
        self.master = from;
        if let Some(watch) = &mut self.watch {
            watch.hear();
        }
        if matches!(self.start_up, StartUp::Attached | StartUp::Listening(_)) {
            self.start_up = StartUp::Following;
        }
        if self.start_up == StartUp::Following {
            self.begin_lap(cycle);
        }
    }

    fn on_request(&mut self, rx: Instant, from: Address, request: Tdma) -> Result<(), Refusal> {
        let Tdma::Request { xmit, reply_cycle, reply_offset } = request else { return Ok(()) };
        if self.start_up != StartUp::InCharge {
            return Err(Refusal::NotMaster);
        }
        if self.worker.pending_replies() == MAX_REQUESTS {
            return Err(Refusal::ReplyBacklog);
        }
        let offset = Span::from_nanos(reply_offset as i64);
        self.worker.add_reply(worker::Reply { cycle: reply_cycle, offset, to: from, xmit, reception: rx });
        Ok(())
    }

    fn on_reply(&mut self, rx: Instant, request_xmit: u64, reception: u64, xmit: u64) -> Result<(), Refusal> {
        self.delay = self.samples.reply(rx, request_xmit, reception, xmit, self.config.rounds)?;
        if self.calibrated() && self.config.master.is_some() {
            self.take_charge();
        }
        Ok(())
    }

    /// From the next cycle on this master sends Synchronisations, or looks whether somebody does. What was heard
    /// before tells nothing of that.
    fn take_charge(&mut self) {
        self.start_up = StartUp::InCharge;
        self.watch = self.config.backup.map(Watch::new);
        self.end_lap();
    }

    /// The job the worker sleeps for, and its instant by the clock as it is now.
    fn job(&self) -> Option<(Job, Instant)> {
        let clock = self.clock?;
        if self.worker.is_waiting() {
            let cycle = self.config.master.filter(|_| self.start_up == StartUp::InCharge)?;
            return Some(match &self.watch {
                None => (Job::Sync, clock.start + cycle),
                Some(watch) => (Job::Look, watch.at()),
            });
        }
        let slots = if self.calibrated() { &self.config.slots[..] } else { &[] };
        let asks = !self.calibrated() && !self.samples.waiting;
        let request = self.config.slots.first().filter(|_| asks);
        let (job, offset) = self.worker.next(clock.cycle, request, slots)?;
        Some((job, clock.start + offset))
    }

    /// The job, if it is time to choose its frame.
    fn due(&self, now: Instant) -> Option<(Job, Instant)> {
        self.job().filter(|(job, at)| self.wake(*job, *at) <= now)
    }

    /// A frame is chosen before its instant, but what has not been heard by then only a look at it tells.
    fn wake(&self, job: Job, at: Instant) -> Instant {
        if job == Job::Look { at } else { at - self.config.lead }
    }

    fn begin_lap(&mut self, cycle: u32) {
        self.counts.replies_discarded += self.worker.pulse(cycle);
        self.end_lap_if_over();
    }

    /// Only a worker that waits notices the pulse of a Synchronisation.
    fn end_lap_if_over(&mut self) {
        if self.job().is_none() {
            self.end_lap();
        }
    }

    fn end_lap(&mut self) {
        self.worker.end_lap();
        if let (Some(watch), Some(clock), Some(cycle)) = (&mut self.watch, &self.clock, self.config.master) {
            watch.sleep(clock.start + cycle);
        }
    }

    fn build(&mut self, job: Job, at: Instant) -> Option<Transmission> {
        let (frame, stamp, priority) = match job {
            Job::Slot(i) => {
                let (priority, frame) = self.queues[i].pop()?;
                (frame, None, priority)
            }
            control => {
                let (tdma, to, stamp) = self.control(control)?;
                let mut frame = self.pool.take()?;
                wire::encode(to, self.config.address, &tdma, &mut frame);
                (frame, Some(stamp), Priority::FIRST)
            }
        };
        self.pending = Some((job, priority));
        Some(Transmission { frame, at, latest: at + EVER, stamp })
    }

    fn control(&mut self, job: Job) -> Option<(Tdma, Address, Stamp)> {
        let clock = self.clock.as_mut()?;
        match job {
            Job::Sync => {
                clock.cycle = clock.cycle.wrapping_add(1);
                clock.start += self.config.master?;
                let sched = clock.offset.global(clock.start).nanos();
                let stamp = Stamp { at_byte: wire::SYNC_STAMP, add: clock.offset.nanos(), sum_at: None };
                Some((Tdma::Sync { cycle: clock.cycle, xmit: 0, sched }, Address::BROADCAST, stamp))
            }
            Job::Request => {
                let slot = self.config.slots.first()?;
                self.samples.waiting = true;
                let reply_cycle = clock.cycle.wrapping_add(slot.period);
                let request =
                    Tdma::Request { xmit: 0, reply_cycle, reply_offset: slot.offset.nanos() as u64 };
                Some((request, self.master, Stamp { at_byte: wire::REQUEST_STAMP, add: 0, sum_at: None }))
            }
            Job::Reply(reply) => {
                let (request_xmit, reception) = (reply.xmit, reply.reception.nanos());
                let tdma = Tdma::Reply { request_xmit, reception, xmit: 0 };
                Some((tdma, reply.to, Stamp { at_byte: wire::REPLY_STAMP, add: 0, sum_at: None }))
            }
            Job::Slot(_) | Job::Look => None,
        }
    }

    fn slot(&self, channel: Channel) -> Result<usize, SendError> {
        let defined = self.config.slots.iter().position(|slot| slot.id == channel);
        defined.filter(|_| self.calibrated()).ok_or(SendError::NoSlot(channel))
    }
}

impl Discipline for Peer {
    type Command = ();
    type Refused = &'static str;
    type Status = PeerStatus;

    fn claims(&self, header: &Header) -> bool {
        header.ether_type() == EtherType::RTMAC
    }

    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Claimed {
        let Some((header, _)) = Header::parse(&frame) else { return Claimed::Refused(Refusal::Runt) };
        let Some(rx) = rx else { return Claimed::Refused(Refusal::NoStamp) };
        let heard = match wire::decode(&frame) {
            None => Err(Refusal::Truncated),
            Some(Tdma::Sync { cycle, xmit, sched }) => {
                self.on_sync(rx, header.source, cycle, xmit, sched);
                Ok(())
            }
            Some(request @ Tdma::Request { .. }) => self.on_request(rx, header.source, request),
            Some(Tdma::Reply { request_xmit, reception, xmit }) => {
                self.on_reply(rx, request_xmit, reception, xmit)
            }
        };
        heard.map_or_else(Claimed::Refused, |()| Claimed::Kept)
    }

    fn on_timeout(&mut self, now: Instant) {
        let Some(cycle) = self.config.master else { return };
        match self.start_up {
            StartUp::Attached => {
                self.start_up = StartUp::Listening(now + (cycle * 3).max(Span::from_millis(3)));
            }
            StartUp::Listening(until) if now >= until => {
                self.delay = Some(Span::ZERO);
                self.clock = Some(Clock { cycle: 0, start: now, offset: Offset::default() });
                self.take_charge();
            }
            _ => {}
        }
    }

    fn opportunity(&mut self, now: Instant) -> Option<Opportunity> {
        let (Job::Slot(i), begin) = self.due(now)? else { return None };
        let (slot, clock) = (&self.config.slots[i], self.clock?);
        let scheduled = clock.offset.global(begin);
        Some(Opportunity { channel: slot.id, cycle: clock.cycle, begin, scheduled, non_rt: None })
    }

    fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        let (mut job, at) = self.due(now)?;
        if job == Job::Look {
            if self.watch.as_mut().is_some_and(Watch::look) {
                self.begin_lap(self.clock?.cycle);
                return None;
            }
            job = Job::Sync;
        }
        let built = self.build(job, at);
        match job {
            Job::Sync => self.begin_lap(self.clock?.cycle),
            _ => {
                self.worker.pass(&job, &self.config.slots);
                self.end_lap_if_over();
            }
        }
        built
    }

    fn on_sent(&mut self, outcome: Sent) -> Option<Returned> {
        let (job, priority) = self.pending.take()?;
        match (outcome, job) {
            (Sent::At(_) | Sent::StalledUntil(_), Job::Sync) => self.counts.syncs_sent += 1,
            (Sent::At(_) | Sent::StalledUntil(_), Job::Request) => self.counts.requests_sent += 1,
            (Sent::At(_) | Sent::StalledUntil(_), Job::Reply(_)) => self.counts.replies_sent += 1,
            (Sent::At(_) | Sent::StalledUntil(_), Job::Slot(_)) => self.counts.frames_sent += 1,
            (Sent::Late(_, frame) | Sent::Guarded(_, frame) | Sent::Failed(_, frame), Job::Slot(i)) => {
                return Some(Returned { frame, priority, channel: self.config.slots[i].id });
            }
            _ => {}
        }
        None
    }

    fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        let i = match self.slot(ch) {
            Ok(i) => i,
            Err(error) => return Err((error, frame)),
        };
        let (got, limit) = (frame.len().saturating_sub(HEADER_LEN), self.config.slots[i].size);
        if got > limit {
            return Err((SendError::TooLong { channel: ch, got, limit }, frame));
        }
        self.queues[i].push(priority, frame);
        Ok(())
    }

    fn put_back(&mut self, frame: Returned) {
        let Ok(i) = self.slot(frame.channel) else { return };
        self.queues[i].push_front(frame.priority, frame.frame);
    }

    fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        self.slot(ch).map(|i| self.config.slots[i].size)
    }

    fn next_deadline(&self) -> Option<Instant> {
        match self.start_up {
            StartUp::Attached => Some(Instant::default()),
            StartUp::Listening(until) => Some(until),
            _ => self.job().map(|(job, at)| self.wake(job, at)),
        }
    }

    fn time(&self) -> TimeView {
        let state = match (&self.clock, self.calibrated()) {
            (None, _) => SyncState::Waiting,
            (Some(_), false) => SyncState::Calibrating,
            (Some(_), true) => SyncState::Locked,
        };
        let Some(Clock { cycle, start, offset }) = self.clock else { return TimeView::default() };
        TimeView { state, cycle, start, offset, ..TimeView::default() }
    }

    fn next_event(&mut self) -> Option<Event> {
        None
    }

    fn command(&mut self, _now: Instant, _command: &mut ()) -> Result<u32, &'static str> {
        Err("a peer is configured at its start only")
    }

    fn status(&self) -> PeerStatus {
        PeerStatus { delay: self.delay, ..self.counts }
    }
}
