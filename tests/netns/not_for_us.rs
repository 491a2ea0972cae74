//! What a medium floods is not for a station, and costs it nothing.

use std::time::{Duration, Instant};

use rtnet::buf::Pool;
use rtnet::clock::EmulatedClock;
use rtnet::live::interface::Interface;
use rtnet::live::ring::{CaptureRing, RingConfig};
use rtnet::live::{Data, GuardMode, Port, Tunnelled};
use rtnet::wire::ethernet::EtherType;
use tests::bare::Bare;
use tests::host::alone;
use tools::lab::namespace::{Namespace, Segment};

const SENDER: [u8; 6] = [2, 0, 0, 0, 0, 1];
const STATION: [u8; 6] = [2, 0, 0, 0, 0, 2];
/// The medium does not know it, and floods what is for it.
const ANOTHER: [u8; 6] = [2, 0, 0, 0, 0, 9];
const ALL: [u8; 6] = [0xff; 6];
/// How long to wait for what must not come, and for what must.
const SHORT: Duration = Duration::from_millis(50);
const LONG: Duration = Duration::from_secs(30);

fn frame(to: [u8; 6], ether_type: EtherType) -> [u8; 60] {
    let mut frame = [0; 60];
    frame[..6].copy_from_slice(&to);
    frame[6..12].copy_from_slice(&SENDER);
    frame[12..14].copy_from_slice(&ether_type.0.to_be_bytes());
    frame
}

/// A station's port, and an observer that makes its interface promiscuous.
fn listening() -> (Port, CaptureRing) {
    let clock = EmulatedClock::default();
    let interface = Interface::find("rt0").unwrap();
    let port = Port::open(&interface, &[EtherType::EXPERIMENTAL], clock, 50_000, GuardMode::User).unwrap();
    (port, CaptureRing::open("rt0", RingConfig::default()).unwrap())
}

/// Whether a frame wakes the port `within` that time, and how many it has received altogether.
fn woken(port: &mut Port, within: Duration) -> (bool, u64) {
    let begin = Instant::now();
    port.wait_for_frame(within.as_millis() as i32);
    let woken = begin.elapsed() < within;
    port.drain_control(|_, _| ());
    port.drain_data(|_, _| ());
    (woken, port.counters().received)
}

/// Waits until the observer has seen a frame: what the port has not by then, it never will.
fn seen(observer: &mut CaptureRing) -> usize {
    let (deadline, mut frames) = (Instant::now() + LONG, 0);
    while frames == 0 && Instant::now() < deadline {
        observer.wait(SHORT).unwrap();
        observer.drain(|_| frames += 1);
    }
    frames
}

/// A sender, and a station's port with an observer, on one medium that lasts as long as the rest.
fn wired() -> (Bare, Port, CaptureRing, impl Sized) {
    let (here, there) = (Namespace::new().unwrap(), Namespace::new().unwrap());
    let mut segment = Segment::new().unwrap();
    segment.attach(&here, "port0", "rt0", SENDER).unwrap();
    segment.attach(&there, "port1", "rt0", STATION).unwrap();
    let sender = here.run(|| Bare::open(&Interface::find("rt0").unwrap()).unwrap()).unwrap();
    let (port, observer) = there.run(listening).unwrap();
    (sender, port, observer, (here, there, segment))
}

#[test]
fn a_frame_to_another_station_neither_reaches_nor_wakes_a_port() {
    alone("a_frame_to_another_station_neither_reaches_nor_wakes_a_port", || {
        let (sender, mut port, mut observer, _medium) = wired();
        let mut received = 0;
        for ether_type in [EtherType::RTMAC, EtherType::EXPERIMENTAL] {
            assert!(sender.send(&frame(ANOTHER, ether_type)));
            assert_eq!(seen(&mut observer), 1, "it is there for all to see");
            assert_eq!(woken(&mut port, SHORT), (false, received), "{ether_type:?}");
            assert!(sender.send(&frame(STATION, ether_type)));
            assert_eq!(seen(&mut observer), 1);
            received += 1;
            assert_eq!(woken(&mut port, LONG), (true, received), "its own frames do: {ether_type:?}");
        }
    });
}

