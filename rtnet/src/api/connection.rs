//! A program's connection to a station's control socket: asks, answers, and the descriptors that come with them.

use core::time::Duration;
use std::io::{self, ErrorKind, IoSliceMut};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::path::Path;

use nix::cmsg_space;
use nix::errno::Errno;
use nix::sys::socket::{ControlMessageOwned, MsgFlags, recvmsg};
use socket2::{Domain, SockAddr, Socket, Type};

use super::handshake::{ANSWER_LEN, Answer, Ask, DESCRIPTORS};

/// How long a station may take to answer: it looks at what it is asked between two slots.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

/// A new connection, and the descriptors that the station answers this with.
pub(super) fn opened<const N: usize>(path: &Path, ask: Ask) -> io::Result<(Socket, [OwnedFd; N])> {
    let control = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
    // There is nobody there any more, or never was.
    control.connect(&SockAddr::unix(path)?).map_err(|error| match error.kind() {
        ErrorKind::NotFound | ErrorKind::ConnectionRefused => Errno::ENODEV.into(),
        _ => error,
    })?;
    control.set_read_timeout(Some(ANSWER_WITHIN))?;
    let (answer, descriptors) = exchange(&control, ask)?;
    check(&answer)?;
    match descriptors.try_into() {
        Ok(descriptors) => Ok((control, descriptors)),
        Err(_) => Err(Errno::EPROTO.into()),
    }
}

/// What an answer says, as an error if it refuses.
pub(super) fn check(answer: &Answer) -> io::Result<()> {
    match answer.errno {
        0 => Ok(()),
        errno => Err(io::Error::from_raw_os_error(errno)),
    }
}

/// Asks, and waits for the answer and what comes with it.
pub(super) fn exchange(control: &Socket, ask: Ask) -> io::Result<(Answer, Vec<OwnedFd>)> {
    control.send(&ask.to_bytes()).map_err(gone)?;
    let mut packet = [0; ANSWER_LEN + 1];
    let mut room = cmsg_space!([i32; DESCRIPTORS]);
    let mut parts = [IoSliceMut::new(&mut packet)];
    let flags = MsgFlags::MSG_CMSG_CLOEXEC;
    let message = loop {
        match recvmsg::<()>(control.as_raw_fd(), &mut parts, Some(&mut room), flags) {
            Ok(message) => break message,
            Err(Errno::EINTR) => parts = [IoSliceMut::new(&mut packet)],
            Err(errno) => {
                // An answer that came later would be taken for that to the next ask.
                let _ = control.shutdown(std::net::Shutdown::Both);
                return Err(if errno == Errno::EAGAIN {
                    Errno::ETIMEDOUT.into()
                } else {
                    gone(errno.into())
                });
            }
        }
    };
    let mut descriptors = Vec::new();
    for part in message.cmsgs()? {
        if let ControlMessageOwned::ScmRights(fds) = part {
            descriptors.extend(fds.into_iter().map(own));
        }
    }
    let bytes = message.bytes;
    let answer = Answer::parse(&packet[..bytes]).ok_or(Errno::ENODEV)?;
    Ok((answer, descriptors))
}

/// A descriptor that has just been received.
#[allow(unsafe_code)]
fn own(fd: i32) -> OwnedFd {
    // SAFETY: the kernel has just made it for this process, and nobody else knows of it.
    unsafe { OwnedFd::from_raw_fd(fd) }
}

/// A station that hangs up is no device any more.
fn gone(error: io::Error) -> io::Error {
    match error.kind() {
        ErrorKind::BrokenPipe | ErrorKind::ConnectionReset | ErrorKind::NotConnected => Errno::ENODEV.into(),
        _ => error,
    }
}
