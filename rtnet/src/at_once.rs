//! Sending without slots: a frame leaves as soon as it is queued. What [`Direct`](crate::direct::Direct) and
//! RTmac's NoMAC have in common.
//!
//! ```text
//! the loop wakes: a frame has come, or it is time ─► services are asked once ─► all that is queued is sent ─► it sleeps
//! ```

use core::convert::Infallible;
use core::marker::PhantomData;

use crate::buf::Buf;
use crate::discipline::{
    Channel, Claimed, Discipline, Event, EventKind, Opportunity, Returned, SendError, Sent, TimeView,
    Transmission,
};
use crate::queue::{Priority, PriorityQueue};
use crate::time::{GlobalTime, Instant, Span};
use crate::wire::ethernet::{self, Header};

/// How often services are asked for frames unless something else wakes the loop: what another thread has left for
/// sending waits no longer. A core takes a few per cent for it.
pub const DEFAULT_ASK_EVERY: Span = Span::from_millis(1);
/// There is no slot that a frame could miss: it is sent after whatever hold-up. An hour, which no clock of ours overflows.
const NEVER_LATE: Span = Span::from_millis(3_600_000);

/// What a way to share the medium without slots says of frames.
pub trait Rules: Send {
    /// Its name in reports.
    const NAME: &'static str;
    /// Whether a frame with this header is its own.
    fn claims(header: &Header) -> bool;
    /// A frame that it claims.
    fn on_frame(frame: Buf) -> Claimed;
    /// Whether a frame may ever leave.
    fn may_leave(frame: &[u8]) -> bool;
    /// How urgent a frame is that was queued with this priority.
    fn level(asked: Priority) -> Priority;
}

/// A station that sends at once, by these rules.
pub struct AtOnce<R: Rules> {
    queue: PriorityQueue,
    ask_every: Span,
    /// When services are asked next, at the latest; none before the first turn.
    next_ask: Option<Instant>,
    asking: Asking,
    /// Where the frame that is being sent was queued.
    pending: Option<(Priority, Channel)>,
    /// At most one for each turn of the loop, which takes it.
    event: Option<Event>,
    status: AtOnceStatus,
    rules: PhantomData<fn() -> R>,
}

/// Services are asked once each time the loop has waited; what they queue then is sent first.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Asking {
    /// The loop is about to wait.
    Waits,
    /// It has woken.
    Due,
    Done,
}

/// What there is to be seen of a station that sends at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct AtOnceStatus {
    /// Times of [`DEFAULT_ASK_EVERY`] since the start, modulo 2^32: what stands for a cycle.
    pub ticks: u32,
    /// Frames sent.
    pub frames_sent: u64,
    /// Frames that the kernel refused, which are gone.
    pub send_failed: u64,
    /// Frames that may never leave.
    pub lethal: u64,
    /// Frames that wait now.
    pub queued: usize,
    /// Events that nobody took in time.
    pub events_lost: u64,
}

impl<R: Rules> AtOnce<R> {
    /// A station that asks its services this often, at least every nanosecond.
    pub fn new(ask_every: Span) -> Self {
        Self {
            queue: PriorityQueue::new(),
            ask_every: ask_every.max(Span::from_nanos(1)),
            next_ask: None,
            asking: Asking::Waits,
            pending: None,
            event: None,
            status: AtOnceStatus::default(),
            rules: PhantomData,
        }
    }

    /// The name of the way it shares the medium.
    pub const fn name(&self) -> &'static str {
        R::NAME
    }

    fn note_failed(&mut self, errno: i32) {
        let (cycle, span) = (self.status.ticks, Span::from_nanos(i64::from(errno)));
        let event = Event { cycle, kind: EventKind::SendFailed, slot: None, span };
        self.status.events_lost += u64::from(self.event.replace(event).is_some());
    }
}

impl<R: Rules> Discipline for AtOnce<R> {
    type Command = Infallible;
    type Refused = Infallible;
    type Status = AtOnceStatus;

    fn claims(&self, header: &Header) -> bool {
        R::claims(header)
    }

    fn on_frame(&mut self, _rx: Option<Instant>, frame: Buf) -> Claimed {
        R::on_frame(frame)
    }

    fn on_timeout(&mut self, now: Instant) {
        let due = *self.next_ask.get_or_insert(now);
        let over = (now - due).nanos();
        if over >= 0 {
            // What was slept through is not made up for.
            let passed = over / self.ask_every.nanos() + 1;
            self.status.ticks = self.status.ticks.wrapping_add(passed as u32);
            self.next_ask = Some(due + self.ask_every * passed);
        }
        if self.asking == Asking::Waits {
            self.asking = Asking::Due;
        }
    }

    fn opportunity(&mut self, now: Instant) -> Option<Opportunity> {
        if self.asking != Asking::Due {
            return None;
        }
        self.asking = Asking::Done;
        // There is no time but its own.
        let scheduled = GlobalTime::from_nanos(now.nanos());
        let non_rt = Some(ethernet::MTU);
        Some(Opportunity { channel: 0, cycle: self.status.ticks, begin: now, scheduled, non_rt })
    }

    fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        let Some((priority, frame)) = self.queue.pop() else {
            if self.asking == Asking::Done {
                self.asking = Asking::Waits;
            }
            return None;
        };
        self.pending = Some((priority, 0));
        Some(Transmission { frame, at: now, latest: now + NEVER_LATE, stamp: None })
    }

    fn on_sent(&mut self, outcome: Sent) -> Option<Returned> {
        let (priority, channel) = self.pending.take()?;
        match outcome {
            Sent::At(_) | Sent::StalledUntil(_) => {
                self.status.frames_sent += 1;
                None
            }
            Sent::Late(_, frame) | Sent::Guarded(_, frame) => Some(Returned { frame, priority, channel }),
            Sent::Failed(errno, frame) => {
                self.status.send_failed += 1;
                self.note_failed(errno);
                Some(Returned { frame, priority, channel })
            }
        }
    }

    fn enqueue(&mut self, frame: Buf, priority: Priority, _ch: Channel) -> Result<(), (SendError, Buf)> {
        if !R::may_leave(&frame) {
            self.status.lethal += 1;
            return Err((SendError::Lethal, frame));
        }
        self.queue.push(R::level(priority), frame);
        Ok(())
    }

    fn has_queued(&self) -> bool {
        !self.queue.is_empty()
    }

    /// Trying again would keep the loop from ever waiting while the interface is down.
    fn tries_again(&self) -> bool {
        false
    }

    fn put_back(&mut self, frame: Returned) {
        self.queue.push_front(frame.priority, frame.frame);
    }

    fn payload_limit(&self, _ch: Channel) -> Result<usize, SendError> {
        Ok(ethernet::MTU)
    }

    fn next_deadline(&self) -> Option<Instant> {
        self.next_ask
    }

    fn wakes_on_frames(&self) -> bool {
        true
    }

    fn time(&self) -> TimeView {
        TimeView::default()
    }

    fn next_event(&mut self) -> Option<Event> {
        self.event.take()
    }

    fn command(&mut self, _now: Instant, command: &mut Infallible) -> Result<u32, Infallible> {
        match *command {}
    }

    fn status(&self) -> AtOnceStatus {
        AtOnceStatus { queued: self.queue.len(), ..self.status }
    }
}
