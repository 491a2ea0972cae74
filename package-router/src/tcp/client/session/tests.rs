use core::net::{IpAddr, Ipv4Addr, SocketAddr};

use super::*;
use crate::tcp::requests::OPEN_AT_MOST;
use crate::tcp::router::{Connection, Limits, Router};
use crate::wire::{ERROR, NOT_AVAILABLE};
use proptest::collection::vec;
use proptest::prelude::*;

const PEER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 9);
const PILOT: MailboxName = MailboxName(0x0018_0000);
const CHASSIS: MailboxName = MailboxName(0x0011_0000);

fn names(all: &[MailboxName]) -> BTreeSet<MailboxName> {
    all.iter().copied().collect()
}

fn nothing(_: &mut Vec<u8>) -> bool {
    false
}

/// All that it writes now.
fn written(session: &mut Session) -> Vec<u8> {
    let mut bytes = Vec::new();
    let all = session.write(nothing, |part| {
        bytes.extend_from_slice(part);
        Ok(part.len())
    });
    assert_eq!(all.unwrap(), Written::All);
    bytes
}

fn package(kind: i8, to: MailboxName, from: MailboxName, body: &[u8]) -> Vec<u8> {
    let head = Head::new(kind, to, from).with_body(body.len()).unwrap();
    [&head.to_bytes()[..], body].concat()
}

/// The kinds of everything that a session writes while `packages` packages wait.
fn sent(session: &mut Session, packages: usize) -> Vec<i8> {
    let (mut waiting, mut kinds) = (vec![package(-6, CHASSIS, PILOT, b"data"); packages], Vec::new());
    let next = |batch: &mut Vec<u8>| waiting.pop().map(|package| batch.extend(package)).is_some();
    let write = |part: &[u8]| {
        Frames::default().cut(part, |head, _| kinds.push(head.kind)).unwrap();
        Ok(part.len())
    };
    session.write(next, write).unwrap();
    kinds
}

fn came(session: &mut Session, bytes: &[u8], now: u64) -> Vec<Head> {
    let mut all = Vec::new();
    session.received(bytes, now, |head, _| all.push(*head)).unwrap();
    all
}

/// A reply of the router to the request with this id.
fn reply(kind: i8, id: u8) -> [u8; HEAD_LEN] {
    Head { id, ..Head::new(kind, MailboxName::NOBODY, MailboxName::NOBODY) }.to_bytes()
}

#[test]
fn names_are_registered_as_mailboxes_come_and_go() {
    let mut session = Session::default();
    session.connected(0, None);
    assert!(written(&mut session).is_empty());
    session.set_names(&names(&[PILOT, CHASSIS]));
    let asked = written(&mut session);
    assert_eq!(asked.len(), 2 * (HEAD_LEN + 4));
    assert_eq!(asked[..4], [3, 13, 0, 1], "registered, with an answer");
    assert_eq!(session.names(), (0, 2));
    assert!(came(&mut session, &[reply(OK, 1), reply(OK, 2)].concat(), 5).is_empty());
    assert_eq!(session.names(), (2, 0));
    session.set_names(&names(&[PILOT]));
    let gone = written(&mut session);
    assert_eq!((gone[1], &gone[HEAD_LEN..]), (12, &CHASSIS.0.to_le_bytes()[..]));
    session.set_names(&names(&[PILOT]));
    assert!(written(&mut session).is_empty(), "nothing has changed");
}

#[test]
fn a_refused_name_is_asked_for_again_until_it_is_free() {
    let mut session = Session::default();
    session.connected(0, None);
    session.set_names(&names(&[PILOT]));
    written(&mut session);
    came(&mut session, &reply(ERROR, 1), 100);
    assert_eq!((session.names(), session.next_due(true)), ((0, 1), 100 + RETRY));
    session.retry(99 + RETRY);
    assert!(written(&mut session).is_empty());
    session.retry(100 + RETRY);
    assert_eq!(written(&mut session)[..4], [3, 13, 0, 2]);
    came(&mut session, &reply(OK, 2), 1_200);
    assert_eq!((session.names(), session.counters().names_refused), ((1, 0), 1));
}

