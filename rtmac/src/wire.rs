//! RTmac frames and the three frames of TDMA (RTmac 2.0, TDMA 2.1a); all fields big-endian.
//!
//! ```text
//! 0          14     16      17      18        20         22
//! +----------+------+-------+-------+---------+----------+----------------------------------------+
//! | Ethernet | type |version| flags | TDMA    | message  | Synchronisation     cycle 4, xmit 8,   |
//! | header   |      | 2     |bit 0: | version |          |                     sched 8            |
//! | 0x9021   |      |       |tunnel | 0x0201  |          | Request Calibration xmit 8, cycle 4,   |
//! +----------+------+-------+-------+---------+----------+                     offset 8           |
//!            | type 1: TDMA                   |          | Reply Calibration   request 8,         |
//!            | tunnel: the inner EtherType    |          |                     reception 8, xmit 8|
//! ```
//!
//! A frame's length says nothing of its content: real stations pad with stale memory. Fields are read
//! by their offsets only.

pub mod change;

use rtnet::buf::Buf;
use rtnet::counters::Refusal;
use rtnet::discipline::Stamp;
use rtnet::time::GlobalTime;
use rtnet::wire::ethernet::{self, Address, EtherType};
use zerocopy::byteorder::network_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

/// The only RTmac version on today's wires.
pub const RTMAC_VERSION: u8 = 2;
/// The discipline TDMA.
pub const TYPE_TDMA: u16 = 0x0001;
/// Flag: a foreign frame is inside, and the type is its EtherType.
pub const FLAG_TUNNEL: u8 = 0x01;
/// The only TDMA version on today's wires.
pub const TDMA_VERSION: u16 = 0x0201;

/// The RTmac header, behind the Ethernet header.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
pub struct Head {
    kind: U16,
    /// 2.
    pub version: u8,
    /// Bit 0 is the tunnel flag; the others are reserved and ignored.
    pub flags: u8,
}

impl Head {
    /// A discipline's number, or the tunnelled frame's EtherType.
    pub fn kind(&self) -> u16 {
        self.kind.get()
    }
    /// Whether a foreign frame is inside.
    pub fn is_tunnel(&self) -> bool {
        self.flags & FLAG_TUNNEL != 0
    }
}

/// An RTmac frame, as far as it concerns anybody here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rtmac<'a> {
    /// TDMA's own.
    Tdma(Message),
    /// What is not RTnet's, and real stations drop.
    Extension(change::Extension),
    /// A foreign frame's EtherType and payload, with whatever padding followed it.
    Tunnel(EtherType, &'a [u8]),
}

/// What TDMA stations tell each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Message {
    /// From the active master to all: a cycle begins.
    Sync {
        /// Counts cycles, modulo 2^32.
        cycle: u32,
        /// The master's clock when the frame was sent.
        xmit: GlobalTime,
        /// When the cycle was to begin.
        sched: GlobalTime,
    },
    /// From a slave to the master: answer in this cycle, in this slot of mine.
    Request {
        /// The slave's own clock when the frame was sent, nanoseconds.
        xmit: u64,
        /// The cycle of the answer.
        reply_cycle: u32,
        /// The answer's instant in that cycle, nanoseconds from its start.
        reply_offset: u64,
    },
    /// The master's answer; only the difference of its two stamps matters.
    Reply {
        /// The request's `xmit`, unchanged.
        request_xmit: u64,
        /// The master's own clock when the request arrived, nanoseconds.
        reception: u64,
        /// The master's own clock when this frame was sent, nanoseconds.
        xmit: u64,
    },
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct TdmaHead {
    version: U16,
    message: U16,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct SyncBody {
    cycle: U32,
    xmit: U64,
    sched: U64,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct RequestBody {
    xmit: U64,
    reply_cycle: U32,
    reply_offset: U64,
}

#[derive(FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct ReplyBody {
    request_xmit: U64,
    reception: U64,
    xmit: U64,
}

const ID_SYNC: u16 = 0x0000;
const ID_REQUEST: u16 = 0x0010;
const ID_REPLY: u16 = 0x0011;

const BODY: usize = ethernet::HEADER_LEN + size_of::<Head>() + size_of::<TdmaHead>();
const _: () = assert!(BODY == 22);
const _: () = assert!(BODY + size_of::<SyncBody>() == 42 && BODY + size_of::<RequestBody>() == 42);
const _: () = assert!(BODY + size_of::<ReplyBody>() == 46);

/// Splits an RTmac frame into its head and what follows. The caller has checked the EtherType.
pub fn head(frame: &[u8]) -> Result<(&Head, &[u8]), Refusal> {
    let behind = frame.get(ethernet::HEADER_LEN..).ok_or(Refusal::Runt)?;
    Head::ref_from_prefix(behind).map_err(|_| Refusal::Truncated)
}

/// Reads an RTmac frame from its first byte on. The caller has checked the EtherType.
pub fn parse(frame: &[u8]) -> Result<Rtmac<'_>, Refusal> {
    let (head, rest) = head(frame)?;
    if head.version != RTMAC_VERSION {
        return Err(Refusal::RtmacVersion);
    }
    if head.is_tunnel() {
        return Ok(Rtmac::Tunnel(EtherType(head.kind()), rest));
    }
    if head.kind() != TYPE_TDMA {
        return Err(Refusal::OtherDiscipline);
    }
    let (head, body) = prefix::<TdmaHead>(rest)?;
    match head.version.get() {
        TDMA_VERSION => parse_tdma(head.message.get(), body).map(Rtmac::Tdma),
        change::EXTENSION_VERSION => change::parse(head.message.get(), body).map(Rtmac::Extension),
        _ => Err(Refusal::TdmaVersion),
    }
}

