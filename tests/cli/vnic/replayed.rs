//! What real stations tunnelled, and the example frames, sent to a station that runs: what Linux reads at its VNIC's
//! device, to the byte, and what it answers.

use std::time::{Duration, Instant};

use rtnet::live::interface::Interface;
use rtnet::wire::ethernet::EtherType;
use tools::lab::namespace::{Namespace, Segment};

use super::{EVERY, shared};
use crate::bare::Bare;
use crate::captures;
use crate::host::{figure, unique};
use crate::station::{PATIENCE, Station};
use crate::vectors::vector;

type Mac = [u8; 6];

/// The stations of the capture, and their addresses.
const ONE: (Mac, &str) = ([0x52, 0x54, 0, 0, 0, 1], "10.0.0.1/24");
const TWO: (Mac, &str) = ([0x52, 0x54, 0, 0, 0, 2], "10.0.0.2/24");
/// Whom the example frames are for, and who sent frames 7 and 8.
const ASKED: (Mac, &str) = ([2, 0, 0, 0, 0, 1], "10.0.0.1/24");
const ASKER: Mac = [2, 0, 0, 0, 0, 3];
const ALL: Mac = [0xff; 6];

/// RTmac's header is behind that of Ethernet, and the packet behind both: version 2, and the tunnel flag.
const RTMAC: usize = 14;
const PACKET: usize = 18;
const TUNNELLED: [u8; 2] = [2, 1];
const ARP: [u8; 2] = [8, 6];
const ARP_LEN: usize = 28;
/// What a stack writes into the header of its packets as it likes, and their sum: type of service, identification,
/// flags, time to live, checksum.
const OF_A_STACK: [std::ops::Range<usize>; 3] = [1..2, 4..9, 10..12];

fn is_tunnelled(frame: &[u8]) -> bool {
    frame[12..14] == EtherType::RTMAC.0.to_be_bytes() && frame[RTMAC + 2..PACKET] == TUNNELLED
}

/// As another program would unwrap it, padding included.
fn inside(frame: &[u8]) -> Vec<u8> {
    [&frame[..12], &frame[RTMAC..RTMAC + 2], &frame[PACKET..]].concat()
}

/// Whether it asks: an ARP request, or an echo request.
fn is_question(frame: &[u8]) -> bool {
    let packet = &frame[PACKET..];
    if frame[RTMAC..][..2] == ARP { packet[6..8] == [0, 1] } else { packet[20] == 8 }
}

/// Without its padding, in which RTnet leaves what it finds, and what stacks write as they like.
fn content(frame: &[u8]) -> Vec<u8> {
    let mut frame = frame.to_vec();
    if frame[RTMAC..][..2] == ARP {
        frame.truncate(PACKET + ARP_LEN);
    } else {
        frame.truncate(PACKET + usize::from(u16::from_be_bytes([frame[20], frame[21]])));
        OF_A_STACK.iter().for_each(|range| frame[PACKET..][range.clone()].fill(0));
    }
    frame
}

/// A station with a VNIC, between who sends it what another one sent and who reads at its device.
struct Between {
    mac: Mac,
    outside: Bare,
    device: Bare,
    _station: Station,
    _medium: (Namespace, Namespace, Segment),
}

