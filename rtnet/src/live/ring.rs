//! A passive observer: the kernel writes every frame of one interface, with its own receive stamp,
//! into memory shared with it, and wakes nobody for it.
//!
//! ```text
//!   ring   +---------+---------+---------+---------+   the kernel fills block after block and gives
//!          | block 0 | block 1 |   ...   | block n |   one away when it is full or `retire` is over
//!          +---------+---------+---------+---------+
//!   block  | tpacket_block_desc | tpacket3_hdr ~ frame | tpacket3_hdr ~ frame | ... free ...
//!            num_pkts,            tp_mac: header to frame
//!            offset_to_first_pkt  tp_next_offset: header to next header
//! ```
//!
//! Layout and life cycle: the kernel's `Documentation/networking/packet_mmap.rst`, TPACKET_V3.

#![allow(unsafe_code)] // the mapping, its hand-over, and socket options that nix does not have

use std::io;
use std::mem::{offset_of, size_of};
use std::os::fd::{AsFd, AsRawFd};
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use libc::{c_int, c_uint, sockaddr_ll, tpacket_block_desc, tpacket_hdr_v1, tpacket3_hdr};
use nix::errno::Errno;
use nix::net::if_::if_nametoindex;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;
use socket2::{Domain, Socket, Type};

use super::{packet, rights};

/// Nominal only: in version 3 frames take what they need, but the request has to add up.
const FRAME_BYTES: u32 = 2048;

const VLAN_TAG: usize = 4;
const ETHER_ADDRESSES: usize = 12;
const ETH_P_8021Q: u16 = libc::ETH_P_8021Q as u16;

const STATUS: usize = offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, block_status);
const COUNT: usize = offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, num_pkts);
const FIRST: usize = offset_of!(tpacket_block_desc, hdr) + offset_of!(tpacket_hdr_v1, offset_to_first_pkt);
const VLAN_TCI: usize = offset_of!(tpacket3_hdr, hv1) + offset_of!(libc::tpacket_hdr_variant1, tp_vlan_tci);
const VLAN_TPID: usize = offset_of!(tpacket3_hdr, hv1) + offset_of!(libc::tpacket_hdr_variant1, tp_vlan_tpid);

// What the kernel's header says, on every architecture.
const _: () = assert!(size_of::<tpacket_block_desc>() == 48 && size_of::<tpacket3_hdr>() == 48);
const _: () = assert!(STATUS == 8 && COUNT == 12 && FIRST == 16);

/// The size of a [`CaptureRing`]. All of it is allocated when the ring is opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RingConfig {
    /// Bytes per block, a multiple of the page size; the longest frame that is kept whole is a few
    /// hundred bytes shorter.
    pub block_bytes: u32,
    /// Blocks in the ring. What arrives while all wait to be drained is dropped, and counted.
    pub blocks: u32,
    /// About the oldest that a frame gets before it can be drained; a block that fills earlier is
    /// given away earlier. Whole milliseconds, at least one.
    pub retire: Duration,
}

impl Default for RingConfig {
    /// 64 blocks of 256 KiB, 20 ms: at 100 Mbit/s of shortest frames, over half a second.
    fn default() -> Self {
        Self { block_bytes: 256 << 10, blocks: 64, retire: Duration::from_millis(20) }
    }
}

/// A frame as it lies in the ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Captured<'a> {
    /// When the kernel received it: CLOCK_REALTIME, nanoseconds.
    pub realtime_ns: u64,
    /// The frame from its destination address on, a VLAN tag included, without the checksum; cut off
    /// if it was too long for a block.
    pub bytes: &'a [u8],
    /// Bytes of the whole frame: more than `bytes` has if it was cut off.
    pub wire_len: usize,
    /// The ring was full before this frame: frames between the one before and this one may be lost. Stays true for
    /// later blocks until [`CaptureRing::dropped`] is read.
    pub after_loss: bool,
}

/// Everything that one interface receives. Needs CAP_NET_RAW.
#[derive(Debug)]
pub struct CaptureRing {
    interface: String,
    socket: Socket,
    mapping: Mapping,
    block_bytes: usize,
    blocks: usize,
    next: usize,
    dropped: u64,
    unreadable: u64,
}

