//! What is where in the memory that a station shares with a program, for one socket.
//!
//! ```text
//! word 0   the station's:  received written, sent read, state, error, dropped        each group in a cache line of its own
//!      8   the program's:  received read, sent written, asleep
//!     16   the station's:  asleep
//!     64   records of what was received, then of what is to be sent
//! ```

use core::net::{Ipv4Addr, SocketAddrV4};

use super::memory::Memory;
use super::ring::{Meta, Place};
use crate::clock::True;
use crate::discipline::Channel;
use crate::queue::Priority;
use crate::socket::{LinkAddress, Options, Received, Sender, Times};
use crate::time::{GlobalTime, Instant};
use crate::wire::ethernet::{Address, EtherType};

/// Whether the station still serves the socket.
pub const STATE: usize = 2;
/// The last send that failed behind the program's back: its number of error, and how many there were.
pub const ERROR: usize = 3;
/// Whether the program waits to be woken.
pub const ASLEEP: usize = 10;
/// Whether the station waits to be woken.
pub const STATION_ASLEEP: usize = 16;
const RECORDS: usize = 64;

/// In [`STATE`]: it does.
pub const SERVED: u64 = 0;
/// In [`STATE`]: it does not any more.
pub const ENDED: u64 = 1;

/// Words of each ring: the longest datagram and almost another, or more than a thousand of the shortest frames.
pub const RING: usize = 16_384;

/// Bytes of memory for one socket.
pub const fn bytes() -> usize {
    (RECORDS + 2 * RING) * size_of::<u64>()
}

/// Whether a program's memory is what a station has made.
pub fn fits(memory: &Memory) -> bool {
    memory.len() >= RECORDS + 2 * RING
}

/// What the station writes and the program reads.
pub fn received() -> Place {
    Place { head: 0, tail: 8, records: RECORDS..RECORDS + RING }
}

/// What the program writes and the station reads.
pub fn sent() -> Place {
    Place { head: 9, tail: 1, records: RECORDS + RING..RECORDS + 2 * RING }
}

const NO_RX: u64 = 1;
const NO_GLOBAL: u64 = 2;
const TO_GROUP: u64 = 4;
const IS_LINK: u64 = 8;
const NO_TIMES: u64 = 16;
const NO_LEFT: u64 = 32;

/// What comes with something that was received.
pub fn pack_received(received: &Received) -> Meta {
    let (from, of_sender) = match received.from {
        Sender::Udp(from) => (pack_udp(from), 0),
        Sender::Link(from) => {
            let group = if from.to_group { TO_GROUP } else { 0 };
            (pack_link(from.address, from.ether_type), IS_LINK | group)
        }
    };
    let flags = of_sender
        | if received.rx.is_none() { NO_RX } else { 0 }
        | if received.global.is_none() { NO_GLOBAL } else { 0 }
        | if received.times.is_none() { NO_TIMES } else { 0 }
        | if received.times.and_then(|times| times.left).is_none() { NO_LEFT } else { 0 };
    let rx = received.rx.map_or(0, Instant::nanos);
    let (sent, left) = (received.times.map(|times| times.sent), received.times.and_then(|times| times.left));
    let [global, sent, left] = [received.global, sent, left].map(|at| at.map_or(0, GlobalTime::nanos));
    [from, flags, rx, global, sent, left]
}

/// The reverse, of something of which so much was copied.
pub fn unpack_received(meta: Meta, whole: usize, len: usize) -> Received {
    let [from, flags, rx, global, sent, left] = meta;
    let is = |flag| flags & flag != 0;
    let from = if is(IS_LINK) {
        let (address, ether_type) = unpack_link(from);
        Sender::Link(LinkAddress { address, ether_type, to_group: is(TO_GROUP) })
    } else {
        Sender::Udp(unpack_udp(from))
    };
    let known = |unless, nanos| (!is(unless)).then_some(GlobalTime::from_nanos(nanos));
    Received {
        len,
        whole,
        from,
        rx: (!is(NO_RX)).then_some(Instant::from_nanos(rx)),
        global: known(NO_GLOBAL, global),
        times: known(NO_TIMES, sent).map(|sent| Times { sent, left: known(NO_LEFT, left) }),
    }
}