fn parse_tdma(message: u16, body: &[u8]) -> Result<Message, Refusal> {
    match message {
        ID_SYNC => prefix::<SyncBody>(body).map(|(b, _)| Message::Sync {
            cycle: b.cycle.get(),
            xmit: GlobalTime::from_nanos(b.xmit.get()),
            sched: GlobalTime::from_nanos(b.sched.get()),
        }),
        ID_REQUEST => prefix::<RequestBody>(body).map(|(b, _)| Message::Request {
            xmit: b.xmit.get(),
            reply_cycle: b.reply_cycle.get(),
            reply_offset: b.reply_offset.get(),
        }),
        ID_REPLY => prefix::<ReplyBody>(body).map(|(b, _)| Message::Reply {
            request_xmit: b.request_xmit.get(),
            reception: b.reception.get(),
            xmit: b.xmit.get(),
        }),
        _ => Err(Refusal::TdmaMessage),
    }
}

fn prefix<T: FromBytes + KnownLayout + Immutable + Unaligned>(bytes: &[u8]) -> Result<(&T, &[u8]), Refusal> {
    T::ref_from_prefix(bytes).map_err(|_| Refusal::Truncated)
}

impl Message {
    /// Writes the whole frame, padded with zeros to the Ethernet minimum.
    pub fn write(&self, destination: Address, source: Address, frame: &mut Buf) {
        let ethernet = ethernet::Header::new(destination, source, EtherType::RTMAC);
        let head = Head { kind: U16::new(TYPE_TDMA), version: RTMAC_VERSION, flags: 0 };
        let tdma = |id| TdmaHead { version: U16::new(TDMA_VERSION), message: U16::new(id) };
        let room = frame.room_mut();
        let mut len = put(room, 0, &ethernet);
        len = put(room, len, &head);
        len = match *self {
            Message::Sync { cycle, xmit, sched } => {
                len = put(room, len, &tdma(ID_SYNC));
                let (xmit, sched) = (U64::new(xmit.nanos()), U64::new(sched.nanos()));
                put(room, len, &SyncBody { cycle: U32::new(cycle), xmit, sched })
            }
            Message::Request { xmit, reply_cycle, reply_offset } => {
                len = put(room, len, &tdma(ID_REQUEST));
                let (xmit, reply_offset) = (U64::new(xmit), U64::new(reply_offset));
                put(room, len, &RequestBody { xmit, reply_cycle: U32::new(reply_cycle), reply_offset })
            }
            Message::Reply { request_xmit, reception, xmit } => {
                len = put(room, len, &tdma(ID_REPLY));
                let (request_xmit, reception) = (U64::new(request_xmit), U64::new(reception));
                put(room, len, &ReplyBody { request_xmit, reception, xmit: U64::new(xmit) })
            }
        };
        frame.set_len(len);
        frame.pad_to(ethernet::MIN_FRAME);
    }

    /// Where this frame's transmit stamp is written, and what is added to the clock: the offset to
    /// global time for a Synchronisation, nothing for the calibration frames.
    pub fn stamp(&self, add: u64) -> Stamp {
        let at_byte = match self {
            Message::Sync { .. } => 26,
            Message::Request { .. } => 22,
            Message::Reply { .. } => 38,
        };
        Stamp { at_byte, add, sum_at: None }
    }
}

