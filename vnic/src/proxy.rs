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

use rtnet::buf::{Buf, hand_over};
use rtnet::counters::Refusal;
use rtnet::discipline::{Opportunity, Outlet, Service};
use rtnet::ip::route::{Hop, Routes};
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{self, Address, EtherType, HEADER_LEN, Header};
use rtnet::wire::ipv4;
use zerocopy::IntoBytes;

use crate::tunnel::{Bell, Config, End, Loss, Mouth, Shared};

/// Where a packet is put that is to leave, and where it is in a frame that has come.
pub const PACKET: usize = HEADER_LEN;
/// The largest packet, in a slot of the largest size.
pub const MTU: usize = ethernet::MTU;

/// A proxy: the station's end, and the other one.
pub fn new(config: Config) -> (Proxy, Mouth) {
    let mouth = Mouth::new(config, true);
    (Proxy(End::of(&mouth)), mouth)
}

/// The station's end: takes what its sockets have no part in, and sends Linux's packets in turns that nothing else wants.
pub struct Proxy(End);

impl Proxy {
    /// The same, which rings for who waits at the mouth, for buffers or for what has come: after a slot's send.
    pub fn ringing(self, bell: Bell) -> Self {
        Self(self.0.ringing(bell))
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
        let Shared { inward, pool, counters, .. } = &*self.0.shared;
        match hand_over(packet, pool).is_ok_and(|own| inward.push(own).is_ok()) {
            true => counters.received(),
            false => counters.lose(Loss::NoBuffer, 1),
        }
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, _out: &mut Outlet<'_>) {
        self.0.poll(slot.non_rt.map(|limit| limit.min(MTU)));
    }

    fn fill(&mut self, slot: &Opportunity, routes: Option<&Routes>, out: &mut Outlet<'_>) {
        let queued = self.0.fill(slot, out, |frame| {
            let station = routes.and_then(|routes| station_of(frame, routes)).ok_or(Loss::NoStation)?;
            frame[..station.0.len()].copy_from_slice(&station.0);
            Ok(())
        });
        self.0.shared.counters.chose(queued);
    }

    /// It leaves in the next turn. Nothing in it shows whose it is, but nobody else sends what is not real-time.
    fn still_wanted(&mut self, _frame: &[u8], priority: Priority) -> bool {
        if priority == Priority::NON_RT {
            self.0.shared.counters.put_off();
            self.0.shared.counters.chose(1);
        }
        true
    }

    fn given_up(&mut self, _frame: &[u8], priority: Priority) {
        if priority == Priority::NON_RT {
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
