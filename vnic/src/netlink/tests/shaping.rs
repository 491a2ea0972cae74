use super::*;

use nix::sys::socket::{setsockopt, sockopt::UdpGsoSegment};

use netlink_packet_core::{Nla, NlasIterator};
use netlink_packet_route::tc::{TcAttribute, TcHandle, TcMessage, TcOption};

use crate::netlink::shaping::{
    PEAK, TCA_TBF_BURST, TCA_TBF_PARMS, TCA_TBF_PBURST, TCA_TBF_PRATE64, TCA_TBF_RATE64,
};

const SHAPING: Shaping = Shaping { bytes_per_second: 125_000, burst: 2000, longest: 1000, limit: 5 };
/// So slow that hardly anything leaves later.
const SLOW: Shaping = Shaping { bytes_per_second: 10, ..SHAPING };
/// Of Ethernet, IP and UDP.
const HEADERS: usize = 42;

fn bytes(option: &impl Nla) -> Vec<u8> {
    let mut bytes = vec![0; option.value_len()];
    option.emit_value(&mut bytes);
    bytes
}

/// What the kernel tells of how a queueing discipline is set.
fn options(discipline: &TcMessage) -> Vec<u8> {
    let options = discipline.attributes.iter().find_map(|attribute| match attribute {
        TcAttribute::Options(options) => options.first(),
        _ => None,
    });
    let Some(TcOption::Other(options)) = options else { panic!("no options: {discipline:?}") };
    bytes(options)
}

/// The rate, the burst in nanoseconds, and the packets that may wait, which the kernel tells of.
fn told(links: &mut Links, index: u32) -> (u64, u64, u32) {
    let bucket = links.discipline(index, TcHandle::ROOT).unwrap();
    let queue = links.discipline(index, TcHandle { minor: 1, ..bucket.header.handle }).unwrap();
    assert!(queue.attributes.contains(&TcAttribute::Kind("pfifo".into())), "{queue:?}");
    let limit = u32::from_ne_bytes(options(&queue).try_into().unwrap());
    let options = options(&bucket);
    let value = |kind| {
        let mut all = NlasIterator::new(options.as_slice()).flatten();
        all.find(|nla| nla.kind() == kind).map(|nla| nla.value().to_vec())
    };
    let parameters = value(TCA_TBF_PARMS).expect("struct tc_tbf_qopt");
    let field = |at: usize| u32::from_ne_bytes(parameters[at..at + 4].try_into().unwrap());
    let rate64 = value(TCA_TBF_RATE64).map(|rate| u64::from_ne_bytes(rate.try_into().unwrap()));
    // A tick of the kernel's is 64 ns (/proc/net/psched).
    (rate64.unwrap_or(field(8).into()), u64::from(field(28)) * 64, limit)
}

/// Whether this kernel has a token bucket.
fn limited(links: &mut Links, index: u32) -> bool {
    match links.limit_rate(index, &SHAPING) {
        Err(refused) if refused.is_unsupported() => {
            let _ = writeln!(std::io::stderr(), "SKIP tbf: {refused}");
            false
        }
        outcome => {
            let only_bytes = outcome.unwrap();
            assert!(only_bytes.is_none(), "{only_bytes:?}");
            true
        }
    }
}

#[test]
fn a_token_bucket_is_asked_for_as_the_kernel_lays_it_out() {
    let [parameters, peak, burst, at_peak] = SHAPING.options().try_into().unwrap();
    let mut expected = [0; 36];
    [expected[1], expected[13]] = [1, 1];
    expected[6..8].copy_from_slice(&1000_u16.to_ne_bytes());
    expected[8..12].copy_from_slice(&125_000_u32.to_ne_bytes());
    expected[20..24].copy_from_slice(&[0xff; 4]);
    expected[24..28].copy_from_slice(&5000_u32.to_ne_bytes());
    assert_eq!((parameters.kind(), bytes(&parameters)), (TCA_TBF_PARMS, expected.to_vec()));
    assert_eq!((peak.kind(), bytes(&peak)), (TCA_TBF_PRATE64, PEAK.to_ne_bytes().to_vec()));
    assert_eq!((burst.kind(), bytes(&burst)), (TCA_TBF_BURST, 2000_u32.to_ne_bytes().to_vec()));
    assert_eq!((at_peak.kind(), bytes(&at_peak)), (TCA_TBF_PBURST, 1000_u32.to_ne_bytes().to_vec()));

    let fast = 10_000_000_000;
    let [parameters, _, _, _, rate] =
        Shaping { bytes_per_second: fast, ..SHAPING }.options().try_into().unwrap();
    assert_eq!(bytes(&parameters)[8..12], [0xff; 4]);
    assert_eq!((rate.kind(), bytes(&rate)), (TCA_TBF_RATE64, fast.to_ne_bytes().to_vec()));
}

