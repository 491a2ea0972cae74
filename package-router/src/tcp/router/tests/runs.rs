//! Packages that come at once fare as those that come one by one.

use proptest::collection::vec;
use proptest::prelude::*;

use super::*;

const CLIENTS: usize = 3;

/// A package of client 0, of either order.
fn sent() -> impl Strategy<Value = Vec<u8>> {
    let kind = prop_oneof![Just(21i8), Just(-6)];
    let orders = prop_oneof![4 => Just(wire::Endian::Little), 1 => Just(wire::Endian::Big)];
    // Names 1 to 3 are of the clients 0 to 2, 4 of nobody.
    (kind, 0..5u32, 1..3u32, 0..2u8, 0..40usize, orders).prop_map(
        |(kind, to, from, priority, body, head_order)| {
            let head = Head { priority, head_order, ..Head::new(kind, MailboxName(to), MailboxName(from)) };
            [&head.with_body(body).unwrap().to_bytes()[..], &vec![priority; body]].concat()
        },
    )
}

/// The bytes that each client reads, and its counters, after these came in pieces of so many bytes.
fn outcome(limits: Limits, sends: bool, bytes: &[u8], pieces: usize) -> Vec<(Vec<u8>, Counters)> {
    let mut net = Net { router: Router::new(limits, 0), read: vec![Vec::new(); CLIENTS], now: 0 };
    for client in 0..CLIENTS {
        net.router.connect(PEER, 0).unwrap();
        assert_eq!(net.register(client, client as u32 + 1), 0);
    }
    if sends {
        let names = |names: &str| vec![names.parse().unwrap()];
        let send = vec![SendRule { from: names("0x1"), to: names("0x2") }];
        net.router.set_rules(Rules { send, ..Rules::default() });
    }
    bytes.chunks(pieces).for_each(|piece| net.send(0, piece));
    (0..CLIENTS).map(|client| (net.reads(client), net.counters(client))).collect()
}

proptest! {
    #[test]
    fn packages_at_once_fare_as_one_by_one(
        packages in vec(sent(), 1..60), queue in 50..2_000usize, pieces in 1..4_000usize, sends in any::<bool>(),
    ) {
        let limits = Limits { queue, ..Limits::default() };
        let bytes = packages.concat();
        let bare = outcome(limits, sends, &bytes, HEAD_LEN);
        prop_assert_eq!(outcome(limits, sends, &bytes, pieces), bare);
    }
}
