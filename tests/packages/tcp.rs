//! Programs on hosts without a station, and those of a station, meet by a TCP router.

use std::fs;
use std::net::{SocketAddr, TcpListener};
use std::os::fd::{BorrowedFd, RawFd};
use std::time::Instant;

use package_router::component::{Error, ReceiveError, SendError, Way};
use package_router::mailbox;
use package_router::node::Node;
use package_router::registry::Refused;
use package_router::rpc::{CallError, Proxy};
use package_router::tcp::client::{TcpOptions, TcpStatus};
use package_router::tcp::router::Limits;
use package_router::tcp::serve::{Remote, Server};
use package_router::wire::{ERROR, Head, NOT_AVAILABLE, OK};
use socket2::SockRef;

use super::*;

/// A router in a thread of its own.
struct Routing {
    at: SocketAddr,
    remote: Remote,
    thread: Option<JoinHandle<()>>,
}

impl Routing {
    fn new() -> Self {
        Self::at("127.0.0.1:0".parse().unwrap())
    }

    fn at(address: SocketAddr) -> Self {
        let mut server = Server::listen(&[(address, None)], Limits::default()).unwrap();
        let (at, remote) = (server.addresses().unwrap()[0], server.remote());
        let thread = thread::spawn(move || server.run().unwrap());
        Self { at, remote, thread: Some(thread) }
    }

    fn options(&self) -> TcpOptions {
        TcpOptions::new(self.at.to_string().parse().unwrap())
    }

    /// A program on a host without a station, with a mailbox.
    fn component(&self, mailbox: MailboxName) -> (Component, Mailbox) {
        let component = Component::of_router(&self.options()).unwrap();
        let mailbox = component.mailbox(mailbox, Shape::new(16, 2_000)).unwrap();
        registered(&component, 1);
        (component, mailbox)
    }
}

impl Drop for Routing {
    fn drop(&mut self) {
        self.remote.stop();
        self.thread.take().map(JoinHandle::join);
    }
}

fn status(of: &Component) -> TcpStatus {
    of.tcp().unwrap().status()
}

/// Waits until so many mailboxes are known to the router.
fn registered(component: &Component, count: usize) {
    eventually("they are registered", || status(component).names == count);
}

fn eventually(what: &str, mut is_so: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is_so() {
        assert!(begun.elapsed() < PATIENCE, "never: {what}");
        thread::sleep(Duration::from_millis(1));
    }
}

/// TCP_NODELAY of each end of all connections with a router: both ends are in this process.
#[allow(unsafe_code)]
fn nodelay_of(router: SocketAddr) -> Vec<bool> {
    let descriptors = fs::read_dir("/proc/self/fd").unwrap();
    let numbers = descriptors.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    let nodelay = |number: RawFd| {
        // SAFETY: it is used for three calls, which fail if another thread has closed it by now.
        let descriptor = unsafe { BorrowedFd::borrow_raw(number) };
        let socket = SockRef::from(&descriptor);
        let ends = [socket.local_addr().ok()?.as_socket()?, socket.peer_addr().ok()?.as_socket()?];
        ends.contains(&router).then(|| socket.tcp_nodelay().ok()).flatten()
    };
    numbers.filter_map(nodelay).collect()
}

#[test]
fn no_end_of_a_connection_waits_for_more_to_send() {
    let router = Routing::new();
    let _host = router.component(name(0x80, 0));
    assert_eq!(nodelay_of(router.at), [true; 2]);
}

#[test]
fn hosts_without_a_station_exchange_packages_by_name() {
    let router = Routing::new();
    let (ours, mut arm) = router.component(name(0x80, 0));
    let (_theirs, mut camera) = router.component(name(0x15, 0));
    assert_eq!(ours.way(camera.name()).unwrap(), Way::Tcp { is_of_other_system: false });
    let mut asks = arm.sender(camera.name()).unwrap();
    assert!(!asks.is_here() && asks.is_current());
    asks.set_priority(9);
    let id = asks.send(21, &[7; 1_999]).unwrap();
    let package = camera.receive(Some(PATIENCE)).unwrap();
    let command = *package.head();
    assert_eq!((command.from, command.kind, command.priority, command.id), (arm.name(), 21, 9, id));
    assert_eq!(package.body().to_vec(), [7; 1_999]);
    drop(package);
    camera.sender(arm.name()).unwrap().send_with(&command.answer(OK), b"seen").unwrap();
    let package = arm.receive(Some(PATIENCE)).unwrap();
    assert_eq!((package.head().kind, package.head().id, package.body().to_vec()), (OK, id, b"seen".to_vec()));
}

