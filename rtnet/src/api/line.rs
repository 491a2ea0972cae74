//! A station's end of the sockets that other processes have: it copies between their memory and the stack's buffers.
//!
//! ```text
//!   program ─ ring ─► Line ─► Access::send ─► the discipline's queue
//!           ─ doorbell ─► the loop, if it sleeps
//!   program ◄─ ring ─ Line ◄─ the socket's buffers
//!           ◄─ gate ─ waker, after the slot's send, if it sleeps
//! ```
//!
//! Nothing here is believed that a program wrote: an order that cannot be ends its line, and nobody else's. Nor is anything
//! waited for: a descriptor that both have is one whose flags both may change, so that the station never reads nor writes one
//! that a program has. It writes the waker, which the program only sees through the gate, an epoll; and hears the doorbell
//! where it waits for frames.

use core::sync::atomic::Ordering;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use nix::sys::eventfd::{EfdFlags, EventFd};

use super::handshake::DESCRIPTORS;
use super::memory::Memory;
use super::ring::{Nonsense, Reader, Writer};
use super::segment::{self, ASLEEP, ENDED, ERROR, Order, STATE, STATION_ASLEEP};
use crate::live::{Bells, TimeBoard};
use crate::socket::{Access, Flags, Lack, Program, SocketError, SocketId};
use crate::time::GlobalTime;
use crate::wire::udp::MAX_PAYLOAD;

/// Datagrams that are taken from one program in one turn: a flood does not hold up the others'.
const ORDERS_AT_ONCE: usize = 8;
/// Bytes that are copied for all programs in one turn, or one datagram more: a turn may come just before a slot.
const WORK_AT_ONCE: usize = 16 * 1024;
/// What a datagram costs besides its bytes takes as long as copying so many; one that waits for buffers costs that, and as
/// much as copying a byte for each place of its pool that was looked at in vain.
const EACH: usize = 256;
/// The longest order: a datagram, or a frame.
const LONGEST: usize = MAX_PAYLOAD + 1;

/// One program's socket.
pub struct Line {
    socket: SocketId,
    memory: Arc<Memory>,
    to_program: Writer,
    from_program: Reader,
    waker: EventFd,
    gate: Epoll,
    doorbell: EventFd,
    /// Where it is heard.
    bells: Bells,
    /// The oldest order waits for buffers.
    waits: bool,
    /// There is something to be told since the program was woken.
    has_news: bool,
    errors: u32,
    is_broken: bool,
}

/// All lines of a station.
pub struct Lines {
    // Each in the box that it came in: out of it that would be freed in the station's thread.
    #[allow(clippy::vec_box)]
    lines: Vec<Box<Line>>,
    /// Where an order is copied before anything of it is looked at: whoever wrote it may still write.
    room: Box<[u8]>,
    /// Which is served first.
    first: usize,
    /// What may still be done before the station rests, however often programs are looked at until then.
    work: Work,
    /// They were served since the station slept.
    came_by: bool,
    /// So many have not been looked at since then.
    unseen: usize,
    /// By which what is sent with times is told when that was; `None`: it is sent as all else.
    time: Option<Arc<TimeBoard>>,
    counters: LineCounters,
}

/// What a program gets with the answer to an opening: memory, what to wait for, and what to ring.
pub type Descriptors = [OwnedFd; DESCRIPTORS];

/// What may still be done in a turn.
struct Work(usize);

impl Work {
    fn of_a_turn() -> Self {
        Self(WORK_AT_ONCE)
    }
    fn is_left(&self) -> bool {
        self.0 > 0
    }
    fn spend(&mut self, bytes: usize) {
        self.0 = self.0.saturating_sub(EACH + bytes);
    }
}

/// What became of lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct LineCounters {
    /// Programs that were woken: each cost a system call.
    pub wakes: u64,
    /// Lines that were ended because of what the program wrote.
    pub nonsense: u64,
}

