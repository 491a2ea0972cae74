//! The packet filter of the receiving sockets.

use std::io;

use socket2::{SockFilter, Socket};

// Classic BPF, as linux/filter.h and linux/bpf_common.h number it.
const LOAD_WORD_ABSOLUTE: u16 = 0x20;
const JUMP_IF_GREATER: u16 = 0x25;
const RETURN: u16 = 0x06;
/// The word at this offset is the packet's type: to this host 0, broadcast 1, multicast 2, to others 3,
/// outgoing 4.
const PACKET_TYPE: u32 = (-0x1000i32 + 4) as u32;
const MULTICAST: u32 = 2;
const WHOLE: u32 = u32::MAX;
const NOTHING: u32 = 0;

/// Lets only frames to this host or to groups through, so that what a bridge floods or a promiscuous
/// interface picks up wakes nobody and fills nobody's buffer. Broadcasts inside a tunnel pass: they are for the
/// station's VNIC, whether or not it has one.
pub fn accept_only_ours(socket: &Socket) -> io::Result<()> {
    socket.attach_filter(&[
        SockFilter::new(LOAD_WORD_ABSOLUTE, 0, 0, PACKET_TYPE),
        SockFilter::new(JUMP_IF_GREATER, 1, 0, MULTICAST),
        SockFilter::new(RETURN, 0, 0, WHOLE),
        SockFilter::new(RETURN, 0, 0, NOTHING),
    ])
}
