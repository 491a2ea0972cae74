//! Two systems with a router each, and a link between them.

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox};
use package_router::mailbox::Shape;
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::TcpOptions;
use package_router::tcp::control::ROUTER;
use package_router::tcp::keys::ClientKeys;
use package_router::wire::{NOT_AVAILABLE, OK};
use serde_json::Value;
use tempfile::TempDir;
use tools::lab::namespace::Segment;

use super::tls::{Keys, crowds};
use super::{AtEnd, Router, has_joined, not_started, package};
use crate::cell::wait_until;
use crate::host::{shared, unique};
use crate::station::{Medium, Station, set};

const PATIENCE: Duration = Duration::from_secs(30);
/// A command or an answer that comes later is asked for again.
const ANSWERED_WITHIN: Duration = Duration::from_millis(500);

/// Asks until the other answers: until the link is open nobody is there.
fn asks(from: &mut Mailbox, to: &mut Mailbox) {
    let (mut there, mut back) = (from.sender(to.name()).unwrap(), to.sender(from.name()).unwrap());
    let begun = Instant::now();
    loop {
        there.send(21, b"who").unwrap();
        let answered = std::thread::scope(|scope| {
            scope.spawn(|| {
                let command = to.receive(Some(Duration::from_millis(100))).map(|package| *package.head());
                command.map(|command| back.send_with(&command.answer(OK), &[]))
            });
            from.receive(Some(ANSWERED_WITHIN)).map(|package| package.head().kind)
        });
        assert!(begun.elapsed() < PATIENCE, "{} does not answer", to.name());
        match answered {
            Ok(OK) => return,
            // It is asked again.
            Ok(NOT_AVAILABLE) | Err(_) => {}
            Ok(kind) => panic!("kind {kind}"),
        }
    }
}

const FORGED: &[u8] = b"forged";

fn of_system(system: u8) -> MailboxName {
    MailboxName::new(system, Class(0x80), 0, 0)
}

/// Two routers that are reached by TLS, the first with a link to the second, and a client of each.
struct Pair {
    keys: Keys,
    file: PathBuf,
    first: Router,
    second: Router,
    clients: [Component; 2],
    mailboxes: [Mailbox; 2],
    _dir: TempDir,
}

impl Pair {
    fn new() -> Self {
        let (keys, dir) = (Keys::new(), tempfile::tempdir().unwrap());
        let file = dir.path().join("router.toml");
        fs::write(&file, "system = 2\n").unwrap();
        let second = Self::start(&keys, &file, "127.0.0.1:0");
        let (address, of_client) = (second.at, keys.of("client"));
        let link = format!("[[link]]\nrouter = \"{address}\"\nkeys = {of_client:?}\nsystems = [2]\n");
        fs::write(&file, format!("system = 1\n{link}")).unwrap();
        let first = Self::start(&keys, &file, "127.0.0.1:0");
        let clients = [&first, &second].map(|router| {
            let keys = Some(ClientKeys::read(&keys.of("client")).unwrap());
            let at = router.at.to_string().parse().unwrap();
            Component::of_router(&TcpOptions { keys, ..TcpOptions::new(at) }).unwrap()
        });
        let mailbox =
            |client: &Component, system| client.mailbox(of_system(system), Shape::new(8, 64)).unwrap();
        let mailboxes = [mailbox(&clients[0], 1), mailbox(&clients[1], 2)];
        Self { keys, file, first, second, clients, mailboxes, _dir: dir }
    }

    fn start(keys: &Keys, file: &Path, listen: &str) -> Router {
        let keys = keys.of("router");
        Router::start(
            "linked",
            &[file.to_str().unwrap(), "--listen", listen, "--keys", keys.to_str().unwrap()],
        )
    }

    /// Each mailbox asks the other, which answers.
    fn meet(&mut self) {
        for client in &self.clients {
            wait_until("it is registered", || client.tcp().unwrap().status().names == 1);
        }
        let [one, other] = &mut self.mailboxes;
        asks(one, other);
        asks(other, one);
    }
}

fn roles(router: &Router) -> Vec<String> {
    let status = router.status();
    let role = |client: &Value| client["role"].as_str().unwrap().to_owned();
    let mut roles: Vec<_> = status["clients"].as_array().unwrap().iter().map(role).collect();
    roles.sort_unstable();
    roles
}

#[test]
fn mailboxes_of_two_systems_meet_by_a_link() {
    let mut pair = Pair::new();
    pair.meet();
    let expected = [["client", "link"], ["client", "router of system 1"]];
    assert_eq!([roles(&pair.first), roles(&pair.second)], expected);
    // The other router is killed, and comes back.
    let at = pair.second.at.to_string();
    pair.second.child.kill().unwrap();
    pair.second.child.wait().unwrap();
    fs::write(&pair.file, "system = 2\n").unwrap();
    pair.second = Pair::start(&pair.keys, &pair.file, &at);
    pair.meet();
}