#[test]
fn a_mailbox_here_is_not_asked_for_at_the_router() {
    let router = Routing::new();
    let (component, mut arm) = router.component(name(0x80, 0));
    let mut leg = component.mailbox(name(0x81, 0), Shape::new(4, 8)).unwrap();
    assert!(matches!(component.way(leg.name()), Ok(Way::Here { .. })));
    let mut sender = arm.sender(leg.name()).unwrap();
    sender.send(1, b"here").unwrap();
    assert_eq!(leg.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"here");
    assert_eq!(status(&component).session.sent, 0);
    // Once it is elsewhere, it is found there.
    drop(leg);
    let (_theirs, mut leg) = router.component(name(0x81, 0));
    assert!(!sender.is_current());
    sender.follow().unwrap();
    sender.send(2, b"there").unwrap();
    assert_eq!(leg.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"there");
    assert_eq!(arm.try_receive().map(|package| package.is_some()), Ok(false));
}

/// Its sender knows of the router only; it does not follow.
#[test]
fn packages_reach_a_mailbox_that_comes_after_its_sender() {
    let router = Routing::new();
    let (component, mut arm) = router.component(name(0x80, 0));
    let mut sender = arm.sender(name(0x81, 0)).unwrap();
    let mut leg = component.mailbox(name(0x81, 0), Shape::new(4, 8)).unwrap();
    registered(&component, 2);
    sender.send(7, b"late").unwrap();
    let package = leg.receive(Some(PATIENCE)).unwrap();
    assert_eq!((package.head().from, package.body().to_vec()), (arm.name(), b"late".to_vec()));
    drop(package);
    // A command that it does not take is answered.
    sender.send(7, &[0; 9]).unwrap();
    assert_eq!(arm.receive(Some(PATIENCE)).unwrap().head().kind, ERROR);
}

/// Packages that were sent before the end of their component arrive.
#[test]
fn a_component_that_ends_has_sent_what_it_sent() {
    let router = Routing::new();
    let (_theirs, mut camera) = router.component(name(0x15, 0));
    for round in 0..20u8 {
        let (component, arm) = router.component(name(0x80, 0));
        let mut sender = arm.sender(camera.name()).unwrap();
        sender.send(-6, &[round; 1_000]).unwrap();
        drop((sender, arm, component));
        assert_eq!(camera.receive(Some(PATIENCE)).unwrap().body().to_vec(), [round; 1_000]);
    }
}

#[test]
fn a_command_that_nobody_takes_is_answered_and_counted() {
    let router = Routing::new();
    let (component, mut arm) = router.component(name(0x80, 0));
    let (theirs, mut camera) = router.component(name(0x15, 0));
    let answer = |arm: &mut Mailbox| arm.receive(Some(PATIENCE)).unwrap().head().kind;
    arm.sender(name(0x33, 0)).unwrap().send(1, &[]).unwrap();
    assert_eq!(answer(&mut arm), NOT_AVAILABLE, "nobody has it");
    let mut asks = arm.sender(camera.name()).unwrap();
    asks.send(1, &[0; 2_001]).unwrap();
    assert_eq!(answer(&mut arm), ERROR, "its slots hold no more than 2000 bytes");
    assert_eq!(
        asks.send(1, &[0; 4_097]),
        Err(SendError::LongerThanTcpTakes { got: 4_097, most: 4_096 }),
        "nor does the way there"
    );
    for more in 1..=17 {
        asks.send(1, &[]).unwrap();
        eventually("it is written", || status(&component).session.sent == 2 + more);
    }
    assert_eq!(answer(&mut arm), NOT_AVAILABLE, "16 wait, and there is no room");
    eventually("all of it is counted", || {
        let counted = status(&theirs).local;
        (counted.delivered, counted.too_large, counted.full) == (16, 1, 1)
    });
    (0..16).for_each(|_| _ = camera.receive(Some(PATIENCE)).unwrap());
    drop(router);
    eventually("the connection is lost", || !status(&component).is_connected);
    asks.send(1, &[]).unwrap();
    assert_eq!(answer(&mut arm), NOT_AVAILABLE, "there is no router");
    eventually("it is counted", || status(&component).local.not_connected == 1);
    assert!(status(&component).last_error.is_some());
}

