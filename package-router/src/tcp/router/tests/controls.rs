//! Control packages: names, and answers.

use super::*;
use crate::tcp::account::Account;
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
    net.send(0, &control(15, &[]));
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
    assert_eq!(net.register(0, 0), wire::ERROR);
    net.send(0, &package(4, 0, 7, &[]));
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::NOT_AVAILABLE, "0 is nobody");
}

#[test]
fn an_account_is_of_what_was_not_passed_on() {
    let mut net = Net::of(2);
    net.register(1, 2);
    net.send(0, &[package(-6, 9, 1, b"x"), package(-6, 9, 1, b"x"), package(-6, 1, 2, b"forged")].concat());
    for (connection, lost) in
        [(0, Account { nobody_there: 2, foreign_senders: 1, ..Account::default() }), (1, Account::default())]
    {
        net.send(connection, &control(ACCOUNT, &[]));
        let read = net.reads(connection);
        let head = Head::parse(&read).unwrap();
        assert_eq!((head.kind, head.len as usize), (wire::OK, read.len()));
        assert_eq!(Account::parse(&read[HEAD_LEN..]), Some(lost));
    }
}

#[test]
fn unknown_and_malformed_controls_are_counted() {
    let mut net = Net::of(1);
    for kind in [10, 9, 16, 17, 23, 127, -1, -128] {
        net.send(0, &control(kind, b"any"));
    }
    assert_eq!(net.counters(0).controls_ignored, 8);
    for (kind, body) in [(11, 3), (12, 5), (15, 1), (18, 1), (19, 4)] {
        net.send(0, &control(kind, &vec![0; body]));
    }
    assert_eq!((net.counters(0).controls_malformed, net.reads(0).len()), (5, 0));
    for kind in [13, 14] {
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
