//! Sockets of a station for other processes, and its time.
//!
//! A program attaches by the station's control socket and has memory in common with it: what it sends and receives goes
//! through bounded rings there, without a system call as long as both are awake. It needs no right but to open that
//! socket.
//!
//! ```no_run
//! use rtnet::api::Station;
//!
//! // As behind `rtnet -S`; it was started with `--ip`.
//! let socket = Station::named("cell/arm")?.udp()?;
//! socket.bind("0.0.0.0:36000".parse().expect("an address"))?;
//! let mut room = [0; 1500];
//! let received = socket.receive(&mut room)?;
//! println!("{} bytes from {:?}, {:?} on the master's clock", received.len, received.from, received.global);
//! # Ok::<(), std::io::Error>(())
//! ```
//!
//! Errors have BSD's numbers, in [`raw_os_error`](std::io::Error::raw_os_error). Those of opening tell of these limits:
//!
//! | number | what there are no more of, and what to do |
//! |---|---|
//! | `ENODEV` | a station there, or one whose thread looks: start it; of an open socket: it has ended, attach anew |
//! | `EAGAIN` | its 64 sockets, 1024 programs or automatic ports: close some |
//! | `EMFILE` | descriptors, of the station (each socket takes five) or of this process: `ulimit -n` of the one that has few |
//! | `EOPNOTSUPP` | the station has no sockets: start it with `--ip` |
//! | `ETIMEDOUT` | its answer, for two seconds: it is stopped, or has no time |
//!
//! The descriptor of a socket works in `poll`, `epoll` and what is made of them: it is readable when something has come
//! since [`UdpSocket::try_receive`] found nothing, or when the station is gone. Programs in the station's own thread have
//! the same sockets by [`Access`].

pub mod client;
mod connection;
pub mod door;
mod end;
pub mod handshake;
pub mod letters;
pub mod line;
pub mod listener;
pub mod memory;
pub mod place;
mod ready;
pub mod ring;
pub mod segment;

pub use client::{PacketSocket, Station, UdpSocket};

// What both ways to program have in common, and the other one: a program in the station's own thread.
pub use crate::socket::{
    Access, Flags, LinkAddress, LinkMode, LinkType, Options, Program, Received, Sender, SocketId,
};

#[cfg(test)]
mod tests;
