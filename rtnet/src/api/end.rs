//! A program's end of a socket: what UDP and packet sockets have in common.

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use core::time::Duration;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nix::errno::Errno;
use socket2::Socket;

use super::connection::{check, exchange, opened};
use super::handshake::{Answer, Ask, DESCRIPTORS};
use super::memory::Memory;
use super::ready::{HungUp, Ready};
use super::ring::{Reader, Writer};
use super::segment::{self, ASLEEP, ERROR, Order, SERVED, STATE, STATION_ASLEEP};
use crate::live::clock::{Deadline, monotonic};
use crate::socket::{Flags, Options, Received};

/// What an eventfd is written to be readable.
const ONE: [u8; 8] = 1u64.to_ne_bytes();
/// Who looks without waiting asks the kernel so seldom whether the station was killed: it takes as long as many looks.
const LOOKS_IN_VAIN: u32 = 1024;

/// One socket.
pub(super) struct End {
    control: Mutex<Socket>,
    pub(super) memory: Arc<Memory>,
    received: Mutex<Reader>,
    sending: Mutex<Sending>,
    timeout: Mutex<Option<Duration>>,
    pub(super) ready: Ready,
    pub(super) doorbell: File,
    /// How many errors of earlier sends this program has been told of.
    errors_told: AtomicU32,
    /// Whoever receives waits for one peer's answers, and is told why there can be none.
    pub(super) is_connected: AtomicBool,
    /// How often it has looked without waiting, and found nothing.
    looks_in_vain: AtomicU32,
    /// Somebody waits until it is ready by his own means.
    is_watched: AtomicBool,
    is_closed: AtomicBool,
}

struct Sending {
    writer: Writer,
    options: Options,
    /// Whether receivers are to know when it was.
    with_times: bool,
    /// What the station had read at the last send, and how many sends in a row it has read nothing.
    read: u64,
    unread: u32,
}

impl End {
    pub(super) fn open(path: &Path, ask: Ask) -> io::Result<Self> {
        let (control, [memory, gate, doorbell]) = opened::<DESCRIPTORS>(path, ask)?;
        let memory = Arc::new(Memory::open(memory)?);
        if !segment::fits(&memory) {
            return Err(Errno::EPROTO.into());
        }
        let writer = Writer::new(memory.clone(), segment::sent());
        Ok(Self {
            // The same one, to hang up while an answer is awaited.
            ready: Ready::new(gate, control.try_clone()?)?,
            control: Mutex::new(control),
            received: Mutex::new(Reader::new(memory.clone(), segment::received())),
            sending: Mutex::new(Sending {
                writer,
                options: Options::default(),
                with_times: false,
                read: 0,
                unread: 0,
            }),
            memory,
            timeout: Mutex::new(None),
            doorbell: File::from(doorbell),
            errors_told: AtomicU32::new(0),
            is_connected: AtomicBool::new(false),
            looks_in_vain: AtomicU32::new(0),
            is_watched: AtomicBool::new(false),
            is_closed: AtomicBool::new(false),
        })
    }

    pub(super) fn ask(&self, ask: Ask) -> io::Result<Answer> {
        self.check_open()?;
        let (answer, _) = exchange(&locked(&self.control), ask)?;
        check(&answer)?;
        Ok(answer)
    }

    /// Hands over at most so many bytes, in parts as they lie, by one of the known flags.
    pub(super) fn send(
        &self,
        parts: &[&[u8]],
        to: Option<u64>,
        most: usize,
        flags: Flags,
        known: Flags,
    ) -> io::Result<()> {
        self.check_open()?;
        flags.check(known).map_err(|error| Errno::from_raw(error.errno()))?;
        let len = parts.iter().map(|part| part.len()).sum();
        if len > most {
            return Err(Errno::EMSGSIZE.into());
        }
        let mut sending = locked(&self.sending);
        self.take_error().map_or(Ok(()), Err)?;
        let read = sending.writer.read();
        let is_stuck = std::mem::replace(&mut sending.read, read) == read && !sending.writer.is_drained();
        sending.unread = if is_stuck { sending.unread.saturating_add(1) } else { 0 };
        // Who was killed has told nobody; that the last order has not been taken is the first sign of it. Of a burst the
        // station is asked after ever more seldom.
        if sending.unread.is_power_of_two() && self.ready.has_hung_up()? {
            sending.unread = 0;
            return Err(Errno::ENODEV.into());
        }
        let at = sending.with_times.then(monotonic);
        let order = Order { to, options: sending.options, flags: flags.bits(), at };
        let written = sending.writer.write(segment::pack_order(&order), len, parts.iter().copied());
        match written {
            Ok(true) => {}
            Ok(false) => return Err(Errno::ENOBUFS.into()),
            Err(_) => return Err(Errno::ENODEV.into()),
        }
        drop(sending);
        core::sync::atomic::fence(Ordering::SeqCst);
        if self.memory[STATION_ASLEEP].load(Ordering::SeqCst) != 0 {
            // It does not block: nothing but this is ever written.
            let _ = (&self.doorbell).write(&ONE);
        }
        Ok(())
    }

    /// Whether the station has taken all that was handed over: then it leaves, whether this program is there or not.
    pub(super) fn is_drained(&self) -> bool {
        locked(&self.sending).writer.is_drained()
    }

    /// What the station says that it has taken: to be compared with what it said before, and nothing else.
    pub(super) fn taken(&self) -> u64 {
        locked(&self.sending).writer.read()
    }

