//! Two stacks that hear each other at once, without a discipline between them.

mod addresses;
mod echo;
mod fragments;
mod packets;
mod sockets;
mod times;
mod unwanted;

use core::net::{Ipv4Addr, SocketAddrV4};
use std::collections::VecDeque;
use std::sync::Arc;

use super::route::{HostRoute, Interface, Origin};
use super::{Exit, Refused, Stack, StackConfig};
use crate::buf::{Buf, Pool};
use crate::counters::Refusal;
use crate::discipline::{Channel, SendError, TimeView};
use crate::queue::Priority;
use crate::socket::{Flags, Program, Received, Socket, SocketError, SocketId};
use crate::time::Instant;
use crate::wire::ethernet::{Address, MTU};

pub const A: Address = Address([2, 0, 0, 0, 0, 1]);
pub const B: Address = Address([2, 0, 0, 0, 0, 3]);
pub const IP_A: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
pub const IP_B: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 3);
pub const FROM_NOBODY: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 99);

/// What waits to leave: an exit whose slots take so many bytes.
pub struct Queue {
    pub waiting: VecDeque<(Buf, Priority, Channel)>,
    pub limit: usize,
    pub room: usize,
}

impl Exit for Queue {
    fn send(&mut self, frame: Buf, priority: Priority, channel: Channel) -> Result<(), (SendError, Buf)> {
        if self.waiting.len() == self.room {
            return Err((SendError::QueueFull(channel), frame));
        }
        self.waiting.push_back((frame, priority, channel));
        Ok(())
    }
    fn limit(&self, channel: Channel) -> Result<usize, SendError> {
        if channel > 1 { Err(SendError::NoSlot(channel)) } else { Ok(self.limit) }
    }
    fn time(&self) -> TimeView {
        TimeView::default()
    }
}

/// A station's stack and what it has queued.
pub struct End {
    pub stack: Stack,
    pub queue: Queue,
    nic: Pool,
    now: u64,
}

impl End {
    pub fn new(address: Address, ip: Ipv4Addr) -> Self {
        Self::with(StackConfig::new(Interface { address, ip, prefix: 24 }))
    }

    pub fn with(config: StackConfig) -> Self {
        Self::above(config, Vec::new())
    }

    /// With programs in its thread.
    pub fn above(config: StackConfig, programs: Vec<Box<dyn Program>>) -> Self {
        let queue = Queue { waiting: VecDeque::new(), limit: MTU, room: usize::MAX };
        Self { stack: Stack::new(config, programs), queue, nic: Pool::new(1), now: 1_000 }
    }

    pub fn knows(&mut self, ip: Ipv4Addr, address: Address) {
        let route = HostRoute { ip, address, origin: Origin::Static };
        self.stack.routes_mut().add_host(route).unwrap();
    }

    /// A UDP socket with so many buffers, bound to a port, or to an automatic one (0).
    pub fn socket(&mut self, port: u16, buffers: usize) -> SocketId {
        let id = self.open(Socket::udp(Arc::new(Pool::new(buffers))));
        self.stack.bind(id, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)).unwrap();
        id
    }

    pub fn open(&mut self, socket: Box<Socket>) -> SocketId {
        self.stack.open(socket).map_err(|(error, _)| error).unwrap()
    }

    pub fn send(&mut self, id: SocketId, data: &[u8], to: Ipv4Addr, port: u16) -> Result<(), SocketError> {
        self.stack.send_to(id, data, Some(SocketAddrV4::new(to, port)), Flags::NONE, &mut self.queue)
    }

    /// The oldest that has come, with its bytes.
    pub fn receive(&mut self, id: SocketId) -> Option<(Received, Vec<u8>)> {
        let mut room = vec![0; 65_536];
        let received = self.stack.receive(id, &mut room, Flags::NONE, &TimeView::default());
        match received {
            Ok(received) => {
                room.truncate(received.len);
                Some((received, room))
            }
            Err(SocketError::WouldBlock) => None,
            Err(error) => panic!("{error}"),
        }
    }

    /// A frame comes, a microsecond after the last one.
    pub fn hears(&mut self, bytes: &[u8]) -> Result<(), Refusal> {
        self.tells(bytes).map_err(|refused| refused.why)
    }

    /// The same, with what others may want of it.
    pub fn tells(&mut self, bytes: &[u8]) -> Result<(), Refused> {
        self.now += 1_000;
        let mut frame = self.nic.take().expect("whoever keeps a frame pays for it");
        frame.fill(bytes);
        self.stack.on_frame(Some(Instant::from_nanos(self.now)), frame, &mut self.queue)
    }

    pub fn waits(&mut self, nanos: u64) {
        self.now += nanos;
    }

    /// All that was queued, in its order; its buffers go home.
    pub fn sent(&mut self) -> Vec<Vec<u8>> {
        self.queue.waiting.drain(..).map(|(frame, ..)| frame.to_vec()).collect()
    }
}

/// Two stations that know each other.
pub fn pair() -> (End, End) {
    let (mut a, mut b) = (End::new(A, IP_A), End::new(B, IP_B));
    a.knows(IP_B, B);
    b.knows(IP_A, A);
    (a, b)
}

/// What one has queued comes to the other: what was refused of it.
pub fn cross(from: &mut End, to: &mut End) -> Vec<Refusal> {
    from.sent().iter().filter_map(|frame| to.hears(frame).err()).collect()
}

pub fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|n| (n * 7 + n / 251) as u8).collect()
}
