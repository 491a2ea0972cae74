//! A router that is killed and started again, under load.

use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox, SendError, Sender};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::{TcpOptions, TcpStatus, TcpWatch};
use package_router::wire::{Head, NOT_AVAILABLE, OK};

use super::languages::{Program, in_c, in_python};
use super::{AtEnd, Router};
use crate::cell::wait_until;
use crate::host::figure;

const RESTARTS: usize = 100;
const ECHO: MailboxName = MailboxName::new(0, Class(0x80), 0, 0);
const CALLER: MailboxName = MailboxName::new(0, Class(0x80), 1, 0);
const FLOOD: MailboxName = MailboxName::new(0, Class(0x80), 2, 0);
/// Clients in other languages, which send and answer.
const IN_C: MailboxName = MailboxName::new(0, Class(0x80), 3, 0);
const IN_PYTHON: MailboxName = MailboxName::new(0, Class(0x80), 4, 0);
/// All that send data.
const SENDERS: [MailboxName; 3] = [FLOOD, IN_C, IN_PYTHON];
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
    fn new(router: &Router, name: MailboxName) -> Self {
        let options = TcpOptions::new(router.at.to_string().parse().unwrap());
        let component = Component::of_router(&options).unwrap();
        let mailbox = component.mailbox(name, Shape::new(SLOTS, 64).senders(4)).unwrap();
        Self { component, mailbox }
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

/// Packages that were taken, and such that found no room.
fn floods(mailbox: &Mailbox, is_over: &AtomicBool) -> (u64, u64) {
    let mut sender = mailbox.sender(ECHO).unwrap();
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
    /// Reads a program's next line.
    fn of(program: &mut Program) -> Self {
        let line = program.line();
        let numbers: Vec<u64> = line.split(' ').map(|number| number.parse().unwrap()).collect();
        let &[taken, lost, at_router, unconfirmed] = &numbers[..] else { panic!("{line}") };
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

#[test]
fn clients_come_back_to_a_router_killed_again_and_again() {
    let test = "clients_come_back_to_a_router_killed_again_and_again";
    let mut router = Router::start("restarts", &[]);
    let at = router.at.to_string();
    let [mut echo, mut caller, flood] = [ECHO, CALLER, FLOOD].map(|name| Host::new(&router, name));
    let looks = [&echo, &caller, &flood].map(|host| host.component.tcp().unwrap());
    let dir = tempfile::tempdir().unwrap();
    let mut programs = in_other_languages(test, dir.path(), &at);
    let clients = looks.len() + programs.len();
    let are_back = |connections: u64, router: &Router| {
        let mut all = looks.iter().map(|look| look.status());
        all.all(|of| of.names == 1 && of.connections >= connections) && router.status()["names"] == clients
    };
    wait_until("all are registered", || are_back(1, &router));

    let (is_over, is_read, came) = (AtomicBool::new(false), AtomicBool::new(false), Came::default());
    let senders = SENDERS.len() - 2 + programs.len();
    let counts = || came[..senders].iter().map(|of| of.load(Ordering::Relaxed)).collect::<Vec<_>>();
    thread::scope(|scope| {
        let (is_over, is_read, came) = (&is_over, &is_read, &came);
        let _ends = [AtEnd(is_over), AtEnd(is_read)];
        scope.spawn(move || echoes(&mut echo.mailbox, came, is_read));
        let calls = scope.spawn(|| {
            let mut sender = caller.mailbox.sender(ECHO).unwrap();
            let mut calls = Calls::default();
            while !is_over.load(Ordering::Relaxed) {
                call(&mut sender, &mut caller.mailbox, &mut calls);
                thread::sleep(SENDS_EVERY);
            }
            calls
        });
        let flooded = scope.spawn(|| floods(&flood.mailbox, is_over));
        let mut back_after = Vec::new();
        for restart in 1..=RESTARTS as u64 {
            let before = counts();
            router.child.kill().unwrap();
            router.child.wait().unwrap();
            router = Router::start("restarts", &["--listen", &at]);
            let begun = Instant::now();
            wait_until("all are back", || are_back(restart + 1, &router));
            back_after.push(begun.elapsed());
            wait_until("packages of all come again", || {
                counts().iter().zip(&before).all(|(now, before)| now > before)
            });
        }
        is_over.store(true, Ordering::Relaxed);
        programs.iter_mut().for_each(Program::end_input);
        let (taken, refused) = flooded.join().unwrap();
        let (mut accounts, mut full) = (Vec::new(), 0);
        wait_until("each package has come, or is counted", || {
            accounts = vec![Account::of_watch(taken, &looks[2])];
            accounts.extend(programs.iter_mut().map(Account::of));
            full = looks[0].status().local.full;
            accounts.iter().zip(counts()).all(|(account, came)| account.is_whole(came, full))
        });
        let calls = calls.join().unwrap();
        is_read.store(true, Ordering::Relaxed);
        calls.check();
        wait_until("refused packages are counted", || looks[2].status().local.queue_full == refused);
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