/// A client that no router lets in, with a mailbox that has the name of another.
struct Stranger {
    client: Component,
    mailbox: Mailbox,
}

impl Stranger {
    fn new(at: SocketAddr, keys: &Keys, system: u8) -> Self {
        let keys = Some(ClientKeys::read(&keys.of("client")).unwrap());
        let options = TcpOptions { keys, ..TcpOptions::new(at.to_string().parse().unwrap()) };
        let client = Component::of_router(&options).unwrap();
        let mailbox = client.mailbox(of_system(system), Shape::new(8, 64)).unwrap();
        Self { client, mailbox }
    }

    fn sends(&mut self) {
        let other = of_system(3 - self.mailbox.name().system());
        self.mailbox.sender(other).unwrap().send(21, FORGED).unwrap();
    }

    /// Nothing but an answer of its own component: from a router nothing has come.
    fn has_nothing(&mut self) {
        while let Some(package) = self.mailbox.try_receive().unwrap() {
            assert_eq!(package.head().kind, NOT_AVAILABLE);
        }
        let status = self.client.tcp().unwrap().status();
        assert_eq!((status.names, status.session.received), (0, 0));
    }
}

/// They try to be the router of a system, to take a client's name, and to use up what the routers have.
#[test]
fn strangers_harm_neither_of_two_linked_systems() {
    let mut pair = Pair::new();
    pair.meet();
    let others = Keys::new();
    // They believe the routers, and have a certificate of another authority.
    fs::copy(pair.keys.of("client").join("ca.pem"), others.of("client").join("ca.pem")).unwrap();
    let at = [pair.first.at, pair.second.at];
    let names = || [&pair.first, &pair.second].map(|router| router.status()["names"].clone());
    let before = names();
    for (at, system) in at.into_iter().zip([2u8, 1]) {
        let mut plain = TcpStream::connect(at).unwrap();
        plain.write_all(&package(ROUTER, 0, 0, &u32::from(system).to_le_bytes())).unwrap();
        // It may be reset before it is read.
        let _ = plain.read_to_end(&mut Vec::new());
    }
    // Others have no certificate, and a secret that is not the routers'.
    let without = Keys::new().has_only_a_secret();
    fs::copy(pair.keys.of("client").join("ca.pem"), without.of("client").join("ca.pem")).unwrap();
    let all = at.into_iter().flat_map(|at| [(at, &others), (at, &without)]);
    let all = all.flat_map(|(at, keys)| [1, 2].map(|system| Stranger::new(at, keys, system)));
    let mut strangers: Vec<Stranger> = all.collect();
    let counted = |router: &Router, reason: &str| router.status()["endings"][reason].as_u64().unwrap();
    for router in [&pair.first, &pair.second] {
        wait_until("they are kept out", || {
            ["tls", "certificate", "stranger"].into_iter().all(|reason| counted(router, reason) >= 1)
        });
    }
    assert_eq!(names(), before);
    // While the mailboxes exchange packages, strangers send in their names, and would receive by them.
    strangers.iter_mut().for_each(Stranger::sends);
    pair.meet();
    strangers.iter_mut().for_each(Stranger::has_nothing);
    for mailbox in &mut pair.mailboxes {
        while let Some(package) = mailbox.try_receive().unwrap() {
            assert_ne!(package.body().to_vec(), FORGED);
        }
    }
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let _ends = AtEnd(&is_over);
        let is_over = &is_over;
        for at in at {
            scope.spawn(move || crowds(at, is_over));
        }
        for router in [&pair.first, &pair.second] {
            wait_until("they crowd", || counted(router, "crowded") > 0);
        }
        (0..10).for_each(|_| pair.meet());
    });
    assert_eq!(pair.first.status()["links"][0]["open"], true);
    assert_eq!(roles(&pair.second).iter().filter(|role| *role != "client").count(), 1);
}