impl CaptureRing {
    /// Observes `interface` of the calling thread's network namespace, promiscuously, and its
    /// received frames only: on a bridge or a loopback each passes once.
    ///
    /// # Errors
    /// No such interface, it is down, no CAP_NET_RAW, sizes the kernel refuses, no memory. All name
    /// the interface.
    pub fn open(interface: &str, config: RingConfig) -> io::Result<Self> {
        let failed = |what: &'static str| move |error| named(interface, what, error);
        let index = if_nametoindex(interface).map_err(|e| failed("cannot find it")(e.into()))? as c_int;
        let bytes = (config.block_bytes as usize)
            .checked_mul(config.blocks as usize)
            .ok_or_else(|| failed("cannot make a ring")(io::ErrorKind::InvalidInput.into()))?;

        // Protocol 0: until it is bound, the socket would hear every interface.
        let socket = Socket::new(Domain::PACKET, Type::RAW, None)
            .map_err(|error| named(interface, &no_socket(), error))?;
        let version = libc::tpacket_versions::TPACKET_V3 as c_int;
        packet::set(&socket, libc::SOL_PACKET, libc::PACKET_VERSION, &version)
            .map_err(failed("no TPACKET_V3"))?;
        // Room to put a VLAN tag back where the kernel took it out.
        packet::set(&socket, libc::SOL_PACKET, libc::PACKET_RESERVE, &(VLAN_TAG as c_uint))
            .map_err(failed("no PACKET_RESERVE"))?;
        packet::set(&socket, libc::SOL_PACKET, libc::PACKET_IGNORE_OUTGOING, &1_i32)
            .map_err(failed("no PACKET_IGNORE_OUTGOING"))?;
        packet::set(&socket, libc::SOL_PACKET, libc::PACKET_RX_RING, &request(&config))
            .map_err(failed("cannot make a ring of this size"))?;
        let mapping = Mapping::new(&socket, bytes).map_err(failed("cannot map the ring"))?;
        packet::hear_everything(&socket, index).map_err(failed("cannot be promiscuous"))?;
        bind(&socket, index).map_err(failed("cannot bind to it"))?;
        // This is how the kernel says that the interface is down.
        if let Some(error) = socket.take_error()? {
            return Err(failed("cannot observe it")(error));
        }
        Ok(Self {
            interface: interface.to_owned(),
            socket,
            mapping,
            block_bytes: config.block_bytes as usize,
            blocks: config.blocks as usize,
            next: 0,
            dropped: 0,
            unreadable: 0,
        })
    }

