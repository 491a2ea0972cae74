//! One IP address for the station's real-time sockets and for Linux, as RTnet's rtnetproxy has it.
//!
//! ```text
//!           Mouth                              Proxy, a service of the station
//!  Linux ──► send_plain ─────── outward ──► fill: by the station's routes ──► slot 1 or its alias, priority 31
//!  Linux ◄── received ◄──────── inward ◄─── on_unwanted ◄── what the sockets and echoes have no part in, for a buffer
//!
//!  0            6            12       14
//!  +------------+------------+--------+------------------------
//!  | destination| source     | 0x0800 | packet, up to the slot's size
//!  | by route   | the station|        |
//!  +------------+------------+--------+------------------------
//! ```
//!
//! On the medium there are plain packets, as real-time sockets send them: who gets one tells from it alone whether it is for a
//! socket of its own or for its Linux. So whatever a station sends, the other end need not know whose it was. Routes are the
//! station's, in both directions: nothing is asked of the medium. Instead of a tunnel, not beside one.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use rtnet::buf::{Buf, hand_over};
use rtnet::counters::Refusal;
use rtnet::discipline::{Opportunity, Outlet, SendError, Service};
use rtnet::ip::route::{Hop, Routes};
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{self, Address, EtherType, HEADER_LEN, Header};
use rtnet::wire::ipv4;
use zerocopy::IntoBytes;

use crate::tunnel::{Bell, Config, Loss, Mouth, NON_RT, Shared};

/// Where a packet is put that is to leave, and where it is in a frame that has come.
pub const PACKET: usize = HEADER_LEN;
/// The largest packet, in a slot of the largest size.
pub const MTU: usize = ethernet::MTU;
/// Packets that are looked at for one turn: those that lead nowhere are not worth more of the time before a slot.
const LOOKED_AT: usize = 2 * crate::tunnel::AT_ONCE;

/// A proxy: the station's end, and the other one.
pub fn new(config: Config) -> (Proxy, Mouth) {
    let mouth = Mouth::new(config, true);
    let proxy = Proxy { shared: mouth.shared.clone(), per_turn: config.per_turn, bell: None };
    (proxy, mouth)
}

/// The station's end: takes what its sockets have no part in, and sends Linux's packets in turns that nothing else wants.
pub struct Proxy {
    shared: Arc<Shared>,
    per_turn: usize,
    bell: Option<Bell>,
}

impl Proxy {
    /// The same, which rings for who waits at the mouth, for buffers or for what has come: after a slot's send.
    pub fn ringing(self, bell: Bell) -> Self {
        Self { bell: Some(bell), ..self }
    }
}

impl Service for Proxy {
    /// It has no frames of its own: what it takes is the sockets' first.
    fn claims(&self, _ether_type: EtherType) -> bool {
        false
    }

    fn on_frame(&mut self, _rx: Option<Instant>, _frame: Buf) -> Result<(), Refusal> {
        Err(Refusal::NoProtocol)
    }

    fn on_unwanted(&mut self, packet: Buf) -> Result<(), Buf> {
        // As many have room as there are buffers.
        let kept = hand_over(packet, &self.shared.pool).is_ok_and(|own| self.shared.inward.push(own).is_ok());
        match kept {
            true => self.shared.counters.received(),
            false => self.shared.counters.lose(Loss::NoBuffer, 1),
        }
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, _out: &mut Outlet<'_>) {
        if let Some(limit) = slot.non_rt {
            self.shared.mtu.store(limit.min(MTU) as u16, Ordering::Relaxed);
        }
    }

    fn fill(&mut self, slot: &Opportunity, routes: Option<&Routes>, out: &mut Outlet<'_>) {
        let Shared { outward, counters, .. } = &*self.shared;
        let mut left = if slot.non_rt.is_some() { self.per_turn } else { 0 };
        for _ in 0..LOOKED_AT {
            let Some(mut frame) = (left > 0).then(|| outward.pop()).flatten() else { break };
            let Some(station) = routes.and_then(|routes| station_of(&frame, routes)) else {
                counters.lose(Loss::NoStation, 1);
                continue;
            };
            frame[..station.0.len()].copy_from_slice(&station.0);
            match out(frame, Priority::NON_RT, NON_RT) {
                Ok(()) => {
                    left -= 1;
                    counters.sent();
                }
                Err((SendError::TooLong { .. }, _)) => counters.lose(Loss::TooLong, 1),
                Err(_) => counters.lose(Loss::NotQueued, 1),
            }
        }
    }

    /// It leaves in the next turn. Nothing in it shows whose it is, but nobody else sends what is not real-time.
    fn still_wanted(&mut self, _frame: &[u8], priority: Priority) -> bool {
        if priority == Priority::NON_RT {
            self.shared.counters.put_off();
            self.shared.counters.sent();
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

impl Mouth {
    /// An empty buffer for a packet that is to be sent plainly; none while half of them wait for their turns: the others are
    /// for what comes.
    pub fn take_for_packet(&self) -> Option<Buf> {
        let outward = &self.shared.outward;
        if outward.len() > outward.capacity() / 2 { None } else { self.take() }
    }

    /// Sends the packet of IPv4 of `len` bytes that begins at [`PACKET`] of the buffer's room, to whom the station's routes
    /// name when its turn comes.
    pub fn send_plain(&self, mut packet: Buf, len: usize) -> Result<(), Loss> {
        let room = packet.room_mut();
        let Some(bytes) = room.get(PACKET..PACKET + len) else { return Err(self.lose(Loss::TooLong)) };
        if ipv4::parse(bytes).is_err() {
            return Err(self.lose(Loss::NotIp));
        }
        if len > self.mtu() {
            return Err(self.lose(Loss::TooLong));
        }
        let header = Header::new(Address::default(), self.config().address, EtherType::IPV4);
        room[..PACKET].copy_from_slice(header.as_bytes());
        self.leave(packet, PACKET + len)
    }
}

/// Whom a packet goes to. What is for this station itself Linux does not send by a device.
fn station_of(frame: &[u8], routes: &Routes) -> Option<Address> {
    let (header, _) = ipv4::parse(&frame[PACKET..]).ok()?;
    match routes.lookup(header.destination())? {
        Hop::Medium(station) => Some(station),
        Hop::Loopback => None,
    }
}

#[cfg(test)]
mod tests;
