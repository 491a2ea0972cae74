//! Components of three stations and of hosts without one, in Rust, C and Python, exchange packages by name.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use nix::sched::{CloneFlags, setns};
use nix::sys::signal::{Signal, kill};
use package_router::component::{Component, Mailbox, SendError, Times};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::TcpOptions;
use package_router::wire::OK;

use super::languages::{Program, in_c, in_python};
use super::{AtEnd, forget};
use crate::cell::{Cell, json, text, wait_until};
use crate::host::{network, stop};
use crate::rtnet;
use crate::station::PATIENCE;

const ASK: i8 = 21;
const DATA: i8 = -6;
/// The router's addresses: for hosts in the clear, and for stations by TLS, as their lab's file says.
const ROUTER: &str = "10.1.0.4:2000";
const BY_TLS: &str = "10.1.0.4:2001";
/// The components: on the master, the arm and the leg, and on two hosts without a station, in C and Rust on one and in Python on the other.
/// The last is of another system.
const NAMES: [MailboxName; 6] =
    [name(1), name(2), name(3), name(4), name(5), MailboxName::new(1, Class(0x80), 6, 0)];

/// The clock of the leg's host is so far ahead, as the lab's file says.
const AHEAD: Duration = Duration::from_secs(100);

/// A component's news.
#[derive(Default)]
struct Met {
    /// All others have answered.
    all: AtomicBool,
    /// The global time at which a package of a host was delivered, in ns.
    delivered: AtomicU64,
}

const fn name(instance: u8) -> MailboxName {
    MailboxName::new(0, Class(0x80), instance, 0)
}

/// In the namespace of a station.
fn start(cell: &Cell, station: &str, words: &[&str]) -> Program {
    let mut command = rtnet();
    command.args(["lab", "exec", &cell.place(station), "--"]).args(words);
    Program::start(&mut command)
}

/// Asks all others until each has answered, and answers them until it is over. Packages of hosts that come to a station have the global
/// time of their delivery, the last of which is kept.
fn meets((times, mailbox): &mut (Option<Times>, Mailbox), met: &Met, is_over: &AtomicBool) {
    let mut left: BTreeSet<_> = NAMES.into_iter().filter(|name| *name != mailbox.name()).collect();
    let mut senders: Vec<_> = left.iter().map(|name| mailbox.sender(*name).unwrap()).collect();
    while !is_over.load(Ordering::Relaxed) {
        for sender in senders.iter_mut().filter(|sender| left.contains(&sender.to())) {
            match sender.send(ASK, b"who") {
                // One that finds no room is asked again.
                Ok(_) | Err(SendError::Mailbox(_) | SendError::Station(_)) => {}
                Err(error) => panic!("{error}"),
            }
        }
        while let Ok(package) = mailbox.receive(Some(Duration::from_millis(50))) {
            let (head, body) = (*package.head(), package.body().to_vec());
            if let Some(times) = times.as_ref().filter(|_| NAMES[3..].contains(&head.from)) {
                let journey = times.journey(&package);
                assert!(journey.is_from_elsewhere && journey.sent.is_none());
                assert!(journey.delivered <= journey.received);
                met.delivered.store(journey.delivered.unwrap().nanos(), Ordering::Relaxed);
            }
            if let Some(times) = times.as_ref().filter(|_| NAMES[..3].contains(&head.from)) {
                assert!(times.journey(&package).came.is_some(), "from a station it comes by the LAN");
            }
            drop(package);
            match head.kind {
                ASK => {
                    let back = senders.iter_mut().find(|sender| sender.to() == head.from).unwrap();
                    // It asks again where its answer found no room.
                    let _ = back.send_with(&head.answer(OK), &body);
                }
                OK => _ = left.remove(&head.from),
                _ => {}
            }
            met.all.store(left.is_empty(), Ordering::Relaxed);
        }
    }
}

