//! Where programs come in: what they ask is made ready here, done in the station's thread, and answered here again, so
//! that thread takes no memory and frees none.
//!
//! ```text
//! control thread   prepare(ask) ─► Visit ┐                ┌► finish ─► answer, memory, gate and doorbell for the program
//! station's thread                       └─ visit(stack) ─┘
//! ```

use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;

use nix::errno::Errno;

use super::handshake::{Answer, Ask};
use super::letters;
use super::line::{Line, Lines};
use crate::buf::Pool;
use crate::ip::{Exit, Stack};
use crate::live::{Bells, TimeBoard, Visitor};
use crate::socket::{DEFAULT_BUFFERS, MOST_BUFFERS, ROOM_TO_EXTEND, Socket, SocketError, SocketId};

pub use super::line::Descriptors;

/// Pools of closed sockets; while there are so many whose frames still wait to be sent, no socket is opened.
const MOST_RETIRED: usize = 256;

/// The control thread's side of all programs' sockets.
pub struct Door {
    /// Pools of sockets that were closed: once all of their buffers are home another socket has them.
    retired: Vec<Arc<Pool>>,
    bells: Bells,
}

/// A socket that a program has.
pub struct Attached {
    socket: SocketId,
    pool: Arc<Pool>,
}

/// What is to be done, or was done, in the station's thread.
pub struct Visit {
    what: What,
    answer: Answer,
}

enum What {
    Open(Box<Opening>),
    Ask(Ask, SocketId),
    Close(Closing),
}

/// With what was closed: it is freed where this is.
struct Closing {
    id: SocketId,
    line: Option<Box<Line>>,
    socket: Option<Box<Socket>>,
}

struct Opening {
    /// Both are taken in, or both come back.
    socket: Option<Box<Socket>>,
    line: Option<Box<Line>>,
    pool: Arc<Pool>,
    descriptors: Descriptors,
    opened: Option<SocketId>,
}

impl Door {
    /// Nobody has come in yet. Each program gets a bell that the station hears there when it sleeps.
    pub fn new(bells: Bells) -> Self {
        Self { retired: Vec::new(), bells }
    }

    /// Makes an ask of a program ready: one that has no socket opens one, one that has asks about it. What needs nothing of
    /// the station's thread is answered at once.
    pub fn prepare(&mut self, ask: Ask, of: Option<&Attached>) -> Result<Visit, Answer> {
        let refused = |errno| Answer::refused(errno as i32);
        let what = match (ask, of) {
            (Ask::Time, _) => return Err(refused(Errno::EOPNOTSUPP)),
            (Ask::OpenUdp(buffers), None) => self.open(buffers, Socket::udp)?,
            (Ask::OpenPacket(mode, link_type, buffers), None) => {
                self.open(buffers, |pool| Socket::packet(mode, link_type, pool))?
            }
            (Ask::OpenUdp(_) | Ask::OpenPacket(..), Some(_)) => return Err(refused(Errno::EISCONN)),
            (_, None) => return Err(refused(Errno::EBADF)),
            (Ask::Extend(n), Some(of)) => return Err(resized(of.pool.extend(n as usize), Errno::ENOMEM)),
            (Ask::Shrink(n), Some(of)) => return Err(resized(of.pool.shrink(n as usize), Errno::EBUSY)),
            (ask, Some(of)) => What::Ask(ask, of.socket),
        };
        Ok(Visit { what, answer: Answer::DONE })
    }

    /// A program has gone: its socket is to be closed.
    pub fn leave(&mut self, of: Attached) -> Visit {
        self.retired.push(of.pool);
        let closing = Closing { id: of.socket, line: None, socket: None };
        Visit { what: What::Close(closing), answer: Answer::DONE }
    }

    /// What the station's thread has made of it: the answer, and what an opened socket's program is to have.
    pub fn finish(&mut self, visit: Visit) -> (Answer, Option<(Attached, Descriptors)>) {
        let Visit { what: What::Open(opening), answer } = visit else { return (visit.answer, None) };
        let Opening { pool, descriptors, opened, .. } = *opening;
        match opened {
            Some(socket) => (answer, Some((Attached { socket, pool }, descriptors))),
            None => {
                self.retired.push(pool);
                (answer, None)
            }
        }
    }

    fn open(&mut self, buffers: u32, socket: impl FnOnce(Arc<Pool>) -> Box<Socket>) -> Result<What, Answer> {
        let refused = |errno| Answer::refused(errno as i32);
        let buffers = if buffers == 0 { DEFAULT_BUFFERS } else { buffers as usize };
        if buffers > MOST_BUFFERS {
            return Err(refused(Errno::ENOMEM));
        }
        let lacks = |error: io::Error| Answer::refused(error.raw_os_error().unwrap_or(Errno::ENOMEM as i32));
        let line = Line::new(self.bells.clone()).map_err(lacks)?;
        let descriptors = line.descriptors().map_err(lacks)?;
        let pool = self.pool(buffers).ok_or(refused(Errno::ENOBUFS))?;
        let (socket, line) = (Some(socket(pool.clone())), Some(line));
        Ok(What::Open(Box::new(Opening { socket, line, pool, descriptors, opened: None })))
    }