#[test]
fn a_device_is_fed_as_fast_as_is_asked_for() {
    in_a_namespace("a_device_is_fed_as_fast_as_is_asked_for", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        assert_eq!(links.shaping(a).unwrap(), None);
        if !limited(&mut links, a) {
            return;
        }
        // 2000 bytes take 16 ms.
        assert_eq!(told(&mut links, a), (125_000, 16_000_000, 5));
        assert_eq!(links.shaping(a).unwrap(), Some(ShapingStatistics::default()));

        let fast =
            Shaping { bytes_per_second: 10_000_000_000, burst: 1_000_000, longest: 1510, limit: 2_000 };
        links.limit_rate(a, &fast).unwrap();
        let (rate, burst, limit) = told(&mut links, a);
        assert_eq!((rate, limit), (10_000_000_000, 2_000));
        assert!(burst.abs_diff(100_000) < 128, "{burst} ns");

        for _ in 0..2 {
            links.unlimit_rate(a).unwrap();
            assert_eq!(links.shaping(a).unwrap(), None);
        }
    });
}

#[test]
fn what_a_token_bucket_does_not_let_through_waits_or_is_dropped() {
    in_a_namespace("what_a_token_bucket_does_not_let_through_waits_or_is_dropped", || {
        let mut links = Links::open().unwrap();
        let ([a, _], socket) = broadcasting(&mut links);
        if !limited(&mut links, a) {
            return;
        }
        links.limit_rate(a, &SLOW).unwrap();
        // Linux's own may have gone before, and have taken what the bucket had: each takes as much as one of 1000 bytes.
        let begin = links.shaping(a).unwrap().unwrap();
        for _ in 0..20 {
            let _ = socket.send(&[0; 1000 - HEADERS]); // ENOBUFS, for what is dropped
        }
        let before = links.shaping(a).unwrap().unwrap();
        let ShapingStatistics { drops, waiting, backlog, .. } = before;
        let (bytes, packets) = (before.bytes - begin.bytes, before.packets - begin.packets);
        assert!(bytes <= 2000 && before.packets >= 1, "{packets} packets of {bytes} bytes went through");
        // One of Linux's own may be among them.
        assert!(waiting == 5 && (4000..=5000).contains(&backlog), "{waiting} of {backlog} bytes wait");
        assert!(drops >= 13, "{drops} packets were dropped");

        // Asked for again, it goes on counting, and what waits is not lost.
        links.limit_rate(a, &Shaping { limit: 6, ..SLOW }).unwrap();
        let now = links.shaping(a).unwrap().unwrap();
        assert!(now.drops >= drops && now.waiting >= 5, "{now:?}");
        assert_eq!(told(&mut links, a).2, 6);
    });
}

#[test]
fn no_more_short_packets_wait_than_long_ones() {
    in_a_namespace("no_more_short_packets_wait_than_long_ones", || {
        let mut links = Links::open().unwrap();
        let ([a, _], socket) = broadcasting(&mut links);
        if !limited(&mut links, a) {
            return;
        }
        links.limit_rate(a, &SLOW).unwrap();
        // Linux's own may have gone before, and have taken what the bucket had: each takes as much as one of 1000 bytes.
        let begin = links.shaping(a).unwrap().unwrap();
        for _ in 0..100 {
            let _ = socket.send(&[0; 18]);
        }
        let ShapingStatistics { packets, drops, waiting, .. } = links.shaping(a).unwrap().unwrap();
        let went = packets - begin.packets;
        assert!(packets >= 1 && went <= 2 && waiting == 5 && drops >= 93, "{went} {waiting} {drops}");
    });
}

#[test]
fn what_was_put_together_takes_as_many_places_as_it_has_packets() {
    in_a_namespace("what_was_put_together_takes_as_many_places_as_it_has_packets", || {
        let mut links = Links::open().unwrap();
        let ([a, _], socket) = broadcasting(&mut links);
        if !limited(&mut links, a) {
            return;
        }
        // No longer than the burst: three packets that the kernel hands on as one.
        let long = Shaping { burst: 4000, ..SLOW };
        links.limit_rate(a, &long).unwrap();
        setsockopt(&socket, UdpGsoSegment, &(1000 - HEADERS as i32)).unwrap();
        for _ in 0..10 {
            let _ = socket.send(&[0; 3 * (1000 - HEADERS)]);
        }
        let ShapingStatistics { drops, waiting, backlog, .. } = links.shaping(a).unwrap().unwrap();
        assert!(waiting == 5 && backlog <= 5000, "{waiting} of {backlog} bytes wait");
        assert!(drops >= 1, "{drops} packets were dropped");
    });
}

#[test]
fn a_rate_a_burst_or_a_length_of_nothing_is_refused() {
    in_a_namespace("a_rate_a_burst_or_a_length_of_nothing_is_refused", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        if !limited(&mut links, a) {
            return;
        }
        for shaping in [
            Shaping { bytes_per_second: 0, ..SHAPING },
            Shaping { burst: 0, ..SHAPING },
            Shaping { longest: 0, ..SHAPING },
        ] {
            let refused = links.limit_rate(a, &shaping).expect_err("nothing");
            assert_eq!(
                (refused.errno(), refused.is_unsupported()),
                (Some(Errno::EINVAL), false),
                "{refused}"
            );
        }
        assert_eq!(links.limit_rate(NOWHERE, &SHAPING).unwrap_err().errno(), Some(Errno::ENODEV));
        assert_eq!(links.unlimit_rate(NOWHERE).unwrap_err().errno(), Some(Errno::ENODEV));
    });
}