#[test]
fn a_new_connection_registers_all_before_it_sends() {
    let mut session = Session::default();
    session.connected(0, None);
    session.set_names(&names(&[PILOT]));
    session.connected(10, None);
    let mut waiting = vec![package(1, CHASSIS, PILOT, b"go")];
    let mut bytes = Vec::new();
    session
        .write(
            |batch| waiting.pop().map(|package| batch.extend(package)).is_some(),
            |part| {
                bytes.extend_from_slice(part);
                Ok(part.len())
            },
        )
        .unwrap();
    let register = HEAD_LEN + 4;
    let account = register + HEAD_LEN + 2;
    let confirm = account + HEAD_LEN;
    assert_eq!(
        ([1, register + 1, account + 1, confirm + 1].map(|at| bytes[at]), bytes.len()),
        ([13, 1, 22, 14], confirm + HEAD_LEN + 4)
    );
}

/// However many packages wait, a sign of life leaves after the batch that has begun.
#[test]
fn signs_of_life_and_answers_overtake_packages() {
    let mut session = Session::default();
    session.connected(0, None);
    let one = package(-6, CHASSIS, PILOT, &[7; 1000]);
    let endless = |batch: &mut Vec<u8>| {
        batch.extend_from_slice(&one);
        true
    };
    assert_eq!(session.write(endless, |_| Err(io::ErrorKind::WouldBlock.into())).unwrap(), Written::Blocked);
    let begun = session.batch.len();
    assert!((BATCH..BATCH + one.len() + 2 * HEAD_LEN + 4).contains(&begun));
    came(&mut session, &reply(LIFESIGN, 0), 5);
    session.answer(&Head::new(NOT_AVAILABLE, CHASSIS, PILOT));
    let mut bytes = Vec::new();
    let more = session.write(endless, |part| {
        bytes.extend_from_slice(part);
        Ok(part.len())
    });
    assert_eq!(more.unwrap(), Written::More, "other work has its turn");
    // Answers to packages came first, the sign of life was asked for before, and both are behind one batch.
    assert_eq!((bytes[begun + 1] as i8, bytes[begun + HEAD_LEN + 1] as i8), (NOT_AVAILABLE, OK));
}

#[test]
fn packages_that_were_not_written_are_counted_as_lost() {
    let mut session = Session::default();
    session.connected(0, None);
    let mut waiting: Vec<_> = (0..5).map(|_| package(-6, CHASSIS, PILOT, &[1; 84])).collect();
    let mut room = 250;
    session
        .write(
            |batch| waiting.pop().map(|package| batch.extend(package)).is_some(),
            |part| match core::mem::take(&mut room).min(part.len()) {
                0 => Err(io::ErrorKind::WouldBlock.into()),
                sent => Ok(sent),
            },
        )
        .unwrap();
    assert_eq!((session.counters().sent, session.counters().bytes_sent), (2, 250));
    session.disconnected();
    assert_eq!(
        (session.counters().lost, session.counters().unconfirmed),
        (3, 2),
        "one of the three had begun"
    );
}

#[test]
fn written_packages_are_unconfirmed_until_the_router_answers() {
    let mut session = Session::default();
    session.connected(0, None);
    assert_eq!(sent(&mut session, 2), [-6, -6, ACCOUNT, CONFIRM]);
    assert_eq!(sent(&mut session, 3), [-6; 3], "one question waits already");
    came(&mut session, &reply(OK, 2), 1);
    assert_eq!(sent(&mut session, 0), [ACCOUNT, CONFIRM], "the other three are asked for then");
    session.disconnected();
    assert_eq!((session.counters().sent, session.counters().unconfirmed), (5, 3));
    session.connected(2, None);
    assert_eq!(sent(&mut session, 1), [-6, ACCOUNT, CONFIRM]);
    came(&mut session, &reply(OK, 6), 3);
    assert!(sent(&mut session, 0).is_empty(), "an idle client asks nothing");
    session.disconnected();
    assert_eq!((session.counters().sent, session.counters().unconfirmed), (6, 3));
}

