//! A router that is killed and started again, under load.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox, SendError, Sender};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::TcpOptions;
use package_router::wire::{Head, NOT_AVAILABLE, OK};

use super::meet::{Program, in_c, in_python};
use super::{AtEnd, Router};
use crate::cell::wait_until;
use crate::host::figure;

const RESTARTS: usize = 100;
const ECHO: MailboxName = MailboxName::new(0, Class(0x80), 0, 0);
const CALLER: MailboxName = MailboxName::new(0, Class(0x80), 1, 0);
const FLOOD: MailboxName = MailboxName::new(0, Class(0x80), 2, 0);
/// Clients in other languages, which answer each other.
const IN_C: MailboxName = MailboxName::new(0, Class(0x80), 3, 0);
const IN_PYTHON: MailboxName = MailboxName::new(0, Class(0x80), 4, 0);
const ASK: i8 = 21;
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
}

struct Host {
    component: Component,
    mailbox: Mailbox,
}

impl Host {
    fn new(router: &Router, name: MailboxName) -> Self {
        let options = TcpOptions::new(router.at.to_string().parse().unwrap());
        let component = Component::of_router(&options).unwrap();
        let mailbox = component.mailbox(name, Shape::new(64, 64)).unwrap();
        Self { component, mailbox }
    }
}

/// Answers commands, and counts data; panics if anything comes twice.
fn echoes(mailbox: &mut Mailbox, data: &AtomicU64, is_read: &AtomicBool) {
    let mut back = mailbox.sender(CALLER).unwrap();
    let mut seen = [BTreeSet::new(), BTreeSet::new()];
    while !is_read.load(Ordering::Relaxed) {
        let Ok(package) = mailbox.receive(Some(Duration::from_millis(20))) else { continue };
        let (head, body) = (*package.head(), package.body().to_vec());
        drop(package);
        let is_data = head.kind == DATA;
        let number = u64::from_le_bytes(body[..].try_into().unwrap());
        assert!(seen[usize::from(is_data)].insert(number), "{number} of kind {} came twice", head.kind);
        if is_data {
            data.fetch_add(1, Ordering::Relaxed);
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
            OK if package.body().to_vec() == calls.made.to_le_bytes() => {
                calls.answered += 1;
                return;
            }
            // An answer to an earlier call, which has been counted.
            _ => {}
        }
    }
    calls.timed_out += 1;
}

/// Packages of the flood that a router had passed to nobody: one comes back before the other.
fn nobody_there(router: &Router) -> u64 {
    let status = router.status();
    let of = |client: &&serde_json::Value| client["first_names"][0] == FLOOD.to_string();
    let client = status["clients"].as_array().unwrap().iter().find(of).expect("it is registered");
    client["counters"]["nobody_there"].as_u64().unwrap_or(0)
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

/// A client in C and one in Python, which have met each other; none if there is no compiler, or no Python.
fn in_other_languages(test: &str, dir: &Path, at: &str) -> Vec<Program> {
    let (Some(c), Some((python, client))) = (in_c(test, dir), in_python(test)) else { return Vec::new() };
    let [own, other] = [IN_C, IN_PYTHON].map(|name| format!("{:#010x}", name.0));
    let (host, port) = at.split_once(':').unwrap();
    let mut first = Command::new(c);
    first.args(["router", at, &own, &other]);
    let mut second = Command::new("python3");
    second.arg(python).args([host, port, &other, &own]);
    second.env("PYTHONPATH", client).env("PYTHONDONTWRITEBYTECODE", "1");
    let start = |command: &mut Command| Program(command.stdout(Stdio::piped()).spawn().unwrap());
    let mut programs = vec![start(&mut first), start(&mut second)];
    programs.iter_mut().for_each(Program::has_met_all);
    programs
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

#[test]
fn clients_come_back_to_a_router_killed_again_and_again() {
    let test = "clients_come_back_to_a_router_killed_again_and_again";
    let mut router = Router::start("restarts", &[]);
    let at = router.at.to_string();
    let [mut echo, mut caller, flood] = [ECHO, CALLER, FLOOD].map(|name| Host::new(&router, name));
    let looks = [&echo, &caller, &flood].map(|host| host.component.tcp().unwrap());
    let dir = tempfile::tempdir().unwrap();
    let programs = in_other_languages(test, dir.path(), &at);
    let clients = looks.len() + programs.len();
    let are_back = |connections: u64, router: &Router| {
        let mut all = looks.iter().map(|look| look.status());
        all.all(|of| of.names == 1 && of.connections >= connections) && router.status()["names"] == clients
    };
    wait_until("all are registered", || are_back(1, &router));

    let (is_over, is_read, data) = (AtomicBool::new(false), AtomicBool::new(false), AtomicU64::new(0));
    thread::scope(|scope| {
        let (is_over, is_read, data) = (&is_over, &is_read, &data);
        let _ends = [AtEnd(is_over), AtEnd(is_read)];
        scope.spawn(move || echoes(&mut echo.mailbox, data, is_read));
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
        let (mut back_after, mut nobody) = (Vec::new(), 0);
        for restart in 1..=RESTARTS as u64 {
            nobody += nobody_there(&router);
            let received = data.load(Ordering::Relaxed);
            router.child.kill().unwrap();
            router.child.wait().unwrap();
            router = Router::start("restarts", &["--listen", &at]);
            let begun = Instant::now();
            wait_until("all are back", || are_back(restart + 1, &router));
            back_after.push(begun.elapsed());
            wait_until("packages come again", || data.load(Ordering::Relaxed) > received);
        }
        is_over.store(true, Ordering::Relaxed);
        let (taken, full) = flooded.join().unwrap();
        nobody += nobody_there(&router);
        let ends = || {
            let of = looks[2].status();
            let lost = of.local.not_connected + of.session.lost + nobody;
            // The receiver counts packages that find its mailbox full, calls among them.
            (data.load(Ordering::Relaxed), lost, of.session.unconfirmed + looks[0].status().local.full)
        };
        wait_until("each package has an end, or may have been lost with a router", || {
            let (delivered, lost, unconfirmed) = ends();
            (delivered + lost..=delivered + lost + unconfirmed).contains(&taken)
        });
        let Calls { made, answered, not_available, timed_out, full: refused } = calls.join().unwrap();
        is_read.store(true, Ordering::Relaxed);
        assert_eq!(made, answered + not_available + timed_out + refused, "each has one end");
        back_after.sort_unstable();
        let (delivered, lost, unconfirmed) = ends();
        wait_until("refused packages are counted", || looks[2].status().local.queue_full == full);
        figure(
            test,
            &format!(
                "{RESTARTS} restarts: all {clients} clients back after {:.0} ms (p50), {:.0} ms (max); {made} calls: {answered} answered, \
                 {not_available} not available, {timed_out} timed out, {refused} refused; {taken} other packages: {delivered} \
                 delivered once, {lost} lost and counted, {} lost of {unconfirmed} unconfirmed; {full} refused",
                back_after[RESTARTS / 2].as_secs_f64() * 1e3,
                back_after[RESTARTS - 1].as_secs_f64() * 1e3,
                taken - delivered - lost,
            ),
        );
    });
    for to in [IN_C, IN_PYTHON].into_iter().take(programs.len()) {
        wait_until("it answers, too", || answers(&mut caller.mailbox, to));
    }
}
