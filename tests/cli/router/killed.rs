//! Packages that a killed router takes with it.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread;
use std::time::Duration;

use nix::unistd::Pid;
use package_router::component::{Component, SendError, Sender};
use package_router::mailbox::{self, Shape};
use package_router::name::{Class, MailboxName};
use package_router::tcp::client::{TcpOptions, TcpStatus};
use package_router::tcp::keys::ClientKeys;
use package_router::wire::Head;
use socket2::{Domain, Socket, Type};

use super::tls::Keys;
use super::{Router, package, register};
use crate::cell::wait_until;
use crate::host::{figure, stop};
use crate::station::PATIENCE;

const SENDER: MailboxName = MailboxName::new(0, Class(0x80), 1, 0);
const RECEIVER: MailboxName = MailboxName::new(0, Class(0x80), 2, 0);
const DATA: i8 = -6;
/// Bodies of 4,000 bytes: 2 MB, more than a receiver's kernel takes for a program that reads nothing, and less than a router's takes
/// with the router.
const PACKAGES: u64 = 500;
/// Longer than a sender waits before it asks the router again.
const ASKED_AGAIN: Duration = Duration::from_millis(300);

/// Sends a package once there is room for it.
fn send(sender: &mut Sender) {
    loop {
        match sender.send(DATA, &[0; 4_000]) {
            Ok(_) => return,
            Err(SendError::Mailbox(mailbox::SendError::Full(_))) => thread::sleep(Duration::from_millis(1)),
            Err(error) => panic!("{error}"),
        }
    }
}

/// A connection whose receive buffer does not grow.
fn slow(router: &Router) -> TcpStream {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
    socket.set_recv_buffer_size(64 << 10).unwrap();
    socket.connect(&router.at.into()).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    socket.into()
}

/// Whole packages that a connection still has, which has ended.
fn rest_of(mut stream: TcpStream) -> u64 {
    let (mut bytes, mut packages) = (Vec::new(), 0);
    // The router's kernel has reset it.
    let _ = stream.read_to_end(&mut bytes);
    let mut rest = &bytes[..];
    while let Ok(head) = Head::parse(rest)
        && let Some((_, behind)) = rest.split_at_checked(head.len as usize)
    {
        packages += u64::from(head.kind == DATA);
        rest = behind;
    }
    packages
}

#[test]
fn packages_in_the_kernel_of_a_killed_router_are_counted() {
    let mut router = Router::start("killed", &[]);
    let mut deaf = slow(&router);
    register(&mut deaf, RECEIVER.0);
    // It answers no question for a sign of life, either.
    deaf.write_all(&package(19, 0, 0, &[])).unwrap();
    let component = Component::of_router(&TcpOptions::new(router.at.to_string().parse().unwrap())).unwrap();
    let mailbox = component.mailbox(SENDER, Shape::new(4, 64)).unwrap();
    let watch = component.tcp().unwrap();
    wait_until("it is registered", || watch.status().names == 1);
    let mut sender = mailbox.sender(RECEIVER).unwrap();
    (0..PACKAGES).for_each(|_| send(&mut sender));
    wait_until("the router has read them", || router.status()["counters"]["packages_in"] == PACKAGES);
    thread::sleep(ASKED_AGAIN);

    // The kernel resets a connection from which a program that ends has not read everything.
    stop(Pid::from_raw(router.child.id() as i32));
    deaf.write_all(&package(0, 0, 0, &[])).unwrap();
    router.child.kill().unwrap();
    router.child.wait().unwrap();
    let missing = PACKAGES - rest_of(deaf);
    assert!(missing > 0, "the connection was not reset");
    let mut unconfirmed = 0;
    wait_until("they are counted", || {
        let TcpStatus { is_connected, session, .. } = watch.status();
        assert_eq!((session.sent, session.lost), (PACKAGES, 0));
        unconfirmed = session.unconfirmed;
        !is_connected && unconfirmed >= missing
    });
    let test = "packages_in_the_kernel_of_a_killed_router_are_counted";
    figure(test, &format!("{missing} of {PACKAGES} missing, {unconfirmed} unconfirmed"));
}

#[test]
fn packages_that_have_arrived_are_confirmed() {
    are_confirmed(&[], None);
}

/// TLS is longer on the wire than what it carries: that hides no arrival.
#[test]
fn packages_that_have_arrived_by_tls_are_confirmed() {
    let keys = Keys::new();
    let [of_router, of_client] = ["router", "client"].map(|whose| keys.of(whose));
    are_confirmed(&["--keys", of_router.to_str().unwrap()], Some(ClientKeys::read(&of_client).unwrap()));
}

/// A router that is killed a while after a package has arrived has confirmed it before.
fn are_confirmed(by: &[&str], keys: Option<ClientKeys>) {
    let started = |at: &str| Router::start("confirms", &[&["--listen", at], by].concat());
    let mut router = started("127.0.0.1:0");
    let at = router.at.to_string();
    let options = TcpOptions { keys, ..TcpOptions::new(at.parse().unwrap()) };
    let [here, there] = [(); 2].map(|()| Component::of_router(&options).unwrap());
    let mailbox = here.mailbox(SENDER, Shape::new(4, 64)).unwrap();
    let mut receiver = there.mailbox(RECEIVER, Shape::new(4, 4_000)).unwrap();
    let watch = here.tcp().unwrap();
    wait_until("a package is confirmed", || {
        wait_until("both are registered", || router.status()["names"] == 2);
        send(&mut mailbox.sender(RECEIVER).unwrap());
        let came = receiver.receive(Some(PATIENCE)).unwrap().body().len();
        // On a busy host it may be asked later: then there is another attempt.
        thread::sleep(ASKED_AGAIN);
        let before = watch.status().session.unconfirmed;
        router.child.kill().unwrap();
        router.child.wait().unwrap();
        wait_until("it is seen", || !watch.status().is_connected);
        router = started(&at);
        (came, watch.status().session.unconfirmed) == (4_000, before)
    });
}
