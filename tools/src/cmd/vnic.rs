//! `rtnet vnic`.

use anyhow::anyhow;

use super::Failure;
use super::tdma::found_of;
use crate::cli::{VnicVerb, VnicVerbArgs};
use crate::control::{Directory, Reply, Request, VnicChange, VnicRequest, VnicShown, ask};
use crate::report::text::grouped;

/// Looks at a station's VNIC, or changes it.
pub fn vnic(args: &VnicVerbArgs) -> Result<u8, Failure> {
    let which = found_of(&args.which)?;
    let request = match &args.verb {
        VnicVerb::Status => VnicRequest::Status,
        VnicVerb::Up => VnicRequest::Up,
        VnicVerb::Down => VnicRequest::Down,
        VnicVerb::Set { mtu, address, no_address, peer } => {
            fn texts<T: ToString>(all: &[T]) -> Vec<String> {
                all.iter().map(T::to_string).collect()
            }
            let (add, remove, peers) = (texts(address), texts(no_address), texts(peer));
            let change = VnicChange { mtu: mtu.map(usize::from), add, remove, peers };
            if change == VnicChange::default() {
                return Err(Failure::Usage(anyhow!(
                    "nothing is to be changed: say what, see `rtnet vnic set --help`"
                )));
            }
            VnicRequest::Set(change)
        }
    };
    let place = &which.place;
    let directory = Directory::of_user().map_err(Failure::Usage)?;
    match ask(&directory, place, Request::Vnic(request)).map_err(Failure::Usage)? {
        Reply::Vnic(shown) => {
            super::print(which.json, &*shown, describe).map_err(Failure::Run)?;
            Ok(0)
        }
        Reply::Refused(why) => Err(Failure::Usage(anyhow!("station '{place}': {why}"))),
        _ => Err(super::interface::unasked(&which)),
    }
}

fn describe(shown: &VnicShown) -> String {
    let VnicShown { device, mode, state, mtu, mtu_at_most, slot_takes, addresses, peers, .. } = shown;
    let addresses = if addresses.is_empty() { "no address".into() } else { addresses.join(", ") };
    let kind = if shown.proxy { "proxy" } else { mode };
    let mut text = format!("{device} ({kind}, {state}): {addresses}\n");
    text += &shown.mac.as_ref().map_or(String::new(), |mac| format!("MAC {mac}\n"));
    text += &match mtu {
        0 => String::new(),
        _ => format!("MTU {mtu}: the slot takes {slot_takes}, {mtu_at_most} at the most\n"),
    };
    text += &shown.remarks.iter().map(|remark| format!("{remark}\n")).collect::<String>();
    text += &peers.iter().map(|peer| format!("station {}\n", peer.replace('=', " is "))).collect::<String>();
    text += &match (&shown.bytes_per_second, &shown.not_held_back) {
        (Some(rate), _) => {
            let count = |name: &str| grouped(shown.filter.get(name).copied().unwrap_or(0));
            format!(
                "Linux is held back to {} bytes/s{}: {} packets passed on, {} dropped, {} wait\n",
                grouped(*rate),
                shown.held_back_as_before.as_ref().map_or(String::new(), |why| format!(" as before ({why})")),
                count("packets"),
                count("dropped"),
                count("waiting")
            )
        }
        (None, Some(why)) => format!("Linux is not held back: {why}\n"),
        (None, None) => String::new(),
    };
    let named = |(name, n): (&String, &u64)| format!("{name} {}", grouped(*n));
    text += &format!("frames: {}\n", shown.counters.iter().map(named).collect::<Vec<_>>().join(", "));
    let lost: Vec<String> = shown.lost.iter().filter(|(_, n)| **n > 0).map(named).collect();
    text += &format!("lost: {}\n", if lost.is_empty() { "none".into() } else { lost.join(", ") });
    let pool = &shown.pool;
    text += &format!("buffers: {} of {} free, {} at the least\n", pool.free, pool.capacity, pool.least);
    text + &shown.news.as_ref().map_or(String::new(), |news| format!("{news}\n"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::PoolShown;
    use std::collections::BTreeMap;

    fn named(counts: &[(&str, u64)]) -> BTreeMap<String, u64> {
        counts.iter().map(|&(name, n)| (name.to_owned(), n)).collect()
    }

    #[test]
    fn what_is_lost_is_told_by_reason_and_the_rate_with_what_stands_in_its_way() {
        let pool = "vnic".into();
        let mut shown = VnicShown {
            device: "vnic0".into(),
            mode: "tap".into(),
            proxy: false,
            state: "up".into(),
            mtu: 1_496,
            mtu_at_most: 1_496,
            slot_takes: 1_496,
            addresses: Vec::new(),
            peers: Vec::new(),
            bytes_per_second: Some(1_487_350),
            held_back_as_before: None,
            not_held_back: None,
            filter: named(&[("packets", 50), ("dropped", 49_117), ("waiting", 5)]),
            counters: named(&[("sent", 50)]),
            lost: named(&[("filter_dropped", 49_117), ("too_long", 0)]),
            pool: PoolShown { pool, capacity: 64, free: 64, least: 60, exhausted: 0, dropped: 0 },
            mac: None,
            remarks: Vec::new(),
            news: None,
        };
        let lines = |shown: &VnicShown| describe(shown).lines().map(str::to_owned).collect::<Vec<_>>();
        let told = lines(&shown);
        let counted = ": 50 packets passed on, 49 117 dropped, 5 wait";
        assert_eq!(told[2], format!("Linux is held back to 1 487 350 bytes/s{counted}"));
        assert_eq!(told[4], "lost: filter_dropped 49 117");
        shown.held_back_as_before = Some("no cycle is known any more".into());
        let before = " as before (no cycle is known any more)";
        assert_eq!(lines(&shown)[2], format!("Linux is held back to 1 487 350 bytes/s{before}{counted}"));
        (shown.bytes_per_second, shown.held_back_as_before) = (None, None);
        shown.not_held_back = Some("there are no slots".into());
        shown.lost = named(&[("filter_dropped", 0), ("too_long", 0)]);
        let told = lines(&shown);
        assert_eq!((&*told[2], &*told[4]), ("Linux is not held back: there are no slots", "lost: none"));
    }
}