impl Between {
    fn start(what: &str, (mac, ip): (Mac, &str), other: Mac) -> Self {
        let (here, there) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&here, "port0", "rt0", mac).unwrap();
        segment.attach(&there, "port1", "rt0", other).unwrap();
        let name = unique(what);
        let options = ["--interface", "rt0", "--discipline", "nomac", "--name", &name, "--vnic", ip];
        let station = Station::start(&here, &options);
        station.wait_for("Ctrl-C ends it");
        let open = |interface, kind| Bare::hearing(&Interface::find(interface).unwrap(), kind).unwrap();
        let outside = there.run(|| open("rt0", EtherType::RTMAC)).unwrap();
        let device = here.run(|| open("vnic0", EVERY)).unwrap();
        Self { mac, outside, device, _station: station, _medium: (here, there, segment) }
    }

    /// Sends a frame: Linux reads what is inside, and answers as it is said here.
    fn check(&self, what: &str, frame: &[u8], answer: Option<&[u8]>) {
        assert!(self.outside.send(frame), "{what}");
        // What Linux sends by the device is heard there, too.
        let read = next(&self.device, what, |heard| heard[6..12] != self.mac);
        assert_eq!(read, inside(frame), "{what}");
        let Some(answer) = answer else { return };
        // Linux has questions of its own, and news for all.
        let is_answer =
            |heard: &[u8]| heard[..6] == answer[..6] && is_tunnelled(heard) && !is_question(heard);
        let came = next(&self.outside, what, is_answer);
        assert_eq!(content(&came), content(answer), "the answer to {what}");
    }
}

/// The next frame that comes of which this holds.
fn next(socket: &Bare, what: &str, is_it: impl Fn(&[u8]) -> bool) -> Vec<u8> {
    let (deadline, mut room) = (Instant::now() + PATIENCE, [0; 2_048]);
    loop {
        match socket.receive(&mut room) {
            Some(len) if is_it(&room[..len]) => return room[..len].to_vec(),
            Some(_) => (),
            None => std::thread::sleep(Duration::from_millis(1)),
        }
        assert!(Instant::now() < deadline, "in vain: {what}");
    }
}

#[test]
fn what_real_stations_tunnelled_is_read_at_the_device_and_linux_answers_as_they_did() {
    let test = "what_real_stations_tunnelled_is_read_at_the_device_and_linux_answers_as_they_did";
    shared(test, || {
        let mut frames = captures::read("rtnet-real.pcap");
        frames.retain(|frame| is_tunnelled(&frame.bytes));
        // Each of the two stations is ours once.
        let mut count = (0, 0);
        for (what, ours, other) in [("replayed-one", ONE, TWO), ("replayed-two", TWO, ONE)] {
            let between = Between::start(what, ours, other.0);
            for (n, frame) in frames.iter().enumerate() {
                if ![ours.0, ALL].iter().any(|to| frame.bytes[..6] == *to) || frame.bytes[6..12] == ours.0 {
                    continue;
                }
                // What the real one answered comes next in the capture.
                let answer = is_question(&frame.bytes).then(|| &frames[n + 1].bytes[..]);
                assert!(answer.is_none_or(|answer| answer[6..12] == ours.0));
                between.check(&format!("frame {} to {what}", frame.number), &frame.bytes, answer);
                count = (count.0 + 1, count.1 + usize::from(answer.is_some()));
            }
        }
        assert_eq!(count, (10, 5), "all that the capture has");
        figure(test, &format!("{} frames read at the device as they are, {} answered", count.0, count.1));
    });
}

#[test]
fn the_example_frames_are_read_at_the_device_and_linux_answers_them() {
    let test = "the_example_frames_are_read_at_the_device_and_linux_answers_them";
    shared(test, || {
        let between = Between::start("vectors", ASKED, ASKER);
        let [ping, arp] = [7, 8].map(|number| vector(number).bytes);
        // Who answers is the sender then, and who asked the target.
        let answer = |question: &[u8], packet: &[u8]| {
            [&question[6..12], &ASKED.0[..], &question[12..PACKET], packet].concat()
        };
        let (its_ip, our_ip) = (&arp[PACKET + 14..][..4], &arp[PACKET + 24..][..4]);
        let resolved = [&arp[PACKET..][..6], &[0, 2], &ASKED.0[..], our_ip, &arp[6..12], its_ip].concat();
        between.check("vector 8", &arp, Some(&answer(&arp, &resolved)));
        let mut echoed = [&ping[PACKET..][..12], our_ip, its_ip, &ping[PACKET + 20..]].concat();
        // Type 0, of which the checksum is that much more.
        echoed[20] = 0;
        echoed[22] += 8;
        between.check("vector 7", &ping, Some(&answer(&ping, &echoed)));
    });
}
