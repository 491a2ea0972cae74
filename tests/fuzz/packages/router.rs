//! The TCP router: bytes of connections in pieces of any length, the bytes that leave, and its file.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::collections::BTreeSet;
use std::io;

use package_router::tcp::client::session::Session;
use package_router::tcp::config::RouterFile;
use package_router::tcp::frames::Frames;
use package_router::tcp::router::{Connection, Ending, Limits, Router};
use package_router::wire::OK;

use super::*;

/// Clients, one by TLS that has to prove that it knows the secret, and a link to the router of another system.
const CONNECTIONS: u32 = 5;
const UNTRUSTED: u32 = 3;
const LINK: u32 = 4;
const PROOF: [u8; 32] = [7; 32];
/// Bytes before each piece: its connection, and its length in bytes; of a long one in KiB, all of which are the same byte.
const HEAD: usize = 2;
const LONG: u8 = 0x40;

/// Names registered by two connections, packages between them, a question of the router answered.
fn seeds() -> Vec<Vec<u8>> {
    let piece = |connection: u8, hex: &str| {
        let bytes = unhex(hex);
        [&[connection, bytes.len() as u8], &bytes[..]].concat()
    };
    let all = [
        piece(0, "000d000000000000000000000000001400100100"),
        piece(1, "030d000000000000000000001400000000021000"),
        piece(0, "00154d2a00100200001001000000001568656c6c6f"),
        piece(2, "0003052b001063000010010000000010"),
        piece(1, "030f0000000000000000000010000000"),
        piece(0, "00000000000000000000000000000010"),
        piece(3, &format!("03140000000000000000000030000000{}", "07".repeat(32))),
        piece(3, "0315000000000000000000001400000002000000"),
        piece(0, "030c000000000000000000001400000000011000"),
        piece(0, "030e000100000000000000001400000000000000"),
        piece(1, "03120000000000000000000010000000"),
        piece(1, "03130000000000000000000010000000"),
        piece(1, "03160002000000000000000010000000"),
        piece(4, "03000001000000000000000010000000"),
        piece(4, "0311000000000000000000001000000003ff0002000000000000000010000000"),
        piece(0, "0015000002001000001001000000001568656c6c6f"),
    ];
    // To a receiver, the longest but one KiB; and of a length that is none.
    let long = [piece(0, "00154d2a00100200001001000003fc10"), vec![LONG, 255]].concat();
    let too_long = [piece(0, "00154d2a00100200001001000004000100"), vec![LONG, 255]].concat();
    vec![
        all.concat(),
        all[0].clone(),
        [&all[1][..], &all[2]].concat(),
        [&all[0][..], &all[1], &long, &all[2]].concat(),
        [&all[0][..], &too_long].concat(),
    ]
}

#[test]
fn router_takes_any_bytes() {
    fuzz(&Target { name: "router", seeds: seeds(), has_corpus: false, mutate: mutate::bytes, run: routed });
}

fn routed(bytes: &[u8]) -> Vec<u64> {
    let mut router = Router::new(Limits { queue: 0, ..Limits::default() }, 0);
    router.set_links(1, vec![BTreeSet::new()]);
    (0..CONNECTIONS).for_each(|which| assert_eq!(connected(&mut router, which, 0), Connection(which)));
    let (mut rest, mut now, mut steps) = (bytes, 0, Vec::new());
    while let Some((&[whose, length], behind)) = rest.split_first_chunk::<HEAD>() {
        now += 1;
        let connection = Connection(u32::from(whose & !LONG) % CONNECTIONS);
        if whose & LONG != 0 {
            rest = behind;
            router.received(connection, &vec![length; usize::from(length) << 10], now);
        } else {
            let (piece, behind) = behind.split_at(usize::from(length).min(behind.len()));
            rest = behind;
            router.received(connection, piece, now);
        }
        if whose & 0x80 != 0 {
            router.round(now);
        }
        while let Some((gone, why)) = router.next_ending() {
            let is_known = match why {
                Ending::NoPackage(_) | Ending::Silent => true,
                Ending::Stranger => gone.0 == UNTRUSTED,
                Ending::SameSystem => gone.0 == LINK,
                _ => false,
            };
            assert!(is_known, "{gone:?}: {why}");
            router.disconnect(gone, why, now);
            assert_eq!(connected(&mut router, gone.0, now), gone, "its number is free");
        }
        steps.push(left(&mut router, now));
    }
    in_turn(&steps)
}

fn connected(router: &mut Router, which: u32, now: u64) -> Connection {
    let peer = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 1);
    let connection = match which {
        UNTRUSTED => Ok(router.connect_by_tls(peer, now)),
        LINK => router.link(0, peer, None, now),
        _ => router.connect(peer, now),
    };
    let connection = connection.expect("there is room");
    router.secured(connection, Some(PROOF));
    connection
}

/// All bytes that leave are little-endian packages, and nothing waits afterwards.
fn left(router: &mut Router, now: u64) -> u64 {
    let mut kinds = Vec::new();
    while let Some(to) = router.next_awake() {
        let mut read = Vec::new();
        let send = |slices: &[IoSlice<'_>]| {
            slices.iter().for_each(|slice| read.extend_from_slice(slice));
            Ok(slices.iter().map(|slice| slice.len()).sum())
        };
        assert!(router.write(to, send).expect("nothing fails"));
        // Some arrive, some stay in flight.
        if read.len() % 3 > 0 {
            router.written(to, now);
            router.arrived(to, now - u64::from(read.len() % 3 == 1));
        }
        let cut = Frames::default().cut(&read, |head, body| {
            assert_eq!((head.head_order, head.body_len()), (Endian::Little, body.len()));
            kinds.push(head.kind as u64 & 0xff);
        });
        assert_eq!(cut, Ok(()));
    }
    let status = router.status(now);
    assert!(status.clients.iter().all(|client| client.waiting == 0 && client.oldest.is_none()));
    kinds.truncate(4);
    let counters = status.counters.each().map(|(_, count)| count.min(2));
    outcome(kinds.into_iter().chain(counters))
}