impl Line {
    /// Memory, a gate and a doorbell for a socket that is about to be opened.
    pub fn new(bells: Bells) -> io::Result<Box<Self>> {
        let eventfd = || EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC);
        let (waker, doorbell) = (eventfd()?, eventfd()?);
        let gate = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        gate.add(&waker, EpollEvent::new(EpollFlags::EPOLLIN | EpollFlags::EPOLLET, 0))?;
        bells.hang(&doorbell)?;
        let memory = Arc::new(Memory::new(segment::bytes())?);
        // A program may wait before it has ever looked.
        memory[ASLEEP].store(1, Ordering::Relaxed);
        Ok(Box::new(Self {
            socket: SocketId::NOBODY,
            to_program: Writer::new(memory.clone(), segment::received()),
            from_program: Reader::new(memory.clone(), segment::sent()),
            memory,
            waker,
            gate,
            doorbell,
            bells,
            waits: false,
            has_news: false,
            errors: 0,
            is_broken: false,
        }))
    }

    /// For which socket.
    pub fn socket(&self) -> SocketId {
        self.socket
    }
    /// What the program is to have.
    pub fn descriptors(&self) -> io::Result<Descriptors> {
        let copy = |fd: BorrowedFd<'_>| fd.try_clone_to_owned();
        Ok([copy(self.memory.as_fd())?, copy(self.gate.0.as_fd())?, copy(self.doorbell.as_fd())?])
    }
    /// Whether the program has written what cannot be: it is not served any more.
    pub fn is_broken(&self) -> bool {
        self.is_broken
    }

    fn serve(
        &mut self,
        sockets: &mut Access<'_>,
        room: &mut [u8],
        work: &mut Work,
        time: Option<&TimeBoard>,
    ) -> Result<(), Nonsense> {
        // What the program is given frees buffers for what it sends.
        self.pass_on(sockets, work)?;
        self.take_orders(sockets, room, work, time)
    }

    fn pass_on(&mut self, sockets: &mut Access<'_>, work: &mut Work) -> Result<(), Nonsense> {
        let Self { socket, to_program, has_news, .. } = self;
        let mut written = Ok(true);
        while work.is_left() && written == Ok(true) {
            let passed = sockets.pass_on(*socket, |received, parts| {
                written = to_program.write(segment::pack_received(received), received.whole, parts);
                let is_written = written == Ok(true);
                if is_written {
                    work.spend(received.whole);
                    *has_news = true;
                }
                is_written
            });
            if passed.is_err() {
                break;
            }
        }
        written.map(drop)
    }

    /// What waits for a buffer stays where it is, and nothing of it is copied.
    fn take_orders(
        &mut self,
        sockets: &mut Access<'_>,
        room: &mut [u8],
        work: &mut Work,
        time: Option<&TimeBoard>,
    ) -> Result<(), Nonsense> {
        self.waits = false;
        for _ in 0..ORDERS_AT_ONCE {
            if self.from_program.is_empty() || !work.is_left() {
                return Ok(());
            }
            let Some(record) = self.from_program.front()? else { return Ok(()) };
            let order =
                segment::unpack_order(record.meta).filter(|_| record.len <= LONGEST).ok_or(Nonsense)?;
            let mut sent = sockets.set_options(self.socket, order.options);
            if sent.is_ok() {
                let lack = lacks_buffers(self.socket, sockets, &order, record.len);
                lack.iter().for_each(|lack| work.spend(lack.looked));
                if lack.is_some_and(|lack| lack.is_passing) {
                    self.waits = true;
                    return Ok(());
                }
                let copied = self.from_program.copy(&record, room);
                let at = order.at.zip(time).and_then(|(at, time)| time.global_at([at])).map(|[at]| at);
                sent = carry_out(self.socket, sockets, &order, at, &room[..copied]);
            }
            sent.unwrap_or_else(|error| self.note(&error));
            work.spend(record.len);
            self.from_program.take(record);
        }
        Ok(())
    }

    /// The program hears of it at its next call, as of a socket's `SO_ERROR`; one that waits is woken for it.
    fn note(&mut self, error: &SocketError) {
        self.has_news = true;
        self.errors = self.errors.wrapping_add(1);
        let word = u64::from(self.errors) << 32 | error.errno() as u64;
        self.memory[ERROR].store(word, Ordering::Release);
    }

    fn end(&mut self) {
        self.memory[STATE].store(ENDED, Ordering::Release);
        let _ = self.waker.write(1);
    }
}

impl Drop for Line {
    /// A program that still has its doorbell wakes nobody by it.
    fn drop(&mut self) {
        self.bells.take_down(&self.doorbell);
    }
}

fn lacks_buffers(socket: SocketId, sockets: &Access<'_>, order: &Order, len: usize) -> Option<Lack> {
    let to = order.to.filter(|_| sockets.is_udp(socket).unwrap_or(false)).map(segment::unpack_udp);
    sockets.lacks_buffers(socket, len, to, Flags::from_bits(order.flags))
}

