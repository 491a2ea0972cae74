//! Programs on the station's side of the fence: they run in its thread, between a frame and the next slot.

use core::any::Any;
use core::net::{Ipv4Addr, SocketAddrV4};

use super::{Flags, Lack, LinkType, Options, Received, Socket, SocketCounters, SocketError, SocketId};
use crate::discipline::TimeView;
use crate::ip::{Exit, Pong, Stack};
use crate::queue::Priority;
use crate::time::{GlobalTime, Instant};
use crate::wire::ethernet::{Address, EtherType};

/// A program in the station's own thread. It must not wait, allocate or ask the kernel for anything: what it does comes
/// between a frame and the slot in which the answer may leave.
pub trait Program: Send + Any {
    /// Something has come for a socket, or a slot is about to: the last moment to send in it.
    fn run(&mut self, sockets: &mut Access<'_>);
    /// The slot's frame has left: the moment for what may take longer, such as a system call.
    fn rest(&mut self) {}
    /// The station is about to wait until it is rung for, or is awake again. Tells whether it should not wait, since
    /// something has come meanwhile.
    fn sleeps(&mut self, _is_asleep: bool) -> bool {
        false
    }
}

/// The sockets of a station, for the moment in which a program runs. No call waits.
pub struct Access<'a> {
    stack: &'a mut Stack,
    exit: &'a mut dyn Exit,
    now: Instant,
}

impl<'a> Access<'a> {
    /// Access to the sockets of `stack`, which send by `exit`.
    pub fn new(stack: &'a mut Stack, exit: &'a mut dyn Exit, now: Instant) -> Self {
        Self { stack, exit, now }
    }

    /// This station's clock: the begin of the slot that is about to come, or when the frame came.
    pub fn now(&self) -> Instant {
        self.now
    }
    /// What is known of the master's time.
    pub fn time(&self) -> TimeView {
        self.exit.time()
    }

    /// Opens a socket that was made before. One that cannot be opened comes back.
    pub fn open(&mut self, socket: Box<Socket>) -> Result<SocketId, (SocketError, Box<Socket>)> {
        self.stack.open(socket)
    }
    /// Closes a socket: what waits in it is lost. It comes back, to be freed where memory may be.
    pub fn close(&mut self, id: SocketId) -> Result<Box<Socket>, SocketError> {
        self.stack.close(id)
    }

    /// As [`Stack::bind`].
    pub fn bind(&mut self, id: SocketId, to: SocketAddrV4) -> Result<(), SocketError> {
        self.stack.bind(id, to)
    }
    /// As [`Stack::bind_link`].
    pub fn bind_link(&mut self, id: SocketId, link_type: LinkType) -> Result<(), SocketError> {
        self.stack.bind_link(id, link_type)
    }
    /// As [`Stack::connect`].
    pub fn connect(&mut self, id: SocketId, peer: Option<SocketAddrV4>) -> Result<(), SocketError> {
        self.stack.connect(id, peer)
    }
    /// Where a UDP socket hears.
    pub fn local_address(&self, id: SocketId) -> Result<SocketAddrV4, SocketError> {
        self.stack.local_address(id)
    }
    /// Whom it is connected to.
    pub fn peer_address(&self, id: SocketId) -> Result<SocketAddrV4, SocketError> {
        self.stack.peer_address(id)
    }

    /// Whether it is one of UDP's; else it is a packet socket.
    pub fn is_udp(&self, id: SocketId) -> Result<bool, SocketError> {
        self.stack.is_udp(id)
    }
    /// How it sends from now on.
    pub fn set_options(&mut self, id: SocketId, options: Options) -> Result<(), SocketError> {
        self.stack.set_options(id, options)
    }
    /// How it sends.
    pub fn options(&self, id: SocketId) -> Result<Options, SocketError> {
        self.stack.options(id)
    }
    /// What it has counted.
    pub fn counters(&self, id: SocketId) -> Result<SocketCounters, SocketError> {
        self.stack.socket_counters(id)
    }

