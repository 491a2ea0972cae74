//! What comes for a tunnel is Linux's to judge: whatever is inside comes out as it is, as long as there are buffers, and
//! changes nothing of what the station sends.

use rtnet::discipline::Service;
use rtnet::wire::ethernet::{HEADER_LEN, MTU};
use vnic::tunnel::{self, Config, DEFAULT_BUFFERS, FRAME, HEAD, Inner, Loss, Mouth};

use super::*;

/// A slave that follows its master, with a frame to send in each of its slots, and a tunnel that takes what comes.
fn set_up() -> (Bench<Tdma>, Mouth) {
    let latest = Span::from_micros(50);
    let slot = |id, micros, size| SlotConfig {
        id,
        offset: Span::from_micros(micros),
        phase: 0,
        period: 1,
        size,
        joint: None,
        latest,
    };
    let tdma = Tdma::new(&TdmaConfig {
        address: SLAVE,
        role: RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() }),
        slots: vec![slot(0, 400, 64), slot(1, 600, 500)],
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    });
    let (tunnel, mouth) = tunnel::new(Config::of(SLAVE));
    let traffic = TestTraffic::new(3, SLAVE, Address::BROADCAST);
    let services: Vec<Box<dyn Service>> = vec![Box::new(tunnel), Box::new(traffic)];
    let mut bench =
        Bench::new(Station::new(tdma.expect("a sound configuration"), services), start(HOSTILE - 3));
    (HOSTILE - 3..HOSTILE).for_each(|cycle| genuine_sync(&mut bench, cycle));
    bench.advance(start(HOSTILE));
    bench.sent.clear();
    (bench, mouth)
}

/// What it sends in so many cycles, in each of which it hears something.
fn sent_while(
    (bench, mouth): &mut (Bench<Tdma>, Mouth),
    cycles: u32,
    mut hears: impl FnMut(&mut Bench<Tdma>, &Mouth, Instant),
) -> Sent {
    for cycle in HOSTILE..HOSTILE + cycles {
        genuine_sync(bench, cycle);
        hears(bench, mouth, start(cycle) + Span::from_micros(10));
    }
    bench.advance(start(HOSTILE + cycles));
    std::mem::take(&mut bench.sent)
}

fn undisturbed(cycles: u32) -> Sent {
    let sent = sent_while(&mut set_up(), cycles, |_, _, _| {});
    assert_eq!(sent.len(), 2 * cycles as usize);
    sent
}

fn tunnelled(kind: u16, flags: u8, payload: &[u8]) -> Vec<u8> {
    let [high, low] = kind.to_be_bytes();
    [&SLAVE.0[..], &MASTER.0, &[0x90, 0x21, high, low, 2, flags], payload].concat()
}

/// It comes out as it is.
fn check_through(bench: &mut Bench<Tdma>, mouth: &Mouth, at: Instant, frame: &[u8]) {
    bench.frame(at, frame);
    let came = mouth.received().unwrap_or_else(|| panic!("{:02x?}", &frame[..HEAD]));
    assert_eq!(came[..], *frame);
    let inside = [&frame[..12], &frame[14..16], &frame[HEAD..]].concat();
    assert_eq!(Inner::of(&came).expect("it is whole").pieces().concat(), inside);
}

#[test]
fn every_type_with_every_flag_comes_out_of_a_tunnel_as_it_went_in_and_none_is_obeyed() {
    let mut station = set_up();
    // What would be a Synchronisation, if it were not in a tunnel, or in a tunnel of a tunnel.
    let nested = &vectors::vector(1).bytes[14..];
    let mut kind = 0u16;
    let sent = sent_while(&mut station, 64, |bench, mouth, at| {
        for n in 0..1_024 {
            let flags = 1 | (n as u8) << 1;
            check_through(bench, mouth, at, &tunnelled(kind, flags, nested));
            kind = kind.wrapping_add(1);
        }
        check_through(bench, mouth, at, &tunnelled(0x9021, 1, nested));
    });
    assert_eq!((kind, sent), (0, undisturbed(64)));
    assert_eq!(station.0.station.refusals().total(), 0);
}

