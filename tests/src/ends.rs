//! Stacks by hand: frames in, calls of programs, what leaves, and where every buffer is meanwhile.

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, SendError, TimeView};
use rtnet::ip::route::{HostRoute, Interface, Origin};
use rtnet::ip::{Exit, Stack, StackConfig};
use rtnet::queue::Priority;
use rtnet::socket::{Flags, Program, Received, Socket, SocketError, SocketId};
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::checksum::checksum;
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME, MTU};
use rtnet::wire::{icmpv4, ipv4, udp};

/// The stations of the example frames.
pub const A: (Address, Ipv4Addr) = (Address([2, 0, 0, 0, 0, 1]), Ipv4Addr::new(10, 0, 0, 1));
/// See [`A`].
pub const B: (Address, Ipv4Addr) = (Address([2, 0, 0, 0, 0, 3]), Ipv4Addr::new(10, 0, 0, 3));
/// Somebody else.
pub const C: (Address, Ipv4Addr) = (Address([2, 0, 0, 0, 0, 7]), Ipv4Addr::new(10, 0, 0, 7));

/// Whose buffer a frame is in that waits to leave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The stack's own pool of this name.
    Stack(&'static str),
    /// A socket, be it closed meanwhile.
    Socket(SocketId),
}

/// Frames that wait to leave, in slots that take so many bytes, as many as there is room for.
pub struct Queue {
    /// Whose they are, in their order.
    pub waiting: VecDeque<(Buf, Owner)>,
    /// What a slot takes behind the Ethernet header.
    pub limit: usize,
    /// Frames that may wait.
    pub room: usize,
    /// How urgent the last was, and in which slot it is to leave.
    pub last: Option<(Priority, Channel)>,
    /// The socket that is sending; none: the stack answers.
    sending: Option<SocketId>,
    own: Address,
}

impl Exit for Queue {
    /// Whatever leaves must be fit to.
    fn send(&mut self, frame: Buf, priority: Priority, channel: Channel) -> Result<(), (SendError, Buf)> {
        let (header, _) = Header::parse(&frame).expect("a frame has a header");
        assert_ne!(header.ether_type(), EtherType::RTMAC, "only a discipline sends its frames");
        assert!(priority <= Priority::LAST_REAL_TIME && frame.len() >= MIN_FRAME);
        assert!(frame.len() <= HEADER_LEN + self.limit.max(MIN_FRAME - HEADER_LEN), "{}", frame.len());
        let owner = match (self.sending, header.ether_type()) {
            (Some(socket), _) => Owner::Socket(socket),
            (None, EtherType::ARP) => Owner::Stack("arp"),
            (None, _) => Owner::Stack("icmp"),
        };
        assert!(self.sending.is_some() || header.source == self.own, "a station answers as itself");
        if self.waiting.len() >= self.room {
            return Err((SendError::QueueFull(channel), frame));
        }
        self.last = Some((priority, channel));
        self.waiting.push_back((frame, owner));
        Ok(())
    }
    fn limit(&self, channel: Channel) -> Result<usize, SendError> {
        if channel > 1 { Err(SendError::NoSlot(channel)) } else { Ok(self.limit) }
    }
    fn time(&self) -> TimeView {
        TimeView::default()
    }
}

/// A station's stack, what it has queued, and the card that frames come from.
pub struct End {
    /// The stack.
    pub stack: Stack,
    /// What waits to leave.
    pub queue: Queue,
    /// Its clock.
    pub now: Instant,
    nic: Pool,
    closed: Vec<(SocketId, Arc<Pool>)>,
}

impl End {
    /// A station without routes and sockets, in a network of 24 bits.
    pub fn new((address, ip): (Address, Ipv4Addr)) -> Self {
        Self::with(StackConfig::new(Interface { address, ip, prefix: 24 }))
    }

    /// The same as configured.
    pub fn with(config: StackConfig) -> Self {
        Self::above(config, Vec::new())
    }

    /// The same with programs in its thread.
    pub fn above(config: StackConfig, programs: Vec<Box<dyn Program>>) -> Self {
        let own = config.interface.address;
        let queue =
            Queue { waiting: VecDeque::new(), limit: MTU, room: usize::MAX, last: None, sending: None, own };
        let now = Instant::from_nanos(1_000);
        Self { stack: Stack::new(config, programs), queue, now, nic: Pool::new(1), closed: Vec::new() }
    }

    /// A route said by hand.
    pub fn knows(&mut self, (address, ip): (Address, Ipv4Addr)) {
        let route = HostRoute { ip, address, origin: Origin::Static };
        self.stack.routes_mut().add_host(route).expect("a station");
    }

    /// Opens a socket.
    pub fn open(&mut self, socket: Box<Socket>) -> Result<SocketId, SocketError> {
        self.stack.open(socket).map_err(|(error, _)| error)
    }

