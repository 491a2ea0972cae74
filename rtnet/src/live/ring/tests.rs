use std::net::UdpSocket;
use std::time::Instant;

use nix::sched::{CloneFlags, unshare};
use nix::time::{ClockId, clock_gettime};

use super::*;

const BLOCK: usize = 4096;
const FRAME: [u8; 60] = [0x5a; 60];

fn put(block: &mut [u8], offset: usize, value: u32) {
    block[offset..][..4].copy_from_slice(&value.to_ne_bytes());
}

/// A block of `frames` frames, the headers at 48, 304, ...
fn block(frames: u32) -> Vec<u8> {
    let mut block = vec![0; BLOCK];
    put(&mut block, COUNT, frames);
    put(&mut block, FIRST, size_of::<tpacket_block_desc>() as u32);
    for i in 0..frames {
        let packet = &mut block[size_of::<tpacket_block_desc>() + 256 * i as usize..];
        put(packet, offset_of!(tpacket3_hdr, tp_next_offset), if i + 1 < frames { 256 } else { 0 });
        put(packet, offset_of!(tpacket3_hdr, tp_sec), 7);
        put(packet, offset_of!(tpacket3_hdr, tp_nsec), i);
        put(packet, offset_of!(tpacket3_hdr, tp_snaplen), FRAME.len() as u32);
        put(packet, offset_of!(tpacket3_hdr, tp_len), 1514);
        packet[offset_of!(tpacket3_hdr, tp_mac)..][..2].copy_from_slice(&86_u16.to_ne_bytes());
        packet[86..][..FRAME.len()].copy_from_slice(&FRAME);
    }
    block
}

#[test]
fn frames_of_a_block_come_in_order_and_say_that_they_were_cut_off() {
    let mut stamps = Vec::new();
    let result = walk(&mut block(3), false, &mut |frame| {
        assert_eq!((frame.bytes, frame.wire_len), (&FRAME[..], 1514));
        stamps.push(frame.realtime_ns);
    });
    assert_eq!((result, stamps), ((3, true), vec![7_000_000_000, 7_000_000_001, 7_000_000_002]));
}

#[test]
fn a_count_or_an_offset_that_does_not_fit_ends_the_block() {
    let second = size_of::<tpacket_block_desc>() + 256;
    let next = second + offset_of!(tpacket3_hdr, tp_next_offset);
    let snaplen = second + offset_of!(tpacket3_hdr, tp_snaplen);
    let mac = second + offset_of!(tpacket3_hdr, tp_mac);
    for (offset, value, frames) in [
        (COUNT, 4, 3),
        (COUNT, u32::MAX, 3),
        (FIRST, BLOCK as u32, 0),
        (FIRST, BLOCK as u32 - 8, 0),
        (FIRST, u32::MAX, 0),
        (next, 0, 2),
        (next, BLOCK as u32 - 8, 2),
        (next, u32::MAX, 2),
        (snaplen, BLOCK as u32, 1),
        (snaplen, u32::MAX, 1),
        (mac, 0, 1),
        (mac, u32::MAX, 1),
    ] {
        let mut block = block(3);
        put(&mut block, offset, value);
        assert_eq!(walk(&mut block, false, &mut |_| ()), (frames, false), "{value} at {offset}");
    }
    assert_eq!(walk(&mut [0; 8], false, &mut |_| ()), (0, false));
}

#[test]
fn a_vlan_tag_is_put_back() {
    let mut block = block(1);
    let packet = &mut block[size_of::<tpacket_block_desc>()..];
    put(packet, offset_of!(tpacket3_hdr, tp_status), libc::TP_STATUS_VLAN_VALID);
    put(packet, VLAN_TCI, 0xe064);
    let expected = [&FRAME[..12], &[0x81, 0, 0xe0, 0x64], &FRAME[12..]].concat();
    let result = walk(&mut block, false, &mut |frame| {
        assert_eq!((frame.bytes, frame.wire_len), (&expected[..], 1518));
    });
    assert_eq!(result, (1, true));
    let packet = &mut block[size_of::<tpacket_block_desc>()..];
    // No room for a tag between header and frame.
    put(packet, offset_of!(tpacket3_hdr, tp_mac), size_of::<tpacket3_hdr>() as u32 + 3);
    assert_eq!(walk(&mut block, false, &mut |_| ()), (0, false));
}

fn realtime_ns() -> u64 {
    let now = clock_gettime(ClockId::CLOCK_REALTIME).unwrap();
    now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64
}

/// Sets the loopback of the calling thread's namespace up or down.
pub fn loopback_up(up: bool) {
    let socket = UdpSocket::bind("0.0.0.0:0").unwrap();
    // SAFETY: all zeros is a valid `ifreq`.
    let mut request: libc::ifreq = unsafe { std::mem::zeroed() };
    request.ifr_name[..2].copy_from_slice(&[b'l' as _, b'o' as _]);
    request.ifr_ifru.ifru_flags = if up { libc::IFF_UP as _ } else { 0 };
    // SAFETY: SIOCSIFFLAGS reads an `ifreq`, which this is.
    let result = unsafe { libc::ioctl(socket.as_raw_fd(), libc::SIOCSIFFLAGS, &raw mut request) };
    Errno::result(result).unwrap();
}

