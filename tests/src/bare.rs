//! A packet socket and nothing else: what a port's `send` is compared with.

#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};

use nix::libc;
use nix::sys::socket::{MsgFlags, recv, setsockopt, sockopt};
use rtnet::live::interface::Interface;
use rtnet::wire::ethernet::EtherType;

/// A socket as a port's for sending is: bound with protocol 0, so that it receives nothing.
pub struct Bare(OwnedFd);

impl Bare {
    /// Opens it on an interface of the calling thread's namespace.
    pub fn open(interface: &Interface) -> io::Result<Self> {
        Self::bound(interface, 0)
    }

    /// The same, which hears frames of an EtherType, too.
    pub fn hearing(interface: &Interface, kind: EtherType) -> io::Result<Self> {
        Self::bound(interface, kind.0)
    }

    fn bound(interface: &Interface, protocol: u16) -> io::Result<Self> {
        // SAFETY: takes no pointers.
        let fd = unsafe { libc::socket(libc::AF_PACKET, libc::SOCK_RAW | libc::SOCK_CLOEXEC, 0) };
        if fd < 0 {
            return Err(io::Error::last_os_error());
        }
        // SAFETY: the descriptor is open, and nobody else's.
        let socket = unsafe { OwnedFd::from_raw_fd(fd) };
        // SAFETY: all-zero is a valid sockaddr_ll.
        let mut link: libc::sockaddr_ll = unsafe { core::mem::zeroed() };
        link.sll_family = libc::AF_PACKET as u16;
        link.sll_protocol = protocol.to_be();
        link.sll_ifindex = interface.index as i32;
        let len = size_of_val(&link) as libc::socklen_t;
        // SAFETY: `link` is alive for the call, and `len` its true size.
        let bound = unsafe { libc::bind(socket.as_raw_fd(), (&raw const link).cast(), len) };
        if bound < 0 { Err(io::Error::last_os_error()) } else { Ok(Self(socket)) }
    }

    /// Marks what is sent from now on (SO_MARK).
    pub fn mark(&self, mark: u32) -> io::Result<()> {
        Ok(setsockopt(&self.0, sockopt::Mark, &mark)?)
    }

    /// Sends a frame without blocking; whether the kernel took it.
    pub fn send(&self, frame: &[u8]) -> bool {
        // SAFETY: pointer and length are of one slice, which is alive for the call.
        let sent =
            unsafe { libc::send(self.0.as_raw_fd(), frame.as_ptr().cast(), frame.len(), libc::MSG_DONTWAIT) };
        sent == frame.len() as isize
    }
    /// Receives a frame without blocking; its length.
    pub fn receive(&self, frame: &mut [u8]) -> Option<usize> {
        recv(self.0.as_raw_fd(), frame, MsgFlags::MSG_DONTWAIT).ok()
    }
}

impl AsFd for Bare {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
