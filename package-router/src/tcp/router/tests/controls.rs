//! Control packages: names, and answers.

use super::*;
use crate::tcp::account::{Account, Lost};
use crate::tcp::control::ACCOUNT;

#[test]
fn a_name_is_one_connections() {
    let mut net = Net::of(2);
    assert_eq!(net.register(0, 0x10_0100), wire::OK);
    assert_eq!((net.register(0, 0x10_0100), net.register(1, 0x10_0100)), (wire::ERROR, wire::ERROR));
    // Without an answer one's own name is let pass, and another's is refused and counted.
    net.send(0, &control(11, &0x10_0100u32.to_le_bytes()));
    net.send(1, &control(11, &0x10_0100u32.to_le_bytes()));
    assert_eq!((net.counters(0).names_refused, net.counters(1).names_refused), (1, 2));
    net.send(1, &control(12, &0x10_0100u32.to_le_bytes()));
    assert!(net.reads(1).is_empty(), "it has no answer");
    net.send(1, &control(14, &0x10_0100u32.to_le_bytes()));
    assert_eq!(Head::parse(&net.reads(1)).unwrap().kind, wire::ERROR, "it is not its own");
    net.send(1, &package(-6, 0x10_0100, 7, b"x"));
    assert_eq!(net.reads(0).len(), HEAD_LEN + 1, "it is there still");
    for (kind, name) in [(14, 0x10_0100u32), (14, 0x99)] {
        net.send(0, &control(kind, &name.to_le_bytes()));
        assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::OK, "{name:#x}");
    }
    assert_eq!(net.register(1, 0x10_0100), wire::OK);
}

#[test]
fn names_end_with_a_purge_and_with_their_connection() {
    let mut net = Net::of(2);
    for name in [1, 2, 3] {
        assert_eq!(net.register(0, name), wire::OK);
    }
    net.send(0, &control(12, &2u32.to_le_bytes()));
    assert_eq!(net.register(1, 2), wire::OK);
    [15, 18, 19].into_iter().for_each(|kind| net.send(0, &control(kind, &[])));
    assert!(net.reads(0).is_empty(), "none of them has an answer");
    assert_eq!((net.register(1, 1), net.register(0, 3)), (wire::OK, wire::OK));
    net.router.disconnect(Connection(0), Ending::Left, 70);
    assert_eq!(net.register(1, 3), wire::OK);
    let status = net.router.status(70);
    assert_eq!((status.clients.len(), status.closed[0].names.len(), status.closed[0].open_for), (1, 1, 70));
}

#[test]
fn no_name_is_everybodys() {
    let mut net = Net::of(1);
    net.send(0, &control(11, &[0; 4]));
    assert_eq!((net.reads(0).len(), net.counters(0).names_refused), (0, 0), "let pass silently");
    assert_eq!((net.register(0, 0), net.counters(0).names_refused), (wire::OK, 0));
    assert!(net.router.status(0).clients[0].names.is_empty());
    net.send(0, &package(4, 0, 7, &[]));
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::NOT_AVAILABLE, "0 is nobody");
}

/// The account of a connection that has nothing else to read.
fn account(net: &mut Net, of: usize) -> Account {
    net.send(of, &control(ACCOUNT, &[]));
    let read = net.reads(of);
    let head = Head::parse(&read).unwrap();
    assert_eq!((head.kind, head.len as usize), (wire::OK, read.len()));
    Account::parse(&read[HEAD_LEN..]).unwrap()
}

#[test]
fn an_account_is_of_what_was_not_passed_on() {
    let mut net = Net::of(2);
    net.register(1, 2);
    net.send(0, &[package(-6, 9, 1, b"x"), package(-6, 9, 1, b"x"), package(-6, 1, 2, b"forged")].concat());
    let lost = Lost { nobody_there: 2, foreign_senders: 1, ..Lost::default() };
    assert_eq!(account(&mut net, 0), Account { lost, waiting: 0 });
    assert_eq!(account(&mut net, 1), Account::default());
}

#[test]
fn packages_wait_until_their_receivers_kernel_has_them() {
    let mut net = Net::of(2);
    net.register(1, 2);
    net.send(0, &[package(-6, 2, 1, b"x"), package(21, 2, 1, b"command")].concat());
    model::read(&mut net, 1, usize::MAX);
    let waiting =
        |waiting, receiver_gone| Account { waiting, lost: Lost { receiver_gone, ..Lost::default() } };
    let to = Connection(1);
    net.router.written(to, 100);
    net.router.arrived(to, 99);
    assert_eq!(account(&mut net, 0), waiting(2, 0));
    // A third is behind the mark.
    net.send(0, &package(-6, 2, 1, b"x"));
    model::read(&mut net, 1, usize::MAX);
    net.router.arrived(to, 100);
    assert_eq!(account(&mut net, 0), waiting(1, 0));
    net.router.written(to, 117);
    net.router.arrived(to, 116);
    assert!(net.router.has_in_flight(to));
    net.router.arrived(to, 117);
    assert!(!net.router.has_in_flight(to));
    assert_eq!(account(&mut net, 0), waiting(0, 0));
    // The receiver goes with one in front of a mark and one behind it.
    net.send(0, &package(-6, 2, 1, b"x"));
    model::read(&mut net, 1, usize::MAX);
    net.router.written(to, 134);
    net.send(0, &package(-6, 2, 1, b"x"));
    model::read(&mut net, 1, usize::MAX);
    net.router.disconnect(to, Ending::Left, 0);
    assert_eq!(account(&mut net, 0), waiting(0, 2));
}