    /// One whose buffers are all home, with so many of them: frames of a closed socket may still wait to be sent.
    fn pool(&mut self, buffers: usize) -> Option<Arc<Pool>> {
        let is_home = |pool: &Arc<Pool>| pool.available() == pool.capacity() && Arc::strong_count(pool) == 1;
        let Some(place) = self.retired.iter().position(|pool| is_home(pool) && pool.room() >= buffers) else {
            if self.retired.len() >= MOST_RETIRED {
                self.retired.retain(|pool| !is_home(pool));
            }
            let room = buffers.max(ROOM_TO_EXTEND).next_power_of_two();
            return (self.retired.len() < MOST_RETIRED).then(|| Arc::new(Pool::with_room(buffers, room)));
        };
        let pool = self.retired.swap_remove(place);
        match pool.capacity() {
            many if many > buffers => pool.shrink(many - buffers),
            few => pool.extend(buffers - few),
        };
        pool.start_anew();
        Some(pool)
    }
}

/// Sends an answer, with what goes with it, to a program that is not waited for.
pub fn reply(program: impl AsFd, answer: &Answer, descriptors: Option<&Descriptors>) -> io::Result<()> {
    let files = descriptors.map(|descriptors| descriptors.each_ref().map(AsFd::as_fd));
    letters::send_at_once(program, &answer.to_bytes(), files.as_ref().map_or(&[], |files| files))
}

/// Lets a program have the station's time, which it cannot write, as the answer to [`Ask::Time`].
pub fn reply_with_time(program: impl AsFd, time: &TimeBoard) -> io::Result<()> {
    match time.page() {
        Some(page) => letters::send_at_once(program, &Answer::DONE.to_bytes(), &[page.as_fd()]),
        None => reply(program, &Answer::refused(Errno::ENOSYS as i32), None),
    }
}

fn resized(n: usize, if_none: Errno) -> Answer {
    if n == 0 { Answer::refused(if_none as i32) } else { Answer { number: n as u32, ..Answer::DONE } }
}

impl Visitor for Visit {
    /// In the station's thread: nothing is taken or freed here.
    fn visit(&mut self, stack: &mut Stack, _exit: &mut dyn Exit) {
        let done = match &mut self.what {
            What::Open(opening) => opening.visit(stack),
            What::Ask(ask, id) => carry_out(stack, *ask, *id, &mut self.answer),
            What::Close(closing) => {
                closing.line = stack.program_mut::<Lines>().and_then(|lines| lines.remove(closing.id));
                stack.close(closing.id).map(|socket| closing.socket = Some(socket))
            }
        };
        if let Err(error) = done {
            self.answer = Answer::refused(error.errno());
        }
    }
}

impl Opening {
    fn visit(&mut self, stack: &mut Stack) -> Result<(), SocketError> {
        let (Some(socket), Some(line)) = (self.socket.take(), self.line.take()) else { return Ok(()) };
        let id = match stack.open(socket) {
            Ok(id) => id,
            Err((error, socket)) => {
                (self.socket, self.line) = (Some(socket), Some(line));
                return Err(error);
            }
        };
        let Some(lines) = stack.program_mut::<Lines>() else {
            (self.socket, self.line) = (stack.close(id).ok(), Some(line));
            return Err(SocketError::OtherKind("this station has no sockets for other processes"));
        };
        match lines.add(id, line) {
            Ok(()) => self.opened = Some(id),
            Err((most, line)) => {
                (self.socket, self.line) = (stack.close(id).ok(), Some(line));
                return Err(SocketError::TooMany(most));
            }
        }
        Ok(())
    }
}

fn carry_out(stack: &mut Stack, ask: Ask, id: SocketId, answer: &mut Answer) -> Result<(), SocketError> {
    match ask {
        Ask::Bind(to) => stack.bind(id, to),
        Ask::BindLink(link_type) => stack.bind_link(id, link_type),
        Ask::Connect(peer) => stack.connect(id, peer),
        Ask::LocalAddress => stack.local_address(id).map(|address| answer.address = address),
        Ask::PeerAddress => stack.peer_address(id).map(|address| answer.address = address),
        // Answered where they were asked.
        Ask::OpenUdp(_) | Ask::OpenPacket(..) | Ask::Extend(_) | Ask::Shrink(_) | Ask::Time => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buf::PoolStatistics;

    #[test]
    fn who_takes_over_a_pool_is_not_told_of_what_was_before() {
        let mut door = Door::new(Bells::new().unwrap());
        let pool = door.pool(2).unwrap();
        drop([(); 3].map(|()| pool.take()));
        assert_eq!(pool.statistics(), PoolStatistics { capacity: 2, free: 2, least: 0, exhausted: 1 });
        door.retired.push(pool);
        let again = door.pool(2).unwrap();
        assert_eq!(again.statistics(), PoolStatistics { capacity: 2, free: 2, least: 2, exhausted: 0 });
        assert!(door.retired.is_empty(), "it is the same one");
    }
}