#[test]
fn a_tunnelled_frame_to_all_does_not_wake_who_has_no_vnic() {
    alone("a_tunnelled_frame_to_all_does_not_wake_who_has_no_vnic", || {
        let (sender, mut port, mut observer, _medium) = wired();
        let tunnelled = |to, flags| {
            let mut frame = frame(to, EtherType::RTMAC);
            frame[14..18].copy_from_slice(&[0x08, 0x06, 2, flags]);
            frame
        };
        let mut other_version = tunnelled(ALL, 1);
        other_version[16] = 1;
        let too_short = frame(ALL, EtherType::RTMAC);
        let mut received = 0;
        for (what, frame, wakes) in [
            ("ARP in a tunnel, to all", &tunnelled(ALL, 1)[..], false),
            ("with a reserved flag", &tunnelled(ALL, 0x81), false),
            ("to this station alone: counted, and refused", &tunnelled(STATION, 1), true),
            ("no tunnel", &tunnelled(ALL, 0x80), true),
            ("of another version: counted, and refused", &other_version, true),
            ("too short to tell", &too_short[..17], true),
        ] {
            assert!(sender.send(frame), "{what}");
            assert_eq!(seen(&mut observer), 1, "it is there for all to see: {what}");
            received += u64::from(wakes);
            assert_eq!(woken(&mut port, if wakes { LONG } else { SHORT }), (wakes, received), "{what}");
        }
    });
}

#[test]
fn what_was_tunnelled_before_the_vnic_was_there_is_let_go() {
    alone("what_was_tunnelled_before_the_vnic_was_there_is_let_go", || {
        let (sender, mut port, mut observer, _medium) = wired();
        let mut frame = frame(STATION, EtherType::RTMAC);
        frame[14..18].copy_from_slice(&[0x08, 0x06, 2, 1]);
        for sent in 1..=3 {
            assert!(sender.send(&frame));
            assert_eq!(seen(&mut observer), 1, "the {sent}. waits in the port's socket now");
        }
        port.leave_tunnelled().unwrap();
        let free = port.pool().available();
        assert_eq!((woken(&mut port, SHORT), port.pool().available()), ((false, 0), free), "nobody gets it");
        frame[17] = 0;
        assert!(sender.send(&frame));
        assert_eq!(woken(&mut port, LONG), (true, 1), "what is no tunnel's still comes");
    });
}