#[test]
fn components_of_stations_and_hosts_meet_by_name() {
    let test = "components_of_stations_and_hosts_meet_by_name";
    network(test, || {
        let dir = tempfile::tempdir().unwrap();
        let Some(c) = in_c(test, "meet.c", dir.path()) else { return };
        let Some((python, client)) = in_python(test, "meet.py") else { return };
        let (c, routes) = (c.to_str().unwrap(), dir.path().join("routes.toml"));
        fs::write(&routes, include_str!("meet_routes.toml")).unwrap();
        let keys = dir.path().join("keys");
        let made = rtnet().args(["router", "keys", "--host", "10.1.0.4"]).arg(&keys).output().unwrap();
        assert!(made.status.success(), "{}", text(&made.stderr));
        let file = include_str!("meet.toml").replace("ROUTES", routes.to_str().unwrap());
        let file = file.replace("KEYS", keys.join("client").to_str().unwrap());
        let cell = Cell::with("meet", |_| file);
        let router_file = dir.path().join("router.toml");
        let listens = format!(
            "insecure = true\n[[listen]]\naddress = \"{ROUTER}\"\n\
             [[listen]]\naddress = \"{BY_TLS}\"\nkeys = \"keys/router\"\n"
        );
        fs::write(&router_file, listens).unwrap();
        let router_file = router_file.to_str().unwrap();
        let router = start(
            &cell,
            "hosts",
            &[env!("CARGO_BIN_EXE_rtnet"), "router", router_file, "--name", &cell.name],
        );
        wait_until("all stations have their router", || {
            let is_connected = |station| {
                let counters = json(rtnet().args(["stat", "-S", &cell.place(station), "--json"]));
                counters["tcp"]["connected"] == true
            };
            ["master", "arm", "leg"].into_iter().all(is_connected)
        });

        let numbers = NAMES.map(|name| format!("{:#010x}", name.0));
        let names_for = |own: usize| {
            let others = numbers.iter().enumerate().filter(move |(n, _)| *n != own).map(|(_, name)| name);
            std::iter::once(&numbers[own]).chain(others).map(String::as_str).collect::<Vec<_>>()
        };
        let broker = Path::new("/run/rtnet").join(&cell.name).join("arm.packages");
        let python_path = format!("PYTHONPATH={}", client.display());
        let programs = [
            ("arm", vec![c, "station", broker.to_str().unwrap()], 1),
            ("hosts", vec![c, "router", ROUTER], 3),
            (
                "console",
                vec![
                    "env",
                    &python_path,
                    "PYTHONDONTWRITEBYTECODE=1",
                    "python3",
                    python.to_str().unwrap(),
                    "10.1.0.4",
                    "2000",
                ],
                4,
            ),
        ];
        let mut programs = programs.map(|(station, mut words, own)| {
            words.extend(names_for(own));
            start(&cell, station, &words)
        });

        let shape = Shape::new(8, 64);
        let stations = [("master", NAMES[0]), ("leg", NAMES[2])].map(|(station, name)| {
            let component = Component::named(&cell.place(station)).unwrap();
            (Some(component.times()), component.mailbox(name, shape).unwrap())
        });
        let namespace = cell.status()["stations"][3]["pid"].as_u64().unwrap();
        let of_host = thread::spawn(move || {
            // The threads that it starts are in this namespace, too.
            setns(File::open(format!("/proc/{namespace}/ns/net")).unwrap(), CloneFlags::CLONE_NEWNET)
                .unwrap();
            TcpStream::connect(ROUTER).unwrap();
            let component = Component::of_router(&TcpOptions::new(ROUTER.parse().unwrap())).unwrap();
            (None, component.mailbox(NAMES[5], shape).unwrap())
        });
        let [first, second] = stations;
        let mut in_rust = [first, second, of_host.join().unwrap()];

        let is_over = AtomicBool::new(false);
        let met: [Met; 3] = Default::default();
        thread::scope(|scope| {
            let _ends = AtEnd(&is_over);
            for (mailbox, met) in in_rust.iter_mut().zip(&met) {
                let is_over = &is_over;
                scope.spawn(move || meets(mailbox, met, is_over));
            }
            programs.iter_mut().for_each(|program| assert_eq!(program.line(), "met"));
            wait_until("all have met", || met.iter().all(|met| met.all.load(Ordering::Relaxed)));
            // The clock of one of these stations is far ahead of the other's.
            let [at_master, at_leg] = [0, 1].map(|station| met[station].delivered.load(Ordering::Relaxed));
            let apart = Duration::from_nanos(at_master.abs_diff(at_leg));
            assert!(
                at_master > 0 && at_leg > 0 && apart < AHEAD / 2,
                "global time is the same everywhere: {apart:?} apart"
            );
            shows_ways(&cell);
            shows_losses(&cell);
            stations_go_on_without(&router, &cell);
            is_over.store(true, Ordering::Relaxed);
        });
        drop((in_rust, programs, router));
        let name = cell.name.clone();
        cell.down();
        forget(&name);
    });
}

