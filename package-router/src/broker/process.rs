//! Whose a connection is: who has hung up may still live, and write to its lanes.

#![allow(unsafe_code)]

use std::os::fd::{AsFd, BorrowedFd, FromRawFd, OwnedFd};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{getsockopt, sockopt};

/// The process at the other end, as something that becomes readable when it ends.
pub(super) fn process_of(socket: &impl AsFd) -> (u32, Option<OwnedFd>) {
    let credentials = getsockopt(socket, sockopt::PeerCredentials);
    let pid = credentials.map_or(0, |credentials| credentials.pid());
    // SAFETY: it takes numbers, and gives a descriptor of its own or -1.
    let process = Errno::result(unsafe { libc::syscall(libc::SYS_pidfd_open, pid, 0) });
    // SAFETY: it was just made, and is nobody else's.
    let process = process.map(|process| unsafe { OwnedFd::from_raw_fd(process as i32) });
    (pid.unsigned_abs(), process.ok())
}

/// Whether it has.
pub(super) fn has_ended(process: BorrowedFd<'_>) -> bool {
    poll(&mut [PollFd::new(process, PollFlags::POLLIN)], PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}
