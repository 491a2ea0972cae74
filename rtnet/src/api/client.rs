//! A program's end: sockets as those of the standard library, of a station that is another process.

use core::net::SocketAddrV4;
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nix::errno::Errno;
use socket2::Socket;

use super::connection::{check, exchange, opened};
use super::handshake::{Answer, Ask, DESCRIPTORS};
use super::memory::Memory;
use super::place;
use super::ready::{Ready, Told};
use super::ring::{Reader, Writer};
use super::segment::{self, ASLEEP, ERROR, Order, SERVED, STATE, STATION_ASLEEP};
use crate::buf::ROOM;
use crate::live::TimeBoard;
use crate::live::clock::Deadline;
use crate::queue::Priority;
use crate::socket::{Flags, LinkMode, LinkType, Options, Received};
use crate::wire::ethernet::{Address, EtherType};
use crate::wire::udp::MAX_PAYLOAD;

/// What an eventfd is written to be readable.
const ONE: [u8; 8] = 1u64.to_ne_bytes();

/// A station on this machine, by its control socket.
#[derive(Clone, Debug)]
pub struct Station {
    control: PathBuf,
}

/// A UDP socket of a station's. It can be shared between threads: one may receive while another sends.
pub struct UdpSocket(pub(super) End);

/// A packet socket of a station's, for protocols of one's own.
pub struct PacketSocket(pub(super) End);

/// What both have.
pub(super) struct End {
    control: Mutex<Socket>,
    /// The same one, to hang up while an answer is awaited.
    line: Socket,
    pub(super) memory: Arc<Memory>,
    received: Mutex<Reader>,
    sending: Mutex<Sending>,
    timeout: Mutex<Option<Duration>>,
    pub(super) ready: Ready,
    pub(super) doorbell: File,
    /// Somebody waits until it is ready by his own means.
    is_watched: AtomicBool,
    is_closed: AtomicBool,
}

struct Sending {
    writer: Writer,
    options: Options,
    /// How many errors of earlier sends this program has been told of.
    errors_told: u32,
    /// What the station had read at the last send.
    read: u64,
}

impl Station {
    /// The station of this user that is called `[LAB/]STATION`, as behind `rtnet -S`.
    pub fn named(name: &str) -> io::Result<Self> {
        place::socket_of(name).map(Self::at)
    }

    /// The station whose control socket is there.
    pub fn at(control: impl AsRef<Path>) -> Self {
        Self { control: control.as_ref().to_owned() }
    }

    /// A UDP socket with the station's default of buffers, and an automatic port.
    pub fn udp(&self) -> io::Result<UdpSocket> {
        self.udp_with(0)
    }

    /// The same with so many buffers: a datagram in fragments needs one for each.
    pub fn udp_with(&self, buffers: u32) -> io::Result<UdpSocket> {
        End::open(&self.control, Ask::OpenUdp(buffers)).map(UdpSocket)
    }

    /// A packet socket for frames of one EtherType, or all.
    pub fn packet(&self, mode: LinkMode, link_type: LinkType) -> io::Result<PacketSocket> {
        End::open(&self.control, Ask::OpenPacket(mode, link_type, 0)).map(PacketSocket)
    }

    /// The station's time, and its cycle to wait for: as its own threads have it, without a lock and, but for waiting, without
    /// a system call. A station needs no sockets for that. Once it has ended, be it that it was killed, whoever waits is told
    /// so: the one that is started then has a time of its own.
    ///
    /// ```no_run
    /// use rtnet::api::Station;
    /// use std::time::Duration;
    ///
    /// let time = Station::named("cell/arm")?.time()?;
    /// let cycle = time.waiter().wait_cycle(Duration::from_secs(1))?;
    /// println!("cycle {} began {} ago", cycle.number, time.now() - cycle.start);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn time(&self) -> io::Result<Arc<TimeBoard>> {
        let (control, [page]) = opened(&self.control, Ask::Time)?;
        TimeBoard::open(page, control.into())
    }
}

impl UdpSocket {
    /// Binds it to an address of the station's, or any (0.0.0.0), and to a port, or the one that it has (0).
    pub fn bind(&self, to: SocketAddrV4) -> io::Result<()> {
        self.0.ask(Ask::Bind(to)).map(drop)
    }
    /// From now on it sends to this peer and hears nobody else; `None`: to nobody, and all.
    pub fn connect(&self, peer: Option<SocketAddrV4>) -> io::Result<()> {
        self.0.ask(Ask::Connect(peer)).map(drop)
    }
    /// Where it hears.
    pub fn local_addr(&self) -> io::Result<SocketAddrV4> {
        Ok(self.0.ask(Ask::LocalAddress)?.address)
    }
    /// Whom it is connected to.
    pub fn peer_addr(&self) -> io::Result<SocketAddrV4> {
        Ok(self.0.ask(Ask::PeerAddress)?.address)
    }

