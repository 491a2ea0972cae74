//! The example frames, byte for byte, and the arithmetic that goes with them.

#[path = "vectors/sent.rs"]
mod sent;
#[path = "vectors/stack.rs"]
mod stack;
#[path = "vectors/tunnel.rs"]
mod tunnel;

use pnet_packet::Packet;
use pnet_packet::ethernet::EthernetPacket;
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, RoleConfig, SlaveConfig, Tdma, TdmaConfig, line,
};
use rtmac::wire::{self, Message, Rtmac};
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, SyncState};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header};
use tests::vectors::{self, vector};

const ALL: Address = Address::BROADCAST;
const MASTER: Address = Address([2, 0, 0, 0, 0, 1]);
const BACKUP: Address = Address([2, 0, 0, 0, 0, 2]);
const SLAVE: Address = Address([2, 0, 0, 0, 0, 3]);

/// What frame `number` says, and the last look at the clock before it was sent: that clock's time, and
/// what the stamp adds to it.
struct Described {
    number: usize,
    to: Address,
    from: Address,
    message: Message,
    clock: u64,
    add: u64,
}

fn sync(cycle: u32, xmit: u64, sched: u64) -> Message {
    Message::Sync { cycle, xmit: GlobalTime::from_nanos(xmit), sched: GlobalTime::from_nanos(sched) }
}

/// Frames 1 to 6 as `rtnet-frames.md` describes them. The backup's clock is taken to be 7 ns ahead of
/// global time, so that its addend is negative, and the last master's far behind.
fn described() -> [Described; 6] {
    let by_master =
        |number, message, clock, add| Described { number, to: ALL, from: MASTER, message, clock, add };
    let request = Message::Request { xmit: 600_100_323_344, reply_cycle: 101, reply_offset: 400_000 };
    let (request_xmit, reception, xmit) = (600_100_323_344, 1_000_100_492_000, 1_000_101_402_000);
    let reply = Message::Reply { request_xmit, reception, xmit };
    let backup = Described {
        number: 5,
        to: ALL,
        from: BACKUP,
        message: sync(150, 1_000_150_204_100, 1_000_150_000_000),
        clock: 1_000_150_204_107,
        add: 7u64.wrapping_neg(),
    };
    [
        by_master(1, sync(100, 1_000_100_003_250, 1_000_100_000_000), 1_000_100_003_250, 0),
        Described { number: 2, to: MASTER, from: SLAVE, message: request, clock: 600_100_323_344, add: 0 },
        Described { number: 3, to: SLAVE, from: MASTER, message: reply, clock: xmit, add: 0 },
        by_master(4, sync(102, 1_000_102_002_900, 1_000_102_000_000), 1_000_102_002_900, 0),
        backup,
        by_master(6, sync(u32::MAX, 1_000_151_000_100, 1_000_151_000_000), 100, 1_000_151_000_000),
    ]
}

/// The message before its frame is stamped.
fn unstamped(message: Message) -> Message {
    match message {
        Message::Sync { cycle, sched, .. } => sync(cycle, 0, sched.nanos()),
        Message::Request { reply_cycle, reply_offset, .. } => {
            Message::Request { xmit: 0, reply_cycle, reply_offset }
        }
        Message::Reply { request_xmit, reception, .. } => Message::Reply { request_xmit, reception, xmit: 0 },
    }
}

#[test]
fn the_six_tdma_frames_are_produced_to_the_bit() {
    let pool = Pool::new(1);
    for Described { number, to, from, message, clock, add } in described() {
        let mut frame = pool.take().unwrap();
        // What was in the buffer before does not show through.
        frame.room_mut().fill(0xff);
        unstamped(message).write(to, from, &mut frame);
        assert_ne!(frame[..], vector(number).bytes[..], "frame {number} is not stamped yet");
        message.stamp(add).write(&mut frame, Instant::from_nanos(clock));
        assert_eq!(frame[..], vector(number).bytes[..], "frame {number}");

        message.write(to, from, &mut frame);
        assert_eq!(frame[..], vector(number).bytes[..], "frame {number} without a port");
    }
}