/// Runs `f` in a network namespace of its own, with lo up.
pub fn in_a_namespace(f: impl FnOnce() + Send) {
    if !nix::unistd::geteuid().is_root() {
        let _ = std::io::Write::write_all(&mut std::io::stderr(), b"SKIP: needs root (CAP_NET_RAW)\n");
        return;
    }
    let run = || {
        unshare(CloneFlags::CLONE_NEWNET).unwrap();
        loopback_up(true);
        f();
    };
    std::thread::scope(|scope| scope.spawn(run).join()).unwrap();
}

fn config(retire_ms: u64) -> RingConfig {
    RingConfig { block_bytes: 16 << 10, blocks: 4, retire: Duration::from_millis(retire_ms) }
}

#[test]
fn every_datagram_on_a_loopback_is_seen_once_with_the_kernels_stamp() {
    in_a_namespace(|| {
        const DATAGRAMS: u16 = 200;
        let mut ring = CaptureRing::open("lo", RingConfig::default()).unwrap();
        assert!(!ring.wait(Duration::from_millis(1)).unwrap());
        let [sender, receiver] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        let sent_from = realtime_ns();
        for i in 0..DATAGRAMS {
            sender.send_to(&i.to_be_bytes(), receiver.local_addr().unwrap()).unwrap();
        }
        let sent_until = realtime_ns();
        let (mut numbers, mut stamps) = (Vec::new(), vec![sent_from]);
        while numbers.len() < usize::from(DATAGRAMS) && ring.wait(Duration::from_secs(20)).unwrap() {
            ring.drain(|frame| {
                assert_eq!((frame.wire_len, frame.bytes.len()), (44, 44)); // Ethernet, IP, UDP, 2
                numbers.push(u16::from_be_bytes([frame.bytes[42], frame.bytes[43]]));
                stamps.push(frame.realtime_ns);
            });
        }
        stamps.push(sent_until);
        assert_eq!(numbers, (0..DATAGRAMS).collect::<Vec<_>>());
        assert!(stamps.is_sorted(), "{stamps:?}");
        assert_eq!((ring.dropped().unwrap(), ring.unreadable()), (0, 0));
    });
}

#[test]
fn what_a_full_ring_drops_is_counted_and_the_ring_goes_on() {
    in_a_namespace(|| {
        const DATAGRAMS: usize = 300;
        let mut ring = CaptureRing::open("lo", config(5)).unwrap();
        let [sender, receiver] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        let (mut seen, mut last, mut dropped) = (0, 0, 0);
        let deadline = Instant::now() + Duration::from_secs(20);
        for sent in [DATAGRAMS, 2 * DATAGRAMS, 3 * DATAGRAMS] {
            for _ in 0..DATAGRAMS {
                sender.send_to(&[0; 1000], receiver.local_addr().unwrap()).unwrap();
            }
            while seen + (dropped as usize) < sent && Instant::now() < deadline {
                ring.wait(Duration::from_millis(100)).unwrap();
                seen += ring.drain(|frame| {
                    assert!(frame.realtime_ns > last && frame.bytes.len() == 1042);
                    last = frame.realtime_ns;
                });
                dropped = ring.dropped().unwrap();
            }
        }
        assert!(seen > 3 * 40 && dropped > 0, "{seen} seen, {dropped} dropped");
        assert_eq!(seen + dropped as usize, 3 * DATAGRAMS);
        assert_eq!((ring.dropped().unwrap(), ring.unreadable()), (dropped, 0));
    });
}

#[test]
fn a_tagged_frame_is_seen_as_it_was_sent() {
    in_a_namespace(|| {
        let mut ring = CaptureRing::open("lo", config(5)).unwrap();
        let sender = Socket::new(Domain::PACKET, Type::RAW, None).unwrap();
        bind(&sender, if_nametoindex("lo").unwrap() as c_int).unwrap();
        let sent = [&[0; 12][..], &[0x81, 0, 0x60, 5, 0x90, 0x21], &[9; 46]].concat();
        sender.send(&sent).unwrap();
        assert!(ring.wait(Duration::from_secs(20)).unwrap());
        let frames = ring.drain(|frame| assert_eq!((frame.bytes, frame.wire_len), (&sent[..], 64)));
        assert_eq!(frames, 1);
    });
}

#[test]
fn errors_name_the_interface() {
    in_a_namespace(|| {
        let refused = CaptureRing::open("nowhere", RingConfig::default()).unwrap_err();
        assert!(refused.to_string().starts_with("nowhere: "), "{refused}");
        let odd = RingConfig { block_bytes: 1000, ..RingConfig::default() };
        let refused = CaptureRing::open("lo", odd).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::InvalidInput, "{refused}");

        let ring = CaptureRing::open("lo", config(5)).unwrap();
        loopback_up(false);
        let refused = ring.wait(Duration::from_secs(1)).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::NetworkDown, "{refused}");
        let refused = CaptureRing::open("lo", config(5)).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::NetworkDown, "{refused}");
    });
}