    /// Hands a datagram of at most 65 507 bytes to the station. It does not wait: where the station has not taken what was
    /// sent before, that is ENOBUFS. An earlier one that could not leave, for want of a route or of a slot, is told of here,
    /// and this one is not sent then. Of a station that was killed it is told at the second datagram after that, ENODEV.
    pub fn send_to(&self, data: &[u8], to: SocketAddrV4) -> io::Result<()> {
        self.send_to_with(data, to, Flags::NONE)
    }
    /// The same to the peer that it is connected to.
    pub fn send(&self, data: &[u8]) -> io::Result<()> {
        self.send_with(data, Flags::NONE)
    }
    /// As [`UdpSocket::send_to`], with flags: `DONTROUTE` is for who is on the medium itself, `DONTWAIT` goes without saying.
    pub fn send_to_with(&self, data: &[u8], to: SocketAddrV4, flags: Flags) -> io::Result<()> {
        self.0.send(data, Some(segment::pack_udp(to)), MAX_PAYLOAD, flags)
    }
    /// The same to the peer that it is connected to.
    pub fn send_with(&self, data: &[u8], flags: Flags) -> io::Result<()> {
        self.0.send(data, None, MAX_PAYLOAD, flags)
    }
}

impl PacketSocket {
    /// From now on frames of another type come to it.
    pub fn bind(&self, link_type: LinkType) -> io::Result<()> {
        self.0.ask(Ask::BindLink(link_type)).map(drop)
    }
    /// Hands the content of a frame to the station, which writes its header.
    pub fn send_to(&self, data: &[u8], to: Address, ether_type: EtherType) -> io::Result<()> {
        self.0.send(data, Some(segment::pack_link(to, ether_type)), ROOM, Flags::NONE)
    }
    /// Hands a whole frame to the station, from its destination on.
    pub fn send(&self, frame: &[u8]) -> io::Result<()> {
        self.0.send(frame, None, ROOM, Flags::NONE)
    }
}

macro_rules! of_both {
    ($($socket:ident),+) => {$(
        impl $socket {
            /// Waits for what comes next, as long as the time-out says, and copies it as far as it fits.
            pub fn receive(&self, into: &mut [u8]) -> io::Result<Received> {
                self.0.receive(into, Flags::NONE)
            }
            /// The same with flags: `PEEK` leaves it there, `DONTWAIT` does not wait: who spins so never asks the kernel, if
            /// he has never asked for the descriptor.
            pub fn receive_with(&self, into: &mut [u8], flags: Flags) -> io::Result<Received> {
                self.0.receive(into, flags)
            }
            /// Receives what has come, or says that nothing has (`WouldBlock`): then the descriptor becomes readable
            /// as soon as something does.
            pub fn try_receive(&self, into: &mut [u8]) -> io::Result<Received> {
                self.0.receive_now(into, Flags::NONE)
            }
            /// How long to wait; `None`: for ever.
            pub fn set_timeout(&self, timeout: Option<Duration>) {
                *locked(&self.0.timeout) = timeout;
            }
            /// How urgent what it sends is, 0 to 30.
            pub fn set_priority(&self, priority: Priority) -> io::Result<()> {
                if priority > Priority::LAST_REAL_TIME {
                    return Err(Errno::EINVAL.into());
                }
                locked(&self.0.sending).options.priority = priority;
                Ok(())
            }
            /// The slot that it sends in.
            pub fn set_channel(&self, channel: crate::discipline::Channel) {
                locked(&self.0.sending).options.channel = channel;
            }
            /// The type of service in its IP headers.
            pub fn set_tos(&self, tos: u8) {
                locked(&self.0.sending).options.tos = tos;
            }
            /// How it sends, as it was set.
            pub fn options(&self) -> Options {
                locked(&self.0.sending).options
            }
            /// How long it waits, as it was set.
            pub fn timeout(&self) -> Option<Duration> {
                *locked(&self.0.timeout)
            }
            /// Gives it up to so many more buffers; tells how many.
            pub fn extend(&self, buffers: u32) -> io::Result<u32> {
                Ok(self.0.ask(Ask::Extend(buffers))?.number)
            }
            /// Takes up to so many free buffers from it; tells how many.
            pub fn shrink(&self, buffers: u32) -> io::Result<u32> {
                Ok(self.0.ask(Ask::Shrink(buffers))?.number)
            }
            /// Ends all waiting on it, in whatever thread, and everything that comes after it: EBADF.
            pub fn close(&self) {
                self.0.close();
            }
        }

        impl AsFd for $socket {
            /// For `poll`, `epoll` and whatever is made of them: readable when something has come since a receive found
            /// nothing, or when the station is gone.
            fn as_fd(&self) -> BorrowedFd<'_> {
                self.0.is_watched.store(true, Ordering::Relaxed);
                self.0.ready.as_fd()
            }
        }

        impl AsRawFd for $socket {
            fn as_raw_fd(&self) -> i32 {
                self.as_fd().as_raw_fd()
            }
        }
    )+};
}

