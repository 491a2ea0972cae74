//! What the package router reads: heads and parts of packages, what components ask its broker, files, names.

mod broker;
mod router;
mod texts;

use std::collections::BTreeSet;
use std::ffi::CString;
use std::io::{IoSlice, IoSliceMut};
use std::net::Ipv4Addr;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::epoll::{Epoll, EpollCreateFlags};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recvmsg, sendmsg};
use nix::unistd::ftruncate;
use package_router::broker::Broker;
use package_router::component::Component;
use package_router::handshake::{ANSWER_LEN, Answer, Ask, FILES, Lane};
use package_router::mailbox::{Layout, Shape};
use package_router::name::{Class, MailboxName, Pattern};
use package_router::priority::{Priorities, level_of};
use package_router::route::{MOST_ROUTES, Own, Routes};
use package_router::shared::lane_at;
use package_router::wire::{
    Endian, HEAD_LEN, Head, HeadError, Joining, MAX_LEN, MOST_DATAGRAM, MOST_PARTS, Part, split,
};
use rtnet::sim::Random;
use socket2::{Domain, SockAddr, Socket, Type};

use super::engine::{Target, fuzz, in_turn, outcome};
use super::mutate;
use super::steps::{self, Step};

// ---- heads ----

/// What real peers have sent (section 5.3 of the reference).
const SEEN: [&str; 6] = [
    "000d000000000000000000000000001400100100",
    "00154d2a00100200001001000000001568656c6c6f",
    "01154d2a000210000001100015000000",
    "03fd052b000110000063100010000000",
    "0106000a00001100000702001800000000000000",
    "03840100000001000000110000000400",
];

fn unhex(text: &str) -> Vec<u8> {
    let digits = |at| u8::from_str_radix(&text[at..at + 2], 16).expect("digits");
    (0..text.len()).step_by(2).map(digits).collect()
}

#[test]
fn package_head_takes_any_bytes() {
    fuzz(&Target {
        name: "package_head",
        seeds: SEEN.map(unhex).into(),
        has_corpus: true,
        mutate: mutate::bytes,
        run: |bytes| vec![head(bytes)],
    });
}

/// A head in another's reading: the flags, the four bytes behind each other, and the three words.
fn read_by_another(bytes: &[u8]) -> Option<([u8; 4], [u32; 3])> {
    let bytes: [u8; HEAD_LEN] = *bytes.first_chunk()?;
    let is_little = bytes[0] % 2 == 1;
    let word = |at: usize| {
        let parts: Vec<u32> = bytes[at..at + 4].iter().map(|&byte| byte.into()).collect();
        let [a, b, c, d] = parts.try_into().expect("four");
        if is_little {
            a + b * 0x100 + c * 0x1_0000 + d * 0x100_0000
        } else {
            d + c * 0x100 + b * 0x1_0000 + a * 0x100_0000
        }
    };
    Some(([bytes[0], bytes[1], bytes[2], bytes[3]], [4, 8, 12].map(word)))
}

fn head(bytes: &[u8]) -> u64 {
    let (ours, theirs) = (Head::parse(bytes), read_by_another(bytes));
    let Some(([flags, kind, priority, id], [to, from, len])) = theirs else {
        assert_eq!(ours, Err(HeadError::TooShort { got: bytes.len() }));
        return 0;
    };
    let head = match ours {
        Err(error) => {
            let expected = match len {
                0..16 => HeadError::LenBelowHead { len },
                _ => HeadError::LenAboveMost { len },
            };
            assert!(error == expected && !(16..=262_144).contains(&len), "{error:?}: {len}");
            return 1 + u64::from(len < 16);
        }
        Ok(head) => head,
    };
    assert!((16..=262_144).contains(&len));
    assert_eq!((head.kind as u8, head.priority, head.id), (kind, priority, id));
    assert_eq!((head.to.0, head.from.0, head.len, head.body_len()), (to, from, len, len as usize - 16));
    assert_eq!(
        (head.head_order == Endian::Little, head.body_order == Endian::Little),
        (flags & 1 == 1, flags & 2 == 2)
    );
    let part = [Part::Whole, Part::First, Part::Middle, Part::Last][usize::from(flags / 4 % 4)];
    assert_eq!((head.part, head.other_flags, head.is_whole()), (part, flags & 0xf0, flags & 12 == 0));
    assert_eq!(head.is_command(), (1..128).contains(&kind));
    assert_eq!(head.to_bytes(), bytes[..HEAD_LEN], "written as it was read");
    let reply = read_by_another(&head.answer(-3).to_bytes()).expect("a head");
    assert_eq!(reply, ([3, 0xfd, priority, id], [from, to, 16]));
    outcome([9, u64::from(flags), head.is_command().into(), (to == 0).into(), (len == 16).into()])
}

