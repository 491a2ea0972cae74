// Clients wait for their router.
#![allow(clippy::disallowed_methods)]

use std::net::TcpStream as Std;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Instant;

use super::*;
use crate::name::MailboxName;
use crate::tcp::control::LIFESIGN;
use crate::tcp::hex;
use crate::wire::{self, HEAD_LEN, Head};

const PATIENCE: Duration = Duration::from_secs(30);

struct Running {
    at: SocketAddr,
    remote: Remote,
    thread: Option<JoinHandle<()>>,
}

impl Running {
    fn start(limits: Limits) -> Self {
        let mut server = Server::listen(&[("127.0.0.1:0".parse().unwrap(), None)], limits).unwrap();
        let (at, remote) = (server.addresses().unwrap()[0], server.remote());
        let thread = std::thread::spawn(move || server.run().unwrap());
        Self { at, remote, thread: Some(thread) }
    }

    fn connect(&self) -> Std {
        let stream = Std::connect(self.at).unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream
    }

    fn status(&self) -> Status {
        self.remote.status(PATIENCE).unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.remote.stop();
        self.thread.take().map(JoinHandle::join);
    }
}

/// Sets a flag when dropped, also by a panic: threads of a scope that look at it end.
struct AtEnd<'a>(&'a AtomicBool);

impl Drop for AtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn package(kind: i8, to: u32, from: u32, body: &[u8]) -> Vec<u8> {
    let head = Head::new(kind, MailboxName(to), MailboxName(from)).with_body(body.len()).unwrap();
    [&head.to_bytes()[..], body].concat()
}

fn read(from: &mut Std) -> (Head, Vec<u8>) {
    let mut head = [0; HEAD_LEN];
    from.read_exact(&mut head).unwrap();
    let head = Head::parse(&head).unwrap();
    let mut body = vec![0; head.body_len()];
    from.read_exact(&mut body).unwrap();
    (head, body)
}

fn register(stream: &mut Std, name: u32) {
    stream.write_all(&package(13, 0, 0, &name.to_le_bytes())).unwrap();
    assert_eq!(read(stream).0.kind, wire::OK);
}

fn eventually(running: &Running, holds: impl Fn(&Status) -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds(&running.status()) {
        assert!(Instant::now() < deadline, "{:?}", running.status());
        std::thread::yield_now();
    }
}

#[test]
fn packages_of_any_length_go_from_one_connection_to_another() {
    let running = Running::start(Limits::default());
    let (mut a, mut b) = (running.connect(), running.connect());
    register(&mut b, 2);
    for length in [0, 1, 5_000, wire::MAX_LEN - HEAD_LEN] {
        a.write_all(&package(-6, 2, 1, &vec![length as u8; length])).unwrap();
        let (head, body) = read(&mut b);
        assert_eq!((head.body_len(), body), (length, vec![length as u8; length]));
    }
    a.write_all(&package(4, 9, 1, &[])).unwrap();
    assert_eq!(read(&mut a).0.kind, wire::NOT_AVAILABLE);
}

/// Two clients answer each other for more than a round, for which the loop polls where it may; a third is asked for a sign of life, and
/// questions of other threads are answered.
#[test]
fn a_busy_loop_keeps_its_rounds_and_answers() {
    let running = Running::start(Limits::default());
    let (mut a, mut b, mut third) = (running.connect(), running.connect(), running.connect());
    register(&mut a, 1);
    register(&mut b, 2);
    let (to_a, to_b) = (package(-6, 1, 2, &[]), package(-6, 2, 1, &[]));
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                a.write_all(&to_b).unwrap();
                while read(&mut b).0.kind != -6 {}
                b.write_all(&to_a).unwrap();
                while read(&mut a).0.kind != -6 {}
            }
        });
        let mut asked = [0; HEAD_LEN];
        let begun = Instant::now();
        let read = third.read_exact(&mut asked);
        // A Java client gives up after 10 s.
        let waited = begun.elapsed();
        let status = running.remote.status(PATIENCE);
        is_over.store(true, Ordering::Relaxed);
        read.unwrap();
        assert!(waited < Duration::from_secs(10), "{waited:?}");
        assert_eq!(Head::parse(&asked).unwrap().kind, LIFESIGN);
        assert!(status.unwrap().counters.packages_out > 0);
    });
}

