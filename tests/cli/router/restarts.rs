//! A router that is killed and started again, under load.

use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox, SendError, Sender};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::{TcpOptions, TcpStatus, TcpWatch};
use package_router::tcp::keys::ClientKeys;
use package_router::wire::{Head, NOT_AVAILABLE, OK};
use tools::lab::namespace::Namespace;

use super::languages::{Program, in_c, in_python};
use super::tls::Keys;
use super::{AtEnd, Router, has_joined};
use crate::cell::{json, wait_until};
use crate::host::{figure, unique};
use crate::rtnet;
use crate::station::{Medium, Station};

const RESTARTS: usize = 100;
const ECHO: MailboxName = MailboxName::new(0, Class(0x80), 0, 0);
const CALLER: MailboxName = MailboxName::new(0, Class(0x80), 1, 0);
const FLOOD: MailboxName = MailboxName::new(0, Class(0x80), 2, 0);
/// Clients in other languages, which send, receive and answer.
const IN_C: MailboxName = MailboxName::new(0, Class(0x80), 3, 0);
const IN_PYTHON: MailboxName = MailboxName::new(0, Class(0x80), 4, 0);
const BY_TLS: MailboxName = MailboxName::new(0, Class(0x80), 5, 0);
const AT_STATION: MailboxName = MailboxName::new(0, Class(0x80), 6, 0);
/// All that send data, as far as they can run here.
const SENDERS: [MailboxName; 5] = [FLOOD, BY_TLS, AT_STATION, IN_C, IN_PYTHON];
const ASK: i8 = 21;
/// Slots of a mailbox for what comes by TCP: all that all send in an eighth of a second.
const SLOTS: usize = 1_024;
const DATA: i8 = -6;
/// How long a call waits for its answer.
const ANSWER_WITHIN: Duration = Duration::from_millis(200);
/// From one package to the next, and from one call to the next: a load for the router, and none for the labs of other tests.
const SENDS_EVERY: Duration = Duration::from_micros(500);

/// The ends of calls, each counted where it was made.
#[derive(Debug, Default)]
struct Calls {
    made: u64,
    answered: u64,
    not_available: u64,
    timed_out: u64,
    /// Refused at once: as many wait as may.
    full: u64,
    /// The calls whose answers have come.
    seen: BTreeSet<u64>,
}

impl Calls {
    fn check(&self) {
        let Self { made, answered, not_available, timed_out, full, .. } = self;
        assert_eq!(*made, answered + not_available + timed_out + full, "each has one end");
    }
}

impl Display for Calls {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { made, answered, not_available, timed_out, full, .. } = self;
        write!(
            f,
            "{made} calls: {answered} answered, {not_available} not available, {timed_out} timed out, {full} refused"
        )
    }
}

struct Host {
    component: Component,
    mailbox: Mailbox,
}

impl Host {
    fn new(at: &SocketAddr, keys: Option<ClientKeys>, name: MailboxName) -> Self {
        let options = TcpOptions { keys, ..TcpOptions::new(at.to_string().parse().unwrap()) };
        Self::of(Component::of_router(&options).unwrap(), name)
    }

    fn of(component: Component, name: MailboxName) -> Self {
        let mailbox = component.mailbox(name, Shape::new(SLOTS, 64).senders(4)).unwrap();
        Self { component, mailbox }
    }
}

/// A station that joins the router, with a component.
struct AtStation {
    name: String,
    host: Host,
    _station: Station,
}

impl AtStation {
    fn new(place: &Namespace, router: &SocketAddr) -> Self {
        let (name, at) = (unique("restarts"), router.to_string());
        let net = ["--interface", "rt0", "--discipline", "nomac", "--ip", "10.0.0.1/24", "--name", &name];
        let station = Station::start(place, &[&net[..], &["--packages", "--router", &at]].concat());
        has_joined(&name);
        let host = Host::of(Component::named(&name).unwrap(), AT_STATION);
        Self { name, host, _station: station }
    }

