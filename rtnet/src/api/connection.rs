//! A program's connection to a station's control socket: asks, answers, and the descriptors that come with them.

use core::time::Duration;
use std::io::{self, ErrorKind};
use std::os::fd::OwnedFd;
use std::path::Path;

use nix::errno::Errno;
use socket2::{Domain, SockAddr, Socket, Type};

use super::handshake::{ANSWER_LEN, Answer, Ask};
use super::letters;

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
    let (length, descriptors) = letters::answer(control, &mut packet).map_err(gone)?;
    let answer = Answer::parse(&packet[..length]).ok_or(Errno::ENODEV)?;
    Ok((answer, descriptors))
}

/// A station that hangs up is no device any more.
fn gone(error: io::Error) -> io::Error {
    match error.kind() {
        ErrorKind::BrokenPipe | ErrorKind::ConnectionReset | ErrorKind::NotConnected => Errno::ENODEV.into(),
        _ => error,
    }
}
