//! Frames to begin with, and changes of frames whose checksums are right again afterwards: else nearly none would come
//! further than those.

use rtnet::sim::Random;
use rtnet::wire::ethernet::HEADER_LEN;
use rtnet::wire::ipv4;
use tests::ends::mend;
use tests::{captures, vectors};

use super::mutate;

/// Where the fields of Ethernet, ARP, IP, UDP and ICMP begin.
const FIELDS: [usize; 20] = [0, 6, 12, 14, 15, 16, 18, 20, 22, 23, 24, 26, 28, 30, 32, 34, 36, 38, 40, 42];

/// The example frames, and what real stations sent.
pub fn all() -> Vec<Vec<u8>> {
    let captured = ["rtnet-frames.pcap", "rtnet-real.pcap", "rtnet-real-backup.pcap"];
    let captured = captured.into_iter().flat_map(captures::read).map(|frame| frame.bytes);
    vectors::all().into_iter().map(|vector| vector.bytes).chain(captured).collect()
}

/// Of these, what follows the Ethernet header.
pub fn payloads(ether_type: u16) -> Vec<Vec<u8>> {
    let of_type = all().into_iter().filter(|frame| frame[12..HEADER_LEN] == ether_type.to_be_bytes());
    of_type.map(|frame| frame[HEADER_LEN..].to_vec()).collect()
}

/// Of IPv4's, what follows the IP header.
pub fn ip_payloads(protocol: u8) -> Vec<Vec<u8>> {
    let packets = payloads(0x0800).into_iter().filter(|packet| packet[9] == protocol);
    packets.filter_map(|packet| ipv4::parse(&packet).ok().map(|(_, payload)| payload.to_vec())).collect()
}

/// One change, mostly of the headers; mostly with checksums that are right.
pub fn change(random: &mut Random, frame: &mut Vec<u8>, other: &[u8]) {
    match random.below(4) {
        0 => mutate::bytes(random, frame, other),
        1 => {
            let at = FIELDS[random.below(FIELDS.len() as u64) as usize];
            let bits = random.bits().to_be_bytes();
            let n = 1 + random.below(2) as usize;
            frame.iter_mut().skip(at).zip(bits).take(n).for_each(|(byte, new)| *byte = new);
        }
        2 => {
            // As it stands in another frame.
            let at = FIELDS[random.below(FIELDS.len() as u64) as usize];
            let n = [1, 2, 4, 6][random.below(4) as usize];
            frame.iter_mut().zip(other).skip(at).take(n).for_each(|(byte, new)| *byte = *new);
        }
        _ => {
            let head = frame.len().min(60);
            let mut behind = frame.split_off(head);
            mutate::bytes(random, frame, other);
            frame.append(&mut behind);
        }
    }
    frame.truncate(rtnet::buf::ROOM);
    if random.below(4) > 0 && frame.get(12..HEADER_LEN) == Some(&[8, 0]) {
        mend(&mut frame[HEADER_LEN..]);
    }
}
