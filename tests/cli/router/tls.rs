//! A router that is reached by TLS: clients with a certificate or the secret come in, and nobody else.

use std::collections::VecDeque;
use std::fs;
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox, Sender};
use package_router::mailbox::Shape;
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::TcpOptions;
use package_router::tcp::keys::{ClientKeys, SECRET_AT_LEAST};

use super::languages::{Program, in_c, in_python};
use super::{AtEnd, Router, not_started, package, refusal};
use crate::cell::{text, wait_until};
use crate::host::figure;
use crate::rtnet;

const PATIENCE: Duration = Duration::from_secs(30);

/// Keys, as the verb makes them.
pub struct Keys(tempfile::TempDir);

impl Keys {
    pub fn new() -> Self {
        let keys = Self(tempfile::tempdir().unwrap());
        let output = rtnet().args(["router", "keys"]).arg(keys.0.path().join("keys")).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        keys
    }

    pub fn of(&self, whose: &str) -> PathBuf {
        self.0.path().join("keys").join(whose)
    }

    fn router(&self, what: &str) -> Router {
        let keys = self.of("router");
        Router::start(what, &["--listen", "127.0.0.1:0", "--keys", keys.to_str().unwrap()])
    }

    /// A client without a certificate.
    pub fn has_only_a_secret(self) -> Self {
        for file in ["client.pem", "client.key"] {
            fs::remove_file(self.of("client").join(file)).unwrap();
        }
        self
    }
}

fn name(instance: u8) -> MailboxName {
    MailboxName::new(0, Class(0x80), instance, 0)
}

/// A component on a host without a station, which may be let in or not.
fn component(router: &Router, keys: &Path, instance: u8) -> (Component, Mailbox) {
    component_at(router.at, keys, instance)
}

fn component_at(at: SocketAddr, keys: &Path, instance: u8) -> (Component, Mailbox) {
    let options = TcpOptions {
        keys: Some(ClientKeys::read(keys).unwrap()),
        largest_body: 200_000,
        ..TcpOptions::new(at.to_string().parse().unwrap())
    };
    let component = Component::of_router(&options).unwrap();
    let mailbox = component.mailbox(name(instance), Shape::new(4, 200_000)).unwrap();
    (component, mailbox)
}

fn registered(component: &Component) {
    wait_until("it is registered", || component.tcp().unwrap().status().names == 1);
}

#[test]
fn a_certificate_or_the_secret_lets_a_client_in() {
    let keys = Keys::new();
    let router = keys.router("tls");
    let (certified, mut first) = component(&router, &keys.of("client"), 1);
    registered(&certified);
    let keys = keys.has_only_a_secret();
    let (knowing, mut second) = component(&router, &keys.of("client"), 2);
    registered(&knowing);
    let mut there = first.sender(second.name()).unwrap();
    let mut back = second.sender(first.name()).unwrap();
    for round in 0..200u8 {
        let body = vec![round; usize::from(round) * 1_000];
        there.send(21, &body).unwrap();
        assert_eq!(second.receive(Some(PATIENCE)).unwrap().body().to_vec(), body);
        back.send(0, &body).unwrap();
        assert_eq!(first.receive(Some(PATIENCE)).unwrap().body().to_vec(), body);
    }
    assert_eq!(router.clients(), 2);
}

/// Two programs in C, each of which asks the other by name.
#[test]
fn programs_in_c_come_by_tls() {
    let (keys, dir) = (Keys::new(), tempfile::tempdir().unwrap());
    let Some(program) = in_c("programs_in_c_come_by_tls", "meet.c", dir.path()) else { return };
    let router = keys.router("tls_in_c");
    let [first, second] = [1, 2].map(|instance| format!("{:#010x}", name(instance).0));
    let meets = |own: &str, other: &str| {
        let mut command = Command::new(&program);
        command.args(["router", &router.at.to_string(), own, other]).env("KEYS", keys.of("client"));
        Program::start(&mut command)
    };
    let mut programs = [meets(&first, &second), meets(&second, &first)];
    programs.iter_mut().for_each(|program| assert_eq!(program.line(), "met"));
    assert_eq!(router.clients(), 2);
}

