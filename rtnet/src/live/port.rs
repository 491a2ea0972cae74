//! One interface: a socket that only sends, one for TDMA's control frames, one per EtherType of data, or one for all.

mod receive;
mod wait;

use std::io;
use std::sync::Arc;

use nix::sys::eventfd::{EfdFlags, EventFd};
use socket2::Socket;

use crate::buf::{Buf, Pool};
use crate::clock::{EmulatedClock, True};
use crate::discipline::{Sent, Stamp, Transmission};
use crate::time::{Instant, Span};
use crate::wire::ethernet::EtherType;

use super::alarm::Alarm;
use super::bells::{Bells, PLACES, THE_ALARM};
use super::clock::{WallClock, monotonic, sleep_until, spin_until};
use super::guard::{self, Guard, GuardMode, GuardRefused, MARK};
use super::interface::Interface;
use super::{filter, packet, rights};
use receive::{DRAIN_AT_MOST, Inlet, drain, on_clock, receiver};

pub use receive::Data;

/// Buffers for received frames, unless it is said otherwise: as many as RTnet's receive ring and transmit descriptors.
pub const RECEIVE_POOL: usize = 32;
/// So long before it has to be awake data wakes nobody: several times what waking for it and looking at it take.
const UNDISTURBED: True = 100_000;
/// No undisturbed `send` takes longer than twice this; a first one that was preempted is not believed.
const COST_AT_MOST: True = 5_000;
/// EtherTypes that a port hears at the most, each by a socket of its own: the first place is that of RTmac's frames.
pub const ETHER_TYPES_AT_MOST: usize = PLACES - 1;
/// The measured cost of `send` is forgotten by so many nanoseconds a frame, to follow the host.
const COST_AGES: u64 = 2;

/// An interface that a station sends and receives on.
pub struct Port {
    sender: Socket,
    control: Inlet,
    data: Vec<Inlet>,
    pool: Arc<Pool>,
    clock: EmulatedClock,
    wall: WallClock,
    /// Whether the wall clock has not stepped since the frames now waiting could have been stamped.
    trusted: bool,
    spin: True,
    send_cost: Option<True>,
    /// When the last sleep ended.
    woke: True,
    /// How much later than it was to be its last look at the clock before a send was, nanoseconds.
    late: u64,
    guard: Option<Guard>,
    guard_refused: Option<String>,
    /// Others are kept off the interface.
    is_alone: bool,
    hold: Option<fn()>,
    /// What other threads of the process ring.
    bell: Arc<EventFd>,
    alarm: Alarm,
    /// What ends a wait for frames: all of them. Each wait of `ppoll` would ask them all, twice.
    bells: Bells,
    /// Sockets that were found empty since the last wait for frames began, a bit for each place: the lowest is for control.
    empty: u64,
    /// How often they were to be asked again without a wait.
    looks: u32,
    counters: PortCounters,
}

/// Why a port could not be opened, on which interface, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The kernel gives no packet sockets.
    #[error("packet sockets on '{0}' ({remedy})", remedy = rights::remedy(&["CAP_NET_RAW"]))]
    Sockets(String, #[source] io::Error),
    /// More EtherTypes than a port has sockets for.
    #[error(
        "'{0}' cannot be heard for {1} EtherTypes one by one: {ETHER_TYPES_AT_MOST} at the most (hear all, `Data::All`)"
    )]
    TooMany(String, usize),
    /// There can be no guard, and it is not to go without.
    #[error("kernel guard on '{0}' ({remedy}; or go without)", remedy = .1.remedy())]
    Guard(String, #[source] GuardRefused),
}

/// What a port counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct PortCounters {
    /// Frames received.
    pub received: u64,
    /// Frames longer than a buffer.
    pub oversize: u64,
    /// Frames that came as one and were cut into those that were meant.
    pub uncut: u64,
    /// The same of a kind that nobody here cuts: they are dropped.
    pub not_cut: u64,
    /// Turns in which the receive pool was empty.
    pub pool_empty: u64,
    /// Frames that the kernel dropped because a socket's queue was full.
    pub socket_full: u64,
    /// Steps of the wall clock.
    pub clock_steps: u64,
    /// Frames of other programs that the guard has seen leave the interface...
    pub others_passed: u64,
    /// ... or has kept from it.
    pub others_kept_off: u64,
}

