use super::*;

use netlink_packet_core::{Nla, NlasIterator};
use netlink_packet_route::tc::{TcAttribute, TcOption};

use crate::netlink::shaping::{TCA_TBF_BURST, TCA_TBF_PARMS, TCA_TBF_RATE64};

const SHAPING: Shaping = Shaping { bytes_per_second: 125_000, burst: 2000, least: 1000, limit: 5000 };

fn bytes(option: &impl Nla) -> Vec<u8> {
    let mut bytes = vec![0; option.value_len()];
    option.emit_value(&mut bytes);
    bytes
}

/// The rate, the burst in nanoseconds, and the limit that the kernel tells of.
fn told(links: &mut Links, index: u32) -> (u64, u64, u32) {
    let discipline = links.root_discipline(index).unwrap();
    let options = discipline.iter().find_map(|attribute| match attribute {
        TcAttribute::Options(options) => options.first(),
        _ => None,
    });
    let Some(TcOption::Other(options)) = options else { panic!("no options: {discipline:?}") };
    let options = bytes(options);
    let value = |kind| {
        let mut all = NlasIterator::new(options.as_slice()).flatten();
        all.find(|nla| nla.kind() == kind).map(|nla| nla.value().to_vec())
    };
    let parameters = value(TCA_TBF_PARMS).expect("struct tc_tbf_qopt");
    let field = |at: usize| u32::from_ne_bytes(parameters[at..at + 4].try_into().unwrap());
    let rate64 = value(TCA_TBF_RATE64).map(|rate| u64::from_ne_bytes(rate.try_into().unwrap()));
    // A tick of the kernel's is 64 ns (/proc/net/psched).
    (rate64.unwrap_or(field(8).into()), u64::from(field(28)) * 64, field(24))
}

/// Whether this kernel has a token bucket.
fn limited(links: &mut Links, index: u32) -> bool {
    match links.limit_rate(index, &SHAPING) {
        Err(refused) if refused.is_unsupported() => {
            let _ = writeln!(std::io::stderr(), "SKIP tbf: {refused}");
            false
        }
        outcome => outcome.map(|()| true).unwrap(),
    }
}

#[test]
fn a_token_bucket_is_asked_for_as_the_kernel_lays_it_out() {
    let [parameters, burst] = SHAPING.options().try_into().unwrap();
    let mut expected = [0; 36];
    expected[1] = 1;
    expected[6..8].copy_from_slice(&1000_u16.to_ne_bytes());
    expected[8..12].copy_from_slice(&125_000_u32.to_ne_bytes());
    expected[24..28].copy_from_slice(&5000_u32.to_ne_bytes());
    assert_eq!((parameters.kind(), bytes(&parameters)), (TCA_TBF_PARMS, expected.to_vec()));
    assert_eq!((burst.kind(), bytes(&burst)), (TCA_TBF_BURST, 2000_u32.to_ne_bytes().to_vec()));

    let fast = 10_000_000_000;
    let [parameters, _, rate] = Shaping { bytes_per_second: fast, ..SHAPING }.options().try_into().unwrap();
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
        assert_eq!(told(&mut links, a), (125_000, 16_000_000, 5000));
        assert_eq!(links.shaping(a).unwrap(), Some(ShapingStatistics::default()));

        let fast = Shaping { bytes_per_second: 10_000_000_000, burst: 1_000_000, least: 0, limit: 2_000_000 };
        links.limit_rate(a, &fast).unwrap();
        let (rate, burst, limit) = told(&mut links, a);
        assert_eq!((rate, limit), (10_000_000_000, 2_000_000));
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
        // So slow that hardly anything leaves later.
        links
            .limit_rate(a, &Shaping { bytes_per_second: 10, burst: 2000, least: 1000, limit: 5000 })
            .unwrap();
        for _ in 0..20 {
            let _ = socket.send(&[0; 1000 - 42]); // ENOBUFS, for what is dropped
        }
        let ShapingStatistics { bytes, packets, drops, backlog } = links.shaping(a).unwrap().unwrap();
        assert!(bytes <= 2000 && packets >= 1, "{packets} packets of {bytes} bytes went through");
        assert!((4000..=5000).contains(&backlog), "{backlog} bytes wait");
        assert!(drops >= 13, "{drops} packets were dropped");

        // Asked for again, it goes on counting.
        links.limit_rate(a, &SHAPING).unwrap();
        assert!(links.shaping(a).unwrap().unwrap().drops >= drops);
    });
}

#[test]
fn a_rate_or_a_burst_of_nothing_is_refused() {
    in_a_namespace("a_rate_or_a_burst_of_nothing_is_refused", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        if !limited(&mut links, a) {
            return;
        }
        for shaping in [Shaping { bytes_per_second: 0, ..SHAPING }, Shaping { burst: 0, ..SHAPING }] {
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
