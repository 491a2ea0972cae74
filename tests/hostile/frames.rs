//! Hostile frames by the thousand, from pure noise to forged messages with plausible fields.

use proptest::prelude::*;
use rtmac::wire::Message;
use rtnet::buf::Pool;
use rtnet::time::{GlobalTime, Span};
use rtnet::wire::ethernet::Address;
use tests::vectors;

use super::{FORGER, HOSTILE, MASTER, SLAVE, forged_sync, start};
use crate::calibration;

/// Bytes of any kind.
pub fn hostile_frame() -> impl Strategy<Value = Vec<u8>> {
    let noise = prop::collection::vec(any::<u8>(), 0..200);
    let rtmac = (any::<bool>(), prop::collection::vec(any::<u8>(), 0..60)).prop_map(|(to_slave, rest)| {
        let to = if to_slave { SLAVE } else { MASTER };
        let head = [0x90, 0x21, 0, 1, 2, 0, 2, 1, 0];
        [&to.0[..], &MASTER.0[..], &head[..], &rest[..]].concat()
    });
    let changed = (0..51usize, prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4));
    let changed = changed.prop_map(|(number, changes)| {
        let mut bytes = vectors::vector(number + 1).bytes;
        let head = bytes.len().min(60);
        changes.iter().for_each(|(at, byte)| bytes[at.index(head)] = *byte);
        bytes
    });
    let near = -2_000_000i64..4_000_000;
    let forged = (any::<u8>(), 95u32..110, near.clone(), near, any::<u64>());
    let forged = forged.prop_map(|(kind, cycle, xmit, sched, wild)| {
        let global = |ahead| GlobalTime::from_nanos(start(HOSTILE).nanos()) + Span::from_nanos(ahead);
        let (xmit, sched) = (global(xmit), global(sched));
        let (message, to) = match kind % 6 {
            0 => (Message::Sync { cycle, xmit, sched }, Address::BROADCAST),
            1 => (Message::Sync { cycle: wild as u32, xmit, sched: GlobalTime::from_nanos(wild) }, MASTER),
            2 => {
                (Message::Request { xmit: wild, reply_cycle: cycle, reply_offset: wild % 1_200_000 }, MASTER)
            }
            // What the one that calibrates waits for, and stamps that are lies.
            3 => {
                let (request_xmit, reception) = (calibration::asked().nanos(), xmit.nanos());
                (Message::Reply { request_xmit, reception, xmit: sched.nanos() }, SLAVE)
            }
            4 => (Message::Request { xmit: 0, reply_cycle: wild as u32, reply_offset: wild }, MASTER),
            _ => (Message::Reply { request_xmit: wild, reception: xmit.nanos(), xmit: sched.nanos() }, SLAVE),
        };
        let mut frame = Pool::new(1).take().expect("a new pool is full");
        message.write(to, FORGER, &mut frame);
        frame.to_vec()
    });
    // The fields above are drawn independently, and hardly ever fit a slave's line. These do.
    let fitting = (any::<bool>(), 97u32..105, -300_000i64..300_000, -2_000_000i64..2_000_000);
    let fitting = fitting.prop_map(|(is_masters, cycle, later, global)| {
        let from = if is_masters { MASTER } else { FORGER };
        forged_sync(from, cycle, Span::from_nanos(later), Span::from_nanos(global))
    });
    prop_oneof![noise, rtmac, changed, forged, fitting]
}
