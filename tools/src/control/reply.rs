//! Replies of any length: what no packet of a local socket holds goes along as a file.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Seek, Write};
use std::os::fd::AsFd;

use nix::sys::memfd::{MFdFlags, memfd_create};
use rtnet::api::letters;

/// The longest reply that is a packet: the kernel takes 208 KiB, with what it adds, unless it was set otherwise.
const PACKET_AT_MOST: usize = 192 * 1024;
/// The packet with which a file comes.
const IN_FILE: &[u8] = b"the reply is in the file that comes along";
/// The longest file that is read: far more than a router with all connections and mailboxes that it may have has to say.
const FILE_AT_MOST: u64 = 1 << 30;

/// Sends one. It does not wait if the socket does not.
pub(super) fn send(to: impl AsFd, reply: &[u8]) -> io::Result<()> {
    if reply.len() <= PACKET_AT_MOST {
        return letters::send(to, reply, &[]);
    }
    let mut file = File::from(memfd_create(c"rtnet-reply", MFdFlags::MFD_CLOEXEC)?);
    file.write_all(reply)?;
    file.rewind()?;
    letters::send(to, IN_FILE, &[file.as_fd()])
}

/// Receives one; an empty one of an end that has hung up.
pub(super) fn receive(from: impl AsFd) -> io::Result<Vec<u8>> {
    receive_up_to(from, FILE_AT_MOST)
}

fn receive_up_to(from: impl AsFd, most: u64) -> io::Result<Vec<u8>> {
    let mut reply = vec![0; PACKET_AT_MOST];
    let (length, files) = letters::receive(from, &mut reply)?;
    reply.truncate(length);
    if reply != IN_FILE {
        return Ok(reply);
    }
    let file = files.into_iter().next().map(File::from);
    let Some(file) = file.filter(|file| file.metadata().is_ok_and(|of| of.is_file() && of.len() <= most))
    else {
        return Err(io::Error::new(
            ErrorKind::InvalidData,
            format!("the reply has no file, or more than {most} bytes"),
        ));
    };
    reply.clear();
    file.take(most).read_to_end(&mut reply)?;
    Ok(reply)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use socket2::{Domain, Socket, Type};

    use super::*;

    #[test]
    fn a_reply_of_any_length_comes_whole() {
        let (one, other) = Socket::pair(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        for length in [1, PACKET_AT_MOST - 1, PACKET_AT_MOST, PACKET_AT_MOST + 1, 100 * PACKET_AT_MOST] {
            let reply: Vec<u8> = (0..length).map(|at| at as u8).collect();
            send(&one, &reply).unwrap();
            assert!(receive(&other).unwrap() == reply, "{length} bytes");
        }
        send(&one, &vec![0; PACKET_AT_MOST + 1]).unwrap();
        let most = PACKET_AT_MOST as u64;
        assert_eq!(receive_up_to(&other, most).unwrap_err().kind(), ErrorKind::InvalidData);
        let (pipe, _end) = nix::unistd::pipe().unwrap();
        for files in [&[][..], &[pipe.as_fd()]] {
            letters::send(&one, IN_FILE, files).unwrap();
            assert_eq!(receive(&other).unwrap_err().kind(), ErrorKind::InvalidData);
        }
        other.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        assert_eq!(receive(&other).unwrap_err().kind(), ErrorKind::WouldBlock);
        drop(one);
        assert!(receive(&other).unwrap().is_empty(), "it has hung up");
    }
}
