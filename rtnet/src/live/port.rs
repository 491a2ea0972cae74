//! One interface: a socket that only sends, one for TDMA's control frames, one per EtherType of data.

use std::io;

use socket2::Socket;

use crate::buf::{Buf, Pool};
use crate::clock::{EmulatedClock, True};
use crate::discipline::{Sent, Transmission};
use crate::time::Instant;
use crate::wire::ethernet::EtherType;

use super::clock::{WallClock, monotonic, sleep_until, spin_until};
use super::interface::Interface;
use super::{filter, packet};

/// Buffers for received frames: as many as RTnet's receive ring and transmit descriptors.
const RECEIVE_POOL: usize = 32;
/// Frames taken from one socket in one turn at the most, so that a flood cannot hold up a slot.
const DRAIN_AT_MOST: usize = 32;
/// No undisturbed `send` takes longer than twice this; a first one that was preempted is not believed.
const COST_AT_MOST: True = 5_000;
/// The measured cost of `send` is forgotten by so many nanoseconds a frame, to follow the host.
const COST_AGES: u64 = 2;

/// An interface that a station sends and receives on.
pub struct Port {
    sender: Socket,
    control: Socket,
    data: Vec<Socket>,
    pool: Pool,
    clock: EmulatedClock,
    wall: WallClock,
    /// Whether the wall clock has not stepped since the frames now waiting could have been stamped.
    trusted: bool,
    spin: True,
    send_cost: Option<True>,
    /// When the last sleep ended.
    woke: True,
    counters: PortCounters,
}

/// What a port counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct PortCounters {
    /// Frames received.
    pub received: u64,
    /// Frames longer than a buffer.
    pub oversize: u64,
    /// Turns in which the receive pool was empty.
    pub pool_empty: u64,
    /// Frames that the kernel dropped because a socket's queue was full.
    pub socket_full: u64,
    /// Steps of the wall clock.
    pub clock_steps: u64,
}

impl Port {
    /// Opens the sockets on an interface, for these EtherTypes besides RTmac's. Needs CAP_NET_RAW.
    pub fn open(
        interface: &Interface,
        data: &[EtherType],
        clock: EmulatedClock,
        spin: u64,
    ) -> io::Result<Self> {
        let sender = packet::open()?;
        packet::bind(&sender, interface.index, 0)?;
        let receiver = |ether_type: EtherType| -> io::Result<Socket> {
            let socket = packet::open()?;
            filter::accept_only_ours(&socket)?;
            packet::stamp_received(&socket)?;
            packet::bind(&socket, interface.index, ether_type.0)?;
            Ok(socket)
        };
        Ok(Self {
            sender,
            control: receiver(EtherType::RTMAC)?,
            data: data.iter().copied().map(receiver).collect::<io::Result<_>>()?,
            pool: Pool::new(RECEIVE_POOL),
            clock,
            wall: WallClock::default(),
            trusted: true,
            spin,
            send_cost: None,
            woke: monotonic(),
            counters: PortCounters::default(),
        })
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

    /// What was counted so far. Asks the kernel, too.
    pub fn counters(&mut self) -> PortCounters {
        let sockets = core::iter::once(&self.control).chain(&self.data);
        // A packet socket always has statistics.
        let dropped = sockets.filter_map(|socket| packet::take_dropped(socket).ok());
        self.counters.socket_full += dropped.sum::<u64>();
        PortCounters { clock_steps: self.wall.steps(), ..self.counters }
    }

    /// Hands over the control frames that have arrived, each with its stamp on the station's clock.
    pub fn drain_control(&mut self, mut to: impl FnMut(Option<Instant>, Buf)) {
        self.trusted = self.wall.sample();
        let Self { control, pool, clock, wall, trusted, counters, .. } = self;
        drain(control, pool, counters, |stamp, frame| to(on_clock(stamp, *trusted, clock, wall), frame));
    }

    /// The same for data frames, by the same sample of the wall clock: one a turn, so that a step is
    /// seen before any control frame is trusted.
    pub fn drain_data(&mut self, mut to: impl FnMut(Option<Instant>, Buf)) {
        let Self { data, pool, clock, wall, trusted, counters, .. } = self;
        for socket in data {
            drain(socket, pool, counters, |stamp, frame| to(on_clock(stamp, *trusted, clock, wall), frame));
        }
    }

    /// Waits for a frame of any kind, at most `timeout_ms` milliseconds.
    pub fn wait_for_frame(&self, timeout_ms: i32) {
        packet::wait_any(std::iter::once(&self.control).chain(&self.data), timeout_ms);
    }

    /// Sleeps until the station's clock shows `at`, at most until the true moment `no_later`.
    pub fn sleep_until(&mut self, at: Instant, no_later: True) {
        sleep_until(self.clock.truth(at).min(no_later));
        self.woke = monotonic();
    }

    /// When the last sleep ended.
    pub fn woke(&self) -> True {
        self.woke
    }

    /// Sends a frame at its instant: sleeps, spins, stamps, checks, sends, and looks at the clock again.
    pub fn transmit(&mut self, transmission: Transmission) -> Sent {
        let Transmission { mut frame, at, latest, stamp } = transmission;
        let target = self.clock.truth(at) - self.send_cost.unwrap_or(0);
        let latest = self.clock.truth(latest);
        if monotonic() + self.spin < target {
            sleep_until(target - self.spin);
            self.woke = monotonic();
        }
        let before = spin_until(target);
        let stamped = self.clock.local(before);
        if before > latest {
            return Sent::Late(stamped, frame);
        }
        if let Some(stamp) = stamp {
            stamp.write(&mut frame, stamped);
        }
        if let Err(errno) = packet::send(&self.sender, &frame) {
            return Sent::Failed(errno, frame);
        }
        let after = monotonic();
        self.learn_cost(after - before);
        if after > latest { Sent::StalledUntil(self.clock.local(after)) } else { Sent::At(stamped) }
    }

    /// From the last look at the clock to the wire passes about half of what `send` takes. The smallest
    /// of the last frames counts: what is above it is preemption, which cannot be anticipated.
    fn learn_cost(&mut self, took: True) {
        let half = (took / 2).min(COST_AT_MOST);
        self.send_cost = Some(self.send_cost.map_or(half, |cost| half.min(cost + COST_AGES)));
    }
}

fn on_clock(stamp: Option<u64>, trusted: bool, clock: &EmulatedClock, wall: &WallClock) -> Option<Instant> {
    stamp.filter(|_| trusted).map(|stamp| clock.local(wall.truth(stamp)))
}

fn drain(socket: &Socket, pool: &Pool, counters: &mut PortCounters, mut to: impl FnMut(Option<u64>, Buf)) {
    for _ in 0..DRAIN_AT_MOST {
        let Some(mut buf) = pool.take() else {
            counters.pool_empty += 1;
            return;
        };
        let Some(received) = packet::receive(socket, &mut buf) else { return };
        counters.received += 1;
        if received.truncated {
            counters.oversize += 1;
        } else {
            to(received.stamp, buf);
        }
    }
}

#[cfg(test)]
mod tests;
