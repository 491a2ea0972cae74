//! Components of three stations and of hosts without one, in Rust, C and Python, exchange packages by name.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use package_router::component::{Component, Mailbox, SendError, Times};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::TcpOptions;
use package_router::wire::OK;
use rtnet::time::Span;
use tools::lab::namespace::Namespace;

use super::languages::{Program, in_c, in_python};
use super::{AtEnd, forget, has_joined};
use crate::cell::{Cell, json, text, wait_until};
use crate::host::{figure, network, stop};
use crate::rtnet;
use crate::station::PATIENCE;
use crate::vnic::are_there;

const ASK: i8 = 21;
const DATA: i8 = -6;
/// The router's addresses: for each of two hosts in the clear, and for stations by TLS, as their lab's file says.
const FOR_HOSTS: [&str; 2] = ["10.2.1.1:2000", "10.2.2.1:2000"];
const BY_TLS: &str = "10.1.0.4:2001";
/// The components: on the master, the arm and the leg, and on two hosts without a station, in C and Rust on the first and in Python on the
/// second. The last is of another system.
const NAMES: [MailboxName; 6] =
    [name(1), name(2), name(3), name(4), name(5), MailboxName::new(1, Class(0x80), 6, 0)];

/// Stations that keep their slots, which are 400 us apart, differ in global time by less, whatever their clocks show. Those of the master
/// and the leg are 100 s apart, as the file says.
const DIFFER: Span = Span::from_millis(1);

const fn name(instance: u8) -> MailboxName {
    MailboxName::new(0, Class(0x80), instance, 0)
}

/// Two hosts without a station, each with a wire to the host of the router.
fn hosts(cell: &Cell) -> [Namespace; 2] {
    let gate = cell.status()["stations"][3]["pid"].to_string();
    [1, 2].map(|host| {
        let (namespace, peer) = (Namespace::new().unwrap(), format!("host{host}"));
        let ip = |words: String| {
            let run = || Command::new("sh").args(["-c", &words]).output().unwrap();
            let done = namespace.run(run).unwrap();
            assert!(done.status.success(), "{words}: {}", text(&done.stderr));
        };
        ip(format!("ip link add eth0 type veth peer name {peer} netns {gate}"));
        ip(format!("ip address add 10.2.{host}.2/24 dev eth0 && ip link set eth0 up"));
        let there = format!("ip address add 10.2.{host}.1/24 dev {peer} && ip link set {peer} up");
        let done =
            rtnet().args(["lab", "exec", &cell.place("gate"), "--", "sh", "-c", &there]).output().unwrap();
        assert!(done.status.success(), "{}", text(&done.stderr));
        namespace
    })
}

/// In the namespace of a station.
fn start(cell: &Cell, station: &str, words: &[&str]) -> Program {
    let mut command = rtnet();
    command.args(["lab", "exec", &cell.place(station), "--"]).args(words);
    Program::start(&mut command)
}

/// Asks all others until each has answered, and answers them until it is over. Packages of hosts that come to a station have the global
/// time of their delivery.
fn meets((times, mailbox): &mut (Option<Times>, Mailbox), has_met: &AtomicBool, is_over: &AtomicBool) {
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
                assert!(journey.delivered.is_some() && journey.delivered <= journey.received);
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
            has_met.store(left.is_empty(), Ordering::Relaxed);
        }
    }
}

