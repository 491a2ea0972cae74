//! Frames that are not real-time, each inside an RTmac frame, in turns that nothing real-time wants.
//!
//! ```text
//!            Mouth                                 Tunnel, a service of the station
//!  Linux ──► send_frame, send_packet ── outward ──► fill ──► slot 1 or its alias, priority 31, one frame a turn
//!  Linux ◄── received ◄──────────────── inward ◄── on_frame ◄── an RTmac frame with the tunnel flag, for a buffer of the pool
//!
//!  0            6            12       14      16      17      18
//!  +------------+------------+--------+-------+-------+-------+------------------------
//!  | destination| source     | 0x9021 | inner |version| flags | inner payload, up to the slot's size less 4
//!  |            | the station|        | type  | 2     | 1     |
//!  +------------+------------+--------+-------+-------+-------+------------------------
//! ```
//!
//! All buffers are of one pool, as in RTnet: what waits for a turn is bounded by it, and who sends waits for one to come
//! home. Live, what comes for a station's tunnel does not go through its real-time thread: the thread behind the device
//! has a socket of its own for it ([`tun`](crate::tun)), and unwraps it by [`Inner::of`], too.

mod counts;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, Ordering, fence};

use crossbeam::queue::ArrayQueue;
use rtmac::tdma::NON_RT_SLOT;
use rtmac::wire::{FLAG_TUNNEL, RTMAC_VERSION};
use rtnet::buf::{Buf, Pool, hand_over};
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, Opportunity, Outlet, SendError, Service};
use rtnet::ip::route::Routes;
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{self, Address, EtherType, Header};

pub(crate) use counts::Counters;
pub use counts::{Counts, Loss};

use crate::proxy;

/// Bytes before the inner payload: the Ethernet header and RTmac's.
pub const HEAD: usize = ethernet::HEADER_LEN + RTMAC;
/// Where an Ethernet frame is put that is to be wrapped: its payload is where it stays.
pub const FRAME: usize = RTMAC;
/// Largest inner payload, in a slot of the largest size.
pub const MTU: usize = ethernet::MTU - RTMAC;
/// Smallest that a device may be set to, as in RTnet.
pub const LEAST_MTU: usize = 68;
/// Buffers of a tunnel unless it is said otherwise, as in RTnet.
pub const DEFAULT_BUFFERS: usize = 32;
/// Frames for one turn where there are no slots: so many leave before the station looks up again.
pub const AT_ONCE: usize = 16;
/// Bytes of RTmac's header.
const RTMAC: usize = 4;
/// An Ethernet header's addresses, and where its type is.
const TYPE: usize = 12;

/// What a tunnel is to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// The station's address: the source of all that it tunnels.
    pub address: Address,
    /// Buffers, for both directions together.
    pub buffers: usize,
    /// Frames that leave in a turn: one in a slot.
    pub per_turn: usize,
    /// Whether frames keep the source that they come with, for hosts behind the device. RTnet's never do.
    pub keeps_source: bool,
}

impl Config {
    /// That of a station with this address in slots, and else as usual.
    pub fn of(address: Address) -> Self {
        Self { address, buffers: DEFAULT_BUFFERS, per_turn: 1, keeps_source: false }
    }
}

/// A tunnel: the station's end, and the other one.
pub fn new(config: Config) -> (Tunnel, Mouth) {
    let mouth = Mouth::new(config, false);
    let tunnel = Tunnel { shared: mouth.shared.clone(), per_turn: config.per_turn, bell: None };
    (tunnel, mouth)
}

/// What both ends see.
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

/// What wakes who waits at the mouth for buffers.
pub type Bell = Box<dyn Fn() + Send>;

/// The station's end: sends what waits in turns that nothing else wants.
pub struct Tunnel {
    shared: Arc<Shared>,
    per_turn: usize,
    bell: Option<Bell>,
}

impl Tunnel {
    /// The same, which rings once half of the buffers are home if somebody waits for them: after a slot's send.
    pub fn ringing(self, bell: Bell) -> Self {
        Self { bell: Some(bell), ..self }
    }
}