#[test]
fn commands_are_answered_and_counted_where_the_queue_is_full() {
    // The kernel takes connections; no program reads.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = silent.local_addr().unwrap().to_string().parse().unwrap();
    let component = Component::of_router(&TcpOptions::new(at)).unwrap();
    eventually("it is connected", || status(&component).is_connected);
    let mut arm = component.mailbox(name(0x80, 0), Shape::new(16, 64)).unwrap();
    let mut asks = arm.sender(name(0x15, 0)).unwrap();
    let body = [0; 4_096];
    let full = Err(SendError::Mailbox(mailbox::SendError::Full(8)));
    let mut refused = 0;
    eventually("all buffers on the way are full", || {
        let is_full = asks.send(-6, &body) == full;
        refused += u64::from(is_full);
        is_full && {
            thread::sleep(Duration::from_millis(200));
            let stays_full = asks.send(-6, &body) == full;
            refused += u64::from(stays_full);
            stays_full
        }
    });
    // Its queue stays full: each command is answered, and nothing else is.
    for _ in 0..40 {
        let id = asks.send(1, &body).unwrap();
        assert_eq!(asks.send(0, &[]), full);
        let package = arm.receive(Some(PATIENCE)).unwrap();
        let Head { kind, id: of, from, len, .. } = *package.head();
        assert_eq!((kind, of, from, len), (NOT_AVAILABLE, id, name(0x15, 0), 16));
    }
    refused += 2 * 40;
    let mut proxy = Proxy::new(&component, name(0x80, 1), Shape::new(16, 64), name(0x15, 0)).unwrap();
    let calls: Vec<_> = (0..12).map(|_| proxy.begin(1, &body).unwrap()).collect();
    eventually("4 are answered", || proxy.is_answered(&calls[11]).unwrap());
    let answered: Vec<bool> = calls.iter().map(|call| proxy.is_answered(call).unwrap()).collect();
    assert_eq!(answered, [[false; 8].as_slice(), &[true; 4]].concat(), "8 wait for the router");
    let ends = calls.into_iter().skip(8).map(|call| proxy.finish(call, Duration::ZERO).err());
    assert!(ends.into_iter().all(|end| end == Some(CallError::NotAvailable(name(0x15, 0)))));
    refused += 4;
    // One of each id at once: the first 8 wait for the router.
    let mut many = component.mailbox(name(0x80, 2), Shape::new(256, 64)).unwrap();
    let mut asks = many.sender(name(0x15, 0)).unwrap();
    let ids: Vec<u8> = (0..264).map(|_| asks.send(1, &body).unwrap()).skip(8).collect();
    for id in ids {
        let package = many.receive(Some(PATIENCE)).unwrap();
        assert_eq!((package.head().kind, package.head().id), (NOT_AVAILABLE, id));
    }
    eventually("each is counted", || status(&component).local.queue_full == refused + 256);
    assert_eq!(status(&component).local.waiting, 24);
}

#[test]
fn clients_come_back_to_a_router_that_was_away() {
    let router = Routing::new();
    let (component, mut arm) = router.component(name(0x80, 0));
    let (theirs, camera) = router.component(name(0x15, 0));
    let at = router.at;
    drop(router);
    eventually("the connections are lost", || {
        [&component, &theirs].iter().all(|component| !status(component).is_connected)
    });
    // Meanwhile another mailbox is there.
    let more = component.mailbox(name(0x80, 1), Shape::new(4, 8)).unwrap();
    let router = Routing::at(at);
    registered(&component, 2);
    registered(&theirs, 1);
    camera.sender(arm.name()).unwrap().send(5, b"again").unwrap();
    assert_eq!(arm.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"again");
    drop(more);
    registered(&component, 1);
    assert_eq!(status(&component).connections, 2);
    drop(router);
}