#[test]
fn garbage_of_every_length_comes_out_of_a_tunnel_also_what_is_longer_than_its_own_slot_takes() {
    let mut station = set_up();
    let garbage: Vec<u8> = (0..MTU as u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let mut len = 0;
    let sent = sent_while(&mut station, 10, |bench, mouth, at| {
        for _ in 0..150 {
            check_through(bench, mouth, at, &tunnelled(0x0800, 1, &garbage[..len.min(tunnel::MTU)]));
            len += 1;
        }
    });
    assert_eq!((len, sent), (MTU, undisturbed(10)));
}

#[test]
fn frames_for_a_tunnel_that_are_cut_short_or_of_another_version_are_refused_by_reason() {
    let (mut bench, mouth) = set_up();
    let at = start(HOSTILE) + Span::from_micros(10);
    genuine_sync(&mut bench, HOSTILE);
    for number in [7, 8, 9] {
        let whole = vectors::vector(number).bytes;
        for len in 0..whole.len() {
            let before = *bench.station.refusals();
            bench.frame(at, &whole[..len]);
            let expected = match len {
                0..HEADER_LEN => Some(Refusal::Runt),
                HEADER_LEN..HEAD => Some(Refusal::Truncated),
                _ => None,
            };
            assert_eq!(mouth.received().is_some(), expected.is_none(), "{len} bytes");
            let refused = bench.station.refusals().total() - before.total();
            assert_eq!(refused, u64::from(expected.is_some()));
            if let Some(reason) = expected {
                assert_eq!(bench.station.refusals().get(reason), before.get(reason) + 1);
            }
        }
        let before = bench.station.refusals().get(Refusal::RtmacVersion);
        for version in (0..=u8::MAX).filter(|&version| version != 2) {
            let mut other = whole.clone();
            other[16] = version;
            bench.frame(at, &other);
        }
        assert_eq!(bench.station.refusals().get(Refusal::RtmacVersion), before + 255);
    }
    assert!(mouth.received().is_none());
}

#[test]
fn a_flood_into_a_tunnel_is_bounded_by_its_buffers_and_counted_and_real_time_goes_on() {
    const FLOOD: u64 = 100_000;
    const CYCLES: u32 = 100;
    let mut station = set_up();
    let frame = tunnelled(0x0800, 1, &[0xaa; tunnel::MTU]);
    let sent = sent_while(&mut station, CYCLES, |bench, _, at| {
        // All the cycle long, also while a frame that was chosen waits for its instant.
        for n in 0..FLOOD / u64::from(CYCLES) {
            bench.frame(at + Span::from_nanos(900 * n as i64), &frame);
        }
    });
    assert_eq!(sent, undisturbed(CYCLES));
    let (bench, mouth) = &station;
    let kept = DEFAULT_BUFFERS as u64;
    assert_eq!(mouth.counts().received, kept);
    assert_eq!(mouth.pool().available(), 0);
    let refusals = bench.station.refusals();
    assert_eq!((refusals.get(Refusal::PoolEmpty), refusals.total()), (FLOOD - kept, FLOOD - kept));
    assert_eq!(std::iter::from_fn(|| mouth.received()).count() as u64, kept);
    assert_eq!(mouth.pool().available(), DEFAULT_BUFFERS);
}

/// Also what looks like RTmac's own: it leaves inside, with the tunnel flag, so that no station takes it for a discipline's.
#[test]
fn what_linux_sends_too_long_is_refused_and_what_it_forges_is_not_lethal() {
    let (mut bench, mouth) = set_up();
    genuine_sync(&mut bench, HOSTILE);
    // It learns the size of its slot in a turn of that.
    bench.advance(start(HOSTILE + 1));
    assert_eq!(mouth.mtu(), 496);
    let mut refused = 0;
    for len in (0..HEADER_LEN).chain(HEADER_LEN + 497..1_600).chain([usize::MAX]) {
        let expected = if len < HEADER_LEN { Loss::Short } else { Loss::TooLong };
        assert_eq!(mouth.send_frame(mouth.take().expect("it came back"), len), Err(expected), "{len}");
        refused += 1;
    }
    assert_eq!(mouth.counts().losses().map(|(_, n)| n).sum::<u64>(), refused);
    assert_eq!(mouth.pool().available(), DEFAULT_BUFFERS);

    let (mut alone, mouth) = without_traffic();
    let probes = [38, 39, 1, 7].map(|number| vectors::vector(number).bytes);
    for probe in &probes {
        let mut room = mouth.take().expect("one of 32");
        room.room_mut()[FRAME..][..probe.len()].copy_from_slice(probe);
        mouth.send_frame(room, probe.len()).expect("it is short");
    }
    (HOSTILE..HOSTILE + 8).for_each(|cycle| genuine_sync(&mut alone, cycle));
    let left: Vec<&Vec<u8>> = alone.sent.iter().map(|(_, frame)| frame).collect();
    assert_eq!(left.len(), probes.len());
    for (frame, probe) in left.iter().zip(&probes) {
        assert!(!wire::is_lethal(frame));
        assert_eq!(frame[12..HEAD], [0x90, 0x21, 0x90, 0x21, 2, 1]);
        assert_eq!(frame[HEAD..], probe[HEADER_LEN..]);
    }
}

/// One whose turns are all the tunnel's.
fn without_traffic() -> (Bench<Tdma>, Mouth) {
    let latest = Span::from_micros(50);
    let offset = Span::from_micros(400);
    let tdma = Tdma::new(&TdmaConfig {
        address: SLAVE,
        role: RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() }),
        slots: vec![SlotConfig { id: 0, offset, phase: 0, period: 1, size: 500, joint: None, latest }],
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    });
    let (tunnel, mouth) = tunnel::new(Config::of(SLAVE));
    let station = Station::new(tdma.expect("a sound configuration"), vec![Box::new(tunnel)]);
    let mut bench = Bench::new(station, start(HOSTILE - 3));
    (HOSTILE - 3..HOSTILE).for_each(|cycle| genuine_sync(&mut bench, cycle));
    bench.advance(start(HOSTILE));
    assert!(bench.sent.is_empty());
    (bench, mouth)
}