impl Service for Tunnel {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::RTMAC
    }

    fn on_frame(&mut self, _rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        Inner::of(&frame).ok_or(Refusal::Truncated)?;
        let own = hand_over(frame, &self.shared.pool).map_err(|_| Refusal::PoolEmpty)?;
        // As many have room as there are buffers.
        self.shared.inward.push(own).map_err(|_| Refusal::PoolEmpty)?;
        self.shared.counters.received();
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, _out: &mut Outlet<'_>) {
        if let Some(limit) = slot.non_rt {
            self.shared.mtu.store(limit.saturating_sub(RTMAC) as u16, Ordering::Relaxed);
        }
    }

    fn fill(&mut self, slot: &Opportunity, _routes: Option<&Routes>, out: &mut Outlet<'_>) {
        let mut left = if slot.non_rt.is_some() { self.per_turn } else { 0 };
        while left > 0
            && let Some(frame) = self.shared.outward.pop()
        {
            match out(frame, Priority::NON_RT, NON_RT) {
                Ok(()) => left -= 1,
                Err((SendError::TooLong { .. }, _)) => self.shared.counters.lose(Loss::TooLong, 1),
                Err(_) => self.shared.counters.lose(Loss::NotQueued, 1),
            }
        }
    }

    fn leaves(&mut self, _slot: &Opportunity, frame: &mut [u8]) {
        if is_tunnelled(frame) {
            self.shared.counters.sent();
        }
    }

    /// It leaves in the next turn.
    fn still_wanted(&mut self, frame: &[u8], _priority: Priority) -> bool {
        if is_tunnelled(frame) {
            self.shared.counters.put_off();
        }
        true
    }

    fn rest(&mut self) {
        self.shared.rest(self.bell.as_ref());
    }

    fn sleeps(&mut self, is_asleep: bool) -> bool {
        self.shared.sleeps(is_asleep)
    }
}

impl Shared {
    /// A slot's frame has left: rings for who waits for buffers, once half of them are home, or for what has come.
    pub fn rest(&self, bell: Option<&Bell>) {
        let Some(bell) = bell else { return };
        let is_told =
            |waits: &AtomicBool| waits.load(Ordering::Relaxed) && waits.swap(false, Ordering::SeqCst);
        let has_buffers = self.outward.len() <= self.outward.capacity() / 2 && is_told(&self.mouth_waits);
        let has_come = !self.inward.is_empty() && {
            // Either it is seen here that the other end sleeps, or over there that something has come.
            fence(Ordering::SeqCst);
            is_told(&self.mouth_sleeps)
        };
        if has_buffers || has_come {
            bell();
        }
    }

    /// The station is about to wait, or is awake again. Tells whether it should not wait.
    pub fn sleeps(&self, is_asleep: bool) -> bool {
        self.station_sleeps.store(is_asleep, Ordering::SeqCst);
        // Either it is seen here that something waits, or over there that this end sleeps.
        fence(Ordering::SeqCst);
        is_asleep && !self.outward.is_empty()
    }
}

/// The other end: what Linux sends goes in here, and what comes for it is found here. For one thread.
pub struct Mouth {
    pub(crate) shared: Arc<Shared>,
    config: Config,
    /// A proxy's, not a tunnel's.
    is_proxy: bool,
}

impl Mouth {
    pub(crate) fn new(config: Config, is_proxy: bool) -> Self {
        let most = if is_proxy { proxy::MTU } else { MTU };
        let shared = Shared {
            outward: ArrayQueue::new(config.buffers),
            inward: ArrayQueue::new(config.buffers),
            pool: Arc::new(Pool::new(config.buffers)),
            mtu: AtomicU16::new(most as u16),
            counters: Counters::default(),
            station_sleeps: AtomicBool::new(false),
            mouth_waits: AtomicBool::new(false),
            mouth_sleeps: AtomicBool::new(false),
        };
        Self { shared: Arc::new(shared), config, is_proxy }
    }

    /// An empty buffer for what is to be sent; none while all wait for their turns, or to be read.
    pub fn take(&self) -> Option<Buf> {
        self.shared.pool.take()
    }

    /// Sends the Ethernet frame of `len` bytes that begins at [`FRAME`] of the buffer's room.
    pub fn send_frame(&self, mut frame: Buf, len: usize) -> Result<(), Loss> {
        let room = frame.room_mut();
        let bytes = room[FRAME..].get(..len);
        let Some((header, _)) = bytes.and_then(Header::parse) else {
            return Err(self.lose(if len < ethernet::HEADER_LEN { Loss::Short } else { Loss::TooLong }));
        };
        let (destination, source, kind) = (header.destination, header.source, header.ether_type());
        let source = if self.config.keeps_source { source } else { self.config.address };
        self.send(frame, len - ethernet::HEADER_LEN, [destination, source], kind)
    }

    /// Sends the packet of `len` bytes that begins at [`HEAD`] of the buffer's room to a station, or to all.
    pub fn send_packet(&self, packet: Buf, len: usize, to: Address, kind: EtherType) -> Result<(), Loss> {
        self.send(packet, len, [to, self.config.address], kind)
    }

