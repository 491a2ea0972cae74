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
mod end;

use std::sync::Arc;
use std::sync::atomic::Ordering;

use rtmac::tdma::NON_RT_SLOT;
use rtmac::wire::{FLAG_TUNNEL, RTMAC_VERSION};
use rtnet::buf::{Buf, Pool, hand_over};
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, Opportunity, Outlet, Service};
use rtnet::ip::route::Routes;
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{self, Address, EtherType, Header};

pub use counts::{Counts, Loss};
pub use end::Bell;
#[cfg(test)]
pub(crate) use end::LOOKED_AT;
pub(crate) use end::{End, Shared};

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
    (Tunnel(End::of(&mouth)), mouth)
}

/// The station's end: sends what waits in turns that nothing else wants.
pub struct Tunnel(End);

impl Tunnel {
    /// The same, which rings once half of the buffers are home if somebody waits for them: after a slot's send.
    pub fn ringing(self, bell: Bell) -> Self {
        Self(self.0.ringing(bell))
    }
}

impl Service for Tunnel {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::RTMAC
    }

    fn on_frame(&mut self, _rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        Inner::of(&frame).ok_or(Refusal::Truncated)?;
        let own = hand_over(frame, &self.0.shared.pool).map_err(|_| Refusal::PoolEmpty)?;
        // As many have room as there are buffers.
        self.0.shared.inward.push(own).map_err(|_| Refusal::PoolEmpty)?;
        self.0.shared.counters.received();
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, _out: &mut Outlet<'_>) {
        self.0.poll(slot.non_rt.map(|limit| limit.saturating_sub(RTMAC)));
    }

    fn fill(&mut self, slot: &Opportunity, _routes: Option<&Routes>, out: &mut Outlet<'_>) {
        self.0.fill(slot, out, |_| Ok(()));
    }

    fn leaves(&mut self, _slot: &Opportunity, frame: &mut [u8]) {
        if is_tunnelled(frame) {
            self.0.shared.counters.chose(1);
        }
    }

    /// It leaves in the next turn.
    fn still_wanted(&mut self, frame: &[u8], _priority: Priority) -> bool {
        if is_tunnelled(frame) {
            self.0.shared.counters.put_off();
        }
        true
    }

    fn given_up(&mut self, frame: &[u8], _priority: Priority) {
        if is_tunnelled(frame) {
            self.0.shared.counters.lose(Loss::KernelRefused, 1);
        }
    }

    fn rest(&mut self) {
        self.0.rest();
    }

    fn sleeps(&mut self, is_asleep: bool) -> bool {
        self.0.sleeps(is_asleep)
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
        let shared = Shared::new(config.buffers, most);
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
        self.shared.should_ring()
    }

    /// Has the station ring once there are buffers again ([`Tunnel::ringing`]). Tells whether there are some already.
    pub fn wait_for_buffers(&self) -> bool {
        self.shared.wait_for_buffers()
    }

    /// The oldest frame that has come and was not taken, as it came: for [`Inner::of`].
    pub fn received(&self) -> Option<Buf> {
        self.shared.inward.pop()
    }

    /// Has the station ring once something has come, or is awake again. Tells whether something has come already.
    pub fn sleeps(&self, is_asleep: bool) -> bool {
        self.shared.mouth_sleeps(is_asleep)
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