    /// Hands over the frames of all blocks that the kernel has given away, oldest first, and returns
    /// how many. Never blocks, and goes round the ring once at most. To see what was sent until now,
    /// call it again after twice `retire`.
    pub fn drain(&mut self, mut f: impl FnMut(Captured<'_>)) -> usize {
        let mut frames = 0;
        for _ in 0..self.blocks {
            let start = self.mapping.block(self.next, self.block_bytes);
            // SAFETY: `start` is page-aligned, so that the status is aligned, and lies in the mapping,
            // which outlives this. The kernel's accesses to this word are atomic, and nobody here
            // makes other ones while the reference lives.
            let status = unsafe { AtomicU32::from_ptr(start.as_ptr().add(STATUS).cast()) };
            // Acquire: what the kernel wrote before giving the block away is seen after.
            let status = status.load(Ordering::Acquire);
            if status & libc::TP_STATUS_USER == 0 {
                break;
            }
            // SAFETY: the block's `block_bytes` lie in the mapping and were initialised by the kernel,
            // which does not write there until it is given the block back below; `&mut self` keeps
            // out everyone else, and the slice is no longer used then.
            let block = unsafe { std::slice::from_raw_parts_mut(start.as_ptr(), self.block_bytes) };
            let (read, whole) = walk(block, status & libc::TP_STATUS_LOSING != 0, &mut f);
            frames += read;
            self.unreadable += u64::from(!whole);
            // SAFETY: as above; the slice is no longer used.
            let status = unsafe { AtomicU32::from_ptr(start.as_ptr().add(STATUS).cast()) };
            // Release: nothing of the block is touched once the kernel may have it.
            status.store(libc::TP_STATUS_KERNEL, Ordering::Release);
            self.next = (self.next + 1) % self.blocks;
        }
        frames
    }

    /// Waits until a block can be drained, `timeout` at most; whether one can. False too if a
    /// signal came.
    ///
    /// # Errors
    /// The interface went down or away; the kernel says so once. Names it.
    pub fn wait(&self, timeout: Duration) -> io::Result<bool> {
        let mut ready = [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN)];
        match ppoll(&mut ready, Some(TimeSpec::from_duration(timeout)), None) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(error) => return Err(named(&self.interface, "cannot wait for frames", error.into())),
        }
        let events = ready[0].revents().unwrap_or(PollFlags::empty());
        if events.contains(PollFlags::POLLERR)
            && let Some(error) = self.socket.take_error()?
        {
            return Err(named(&self.interface, "no longer observed", error));
        }
        Ok(events.contains(PollFlags::POLLIN))
    }

    /// Frames lost because the ring was full, since it was opened.
    ///
    /// # Errors
    /// The kernel refuses its statistics. Names the interface.
    pub fn dropped(&mut self) -> io::Result<u64> {
        let newly = packet::take_dropped(&self.socket);
        self.dropped += newly.map_err(|e| named(&self.interface, "no statistics", e))?;
        Ok(self.dropped)
    }

    /// Blocks left early because a count or an offset did not fit, since the ring was opened. More
    /// than 0 is a bug, here or in the kernel; frames are missing then.
    pub fn unreadable(&self) -> u64 {
        self.unreadable
    }
}

/// Hands over the frames of one block, the first of them marked if frames before it may be lost. Returns how many, and
/// whether those were all it promises.
fn walk(block: &mut [u8], after_loss: bool, f: &mut impl FnMut(Captured<'_>)) -> (usize, bool) {
    let (Some(count), Some(first)) = (u32_at(block, COUNT), u32_at(block, FIRST)) else {
        return (0, false);
    };
    let mut rest = block.get_mut(first as usize..);
    for read in 0..count as usize {
        let Some((header, step)) = rest.and_then(|packet| {
            let step = u32_at(packet, offset_of!(tpacket3_hdr, tp_next_offset))? as usize;
            Some((packet, step))
        }) else {
            return (read, false);
        };
        let Some(frame) = captured(header) else { return (read, false) };
        f(Captured { after_loss: after_loss && read == 0, ..frame });
        // 0 is the last one's.
        rest = if step == 0 { None } else { header.get_mut(step..) };
    }
    (count as usize, true)
}

/// The frame behind the header that `packet` begins with; None if it does not lie within `packet`.
fn captured(packet: &mut [u8]) -> Option<Captured<'_>> {
    let seconds = u32_at(packet, offset_of!(tpacket3_hdr, tp_sec))?;
    let nanos = u32_at(packet, offset_of!(tpacket3_hdr, tp_nsec))?;
    let status = u32_at(packet, offset_of!(tpacket3_hdr, tp_status))?;
    let mut wire_len = u32_at(packet, offset_of!(tpacket3_hdr, tp_len))? as usize;
    let length = u32_at(packet, offset_of!(tpacket3_hdr, tp_snaplen))? as usize;
    let mut start = usize::from(u16_at(packet, offset_of!(tpacket3_hdr, tp_mac))?);
    let end = start.checked_add(length)?;
    if start < size_of::<tpacket3_hdr>() {
        return None;
    }
    if status & libc::TP_STATUS_VLAN_VALID != 0 && length >= ETHER_ADDRESSES {
        let tci = u32_at(packet, VLAN_TCI)? as u16;
        let announced = status & libc::TP_STATUS_VLAN_TPID_VALID != 0;
        let tpid = if announced { u16_at(packet, VLAN_TPID)? } else { ETH_P_8021Q };
        let untagged = start;
        start = start.checked_sub(VLAN_TAG).filter(|&s| s >= size_of::<tpacket3_hdr>())?;
        let room = packet.get_mut(start..end)?;
        room.copy_within(untagged - start..untagged - start + ETHER_ADDRESSES, 0);
        room[ETHER_ADDRESSES..][..2].copy_from_slice(&tpid.to_be_bytes());
        room[ETHER_ADDRESSES + 2..][..2].copy_from_slice(&tci.to_be_bytes());
        wire_len += VLAN_TAG;
    }
    let realtime_ns = u64::from(seconds) * 1_000_000_000 + u64::from(nanos);
    Some(Captured { realtime_ns, bytes: packet.get(start..end)?, wire_len, after_loss: false })
}