#[test]
fn what_is_tunnelled_to_who_has_a_vnic_wakes_its_thread_only_and_what_floods_that_keeps_no_sync_away() {
    let test =
        "what_is_tunnelled_to_who_has_a_vnic_wakes_its_thread_only_and_what_floods_that_keeps_no_sync_away";
    alone(test, || {
        let (here, there) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&here, "port0", "rt0", SENDER).unwrap();
        segment.attach(&there, "port1", "rt0", STATION).unwrap();
        let sender = here.run(|| Bare::open(&Interface::find("rt0").unwrap()).unwrap()).unwrap();
        let open = |of_others| {
            let (mut port, _) = listening();
            port.leave_tunnelled().unwrap();
            (port, Tunnelled::open(&Interface::find("rt0").unwrap(), of_others).unwrap())
        };
        let (mut port, own) = there.run(|| open(false)).unwrap();
        let (_, forwarding) = there.run(|| open(true)).unwrap();
        let rtmac = |to, version, flags| {
            let mut frame = frame(to, EtherType::RTMAC);
            frame[14..18].copy_from_slice(&[0x08, 0x06, version, flags]);
            frame
        };
        let room = Pool::new(1);
        let hears = |socket: &Tunnelled| {
            let mut buf = room.take().unwrap();
            (0..).map_while(|_| socket.receive(&mut buf)).count()
        };
        // As many as are expected are waited for.
        let heard_by = |sockets: [(&Tunnelled, bool); 2]| {
            sockets.map(|(socket, is_expected)| {
                let (deadline, mut heard) = (Instant::now() + LONG, hears(socket));
                while heard < usize::from(is_expected) && Instant::now() < deadline {
                    std::thread::sleep(Duration::from_millis(1));
                    heard += hears(socket);
                }
                heard
            })
        };
        let mut received = 0;
        for (what, frame, heard) in [
            ("to this station", &rtmac(STATION, 2, 1)[..], [false, true, true]),
            ("to all, with a reserved flag", &rtmac(ALL, 2, 0x81), [false, true, true]),
            ("to a host behind somebody", &rtmac(ANOTHER, 2, 1), [false, false, true]),
            ("no tunnel", &rtmac(STATION, 2, 0x80), [true, false, false]),
            ("of another version: counted, and refused", &rtmac(STATION, 1, 1), [true, false, false]),
            ("too short to tell", &rtmac(STATION, 2, 1)[..17], [true, false, false]),
        ] {
            assert!(sender.send(frame), "{what}");
            received += u64::from(heard[0]);
            assert_eq!(woken(&mut port, if heard[0] { LONG } else { SHORT }), (heard[0], received), "{what}");
            let by = heard_by([(&own, heard[1]), (&forwarding, heard[2])]);
            assert_eq!(by, [heard[1], heard[2]].map(usize::from), "{what}");
        }
        // Many times what any queue holds, and a sync behind it.
        let flood = (0..20_000).filter(|_| sender.send(&rtmac(STATION, 2, 1))).count();
        assert!(sender.send(&rtmac(STATION, 2, 0)));
        assert_eq!(woken(&mut port, LONG), (true, received + 1));
        assert_eq!(port.counters().socket_full, 0);
        // The kernel may deliver the last of them later than the sync.
        let (deadline, mut came, mut dropped) = (Instant::now() + LONG, 0, 0);
        while came as u64 + dropped < flood as u64 && Instant::now() < deadline {
            came += hears(&own);
            dropped += own.take_dropped();
        }
        assert!(dropped > 0 && came as u64 + dropped == flood as u64, "{came} and {dropped} of {flood}");
    });
}

#[test]
fn a_station_with_sockets_hears_every_ether_type_but_rtmac_s_no_vlan_and_not_itself() {
    alone("a_station_with_sockets_hears_every_ether_type_but_rtmac_s_no_vlan_and_not_itself", || {
        let (here, there) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&here, "port0", "rt0", SENDER).unwrap();
        segment.attach(&there, "port1", "rt0", STATION).unwrap();
        let sender = here.run(|| Bare::open(&Interface::find("rt0").unwrap()).unwrap()).unwrap();
        let open = || {
            let interface = Interface::find("rt0").unwrap();
            let port =
                Port::open(&interface, Data::All, EmulatedClock::default(), 50_000, GuardMode::User).unwrap();
            (port, Bare::open(&interface).unwrap())
        };
        let (mut port, itself) = there.run(open).unwrap();
        let mut vlan = frame(STATION, EtherType(0x8100));
        vlan[16..18].copy_from_slice(&EtherType::EXPERIMENTAL.0.to_be_bytes());
        let mut own = frame(SENDER, EtherType::EXPERIMENTAL);
        own[6..12].copy_from_slice(&STATION);
        assert!(itself.send(&own));
        let others = [vlan, frame(STATION, EtherType::RTMAC), frame(ANOTHER, EtherType::EXPERIMENTAL)];
        let ours = [EtherType::EXPERIMENTAL, EtherType::ARP, EtherType(0x1234)].map(|of| frame(STATION, of));
        for frame in others.iter().chain(&ours).chain([&frame(ALL, EtherType::EXPERIMENTAL)]) {
            assert!(sender.send(frame));
        }
        let (deadline, mut heard) = (Instant::now() + LONG, Vec::new());
        while heard.len() < 4 && Instant::now() < deadline {
            port.wait_for_frame(SHORT.as_millis() as i32);
            port.drain_control(|_, _| ());
            port.drain_data(|_, frame| heard.push([frame[12], frame[13]]));
        }
        std::thread::sleep(SHORT);
        port.drain_data(|_, frame| heard.push([frame[12], frame[13]]));
        assert_eq!(heard, [[0x88, 0xb5], [8, 6], [0x12, 0x34], [0x88, 0xb5]]);
    });
}