/// Packages of stations pass on the LAN while the router hangs, and the queue to it is full.
fn stations_go_on_without(router: &Program, cell: &Cell) {
    stop(router.pid());
    let [mut arm, leg] = [("arm", NAMES[1]), ("leg", NAMES[2])].map(|(station, name)| {
        let more = MailboxName::new(0, name.class(), name.instance(), 1);
        Component::named(&cell.place(station)).unwrap().mailbox(more, Shape::new(8, 64)).unwrap()
    });
    let [mut by_lan, mut by_tcp] = [arm.name(), NAMES[4]].map(|to| leg.sender(to).unwrap());
    let mut is_full = || match by_tcp.send(DATA, &[0; 4_000]) {
        Ok(_) => false,
        Err(SendError::Mailbox(mailbox::SendError::Full(_))) => true,
        Err(error) => panic!("{error}"),
    };
    for number in 0..50u8 {
        // The kernel still takes some now and then: it makes its buffers larger.
        while !is_full() {}
        by_lan.send(DATA, &[number]).unwrap();
        assert_eq!(arm.receive(Some(PATIENCE)).unwrap().body().to_vec(), [number]);
    }
    kill(router.pid(), Signal::SIGCONT).unwrap();
}

/// The station shows what the router did not pass on.
fn shows_losses(cell: &Cell) {
    let leg = cell.place("leg");
    let lost = || {
        let shown = json(rtnet().args(["stat", "-S", &leg, "--json"]));
        shown["tcp"]["lost_at_router"]["nobody_there"].as_u64().unwrap()
    };
    // The first questions came before the mailboxes of others, and are in an account by now.
    let mut before = lost();
    wait_until("no more are counted", || {
        thread::sleep(Duration::from_millis(300));
        core::mem::replace(&mut before, lost()) == before
    });
    let sent = rtnet().args(["package", "-S", &leg, "send", "0x00990000", "hello"]).output().unwrap();
    assert!(sent.status.success(), "{}", text(&sent.stderr));
    wait_until("it is counted", || lost() == before + 1);
}

/// The way of packages from a station to a mailbox of its own, of another station, of a host, and to one that nobody has.
fn shows_ways(cell: &Cell) {
    let way = |to: MailboxName| {
        let to = format!("{:#010x}", to.0);
        json(rtnet().args(["package", "-S", &cell.place("leg"), "--json", "route", &to]))
    };
    let leg = way(NAMES[2]);
    assert_eq!((&leg["way"], &leg["process"]), (&"mailbox".into(), &std::process::id().into()));
    let arm = way(NAMES[1]);
    assert_eq!(
        (&arm["way"], &arm["route"], &arm["station"]),
        (&"lan".into(), &"0.0x80.2".into(), &"10.0.0.2".into())
    );
    assert_eq!(way(NAMES[4])["way"], "tcp");
    let why = |to: MailboxName| {
        let to = format!("{:#010x}", to.0);
        let output = rtnet().args(["package", "-S", &cell.place("leg"), "route", &to]).output().unwrap();
        text(&output.stdout).to_string()
    };
    for (to, words) in [
        (NAMES[2], "mailbox: it is a mailbox of this station"),
        (NAMES[1], "LAN: no mailbox of this station, and route 0.0x80.2 leads to 10.0.0.2"),
        (NAMES[4], "TCP: no mailbox of this station, and no route leads to another; "),
        (NAMES[5], "TCP: no mailbox of this station, and it is of another system; "),
    ] {
        assert!(why(to).contains(words), "{}", why(to));
    }
}