fn u32_at(bytes: &[u8], offset: usize) -> Option<u32> {
    bytes.get(offset..)?.first_chunk().map(|&b| u32::from_ne_bytes(b))
}

fn u16_at(bytes: &[u8], offset: usize) -> Option<u16> {
    bytes.get(offset..)?.first_chunk().map(|&b| u16::from_ne_bytes(b))
}

fn request(config: &RingConfig) -> libc::tpacket_req3 {
    let retire = config.retire.as_millis().clamp(1, u128::from(u16::MAX)) as c_uint;
    libc::tpacket_req3 {
        tp_block_size: config.block_bytes,
        tp_block_nr: config.blocks,
        tp_frame_size: FRAME_BYTES,
        // The kernel checks that it adds up: too much for 32 bits is refused there.
        tp_frame_nr: (config.block_bytes / FRAME_BYTES).wrapping_mul(config.blocks),
        tp_retire_blk_tov: retire,
        tp_sizeof_priv: 0,
        tp_feature_req_word: 0,
    }
}

fn bind(socket: &Socket, interface: c_int) -> io::Result<()> {
    let address = sockaddr_ll {
        sll_family: libc::AF_PACKET as u16,
        sll_protocol: (libc::ETH_P_ALL as u16).to_be(),
        sll_ifindex: interface,
        sll_hatype: 0,
        sll_pkttype: 0,
        sll_halen: 0,
        sll_addr: [0; 8],
    };
    let length = size_of::<sockaddr_ll>() as libc::socklen_t;
    // SAFETY: the kernel reads `length` bytes of `address`, which has them.
    let result = unsafe { libc::bind(socket.as_raw_fd(), (&raw const address).cast(), length) };
    Ok(Errno::result(result).map(drop)?)
}

/// Without the right to one, or without descriptors or memory for it.
fn no_socket() -> String {
    format!("cannot open a packet socket ({})", rights::remedy(&["CAP_NET_RAW"]))
}

fn named(interface: &str, what: &str, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{interface}: {what}: {error}"))
}

/// The ring in this process's memory.
#[derive(Debug)]
struct Mapping {
    start: NonNull<u8>,
    bytes: usize,
}

// SAFETY: the mapping belongs to the process, not to a thread; only this value knows its address.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(socket: &Socket, bytes: usize) -> io::Result<Self> {
        let (access, fd) = (libc::PROT_READ | libc::PROT_WRITE, socket.as_raw_fd());
        // SAFETY: the kernel chooses the address, so that no other mapping is replaced.
        let start = unsafe { libc::mmap(ptr::null_mut(), bytes, access, libc::MAP_SHARED, fd, 0) };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        let start = NonNull::new(start.cast()).ok_or(io::ErrorKind::AddrNotAvailable)?;
        Ok(Self { start, bytes })
    }

    /// Where a block begins.
    fn block(&self, index: usize, block_bytes: usize) -> NonNull<u8> {
        let offset = index * block_bytes;
        assert!(offset + block_bytes <= self.bytes, "block {index} is not in the ring");
        // SAFETY: just checked that the offset lies in the mapping.
        unsafe { self.start.add(offset) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by `new` with this length, and nothing borrowed from it is left.
        unsafe { libc::munmap(self.start.as_ptr().cast(), self.bytes) };
    }
}

#[cfg(test)]
pub(super) mod tests;