/// Two robots: a station of system 1 at its router, a link, and a station of system 2 at its own.
#[test]
fn stations_of_two_systems_meet_by_their_routers() {
    let test = "stations_of_two_systems_meet_by_their_routers";
    shared(test, || {
        let medium = Medium::new();
        set(&medium.a, "lo", true);
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("router.toml");
        let router = |text: &str| {
            fs::write(&file, text).unwrap();
            let start = || Router::start("robot", &["--listen", "127.0.0.1:0", file.to_str().unwrap()]);
            medium.a.run(start).unwrap()
        };
        let second = router("system = 2");
        let first = router(&format!("system = 1\n[[link]]\nrouter = \"{}\"\nsystems = [2]", second.at));
        // The second robot has a network of its own; only its router is reached from here.
        let mut segment = Segment::new().unwrap();
        segment.attach(&medium.a, "port2", "rt1", [2, 0, 0, 0, 0, 0xc]).unwrap();
        let station = |router: &Router, interface: &str, system: u8| {
            let (name, at, system) = (unique("robot"), router.at.to_string(), system.to_string());
            let net =
                ["--interface", interface, "--discipline", "nomac", "--ip", "10.0.0.1/24", "--name", &name];
            let packages = ["--packages", "--package-system", &system, "--router", &at];
            let station = Station::start(&medium.a, &[&net[..], &packages].concat());
            has_joined(&name);
            (name, station)
        };
        let (arm, _arm) = station(&first, "rt0", 1);
        let (leg, _leg) = station(&second, "rt1", 2);
        let mailbox = |station: &str, system: u8| {
            let component = Component::named(station).unwrap();
            component.mailbox(of_system(system), Shape::new(8, 64)).unwrap()
        };
        let (mut arm, mut leg) = (mailbox(&arm, 1), mailbox(&leg, 2));
        asks(&mut arm, &mut leg);
        asks(&mut leg, &mut arm);
    });
}

#[test]
fn a_link_that_cannot_be_is_refused_at_the_start() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("router.toml");
    for (text, words) in [
        ("[[link]]\nrouter = \"10.0.0.9\"\nsystems = [0]", "leads to system 0, which is this router's own"),
        ("[[link]]\nrouter = \"10.0.0.9\"\nkeys = \"none\"", "none/ca.pem: "),
        ("system = 256", "router.toml:1:10: "),
        ("[[link]]\nrouter = \"127.0.0.1:24999\"", "the link to 127.0.0.1:24999 leads to this router itself"),
    ] {
        fs::write(&file, text).unwrap();
        let output = not_started(&["--listen", "127.0.0.1:24999", file.to_str().unwrap()]);
        assert!(output.contains(words), "{output}");
    }
}

/// Nobody listens there, then a router does.
#[test]
fn a_link_shows_whether_it_is_open_and_else_why() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("router.toml");
    let other = Router::start("other", &[]);
    let (at, shown) = (other.at.to_string(), |router: &Router| router.status()["links"][0].clone());
    drop(other);
    fs::write(&file, format!("system = 1\n[[link]]\nrouter = \"{at}\"\nsystems = [2, 3]")).unwrap();
    let router = Router::start("opens", &["--listen", "127.0.0.1:0", file.to_str().unwrap()]);
    wait_until("it says why", || {
        let link = shown(&router);
        link["open"] == false && link["last_error"].as_str().is_some_and(|why| why.contains("refused"))
    });
    assert_eq!(
        (&shown(&router)["router"], shown(&router)["systems"][1].as_u64()),
        (&at.clone().into(), Some(3))
    );
    fs::write(&file, "system = 2").unwrap();
    let other = Router::start("opened", &["--listen", &at, file.to_str().unwrap()]);
    wait_until("it is open", || shown(&router)["open"] == true);
    assert!(shown(&router)["last_error"].is_null());
    drop(other);
    wait_until("it is over, and says why", || {
        let link = shown(&router);
        link["open"] == false && link["last_error"].is_string()
    });
}

/// It knows the name of its host only, and finds itself there.
#[test]
fn a_link_to_the_router_itself_by_a_name_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("router.toml");
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    fs::write(&file, format!("system = 1\n[[link]]\nrouter = \"localhost:{port}\"\n")).unwrap();
    let at = format!("127.0.0.1:{port}");
    let router = Router::start("itself", &[file.to_str().unwrap(), "--listen", &at]);
    wait_until("it is refused", || {
        let closed = router.status()["closed"].clone();
        let why = |of: &Value| of["why"].as_str().unwrap().contains("takes no link of this system");
        closed.as_array().unwrap().iter().any(why)
    });
    assert_eq!(router.status()["links"][0]["open"], false);
}

/// The link is there, closed again with the reason, and tried later.
#[test]
fn a_link_to_ones_own_system_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("router.toml");
    let same = Router::start("same", &[]);
    fs::write(&file, format!("[[link]]\nrouter = \"{}\"\n", same.at)).unwrap();
    let router = Router::start("linked", &[file.to_str().unwrap(), "--listen", "127.0.0.1:0"]);
    wait_until("it is refused", || {
        let why = router.status()["closed"][0]["why"].clone();
        why.as_str().is_some_and(|why| why.contains("the router there takes no link of this system"))
    });
}
