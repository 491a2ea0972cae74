//! Packets on local sockets, with the files that come along.

use std::io::{self, ErrorKind, IoSlice, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};

use nix::cmsg_space;
use nix::errno::Errno;
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recvmsg, sendmsg};
use socket2::Socket;

/// What the kernel lets come along with a packet (`SCM_MAX_FD`): without room for all, some would be nobody's.
const MOST_FILES: usize = 253;

/// Sends one; it does not wait if the socket does not.
pub fn send(to: impl AsFd, packet: &[u8], files: &[BorrowedFd<'_>]) -> io::Result<()> {
    send_with(to, packet, files, MsgFlags::empty())
}

/// Sends one to somebody who is not waited for, whatever the socket does.
pub fn send_at_once(to: impl AsFd, packet: &[u8], files: &[BorrowedFd<'_>]) -> io::Result<()> {
    send_with(to, packet, files, MsgFlags::MSG_DONTWAIT)
}

fn send_with(to: impl AsFd, packet: &[u8], files: &[BorrowedFd<'_>], flags: MsgFlags) -> io::Result<()> {
    let raw: Vec<i32> = files.iter().map(AsRawFd::as_raw_fd).collect();
    let rights = (!raw.is_empty()).then_some(ControlMessage::ScmRights(&raw));
    let to = to.as_fd().as_raw_fd();
    sendmsg::<()>(to, &[IoSlice::new(packet)], rights.as_slice(), flags | MsgFlags::MSG_NOSIGNAL, None)?;
    Ok(())
}

/// Receives one: how long it is, 0 of who has hung up, and its files, however many.
pub fn receive(from: impl AsFd, packet: &mut [u8]) -> io::Result<(usize, Vec<OwnedFd>)> {
    let mut room = cmsg_space!([i32; MOST_FILES]);
    let mut parts = [IoSliceMut::new(packet)];
    let from = from.as_fd().as_raw_fd();
    let message = recvmsg::<()>(from, &mut parts, Some(&mut room), MsgFlags::MSG_CMSG_CLOEXEC)?;
    let mut files = Vec::new();
    for part in message.cmsgs()? {
        if let ControlMessageOwned::ScmRights(fds) = part {
            files.extend(fds.into_iter().map(own));
        }
    }
    Ok((message.bytes, files))
}

/// Receives the answer to what was asked, for which it waits as long as the socket does. If there is none, nobody asks there again.
pub fn answer(from: &Socket, packet: &mut [u8]) -> io::Result<(usize, Vec<OwnedFd>)> {
    loop {
        match receive(from, packet) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => {
                // An answer that came later would be taken for that to the next ask.
                let _ = from.shutdown(std::net::Shutdown::Both);
                let is_late = error.kind() == ErrorKind::WouldBlock;
                return Err(if is_late { Errno::ETIMEDOUT.into() } else { error });
            }
            letter => return letter,
        }
    }
}

/// A descriptor that has just been received.
#[allow(unsafe_code)]
fn own(fd: i32) -> OwnedFd {
    // SAFETY: the kernel has just made it for this process, and nobody else knows of it.
    unsafe { OwnedFd::from_raw_fd(fd) }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;
    use std::fs::File;

    use socket2::{Domain, Type};

    use super::*;

    #[test]
    fn all_files_come_along_and_an_answer_that_does_not_come_is_the_last_that_was_waited_for() {
        let (one, other) = Socket::pair(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        let file = File::open("/dev/null").unwrap();
        let mut room = [0; 8];
        for files in [0, 1, MOST_FILES] {
            send(&one, b"letter", &vec![file.as_fd(); files]).unwrap();
            let (len, came) = answer(&other, &mut room).unwrap();
            assert_eq!((&room[..len], came.len()), (&b"letter"[..], files));
        }
        let full =
            std::iter::repeat_with(|| send_at_once(&one, &[0; 64], &[])).find_map(Result::err).unwrap();
        assert_eq!(full.kind(), ErrorKind::WouldBlock);
        one.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        assert_eq!(answer(&one, &mut room).unwrap_err().raw_os_error(), Some(Errno::ETIMEDOUT as i32));
        assert_eq!(send(&one, b"again", &[]).unwrap_err().kind(), ErrorKind::BrokenPipe);
        while receive(&other, &mut room).unwrap().0 > 0 {}
    }
}