#[test]
fn packages_for_a_receiver_that_goes_are_their_senders_loss() {
    let mut net = Net::of(3);
    net.register(1, 2);
    net.send(
        0,
        &[package(21, 2, 1, b"command"), package(-6, 2, 1, b"data"), package(-6, 2, 1, b"data")].concat(),
    );
    // The connection that this one came by ends first.
    net.send(2, &package(-6, 2, 9, b"data"));
    net.router.disconnect(Connection(2), Ending::Left, 0);
    // A part of the command has left.
    model::read(&mut net, 1, 5);
    model::read(&mut net, 1, 5);
    net.send(0, &control(ACCOUNT, &[]));
    model::read(&mut net, 0, usize::MAX);
    let read = core::mem::take(&mut net.read[0]);
    assert_eq!(Account::parse(&read[HEAD_LEN..]), Some(Account { waiting: 3, ..Account::default() }));
    net.router.disconnect(Connection(1), Ending::Left, 0);
    model::read(&mut net, 0, usize::MAX);
    let answer = Head::parse(&core::mem::take(&mut net.read[0])).unwrap();
    assert_eq!((answer.kind, answer.to), (wire::NOT_AVAILABLE, MailboxName(1)));
    let lost = Lost { receiver_gone: 3, ..Lost::default() };
    assert_eq!(account(&mut net, 0), Account { lost, waiting: 0 });
    assert_eq!(net.router.status(0).counters.lost_at_close, 4);
}

/// As many as one read of a socket holds.
#[test]
fn all_requests_of_one_read_are_answered() {
    const REQUESTS: u32 = (64 << 10) / (HEAD_LEN as u32 + 4);
    let mut net = Net::of(1);
    let requests: Vec<u8> = (1..=REQUESTS).flat_map(|name| control(13, &name.to_le_bytes())).collect();
    net.send(0, &requests);
    assert!(net.router.held >= REQUESTS as usize * HEAD_LEN, "answers are memory, too");
    assert_eq!(net.reads(0).len(), REQUESTS as usize * HEAD_LEN);
    assert_eq!((net.router.held, net.counters(0).answers_lost), (0, 0));
}

/// Head and body have a byte order each.
#[test]
fn names_in_bodies_have_the_order_of_bodies() {
    const NAME: u32 = 0x0010_0100;
    for flags in 0..4u8 {
        let len = if flags & 1 == 0 { 20u32.to_be_bytes() } else { 20u32.to_le_bytes() };
        let name = if flags & 2 == 0 { NAME.to_be_bytes() } else { NAME.to_le_bytes() };
        let request = |kind: u8| [&[flags, kind, 0, 0][..], &[0; 8], &len, &name].concat();
        let mut net = Net::of(1);
        net.send(0, &request(13));
        assert_eq!(net.router.status(0).clients[0].names, [MailboxName(NAME)], "{flags}");
        net.send(0, &request(14));
        assert!(net.router.status(0).clients[0].names.is_empty(), "{flags}");
    }
}

#[test]
fn unknown_and_malformed_controls_are_counted() {
    let mut net = Net::of(1);
    // A proof is none where the client had nothing to prove.
    for kind in [10, 9, 16, 17, 20, 23, 127, -1, -128] {
        net.send(0, &control(kind, b"any"));
    }
    assert_eq!(net.counters(0).controls_ignored, 9);
    for (kind, body) in [(0, 1), (11, 3), (12, 5), (15, 1), (18, 1), (19, 4)] {
        net.send(0, &control(kind, &vec![0; body]));
    }
    assert_eq!((net.counters(0).controls_malformed, net.reads(0).len()), (6, 0));
    for kind in [13, 14, 21, 22] {
        net.send(0, &control(kind, &[1; 8]));
        assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::ERROR);
    }
    assert_eq!(net.endings(), [], "the connection stays");
}

#[test]
fn answers_to_controls_copy_id_and_priority() {
    let mut net = Net::of(1);
    for (number, kind) in [13, 13, 14, 14, 13].into_iter().enumerate() {
        let mut bytes = control(kind, &5u32.to_le_bytes());
        bytes[2..4].copy_from_slice(&[77, 100 + number as u8]);
        net.send(0, &bytes);
        let answer = Head::parse(&net.reads(0)).unwrap();
        let nobody = MailboxName::NOBODY;
        assert_eq!((answer.priority, answer.id, answer.len), (77, 100 + number as u8, 16));
        assert_eq!((answer.from, answer.to), (nobody, nobody));
        assert_eq!(answer.to_bytes()[0], 3, "head and body are little-endian");
    }
}
