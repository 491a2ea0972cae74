//! What is tunnelled to a station, for whoever is not its real-time thread.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};

use socket2::Socket;

use super::interface::Interface;
use super::{filter, packet};
use crate::buf::Buf;
use crate::wire::ethernet::EtherType;

/// Bytes of frames that wait in the kernel, each with what that has around it: some hundred of the largest.
pub const TUNNELLED_QUEUE: usize = 512 * 1024;

/// A socket that hears the RTmac frames that have another frame inside, and nothing else. A flood of them fills its queue
/// only, and wakes only who waits for it.
pub struct Tunnelled {
    socket: Socket,
}

impl Tunnelled {
    /// Opens it on an interface: for frames to this station or to groups; for those to others, too, for who forwards them to
    /// hosts behind it. Needs CAP_NET_RAW.
    pub fn open(interface: &Interface, of_others: bool) -> io::Result<Self> {
        let socket = packet::open()?;
        filter::accept_only_tunnelled(&socket, of_others)?;
        // The host's limit holds.
        let _ = socket.set_recv_buffer_size(TUNNELLED_QUEUE);
        packet::bind(&socket, interface.index, EtherType::RTMAC.0)?;
        if of_others {
            packet::hear_everything(&socket, interface.index as i32)?;
        }
        Ok(Self { socket })
    }

    /// Receives a frame without waiting: whether it was whole. `None` when none waits.
    pub fn receive(&self, frame: &mut Buf) -> Option<bool> {
        Some(!packet::receive(&self.socket, frame)?.truncated)
    }

    /// How many frames were dropped since the last call because the queue was full.
    pub fn take_dropped(&self) -> u64 {
        // A packet socket always has statistics.
        packet::take_dropped(&self.socket).unwrap_or(0)
    }
}

impl AsFd for Tunnelled {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}
