//! A station's end of the sockets that other processes have: it copies between their memory and the stack's buffers.
//!
//! ```text
//!   program ─ ring ─► Line ─► Access::send ─► the discipline's queue
//!   program ◄─ ring ─ Line ◄─ the socket's buffers
//!           ◄─ eventfd, after the slot's send, if it sleeps
//! ```
//!
//! Nothing here is believed that a program wrote: an order that cannot be ends its line, and nobody else's.

use core::sync::atomic::Ordering;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;

use nix::sys::eventfd::{EfdFlags, EventFd};

use super::memory::Memory;
use super::ring::{Nonsense, Reader, Writer};
use super::segment::{self, ASLEEP, ENDED, ERROR, Order, STATE, STATION_ASLEEP};
use crate::socket::{Access, Flags, Program, SocketError, SocketId};
use crate::wire::udp::MAX_PAYLOAD;

/// Datagrams that are taken from one program in one turn: a flood does not hold up the others', nor the slot.
const ORDERS_AT_ONCE: usize = 8;
/// The longest order: a datagram, or a frame.
const LONGEST: usize = MAX_PAYLOAD + 1;

/// One program's socket.
pub struct Line {
    socket: SocketId,
    memory: Arc<Memory>,
    to_program: Writer,
    from_program: Reader,
    waker: EventFd,
    /// Something was written since the program was woken.
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
    counters: LineCounters,
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
    /// Memory and a waker for a socket that is about to be opened.
    pub fn new() -> io::Result<Box<Self>> {
        let memory = Arc::new(Memory::new(segment::bytes())?);
        // A program may wait before it has ever looked.
        memory[ASLEEP].store(1, Ordering::Relaxed);
        Ok(Box::new(Self {
            socket: SocketId::NOBODY,
            to_program: Writer::new(memory.clone(), segment::received()),
            from_program: Reader::new(memory.clone(), segment::sent()),
            memory,
            waker: EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC)?,
            has_news: false,
            errors: 0,
            is_broken: false,
        }))
    }

    /// For which socket.
    pub fn socket(&self) -> SocketId {
        self.socket
    }
    /// The memory that the program is to have.
    pub fn memory(&self) -> BorrowedFd<'_> {
        self.memory.as_fd()
    }
    /// What the program is to wait for.
    pub fn waker(&self) -> BorrowedFd<'_> {
        self.waker.as_fd()
    }
    /// Whether the program has written what cannot be: it is not served any more.
    pub fn is_broken(&self) -> bool {
        self.is_broken
    }

    fn serve(&mut self, sockets: &mut Access<'_>, room: &mut [u8]) -> Result<(), Nonsense> {
        self.take_orders(sockets, room)?;
        let Self { socket, to_program, has_news, .. } = self;
        let mut result = Ok(());
        let mut room_left = true;
        while room_left && result.is_ok() {
            let passed = sockets.pass_on(*socket, |received, parts| {
                let written = to_program.write(segment::pack_received(received), received.whole, parts);
                room_left = *written.as_ref().unwrap_or(&false);
                *has_news |= room_left;
                result = written.map(|_| ());
                room_left
            });
            if passed.is_err() {
                break;
            }
        }
        result
    }

    /// What waits for a buffer or a place in the queue stays where it is.
    fn take_orders(&mut self, sockets: &mut Access<'_>, room: &mut [u8]) -> Result<(), Nonsense> {
        for _ in 0..ORDERS_AT_ONCE {
            if self.from_program.is_empty() {
                return Ok(());
            }
            let Some(record) = self.from_program.peek(room)? else { return Ok(()) };
            let order =
                segment::unpack_order(record.meta).filter(|_| record.len <= LONGEST).ok_or(Nonsense)?;
            match carry_out(self.socket, sockets, &order, &room[..record.copied]) {
                Err(SocketError::NoBuffers { needed, capacity, .. }) if needed <= capacity => return Ok(()),
                Err(error) => self.note(&error),
                Ok(()) => {}
            }
            self.from_program.take(record);
        }
        Ok(())
    }

    /// The program hears of it at its next call, as of a socket's `SO_ERROR`.
    fn note(&mut self, error: &SocketError) {
        self.errors = self.errors.wrapping_add(1);
        let word = u64::from(self.errors) << 32 | error.errno() as u64;
        self.memory[ERROR].store(word, Ordering::Release);
    }

    fn end(&mut self) {
        self.memory[STATE].store(ENDED, Ordering::Release);
        let _ = self.waker.write(1);
    }
}

fn carry_out(
    socket: SocketId,
    sockets: &mut Access<'_>,
    order: &Order,
    data: &[u8],
) -> Result<(), SocketError> {
    sockets.set_options(socket, order.options)?;
    let flags = Flags::from_bits(order.flags);
    if sockets.is_udp(socket)? {
        sockets.send_with(socket, data, order.to.map(segment::unpack_udp), flags)
    } else {
        sockets.send_frame(socket, data, order.to.map(segment::unpack_link))
    }
}

impl Lines {
    /// Room for so many.
    pub fn new(most: usize) -> Self {
        Self {
            lines: Vec::with_capacity(most),
            room: vec![0; LONGEST].into_boxed_slice(),
            counters: LineCounters::default(),
        }
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
        let Self { lines, room, counters } = self;
        for line in lines.iter_mut().filter(|line| !line.is_broken) {
            if line.serve(sockets, room).is_err() {
                counters.nonsense += 1;
                line.is_broken = true;
                line.end();
            }
        }
    }

    /// Programs ring only while the station sleeps; what came before they could know is looked for.
    fn sleeps(&mut self, is_asleep: bool) -> bool {
        for line in &self.lines {
            line.memory[STATION_ASLEEP].store(is_asleep.into(), Ordering::SeqCst);
        }
        core::sync::atomic::fence(Ordering::SeqCst);
        is_asleep && self.lines.iter().any(|line| !line.is_broken && !line.from_program.is_empty())
    }

    /// Who sleeps is woken once; who is awake costs nothing.
    fn rest(&mut self) {
        for line in self.lines.iter_mut().filter(|line| line.has_news) {
            line.has_news = false;
            // What was written is seen by who looks after saying that it sleeps; who said so before is seen here.
            core::sync::atomic::fence(Ordering::SeqCst);
            if line.memory[ASLEEP].swap(0, Ordering::SeqCst) != 0 {
                self.counters.wakes += 1;
                let _ = line.waker.write(1);
            }
        }
    }
}