    fn send(&self, mut frame: Buf, len: usize, addresses: [Address; 2], kind: EtherType) -> Result<(), Loss> {
        if len > self.mtu() {
            return Err(self.lose(Loss::TooLong));
        }
        let [Address(destination), Address(source)] = addresses;
        let room = frame.room_mut();
        room[..6].copy_from_slice(&destination);
        room[6..TYPE].copy_from_slice(&source);
        room[TYPE..TYPE + 2].copy_from_slice(&EtherType::RTMAC.0.to_be_bytes());
        room[TYPE + 2..HEAD - 2].copy_from_slice(&kind.0.to_be_bytes());
        room[HEAD - 2..HEAD].copy_from_slice(&[RTMAC_VERSION, FLAG_TUNNEL]);
        self.leave(frame, HEAD + len)
    }

    /// Leaves a frame of `len` bytes where the station finds it.
    pub(crate) fn leave(&self, mut frame: Buf, len: usize) -> Result<(), Loss> {
        frame.set_len(len);
        frame.pad_to(ethernet::MIN_FRAME);
        // As many have room as there are buffers.
        self.shared.outward.push(frame).map_err(|_| self.lose(Loss::NotQueued))
    }

    /// Whether the station waits to be rung for what was sent: once for all of it.
    pub fn should_ring(&self) -> bool {
        fence(Ordering::SeqCst);
        let asleep = &self.shared.station_sleeps;
        !self.shared.outward.is_empty()
            && asleep.load(Ordering::Relaxed)
            && asleep.swap(false, Ordering::SeqCst)
    }

    /// Has the station ring once there are buffers again ([`Tunnel::ringing`]). Tells whether there are some already.
    pub fn wait_for_buffers(&self) -> bool {
        self.shared.mouth_waits.store(true, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        self.shared.outward.len() <= self.shared.outward.capacity() / 2
    }

    /// The oldest frame that has come and was not taken, as it came: for [`Inner::of`].
    pub fn received(&self) -> Option<Buf> {
        self.shared.inward.pop()
    }

    /// Has the station ring once something has come, or is awake again. Tells whether something has come already.
    pub fn sleeps(&self, is_asleep: bool) -> bool {
        self.shared.mouth_sleeps.store(is_asleep, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        is_asleep && !self.shared.inward.is_empty()
    }

    /// Whether it is a [`proxy`]'s, or a tunnel's.
    pub fn is_proxy(&self) -> bool {
        self.is_proxy
    }

    /// The largest payload that ever goes through.
    pub fn most(&self) -> usize {
        if self.is_proxy { proxy::MTU } else { MTU }
    }

    /// The largest inner payload that the slot takes now.
    pub fn mtu(&self) -> usize {
        self.shared.mtu.load(Ordering::Relaxed).into()
    }

    /// Counts what is lost at this end, and gives the reason back.
    pub fn lose(&self, why: Loss) -> Loss {
        self.lose_many(why, 1);
        why
    }

    /// Counts so many.
    pub fn lose_many(&self, why: Loss, n: u64) {
        self.shared.counters.lose(why, n);
    }

    /// Counts a frame that came for Linux and did not go through the station.
    pub fn count_received(&self) {
        self.shared.counters.received();
    }

    /// Of both directions.
    pub fn pool(&self) -> &Arc<Pool> {
        &self.shared.pool
    }

    /// What went through, and what did not.
    pub fn counts(&self) -> Counts {
        self.shared.counters.now()
    }

    /// What it was made as.
    pub fn config(&self) -> &Config {
        &self.config
    }
}

/// What is inside a tunnelled frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Inner<'a> {
    frame: &'a [u8],
}

impl<'a> Inner<'a> {
    /// What is inside `frame`, whose EtherType, version and flag were seen by who received it; `None` where it is too short.
    pub fn of(frame: &'a [u8]) -> Option<Self> {
        (frame.len() >= HEAD).then_some(Self { frame })
    }

    /// Its type.
    pub fn kind(&self) -> EtherType {
        EtherType(u16::from_be_bytes([self.frame[TYPE + 2], self.frame[TYPE + 3]]))
    }

    /// Its payload, with what it was padded by: nothing tells how long it was.
    pub fn payload(&self) -> &'a [u8] {
        &self.frame[HEAD..]
    }

    /// The frame as it was before it was wrapped, in pieces: addresses, type, payload.
    pub fn pieces(&self) -> [&'a [u8]; 3] {
        [&self.frame[..TYPE], &self.frame[TYPE + 2..HEAD - 2], self.payload()]
    }
}

/// The slot of everything that is not real-time, or its alias.
pub(crate) const NON_RT: Channel = NON_RT_SLOT;

/// Whether a frame of a station's own is one of its tunnel's.
fn is_tunnelled(frame: &[u8]) -> bool {
    let is_rtmac = Header::parse(frame).is_some_and(|(header, _)| header.ether_type() == EtherType::RTMAC);
    is_rtmac && rtmac::wire::head(frame).is_ok_and(|(head, _)| head.is_tunnel())
}

#[cfg(test)]
mod tests;
