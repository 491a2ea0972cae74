//! The peer's own reading and writing of TDMA frames, byte by byte.

use rtnet::buf::Buf;
use rtnet::wire::ethernet::Address;

/// What real stations leave behind the last field of a short frame: whatever was there before.
const STALE: u8 = 0xdb;

/// Where the transmit stamps are.
pub const SYNC_STAMP: u16 = 26;
pub const REQUEST_STAMP: u16 = 22;
pub const REPLY_STAMP: u16 = 38;

/// A TDMA frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tdma {
    Sync { cycle: u32, xmit: u64, sched: u64 },
    Request { xmit: u64, reply_cycle: u32, reply_offset: u64 },
    Reply { request_xmit: u64, reception: u64, xmit: u64 },
}

/// Reads a frame with EtherType 0x9021; `None` for anything that real stations drop.
pub fn decode(frame: &[u8]) -> Option<Tdma> {
    let u16_at = |at: usize| Some(u16::from_be_bytes(frame.get(at..at + 2)?.try_into().ok()?));
    let u32_at = |at: usize| Some(u32::from_be_bytes(frame.get(at..at + 4)?.try_into().ok()?));
    let u64_at = |at: usize| Some(u64::from_be_bytes(frame.get(at..at + 8)?.try_into().ok()?));
    // RTmac type 1, version 2, no tunnel flag; TDMA version 2.1.
    let ours = u16_at(14)? == 1 && *frame.get(16)? == 2 && *frame.get(17)? & 1 == 0 && u16_at(18)? == 0x0201;
    match u16_at(20)? {
        _ if !ours => None,
        0x0000 => Some(Tdma::Sync { cycle: u32_at(22)?, xmit: u64_at(26)?, sched: u64_at(34)? }),
        0x0010 => {
            let (xmit, reply_cycle, reply_offset) = (u64_at(22)?, u32_at(30)?, u64_at(34)?);
            Some(Tdma::Request { xmit, reply_cycle, reply_offset })
        }
        0x0011 => {
            let (request_xmit, reception, xmit) = (u64_at(22)?, u64_at(30)?, u64_at(38)?);
            Some(Tdma::Reply { request_xmit, reception, xmit })
        }
        _ => None,
    }
}

/// Writes a frame of 60 bytes whose end is not zero.
pub fn encode(to: Address, from: Address, tdma: &Tdma, frame: &mut Buf) {
    let mut bytes = [STALE; 60];
    let mut len = 0;
    let mut put = |part: &[u8]| {
        bytes[len..len + part.len()].copy_from_slice(part);
        len += part.len();
    };
    put(&to.0);
    put(&from.0);
    put(&[0x90, 0x21, 0, 1, 2, 0, 0x02, 0x01]);
    match tdma {
        Tdma::Sync { cycle, xmit, sched } => {
            put(&[0x00, 0x00]);
            put(&cycle.to_be_bytes());
            put(&xmit.to_be_bytes());
            put(&sched.to_be_bytes());
        }
        Tdma::Request { xmit, reply_cycle, reply_offset } => {
            put(&[0x00, 0x10]);
            put(&xmit.to_be_bytes());
            put(&reply_cycle.to_be_bytes());
            put(&reply_offset.to_be_bytes());
        }
        Tdma::Reply { request_xmit, reception, xmit } => {
            put(&[0x00, 0x11]);
            put(&request_xmit.to_be_bytes());
            put(&reception.to_be_bytes());
            put(&xmit.to_be_bytes());
        }
    }
    frame.fill(&bytes);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectors;
    use rtnet::buf::Pool;

    #[test]
    fn the_first_six_example_frames_are_read_and_written_but_for_the_padding() {
        let pool = Pool::new(1);
        for vector in &vectors::all()[..6] {
            let tdma = decode(&vector.bytes).expect("a TDMA frame");
            let address = |at: usize| Address(vector.bytes[at..at + 6].try_into().unwrap());
            let mut frame = pool.take().unwrap();
            encode(address(0), address(6), &tdma, &mut frame);
            let end = if matches!(tdma, Tdma::Reply { .. }) { 46 } else { 42 };
            assert_eq!(frame[..end], vector.bytes[..end], "{}", vector.name);
            assert!(frame.len() == 60 && frame[end..].iter().all(|&byte| byte == STALE));
        }
    }

    #[test]
    fn what_real_stations_drop_is_nothing() {
        for number in [7, 38, 39, 40, 41, 42, 43, 51] {
            assert_eq!(decode(&vectors::vector(number).bytes), None, "frame {number}");
        }
    }
}
