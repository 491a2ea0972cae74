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
    match ask(&Directory::of_user(), place, Request::Vnic(request)).map_err(Failure::Usage)? {
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
                "Linux is held back to {} bytes/s: {} packets passed on, {} dropped, {} wait\n",
                grouped(*rate),
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
    let lost: Vec<String> = shown.lost.iter().map(named).collect();
    text += &format!("lost: {}\n", if lost.is_empty() { "none".into() } else { lost.join(", ") });
    let pool = &shown.pool;
    text += &format!("buffers: {} of {} free, {} at the least\n", pool.free, pool.capacity, pool.least);
    text + &shown.news.as_ref().map_or(String::new(), |news| format!("{news}\n"))
}
