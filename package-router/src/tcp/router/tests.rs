use super::*;
use crate::tcp::control::{LIFESIGN, PROOF};
use crate::tcp::hex;
use crate::tcp::rules::{RegisterRule, SendRule};
use crate::wire;
use crate::wire::HEAD_LEN;

mod controls;
mod life;
mod model;
mod runs;
mod trust;

const PEER: SocketAddr = SocketAddr::new(core::net::IpAddr::V4(core::net::Ipv4Addr::LOCALHOST), 9);

/// A router with connections, and all bytes that have left for each.
struct Net {
    router: Router,
    read: Vec<Vec<u8>>,
    now: u64,
}

impl Net {
    fn of(connections: usize) -> Self {
        let mut router = Router::new(Limits::default(), 0);
        (0..connections).for_each(|_| {
            router.connect(PEER, 0).unwrap();
        });
        Self { router, read: vec![Vec::new(); connections], now: 0 }
    }

    fn send(&mut self, from: usize, bytes: &[u8]) {
        self.router.received(Connection(from as u32), bytes, self.now);
    }

    fn flush(&mut self) {
        while let Some(to) = self.router.next_awake() {
            let read = &mut self.read[to.0 as usize];
            let send = |slices: &[IoSlice<'_>]| {
                slices.iter().for_each(|slice| read.extend_from_slice(slice));
                Ok(slices.iter().map(|slice| slice.len()).sum())
            };
            assert!(self.router.write(to, send).unwrap());
        }
    }

    /// All bytes that a connection reads now.
    fn reads(&mut self, of: usize) -> Vec<u8> {
        self.flush();
        core::mem::take(&mut self.read[of])
    }

    fn register(&mut self, connection: usize, name: u32) -> i8 {
        let head = Head::new(13, MailboxName::NOBODY, MailboxName::NOBODY).with_body(4).unwrap();
        self.send(connection, &[&head.to_bytes()[..], &name.to_le_bytes()].concat());
        Head::parse(&self.reads(connection)).unwrap().kind
    }

    fn endings(&mut self) -> Vec<(u32, Ending)> {
        core::iter::from_fn(|| self.router.next_ending()).map(|(of, why)| (of.0, why)).collect()
    }

    fn counters(&self, of: usize) -> Counters {
        self.router.status(self.now).clients[of].counters
    }
}

fn package(kind: i8, to: u32, from: u32, body: &[u8]) -> Vec<u8> {
    let head = Head { priority: 5, id: 9, ..Head::new(kind, MailboxName(to), MailboxName(from)) };
    [&head.with_body(body.len()).unwrap().to_bytes()[..], body].concat()
}

fn control(kind: i8, body: &[u8]) -> Vec<u8> {
    let head = Head { priority: 0, id: 0, ..Head::new(kind, MailboxName::NOBODY, MailboxName::NOBODY) };
    [&head.with_body(body.len()).unwrap().to_bytes()[..], body].concat()
}

#[test]
fn bytes_are_those_seen_between_real_peers() {
    // 0: J, big-endian; 1: J2; 2: C.
    let mut net = Net::of(3);
    net.send(0, &hex("000d0000 00000000 00000000 00000014 00100100"));
    assert_eq!(net.reads(0), hex("03000000 00000000 00000000 10000000"));
    net.send(1, &hex("000d0000 00000000 00000000 00000014 00100200"));
    net.reads(1);
    net.send(0, &hex("00154d2a 00100200 00100100 00000015 68656c6c6f"));
    assert_eq!(net.reads(1), hex("01154d2a 00021000 00011000 15000000 68656c6c6f"));
    net.send(0, &hex("0003052b 00106300 00100100 00000010"));
    assert_eq!(net.reads(0), hex("03fd052b 00011000 00631000 10000000"));
    net.send(0, &hex("00fa052c 00106300 00100100 00000010"));
    assert_eq!(net.reads(0), [], "a reply to nobody");

    net.now = LIFESIGN_EVERY;
    net.router.round(net.now);
    for client in 0..3 {
        assert_eq!(net.reads(client), hex("03110000 00000000 00000000 10000000"));
    }
    net.send(0, &hex("00000000 00000000 00000000 00000010"));
    net.send(2, &hex("03130000 00000000 00000000 10000000"));
    net.send(2, &hex("030d0000 00000000 00000000 14000000"));
    net.send(2, &hex("00001c00"));
    assert_eq!(net.reads(2), hex("03000000 00000000 00000000 10000000"));
    net.send(0, &hex("00060000 001c0000 00100100 00000010"));
    assert_eq!(net.reads(2), hex("01060000 00001c00 00011000 10000000"));
}

