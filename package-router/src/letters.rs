//! Packets on the broker's socket, with the files that come along.

use std::io::{IoSlice, IoSliceMut};
use std::os::fd::{AsRawFd, BorrowedFd, FromRawFd, OwnedFd};

use nix::cmsg_space;
use nix::errno::Errno;
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recvmsg, sendmsg};

/// Sends one; it does not wait if the socket does not.
pub fn send(to: BorrowedFd<'_>, packet: &[u8], files: &[BorrowedFd<'_>]) -> Result<(), Errno> {
    let raw: Vec<i32> = files.iter().map(AsRawFd::as_raw_fd).collect();
    let rights = [ControlMessage::ScmRights(&raw)];
    let rights = if raw.is_empty() { &rights[..0] } else { &rights[..] };
    sendmsg::<()>(to.as_raw_fd(), &[IoSlice::new(packet)], rights, MsgFlags::MSG_NOSIGNAL, None).map(drop)
}

/// What the kernel lets come along with a packet (`SCM_MAX_FD`): without room for all, some would be nobody's.
const MOST_FILES: usize = 253;

/// Receives one: how long it is, 0 of who has hung up, and its files, however many.
pub fn receive(from: BorrowedFd<'_>, packet: &mut [u8]) -> Result<(usize, Vec<OwnedFd>), Errno> {
    let mut room = cmsg_space!([i32; MOST_FILES]);
    let mut parts = [IoSliceMut::new(packet)];
    let message = recvmsg::<()>(from.as_raw_fd(), &mut parts, Some(&mut room), MsgFlags::MSG_CMSG_CLOEXEC)?;
    let mut files = Vec::new();
    for part in message.cmsgs()? {
        if let ControlMessageOwned::ScmRights(fds) = part {
            files.extend(fds.into_iter().map(own));
        }
    }
    Ok((message.bytes, files))
}

/// A descriptor that has just been received.
#[allow(unsafe_code)]
fn own(fd: i32) -> OwnedFd {
    // SAFETY: the kernel has just made it for this process, and nobody else knows of it.
    unsafe { OwnedFd::from_raw_fd(fd) }
}
