//! The station's end of the control socket: many clients, none of which is ever waited for, and programs with sockets,
//! none of which has to go for others.

use std::collections::BTreeMap;
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::eventfd::EventFd;
use nix::sys::resource::{Resource, getrlimit};
use socket2::Socket;

use rtnet::api::door;
use rtnet::api::handshake::{self, Answer};
use rtnet::api::listener::Listener;

use super::programs::{Answers, Program, Requests};
use super::protocol::{Envelope, Reply};
use super::reply;
use crate::remedy::{SOCKET_PATH_AT_MOST, explained};

/// Longest request: a schedule with as many slots as one can have.
pub const REQUEST_AT_MOST: usize = 160 * 1024;
/// Clients at a time; when one more comes, the one that was silent longest has to go.
const CLIENTS_AT_MOST: usize = 64;
/// Clients that wait to be accepted.
const BACKLOG: i32 = 128;
/// How long the clients of one call may take together before others get their turn: those that wait, and whatever else
/// its thread has to do.
const TURN: Duration = Duration::from_millis(20);
/// New clients that are let in before those that are there get their turn.
const ACCEPT_AT_ONCE: usize = 16;

/// Programs with sockets at a time: as many as a station has sockets, if it has the most.
const PROGRAMS_AT_MOST: usize = 1024;
/// Descriptors that a program's socket takes: its connection, its memory, what wakes it, the gate that it sees that through, and
/// its doorbell.
const FILES_OF_PROGRAM: u64 = 5;
/// Descriptors that programs leave for everything else: clients, what is the station's, what goes along with an answer.
const FILES_BESIDE: u64 = CLIENTS_AT_MOST as u64 + 64;

/// What a server counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Requests that were answered.
    pub answered: u64,
    /// Requests longer than [`REQUEST_AT_MOST`].
    pub too_long: u64,
    /// Requests that were taken back before they were looked at, by who hung up or sends no more.
    pub taken_back: u64,
    /// Clients that did not take their reply.
    pub not_taken: u64,
    /// Clients that had to go for others.
    pub evicted: u64,
    /// How often nobody could be let in though somebody waited: for want of descriptors, or of memory.
    pub not_let_in: u64,
}

impl Traffic {
    /// By name.
    pub fn named(&self) -> BTreeMap<String, u64> {
        let all = [
            ("answered", self.answered),
            ("too_long", self.too_long),
            ("taken_back", self.taken_back),
            ("not_taken", self.not_taken),
            ("evicted", self.evicted),
            ("not_let_in", self.not_let_in),
        ];
        all.into_iter().map(|(name, n)| (name.to_owned(), n)).collect()
    }
}

/// Whether a socket can have this path.
pub fn check_length(path: &Path) -> Result<()> {
    let length = path.as_os_str().len();
    ensure!(
        length <= SOCKET_PATH_AT_MOST,
        "{}: the path of a socket has {SOCKET_PATH_AT_MOST} bytes at the most, and this has {length}: set XDG_RUNTIME_DIR to a \
         shorter one, or shorten the names",
        path.display()
    );
    Ok(())
}

/// A control socket; its file goes with it.
pub struct Server {
    listener: Listener,
    clients: Vec<Client>,
    programs: Vec<Program>,
    traffic: Traffic,
    /// Ends a wait before its time.
    waker: Option<Arc<EventFd>>,
    /// Whether somebody waits who could not be accepted: to be told of that again and again would keep it from waiting.
    is_full: bool,
}

struct Client {
    socket: Socket,
    heard: Instant,
}

/// What becomes of a client after its turn.
enum Outcome {
    Stays(Client),
    Goes,
    /// It is a program.
    Attaches(Program),
}

impl Server {
    /// Listens at `path`. A file that is there is taken for a dead station's: names are locked elsewhere.
    pub fn bind(path: &Path) -> Result<Self> {
        check_length(path)?;
        let listener = Listener::bind(path, BACKLOG).map_err(explained);
        Ok(Self {
            listener: listener
                .with_context(|| format!("the control socket {} cannot be made", path.display()))?,
            clients: Vec::new(),
            programs: Vec::new(),
            traffic: Traffic::default(),
            waker: None,
            is_full: false,
        })
    }