/// Each is kept out, and the router says why.
#[test]
fn strangers_are_kept_out_and_named() {
    let keys = Keys::new();
    let router = keys.router("strangers");
    let why = || -> Vec<String> {
        let closed = router.status()["closed"].clone();
        let why = |closed: &serde_json::Value| closed["why"].as_str().unwrap().to_owned();
        closed.as_array().unwrap().iter().map(why).collect()
    };
    let kept_out = |words: &str| {
        wait_until(words, || why().iter().any(|why| why.contains(words)));
        assert_eq!(router.status()["names"], 0, "{words}");
    };

    // Packages in the clear.
    let mut plain = router.connect();
    plain.write_all(&package(13, 0, 0, &0x0080_0100u32.to_le_bytes())).unwrap();
    let mut alert = Vec::new();
    // It may be reset before it is read.
    let _ = plain.read_to_end(&mut alert);
    kept_out("TLS: it does not speak TLS, which this address asks for");

    // Another authority's certificate: neither believes the other.
    let others = Keys::new();
    let (stranger, _mailbox) = component(&router, &others.of("client"), 1);
    wait_until("it does not believe the router", || {
        stranger
            .tcp()
            .unwrap()
            .status()
            .last_error
            .is_some_and(|why| why.contains("invalid peer certificate"))
    });
    kept_out("TLS: received fatal alert");

    // It believes the router, and has a certificate of somebody else.
    fs::copy(keys.of("client").join("ca.pem"), others.of("client").join("ca.pem")).unwrap();
    let (_stranger, _mailbox) = component(&router, &others.of("client"), 2);
    kept_out("TLS: invalid peer certificate");

    // It has no certificate, and another secret; of another length, too.
    let others = others.has_only_a_secret();
    for secret in ["another secret, that is wrong", &"x".repeat(SECRET_AT_LEAST)] {
        fs::write(others.of("client").join("secret"), secret).unwrap();
        let (_stranger, _mailbox) = component(&router, &others.of("client"), 3);
        let before = why().len();
        wait_until("it tries again", || why().len() > before);
        kept_out("did not prove that it knows the secret");
    }
    let endings = router.status()["endings"].clone();
    let count = |reason: &str| endings[reason].as_u64().unwrap();
    assert!(count("tls") >= 2 && count("certificate") >= 1 && count("stranger") >= 2, "{endings}");
}

/// Passes bytes on from a client to a router, and back. While `breaks` is set it changes one byte of those to the router, and clears it.
fn passes_on(from: &TcpListener, to: SocketAddr, breaks: &Arc<AtomicBool>) {
    for client in from.incoming() {
        let (Ok(mut client), Ok(mut router)) = (client, TcpStream::connect(to)) else { return };
        let (mut back_from, mut back_to) = (router.try_clone().unwrap(), client.try_clone().unwrap());
        thread::spawn(move || std::io::copy(&mut back_from, &mut back_to));
        let breaks = breaks.clone();
        thread::spawn(move || {
            let mut room = [0; 4096];
            while let Ok(count @ 1..) = client.read(&mut room) {
                // The last byte of a record belongs to its authentication tag.
                room[count - 1] ^= u8::from(breaks.swap(false, Ordering::Relaxed));
                if router.write_all(&room[..count]).is_err() {
                    break;
                }
            }
            // Closed already where the router has ended it.
            let _ = [&client, &router].map(|stream| stream.shutdown(Shutdown::Both));
        });
    }
}

#[test]
fn garbage_ends_its_own_session_only_and_is_counted() {
    let keys = Keys::new();
    let router = keys.router("garbage");
    let counted = || router.status()["endings"]["tls"].as_u64().unwrap();
    let (well, _mailbox) = component(&router, &keys.of("client"), 1);
    registered(&well);

    // Before a session: no TLS; a head of it and other bytes behind; a record of the wrong type.
    let all = [&[0xff; 600][..], &[&[0x16, 3, 1, 2, 0][..], &[0xa5; 512]].concat(), &[0x17, 3, 3, 0, 1, 7]];
    for (number, garbage) in all.into_iter().enumerate() {
        let mut stranger = router.connect();
        stranger.write_all(garbage).unwrap();
        // It may be reset before it is read.
        let _ = stranger.read_to_end(&mut Vec::new());
        wait_until("it is counted", || counted() == number as u64 + 1);
    }

    // In the middle of a session, whose client comes again.
    let (listener, breaks) = (TcpListener::bind("127.0.0.1:0").unwrap(), Arc::new(AtomicBool::new(false)));
    let (at, to, set) = (listener.local_addr().unwrap(), router.at, breaks.clone());
    thread::spawn(move || passes_on(&listener, to, &set));
    let (broken, mailbox) = component_at(at, &keys.of("client"), 2);
    registered(&broken);
    breaks.store(true, Ordering::Relaxed);
    // Its answer to the next question, at the latest, is the record that is changed.
    mailbox.sender(name(9)).unwrap().send(-6, b"to nobody").unwrap();
    wait_until("it is counted", || counted() == 4);
    wait_until("it is back", || broken.tcp().unwrap().status().connections == 2);
    registered(&broken);
    assert_eq!(well.tcp().unwrap().status().connections, 1, "the others go on");
}

