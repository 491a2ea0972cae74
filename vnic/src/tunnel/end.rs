//! What tunnels and proxies have in common: two queues between Linux and the station, one pool, and who wakes whom.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, Ordering, fence};

use crossbeam::queue::ArrayQueue;
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Opportunity, Outlet, SendError};
use rtnet::queue::Priority;

use super::counts::Counters;
use super::{AT_ONCE, Loss, Mouth, NON_RT};

/// Frames that are looked at for one turn: those that cannot leave are not worth more of the time before a slot.
pub(crate) const LOOKED_AT: usize = 2 * AT_ONCE;

/// What both ends see.
///
/// Whoever is about to wait says so first, and looks then; whoever has something for it leaves that first, and looks then
/// whether it waits. The fences between keep one of the two from missing the other.
pub(crate) struct Shared {
    pub outward: ArrayQueue<Buf>,
    pub inward: ArrayQueue<Buf>,
    pub pool: Arc<Pool>,
    /// What the slot takes, less RTmac's header where there is one.
    pub mtu: AtomicU16,
    pub counters: Counters,
    /// The station waits to be rung.
    station_sleeps: AtomicBool,
    /// The other end waits for buffers.
    mouth_waits: AtomicBool,
    /// The other end waits for what comes.
    mouth_sleeps: AtomicBool,
}

impl Shared {
    pub fn new(buffers: usize, mtu: usize) -> Self {
        Self {
            outward: ArrayQueue::new(buffers),
            inward: ArrayQueue::new(buffers),
            pool: Arc::new(Pool::new(buffers)),
            mtu: AtomicU16::new(mtu as u16),
            counters: Counters::default(),
            station_sleeps: AtomicBool::new(false),
            mouth_waits: AtomicBool::new(false),
            mouth_sleeps: AtomicBool::new(false),
        }
    }

    /// Whether the station waits to be rung for what was left for it: once for all of it.
    pub fn should_ring(&self) -> bool {
        fence(Ordering::SeqCst);
        !self.outward.is_empty() && is_told(&self.station_sleeps)
    }

    /// Has the station ring once there are buffers again. Tells whether there are some already.
    pub fn wait_for_buffers(&self) -> bool {
        self.mouth_waits.store(true, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        self.has_buffers()
    }

    /// Has the station ring once something has come, or is awake again. Tells whether something has come already.
    pub fn mouth_sleeps(&self, is_asleep: bool) -> bool {
        self.mouth_sleeps.store(is_asleep, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        is_asleep && !self.inward.is_empty()
    }

    /// No more than half of them wait for their turns, and one is at home.
    fn has_buffers(&self) -> bool {
        self.outward.len() <= self.outward.capacity() / 2 && self.pool.lacks(1).is_none()
    }
}

/// Whether it waited, and is told now.
fn is_told(waits: &AtomicBool) -> bool {
    waits.load(Ordering::Relaxed) && waits.swap(false, Ordering::SeqCst)
}

/// What wakes who waits at the mouth, for buffers or for what has come.
pub type Bell = Box<dyn Fn() + Send>;

/// The station's end.
pub(crate) struct End {
    pub shared: Arc<Shared>,
    per_turn: usize,
    bell: Option<Bell>,
    /// There was a turn since it slept last.
    had_turn: bool,
}

impl End {
    /// Across from this mouth.
    pub fn of(mouth: &Mouth) -> Self {
        Self { shared: mouth.shared.clone(), per_turn: mouth.config().per_turn, bell: None, had_turn: false }
    }

    /// The same, which rings for who waits at the mouth: after a slot's send.
    pub fn ringing(self, bell: Bell) -> Self {
        Self { bell: Some(bell), ..self }
    }

    /// A slot is about to come. If what is not real-time may leave in it, so long a payload it takes.
    pub fn poll(&mut self, takes: Option<usize>) {
        if let Some(takes) = takes {
            self.had_turn = true;
            self.shared.mtu.store(takes as u16, Ordering::Relaxed);
        }
    }

    /// Queues for the slot what it takes, each made ready before. Tells how many.
    pub fn fill(
        &mut self,
        slot: &Opportunity,
        out: &mut Outlet<'_>,
        mut make_ready: impl FnMut(&mut Buf) -> Result<(), Loss>,
    ) -> usize {
        let wanted = if slot.non_rt.is_some() { self.per_turn } else { 0 };
        let mut queued = 0;
        for _ in 0..LOOKED_AT {
            let next = (queued < wanted).then(|| self.shared.outward.pop());
            let Some(mut frame) = next.flatten() else { break };
            let done = make_ready(&mut frame).and_then(|()| {
                out(frame, Priority::NON_RT, NON_RT).map_err(|(why, _)| match why {
                    SendError::TooLong { .. } => Loss::TooLong,
                    _ => Loss::NotQueued,
                })
            });
            match done {
                Ok(()) => queued += 1,
                Err(why) => self.shared.counters.lose(why, 1),
            }
        }
        queued
    }

    /// A slot's frame has left: rings for who waits for buffers, once half of them are home, or for what has come.
    pub fn rest(&self) {
        let Some(bell) = &self.bell else { return };
        fence(Ordering::SeqCst);
        let has_buffers = self.shared.has_buffers() && is_told(&self.shared.mouth_waits);
        let has_come = !self.shared.inward.is_empty() && is_told(&self.shared.mouth_sleeps);
        if has_buffers || has_come {
            bell();
        }
    }

    /// The station is about to wait, or is awake again. Tells whether it should not wait: something can leave. Where no turn came
    /// since the last time none comes now, and what waits for one would keep it awake for ever.
    pub fn sleeps(&mut self, is_asleep: bool) -> bool {
        self.shared.station_sleeps.store(is_asleep, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        is_asleep && core::mem::take(&mut self.had_turn) && !self.shared.outward.is_empty()
    }
}
