//! Connections by TLS: nothing is done for one before it is trusted.

use super::*;

const PROVES: Proof = [7; 32];
const REGISTERS: u32 = 0x0018_0000;

fn proof(bytes: &[u8]) -> Vec<u8> {
    let head = Head::new(PROOF, MailboxName::NOBODY, MailboxName::NOBODY).with_body(bytes.len()).unwrap();
    [&head.to_bytes()[..], bytes].concat()
}

fn registration() -> Vec<u8> {
    let head = Head::new(13, MailboxName::NOBODY, MailboxName::NOBODY).with_body(4).unwrap();
    [&head.to_bytes()[..], &REGISTERS.to_le_bytes()].concat()
}

/// A connection that has to prove that it knows the secret.
fn untrusted() -> Net {
    let mut net = Net::of(0);
    let connection = net.router.connect_by_tls(PEER, 0);
    net.router.secured(connection, Some(PROVES));
    net.read.push(Vec::new());
    net
}

#[test]
fn the_proof_is_the_first_package_or_the_connection_ends() {
    let in_anothers_name = package(21, 2, 1, b"from a stranger");
    for other in
        [registration(), in_anothers_name, proof(&[8; 32]), proof(&[7; 31]), proof(&[7; 33]), proof(&[])]
    {
        let mut net = untrusted();
        net.send(0, &[other, proof(&PROVES), registration()].concat());
        assert_eq!(net.endings(), [(0, Ending::Stranger)]);
        assert!(net.reads(0).is_empty() && net.router.status(0).clients[0].names.is_empty());
    }
}

#[test]
fn a_proof_may_come_byte_by_byte_and_again() {
    let mut net = untrusted();
    proof(&PROVES).chunks(1).for_each(|byte| net.send(0, byte));
    net.send(0, &[proof(&PROVES), registration()].concat());
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::OK);
    let counters = net.router.status(0).counters;
    assert_eq!((net.endings(), counters.controls_ignored), (Vec::new(), 0));
}

#[test]
fn a_certificate_needs_no_proof() {
    let mut net = Net::of(0);
    let connection = net.router.connect_by_tls(PEER, 0);
    net.read.push(Vec::new());
    net.router.secured(connection, None);
    net.send(0, &registration());
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::OK);
}

/// Neither in its handshake nor before its proof it is asked for a sign of life.
#[test]
fn a_connection_that_is_not_trusted_ends_within_two_rounds() {
    for has_begun in [false, true] {
        let mut net = Net::of(0);
        let connection = net.router.connect_by_tls(PEER, 0);
        net.read.push(Vec::new());
        if has_begun {
            net.router.secured(connection, Some(PROVES));
        }
        net.router.round(LIFESIGN_EVERY);
        net.send(0, &proof(&PROVES)[..5]);
        assert!(net.reads(0).is_empty() && net.endings().is_empty());
        net.router.round(2 * LIFESIGN_EVERY);
        assert_eq!(net.endings(), [(0, Ending::Silent)]);
    }
    let mut net = untrusted();
    net.router.round(LIFESIGN_EVERY);
    net.send(0, &proof(&PROVES));
    net.router.round(2 * LIFESIGN_EVERY);
    assert!(net.endings().is_empty(), "it proved itself in time");
    assert!(!net.reads(0).is_empty(), "and is asked as all are");
}

/// Neither packages of others nor answers leave for them; a name that one has asked for is nobody's.
#[test]
fn strangers_hear_nothing() {
    let mut net = Net::of(2);
    let strangers = [None, Some(PROVES)].map(|proof| {
        let connection = net.router.connect_by_tls(PEER, 0);
        proof.into_iter().for_each(|proof| net.router.secured(connection, Some(proof)));
        net.read.push(Vec::new());
        connection.0 as usize
    });
    net.register(0, 1);
    net.register(1, 2);
    let asks = registration();
    net.send(strangers[1], &asks[..5]);
    net.send(0, &package(21, 2, 1, b"not for strangers"));
    net.send(1, &package(0, 1, 2, b"nor is this"));
    net.router.round(LIFESIGN_EVERY);
    net.send(strangers[1], &asks[5..]);
    net.reads(0);
    net.send(0, &package(21, REGISTERS, 1, b"to the name that it asked for"));
    assert_eq!(Head::parse(&net.reads(0)).unwrap().kind, wire::NOT_AVAILABLE);
    assert_eq!(net.endings(), [(strangers[1] as u32, Ending::Stranger)]);
    for stranger in strangers {
        assert!(net.reads(stranger).is_empty());
        assert_eq!(net.counters(stranger), Counters::default());
    }
}