#[test]
fn rates_are_those_of_the_last_round() {
    let mut net = Net::of(2);
    net.register(0, 1);
    net.register(1, 2);
    let rates = |net: &Net| {
        let status = net.router.status(net.now);
        (status.rates, status.clients.iter().map(|client| client.rates).collect::<Vec<_>>())
    };
    assert_eq!(rates(&net), (None, vec![None, None]));
    for _ in 0..10 {
        net.send(0, &package(-6, 2, 1, &[0; 14]));
    }
    net.now = LIFESIGN_EVERY;
    net.router.round(net.now);
    let sender = Rates { packages_in: 2, bytes_in: 60, ..Rates::default() };
    let receiver = Rates { packages_out: 2, bytes_out: 60, ..Rates::default() };
    let all = Rates { packages_out: 2, bytes_out: 60, ..sender };
    assert_eq!(rates(&net), (Some(all), vec![Some(sender), Some(receiver)]));
    // Packages of a closed connection count once.
    net.send(0, &package(-6, 2, 1, &[0; 4984]));
    net.router.disconnect(Connection(0), Ending::Left, net.now);
    net.send(1, &control(0, &[]));
    net.now = 2 * LIFESIGN_EVERY;
    net.router.round(net.now);
    net.send(1, &control(0, &[]));
    let last = Rates { packages_out: 1, bytes_out: 1_000, ..Rates::default() };
    let all = Rates { packages_in: 1, bytes_in: 1_000, ..last };
    assert_eq!(rates(&net), (Some(all), vec![Some(last)]), "one in 5 s is not none");
    // A long round; and a connection that has just been opened.
    let young = net.router.connect(PEER, net.now + 50_000 - 999).unwrap();
    net.router.received(young, &package(-6, 2, 3, &[0; 4984]), net.now);
    net.now += 50_000;
    net.router.round(net.now);
    let last = Rates { packages_out: 1, bytes_out: 100, ..Rates::default() };
    let all = Rates { packages_in: 1, bytes_in: 100, ..last };
    assert_eq!(rates(&net), (Some(all), vec![None, Some(last)]));
    net.now += LIFESIGN_EVERY;
    net.router.round(net.now);
    assert_eq!(rates(&net).1[0], Some(Rates { packages_in: 1, bytes_in: 834, ..Rates::default() }));
}

#[test]
fn a_connection_that_sends_no_package_is_closed_and_counted() {
    let mut net = Net::of(3);
    net.register(0, 1);
    for (client, length) in [(0, "0f000000"), (1, "01000400")] {
        net.send(client, &hex(&format!("03010000 01000000 01000000 {length}")));
        let [(closed, why @ Ending::NoPackage(_))] = &net.endings()[..] else { panic!() };
        assert_eq!(*closed as usize, client);
        net.router.disconnect(Connection(client as u32), why.clone(), 0);
    }
    net.router.disconnect(Connection(7), Ending::Left, 0);
    let counted: Vec<_> = net.router.status(0).endings.into_iter().filter(|(_, count)| *count > 0).collect();
    assert_eq!(counted, [("too_long", 1), ("too_short", 1)]);
    assert_eq!(net.register(2, 1), wire::OK);
}

#[test]
fn nobody_sends_in_anothers_name() {
    let mut net = Net::of(3);
    (0..3).for_each(|client| assert_eq!(net.register(client, client as u32 + 1), wire::OK));
    net.send(2, &package(-6, 2, 1, b"forged"));
    net.send(2, &package(4, 2, 1, b"forged"));
    assert_eq!((net.reads(0).len(), net.reads(1).len(), net.counters(2).foreign_senders), (0, 0, 2));
    assert_eq!(
        Head::parse(&net.reads(2)).unwrap().kind,
        wire::NOT_AVAILABLE,
        "the command's own connection is answered"
    );
    net.send(2, &package(-6, 2, 77, b"of nobody"));
    assert_eq!(net.reads(1).len(), HEAD_LEN + 9);
}

/// Rules for registration are rules for sending, too: else anybody might send in a free name that `[[send]]` allows.
#[test]
fn nobody_sends_in_a_name_that_it_may_not_register() {
    let mut net = Net::of(2);
    net.router.set_rules(Rules {
        register: vec![RegisterRule { peer: None, names: vec!["0.Chassis.*".parse().unwrap()] }],
        send: Vec::new(),
    });
    assert_eq!(net.register(1, 0x11_0000), wire::OK);
    net.send(0, &package(21, 0x11_0000, 0x18_0500, b"in the name of a pilot"));
    assert_eq!((net.reads(1).len(), net.counters(0).foreign_senders), (0, 1));
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::NOT_AVAILABLE);
    for name in [0x11_0100, 0] {
        net.send(0, &package(-6, 0x11_0000, name, b"as it may"));
        assert_eq!(net.reads(1).len(), HEAD_LEN + 9);
    }
}