fn carry_out(
    socket: SocketId,
    sockets: &mut Access<'_>,
    order: &Order,
    at: Option<GlobalTime>,
    data: &[u8],
) -> Result<(), SocketError> {
    let flags = Flags::from_bits(order.flags);
    if sockets.is_udp(socket)? {
        sockets.send_sent_at(socket, data, order.to.map(segment::unpack_udp), flags, at)
    } else {
        sockets.send_frame_with(socket, data, order.to.map(segment::unpack_link), flags)
    }
}

impl Lines {
    /// Room for so many.
    pub fn new(most: usize) -> Self {
        Self {
            lines: Vec::with_capacity(most),
            room: vec![0; LONGEST].into_boxed_slice(),
            first: 0,
            work: Work::of_a_turn(),
            came_by: false,
            unseen: 0,
            time: None,
            counters: LineCounters::default(),
        }
    }

    /// From now on what programs send with times says when it was sent, by this board of their station's.
    pub fn tell_times(&mut self, time: Arc<TimeBoard>) {
        self.time = Some(time);
    }

    /// Serves another one, for this socket; it comes back with how many there may be if there is no room.
    pub fn add(&mut self, socket: SocketId, mut line: Box<Line>) -> Result<(), (usize, Box<Line>)> {
        let most = self.lines.capacity();
        if self.lines.len() == most {
            return Err((most, line));
        }
        line.socket = socket;
        self.lines.push(line);
        Ok(())
    }

    /// The line of a socket is not served any more: it is to be freed where memory may be.
    pub fn remove(&mut self, socket: SocketId) -> Option<Box<Line>> {
        let place = self.lines.iter().position(|line| line.socket == socket)?;
        let mut line = self.lines.swap_remove(place);
        line.end();
        Some(line)
    }

    /// Lines whose programs have written what cannot be.
    pub fn broken(&self) -> impl Iterator<Item = SocketId> + '_ {
        self.lines.iter().filter(|line| line.is_broken).map(|line| line.socket)
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.lines.len()
    }
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }
    /// What became of them.
    pub fn counters(&self) -> LineCounters {
        self.counters
    }
}

/// The station has ended.
impl Drop for Lines {
    fn drop(&mut self) {
        self.lines.iter_mut().for_each(|line| line.end());
    }
}

impl Program for Lines {
    fn run(&mut self, sockets: &mut Access<'_>) {
        let Self { lines, room, first, work, came_by, unseen, time, counters } = self;
        *came_by = true;
        let count = lines.len();
        for place in (*first..*first + count).map(|place| place % count) {
            if !work.is_left() {
                // Who has had no part of this turn is the first in the next.
                *first = place;
                return;
            }
            *unseen = unseen.saturating_sub(1);
            let line = &mut lines[place];
            if !line.is_broken && line.serve(sockets, room, work, time.as_deref()).is_err() {
                counters.nonsense += 1;
                // To be told of when it rests: it takes a system call.
                (line.is_broken, line.has_news) = (true, true);
            }
        }
    }

    /// Programs ring only while the station sleeps; what came before they could know is looked for. Who has not come by since
    /// the last time would not serve it the next time either. What waits for buffers is not waited for, unless a turn has
    /// ended before it was looked at: they may be home.
    fn sleeps(&mut self, is_asleep: bool) -> bool {
        for line in &self.lines {
            line.memory[STATION_ASLEEP].store(is_asleep.into(), Ordering::SeqCst);
        }
        core::sync::atomic::fence(Ordering::SeqCst);
        let (came_by, is_unsure) = (is_asleep && core::mem::take(&mut self.came_by), self.unseen > 0);
        let can_go = |line: &Line| !line.is_broken && (is_unsure || !line.waits);
        let is_waiting = |line: &Line| can_go(line) && !line.from_program.is_empty();
        let stays = came_by && self.lines.iter().any(|line| is_waiting(line));
        if is_asleep && !stays {
            self.unseen = self.lines.len();
        }
        stays
    }

    /// Who sleeps is woken once; who is awake costs nothing.
    fn rest(&mut self) {
        self.work = Work::of_a_turn();
        for line in self.lines.iter_mut().filter(|line| line.has_news) {
            line.has_news = false;
            if line.is_broken {
                line.end();
                continue;
            }
            // What was written is seen by who looks after saying that it sleeps; who said so before is seen here.
            core::sync::atomic::fence(Ordering::SeqCst);
            if line.memory[ASLEEP].swap(0, Ordering::SeqCst) != 0 {
                self.counters.wakes += 1;
                let _ = line.waker.write(1);
            }
        }
    }
}

#[cfg(test)]
mod tests;
