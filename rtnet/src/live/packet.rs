//! AF_PACKET sockets: what socket2 does not have, one unsafe system call each.

use std::io::{self, IoSliceMut};
use std::os::fd::{AsRawFd, BorrowedFd};

use socket2::{Domain, SockAddr, Socket, Type};

use zerocopy::IntoBytes;

use super::clock::timespec;
use crate::buf::{Buf, ROOM};
use crate::clock::True;
use crate::wire::offload::{self, Offload};

/// Room for the control message of a time stamp, aligned as the kernel wants it.
type ControlRoom = [u64; 8];
// As linux/if_packet.h numbers them, which libc does not.
const PACKET_VNET_HDR: libc::c_int = 15;
/// Since Linux 4.20.
const PACKET_IGNORE_OUTGOING: libc::c_int = 23;

/// A raw packet socket that receives nothing until it is bound to a protocol.
pub fn open() -> io::Result<Socket> {
    Socket::new(Domain::PACKET, Type::RAW, None)
}

/// Binds to an interface; protocol 0 receives nothing.
pub fn bind(socket: &Socket, interface: u32, protocol: u16) -> io::Result<()> {
    // SAFETY: the closure fills a sockaddr_ll into storage that is large enough for any address, and
    // tells its true length; all other fields of it are zero, as the storage was.
    let ((), address) = unsafe {
        SockAddr::try_init(|storage, len| {
            let link = &mut *storage.cast::<libc::sockaddr_ll>();
            link.sll_family = libc::AF_PACKET as u16;
            link.sll_protocol = protocol.to_be();
            link.sll_ifindex = interface as i32;
            *len = size_of::<libc::sockaddr_ll>() as libc::socklen_t;
            Ok(())
        })?
    };
    socket.bind(&address)
}

/// Lets the kernel stamp received frames with CLOCK_REALTIME.
pub fn stamp_received(socket: &Socket) -> io::Result<()> {
    switch_on(socket, libc::SOL_SOCKET, libc::SO_TIMESTAMPNS)
}

/// Has the kernel write in front of each frame what its sender has left to a card: to be received by [`receive_offloaded`].
pub fn show_offloads(socket: &Socket) -> io::Result<()> {
    switch_on(socket, libc::SOL_PACKET, PACKET_VNET_HDR)
}

/// Keeps frames that leave from the socket, before any filter is asked; an older kernel says no.
pub fn ignore_outgoing(socket: &Socket) -> io::Result<()> {
    switch_on(socket, libc::SOL_PACKET, PACKET_IGNORE_OUTGOING)
}

/// Takes in what is for others, too, as long as the socket is open.
pub fn hear_everything(socket: &Socket, interface: libc::c_int) -> io::Result<()> {
    let everything = libc::packet_mreq {
        mr_ifindex: interface,
        mr_type: libc::PACKET_MR_PROMISC as u16,
        mr_alen: 0,
        mr_address: [0; 8],
    };
    set(socket, libc::SOL_PACKET, libc::PACKET_ADD_MEMBERSHIP, &everything)
}

fn switch_on(socket: &Socket, level: libc::c_int, option: libc::c_int) -> io::Result<()> {
    set(socket, level, option, &1i32)
}

/// Sets an option whose value this is.
pub fn set<T>(socket: &Socket, level: libc::c_int, option: libc::c_int, value: &T) -> io::Result<()> {
    let (value, length) = (core::ptr::from_ref(value).cast(), size_of::<T>() as libc::socklen_t);
    // SAFETY: the kernel reads at most the `size_of::<T>()` bytes that `value` refers to.
    let result = unsafe { libc::setsockopt(socket.as_raw_fd(), level, option, value, length) };
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Sends a frame without blocking.
#[inline]
pub fn send(socket: &Socket, frame: &[u8]) -> Result<(), i32> {
    // SAFETY: pointer and length are of one slice, which is alive for the call.
    let sent =
        unsafe { libc::send(socket.as_raw_fd(), frame.as_ptr().cast(), frame.len(), libc::MSG_DONTWAIT) };
    if sent < 0 { Err(errno()) } else { Ok(()) }
}

/// What was received.
pub struct Received {
    /// The kernel's stamp, CLOCK_REALTIME in nanoseconds, if it gave one.
    pub stamp: Option<u64>,
    /// Bytes of the frame as far as they fitted the room for them.
    pub len: usize,
    /// The frame was longer than that.
    pub truncated: bool,
}

/// Why there is no frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Nothing {
    /// None waits.
    Empty,
    /// The kernel had one, and no words for what was left to do of it (before Linux 6.2: UDP that is to be cut).
    Unreadable,
}

/// Receives a frame into `buf` without blocking; `None` when none waits. What the kernel has to say to the socket
/// instead, such as once ENETDOWN, is gone with the call too, so that nobody who waits is woken by it again.
#[inline]
pub fn receive(socket: &Socket, buf: &mut Buf) -> Option<Received> {
    let received = receive_parts(socket, &mut [IoSliceMut::new(buf.room_mut())]).ok()?;
    buf.set_len(received.len.min(ROOM));
    Some(received)
}