/// Writes `part` at `at` and tells where it ends.
fn put(room: &mut [u8], at: usize, part: &(impl IntoBytes + Immutable)) -> usize {
    let end = at + part.as_bytes().len();
    room[at..end].copy_from_slice(part.as_bytes());
    end
}

/// Whether real RTnet stations would leak this frame's buffer until they are deaf: an RTmac frame
/// without the tunnel flag that is not TDMA's (invariant 8). It must never leave.
pub fn is_lethal(frame: &[u8]) -> bool {
    let is_rtmac = ethernet::Header::parse(frame).is_some_and(|(h, _)| h.ether_type() == EtherType::RTMAC);
    is_rtmac && head(frame).map_or(true, |(head, _)| !head.is_tunnel() && head.kind() != TYPE_TDMA)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::buf::Pool;

    const MASTER: Address = Address([2, 0, 0, 0, 0, 1]);
    const SLAVE: Address = Address([2, 0, 0, 0, 0, 3]);

    /// Frames 1 to 3 of the examples, without the padding.
    const SYNC: &str = "ffffffffffff020000000001902100010200020100000000\
                        0064000000e8da9afdb2000000e8da9af100";
    const REQUEST: &str = "020000000001020000000003902100010200020100100000\
                           008bb8c44010000000650000000000061a80";
    const REPLY: &str = "020000000003020000000001902100010200020100110000\
                         008bb8c44010000000e8daa272e0000000e8dab05590";

    fn examples() -> [(&'static str, Message, Address, Address); 3] {
        let sync = Message::Sync {
            cycle: 100,
            xmit: GlobalTime::from_nanos(1_000_100_003_250),
            sched: GlobalTime::from_nanos(1_000_100_000_000),
        };
        let request = Message::Request { xmit: 600_100_323_344, reply_cycle: 101, reply_offset: 400_000 };
        let reply = Message::Reply {
            request_xmit: 600_100_323_344,
            reception: 1_000_100_492_000,
            xmit: 1_000_101_402_000,
        };
        [
            (SYNC, sync, Address::BROADCAST, MASTER),
            (REQUEST, request, MASTER, SLAVE),
            (REPLY, reply, SLAVE, MASTER),
        ]
    }

    fn bytes(hex: &str) -> Vec<u8> {
        (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
    }

    #[test]
    fn messages_and_bytes_are_the_same_thing_in_both_directions() {
        let pool = Pool::new(1);
        for (hex, message, destination, source) in examples() {
            let mut padded = bytes(hex);
            padded.resize(ethernet::MIN_FRAME, 0);
            let mut frame = pool.take().unwrap();
            message.write(destination, source, &mut frame);
            assert_eq!(frame[..], padded[..]);
            assert_eq!(parse(&frame), Ok(Rtmac::Tdma(message)));
        }
    }

    #[test]
    fn every_prefix_is_refused_and_stale_padding_changes_nothing() {
        for (hex, message, ..) in examples() {
            let mut whole = bytes(hex);
            for len in 0..whole.len() {
                assert!(parse(&whole[..len]).is_err(), "{len} bytes of {hex}");
            }
            whole.resize(ethernet::MIN_FRAME, 0xaa);
            assert_eq!(parse(&whole), Ok(Rtmac::Tdma(message)));
        }
    }

    #[test]
    fn the_stamp_goes_where_the_transmit_time_is() {
        let pool = Pool::new(1);
        let mut frame = pool.take().unwrap();
        for (_, message, destination, source) in examples() {
            message.write(destination, source, &mut frame);
            message.stamp(7).write(&mut frame, rtnet::Instant::from_nanos(93));
            let stamped = match parse(&frame).unwrap() {
                Rtmac::Tdma(Message::Sync { xmit, .. }) => xmit.nanos(),
                Rtmac::Tdma(Message::Request { xmit, .. } | Message::Reply { xmit, .. }) => xmit,
                Rtmac::Tunnel(..) | Rtmac::Extension(_) => panic!("TDMA's own"),
            };
            assert_eq!(stamped, 100);
        }
    }

    #[test]
    fn what_is_lethal_to_rtnet_stations_is_known() {
        let mut frame = bytes(SYNC);
        assert!(!is_lethal(&frame));
        frame[15] = 0x42;
        assert!(is_lethal(&frame));
        frame[17] = FLAG_TUNNEL;
        assert!(!is_lethal(&frame));
        assert!(is_lethal(&frame[..16]), "an RTmac frame without a whole head");
        frame[12] = 0x08;
        assert!(!is_lethal(&frame[..16]), "not an RTmac frame");
    }
}