    /// As [`Stack::send_to`].
    pub fn send_to(&mut self, id: SocketId, data: &[u8], to: SocketAddrV4) -> Result<(), SocketError> {
        self.stack.send_to(id, data, Some(to), Flags::NONE, self.exit)
    }
    /// As [`Stack::send_to`], with flags.
    pub fn send_with(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
        flags: Flags,
    ) -> Result<(), SocketError> {
        self.stack.send_to(id, data, to, flags, self.exit)
    }
    /// As [`Stack::send_sent_at`].
    pub fn send_sent_at(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
        flags: Flags,
        sent: Option<GlobalTime>,
    ) -> Result<(), SocketError> {
        self.stack.send_sent_at(id, data, to, flags, sent, self.exit)
    }
    /// Whether what is sent now, `len` bytes, would be refused for want of the socket's buffers, and whether that passes: then
    /// it is worth being tried again. To a packet socket `to` is nothing.
    pub fn lacks_buffers(
        &self,
        id: SocketId,
        len: usize,
        to: Option<SocketAddrV4>,
        flags: Flags,
    ) -> Option<Lack> {
        // What is wrong besides is said by who sends.
        self.stack.lacks_buffers(id, len, to, flags, self.exit).unwrap_or(None)
    }
    /// Sends to the peer that the socket is connected to.
    pub fn send(&mut self, id: SocketId, data: &[u8]) -> Result<(), SocketError> {
        self.stack.send_to(id, data, None, Flags::NONE, self.exit)
    }
    /// As [`Stack::send_frame`].
    pub fn send_frame(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<(Address, EtherType)>,
    ) -> Result<(), SocketError> {
        self.send_frame_with(id, data, to, Flags::NONE)
    }
    /// As [`Stack::send_frame`], with flags.
    pub fn send_frame_with(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<(Address, EtherType)>,
        flags: Flags,
    ) -> Result<(), SocketError> {
        self.stack.send_frame(id, data, to, flags, self.exit)
    }

    /// As [`Stack::ask_echo`].
    pub fn ask_echo(
        &mut self,
        to: Ipv4Addr,
        which: (u16, u16),
        data: &[u8],
        options: Options,
    ) -> Result<(), SocketError> {
        self.stack.ask_echo(to, which, data, options, self.exit)
    }
    /// As [`Stack::next_pong`].
    pub fn next_pong(&mut self) -> Option<Pong> {
        self.stack.next_pong()
    }

    /// The oldest that has come for a socket, copied as far as it fits. Does not wait.
    pub fn receive(&mut self, id: SocketId, into: &mut [u8], flags: Flags) -> Result<Received, SocketError> {
        let view = self.exit.time();
        self.stack.receive(id, into, flags, &view)
    }

    /// Shows the oldest that has come to `take`, in its parts; it goes if that says so.
    pub fn pass_on(
        &mut self,
        id: SocketId,
        take: impl FnOnce(&Received, &mut dyn Iterator<Item = &[u8]>) -> bool,
    ) -> Result<(), SocketError> {
        let view = self.exit.time();
        self.stack.pass_on(id, &view, take)
    }
}

impl Stack {
    /// Opens a socket. One that cannot be opened comes back.
    pub fn open(&mut self, socket: Box<Socket>) -> Result<SocketId, (SocketError, Box<Socket>)> {
        self.sockets.open(socket)
    }

    /// Closes a socket, with all that waits in it.
    pub fn close(&mut self, id: SocketId) -> Result<Box<Socket>, SocketError> {
        self.collectors.forget(id);
        self.sockets.close(id)
    }

    /// How a socket sends from now on. The last level is not for sockets.
    pub fn set_options(&mut self, id: SocketId, options: Options) -> Result<(), SocketError> {
        if options.priority > Priority::LAST_REAL_TIME {
            return Err(SocketError::WrongPriority(options.priority.level()));
        }
        self.sockets.get_mut(id)?.options = options;
        Ok(())
    }

    /// How a socket sends.
    pub fn options(&self, id: SocketId) -> Result<Options, SocketError> {
        Ok(self.sockets.get(id)?.options)
    }

    /// What a socket has counted.
    pub fn socket_counters(&self, id: SocketId) -> Result<SocketCounters, SocketError> {
        Ok(self.sockets.get(id)?.counters)
    }

    /// Whether a socket is one of UDP's; else it is a packet socket.
    pub fn is_udp(&self, id: SocketId) -> Result<bool, SocketError> {
        Ok(self.sockets.get(id)?.as_udp().is_ok())
    }

    /// Shows the oldest that has come for a socket to `take`, in its parts; it goes if that says so.
    pub fn pass_on(
        &mut self,
        id: SocketId,
        time: &TimeView,
        take: impl FnOnce(&Received, &mut dyn Iterator<Item = &[u8]>) -> bool,
    ) -> Result<(), SocketError> {
        self.sockets.get_mut(id)?.pass_on(time, take)
    }

    /// All that are open.
    pub fn sockets(&self) -> impl Iterator<Item = (SocketId, &Socket)> {
        self.sockets.all()
    }

    /// The oldest that has come for a socket, copied as far as it fits. It goes unless it was only peeked at.
    pub fn receive(
        &mut self,
        id: SocketId,
        into: &mut [u8],
        flags: Flags,
        time: &TimeView,
    ) -> Result<Received, SocketError> {
        let received = self.sockets.get_mut(id)?.read(into, flags)?;
        let global = received.rx.and_then(|rx| time.to_global(rx));
        Ok(Received { global, ..received })
    }
}