#[test]
fn a_name_that_another_has_is_registered_once_it_is_free() {
    let router = Routing::new();
    let (first, arm) = router.component(name(0x80, 0));
    let second = Component::of_router(&router.options()).unwrap();
    let same = second.mailbox(name(0x80, 0), Shape::new(4, 8)).unwrap();
    eventually("it is refused", || {
        let status = status(&second);
        status.session.names_refused > 0 && (status.names, status.names_waiting) == (0, 1)
    });
    drop((arm, first));
    registered(&second, 1);
    drop(same);
}

#[test]
fn nobody_but_the_client_has_the_way_to_the_router() {
    let router = Routing::new();
    let (component, arm) = router.component(name(0x80, 0));
    let nobody = MailboxName::NOBODY;
    let refused = |error| matches!(error, Error::Refused(Refused::NoMailbox(name)) if name == nobody);
    assert!(arm.sender(nobody).is_err_and(refused), "the router itself is no mailbox");
    assert!(matches!(component.mailbox(nobody, Shape::new(1, 1)), Err(Error::Refused(Refused::Taken(_)))));
    // A broker without a router has no such way, and gives its mailbox to nobody else.
    let station = Station::new();
    let component = station.attach();
    let arm = component.mailbox(name(0x80, 0), Shape::new(1, 1)).unwrap();
    assert!(arm.sender(name(0x15, 0)).is_err());
    assert!(component.way(name(0x15, 0)).is_err());
}

/// Two stations' brokers, each with its client.
#[test]
fn components_of_brokers_meet_by_their_clients() {
    let router = Routing::new();
    let dir = tempfile::tempdir().unwrap();
    let nodes = ["a", "b"].map(|name| {
        let path = dir.path().join(name);
        let node = Node::start(Broker::bind(&path).unwrap(), &path, Some(&router.options())).unwrap();
        (node, path)
    });
    let mut mailboxes = [0, 1].map(|n| component(&nodes[n].1, name(0x80, n as u8), Shape::new(16, 8)));
    eventually("all are registered", || {
        nodes.iter().all(|(node, _)| node.tcp().unwrap().status().names == 1)
    });
    let [(_, one), (_, other)] = &mut mailboxes;
    let mut there = one.sender(other.name()).unwrap();
    let mut back = other.sender(one.name()).unwrap();
    for round in 0..1_000u32 {
        there.send(1, &round.to_le_bytes()).unwrap();
        assert_eq!(other.receive(Some(PATIENCE)).unwrap().body().to_vec(), round.to_le_bytes());
        back.send(0, &round.to_le_bytes()).unwrap();
        assert_eq!(one.receive(Some(PATIENCE)).unwrap().body().to_vec(), round.to_le_bytes());
    }
    // Its age is unknown: another host's clock sent it.
    there.send(1, &[]).unwrap();
    let package = other.receive(Some(PATIENCE)).unwrap();
    assert_eq!(package.stamps().origin, mailbox::Origin::Elsewhere(None));
    drop(package);
    let [(node, _), _] = nodes;
    drop(node);
    assert_eq!(one.receive(Some(PATIENCE)).map(drop), Err(ReceiveError::Gone));
}

/// A router may send in no name of a mailbox that is here.
#[test]
fn a_package_in_ones_own_name_is_refused() {
    use std::io::{Read, Write};
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string().parse().unwrap();
    let component = Component::of_router(&TcpOptions::new(address)).unwrap();
    let mut arm = component.mailbox(name(0x80, 0), Shape::new(4, 8)).unwrap();
    let (mut router, _) = listener.accept().unwrap();
    router.read_exact(&mut [0; 20]).unwrap();
    let head = Head { kind: 1, to: arm.name(), from: arm.name(), ..Head::default() };
    let stranger = Head { from: name(0x15, 0), ..head };
    router.write_all(&[head.to_bytes(), stranger.to_bytes()].concat()).unwrap();
    assert_eq!(arm.receive(Some(PATIENCE)).unwrap().head().from, stranger.from);
    eventually("it is counted", || status(&component).local.forged == 1);
    // Bytes that are no package end the connection, and another is opened.
    router.write_all(&[0xff; 16]).unwrap();
    let (mut again, _) = listener.accept().unwrap();
    again.read_exact(&mut [0; 20]).unwrap();
    let why = status(&component).last_error.unwrap();
    assert!(why.starts_with("a package of "), "{why}");
}