    fn account(&self, taken: u64) -> Account {
        let tcp = json(rtnet().args(["stat", "-S", &self.name, "--json"]))["tcp"].clone();
        let lost = |reason: &str| tcp["lost"][reason].as_u64().unwrap();
        let at_router = tcp["lost_at_router"].as_object().unwrap().values();
        let at_router: u64 = at_router.map(|count| count.as_u64().unwrap()).sum();
        let lost_here = lost("not_connected") + lost("not_written");
        Account { taken, lost: lost_here + at_router, unconfirmed: lost("unconfirmed") }
    }
}

/// Packages that have come, by the sender.
type Came = [AtomicU64; SENDERS.len()];

/// Answers commands, and counts data; panics if anything comes twice.
fn echoes(mailbox: &mut Mailbox, came: &Came, is_read: &AtomicBool) {
    let mut back = mailbox.sender(CALLER).unwrap();
    let mut seen = BTreeSet::new();
    while !is_read.load(Ordering::Relaxed) {
        let Ok(package) = mailbox.receive(Some(Duration::from_millis(20))) else { continue };
        let (head, body) = (*package.head(), package.body().to_vec());
        drop(package);
        let number = u64::from_le_bytes(body[..].try_into().unwrap());
        assert!(seen.insert((head.from, number)), "{number} of {} came twice", head.from);
        if let Some(sender) = SENDERS.iter().position(|name| *name == head.from) {
            came[sender].fetch_add(1, Ordering::Relaxed);
        } else {
            // An answer that finds no room is a call that times out.
            let _ = back.send_with(&head.answer(OK), &body);
        }
    }
}

fn call(sender: &mut Sender, mailbox: &mut Mailbox, calls: &mut Calls) {
    calls.made += 1;
    match sender.send(ASK, &calls.made.to_le_bytes()) {
        Ok(_) => {}
        Err(SendError::Mailbox(mailbox::SendError::Full(_))) => {
            calls.full += 1;
            return;
        }
        Err(error) => panic!("{error}"),
    }
    let begun = Instant::now();
    while let Some(left) = ANSWER_WITHIN.checked_sub(begun.elapsed()) {
        let Ok(package) = mailbox.receive(Some(left)) else { break };
        let Head { kind, .. } = *package.head();
        match kind {
            NOT_AVAILABLE => {
                calls.not_available += 1;
                return;
            }
            OK => {
                let number = u64::from_le_bytes(package.body().to_vec()[..].try_into().unwrap());
                assert!(calls.seen.insert(number), "the answer to {number} came twice");
                // The answer to an earlier call comes too late: that call has been counted.
                if number == calls.made {
                    calls.answered += 1;
                    return;
                }
            }
            _ => {}
        }
    }
    calls.timed_out += 1;
}

/// Calls, and sends numbers to the clients in other languages meanwhile.
fn calls_and_feeds(caller: &mut Mailbox, is_over: &AtomicBool) -> Calls {
    let mut sender = caller.sender(ECHO).unwrap();
    let mut fed = [IN_C, IN_PYTHON].map(|name| caller.sender(name).unwrap());
    let mut calls = Calls::default();
    while !is_over.load(Ordering::Relaxed) {
        call(&mut sender, caller, &mut calls);
        // One that finds no room, or no client, is lost.
        fed.iter_mut().for_each(|to| _ = to.send(DATA, &calls.made.to_le_bytes()));
        thread::sleep(SENDS_EVERY);
    }
    calls
}

/// Packages that were taken, and such that found no room.
fn floods(sender: &mut Sender, is_over: &AtomicBool) -> (u64, u64) {
    let (mut taken, mut full) = (0u64, 0u64);
    while !is_over.load(Ordering::Relaxed) {
        match sender.send(DATA, &taken.to_le_bytes()) {
            Ok(_) => taken += 1,
            Err(SendError::Mailbox(mailbox::SendError::Full(_))) => full += 1,
            Err(error) => panic!("{error}"),
        }
        thread::sleep(SENDS_EVERY);
    }
    (taken, full)
}

