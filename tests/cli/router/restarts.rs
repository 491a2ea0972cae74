//! A router that is killed and started again, under load.

mod calls;

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox, SendError, Sender};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::{TcpOptions, TcpStatus, TcpWatch};
use package_router::tcp::keys::ClientKeys;
use package_router::wire::OK;
use tools::lab::namespace::Namespace;

use self::calls::calls;
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
/// It sends to the clients in other languages.
const FEED: MailboxName = MailboxName::new(0, Class(0x80), 7, 0);
/// All that send data to the first, as far as they can run here.
const SENDERS: [MailboxName; 5] = [FLOOD, BY_TLS, AT_STATION, IN_C, IN_PYTHON];
const ASK: i8 = 21;
/// Slots of a mailbox for packages that come by TCP: all that all send in a quarter of a second.
const SLOTS: usize = 1_024;
const DATA: i8 = -6;
/// How long a call waits for its answer.
const ANSWER_WITHIN: Duration = Duration::from_millis(200);
/// From one package to the next, and from one call to the next: a load for the router, and none for the labs of other tests.
const SENDS_EVERY: Duration = Duration::from_millis(2);

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

/// Sends numbers to the clients in other languages. One that finds no room, or no client, is lost.
fn feeds(feed: &Mailbox, is_over: &AtomicBool) {
    let mut fed = [IN_C, IN_PYTHON].map(|name| feed.sender(name).unwrap());
    for number in 1u64.. {
        if is_over.load(Ordering::Relaxed) {
            return;
        }
        fed.iter_mut().for_each(|to| _ = to.send(DATA, &number.to_le_bytes()));
        thread::sleep(SENDS_EVERY);
    }
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
        assert!(came > 0 && again == 0, "{came} numbers came, {again} of them again");
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

    /// Whether each package has come, or is counted, and some are confirmed. The receiver counts packages that find its mailbox `full`.
    fn is_whole(&self, came: u64, full: u64) -> bool {
        let surely = came + self.lost;
        (surely..=surely + self.unconfirmed + full).contains(&self.taken)
            && self.unconfirmed < self.taken - self.lost
    }

    /// Whether that holds for all together: each that found the mailbox full is one sender's.
    fn are_whole<'a>(all: impl Iterator<Item = (&'a Self, u64)>, full: u64) -> bool {
        let missing = all.map(|(of, came)| (of.taken - came - of.lost).saturating_sub(of.unconfirmed));
        missing.sum::<u64>() <= full
    }
}

/// A router that listens in the clear and by TLS, at the same addresses after each start.
struct Restarted {
    file: PathBuf,
    router: Router,
    by_tls: SocketAddr,
    keys: Keys,
}

impl Restarted {
    fn new(dir: &Path) -> Self {
        let (file, keys) = (dir.join("router.toml"), Keys::new());
        let listen_at = |plain: &str, by_tls: &str| {
            let keys = keys.of("router");
            let text = format!(
                "[[listen]]\naddress = \"{plain}\"\n[[listen]]\naddress = \"{by_tls}\"\nkeys = {keys:?}\n"
            );
            std::fs::write(&file, text).unwrap();
        };
        listen_at("127.0.0.1:0", "127.0.0.1:0");
        let router = Self::start(&file);
        let by_tls = router.also[0];
        listen_at(&router.at.to_string(), &by_tls.to_string());
        Self { file, router, by_tls, keys }
    }

    fn start(file: &Path) -> Router {
        Router::start("restarts", &[file.to_str().unwrap()])
    }

    /// Kills it, and starts it again.
    fn restart(&mut self) {
        self.router.child.kill().unwrap();
        self.router.child.wait().unwrap();
        self.router = Self::start(&self.file);
    }

    fn host(&self, name: MailboxName) -> Host {
        Host::new(&self.router.at, None, name)
    }

    fn host_by_tls(&self, name: MailboxName) -> Host {
        Host::new(&self.by_tls, Some(ClientKeys::read(&self.keys.of("client")).unwrap()), name)
    }
}

/// With a station among the clients where one can be.
#[test]
fn clients_come_back_to_a_router_killed_again_and_again() {
    let test = "clients_come_back_to_a_router_killed_again_and_again";
    if nix::unistd::geteuid().is_root() {
        // Its station has no slots to keep: the test needs no core of its own, and a failure is none of the host's.
        let medium = Medium::new();
        medium.a.run(|| come_back(test, Some(&medium.a))).unwrap();
    } else {
        come_back(test, None);
    }
}