#[test]
fn the_six_tdma_frames_are_parsed_to_the_bit() {
    for Described { number, to, from, message, .. } in described() {
        let bytes = vector(number).bytes;
        let (header, _) = Header::parse(&bytes).unwrap();
        assert_eq!((header.destination, header.source), (to, from));
        assert_eq!(wire::parse(&bytes), Ok(Rtmac::Tdma(message)), "frame {number}");
    }
}

#[test]
fn padding_that_is_not_zero_changes_nothing() {
    for Described { number, message, .. } in described() {
        let mut bytes = vector(number).bytes;
        bytes[46..].fill(0xa5);
        bytes.extend([0x5a; 900]);
        assert_eq!(wire::parse(&bytes), Ok(Rtmac::Tdma(message)), "frame {number}");
    }
}

#[test]
fn tunnelled_frames_are_rtmac_heads_with_the_frame_inside() {
    for (number, kind) in [(7, 0x0800), (8, 0x0806), (9, 0x88b5)] {
        let bytes = vector(number).bytes;
        let (head, rest) = wire::head(&bytes).unwrap();
        assert_eq!((head.kind(), head.version, head.flags), (kind, 2, 1), "frame {number}");
        assert_eq!(rest, &bytes[18..]);
        assert_eq!(wire::parse(&bytes), Ok(Rtmac::Tunnel(EtherType(kind), &bytes[18..])));
    }
    let ip = vector(7).bytes;
    assert_eq!((ip[18], &ip[30..34]), (0x45, &[10, 0, 0, 3][..]), "the inner datagram is 10.0.0.3's");
}

#[test]
fn odd_frames_are_refused_by_reason() {
    // 29 to 37 are TDMA's of version 1, which comes with an RTmac of its own.
    let old = (29..=37).map(|number| (number, Refusal::RtmacVersion));
    let refused = [
        (38, Refusal::OtherDiscipline),
        (39, Refusal::OtherDiscipline),
        (40, Refusal::RtmacVersion),
        (41, Refusal::TdmaVersion),
        (42, Refusal::TdmaMessage),
        (43, Refusal::Truncated),
        (51, Refusal::RtmacVersion),
    ];
    for (number, reason) in old.chain(refused) {
        let odd = vector(number);
        assert_eq!(wire::parse(&odd.bytes), Err(reason), "{}", odd.name);
    }
}

/// RTcfg, IP and ARP, and the EtherType under which another family's stations speak TDMA among themselves.
#[test]
fn other_ether_types_are_nobodys_whatever_is_behind_them() {
    let role = RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() });
    let (max_slot_id, lead, late) = (DEFAULT_MAX_SLOT_ID, DEFAULT_LEAD, LatePolicy::Skip);
    let config = TdmaConfig { address: SLAVE, role, slots: vec![], max_slot_id, lead, late };
    let mut slave = Station::new(Tdma::new(&config).unwrap(), vec![]);
    let pool = Pool::new(1);
    let hear = |station: &mut Station<Tdma>, bytes: &[u8], ms: u64| {
        let mut frame = pool.take().unwrap();
        frame.fill(bytes);
        station.on_frame(Some(Instant::from_nanos(ms * 1_000_000)), frame);
        let refused = station.refusals().get(Refusal::UnclaimedEtherType);
        (refused, station.discipline().status().counters.syncs_received)
    };
    for (count, number) in (1..).zip([10, 23, 26]) {
        assert_eq!(hear(&mut slave, &vector(number).bytes, 0), (count, 0), "frame {number}");
    }
    for (ms, number) in [(100, 1), (102, 4)] {
        let mut sync = vector(number).bytes;
        sync[12..14].copy_from_slice(&[0x90, 0x23]);
        assert_eq!(hear(&mut slave, &sync, ms).1, 0);
    }
    assert_eq!(slave.refusals().total(), 5);
    assert_eq!(slave.discipline().time().state, SyncState::Waiting);
    assert_eq!(hear(&mut slave, &vector(1).bytes, 103), (5, 1), "that of RTmac is taken");
}