/// Mailboxes of a client.
const OWN: [MailboxName; 2] = [MailboxName(0x0010_0100), MailboxName(0x0010_0200)];

/// A client of a router: answers to its registrations and questions, packages, a question for a sign of life.
#[test]
fn router_client_takes_any_bytes() {
    // It writes, then that comes, and it writes again.
    let comes = |hex: &str| {
        let bytes = unhex(hex);
        [&[0x40, 0, 1, bytes.len() as u8], &bytes[..], &[0x40, 0]].concat()
    };
    let answer = |id: u8| format!("030000{id:02x}000000000000000010000000");
    let account = format!("0300000200000000000000004800000005{}", "00".repeat(55));
    let package = "0015000002001001000000150000001568656c6c6f";
    let all = [
        comes(&answer(0)),
        comes(&format!("{}{}", answer(0), answer(1))),
        comes(&[answer(0), answer(1), account.clone(), answer(3)].concat()),
        comes(&account),
        comes("03010001000000000000000010000000"),
        comes("030c000000000000000000001000000003000000000000000000000011000000"),
        comes(package),
    ];
    let seeds = [&all[..], &[all.concat()]].concat();
    fuzz(&Target { name: "router_client", seeds, has_corpus: false, mutate: mutate::bytes, run: answered });
}

fn answered(bytes: &[u8]) -> Vec<u64> {
    let mut session = Session::default();
    session.set_names(&OWN.into());
    session.connected(0, None);
    let (mut rest, mut now, mut written, mut steps) = (bytes, 0, Vec::new(), Vec::new());
    while let Some((&[what, length], behind)) = rest.split_first_chunk::<HEAD>() {
        now += u64::from(what & 0x3f);
        session.retry(now);
        rest = behind;
        if what & 0x40 != 0 {
            // The connection takes so many bytes of two packages and all else.
            let (mut left, mut room) = (2, 4 * usize::from(length) + HEAD_LEN);
            let next = |batch: &mut Vec<u8>| {
                let package = Head::new(-6, MailboxName(9), OWN[0]).to_bytes();
                (left > 0).then(|| batch.extend_from_slice(&package)).map(|()| left -= 1).is_some()
            };
            let send = |bytes: &[u8]| {
                let taken = bytes.len().min(core::mem::take(&mut room));
                written.extend_from_slice(&bytes[..taken]);
                if taken > 0 { Ok(taken) } else { Err(io::ErrorKind::WouldBlock.into()) }
            };
            session.write(next, send).expect("nothing fails");
        } else {
            let piece;
            (piece, rest) = behind.split_at(usize::from(length).min(behind.len()));
            let mut came = Vec::new();
            if session.received(piece, now, |head, _| came.push(*head)).is_err() || what & 0x80 != 0 {
                session.disconnected();
                session.connected(now, None);
                written.clear();
            }
            came.iter().filter(|head| head.is_command()).for_each(|head| session.answer(&head.answer(OK)));
        }
        let counters = session.counters();
        let (registered, waiting) = session.names();
        assert_eq!(registered + waiting, OWN.len());
        assert!(counters.unconfirmed <= counters.sent && session.next_due(true) <= session.next_due(false));
        let mut kinds = Vec::new();
        let cut = Frames::default().cut(&written, |head, _| kinds.push(head.kind as u64 & 0xff));
        assert_eq!(cut, Ok(()), "it writes packages");
        kinds.truncate(4);
        let few = [
            registered as u64,
            counters.sent,
            counters.received,
            counters.unconfirmed,
            counters.lost_at_router.sum(),
        ];
        steps.push(outcome(kinds.into_iter().chain(few.map(|count| count.min(3)))));
    }
    in_turn(&steps)
}

#[test]
fn router_file_takes_any_text() {
    let file = "name = \"r\"\ninsecure = true\n[[listen]]\naddress = \"127.0.0.1:2000\"\n[limits]\nconnections = 5\nnames = 3\n\
                queue = 300000\n";
    let of_systems = "system = 1\nmetrics = \"127.0.0.1:9100\"\n[[listen]]\naddress = \"0.0.0.0:2001\"\nkeys = \"keys/router\"\n\
                      [[link]]\nrouter = \"far:2001\"\nkeys = \"keys/client\"\nsystems = [2, 3]\n\
                      [[register]]\nnames = [\"1.Pilot.*\", \"1.0x80.1/2\"]\n[[send]]\nfrom = [\"2.*\"]\nto = [\"1.Pilot.*\"]\n";
    fuzz(&Target {
        name: "router_file",
        seeds: [file, of_systems, "", "[limits]\nqueue = 1\n"].map(|text| text.as_bytes().to_vec()).into(),
        has_corpus: false,
        mutate: mutate::text,
        run: |bytes| {
            let text = String::from_utf8_lossy(bytes);
            match RouterFile::parse(&text, "a.toml") {
                Err(error) => {
                    let error = error.to_string();
                    assert!(error.starts_with("a.toml:"), "{error}");
                    vec![outcome(error.bytes().filter(u8::is_ascii_alphabetic).take(40).map(u64::from))]
                }
                Ok(file) => {
                    assert!(!file.listen.is_empty() && file.limits.queue >= MAX_LEN);
                    vec![file.listen.len() as u64, u64::from(file.insecure)]
                }
            }
        },
    });
}