    pub(super) fn receive(&self, into: &mut [u8], flags: Flags) -> io::Result<Received> {
        flags.check(Flags::PEEK | Flags::DONTWAIT).map_err(|error| Errno::from_raw(error.errno()))?;
        if !flags.contains(Flags::DONTWAIT) {
            let deadline = Deadline::after(self.timeout());
            return self.receive_by(deadline, into, flags);
        }
        if self.is_watched.load(Ordering::Relaxed) {
            return self.receive_now(into, flags);
        }
        match self.take(into, flags)? {
            Some(received) => Ok(received),
            // All that comes is there before it is said that no more will.
            None if self.is_gone()? => self.take(into, flags)?.ok_or(Errno::ENODEV.into()),
            None => Err(self.no_answer().unwrap_or(Errno::EAGAIN.into())),
        }
    }

    /// For who spins: what of it is seldom true is seldom looked for.
    fn is_gone(&self) -> io::Result<bool> {
        let looks = self.looks_in_vain.load(Ordering::Relaxed).wrapping_add(1);
        self.looks_in_vain.store(looks, Ordering::Relaxed);
        Ok(!self.is_served() || looks.is_multiple_of(LOOKS_IN_VAIN) && self.ready.has_hung_up()?)
    }

    fn receive_by(&self, deadline: Deadline, into: &mut [u8], flags: Flags) -> io::Result<Received> {
        let mut told = HungUp(false);
        loop {
            if let Some(received) = self.take(into, flags)? {
                return Ok(received);
            }
            let waiter = self.ready.waiter();
            let HungUp(before) = waiter.silence()?;
            if let Some(received) = self.listen(into, flags)? {
                return Ok(received);
            }
            if before || told.0 {
                return Err(Errno::ENODEV.into());
            }
            told = waiter.wait(deadline)?;
        }
    }

    /// What has come, or why there is nothing: the station wakes this program for what comes next.
    pub(super) fn receive_now(&self, into: &mut [u8], flags: Flags) -> io::Result<Received> {
        // Whoever is told that there is nothing yet may wait for it by his own means.
        self.ready.share();
        let now = Deadline::after(Some(Duration::ZERO));
        self.receive_by(now, into, flags).map_err(|error| match error.raw_os_error() {
            Some(libc::ETIMEDOUT) => Errno::EAGAIN.into(),
            _ => error,
        })
    }

    /// The station wakes this program for what comes next. Who says that he sleeps looks once more: what came before is not
    /// told of.
    fn listen(&self, into: &mut [u8], flags: Flags) -> io::Result<Option<Received>> {
        self.memory[ASLEEP].store(1, Ordering::SeqCst);
        core::sync::atomic::fence(Ordering::SeqCst);
        // All that comes is there before it is said that no more will.
        let open = self.check_open();
        let received = self.take(into, flags).inspect_err(|_| self.ready.ring_again())?;
        let error = if received.is_none() { self.no_answer() } else { None };
        if received.is_some() || error.is_some() || open.is_err() {
            // More may have come with it, and what was told of is read away: whoever waits looks for himself.
            self.ready.ring_again();
        }
        match (received, error) {
            (Some(received), _) => Ok(Some(received)),
            (None, Some(error)) => Err(error),
            (None, None) => open.map(|()| None),
        }
    }

    fn take(&self, into: &mut [u8], flags: Flags) -> io::Result<Option<Received>> {
        if self.is_closed.load(Ordering::Acquire) {
            return Err(Errno::EBADF.into());
        }
        let mut reader = locked(&self.received);
        let record = reader.peek(into).map_err(|_| Errno::ENODEV)?;
        Ok(record.map(|record| {
            if !flags.contains(Flags::PEEK) {
                reader.take(record);
            }
            segment::unpack_received(record.meta, record.len, record.copied)
        }))
    }

    /// What has come can be read even of a station that is gone; nothing else can be done.
    fn check_open(&self) -> io::Result<()> {
        if self.is_closed.load(Ordering::Acquire) {
            return Err(Errno::EBADF.into());
        }
        if self.is_served() { Ok(()) } else { Err(Errno::ENODEV.into()) }
    }

    fn is_served(&self) -> bool {
        self.memory[STATE].load(Ordering::Acquire) == SERVED
    }

    /// Why there is no answer to what was sent. Who hears all goes on with the others.
    fn no_answer(&self) -> Option<io::Error> {
        if self.is_connected.load(Ordering::Relaxed) { self.take_error() } else { None }
    }

    /// The last error of an earlier send, once.
    pub(super) fn take_error(&self) -> Option<io::Error> {
        let told = self.errors_told.load(Ordering::Acquire);
        let word = self.memory[ERROR].load(Ordering::Acquire);
        let count = (word >> 32) as u32;
        // Of several threads one is told.
        let is_new = count != told
            && self.errors_told.compare_exchange(told, count, Ordering::AcqRel, Ordering::Relaxed).is_ok();
        is_new.then(|| Errno::from_raw(word as u32 as i32).into())
    }

    pub(super) fn options(&self) -> Options {
        locked(&self.sending).options
    }

    pub(super) fn set_options(&self, change: impl FnOnce(&mut Options)) {
        change(&mut locked(&self.sending).options);
    }

    pub(super) fn set_with_times(&self, with_times: bool) {
        locked(&self.sending).with_times = with_times;
    }

    pub(super) fn timeout(&self) -> Option<Duration> {
        *locked(&self.timeout)
    }

    pub(super) fn set_timeout(&self, timeout: Option<Duration>) {
        *locked(&self.timeout) = timeout;
    }

    /// What to wait for by one's own means, from now on.
    pub(super) fn watch(&self) -> &Ready {
        self.ready.share();
        self.is_watched.store(true, Ordering::Relaxed);
        &self.ready
    }

    pub(super) fn close(&self) {
        self.is_closed.store(true, Ordering::Release);
        self.ready.hang_up();
    }
}

/// Nothing is left half done by who panicked.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
