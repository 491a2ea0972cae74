//! The station's end of the control socket: many clients, none of which is ever waited for.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, ErrorKind, Read};
use std::os::fd::AsFd;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use socket2::{Domain, SockAddr, Socket, Type};

/// Longest request. The longest there is takes a third of it.
pub const REQUEST_AT_MOST: usize = 1024;
/// Clients at a time; when one more comes, the one that was silent longest has to go.
const CLIENTS_AT_MOST: usize = 64;
/// Clients that wait to be accepted.
const BACKLOG: i32 = 128;
/// New clients that are let in before those that are there get their turn.
const ACCEPT_AT_ONCE: usize = 16;

/// What a server counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Requests that were answered.
    pub answered: u64,
    /// Requests longer than [`REQUEST_AT_MOST`].
    pub too_long: u64,
    /// Clients that did not take their reply.
    pub not_taken: u64,
    /// Clients that had to go for others.
    pub evicted: u64,
}

impl Traffic {
    /// By name.
    pub fn named(&self) -> BTreeMap<String, u64> {
        let all = [
            ("answered", self.answered),
            ("too_long", self.too_long),
            ("not_taken", self.not_taken),
            ("evicted", self.evicted),
        ];
        all.into_iter().map(|(name, n)| (name.to_owned(), n)).collect()
    }
}

/// A control socket; its file goes with it.
pub struct Server {
    listener: Socket,
    clients: Vec<Client>,
    path: PathBuf,
    /// The file's number: another of this name is somebody else's.
    inode: u64,
    traffic: Traffic,
}

struct Client {
    socket: Socket,
    heard: Instant,
}

impl Server {
    /// Listens at `path`. A file that is there is taken for a dead station's: names are locked elsewhere.
    pub fn bind(path: &Path) -> Result<Self> {
        let bound = Self::listen_at(path);
        bound.with_context(|| format!("the control socket {} cannot be made", path.display()))
    }

    fn listen_at(path: &Path) -> io::Result<Self> {
        match fs::remove_file(path) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let listener = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        listener.set_nonblocking(true)?;
        listener.bind(&SockAddr::unix(path)?)?;
        // Its directory lets nobody else in; this is for directories that somebody else has made.
        fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
        listener.listen(BACKLOG)?;
        let inode = fs::metadata(path)?.ino();
        Ok(Self { listener, clients: Vec::new(), path: path.to_owned(), inode, traffic: Traffic::default() })
    }

    /// What was counted so far.
    pub fn traffic(&self) -> Traffic {
        self.traffic
    }

    /// Waits for requests, at most so long, and answers those that are there: one of each client.
    pub fn serve(&mut self, at_most: Duration, mut answer: impl FnMut(&[u8], Traffic) -> Vec<u8>) {
        let ready = self.wait(at_most);
        let mut clients = std::mem::take(&mut self.clients);
        let mut turn = ready.iter();
        clients.retain_mut(|client| {
            !turn.next().copied().unwrap_or(false) || self.serve_one(client, &mut answer)
        });
        self.clients = clients;
        self.admit();
    }

    /// Which clients have something to say.
    fn wait(&self, at_most: Duration) -> Vec<bool> {
        let sockets = self.clients.iter().map(|client| &client.socket).chain([&self.listener]);
        let mut fds: Vec<PollFd> = sockets.map(|fd| PollFd::new(fd.as_fd(), PollFlags::POLLIN)).collect();
        let timeout = PollTimeout::try_from(at_most).unwrap_or(PollTimeout::MAX);
        // Interrupted, or nothing came: nobody is ready.
        let _ = poll(&mut fds, timeout);
        let ready = |fd: &PollFd| fd.revents().is_some_and(|events| !events.is_empty());
        fds[..self.clients.len()].iter().map(ready).collect()
    }

    /// Answers a request; `false`: this client is done with.
    fn serve_one(&mut self, client: &mut Client, answer: &mut impl FnMut(&[u8], Traffic) -> Vec<u8>) -> bool {
        let mut packet = [0; REQUEST_AT_MOST + 1];
        let length = match client.socket.read(&mut packet) {
            Ok(0) => return false,
            Ok(length) => length,
            Err(error) => return matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted),
        };
        client.heard = Instant::now();
        if length > REQUEST_AT_MOST {
            self.traffic.too_long += 1;
            return false;
        }
        self.traffic.answered += 1;
        let reply = answer(&packet[..length], self.traffic);
        // The socket does not block: who has not taken earlier replies does not get this one.
        let taken = client.socket.send_with_flags(&reply, nix::libc::MSG_NOSIGNAL).is_ok();
        self.traffic.not_taken += u64::from(!taken);
        taken
    }

    fn admit(&mut self) {
        for _ in 0..ACCEPT_AT_ONCE {
            let Ok((socket, _)) = self.listener.accept() else { return };
            if socket.set_nonblocking(true).is_err() {
                continue;
            }
            if self.clients.len() == CLIENTS_AT_MOST {
                let silent = (0..CLIENTS_AT_MOST).min_by_key(|&i| self.clients[i].heard).unwrap_or(0);
                self.clients.swap_remove(silent);
                self.traffic.evicted += 1;
            }
            self.clients.push(Client { socket, heard: Instant::now() });
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if fs::metadata(&self.path).is_ok_and(|found| found.ino() == self.inode) {
            // Who comes too late finds nothing, or nobody: both are told alike.
            let _ = fs::remove_file(&self.path);
        }
    }
}
