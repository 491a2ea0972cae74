//! To a mailbox of another station: straight to the stack of one's own, which sends it by real-time UDP.

use core::net::{Ipv4Addr, SocketAddrV4};
use core::time::Duration;
use std::io;
use std::path::Path;

use rtnet::api::{Flags, Station, UdpSocket};
use rtnet::discipline::Channel;
use rtnet::live::clock::Deadline;

use super::SendError;
use crate::priority::level_of;
use crate::router::LAN_PORT;
use crate::wire::{Head, MOST_DATAGRAM, split};

/// A socket to a station, for packages to one mailbox there.
pub(super) struct Away {
    socket: UdpSocket,
    /// To which station, and in which slot.
    pub to: (Ipv4Addr, Channel),
    /// With which it sends now.
    priority: Option<u8>,
}

impl Away {
    /// By the station with this control socket to another.
    pub fn new(own: &Path, station: Ipv4Addr, channel: Channel) -> io::Result<Self> {
        let socket = Station::at(own).udp()?;
        socket.connect(Some(SocketAddrV4::new(station, LAN_PORT)))?;
        socket.set_channel(channel);
        socket.set_with_times(true);
        Ok(Self { socket, to: (station, channel), priority: None })
    }

    /// Hands over a package, head and body where they lie: nothing is put together first.
    pub fn send(&mut self, head: Head, body: &[u8]) -> Result<(), SendError> {
        if self.priority != Some(head.priority) {
            self.socket.set_priority(level_of(head.priority)).map_err(told)?;
            self.priority = Some(head.priority);
        }
        let head = head.with_body(body.len()).map_err(|_| SendError::Station(libc::EMSGSIZE))?;
        for piece in split(&head, MOST_DATAGRAM).map_err(|_| SendError::Station(libc::EMSGSIZE))? {
            let parts = [&piece.head.to_bytes()[..], &body[piece.body]];
            self.socket.send_parts(&parts, Flags::NONE).map_err(told)?;
        }
        Ok(())
    }
}

/// As long as a station that runs may take to look at what it was handed.
const TAKEN_WITHIN: Duration = Duration::from_secs(1);
const LOOK_EVERY: Duration = Duration::from_micros(200);

impl Away {
    /// Waits until the station has taken all of it, and says what it could not send.
    #[allow(clippy::disallowed_methods)]
    pub fn drained(&self) -> Result<(), SendError> {
        let deadline = Deadline::after(Some(TAKEN_WITHIN));
        while !self.socket.is_drained() {
            if deadline.left().is_some_and(|left| left.is_zero()) {
                return Err(SendError::Station(libc::ETIMEDOUT));
            }
            std::thread::sleep(LOOK_EVERY);
        }
        self.socket.take_error().map_or(Ok(()), |error| Err(told(error)))
    }

    /// What the station says that it has taken: to be compared with what it said before, and nothing else.
    pub fn taken(&self) -> u64 {
        self.socket.taken()
    }
}

fn told(error: io::Error) -> SendError {
    SendError::Station(error.raw_os_error().unwrap_or(libc::EIO))
}