/// A client in C and one in Python; none if there is no compiler, or no Python.
fn in_other_languages(test: &str, dir: &Path, at: &str) -> Vec<Program> {
    let (Some(c), Some((python, client))) = (in_c(test, "flood.c", dir), in_python(test, "flood.py")) else {
        return Vec::new();
    };
    let [in_c, in_python, to] = [IN_C, IN_PYTHON, ECHO].map(|name| format!("{:#010x}", name.0));
    let (host, port) = at.split_once(':').unwrap();
    let mut first = Command::new(c);
    first.args([at, &in_c, &to]);
    let mut second = Command::new("python3");
    second.arg(python).args([host, port, &in_python, &to]);
    second.env("PYTHONPATH", client).env("PYTHONDONTWRITEBYTECODE", "1");
    [first, second].iter_mut().map(Program::start).collect()
}

/// Whether a client answers a question.
fn answers(caller: &mut Mailbox, to: MailboxName) -> bool {
    let id = caller.sender(to).unwrap().send(ASK, b"again").unwrap();
    let package = caller.receive(Some(ANSWER_WITHIN));
    package.is_ok_and(|package| {
        let head = package.head();
        (head.kind, head.from, head.id) == (OK, to, id)
    })
}

/// A sender's account of its packages.
#[derive(Clone, Copy, Debug, Default)]
struct Account {
    taken: u64,
    /// Packages that did not leave, or that the router read and did not pass on.
    lost: u64,
    unconfirmed: u64,
}

impl Account {
    /// Reads a program's next line. Numbers have come to the program, and none twice.
    fn of(program: &mut Program) -> Self {
        let line = program.line();
        let numbers: Vec<u64> = line.split(' ').map(|number| number.parse().unwrap()).collect();
        let &[taken, lost, at_router, unconfirmed, came, again] = &numbers[..] else { panic!("{line}") };
        assert!(came >= RESTARTS as u64 && again == 0, "{came} numbers came, {again} of them again");
        Self { taken, lost: lost + at_router, unconfirmed }
    }

    /// Reads the counters of a client in Rust.
    fn of_watch(taken: u64, watch: &TcpWatch) -> Self {
        let TcpStatus { session, local, .. } = watch.status();
        let lost = local.not_connected + session.lost + session.lost_at_router.sum();
        Self { taken, lost, unconfirmed: session.unconfirmed }
    }

    fn shown(&self, came: u64) -> String {
        let Self { taken, lost, unconfirmed } = self;
        format!(
            "{taken}: {came} delivered once, {lost} lost and counted, {} missing, {unconfirmed} unconfirmed",
            taken - came - lost
        )
    }

    /// Whether each package has come, or is counted. The receiver counts packages that find its mailbox `full`.
    fn is_whole(&self, came: u64, full: u64) -> bool {
        let surely = came + self.lost;
        (surely..=surely + self.unconfirmed + full).contains(&self.taken)
    }
}

/// With a station among the clients where one can be.
#[test]
fn clients_come_back_to_a_router_killed_again_and_again() {
    let test = "clients_come_back_to_a_router_killed_again_and_again";
    if nix::unistd::geteuid().is_root() {
        let medium = Medium::new();
        medium.a.run(|| come_back(test, Some(&medium.a))).unwrap();
    } else {
        come_back(test, None);
    }
}