#[test]
fn strangers_take_neither_memory_nor_the_place_of_clients() {
    let mut net = untrusted();
    let mut long = proof(&[0; 1_000]);
    long.pop();
    net.send(0, &long);
    assert_eq!(net.endings(), [(0, Ending::Stranger)]);
    net.router.disconnect(Connection(0), Ending::Stranger, 0);
    let came: Vec<_> = (0..UNTRUSTED + 10).map(|_| net.router.connect_by_tls(PEER, 0)).collect();
    let mut crowded = net.endings();
    crowded.reverse();
    assert_eq!(crowded, came[..10].iter().map(|of| (of.0, Ending::Crowded)).collect::<Vec<_>>());
    // One that proves itself in time takes no place among them any more.
    let newest = *came.last().unwrap();
    net.router.secured(newest, None);
    net.router.connect_by_tls(PEER, 0);
    assert!(net.endings().is_empty());
    (0..UNTRUSTED).for_each(|_| _ = net.router.connect_by_tls(PEER, 0));
    assert!(net.endings().iter().all(|(of, _)| *of != newest.0));
    assert!(net.router.connect(PEER, 0).is_ok(), "others come in");
}

#[test]
fn strangers_take_no_connection_of_clients() {
    let limits = Limits { connections: 2, ..Limits::default() };
    let mut net = Net { router: Router::new(limits, 0), read: Vec::new(), now: 0 };
    let strangers: Vec<_> = (0..10).map(|_| net.router.connect_by_tls(PEER, 0)).collect();
    net.router.connect(PEER, 0).unwrap();
    net.router.secured(strangers[3], None);
    assert_eq!((net.endings(), net.router.connect(PEER, 0)), (vec![], Err(TooMany)), "two are two");
    net.router.secured(strangers[4], Some(PROVES));
    net.router.received(strangers[4], &proof(&PROVES), 0);
    net.router.secured(strangers[5], None);
    assert_eq!(net.endings(), [5, 4].map(|of| (strangers[of].0, Ending::TooMany)));
    assert_eq!(net.router.status(0).counters.connections_refused, 3);
    [4, 5].into_iter().for_each(|of| net.router.disconnect(strangers[of], Ending::TooMany, 0));
    net.router.disconnect(strangers[3], Ending::Left, 0);
    assert!(net.router.connect(PEER, 0).is_ok(), "one has left");
}

/// The connections that made room for others, in that order.
fn crowded(router: &mut Router) -> Vec<Connection> {
    let mut ended: Vec<_> = core::iter::from_fn(|| router.next_ending()).map(|(of, _)| of).collect();
    ended.reverse();
    ended
}

#[test]
fn a_crowd_of_one_network_makes_room_for_others() {
    for networks in [["10.0.0.1", "10.0.0.2"], ["2001:db8::1", "2001:db8:0:1::1"]] {
        let [one, other] = networks.map(|of| of.parse::<IpAddr>().unwrap());
        let mut router = Router::new(Limits::default(), 0);
        let client = router.connect_by_tls((one, 1).into(), 0);
        let addresses = (0..10_000u16).map(|number| match other {
            IpAddr::V4(_) => (other, number).into(),
            IpAddr::V6(of) => (IpAddr::V6((u128::from(of) + u128::from(number)).into()), 1).into(),
        });
        let crowd: Vec<_> = addresses.map(|peer| router.connect_by_tls(peer, 0)).collect();
        assert_eq!(crowded(&mut router), crowd[..10_000 + 1 - UNTRUSTED], "its oldest; {client:?} stays");
    }
}

#[test]
fn the_oldest_makes_room_where_no_network_crowds() {
    let mut router = Router::new(Limits::default(), 0);
    let from = |number: u16| SocketAddr::from(([10, 0, (number >> 8) as u8, number as u8], 1));
    let all: Vec<_> = (0..1_000).rev().map(|number| router.connect_by_tls(from(number), 0)).collect();
    assert_eq!(crowded(&mut router), all[..1_000 - UNTRUSTED]);
}