    /// From now on a wait is over, too, when this becomes readable.
    pub fn wake_by(&mut self, waker: Arc<EventFd>) {
        self.waker = Some(waker);
    }

    /// Where it listens.
    pub fn path(&self) -> &Path {
        self.listener.path()
    }

    /// What was counted so far.
    pub fn traffic(&self) -> Traffic {
        self.traffic
    }

    /// Waits for requests, at most so long, and answers those that are there: one of each client, as far as they do not
    /// take long. Who had no turn is first in the next call.
    pub fn serve(&mut self, at_most: Duration, answer: impl FnMut(&[u8], Traffic) -> Vec<u8>) {
        self.serve_all(at_most, &mut Requests(answer));
    }

    /// The same for who has sockets for programs, too.
    pub fn serve_all(&mut self, at_most: Duration, answers: &mut impl Answers) {
        let (ready, programs_ready) = self.wait(at_most);
        self.serve_programs(&programs_ready, answers);
        // Programs do not take the clients' turn.
        let begun = Instant::now();
        let mut waiting = std::mem::take(&mut self.clients).into_iter().zip(ready);
        let mut had_turn = Vec::new();
        for (client, ready) in waiting.by_ref() {
            match if ready { self.serve_one(client, answers) } else { Outcome::Stays(client) } {
                Outcome::Stays(client) => had_turn.push(client),
                Outcome::Attaches(program) => self.programs.push(program),
                Outcome::Goes => {}
            }
            if begun.elapsed() >= TURN {
                break;
            }
        }
        self.clients = waiting.map(|(client, _)| client).chain(had_turn).collect();
        self.admit();
    }

    /// One ask of each program, as far as they do not take long: who had no turn is first in the next call.
    fn serve_programs(&mut self, ready: &[bool], answers: &mut impl Answers) {
        let begun = Instant::now();
        let mut had_turn = 0;
        let mut ready = ready.iter();
        self.programs.retain_mut(|program| {
            if begun.elapsed() >= TURN {
                return true;
            }
            let stays = program.turn(ready.next().is_some_and(|ready| *ready), answers);
            had_turn += usize::from(stays);
            stays
        });
        self.programs.rotate_left(had_turn);
    }

    /// Which clients, and which programs, have something to say.
    fn wait(&self, at_most: Duration) -> (Vec<bool>, Vec<bool>) {
        let clients = self.clients.iter().map(|client| &client.socket);
        let programs = self.programs.iter().map(|program| &program.socket);
        let listener = (!self.is_full).then_some(self.listener.as_fd());
        let sockets = clients.chain(programs).map(|socket| socket.as_fd()).chain(listener);
        let fds = sockets.chain(self.waker.iter().map(|waker| waker.as_fd()));
        let mut fds: Vec<PollFd> = fds.map(|fd| PollFd::new(fd, PollFlags::POLLIN)).collect();
        let timeout = PollTimeout::try_from(at_most).unwrap_or(PollTimeout::MAX);
        // Interrupted, or nothing came: nobody is ready.
        let _ = poll(&mut fds, timeout);
        if let Some(waker) = &self.waker {
            // Whether it was or not: it is not readable any more.
            let _ = waker.read();
        }
        let ready = |fd: &PollFd| fd.revents().is_some_and(|events| !events.is_empty());
        let (clients, rest) = fds.split_at(self.clients.len());
        let programs = &rest[..self.programs.len()];
        (clients.iter().map(ready).collect(), programs.iter().map(ready).collect())
    }