/// A session and our router.
struct Joined {
    router: Router,
    session: Session,
    connection: Connection,
}

impl Joined {
    fn new() -> Self {
        let (mut router, mut session) = (Router::new(Limits::default(), 0), Session::default());
        let connection = router.connect(PEER, 0).unwrap();
        session.connected(0, None);
        Self { router, session, connection }
    }

    /// Sends packages to a name, and all else that the session has to send; it reads what the router answers.
    fn sends(&mut self, to: MailboxName, packages: usize, now: u64) {
        let mut waiting = vec![package(-6, to, PILOT, b"data"); packages];
        let next = |batch: &mut Vec<u8>| waiting.pop().map(|package| batch.extend(package)).is_some();
        let mut bytes = Vec::new();
        let write = |part: &[u8]| {
            bytes.extend_from_slice(part);
            Ok(part.len())
        };
        self.session.retry(now);
        self.session.write(next, write).unwrap();
        self.router.received(self.connection, &bytes, now);
        let answers = left_for(&mut self.router, self.connection);
        assert!(came(&mut self.session, &answers, now).is_empty());
    }
}

/// All that waits for a connection.
fn left_for(router: &mut Router, connection: Connection) -> Vec<u8> {
    let mut bytes = Vec::new();
    let read = |parts: &[io::IoSlice<'_>]| {
        parts.iter().for_each(|part| bytes.extend_from_slice(part));
        Ok(parts.iter().map(|part| part.len()).sum())
    };
    assert!(router.write(connection, read).unwrap());
    bytes
}

#[test]
fn a_router_gives_account_of_what_it_did_not_pass_on() {
    let mut joined = Joined::new();
    for (packages, all) in [(3, 3), (2, 5)] {
        joined.sends(CHASSIS, packages, 0);
        let lost = Lost { nobody_there: all, ..Lost::default() };
        assert_eq!(joined.session.counters().lost_at_router, lost);
        joined.session.connected(0, None);
        joined.connection = joined.router.connect(PEER, 0).unwrap();
    }
    assert_eq!((joined.session.counters().sent, joined.session.counters().unconfirmed), (5, 0));
}

#[test]
fn packages_that_wait_at_the_router_are_not_confirmed() {
    let mut joined = Joined::new();
    let receiver = joined.router.connect(PEER, 0).unwrap();
    let head = request(REGISTER, 0, &CHASSIS.0.to_le_bytes());
    joined.router.received(receiver, &[&head.to_bytes()[..], &CHASSIS.0.to_le_bytes()].concat(), 0);
    left_for(&mut joined.router, receiver);
    joined.sends(CHASSIS, 3, 0);
    let unsettled = |joined: &Joined| joined.session.counters().sent - joined.session.settled;
    assert_eq!((unsettled(&joined), joined.session.is_read()), (3, true));
    assert_eq!(joined.session.next_due(false), SILENCE, "nothing can be written");
    assert_eq!(joined.session.next_due(true), CONFIRM_AGAIN, "it is asked again then");
    left_for(&mut joined.router, receiver);
    joined.sends(CHASSIS, 0, CONFIRM_AGAIN - 1);
    assert_eq!(unsettled(&joined), 3, "it is not asked before");
    joined.sends(CHASSIS, 0, CONFIRM_AGAIN);
    assert_eq!(unsettled(&joined), 3, "they have left, and not arrived");
    joined.router.written(receiver, 1);
    joined.router.arrived(receiver, 1);
    joined.sends(CHASSIS, 0, 2 * CONFIRM_AGAIN);
    assert_eq!(unsettled(&joined), 0);
    joined.sends(CHASSIS, 2, 2 * CONFIRM_AGAIN);
    joined.session.disconnected();
    assert_eq!((joined.session.counters().sent, joined.session.counters().unconfirmed), (5, 2));
}

