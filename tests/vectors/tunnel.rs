//! Frames 7 to 9 through the tunnel of a station, in both directions.

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, RoleConfig, SlaveConfig, SlotConfig, Tdma, TdmaConfig,
};
use rtnet::discipline::{Discipline, SyncState};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, MTU};
use tests::bench::Bench;
use tests::vectors::vector;
use vnic::tunnel::{self, Config, FRAME, HEAD, Inner, Mouth};

use super::SLAVE;

/// When the slave has heard frames 1 and 4, by its clock.
const HEARD: [(usize, u64); 2] = [(1, 600_099_924_794), (4, 600_101_924_444)];
/// What Linux has sent, in front of the padding.
const CONTENT: [(usize, usize); 3] = [(7, 60), (8, 28), (9, 26)];

/// The slave of the example frames, which follows its master, and has slots 0 and 1.
fn slave() -> (Bench<Tdma>, Mouth) {
    let slot = |id, micros| {
        let (offset, latest) = (Span::from_micros(micros), Span::from_micros(50));
        SlotConfig { id, offset, phase: 0, period: 1, size: MTU, joint: None, latest }
    };
    let config = TdmaConfig {
        address: SLAVE,
        role: RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() }),
        slots: vec![slot(0, 400), slot(1, 600)],
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    };
    let (tunnel, mouth) = tunnel::new(Config::of(SLAVE));
    let station = Station::new(Tdma::new(&config).expect("a sound configuration"), vec![Box::new(tunnel)]);
    let mut bench = Bench::new(station, Instant::from_nanos(HEARD[0].1 - 1));
    for (number, at) in HEARD {
        bench.frame(Instant::from_nanos(at), &vector(number).bytes);
    }
    assert_eq!(bench.station.discipline().time().state, SyncState::Locked);
    (bench, mouth)
}

/// What leaves in the rest of this cycle.
fn leaves(mut bench: Bench<Tdma>) -> Vec<Vec<u8>> {
    bench.advance(Instant::from_nanos(HEARD[1].1) + Span::from_micros(900));
    bench.sent.into_iter().map(|(_, frame)| frame).collect()
}

/// The Ethernet frame inside an example frame.
fn inside(number: usize) -> Vec<u8> {
    let bytes = vector(number).bytes;
    [&bytes[..12], &bytes[14..16], &bytes[18..]].concat()
}

#[test]
fn what_linux_sends_leaves_as_the_example_frames_to_the_bit() {
    for (number, content) in CONTENT {
        let sent = inside(number);
        assert!(sent[HEADER_LEN + content..].iter().all(|&byte| byte == 0), "the rest is padding");
        let sent = &sent[..HEADER_LEN + content];

        let (bench, mouth) = slave();
        let mut room = mouth.take().expect("it is free");
        // What was in the buffer before does not show through.
        room.room_mut().fill(0xff);
        room.room_mut()[FRAME..][..sent.len()].copy_from_slice(sent);
        mouth.send_frame(room, sent.len()).expect("it fits");
        assert_eq!(leaves(bench), [vector(number).bytes], "frame {number}");

        let (bench, mouth) = slave();
        let mut room = mouth.take().expect("it is free");
        room.room_mut().fill(0xff);
        room.room_mut()[HEAD..][..content].copy_from_slice(&sent[HEADER_LEN..]);
        let to = Address(*sent.first_chunk().expect("a header"));
        let kind = EtherType(u16::from_be_bytes([sent[12], sent[13]]));
        mouth.send_packet(room, content, to, kind).expect("it fits");
        assert_eq!(leaves(bench), [vector(number).bytes], "the packet of frame {number}");
    }
}

#[test]
fn the_example_frames_come_out_of_a_tunnel_as_what_is_inside_with_its_padding() {
    let (mut bench, mouth) = slave();
    let begin = Instant::from_nanos(HEARD[1].1);
    for (number, kind) in [(7, EtherType::IPV4), (8, EtherType::ARP), (9, EtherType::EXPERIMENTAL)] {
        bench.frame(begin + Span::from_micros(number as i64), &vector(number).bytes);
        let came = mouth.received().expect("it is for Linux");
        let inner = Inner::of(&came).expect("it is whole");
        assert_eq!(inner.kind(), kind);
        assert_eq!(inner.payload(), &vector(number).bytes[18..]);
        assert_eq!(inner.pieces().concat(), inside(number), "frame {number}");
    }
    assert!(mouth.received().is_none());
    assert_eq!((bench.station.refusals().total(), mouth.counts().received), (0, 3));
}