// ---- parts ----

#[test]
fn package_parts_takes_any_bytes() {
    let seed = |len: u32, most: u16, happens: &[u8]| {
        [&len.to_be_bytes()[1..], &most.to_be_bytes(), happens].concat()
    };
    fuzz(&Target {
        name: "package_parts",
        seeds: vec![
            seed(0, 1_472, &[]),
            seed(2_000, 1_472, &[0]),
            seed(262_128, 65_507, &[]),
            seed(262_128, 1_456, &[]),
            seed(100, 17, &[0, 1, 0, 0, 2]),
            seed(70_000, 1_472, &[0, 0, 0, 0, 0, 0, 0, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
            seed(262_129, 65_507, &[]),
        ],
        has_corpus: true,
        mutate: mutate::bytes,
        run: parts,
    });
}

/// A package in the making, as another would keep it: all that came so far, and how many parts.
struct Made {
    bytes: Vec<u8>,
    parts: usize,
}

/// Cuts a package, lets things happen to its parts, one byte each, and joins what comes.
fn parts(bytes: &[u8]) -> Vec<u64> {
    let Some((&[a, b, c, d, e], happens)) = bytes.split_first_chunk::<5>() else { return vec![0] };
    let (len, most) = (u32::from_be_bytes([0, a, b, c]) as usize, usize::from(u16::from_be_bytes([d, e])));
    let names = (MailboxName(0x0018_0100), MailboxName(0x0017_0000));
    let whole = Head { id: 42, priority: 99, other_flags: 0x50, ..Head::new(21, names.0, names.1) };
    let whole = Head { len: (len + HEAD_LEN) as u32, ..whole };
    // By another's arithmetic: so many parts, each as large as can be but for the last.
    let room = most.min(MOST_DATAGRAM).saturating_sub(HEAD_LEN);
    let count = if len == 0 { 1 } else { (len + room).saturating_sub(1) / room.max(1) };
    let can_be =
        len + HEAD_LEN <= MAX_LEN && most >= HEAD_LEN && count <= MOST_PARTS && (room > 0 || len == 0);
    let Ok(pieces) = split(&whole, most) else {
        assert!(!can_be, "{len} in {most}");
        return vec![1 + u64::from(len + HEAD_LEN > MAX_LEN)];
    };
    assert!(can_be && pieces.len() == count, "{len} in {most}: {} of {count}", pieces.len());
    let body: Vec<u8> = (0..len).map(|at| (at * 7 + at / 251) as u8).collect();
    // As datagrams.
    let mut datagrams = Vec::new();
    let mut end = 0;
    for (number, piece) in pieces.enumerate() {
        assert_eq!(piece.body.start, end);
        end = piece.body.end;
        let part = body[piece.body].to_vec();
        assert!(part.len() + HEAD_LEN <= most && (part.len() == room || number + 1 == count));
        let mark = match number {
            _ if count == 1 => 0x53,
            0 => 0x57,
            _ if number + 1 == count => 0x5f,
            _ => 0x5b,
        };
        let (id, said) = if number == 0 { (42, len) } else { (number as u8, part.len()) };
        let expected = ([mark, 21, 99, id], [names.0.0, names.1.0, (said + HEAD_LEN) as u32]);
        assert_eq!(read_by_another(&piece.head.to_bytes()), Some(expected), "part {number} of {count}");
        datagrams.push((piece.head, part));
    }
    assert_eq!(end, len);
    if count == 1 {
        return vec![3];
    }
    for (at, &happens) in happens.iter().take(40).enumerate() {
        let (at, other) = (at % datagrams.len().max(1), usize::from(happens / 16));
        let Some((head, part)) = datagrams.get_mut(at) else { break };
        match happens % 16 {
            1 => drop(datagrams.remove(at)),
            2 => {
                let again = datagrams[at].clone();
                datagrams.insert(at, again);
            }
            3 => {
                let with = other % datagrams.len();
                datagrams.swap(at, with);
            }
            4 => head.id = head.id.wrapping_add(happens / 16),
            5 => head.from = MailboxName(head.from.0 ^ u32::from(happens / 16)),
            6 => head.to = MailboxName(head.to.0 ^ u32::from(happens / 16)),
            7 => head.len += u32::from(happens / 16),
            8 => part.truncate(other),
            9 => part.extend(vec![7; other]),
            10 => head.part = [Part::Whole, Part::First, Part::Middle, Part::Last][other % 4],
            11 => (head.part, head.len) = (Part::First, (part.len() + HEAD_LEN + other) as u32),
            12 => head.head_order = Endian::Big,
            _ => {}
        }
    }
    let mut outcomes = Vec::new();
    let mut ours: Option<(Joining, Vec<u8>)> = None;
    let mut made: Option<(Head, Made)> = None;
    for (head, part) in &datagrams {
        // It is read as it is written.
        let Ok(head) = Head::parse(&head.to_bytes()) else { continue };
        let mut is_over = false;
        match (&mut ours, &mut made) {
            (Some((joining, joined)), Some((first, made))) => {
                let before = *joining.head();
                let len = first.body_len();
                let behind = made.bytes.len() + part.len();
                let is_next = (head.to, head.from) == (first.to, first.from)
                    && matches!(head.part, Part::Middle | Part::Last)
                    && usize::from(head.id) == made.parts
                    && head.body_len() == part.len()
                    && !part.is_empty()
                    && if head.part == Part::Last { behind == len } else { behind < len };
                let told = joining.next(&head, part.len());
                assert_eq!(told.is_ok(), is_next, "{told:?} of {head:?} behind {} parts", made.parts);
                assert_eq!(*joining.head(), before);
                let Ok(placed) = told else {
                    outcomes.push(outcome(format!("{told:?}").bytes().take(10).map(u64::from)));
                    continue;
                };
                assert_eq!(placed.at, made.bytes.len()..behind);
                joined[placed.at].copy_from_slice(part);
                made.bytes.extend(part);
                made.parts += 1;
                assert_eq!(placed.is_complete, behind == len);
                if placed.is_complete {
                    assert_eq!(*joined, made.bytes);
                    outcomes.push(4 + u64::from(made.bytes == body));
                    is_over = true;
                }
            }
            _ => {
                let is_first = head.part == Part::First && !part.is_empty() && part.len() < head.body_len();
                let told = Joining::begin(&head, part.len());
                assert_eq!(told.is_ok(), is_first, "{told:?} of {head:?}");
                if let Ok((joining, at)) = told {
                    assert_eq!((at, *joining.head()), (0..part.len(), Head { part: Part::Whole, ..head }));
                    let mut joined = vec![0; head.body_len()];
                    joined[..part.len()].copy_from_slice(part);
                    ours = Some((joining, joined));
                    made = Some((head, Made { bytes: part.clone(), parts: 1 }));
                }
            }
        }
        if is_over {
            (ours, made) = (None, None);
        }
    }
    if happens.is_empty() {
        assert_eq!(outcomes, [5], "undisturbed, it is what was sent");
    }
    outcomes
}

// ---- the broker ----