#[test]
fn components_of_stations_and_hosts_meet_by_name() {
    let test = "components_of_stations_and_hosts_meet_by_name";
    network(test, || {
        if !are_there(test, &[("ip", "iproute2")]) {
            return;
        }
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
        let listens = FOR_HOSTS.map(|address| format!("[[listen]]\naddress = \"{address}\"\n")).concat();
        let by_tls = format!("[[listen]]\naddress = \"{BY_TLS}\"\nkeys = \"keys/router\"\n");
        fs::write(&router_file, format!("insecure = true\n{listens}{by_tls}")).unwrap();
        let hosts = hosts(&cell);
        let router_file = router_file.to_str().unwrap();
        let router =
            start(&cell, "gate", &[env!("CARGO_BIN_EXE_rtnet"), "router", router_file, "--name", &cell.name]);
        ["master", "arm", "leg"].into_iter().for_each(|station| has_joined(&cell.place(station)));

        let numbers = NAMES.map(|name| format!("{:#010x}", name.0));
        let names_for = |own: usize| {
            let others = numbers.iter().enumerate().filter(move |(n, _)| *n != own).map(|(_, name)| name);
            std::iter::once(&numbers[own]).chain(others).map(String::as_str).collect::<Vec<_>>()
        };
        let broker = Path::new("/run/rtnet").join(&cell.name).join("arm.packages");
        let by = |host: &Namespace, mut command: Command| host.run(|| Program::start(&mut command)).unwrap();
        let mut in_c = Command::new(c);
        in_c.args(["router", FOR_HOSTS[0]]).args(names_for(3));
        let (host, port) = FOR_HOSTS[1].split_once(':').unwrap();
        let mut in_python = Command::new("python3");
        in_python.arg(&python).args([host, port]).args(names_for(4));
        in_python.env("PYTHONPATH", &client).env("PYTHONDONTWRITEBYTECODE", "1");
        let mut at_arm = vec![c, "station", broker.to_str().unwrap()];
        at_arm.extend(names_for(1));
        let mut programs = [start(&cell, "arm", &at_arm), by(&hosts[0], in_c), by(&hosts[1], in_python)];

        let shape = Shape::new(8, 64);
        let stations = [("master", NAMES[0]), ("leg", NAMES[2])].map(|(station, name)| {
            let component = Component::named(&cell.place(station)).unwrap();
            (Some(component.times()), component.mailbox(name, shape).unwrap())
        });
        let of_host = |name: MailboxName| {
            let component = Component::of_router(&TcpOptions::new(FOR_HOSTS[0].parse().unwrap())).unwrap();
            component.mailbox(name, shape).unwrap()
        };
        let [first, second] = stations;
        let last = (None, hosts[0].run(|| of_host(NAMES[5])).unwrap());
        let mut in_rust = [first, second, last];

        let is_over = AtomicBool::new(false);
        let met: [AtomicBool; 3] = Default::default();
        thread::scope(|scope| {
            let _ends = AtEnd(&is_over);
            for (mailbox, has_met) in in_rust.iter_mut().zip(&met) {
                let is_over = &is_over;
                scope.spawn(move || meets(mailbox, has_met, is_over));
            }
            programs.iter_mut().for_each(|program| assert_eq!(program.line(), "met"));
            wait_until("all have met", || met.iter().all(|has_met| has_met.load(Ordering::Relaxed)));
            let host = hosts[0].run(|| of_host(MailboxName::new(1, Class(0x80), 7, 0))).unwrap();
            delivery_has_global_time(test, &cell, &host);
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

/// By the global time of one station a package of a host is delivered at another between its sending and its reception.
fn delivery_has_global_time(test: &str, cell: &Cell, host: &Mailbox) {
    let [master, leg] = ["master", "leg"].map(|station| Component::named(&cell.place(station)).unwrap());
    let now = || master.times().board().unwrap().global_now().unwrap().0;
    let mut mailbox = leg.mailbox(MailboxName::new(0, Class(0x80), 7, 0), Shape::new(8, 64)).unwrap();
    wait_until("it is registered, too", || {
        json(rtnet().args(["stat", "-S", &cell.place("leg"), "--json"]))["tcp"]["counters"]["mailboxes"] == 2
    });
    let mut sender = host.sender(mailbox.name()).unwrap();
    let mut taken = Vec::new();
    for _ in 0..20 {
        let sent = now();
        sender.send(DATA, b"when").unwrap();
        let delivered = leg.times().journey(&mailbox.receive(Some(PATIENCE)).unwrap()).delivered.unwrap();
        let received = now();
        assert!(
            sent - DIFFER <= delivered && delivered <= received + DIFFER,
            "sent {sent:?}, delivered {delivered:?}, received {received:?}"
        );
        taken.push(received - sent);
    }
    taken.sort_unstable();
    figure(test, &format!("delivered at a station within {} of another's global time (p50)", taken[10]));
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