    /// Answers a request.
    fn serve_one(&mut self, mut client: Client, answers: &mut impl Answers) -> Outcome {
        let mut packet = vec![0; REQUEST_AT_MOST + 1];
        let length = match client.socket.read(&mut packet) {
            Ok(0) => return Outcome::Goes,
            Ok(length) => length,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {
                return Outcome::Stays(client);
            }
            Err(_) => return Outcome::Goes,
        };
        client.heard = Instant::now();
        if length > REQUEST_AT_MOST {
            self.traffic.too_long += 1;
            let why = format!("a request is {REQUEST_AT_MOST} bytes at most: send less at a time");
            let _ = reply::send(&client.socket, &refusal(why));
            return Outcome::Goes;
        }
        if client.has_taken_back() {
            self.traffic.taken_back += 1;
            // Who has hung up does not hear it.
            let refusal = refusal("nothing is done: it was taken back before it was looked at".into());
            let _ = reply::send(&client.socket, &refusal);
            return Outcome::Goes;
        }
        self.traffic.answered += 1;
        if handshake::is_ask(&packet[..length]) {
            return self.let_in(client, &packet[..length], answers);
        }
        let reply = answers.answer(&packet[..length], self.traffic);
        // The socket does not block: who has not taken earlier replies does not get this one.
        let taken = match reply::send(&client.socket, &reply) {
            Err(error) if error.kind() != ErrorKind::WouldBlock => {
                let why = format!("its reply of {} bytes cannot be sent: {}", reply.len(), explained(error));
                reply::send(&client.socket, &refusal(why)).is_ok()
            }
            sent => sent.is_ok(),
        };
        self.traffic.not_taken += u64::from(!taken);
        if taken { Outcome::Stays(client) } else { Outcome::Goes }
    }

    /// A client that opens a socket is a program from then on.
    fn let_in(&mut self, client: Client, packet: &[u8], answers: &mut impl Answers) -> Outcome {
        // Nothing is begun that would end half done for want of a descriptor.
        let files = getrlimit(Resource::RLIMIT_NOFILE).map_or(u64::MAX, |(files, _)| files);
        let refused = match self.programs.len() {
            PROGRAMS_AT_MOST.. => Some(nix::libc::EAGAIN),
            programs if programs >= programs_with(files) => Some(nix::libc::EMFILE),
            _ => None,
        };
        if let Some(errno) = refused {
            let _ = door::reply(&client.socket, &Answer::refused(errno), None);
            return Outcome::Goes;
        }
        Program::let_in(client.socket, packet, answers).map_or(Outcome::Goes, Outcome::Attaches)
    }

    fn admit(&mut self) {
        self.is_full = false;
        for _ in 0..ACCEPT_AT_ONCE {
            let socket = match self.listener.accept() {
                Ok(Some(socket)) => socket,
                Ok(None) => return,
                Err(error) => return self.note_full(&error),
            };
            if self.clients.len() == CLIENTS_AT_MOST {
                let silent = (0..CLIENTS_AT_MOST).min_by_key(|&i| self.clients[i].heard).unwrap_or(0);
                self.clients.remove(silent);
                self.traffic.evicted += 1;
            }
            self.clients.push(Client { socket, heard: Instant::now() });
        }
    }

    /// Nobody can be let in now, for whatever reason: it is tried again after the next wait, and said the first time.
    fn note_full(&mut self, error: &io::Error) {
        self.is_full = true;
        self.traffic.not_let_in += 1;
        if self.traffic.not_let_in == 1 {
            let remedy = match error.raw_os_error() {
                Some(nix::libc::EMFILE | nix::libc::ENFILE) => "let more files be open, `ulimit -n`",
                _ => "it is tried again, and counted as `not_let_in`",
            };
            let path = self.listener.path().display();
            // Whoever has closed our standard error finds it counted.
            let _ = writeln!(io::stderr(), "rtnet: {path} lets nobody in who comes now: {error} ({remedy})");
        }
    }
}

impl Client {
    /// Whoever hangs up, or sends no more, does not want what it has asked for any more: it was told that it failed.
    fn has_taken_back(&self) -> bool {
        // Being hung up on is always told of.
        let sends_no_more = PollFlags::from_bits_retain(nix::libc::POLLRDHUP);
        let mut fds = [PollFd::new(self.socket.as_fd(), sends_no_more)];
        poll(&mut fds, PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
    }
}

/// Programs that may have sockets where so many descriptors may be open.
fn programs_with(files: u64) -> usize {
    ((files - FILES_BESIDE.min(files / 2)) / FILES_OF_PROGRAM) as usize
}

/// What stations and labs say alike.
fn refusal(why: String) -> Vec<u8> {
    Envelope::pack(Reply::Refused(why))
}

#[cfg(test)]
mod tests;