/// What is to be sent, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Order {
    /// Where to, in the words of the socket's kind; `None`: to its peer.
    pub to: Option<u64>,
    /// How.
    pub options: Options,
    /// Flags of the call.
    pub flags: i32,
    /// When it was handed over, by CLOCK_MONOTONIC, if its receiver is to know.
    pub at: Option<True>,
}

const TO_SOMEBODY: u64 = 1;
const WITH_TIMES: u64 = 2;

/// What comes with something that is to be sent.
pub fn pack_order(order: &Order) -> Meta {
    let Options { priority, channel, tos } = order.options;
    let options = u64::from(priority.level()) | u64::from(channel) << 8 | u64::from(tos) << 16;
    let flags = u64::from(order.flags as u32) << 32;
    let has =
        if order.to.is_some() { TO_SOMEBODY } else { 0 } | if order.at.is_some() { WITH_TIMES } else { 0 };
    [order.to.unwrap_or(0), options, flags, has, order.at.unwrap_or(0), 0]
}

/// The reverse; `None`: it cannot be.
pub fn unpack_order(meta: Meta) -> Option<Order> {
    let [to, options, flags, has, at, _] = meta;
    let priority = Priority::new(options as u8).ok()?;
    let options = Options { priority, channel: (options >> 8) as Channel, tos: (options >> 16) as u8 };
    let known = |flag, word| (has & flag != 0).then_some(word);
    let (to, at) = (known(TO_SOMEBODY, to), known(WITH_TIMES, at));
    Some(Order { to, options, flags: (flags >> 32) as i32, at })
}

/// An address of UDP's in a word.
pub fn pack_udp(address: SocketAddrV4) -> u64 {
    u64::from(address.ip().to_bits()) << 16 | u64::from(address.port())
}

/// The reverse.
pub fn unpack_udp(word: u64) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::from_bits((word >> 16) as u32), word as u16)
}

/// An address on the medium in a word.
pub fn pack_link(address: Address, ether_type: EtherType) -> u64 {
    let [a, b, c, d, e, f] = address.0;
    let [g, h] = ether_type.0.to_be_bytes();
    u64::from_be_bytes([a, b, c, d, e, f, g, h])
}

/// The reverse.
pub fn unpack_link(word: u64) -> (Address, EtherType) {
    let [a, b, c, d, e, f, g, h] = word.to_be_bytes();
    (Address([a, b, c, d, e, f]), EtherType(u16::from_be_bytes([g, h])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_received_comes_over_as_it_is() {
        let udp = Sender::Udp("10.0.0.1:36000".parse().unwrap());
        let address = LinkAddress {
            address: Address([2, 0, 0, 0, 0, 9]),
            ether_type: EtherType(0x88b6),
            to_group: true,
        };
        for from in [udp, Sender::Link(address), Sender::Link(LinkAddress { to_group: false, ..address })] {
            for (rx, global) in
                [(None, None), (Some(0), Some(u64::MAX)), (Some(u64::MAX), None), (None, Some(0))]
            {
                let (rx, global) = (rx.map(Instant::from_nanos), global.map(GlobalTime::from_nanos));
                let sent = GlobalTime::from_nanos(5);
                for times in [None, Some(Times { sent, left: None }), Some(Times { sent, left: Some(sent) })]
                {
                    let received = Received { len: 3, whole: 7, from, rx, global, times };
                    assert_eq!(unpack_received(pack_received(&received), 7, 3), received);
                }
            }
        }
    }

    #[test]
    fn what_is_to_be_sent_comes_over_as_it_is_and_no_priority_that_there_is_not() {
        let options = Options { priority: Priority::LAST_REAL_TIME, channel: 255, tos: 0x10 };
        for to in [None, Some(0), Some(u64::MAX)] {
            for at in [None, Some(0), Some(u64::MAX)] {
                let order = Order { to, options, flags: -1, at };
                assert_eq!(unpack_order(pack_order(&order)), Some(order));
            }
        }
        assert_eq!(unpack_order([0, 32, 0, 0, 0, 0]), None);
    }
}
