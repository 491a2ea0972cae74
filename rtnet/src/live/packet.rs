//! AF_PACKET sockets: what socket2 does not have, one unsafe system call each.

use std::io;
use std::os::fd::{AsRawFd, BorrowedFd};

use socket2::{Domain, SockAddr, Socket, Type};

use super::clock::timespec;
use crate::buf::{Buf, ROOM};
use crate::clock::True;

/// Room for the control messages of a time stamp and of what else the kernel tells of a frame, aligned as it wants them.
type ControlRoom = [u64; 12];
// As linux/if_packet.h numbers them, which libc does not.
const PACKET_AUXDATA: libc::c_int = 8;
/// Since Linux 4.20.
const PACKET_IGNORE_OUTGOING: libc::c_int = 23;
const TP_STATUS_CSUMNOTREADY: u32 = 1 << 3;

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

/// Lets the kernel tell of each frame whether its sender has left the checksum to a card that it came by none of.
pub fn tell_of_checksums(socket: &Socket) -> io::Result<()> {
    switch_on(socket, libc::SOL_PACKET, PACKET_AUXDATA)
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
    /// The frame was longer than a buffer.
    pub truncated: bool,
    /// Its checksum is not there: who sent it left that to a card, and it came by none.
    pub without_checksum: bool,
}

/// Receives a frame into `buf` without blocking; `None` when none waits. What the kernel has to say to the socket
/// instead, such as once ENETDOWN, is gone with the call too, so that nobody who waits is woken by it again.
#[inline]
pub fn receive(socket: &Socket, buf: &mut Buf) -> Option<Received> {
    let mut room: ControlRoom = [0; 12];
    let mut part = libc::iovec { iov_base: buf.room_mut().as_mut_ptr().cast(), iov_len: ROOM };
    // SAFETY: all-zero is a valid msghdr.
    let mut message: libc::msghdr = unsafe { core::mem::zeroed() };
    message.msg_iov = &mut part;
    message.msg_iovlen = 1;
    message.msg_control = room.as_mut_ptr().cast();
    message.msg_controllen = size_of::<ControlRoom>() as _;
    // SAFETY: the message's parts point to `buf`'s room and to `room`, with their true lengths; both
    // outlive the call, and nothing else refers to them meanwhile.
    let len = unsafe { libc::recvmsg(socket.as_raw_fd(), &mut message, libc::MSG_DONTWAIT) };
    let len = usize::try_from(len).ok()?;
    buf.set_len(len.min(ROOM));
    let truncated = message.msg_flags & libc::MSG_TRUNC != 0;
    let (stamp, without_checksum) = told_of(&message);
    Some(Received { stamp, truncated, without_checksum })
}

/// What the control messages say that the kernel wrote: the time stamp, and whether the checksum is missing.
fn told_of(message: &libc::msghdr) -> (Option<u64>, bool) {
    let (mut stamp, mut without_checksum) = (None, false);
    // SAFETY: `message` was filled by recvmsg, so its control messages are well formed, and the room
    // they lie in is alive: the caller's. CMSG_NXTHDR stays within it.
    unsafe {
        let mut header = libc::CMSG_FIRSTHDR(message);
        while !header.is_null() {
            match ((*header).cmsg_level, (*header).cmsg_type) {
                (libc::SOL_SOCKET, libc::SCM_TIMESTAMPNS) => {
                    let at: libc::timespec = core::ptr::read_unaligned(libc::CMSG_DATA(header).cast());
                    stamp = Some(at.tv_sec as u64 * 1_000_000_000 + at.tv_nsec as u64);
                }
                (libc::SOL_PACKET, PACKET_AUXDATA) => {
                    // Its first field is the frame's status.
                    let status: u32 = core::ptr::read_unaligned(libc::CMSG_DATA(header).cast());
                    without_checksum = status & TP_STATUS_CSUMNOTREADY != 0;
                }
                _ => {}
            }
            header = libc::CMSG_NXTHDR(message, header);
        }
    }
    (stamp, without_checksum)
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
