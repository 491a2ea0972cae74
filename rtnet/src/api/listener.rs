//! Where other processes come to a station: a local socket whose file goes with it.

use std::fs;
use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use socket2::{Domain, SockAddr, Socket, Type};

/// A socket that is listened at; its file goes with it.
pub struct Listener {
    socket: Socket,
    path: PathBuf,
    /// The file's number: another of this name is somebody else's.
    inode: u64,
}

impl Listener {
    /// Listens at `path`; so many may wait to be let in. A file that is there is taken for a dead station's: names are locked elsewhere.
    pub fn bind(path: &Path, backlog: i32) -> io::Result<Self> {
        match fs::remove_file(path) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        socket.set_nonblocking(true)?;
        socket.bind(&SockAddr::unix(path)?)?;
        // Its directory lets nobody else in; this is for directories that somebody else has made.
        fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
        socket.listen(backlog)?;
        Ok(Self { socket, path: path.to_owned(), inode: fs::metadata(path)?.ino() })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Lets one in who waits, by a socket that does not block; `None`: nobody waits. An error is of this process, which has too many
    /// descriptors open, or no memory.
    pub fn accept(&self) -> io::Result<Option<Socket>> {
        let socket = match self.socket.accept() {
            Ok((socket, _)) => socket,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {
                return Ok(None);
            }
            Err(error) => return Err(error),
        };
        socket.set_nonblocking(true)?;
        Ok(Some(socket))
    }
}

/// Readable when somebody waits.
impl AsFd for Listener {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        if fs::metadata(&self.path).is_ok_and(|found| found.ino() == self.inode) {
            // Who comes too late finds nothing, or nobody: both are told alike.
            let _ = fs::remove_file(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn a_file_goes_with_its_listener_unless_it_is_anothers() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("station.sock");
        let first = Listener::bind(&path, 1).unwrap();
        assert!(first.accept().unwrap().is_none());
        let second = Listener::bind(&path, 1).unwrap();
        drop(first);
        let client = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        client.connect(&SockAddr::unix(&path).unwrap()).unwrap();
        let let_in = second.accept().unwrap().unwrap();
        assert_eq!((&let_in).read(&mut [0]).unwrap_err().kind(), ErrorKind::WouldBlock);
        drop(second);
        assert!(!path.exists());
    }
}
