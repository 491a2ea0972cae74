//! Packages that come at once fare as those that come one by one.

use proptest::collection::vec;
use proptest::prelude::*;

use super::model::read;
use super::*;

const CLIENTS: usize = 3;

/// A package of client 0, of either order. The names 1 to 3 are of the clients 0 to 2; no client has 4.
fn sent() -> impl Strategy<Value = Vec<u8>> {
    let kind = prop_oneof![3 => Just(-6i8), 1 => Just(21)];
    let to = prop_oneof![8 => Just(2u32), 1 => 0..5u32];
    let from = prop_oneof![8 => Just(1u32), 1 => Just(2)];
    let priority = prop_oneof![4 => Just(0u8), 1 => 1..3u8];
    let body = prop_oneof![8 => 0..40usize, 1 => 60_000..120_000usize];
    let order = prop_oneof![8 => Just(wire::Endian::Little), 1 => Just(wire::Endian::Big)];
    (kind, to, from, priority, body, order).prop_map(|(kind, to, from, priority, body, head_order)| {
        let head = Head { priority, head_order, ..Head::new(kind, MailboxName(to), MailboxName(from)) };
        [&head.with_body(body).unwrap().to_bytes()[..], &vec![priority; body]].concat()
    })
}

/// The bytes that each client reads, its counters and its end, where the bytes come in pieces. A few bytes are read after each piece.
/// Each piece comes at once, or so that no two packages come at once.
fn outcome(limits: Limits, has_rules: bool, pieces: &[&[u8]], at_once: bool) -> Vec<String> {
    let mut net = Net { router: Router::new(limits, 0), read: vec![Vec::new(); CLIENTS], now: 0 };
    for client in 0..CLIENTS {
        net.router.connect(PEER, 0).unwrap();
        assert_eq!(net.register(client, client as u32 + 1), 0);
    }
    if has_rules {
        let names = |names: &str| vec![names.parse().unwrap()];
        let send = vec![SendRule { from: names("0x1"), to: names("0x2") }];
        net.router.set_rules(Rules { send, ..Rules::default() });
    }
    for piece in pieces {
        let step = if at_once { piece.len() } else { HEAD_LEN };
        piece.chunks(step).for_each(|bytes| net.send(0, bytes));
        read(&mut net, 1, 1_000);
    }
    let endings = net.endings();
    (0..CLIENTS).for_each(|client| read(&mut net, client, usize::MAX));
    let begun: usize = net.router.clients.iter().flatten().map(|client| client.frames.begun()).sum();
    assert_eq!(net.router.held, begun);
    let clients = (0..CLIENTS).map(|client| format!("{:?} {:?}", net.counters(client), net.read[client]));
    clients.chain([format!("{endings:?}")]).collect()
}

proptest! {
    #[test]
    fn packages_at_once_fare_as_one_by_one(
        packages in vec(sent(), 1..60), pieces in 1..200_000usize, has_rules in any::<bool>(),
    ) {
        let limits = Limits { queue: 0, ..Limits::default() };
        let bytes = packages.concat();
        let pieces: Vec<&[u8]> = bytes.chunks(pieces).collect();
        let one_by_one = outcome(limits, has_rules, &pieces, false);
        prop_assert!(outcome(limits, has_rules, &pieces, true) == one_by_one);
    }

    #[test]
    fn packages_at_once_keep_to_the_memory(
        packages in vec(sent(), 1..60), pieces in 1..200_000usize, memory in 270_000..500_000usize,
    ) {
        let mut net = Net::of(CLIENTS);
        net.router.limits.memory = memory;
        for client in 0..CLIENTS {
            net.register(client, client as u32 + 1);
        }
        for piece in packages.concat().chunks(pieces) {
            net.send(0, piece);
            prop_assert!(net.router.held <= memory);
        }
    }
}