/// The same by a socket that shows offloads, which come first: what `buf` has no room for is in `rest`.
#[inline]
pub fn receive_offloaded(
    socket: &Socket,
    offload: &mut Offload,
    buf: &mut Buf,
    rest: &mut [u8],
) -> Result<Received, Nothing> {
    let parts = [offload.as_mut_bytes(), buf.room_mut(), rest];
    let received = receive_parts(socket, &mut parts.map(IoSliceMut::new))?;
    let len = received.len.saturating_sub(offload::HEADER_LEN);
    buf.set_len(len.min(ROOM));
    Ok(Received { len, ..received })
}

/// Receives into parts one behind the other.
#[inline]
fn receive_parts(socket: &Socket, parts: &mut [IoSliceMut<'_>]) -> Result<Received, Nothing> {
    let mut room: ControlRoom = [0; 8];
    // SAFETY: all-zero is a valid msghdr.
    let mut message: libc::msghdr = unsafe { core::mem::zeroed() };
    // An `IoSliceMut` is laid out as an iovec.
    message.msg_iov = parts.as_mut_ptr().cast();
    message.msg_iovlen = parts.len() as _;
    message.msg_control = room.as_mut_ptr().cast();
    message.msg_controllen = size_of::<ControlRoom>() as _;
    // SAFETY: the message's parts are exclusive slices with their true lengths, and `room` is this function's; all outlive
    // the call, and nothing else refers to them meanwhile.
    let len = unsafe { libc::recvmsg(socket.as_raw_fd(), &mut message, libc::MSG_DONTWAIT) };
    let Ok(len) = usize::try_from(len) else {
        return Err(if errno() == libc::EINVAL { Nothing::Unreadable } else { Nothing::Empty });
    };
    Ok(Received { stamp: stamp_of(&message), len, truncated: message.msg_flags & libc::MSG_TRUNC != 0 })
}

/// The time stamp among the control messages that the kernel wrote.
fn stamp_of(message: &libc::msghdr) -> Option<u64> {
    // SAFETY: `message` was filled by recvmsg, so its control messages are well formed, and the room
    // they lie in is alive: the caller's. CMSG_NXTHDR stays within it.
    unsafe {
        let mut header = libc::CMSG_FIRSTHDR(message);
        while !header.is_null() {
            if ((*header).cmsg_level, (*header).cmsg_type) == (libc::SOL_SOCKET, libc::SCM_TIMESTAMPNS) {
                let at: libc::timespec = core::ptr::read_unaligned(libc::CMSG_DATA(header).cast());
                return Some(at.tv_sec as u64 * 1_000_000_000 + at.tv_nsec as u64);
            }
            header = libc::CMSG_NXTHDR(message, header);
        }
    }
    None
}

/// How many frames the kernel dropped since the last call because the socket's queue or ring was full.
pub fn take_dropped(socket: &impl AsRawFd) -> io::Result<u64> {
    // Sockets without a ring of version 3 fill the first two only.
    let mut stats = libc::tpacket_stats_v3 { tp_packets: 0, tp_drops: 0, tp_freeze_q_cnt: 0 };
    let mut len = size_of::<libc::tpacket_stats_v3>() as libc::socklen_t;
    // SAFETY: the kernel writes at most `len` bytes to `stats`, which has them.
    let result = unsafe {
        libc::getsockopt(
            socket.as_raw_fd(),
            libc::SOL_PACKET,
            libc::PACKET_STATISTICS,
            (&raw mut stats).cast(),
            &raw mut len,
        )
    };
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(stats.tp_drops.into()) }
}

/// Waits until one of them can be read, or so many nanoseconds; tells which can, the first by the lowest bit.
pub fn wait_any<'a>(waited_for: impl Iterator<Item = BorrowedFd<'a>>, at_most: Option<True>) -> u8 {
    let entry = |fd: BorrowedFd<'_>| libc::pollfd { fd: fd.as_raw_fd(), events: libc::POLLIN, revents: 0 };
    let mut entries: arrayvec::ArrayVec<libc::pollfd, 8> = waited_for.take(8).map(entry).collect();
    let at_most = at_most.map(timespec);
    let at_most = at_most.as_ref().map_or(core::ptr::null(), core::ptr::from_ref);
    // SAFETY: pointer and count are of one live array; `at_most` is null or outlives the call, and no signal mask is given.
    let found = unsafe {
        libc::ppoll(entries.as_mut_ptr(), entries.len() as libc::nfds_t, at_most, core::ptr::null())
    };
    if found <= 0 {
        return 0;
    }
    entries.iter().rev().fold(0, |bits, entry| bits << 1 | u8::from(entry.revents != 0))
}

fn errno() -> i32 {
    io::Error::last_os_error().raw_os_error().unwrap_or(0)
}