    /// A UDP socket with so many buffers, bound to a port.
    pub fn socket(&mut self, port: u16, buffers: usize) -> SocketId {
        let id = self.open(Socket::udp(Arc::new(Pool::with_room(buffers, buffers.max(64))))).expect("room");
        self.stack.bind(id, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)).expect("a free port");
        id
    }

    /// Closes a socket; its frames may still wait to leave.
    pub fn close(&mut self, id: SocketId) -> Result<(), SocketError> {
        let socket = self.stack.close(id)?;
        self.closed.push((id, socket.pool().clone()));
        Ok(())
    }

    /// Sends a datagram.
    pub fn send(&mut self, id: SocketId, data: &[u8], to: Option<SocketAddrV4>) -> Result<(), SocketError> {
        self.queue.sending = Some(id);
        // Loopback is answered in the meantime, but leaves nothing.
        let sent = self.stack.send_to(id, data, to, Flags::NONE, &mut self.queue);
        self.queue.sending = None;
        sent
    }

    /// Sends a datagram that says when it was sent.
    pub fn send_sent_at(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<SocketAddrV4>,
        sent: Option<GlobalTime>,
    ) -> Result<(), SocketError> {
        self.queue.sending = Some(id);
        let sent = self.stack.send_sent_at(id, data, to, Flags::NONE, sent, &mut self.queue);
        self.queue.sending = None;
        sent
    }

    /// Sends a frame.
    pub fn send_frame(
        &mut self,
        id: SocketId,
        data: &[u8],
        to: Option<(Address, EtherType)>,
    ) -> Result<(), SocketError> {
        self.queue.sending = Some(id);
        let sent = self.stack.send_frame(id, data, to, Flags::NONE, &mut self.queue);
        self.queue.sending = None;
        sent
    }

    /// The oldest that has come for a socket, with as many of its bytes as there is room for.
    pub fn receive(
        &mut self,
        id: SocketId,
        room: usize,
        flags: Flags,
    ) -> Result<(Received, Vec<u8>), SocketError> {
        let mut into = vec![0; room];
        let received = self.stack.receive(id, &mut into, flags, &TimeView::default())?;
        into.truncate(received.len);
        Ok((received, into))
    }

    /// A frame comes, a microsecond after the last one.
    pub fn hears(&mut self, bytes: &[u8]) -> Result<(), Refusal> {
        self.now += Span::from_micros(1);
        let mut frame = self.nic.take().expect("whoever keeps a frame pays for it");
        frame.fill(bytes);
        let heard = self.stack.on_frame(Some(self.now), frame, &mut self.queue);
        heard.map_err(|refused| refused.why)
    }

    /// Time passes up to a slot.
    pub fn waits(&mut self, span: Span) {
        self.now += span;
        self.stack.poll(self.now, &mut self.queue);
    }

    /// Up to so many frames leave.
    pub fn leaves(&mut self, most: usize) -> Vec<Vec<u8>> {
        let n = most.min(self.queue.waiting.len());
        self.queue.waiting.drain(..n).map(|(frame, _)| frame.to_vec()).collect()
    }

    /// Every buffer is somewhere: at home, in the queue, in a socket, or with the parts of a datagram.
    pub fn check_buffers(&mut self) {
        assert_eq!(self.nic.available(), self.nic.capacity(), "the card's own come home at once");
        let mut queued = 0;
        let mut waiting = |owner| {
            let n = self.queue.waiting.iter().filter(|(_, of)| *of == owner).count();
            queued += n;
            n
        };
        for pool in self.stack.pools() {
            let statistics = pool.statistics;
            assert_eq!(
                statistics.free + waiting(Owner::Stack(pool.name)),
                statistics.capacity,
                "{}",
                pool.name
            );
        }
        for (id, socket) in self.stack.sockets() {
            let statistics = socket.pool().statistics();
            let held = waiting(Owner::Socket(id)) + socket.waiting() + self.stack.collecting(id);
            assert_eq!(statistics.free + held, statistics.capacity, "{id:?}");
        }
        for (id, pool) in &self.closed {
            assert_eq!(pool.available() + waiting(Owner::Socket(*id)), pool.capacity(), "closed {id:?}");
        }
        assert_eq!(queued, self.queue.waiting.len(), "every frame is somebody's");
        self.closed.retain(|(_, pool)| pool.available() < pool.capacity());
    }

    /// All is read and has left, and what is incomplete is given up: everything comes home.
    pub fn check_all_comes_home(&mut self) {
        self.leaves(usize::MAX);
        let ids: Vec<_> = self.stack.sockets().map(|(id, _)| id).collect();
        for &id in &ids {
            while self.receive(id, 0, Flags::NONE).is_ok() {}
        }
        self.waits(Span::from_millis(10_000));
        self.check_buffers();
        assert!(ids.iter().all(|&id| self.stack.collecting(id) == 0) && self.closed.is_empty());
    }
}

/// Two stations that know each other.
pub fn pair() -> (End, End) {
    let (mut a, mut b) = (End::new(A), End::new(B));
    a.knows(B);
    b.knows(A);
    (a, b)
}

/// Writes the checksums of a packet, as far as it is one.
pub fn mend(packet: &mut [u8]) {
    let Some(&first) = packet.first() else { return };
    let begin = usize::from(first & 0xf) * 4;
    if begin < ipv4::HEADER_LEN || packet.len() < begin {
        return;
    }
    packet[10..12].fill(0);
    let sum = checksum(&packet[..begin]).to_be_bytes();
    packet[10..12].copy_from_slice(&sum);
    let Ok((header, payload)) = ipv4::parse(packet) else { return };
    let (protocol, source, destination) = (header.protocol(), header.source(), header.destination());
    let end = begin + payload.len();
    let payload = &mut packet[begin..end];
    match protocol {
        ipv4::Protocol::ICMP if payload.len() >= icmpv4::HEADER_LEN => {
            payload[2..4].fill(0);
            let sum = checksum(payload).to_be_bytes();
            payload[2..4].copy_from_slice(&sum);
        }
        ipv4::Protocol::UDP if payload.len() >= udp::HEADER_LEN => {
            let len = u16::from_be_bytes([payload[4], payload[5]]);
            payload[6..8].fill(0);
            let mut sum = udp::pseudo_header(source, destination, len);
            sum.add(&payload[..usize::from(len).min(end - begin)]);
            let sum = udp::to_field(sum).to_be_bytes();
            payload[6..8].copy_from_slice(&sum);
        }
        _ => {}
    }
}
