//! A program that writes nonsense into the memory that it shares with a station: whoever looks sees that it was ended for that.

#![allow(unsafe_code)]

use std::io::IoSliceMut;
use std::net::SocketAddrV4;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use nix::cmsg_space;
use nix::sys::socket::{ControlMessageOwned, MsgFlags, recvmsg};
use rtnet::api::handshake::{ANSWER_LEN, Ask, DESCRIPTORS};
use rtnet::api::memory::Memory;
use rtnet::api::place::socket_of;
use rtnet::api::segment;
use rtnet::api::{Station as Attached, UdpSocket};
use serde_json::Value;
use socket2::{Domain, SockAddr, Socket, Type};

use crate::host::{network, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

/// A program that does not keep to what `rtnet::api` does: its connection, and its memory.
fn attach(control: &Path) -> (Socket, Memory) {
    let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
    socket.connect(&SockAddr::unix(control).unwrap()).unwrap();
    socket.send(&Ask::OpenUdp(0).to_bytes()).unwrap();
    let (mut packet, mut room) = ([0; ANSWER_LEN + 1], cmsg_space!([i32; DESCRIPTORS]));
    let mut parts = [IoSliceMut::new(&mut packet)];
    let message = recvmsg::<()>(socket.as_raw_fd(), &mut parts, Some(&mut room), MsgFlags::empty()).unwrap();
    let rights = message.cmsgs().unwrap().find_map(|part| match part {
        ControlMessageOwned::ScmRights(rights) => Some(rights),
        _ => None,
    });
    // SAFETY: the kernel has just made them for this process, and nobody else knows of them.
    let own = |fd| unsafe { OwnedFd::from_raw_fd(fd) };
    let mut descriptors = rights.expect("it is let in").into_iter().map(own);
    let memory = Memory::open(descriptors.next().unwrap()).unwrap();
    (socket, memory)
}

fn stat(name: &str) -> Value {
    let output = rtnet().args(["stat", "-S", name, "--json"]).output().unwrap();
    crate::schema::read(&output.stdout)
}

/// Sends to itself until it has received, asleep.
fn is_served(socket: &UdpSocket) {
    socket.set_timeout(Some(PATIENCE));
    let port = socket.local_addr().unwrap().port();
    socket.send_to(b"to myself", SocketAddrV4::new([10, 0, 0, 1].into(), port)).unwrap();
    socket.receive(&mut [0; 16]).unwrap();
}

#[test]
fn a_program_that_was_ended_for_nonsense_is_counted_and_so_are_those_that_were_woken() {
    network("a_program_that_was_ended_for_nonsense_is_counted_and_so_are_those_that_were_woken", || {
        let (medium, name) = (Medium::new(), unique("nonsense"));
        let options = ["--interface", "rt0", "--discipline", "direct", "--ip", "10.0.0.1/24"];
        let station = Station::start(&medium.a, &[&options[..], &["--name", &name]].concat());
        station.wait_for("Ctrl-C ends it");
        let shown = stat(&name);
        let (programs, stale) = (&shown["programs"], &shown["station"]["stale"]);
        assert_eq!((&programs["nonsense"], &programs["wakes"], stale), (&0.into(), &0.into(), &0.into()));
        let (_connection, memory) = attach(&socket_of(&name).unwrap());
        // More was written than there is room for.
        memory[segment::sent().head].store(1 << 40, Ordering::SeqCst);
        let other = Attached::named(&name).and_then(|station| station.udp()).unwrap();
        let deadline = Instant::now() + PATIENCE;
        loop {
            is_served(&other);
            let shown = stat(&name);
            let count = |of: &str| shown["programs"][of].as_u64().unwrap();
            if (count("nonsense"), count("wakes") > 0) == (1, true) {
                assert_eq!(memory[segment::STATE].load(Ordering::SeqCst), segment::ENDED);
                return;
            }
            assert!(Instant::now() < deadline, "{shown:#}");
            std::thread::sleep(Duration::from_millis(5));
        }
    });
}