of_both!(UdpSocket, PacketSocket);

impl End {
    fn open(path: &Path, ask: Ask) -> io::Result<Self> {
        let (control, [memory, gate, doorbell]) = opened::<DESCRIPTORS>(path, ask)?;
        let memory = Arc::new(Memory::open(memory)?);
        if !segment::fits(&memory) {
            return Err(Errno::EPROTO.into());
        }
        let writer = Writer::new(memory.clone(), segment::sent());
        Ok(Self {
            ready: Ready::new(gate, &control)?,
            line: control.try_clone()?,
            control: Mutex::new(control),
            received: Mutex::new(Reader::new(memory.clone(), segment::received())),
            sending: Mutex::new(Sending { writer, options: Options::default(), errors_told: 0, read: 0 }),
            memory,
            timeout: Mutex::new(None),
            doorbell: File::from(doorbell),
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

    fn send(&self, data: &[u8], to: Option<u64>, most: usize, flags: Flags) -> io::Result<()> {
        self.check_open()?;
        flags.check(Flags::DONTROUTE | Flags::DONTWAIT).map_err(|error| Errno::from_raw(error.errno()))?;
        if data.len() > most {
            return Err(Errno::EMSGSIZE.into());
        }
        let mut sending = locked(&self.sending);
        let word = self.memory[ERROR].load(Ordering::Acquire);
        let count = (word >> 32) as u32;
        if std::mem::replace(&mut sending.errors_told, count) != count {
            return Err(Errno::from_raw(word as u32 as i32).into());
        }
        let read = sending.writer.read();
        let is_stuck = std::mem::replace(&mut sending.read, read) == read && !sending.writer.is_drained();
        // Who was killed has told nobody; that the last order has not been taken is the first sign of it.
        if is_stuck && self.ready.has_hung_up()? {
            return Err(Errno::ENODEV.into());
        }
        let order = Order { to, options: sending.options, flags: flags.bits() };
        let written = sending.writer.write(segment::pack_order(&order), data.len(), [data].into_iter());
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

    fn receive(&self, into: &mut [u8], flags: Flags) -> io::Result<Received> {
        flags.check(Flags::PEEK | Flags::DONTWAIT).map_err(|error| Errno::from_raw(error.errno()))?;
        if flags.contains(Flags::DONTWAIT) {
            if self.is_watched.load(Ordering::Relaxed) {
                return self.receive_now(into, flags);
            }
            let received = self.take(into, flags)?;
            return received
                .ok_or_else(|| if self.is_served() { Errno::EAGAIN } else { Errno::ENODEV }.into());
        }
        let deadline = Deadline::after(*locked(&self.timeout));
        self.receive_by(deadline, into, flags)
    }

    fn receive_by(&self, deadline: Deadline, into: &mut [u8], flags: Flags) -> io::Result<Received> {
        let mut told = Told::default();
        loop {
            match self.take_or_listen(into, flags, told)? {
                Some(received) => return Ok(received),
                None if told.hung_up => return Err(Errno::ENODEV.into()),
                None => told = self.ready.wait(deadline)?,
            }
        }
    }

    /// What has come, or why there is nothing: the station wakes this program for what comes next.
    fn receive_now(&self, into: &mut [u8], flags: Flags) -> io::Result<Received> {
        let now = Deadline::after(Some(Duration::ZERO));
        self.receive_by(now, into, flags).map_err(|error| match error.raw_os_error() {
            Some(libc::ETIMEDOUT) => Errno::EAGAIN.into(),
            _ => error,
        })
    }

    /// What has come; if nothing has, the station wakes this program for what comes next.
    fn take_or_listen(&self, into: &mut [u8], flags: Flags, told: Told) -> io::Result<Option<Received>> {
        if let Some(received) = self.take(into, flags)? {
            return Ok(Some(received));
        }
        // Who says that it sleeps looks once more: what came before is not told of.
        self.ready.silence(told);
        self.memory[ASLEEP].store(1, Ordering::SeqCst);
        core::sync::atomic::fence(Ordering::SeqCst);
        // All that comes is there before it is said that no more will.
        let open = self.check_open();
        let received = self.take(into, flags)?;
        if received.is_some() || open.is_err() {
            // More may have come with it, and what it was told of is read away: whoever waits looks for himself.
            self.ready.ring_again();
        }
        if received.is_some() { Ok(received) } else { open.map(|()| None) }
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

    fn close(&self) {
        self.is_closed.store(true, Ordering::Release);
        // The station hears of it, and so does who waits here.
        let _ = self.line.shutdown(std::net::Shutdown::Both);
        self.ready.ring_again();
    }
}

/// Nothing is left half done by who panicked.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
