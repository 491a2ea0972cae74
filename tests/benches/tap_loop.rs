//! What a tunnel without slots is compared with: frames copied from a TAP device to a packet socket and back, nothing else.
//!
//! `tap_loop DEVICE INTERFACE` makes the device in the network namespace that it runs in, says `ready`, and copies until its
//! standard input ends. Whoever started it sets the device up. scripts/bench-vnic does.

use std::io::{self, Write};
use std::os::fd::AsFd;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{setsockopt, sockopt};
use nix::unistd::{read, write};
use rtnet::live::interface::Interface;
use rtnet::wire::ethernet::{self, EtherType};
use tests::bare::Bare;
use vnic::tun::{Device, Mode};

/// Frames one way before the other one is looked at, as the tunnel's thread does.
const AT_ONCE: usize = 32;
/// Its frames' own type; what they had before stands behind it, as with a tunnelled frame.
const KIND: EtherType = EtherType::EXPERIMENTAL;
/// Bytes of that, and of addresses.
const TYPE: usize = 2;
const ADDRESSES: usize = 12;

fn main() -> anyhow::Result<()> {
    // `cargo bench` runs every benchmark, with options of its own.
    let given: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with("--")).collect();
    let [device, interface] = &given[..] else {
        println!("SKIP tap_loop: scripts/bench-vnic runs it");
        return Ok(());
    };
    let socket = Bare::hearing(&Interface::find(interface)?, KIND)?;
    // As large as the tunnel's.
    setsockopt(&socket, sockopt::RcvBuf, &rtnet::live::TUNNELLED_QUEUE)?;
    let device = Device::open(Some(device), Mode::Tap)?;
    println!("ready");
    io::stdout().flush()?;
    copy(&device, &socket)
}

fn copy(device: &Device, socket: &Bare) -> anyhow::Result<()> {
    let mut frame = [0; ethernet::HEADER_LEN + ethernet::MTU];
    let input = io::stdin();
    loop {
        let waited_for = [device.as_fd(), socket.as_fd(), input.as_fd()];
        let mut entries = waited_for.map(|fd| PollFd::new(fd, PollFlags::POLLIN));
        poll(&mut entries, PollTimeout::NONE)?;
        if entries[2].revents().is_some_and(|events| !events.is_empty()) {
            return Ok(());
        }
        for _ in 0..AT_ONCE {
            let Ok(len) = read(device, &mut frame[TYPE..]) else { break };
            frame.copy_within(TYPE..TYPE + ADDRESSES, 0);
            frame[ADDRESSES..][..TYPE].copy_from_slice(&KIND.0.to_be_bytes());
            socket.send(&frame[..TYPE + len]);
        }
        for _ in 0..AT_ONCE {
            let Some(len) = socket.receive(&mut frame) else { break };
            frame.copy_within(..ADDRESSES, TYPE);
            let _ = write(device, &frame[TYPE..len]);
        }
    }
}
