//! AF_PACKET sockets: what socket2 does not have, one unsafe system call each.

use std::io;
use std::os::fd::AsRawFd;

use socket2::{Domain, SockAddr, Socket, Type};

use super::clock::timespec;
use crate::buf::{Buf, ROOM};
use crate::clock::True;

/// Room for the control message of one time stamp, aligned as the kernel wants it.
type StampRoom = [u64; 8];

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
    let on = 1i32;
    // SAFETY: `on` is alive for the call, and its true size is passed.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_TIMESTAMPNS,
            (&raw const on).cast(),
            size_of_val(&on) as libc::socklen_t,
        )
    };
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
    /// The frame was longer than a buffer.
    pub truncated: bool,
}

/// Receives a frame into `buf` without blocking; `None` when none waits. What the kernel has to say to the socket
/// instead, such as once ENETDOWN, is gone with the call too, so that nobody who waits is woken by it again.
#[inline]
pub fn receive(socket: &Socket, buf: &mut Buf) -> Option<Received> {
    let mut room: StampRoom = [0; 8];
    let mut part = libc::iovec { iov_base: buf.room_mut().as_mut_ptr().cast(), iov_len: ROOM };
    // SAFETY: all-zero is a valid msghdr.
    let mut message: libc::msghdr = unsafe { core::mem::zeroed() };
    message.msg_iov = &mut part;
    message.msg_iovlen = 1;
    message.msg_control = room.as_mut_ptr().cast();
    message.msg_controllen = size_of::<StampRoom>() as _;
    // SAFETY: the message's parts point to `buf`'s room and to `room`, with their true lengths; both
    // outlive the call, and nothing else refers to them meanwhile.
    let len = unsafe { libc::recvmsg(socket.as_raw_fd(), &mut message, libc::MSG_DONTWAIT) };
    let len = usize::try_from(len).ok()?;
    buf.set_len(len.min(ROOM));
    let truncated = message.msg_flags & libc::MSG_TRUNC != 0;
    Some(Received { stamp: stamp_of(&message), truncated })
}

/// Finds the time stamp among the control messages that the kernel wrote.
fn stamp_of(message: &libc::msghdr) -> Option<u64> {
    // SAFETY: `message` was filled by recvmsg, so its control messages are well formed, and the room
    // they lie in is alive: the caller's. CMSG_NXTHDR stays within it.
    unsafe {
        let mut header = libc::CMSG_FIRSTHDR(message);
        while !header.is_null() {
            if (*header).cmsg_level == libc::SOL_SOCKET && (*header).cmsg_type == libc::SCM_TIMESTAMPNS {
                let stamp: libc::timespec = core::ptr::read_unaligned(libc::CMSG_DATA(header).cast());
                return Some(stamp.tv_sec as u64 * 1_000_000_000 + stamp.tv_nsec as u64);
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

/// Waits until one of the sockets has a frame, or so many nanoseconds.
pub fn wait_any<'a>(sockets: impl Iterator<Item = &'a Socket>, at_most: True) {
    let entry = |socket: &Socket| libc::pollfd { fd: socket.as_raw_fd(), events: libc::POLLIN, revents: 0 };
    let mut entries: arrayvec::ArrayVec<libc::pollfd, 8> = sockets.take(8).map(entry).collect();
    let at_most = timespec(at_most);
    // SAFETY: pointer and count are of one live array; `at_most` outlives the call, and no signal mask is given.
    unsafe {
        libc::ppoll(entries.as_mut_ptr(), entries.len() as libc::nfds_t, &at_most, core::ptr::null());
    }
}

fn errno() -> i32 {
    io::Error::last_os_error().raw_os_error().unwrap_or(0)
}