#[test]
fn reserved_flag_bits_are_ignored() {
    let odd = vector(44);
    assert_eq!(wire::head(&odd.bytes).unwrap().0.flags, 0x80);
    assert_eq!(wire::parse(&odd.bytes), Ok(Rtmac::Tdma(sync(5, 1, 2))), "{}", odd.name);
}

#[test]
fn the_probes_of_other_disciplines_are_lethal_and_what_we_send_is_not() {
    let lethal = |number| wire::is_lethal(&vector(number).bytes);
    assert!(lethal(38) && lethal(39));
    assert!((1..=9).all(|number| !lethal(number)), "TDMA and tunnel");
    assert!((23..=28).all(|number| !lethal(number)), "no RTmac at all");
}

#[test]
fn another_decoder_agrees_on_every_ethernet_header() {
    for vector in vectors::all() {
        let theirs = EthernetPacket::new(&vector.bytes).expect("long enough");
        let (ours, payload) = Header::parse(&vector.bytes).expect("long enough");
        assert_eq!(ours.destination.0, theirs.get_destination().octets(), "{}", vector.name);
        assert_eq!(ours.source.0, theirs.get_source().octets(), "{}", vector.name);
        assert_eq!(ours.ether_type().0, theirs.get_ethertype().0, "{}", vector.name);
        assert_eq!(payload, theirs.payload(), "{}", vector.name);
        assert_eq!(payload, &vector.bytes[HEADER_LEN..]);
    }
}

/// The table at the top of `rtnet-frames.md`, row by row, from the frames themselves.
#[test]
fn the_arithmetic_of_the_scenario_holds() {
    let sync = |number| match wire::parse(&vector(number).bytes) {
        Ok(Rtmac::Tdma(Message::Sync { xmit, sched, .. })) => (xmit, sched),
        other => panic!("frame {number} is {other:?}"),
    };
    let local = Instant::from_nanos;

    let (xmit, sched) = sync(1);
    let before = line::offset(xmit, Span::ZERO, local(600_099_924_794));
    assert_eq!(before.nanos(), 400_000_078_456, "45 us too small");
    let start = line::cycle_start(sched, before);
    assert_eq!(start, local(600_099_921_544));
    assert_eq!((start + Span::from_micros(400)).nanos() + 1_800, 600_100_323_344, "when frame 2 left");

    let Ok(Rtmac::Tdma(Message::Reply { request_xmit, reception, xmit })) = wire::parse(&vector(3).bytes)
    else {
        panic!("frame 3 is a reply");
    };
    let delay = line::delay(request_xmit, reception, xmit, 600_101_323_344);
    assert_eq!(delay, Span::from_micros(45));

    let (xmit, sched) = sync(4);
    let after = line::offset(xmit, delay, local(600_101_924_444));
    assert_eq!(after.nanos(), 400_000_123_456, "the true offset");
    let start = line::cycle_start(sched, after);
    assert_eq!(start, local(600_101_876_544));

    // The backup's Synchronisation of cycle 150 is 204.1 us late, and says so.
    let (xmit, sched) = sync(5);
    assert_eq!((xmit - sched).nanos(), 204_100);
    let rx = local(600_150_125_644);
    let by_backup = line::offset(xmit, delay, rx);
    assert_eq!(by_backup, after, "its lateness moves no clock");
    let late = line::cycle_start(sched, by_backup);
    assert_eq!(late, start + Span::from_millis(48), "nor the grid, 48 cycles later");
    assert!(rx < late + Span::from_micros(400), "the slave's slot is still to come");
}