#[test]
fn an_account_that_cannot_be_changes_nothing() {
    let account = |kind: i8, id: u8, body: &[u8]| {
        let head = Head { id, ..Head::new(kind, MailboxName::NOBODY, MailboxName::NOBODY) };
        [&head.with_body(body.len()).unwrap().to_bytes()[..], body].concat()
    };
    let mut session = Session::default();
    session.connected(0, None);
    let lost = Lost { forbidden: 7, ..Lost::default() };
    let good = Account { lost, waiting: 0 }.to_bytes();
    let none = Account::default().to_bytes();
    // Each question has the id after the one before: those for an account are the odd ones.
    for (id, kind, body) in
        [(1, OK, &good[..]), (3, ERROR, &good), (5, OK, &good[1..]), (7, OK, &[]), (9, OK, &none)]
    {
        assert_eq!(sent(&mut session, 1), [-6, ACCOUNT, CONFIRM]);
        came(&mut session, &[&account(kind, id, body)[..], &reply(OK, id + 1)].concat(), 1);
        assert_eq!(session.counters().lost_at_router, lost, "{id}");
    }
}

/// It may have guessed the id of a question that has not left.
#[test]
fn an_early_answer_confirms_no_more_than_was_sent() {
    let mut session = Session::default();
    session.connected(0, None);
    let mut waiting = vec![package(-6, CHASSIS, PILOT, b"data")];
    let next = |batch: &mut Vec<u8>| waiting.pop().map(|package| batch.extend(package)).is_some();
    session.write(next, |_| Err(io::ErrorKind::WouldBlock.into())).unwrap();
    came(&mut session, &reply(OK, 2), 1);
    session.disconnected();
    assert_eq!((session.counters().sent, session.counters().lost, session.counters().unconfirmed), (0, 1, 0));
}

/// As many at a time as a router surely answers.
#[test]
fn many_mailboxes_are_registered_before_the_first_package() {
    let mut session = Session::default();
    let all: BTreeSet<_> = (1..=1_000).map(MailboxName).collect();
    session.set_names(&all);
    session.connected(0, None);
    let (mut asked, mut packages) = (0, 0);
    while packages == 0 {
        let kinds = sent(&mut session, 1);
        let open: Vec<u8> = session.requests.ids().collect();
        assert!(!kinds.is_empty() && open.len() <= OPEN_AT_MOST + 2);
        asked += kinds.iter().filter(|kind| **kind == REGISTER).count();
        packages += kinds.iter().filter(|kind| **kind == -6).count();
        open.into_iter().for_each(|id| _ = came(&mut session, &reply(OK, id), 1));
    }
    assert_eq!((asked, session.names()), (1_000, (1_000, 0)));
}

#[test]
fn a_mailbox_that_goes_and_comes_is_as_its_last_answer_says() {
    let mut session = Session::default();
    session.connected(0, None);
    for here in [&names(&[PILOT]), &names(&[]), &names(&[PILOT])] {
        session.set_names(here);
        sent(&mut session, 0);
    }
    came(&mut session, &reply(ERROR, 1), 1);
    assert_eq!((session.names(), session.counters().names_refused), ((0, 1), 0));
    session.retry(2 * RETRY);
    assert!(sent(&mut session, 0).is_empty(), "it is asked for already");
    came(&mut session, &reply(OK, 2), 2 * RETRY);
    assert_eq!(session.names(), (1, 0));
}

#[test]
fn a_router_that_is_silent_counts_as_gone() {
    let mut session = Session::default();
    session.connected(1_000, None);
    assert_eq!((session.next_due(true), session.is_silent(999 + SILENCE)), (1_000 + SILENCE, false));
    came(&mut session, &reply(LIFESIGN, 0), 5_000);
    assert!(!session.is_silent(1_000 + SILENCE) && session.is_silent(5_000 + SILENCE));
}

