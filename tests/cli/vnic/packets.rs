//! Single packets: the largest that goes through, and who is found by IPv6.

use super::{MODES, MTU, TUNNEL, assert_answers, lab, program, said, shared};
use crate::cell::text;

/// Headers of an echo: of IPv4 or IPv6, and of its own.
const HEAD: usize = 28;
const HEAD_OF_IPV6: usize = 48;

#[test]
fn an_unfragmented_ping_of_the_mtu_passes_and_one_byte_more_is_refused_by_linux() {
    shared("an_unfragmented_ping_of_the_mtu_passes_and_one_byte_more_is_refused_by_linux", || {
        for mode in MODES {
            let cell = lab("df", TUNNEL, mode);
            for (to, head) in [("10.1.0.1", HEAD), ("fd00::1", HEAD_OF_IPV6)] {
                assert_answers(&cell, "slave1", to);
                let ping = |size: usize| {
                    let size = size.to_string();
                    let words = ["ping", "-M", "do", "-c", "3", "-i", "0.2", "-W", "2", "-s", &size, to];
                    program(&cell, "slave1", &words).output().unwrap()
                };
                let (fits, more) = (ping(MTU - head), ping(MTU - head + 1));
                assert!(fits.status.success(), "{}", text(&fits.stdout));
                let why = (text(&more.stdout) + &text(&more.stderr)).to_lowercase();
                assert!(!more.status.success() && why.contains("message too long"), "{why}");
            }
            cell.down();
        }
    });
}

#[test]
fn stations_find_each_other_by_ipv6() {
    shared("stations_find_each_other_by_ipv6", || {
        for mode in MODES {
            let cell = lab("ipv6", TUNNEL, mode);
            for (to, address) in [("fd00::1", "02:00:00:00:00:01"), ("fd00::4", "02:00:00:00:00:04")] {
                assert_answers(&cell, "slave1", to);
                let neighbours = said(&cell, "slave1", &["ip", "-6", "neigh", "show", "dev", "vnic0"]);
                let is_found = neighbours.lines().any(|line| line.starts_with(to) && line.contains(address));
                // Where only packets go through a table says who has an address.
                assert_eq!(is_found, mode == "tap", "{mode}: {neighbours}");
            }
            cell.down();
        }
    });
}