#[test]
fn a_displaced_command_is_answered_where_it_came_from() {
    let mut net = Net::of(3);
    net.register(1, 2);
    let head = |priority, body| {
        let head = Head { priority, ..Head::new(21, MailboxName(2), MailboxName(77)) };
        [&head.with_body(body).unwrap().to_bytes()[..], &vec![0; body]].concat()
    };
    let all = Limits::default().queue / 100_016;
    (0..all).for_each(|_| net.send(0, &head(1, 100_000)));
    net.send(2, &head(9, 100_000));
    assert_eq!((net.counters(0).overtaken, net.counters(2).overtaken), (1, 0));
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::NOT_AVAILABLE);
    assert!(net.reads(2).is_empty());
}

#[test]
fn a_receiver_that_does_not_read_costs_its_senders_answers_only() {
    let mut net = Net::of(2);
    net.register(1, 2);
    let sent = 3 * Limits::default().queue / 1_016;
    for _ in 0..sent {
        net.send(0, &package(1, 2, 7, &[0; 1_000]));
    }
    let status = net.router.status(0);
    assert!(status.clients[1].waiting_bytes <= Limits::default().queue);
    let refused = net.counters(0).receiver_full;
    assert_eq!(
        (refused, net.counters(1).queue_full),
        (sent as u64 - status.clients[1].waiting as u64, refused)
    );
    assert_eq!(net.reads(0).len(), HEAD_LEN * refused as usize, "each command is answered");
}

#[test]
fn answers_lifesigns_and_urgent_packages_overtake_10000() {
    let mut net = Net::of(2);
    net.register(1, 2);
    for _ in 0..10_000 {
        net.send(0, &package(-6, 2, 7, &[0; 48]));
    }
    let urgent = Head { priority: 200, ..Head::new(-6, MailboxName(2), MailboxName(7)) };
    net.send(0, &urgent.to_bytes());
    net.send(1, &control(13, &3u32.to_le_bytes()));
    net.router.round(0);
    let read = net.reads(1);
    let first = [0, 1, 2].map(|at| Head::parse(&read[at * HEAD_LEN..]).unwrap());
    assert_eq!((first[0].kind, first[1].kind, first[2].priority), (wire::OK, LIFESIGN, 200));
    assert_eq!(read.len(), 10_000 * 64 + 3 * HEAD_LEN);
}

/// Alone, and behind one that goes the same way.
#[test]
fn other_flags_and_the_body_are_passed_on_untouched() {
    let mut net = Net::of(2);
    net.register(1, 2);
    for flags in [0xFC, 0xFD, 0xFE, 0xFF, 0x00, 0x03] {
        let mut sent = package(-6, 2, 7, b"body");
        sent[0] = flags;
        if flags & 1 == 0 {
            [4, 8, 12].into_iter().for_each(|at| sent[at..at + 4].reverse());
        }
        net.send(0, &[&sent[..], &sent].concat());
        let mut expected = package(-6, 2, 7, b"body");
        expected[0] = flags | 1;
        assert_eq!(net.reads(1), [&expected[..], &expected].concat(), "{flags:#x}");
    }
}

#[test]
fn a_status_shows_how_much_waits_and_since_when() {
    let mut net = Net::of(2);
    net.register(1, 2);
    for now in [100, 350] {
        net.now = now;
        net.send(0, &package(-6, 2, 7, &[0; 48]));
    }
    let of = &net.router.status(400).clients[1];
    assert_eq!((of.waiting, of.waiting_bytes, of.oldest), (2, 128, Some(300)));
}

#[test]
fn limits_hold_and_are_counted() {
    let limits = Limits { connections: 2, names: 2, queue: 0, ..Limits::default() };
    let mut net = Net { router: Router::new(limits, 0), read: vec![Vec::new(); 2], now: 0 };
    let opened: Vec<_> = (0..3).map(|_| net.router.connect(PEER, 0).is_ok()).collect();
    assert_eq!(opened, [true, true, false]);
    assert_eq!([1, 2, 3].map(|name| net.register(0, name)), [wire::OK, wire::OK, wire::ERROR]);
    assert_eq!(net.router.status(0).counters.connections_refused, 1);
    net.router.disconnect(Connection(0), Ending::Left, 0);
    assert_eq!(net.router.connect(PEER, 0), Ok(Connection(0)));
    for _ in 0..2 * CLOSED {
        net.router.disconnect(Connection(0), Ending::Left, 0);
        net.router.connect(PEER, 0).unwrap();
    }
    assert_eq!(net.router.status(0).closed.len(), CLOSED);
}