fn come_back(test: &str, place: Option<&Namespace>) {
    let dir = tempfile::tempdir().unwrap();
    let mut router = Restarted::new(dir.path());
    let [mut echo, mut caller, feed, flood] = [ECHO, CALLER, FEED, FLOOD].map(|name| router.host(name));
    let by_tls = router.host_by_tls(BY_TLS);
    let looks = [&echo, &caller, &feed, &flood, &by_tls].map(|host| host.component.tcp().unwrap());
    let [of_echo, .., of_flood, of_tls] = &looks;
    let at_station = place.map(|place| AtStation::new(place, &router.router.at));
    let mut programs = in_other_languages(test, dir.path(), &router.router.at.to_string());
    let clients = looks.len() + usize::from(at_station.is_some()) + programs.len();
    let are_back = |connections: u64, router: &Restarted| {
        let mut all = looks.iter().map(|look| look.status());
        all.all(|of| of.names == 1 && of.connections >= connections)
            && router.router.status()["names"] == clients
    };
    wait_until("all are registered", || are_back(1, &router));

    let (is_over, is_read) = (AtomicBool::new(false), AtomicBool::new(false));
    let (came, answered) = (Came::default(), AtomicU64::new(0));
    let is_here = [true, true, at_station.is_some(), !programs.is_empty(), !programs.is_empty()];
    let counts = || {
        let here = came.iter().zip(is_here).filter(|(_, is_here)| *is_here);
        here.map(|(of, _)| of.load(Ordering::Relaxed)).collect::<Vec<_>>()
    };
    thread::scope(|scope| {
        let (is_over, is_read, came, answered) = (&is_over, &is_read, &came, &answered);
        let _ends = [AtEnd(is_over), AtEnd(is_read)];
        scope.spawn(move || echoes(&mut echo.mailbox, came, is_read));
        scope.spawn(|| feeds(&feed.mailbox, is_over));
        let calls = scope.spawn(|| calls(&mut caller.mailbox, answered, is_over));
        let flooded = [Some(&flood), Some(&by_tls), at_station.as_ref().map(|at| &at.host)];
        let flooded: Vec<_> = flooded
            .into_iter()
            .flatten()
            .map(|host| {
                let mut sender = host.mailbox.sender(ECHO).unwrap();
                scope.spawn(move || floods(&mut sender, is_over))
            })
            .collect();
        let progress = || [counts(), vec![answered.load(Ordering::Relaxed)]].concat();
        let back_after = restarts(&mut router, are_back, progress);
        is_over.store(true, Ordering::Relaxed);
        programs.iter_mut().for_each(Program::end_input);
        let flooded: Vec<(u64, u64)> = flooded.into_iter().map(|of| of.join().unwrap()).collect();
        let (mut accounts, mut full) = (Vec::new(), 0);
        wait_until("each package has come, or is counted", || {
            accounts =
                vec![Account::of_watch(flooded[0].0, of_flood), Account::of_watch(flooded[1].0, of_tls)];
            accounts.extend(at_station.iter().map(|at| at.account(flooded[2].0)));
            accounts.extend(programs.iter_mut().map(Account::of));
            full = of_echo.status().local.full;
            let each = accounts.iter().zip(counts());
            each.clone().all(|(account, came)| account.is_whole(came, full)) && Account::are_whole(each, full)
        });
        let calls = calls.join().unwrap();
        is_read.store(true, Ordering::Relaxed);
        wait_until("refused packages are counted", || of_flood.status().local.queue_full == flooded[0].1);
        let each: Vec<String> = accounts.iter().zip(counts()).map(|(of, came)| of.shown(came)).collect();
        let back = shown(back_after);
        let words = format!(
            "{RESTARTS} restarts: all {clients} clients back after {back}; {calls}; other packages {}",
            each.join(", ")
        );
        figure(test, &format!("{words}; {full} found the mailbox full"));
    });
    for to in [IN_C, IN_PYTHON].into_iter().take(programs.len()) {
        wait_until("it answers, too", || answers(&mut caller.mailbox, to));
    }
}

/// Restarts the router, and waits each time until all clients are back, and packages and answers come again; returns how long clients took.
fn restarts(
    router: &mut Restarted,
    are_back: impl Fn(u64, &Restarted) -> bool,
    progress: impl Fn() -> Vec<u64>,
) -> Vec<Duration> {
    let restart = |restart| {
        let before = progress();
        router.restart();
        let begun = Instant::now();
        wait_until("all are back", || are_back(restart + 1, router));
        let back_after = begun.elapsed();
        wait_until("packages of all, and answers, come again", || {
            progress().iter().zip(&before).all(|(now, before)| now > before)
        });
        back_after
    };
    (1..=RESTARTS as u64).map(restart).collect()
}

/// The median and the longest of some times.
fn shown(mut times: Vec<Duration>) -> String {
    times.sort_unstable();
    let ms = |at: usize| times[at].as_secs_f64() * 1e3;
    format!("{:.0} ms (p50), {:.0} ms (max)", ms(times.len() / 2), ms(times.len() - 1))
}