/// Opens connections that say nothing; each makes room for the next, and the router closes it.
pub fn crowds(at: SocketAddr, is_over: &AtomicBool) {
    let mut open = VecDeque::new();
    while !is_over.load(Ordering::Relaxed) {
        open.extend(TcpStream::connect(at).ok());
        if open.len() > 300 {
            open.pop_front();
        }
        thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn strangers_who_crowd_keep_no_client_out() {
    let keys = Keys::new();
    let router = keys.router("crowded");
    let (at, is_over) = (router.at, AtomicBool::new(false));
    thread::scope(|scope| {
        let _ends = AtEnd(&is_over);
        scope.spawn(|| crowds(at, &is_over));
        let crowded = || router.status()["endings"]["crowded"].as_u64().unwrap();
        wait_until("they crowd", || crowded() > 0);
        let before = crowded();
        let (client, _mailbox) = component(&router, &keys.of("client"), 1);
        registered(&client);
        wait_until("they still do", || crowded() > before);
        assert_eq!(router.status()["names"], 1, "the client stays");
    });
}

/// Each session that they begin takes the router as long as a thousand packages.
#[test]
fn strangers_who_begin_sessions_leave_time_for_clients() {
    let test = "strangers_who_begin_sessions_leave_time_for_clients";
    let Some((python, _)) = in_python(test, "strangers.py") else { return };
    let keys = Keys::new();
    let router = keys.router("begun");
    let (_first, first) = component(&router, &keys.of("client"), 1);
    let (second, mut other) = component(&router, &keys.of("client"), 2);
    registered(&second);
    let port = router.at.port().to_string();
    let strangers = [(); 2].map(|()| {
        let mut command = Command::new("python3");
        command.arg(&python).args(["127.0.0.1", &port]).arg(keys.of("client").join("ca.pem"));
        let mut program = Program::start(&mut command);
        assert_eq!(program.line(), "begins");
        program
    });
    let ended = |reason: &str| router.status()["endings"][reason].as_u64().unwrap();
    // Their sessions begin, and they close them.
    let begun = || ended("left");
    wait_until("they begin sessions", || begun() > 20);
    let mut sender = first.sender(other.name()).unwrap();
    let (before, from) = (begun(), Instant::now());
    let mut trips: Vec<_> = (0..500).map(|_| there(&mut sender, &mut other)).collect();
    let (sessions, time) = (begun() - before, from.elapsed());
    let (newcomer, _mailbox) = component(&router, &keys.of("client"), 3);
    registered(&newcomer);
    drop(strangers);
    assert!(sessions > 0 && ended("tls") == 0, "they went on");
    trips.sort_unstable();
    assert!(trips[250] < Duration::from_millis(50), "{:?}", trips[250]);
    let [half, most] = [trips[250], trips[499]].map(|trip| trip.as_secs_f64() * 1e3);
    let rate = sessions as f64 / time.as_secs_f64();
    figure(
        test,
        &format!(
            "a package took {half:.2} ms (p50), {most:.1} ms (max), while {rate:.0} sessions a second began"
        ),
    );
}

/// The time of a package from one component to another.
fn there(sender: &mut Sender, receiver: &mut Mailbox) -> Duration {
    let begun = Instant::now();
    sender.send(-6, b"there").unwrap();
    assert_eq!(receiver.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"there");
    begun.elapsed()
}

#[test]
fn keys_that_cannot_be_used_are_named_with_the_remedy() {
    let keys = Keys::new();
    let (router, client) = (keys.of("router"), keys.of("client"));
    let start = || not_started(&["--listen", "0.0.0.0:0", "--keys", router.to_str().unwrap()]);
    let again = rtnet().args(["router", "keys"]).arg(router.parent().unwrap()).output().unwrap();
    assert!(refusal(&again).contains("in a directory that is not there yet"));

    for host in ["10.1.0.4:2001", "bad host!", ""] {
        let output = rtnet().args(["router", "keys", "--host", host]).arg(keys.of("other")).output().unwrap();
        assert!(
            refusal(&output).contains(&format!("'{host}' is no host: write its name")),
            "{}",
            refusal(&output)
        );
        assert!(!keys.of("other").exists());
    }
    fs::write(client.join("secret"), "short").unwrap();
    let error = ClientKeys::read(&client).unwrap_err().to_string();
    assert!(error.contains("a secret of 5 bytes could be guessed: make it 16 or more"), "{error}");
    fs::remove_file(client.join("secret")).unwrap();
    fs::remove_file(client.join("client.pem")).unwrap();
    let error = ClientKeys::read(&client).unwrap_err().to_string();
    assert!(error.contains("has neither client.pem nor a secret"), "{error}");

    fs::rename(router.join("router.key"), router.join("kept")).unwrap();
    assert!(start().contains("router.key: "), "{}", start());
    fs::copy(client.join("client.key"), router.join("router.key")).unwrap();
    assert!(start().contains("router.pem: "), "{}", start());
    fs::write(router.join("ca.pem"), "nothing").unwrap();
    assert!(start().contains("ca.pem: it holds no certificate"), "{}", start());
    fs::remove_file(router.join("ca.pem")).unwrap();
    fs::remove_file(router.join("secret")).unwrap();
    fs::rename(router.join("kept"), router.join("router.key")).unwrap();
    assert!(start().contains("anybody could connect"), "{}", start());
}
