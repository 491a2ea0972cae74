//! The packet filter of the receiving sockets.

use std::io;

use socket2::{SockFilter, Socket};

use crate::wire::ethernet::EtherType;

// Classic BPF, as linux/filter.h and linux/bpf_common.h number it.
const LOAD_WORD_ABSOLUTE: u16 = 0x20;
const LOAD_HALF_ABSOLUTE: u16 = 0x28;
const LOAD_BYTE_ABSOLUTE: u16 = 0x30;
const LOAD_LENGTH: u16 = 0x80;
const JUMP_IF_EQUAL: u16 = 0x15;
const JUMP_IF_GREATER: u16 = 0x25;
const JUMP_IF_SET: u16 = 0x45;
const RETURN: u16 = 0x06;
/// The word at this offset is the packet's type: to this host 0, broadcast 1, multicast 2, to others 3,
/// outgoing 4.
const PACKET_TYPE: u32 = (-0x1000i32 + 4) as u32;
/// Not zero at this offset: the frame had a VLAN's tag, which the kernel has taken out of it.
const VLAN_TAG_PRESENT: u32 = (-0x1000i32 + 48) as u32;
const ETHER_TYPE: u32 = 12;
const TO_THIS_HOST: u32 = 0;
const MULTICAST: u32 = 2;
const TO_OTHERS: u32 = 3;
const NO_TYPE: u32 = u32::MAX;
/// RTmac's version, behind the Ethernet header and its type, and its flags; this one is of a tunnelled frame.
const VERSION: u32 = 16;
const OURS: u32 = 2;
const FLAGS: u32 = 17;
const TUNNEL: u32 = 1;
const WHOLE: u32 = u32::MAX;
const NOTHING: u32 = 0;

/// Lets only frames to this host or to groups through, so that what a bridge floods or a promiscuous
/// interface picks up wakes nobody and fills nobody's buffer.
pub fn accept_only_ours(socket: &Socket) -> io::Result<()> {
    socket.attach_filter(&[
        SockFilter::new(LOAD_WORD_ABSOLUTE, 0, 0, PACKET_TYPE),
        SockFilter::new(JUMP_IF_GREATER, 1, 0, MULTICAST),
        SockFilter::new(RETURN, 0, 0, WHOLE),
        SockFilter::new(RETURN, 0, 0, NOTHING),
    ])
}

/// The same for a socket that hears every EtherType but RTmac's, which has a socket of its own. What is of a VLAN is for
/// another network than this interface's.
pub fn accept_only_our_data(socket: &Socket) -> io::Result<()> {
    socket.attach_filter(&[
        SockFilter::new(LOAD_WORD_ABSOLUTE, 0, 0, PACKET_TYPE),
        SockFilter::new(JUMP_IF_GREATER, 5, 0, MULTICAST),
        SockFilter::new(LOAD_WORD_ABSOLUTE, 0, 0, VLAN_TAG_PRESENT),
        SockFilter::new(JUMP_IF_GREATER, 3, 0, 0),
        SockFilter::new(LOAD_HALF_ABSOLUTE, 0, 0, ETHER_TYPE),
        SockFilter::new(JUMP_IF_EQUAL, 1, 0, EtherType::RTMAC.0 as u32),
        SockFilter::new(RETURN, 0, 0, WHOLE),
        SockFilter::new(RETURN, 0, 0, NOTHING),
    ])
}

/// The same for RTmac's frames, where others' tunnels are foreign traffic, too: tunnelled frames for groups stay
/// out. One for this host alone, too short to tell, or of another version passes, and is counted as what it is.
pub fn accept_only_our_control(socket: &Socket) -> io::Result<()> {
    socket.attach_filter(&by_what_is_inside(MULTICAST, TO_THIS_HOST, [WHOLE, NOTHING]))
}

/// The same where all that is tunnelled has a socket of its own ([`accept_only_tunnelled`]).
pub fn accept_only_discipline(socket: &Socket) -> io::Result<()> {
    socket.attach_filter(&by_what_is_inside(MULTICAST, NO_TYPE, [WHOLE, NOTHING]))
}

/// Lets RTmac's frames through that have another frame inside: those to this host or to groups, or, for who forwards
/// them to others, all but its own.
pub fn accept_only_tunnelled(socket: &Socket, of_others: bool) -> io::Result<()> {
    let last = if of_others { TO_OTHERS } else { MULTICAST };
    socket.attach_filter(&by_what_is_inside(last, NO_TYPE, [NOTHING, WHOLE]))
}

/// Of frames up to the type `last` these parts: of those that have no other one inside, or are of the type `whatever`, and
/// of the others.
fn by_what_is_inside(last: u32, whatever: u32, [plain, tunnelled]: [u32; 2]) -> [SockFilter; 11] {
    // Where nothing is let through.
    let out = if plain == NOTHING { 7 } else { 8 };
    [
        SockFilter::new(LOAD_WORD_ABSOLUTE, 0, 0, PACKET_TYPE),
        SockFilter::new(JUMP_IF_GREATER, out, 0, last),
        SockFilter::new(JUMP_IF_EQUAL, 6, 0, whatever),
        SockFilter::new(LOAD_LENGTH, 0, 0, 0),
        SockFilter::new(JUMP_IF_GREATER, 0, 4, FLAGS),
        SockFilter::new(LOAD_BYTE_ABSOLUTE, 0, 0, VERSION),
        SockFilter::new(JUMP_IF_EQUAL, 0, 2, OURS),
        SockFilter::new(LOAD_BYTE_ABSOLUTE, 0, 0, FLAGS),
        SockFilter::new(JUMP_IF_SET, 1, 0, TUNNEL),
        SockFilter::new(RETURN, 0, 0, plain),
        SockFilter::new(RETURN, 0, 0, tunnelled),
    ]
}