#[test]
fn one_that_asks_and_does_not_read_gets_no_more_answers() {
    let mut session = Session::default();
    session.connected(0, None);
    (0..10_000).for_each(|_| session.answer(&Head::new(NOT_AVAILABLE, CHASSIS, PILOT)));
    assert!(session.own.len() <= ANSWERS);
    assert_eq!(session.counters().answers_lost, 10_000 - (ANSWERS / HEAD_LEN) as u64);
    (0..10_000).for_each(|_| _ = came(&mut session, &reply(LIFESIGN, 0), 1));
    assert_eq!(
        written(&mut session).len(),
        ANSWERS / HEAD_LEN * HEAD_LEN + HEAD_LEN,
        "one sign of life is enough"
    );
}

proptest! {
    /// Whatever a router sends, in whatever pieces.
    #[test]
    fn any_bytes_of_a_router_are_read_or_end_the_connection(bytes in vec(any::<u8>(), 0..600), at_once in 1..40usize) {
        let mut session = Session::default();
        session.connected(0, None);
        session.set_names(&names(&[PILOT, CHASSIS]));
        for part in bytes.chunks(at_once) {
            if session.received(part, 1, |_, _| ()).is_err() {
                break;
            }
            sent(&mut session, at_once % 3);
        }
        session.disconnected();
        let SessionCounters { sent, unconfirmed, .. } = session.counters();
        prop_assert!(unconfirmed <= sent);
    }

    /// Two sessions at our router: after any course of mailboxes, deaths and silence each has the names that it should have.
    #[test]
    fn sessions_and_a_router_agree_on_names(course in vec((0..2usize, 0..6u8), 1..60)) {
        let mut now = 0;
        let mut router = Router::new(Limits::default(), now);
        let peer = "127.0.0.1:9".parse().unwrap();
        let mut sessions = [Session::default(), Session::default()];
        let mut connections: [Connection; 2] = core::array::from_fn(|_| router.connect(peer, now).unwrap());
        let mut wanted = [BTreeSet::new(), BTreeSet::new()];
        sessions.iter_mut().for_each(|session| session.connected(now, None));
        let settle = |router: &mut Router, sessions: &mut [Session; 2], connections: &[Connection; 2], now: u64| {
            for (session, connection) in sessions.iter_mut().zip(connections) {
                session.retry(now);
                router.received(*connection, &written(session), now);
                let mut bytes = Vec::new();
                router
                    .write(*connection, |slices| {
                        slices.iter().for_each(|slice| bytes.extend_from_slice(slice));
                        Ok(slices.iter().map(|slice| slice.len()).sum())
                    })
                    .unwrap();
                assert!(came(session, &bytes, now).is_empty());
            }
        };
        for (which, event) in course {
            now += 100;
            // Each has instances of its own, and instance 9 is wanted by both.
            let name = MailboxName(0x0018_0000 | if event == 3 { 9 } else { which as u32 * 16 + u32::from(event) } << 8);
            match event {
                0..=3 => {
                    if !wanted[which].remove(&name) {
                        wanted[which].insert(name);
                    }
                    sessions[which].set_names(&wanted[which]);
                }
                4 => {
                    router.disconnect(connections[which], crate::tcp::router::Ending::Left, now);
                    connections[which] = router.connect(peer, now).unwrap();
                    sessions[which].connected(now, None);
                }
                _ => now += RETRY,
            }
            settle(&mut router, &mut sessions, &connections, now);
        }
        for _ in 0..4 {
            now += RETRY;
            settle(&mut router, &mut sessions, &connections, now);
        }
        for (which, session) in sessions.iter().enumerate() {
            let both = wanted[1 - which].intersection(&wanted[which]).count();
            let (registered, not) = session.names();
            prop_assert_eq!(registered + not, wanted[which].len());
            prop_assert!(not <= both, "{} of {:?} are not registered", not, &wanted);
        }
        let not: usize = sessions.iter().map(|session| session.names().1).sum();
        prop_assert_eq!(not, wanted[0].intersection(&wanted[1]).count(), "one of both has it");
    }
}