/// Section 5.3 of the reference: J is a Java client (big-endian), J2 another, C a client in C (little-endian).
#[test]
fn bytes_on_sockets_are_those_of_real_peers() {
    let running = Running::start(Limits::default());
    let (mut j, mut j2, mut c) = (running.connect(), running.connect(), running.connect());
    let reads = |from: &mut Std, expected: &str| {
        let expected = hex(expected);
        let mut bytes = vec![0; expected.len()];
        from.read_exact(&mut bytes).unwrap();
        assert_eq!(bytes, expected);
    };
    j.write_all(&hex("000d0000 00000000 00000000 00000014 00100100")).unwrap();
    reads(&mut j, "03000000 00000000 00000000 10000000");
    j2.write_all(&hex("000d0000 00000000 00000000 00000014 00100200")).unwrap();
    reads(&mut j2, "03000000 00000000 00000000 10000000");
    j.write_all(&hex("00154d2a 00100200 00100100 00000015 68656c6c6f")).unwrap();
    reads(&mut j2, "01154d2a 00021000 00011000 15000000 68656c6c6f");
    j.write_all(&hex("0003052b 00106300 00100100 00000010")).unwrap();
    reads(&mut j, "03fd052b 00011000 00631000 10000000");
    // A reply to an unknown name has no answer: the next bytes are those of the lifesign.
    j.write_all(&hex("00fa052c 00106300 00100100 00000010")).unwrap();
    c.write_all(&hex("030d0000 00000000 00000000 14000000")).unwrap();
    c.write_all(&hex("00001c00")).unwrap();
    reads(&mut c, "03000000 00000000 00000000 10000000");
    c.write_all(&hex("03130000 00000000 00000000 10000000")).unwrap();
    reads(&mut j, "03110000 00000000 00000000 10000000");
    j.write_all(&hex("00000000 00000000 00000000 00000010")).unwrap();
    reads(&mut j2, "03110000 00000000 00000000 10000000");
    j.write_all(&hex("00060000 001c0000 00100100 00000010")).unwrap();
    reads(&mut c, "01060000 00001c00 00011000 10000000");

    // M is a module, in little-endian; J has two mailboxes for its records, and one for messages.
    let mut m = running.connect();
    register(&mut m, 0x0011_0000);
    for name in ["00020700", "00020701", "00010000"] {
        j.write_all(&hex(&format!("000d0000 00000000 00000000 00000014 {name}"))).unwrap();
        reads(&mut j, "03000000 00000000 00000000 10000000");
    }
    j.write_all(&hex("0006000a 00110000 00020700 00000018 00000000 00020701")).unwrap();
    reads(&mut m, "0106000a 00001100 00070200 18000000 00000000 00020701");
    let record = "01".repeat(36);
    for answer in [
        "03f9000a 00070200 00001100 14000000 64000000".to_owned(),
        format!("03fa000a 01070200 00001100 34000000 {record}"),
        "03840100 00000100 00001100 1b000000 4d6f64756c65206f6e0a00".to_owned(),
    ] {
        m.write_all(&hex(&answer)).unwrap();
        reads(&mut j, &answer);
    }
}

#[test]
fn a_connection_that_does_not_read_disturbs_no_other() {
    let running = Running::start(Limits { queue: 1 << 20, ..Limits::default() });
    let (mut a, mut b, mut deaf) = (running.connect(), running.connect(), running.connect());
    register(&mut b, 2);
    register(&mut deaf, 3);
    let long = package(-6, 3, 1, &[0; 100_000]);
    for _ in 0..400 {
        a.write_all(&long).unwrap();
    }
    a.write_all(&package(-6, 2, 1, b"past it")).unwrap();
    assert_eq!(read(&mut b).1, b"past it");
    let status = running.status();
    assert!(status.counters.queue_full > 100, "{status:?}");
    assert!(status.clients.iter().all(|client| client.waiting_bytes <= 1 << 20));
}

#[test]
fn why_a_connection_was_closed_is_remembered() {
    let running = Running::start(Limits::default());
    let (a, mut b) = (running.connect(), running.connect());
    eventually(&running, |status| status.clients.len() == 2);
    b.write_all(&[0xff; HEAD_LEN]).unwrap();
    assert_eq!(b.read(&mut [0]).unwrap(), 0, "it is closed");
    drop(a);
    eventually(&running, |status| status.clients.is_empty());
    let why: Vec<_> = running.status().closed.iter().map(|closed| closed.why.clone()).collect();
    assert!(matches!(why[..], [Ending::Left, Ending::NoPackage(_)]), "{why:?}");
}

#[test]
fn a_name_is_free_again_once_its_connection_is_closed() {
    let running = Running::start(Limits::default());
    for _ in 0..50 {
        let mut client = running.connect();
        register(&mut client, 7);
        drop(client);
        eventually(&running, |status| status.clients.is_empty());
    }
}