fn come_back(test: &str, place: Option<&Namespace>) {
    let (dir, keys) = (tempfile::tempdir().unwrap(), Keys::new());
    let file = dir.path().join("router.toml");
    let listen_at = |at: [&str; 2]| {
        let plain = format!("[[listen]]\naddress = \"{}\"\n", at[0]);
        let by_tls = format!("[[listen]]\naddress = \"{}\"\nkeys = {:?}\n", at[1], keys.of("router"));
        std::fs::write(&file, plain + &by_tls).unwrap();
    };
    let start = || Router::start("restarts", &[file.to_str().unwrap()]);
    listen_at(["127.0.0.1:0"; 2]);
    let mut router = start();
    let (at, by_tls) = (router.at, router.also[0]);
    listen_at([&at.to_string(), &by_tls.to_string()]);

    let [mut echo, mut caller, flood] = [ECHO, CALLER, FLOOD].map(|name| Host::new(&at, None, name));
    let by_tls = Host::new(&by_tls, Some(ClientKeys::read(&keys.of("client")).unwrap()), BY_TLS);
    let looks = [&echo, &caller, &flood, &by_tls].map(|host| host.component.tcp().unwrap());
    let at_station = place.map(|place| AtStation::new(place, &at));
    let mut programs = in_other_languages(test, dir.path(), &at.to_string());
    let clients = looks.len() + usize::from(at_station.is_some()) + programs.len();
    let are_back = |connections: u64, router: &Router| {
        let mut all = looks.iter().map(|look| look.status());
        all.all(|of| of.names == 1 && of.connections >= connections) && router.status()["names"] == clients
    };
    wait_until("all are registered", || are_back(1, &router));

    let (is_over, is_read, came) = (AtomicBool::new(false), AtomicBool::new(false), Came::default());
    let is_here = [true, true, at_station.is_some(), !programs.is_empty(), !programs.is_empty()];
    let counts = || {
        let here = came.iter().zip(is_here).filter(|(_, is_here)| *is_here);
        here.map(|(of, _)| of.load(Ordering::Relaxed)).collect::<Vec<_>>()
    };
    thread::scope(|scope| {
        let (is_over, is_read, came) = (&is_over, &is_read, &came);
        let _ends = [AtEnd(is_over), AtEnd(is_read)];
        scope.spawn(move || echoes(&mut echo.mailbox, came, is_read));
        let calls = scope.spawn(|| calls_and_feeds(&mut caller.mailbox, is_over));
        let floods_of = |host: &Host| {
            let mut sender = host.mailbox.sender(ECHO).unwrap();
            scope.spawn(move || floods(&mut sender, is_over))
        };
        let flooded = [Some(&flood), Some(&by_tls), at_station.as_ref().map(|at| &at.host)];
        let flooded: Vec<_> = flooded.into_iter().flatten().map(floods_of).collect();
        let mut back_after = Vec::new();
        for restart in 1..=RESTARTS as u64 {
            let before = counts();
            router.child.kill().unwrap();
            router.child.wait().unwrap();
            router = start();
            let begun = Instant::now();
            wait_until("all are back", || are_back(restart + 1, &router));
            back_after.push(begun.elapsed());
            wait_until("packages of all come again", || {
                counts().iter().zip(&before).all(|(now, before)| now > before)
            });
        }
        is_over.store(true, Ordering::Relaxed);
        programs.iter_mut().for_each(Program::end_input);
        let flooded: Vec<(u64, u64)> = flooded.into_iter().map(|of| of.join().unwrap()).collect();
        let (mut accounts, mut full) = (Vec::new(), 0);
        wait_until("each package has come, or is counted", || {
            accounts =
                vec![Account::of_watch(flooded[0].0, &looks[2]), Account::of_watch(flooded[1].0, &looks[3])];
            accounts.extend(at_station.iter().map(|at| at.account(flooded[2].0)));
            accounts.extend(programs.iter_mut().map(Account::of));
            full = looks[0].status().local.full;
            accounts.iter().zip(counts()).all(|(account, came)| account.is_whole(came, full))
        });
        let calls = calls.join().unwrap();
        is_read.store(true, Ordering::Relaxed);
        calls.check();
        wait_until("refused packages are counted", || looks[2].status().local.queue_full == flooded[0].1);
        back_after.sort_unstable();
        let (half, most) = (back_after[RESTARTS / 2], back_after[RESTARTS - 1]);
        let each: Vec<String> = accounts.iter().zip(counts()).map(|(of, came)| of.shown(came)).collect();
        figure(
            test,
            &format!(
                "{RESTARTS} restarts: all {clients} clients back after {:.0} ms (p50), {:.0} ms (max); {calls}; other packages {}; {full} found \
                 the mailbox full",
                half.as_secs_f64() * 1e3,
                most.as_secs_f64() * 1e3,
                each.join(", "),
            ),
        );
    });
    for to in [IN_C, IN_PYTHON].into_iter().take(programs.len()) {
        wait_until("it answers, too", || answers(&mut caller.mailbox, to));
    }
}