impl Port {
    /// Opens the sockets on an interface, for this data besides RTmac's frames. Needs CAP_NET_RAW; for a
    /// guard CAP_BPF and CAP_NET_ADMIN, too.
    pub fn open<'a>(
        interface: &Interface,
        data: impl Into<Data<'a>>,
        clock: EmulatedClock,
        spin: u64,
        guard: GuardMode,
    ) -> Result<Self, OpenError> {
        let data = data.into();
        if let Data::Only(only) = data
            && only.len() > ETHER_TYPES_AT_MOST
        {
            return Err(OpenError::TooMany(interface.name.clone(), only.len()));
        }
        let mut port = Self::unguarded(interface, data, clock, spin)
            .map_err(|error| OpenError::Sockets(interface.name.clone(), error))?;
        if guard == GuardMode::User {
            return Ok(port);
        }
        match port.attach_guard(interface) {
            Ok(attached) => port.guard = Some(attached),
            Err(refused) if guard == GuardMode::Kernel => {
                return Err(OpenError::Guard(interface.name.clone(), refused));
            }
            Err(refused) => {
                port.guard_refused = Some(format!(
                    "kernel guard: {refused}: what is held up between the last look at the clock and the wire \
                     leaves late ({})",
                    refused.remedy()
                ));
            }
        }
        Ok(port)
    }

    fn unguarded(interface: &Interface, data: Data<'_>, clock: EmulatedClock, spin: u64) -> io::Result<Self> {
        // PACKET_QDISC_BYPASS would be a way past the guard: it is not set.
        let sender = packet::open()?;
        packet::bind(&sender, interface.index, 0)?;
        let control = receiver(interface, EtherType::RTMAC.0, filter::accept_only_our_control)?;
        let (data, alarm) = (receive::data(interface, data)?, Alarm::new()?);
        let bells = Bells::new()?;
        for (place, socket) in (0..).zip(core::iter::once(&control).chain(&data)) {
            bells.watch(socket, place)?;
        }
        bells.watch(&alarm, THE_ALARM)?;
        let bell = EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC)?;
        bells.hang(&bell)?;
        Ok(Self {
            sender,
            control,
            data,
            pool: Arc::new(Pool::new(RECEIVE_POOL)),
            clock,
            wall: WallClock::default(),
            trusted: true,
            spin,
            send_cost: None,
            woke: monotonic(),
            late: 0,
            guard: None,
            guard_refused: None,
            is_alone: false,
            hold: None,
            bell: Arc::new(bell),
            alarm,
            bells,
            empty: 0,
            looks: 0,
            counters: PortCounters::default(),
        })
    }

    /// Marked once, so that the guard knows this port's frames at no cost for each.
    fn attach_guard(&self, interface: &Interface) -> Result<Guard, GuardRefused> {
        let guard = Guard::attach(interface.index)?;
        // Not before: without a guard a mark would only meet what a killed station left.
        self.sender.set_mark(MARK).map_err(|error| GuardRefused::new(guard::Step::Mark, error))?;
        Ok(guard)
    }

    /// Whether the kernel enforces `latest`.
    pub fn is_guarded(&self) -> bool {
        self.guard.is_some()
    }

    /// From now on what is tunnelled to this station is another socket's ([`Tunnelled`](super::Tunnelled)).
    pub fn leave_tunnelled(&mut self) -> io::Result<()> {
        filter::accept_only_discipline(&self.control)?;
        // What has come already is let go, as if it had come before: what is tunnelled of it has nobody here to take it.
        let mut uncounted = PortCounters::default();
        while drain(&mut self.control, &self.pool, &mut uncounted, DRAIN_AT_MOST, |_, _| ()) == DRAIN_AT_MOST
        {
        }
        Ok(())
    }

    /// From now on the guard, if there is one, drops the frames of all other programs on the interface.
    pub fn keep_others_off(&mut self) {
        if let Some(guard) = &self.guard {
            guard.keep_others_off();
            self.is_alone = true;
        }
    }

    /// Why there is no guard though there was to be one if possible: one line, what, why, what it costs.
    pub fn guard_refused(&self) -> Option<&str> {
        self.guard_refused.as_deref()
    }

    /// From now on does this between the last look at the clock and `send`, where a station that is held up
    /// cannot notice it: for tests.
    #[doc(hidden)]
    pub fn hold_before_send(&mut self, hold: fn()) {
        self.hold = Some(hold);
    }

    /// What the station's clock shows now.
    #[inline]
    pub fn now(&self) -> Instant {
        self.clock.local(monotonic())
    }

    /// The station's clock.
    pub fn clock(&self) -> &EmulatedClock {
        &self.clock
    }

    /// How long before its instant a frame is spun for.
    pub(super) fn spin(&self) -> Span {
        Span::from_nanos(self.spin as i64)
    }

    /// Gives the station another clock: what comes from now on is stamped by it.
    pub(super) fn set_clock(&mut self, clock: EmulatedClock) {
        self.clock = clock;
    }

    /// The buffers that frames are received into.
    pub fn pool(&self) -> &Arc<Pool> {
        &self.pool
    }

    /// What was counted so far. Asks the kernel, too.
    pub fn counters(&mut self) -> PortCounters {
        let sockets = core::iter::once(&self.control).chain(&self.data);
        // A packet socket always has statistics.
        let dropped = sockets.filter_map(|inlet| packet::take_dropped(&**inlet).ok());
        self.counters.socket_full += dropped.sum::<u64>();
        let others = self.guard.as_ref().map_or(0, |guard| guard.counters().others);
        let (others_passed, others_kept_off) = if self.is_alone { (0, others) } else { (others, 0) };
        PortCounters { clock_steps: self.wall.steps(), others_passed, others_kept_off, ..self.counters }
    }

    /// Hands over the control frames that have arrived, each with its stamp on the station's clock.
    pub fn drain_control(&mut self, mut to: impl FnMut(Option<Instant>, Buf)) {
        self.trusted = self.wall.sample();
        let Self { control, pool, clock, wall, trusted, counters, .. } = self;
        let to = |stamp, frame| to(on_clock(stamp, *trusted, clock, wall), frame);
        drain(control, pool, counters, DRAIN_AT_MOST, to);
    }

    /// The same for data frames, by the same sample of the wall clock: one a turn, so that a step is
    /// seen before any control frame is trusted.
    pub fn drain_data(&mut self, mut to: impl FnMut(Option<Instant>, Buf)) {
        let Self { data, pool, clock, wall, trusted, counters, .. } = self;
        for socket in data {
            let to = |stamp, frame| to(on_clock(stamp, *trusted, clock, wall), frame);
            drain(socket, pool, counters, DRAIN_AT_MOST, to);
        }
    }

    /// The same for what came before a slot whose frame is about to be chosen: so many at the most, and none is begun with
    /// once the station's clock shows `until`.
    pub fn drain_before(
        &mut self,
        until: Option<Instant>,
        most: usize,
        mut to: impl FnMut(Option<Instant>, Buf),
    ) {
        let Self { data, pool, clock, wall, trusted, counters, .. } = self;
        let until = until.map_or(True::MAX, |until| clock.truth(until));
        let mut left = most;
        for socket in data {
            while left > 0 && monotonic() < until {
                let received = drain(socket, pool, counters, 1, |stamp, frame| {
                    to(on_clock(stamp, *trusted, clock, wall), frame);
                });
                if received == 0 {
                    break;
                }
                left -= received;
            }
        }
    }

    /// Where bells can be hung that end [`Self::wait_for_frame_until`]: what a program rings when it has something to be sent.
    pub fn bells(&self) -> Bells {
        self.bells.clone()
    }

    /// What ends [`Self::wait_for_frame_until`] from any thread of the process, by being written. A loop that waits for a
    /// slot does not hear it.
    pub fn bell(&self) -> Arc<EventFd> {
        self.bell.clone()
    }

    /// The same with so many buffers for received frames.
    pub fn with_receive_buffers(self, buffers: usize) -> Self {
        Self { pool: Arc::new(Pool::new(buffers)), ..self }
    }

    /// How much later than it was to be its last look at the clock before a send was, nanoseconds: the wake-up
    /// latency, as far as a slot feels it.
    pub fn late(&self) -> u64 {
        self.late
    }

    /// Sends a frame at its instant: sleeps, spins, stamps, checks, sends, and looks at the clock again.
    pub fn transmit(&mut self, transmission: Transmission) -> Sent {
        let Transmission { frame, at, latest, stamp } = transmission;
        let (at, latest) = (self.clock.truth(at), self.clock.truth(latest));
        let target = at - self.send_cost.unwrap_or(0);
        if monotonic() < target {
            // More may have come by then: who sends one frame after another does not wait in between.
            self.empty = 0;
        }
        if monotonic() + self.spin < target {
            sleep_until(target - self.spin);
            self.woke = monotonic();
        }
        if let Some(guard) = &self.guard {
            // Nothing is sent while it spins: what is early by more than that is not of this slot.
            guard
                .open(target.saturating_sub(self.spin), latest + guard::tolerance(latest.saturating_sub(at)));
        }
        let sent = self.send_at(target, latest, stamp, frame);
        if let Some(guard) = &self.guard {
            guard.close();
        }
        sent
    }

    fn send_at(&mut self, target: True, latest: True, stamp: Option<Stamp>, mut frame: Buf) -> Sent {
        let drops = self.drops();
        let before = spin_until(target);
        self.late = before.saturating_sub(target);
        let stamped = self.clock.local(before);
        if before > latest {
            return Sent::Late(stamped, frame);
        }
        if let Some(stamp) = stamp {
            stamp.write(&mut frame, stamped);
        }
        if let Some(hold) = self.hold {
            hold();
        }
        match packet::send(&self.sender, &frame) {
            Ok(()) => {}
            // The kernel says the same of a full queue: only the guard's own count tells.
            Err(libc::ENOBUFS) if self.drops() != drops => return Sent::Guarded(self.now(), frame),
            Err(errno) => return Sent::Failed(errno, frame),
        }
        let after = monotonic();
        self.learn_cost(after - before);
        if after > latest { Sent::StalledUntil(self.clock.local(after)) } else { Sent::At(stamped) }
    }

    /// Frames that the guard has dropped.
    #[inline]
    fn drops(&self) -> u64 {
        self.guard.as_ref().map_or(0, Guard::drops)
    }

    /// From the last look at the clock to the wire passes about half of what `send` takes. The smallest
    /// of the last frames counts: what is above it is preemption, which cannot be anticipated.
    fn learn_cost(&mut self, took: True) {
        let half = (took / 2).min(COST_AT_MOST);
        self.send_cost = Some(self.send_cost.map_or(half, |cost| half.min(cost + COST_AGES)));
    }
}

#[cfg(test)]
mod tests;