#[test]
fn connections_beyond_the_limit_are_closed_and_counted() {
    let running = Running::start(Limits { connections: 2, ..Limits::default() });
    let (mut a, mut b) = (running.connect(), running.connect());
    register(&mut a, 1);
    register(&mut b, 2);
    let mut c = running.connect();
    assert_eq!(c.read(&mut [0]).unwrap_or(0), 0);
    assert_eq!(running.status().counters.connections_refused, 1);
    drop(a);
    eventually(&running, |status| status.clients.len() == 1);
    register(&mut running.connect(), 1);
}

#[test]
fn floods_keep_no_lifesign_from_the_others() {
    const FLOODS: usize = 8;
    let running = Running::start(Limits::default());
    let mut quiet = running.connect();
    register(&mut quiet, 2);
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..FLOODS {
            let mut flood = running.connect();
            let is_over = &is_over;
            scope.spawn(move || {
                // Each read of the router finds as much as it takes.
                let batch = package(-6, 9, 1, &[0; 100]).repeat(100_000);
                while !is_over.load(Ordering::Relaxed) {
                    flood.write_all(&batch).unwrap();
                }
            });
        }
        let _ends = AtEnd(&is_over);
        // Replies are due within 1 s. A busy host may take a single one longer.
        let (mut replies, mut is_asked) = ([Duration::ZERO; 9], false);
        for (reply, name) in replies.iter_mut().zip(100u32..) {
            let begun = Instant::now();
            quiet.write_all(&package(13, 0, 0, &name.to_le_bytes())).unwrap();
            while read(&mut quiet).0.kind == LIFESIGN {
                is_asked = true;
            }
            *reply = begun.elapsed();
        }
        replies.sort_unstable();
        assert!(replies[4] < Duration::from_secs(1), "{replies:?}");
        assert!(is_asked || read(&mut quiet).0.kind == LIFESIGN);
    });
}

/// A client that neither answers nor closes its connection, as one whose host is gone, is closed within two rounds.
#[test]
fn a_ghost_is_closed_and_its_name_is_free_again() {
    let running = Running::start(Limits::default());
    let (mut ghost, mut heir) = (running.connect(), running.connect());
    register(&mut ghost, 7);
    // This one is not asked.
    heir.write_all(&package(19, 0, 0, &[])).unwrap();
    heir.write_all(&package(13, 0, 0, &7u32.to_le_bytes())).unwrap();
    assert_eq!(read(&mut heir).0.kind, wire::ERROR);
    // It is closed at the second question.
    let mut room = Vec::new();
    ghost.set_read_timeout(Some(PATIENCE)).unwrap();
    let _ = ghost.read_to_end(&mut room);
    eventually(&running, |status| status.endings["silent"] == 1);
    register(&mut heir, 7);
    let status = running.status();
    let [closed] = &status.closed[..] else { panic!("{status:?}") };
    assert_eq!((&closed.why, &closed.names[..]), (&Ending::Silent, &[MailboxName(7)][..]));
    assert!((5_000..20_000).contains(&closed.open_for), "{closed:?}");
}

/// The kernel resets a connection that is closed with unread bytes: what it has not sent yet is lost then.
#[test]
fn what_waits_at_the_end_arrives() {
    // More than a kernel takes at once, and little enough for a busy host: the end takes 1 s at the most.
    const PACKAGES: usize = 400;
    let running = Running::start(Limits::default());
    let (mut a, mut b) = (running.connect(), running.connect());
    register(&mut b, 2);
    a.write_all(&package(-6, 2, 1, &[0; 1_000]).repeat(PACKAGES)).unwrap();
    eventually(&running, |status| status.counters.packages_in == PACKAGES as u64);
    let mut talks = b.try_clone().unwrap();
    let talker =
        std::thread::spawn(move || while talks.write_all(&package(-6, 9, 2, &[0; 10_000])).is_ok() {});
    let end = std::thread::spawn(move || drop(running));
    let (mut came, mut bytes) = (0, Vec::new());
    let _ = b.read_to_end(&mut bytes);
    let mut rest = &bytes[..];
    while let Ok(head) = Head::parse(rest)
        && let Some((_, behind)) = rest.split_at_checked(head.len as usize)
    {
        came += usize::from(head.kind == -6);
        rest = behind;
    }
    assert_eq!(came, PACKAGES);
    end.join().unwrap();
    talker.join().unwrap();
}