#[test]
fn a_hundred_thousand_registrations_are_refused_and_counted() {
    const ASKED: u32 = 100_000;
    let mut net = Net::of(2);
    for name in 1..=ASKED {
        net.send(0, &control(11, &name.to_le_bytes()));
    }
    let most = Limits::default().names;
    assert_eq!(net.router.table.len(), most);
    assert_eq!(net.counters(0).names_refused, u64::from(ASKED) - most as u64);
    assert_eq!(net.register(1, ASKED), wire::OK, "the other client has room");
}

#[test]
fn what_no_rule_allows_is_refused_counted_and_answered() {
    let mut net = Net::of(2);
    let of = |text: &str| vec![text.parse().unwrap()];
    let pilots = RegisterRule { peer: None, names: of("0.Pilot.*") };
    let others = RegisterRule { peer: None, names: of("0.Chassis.0") };
    let send = vec![SendRule { from: of("0.Pilot.*"), to: of("0.Chassis.*") }];
    net.router.set_rules(Rules { register: vec![pilots, others], send });
    assert_eq!(
        [0x18_0000, 0x18_0100, 0x12_0000].map(|name| net.register(0, name)),
        [wire::OK, wire::OK, wire::ERROR]
    );
    assert_eq!((net.register(1, 0x11_0000), net.counters(0).names_refused), (wire::OK, 1));
    net.send(0, &package(21, 0x11_0000, 0x18_0000, b"go"));
    net.send(1, &package(0, 0x18_0000, 0x11_0000, b"gone"));
    assert_eq!((net.reads(1).len(), net.reads(0).len()), (HEAD_LEN + 2, HEAD_LEN + 4));
    net.send(1, &package(21, 0x18_0000, 0x11_0000, b"and you"));
    assert_eq!((net.reads(0).len(), net.counters(1).forbidden), (0, 1));
    assert_eq!(Head::parse(&net.reads(1)).unwrap().kind, wire::NOT_AVAILABLE);
    // Other rules drop nobody.
    net.router.set_rules(Rules {
        register: vec![RegisterRule { peer: None, names: of("0.Gyro.0") }],
        ..Rules::default()
    });
    net.send(1, &package(21, 0x18_0000, 0x11_0000, b"and you"));
    assert_eq!((net.reads(0).len(), net.register(0, 0x18_0200)), (HEAD_LEN + 7, wire::ERROR));
}

#[test]
fn all_connections_together_have_no_more_names_than_they_may() {
    let limits = Limits { all_names: 3, ..Limits::default() };
    let mut net = Net { router: Router::new(limits, 0), ..Net::of(3) };
    (0..3).for_each(|_| assert!(net.router.connect(PEER, 0).is_ok()));
    let registered = [(0, 1), (1, 2), (2, 3), (2, 4)].map(|(client, name)| net.register(client, name));
    assert_eq!(registered, [0, 0, 0, wire::ERROR]);
}

/// The others go on, also with commands and with packages that come in parts.
#[test]
fn the_connection_that_holds_most_is_closed_where_memory_ends() {
    let limits = Limits { memory: 1_000, ..Limits::default() };
    let mut net = Net { router: Router::new(limits, 0), ..Net::of(3) };
    (0..3).for_each(|_| assert!(net.router.connect(PEER, 0).is_ok()));
    (0..3).for_each(|client| assert_eq!(net.register(client, client as u32 + 1), wire::OK));
    for to in [2, 2, 2, 2, 2, 2, 3, 3] {
        net.send(0, &package(-6, to, 1, &[0; 100]));
    }
    assert_eq!((net.router.held, net.endings()), (8 * 116, vec![]));
    net.send(0, &package(-6, 3, 1, &[0; 100]));
    assert_eq!((net.router.held, net.endings()), (3 * 116, vec![(1, Ending::NoMemory)]));
    assert_eq!(net.counters(1).lost_at_close, 6);
    net.send(0, &package(21, 2, 1, &[]));
    assert_eq!(
        (net.counters(0).receiver_full, Head::parse(&net.reads(0)).unwrap().kind),
        (1, wire::NOT_AVAILABLE)
    );
    net.router.disconnect(Connection(1), Ending::NoMemory, 0);
    // A package that has begun counts. More of it does not come from one that is to be closed.
    net.reads(2);
    net.send(2, &package(-6, 1, 3, &[0; 2_000])[..600]);
    net.send(0, &package(-6, 3, 1, &[0; 2_000])[..900]);
    assert_eq!((net.router.held, net.endings()), (600, vec![(0, Ending::NoMemory)]));
    net.send(0, &[0; 1_116]);
    assert_eq!((net.router.held, net.endings()), (600, vec![]));
    net.router.disconnect(Connection(0), Ending::NoMemory, 0);
    net.router.disconnect(Connection(2), Ending::Left, 0);
    assert_eq!((net.router.held, net.router.table.len()), (0, 0));
}
