//! `rtnet stat`.

use std::collections::BTreeMap;

use super::Failure;
use super::interface::{asked, unasked};
use super::tdma::found;
use crate::cli::ShowArgs;
use crate::control::{CountersShown, StackReply, StackRequest, VnicCounted};
use crate::report::text::grouped;

/// Shows everything that a station counts.
pub fn stat(args: &ShowArgs) -> Result<u8, Failure> {
    let which = found(&args.which)?;
    let shown = match asked(&which, StackRequest::Counters)? {
        StackReply::Counters(shown) => *shown,
        _ => return Err(unasked(&which)),
    };
    super::print(which.json, &shown, describe).map_err(Failure::Run)?;
    Ok(0)
}

/// What has happened; what has not is in the JSON only.
fn describe(shown: &CountersShown) -> String {
    let CountersShown {
        name,
        station,
        port,
        refused,
        programs,
        stack,
        loopback,
        sockets,
        packages,
        tcp,
        vnic,
    } = shown;
    let mut text = format!("{name}:\n");
    for (title, counts) in [("station", station), ("port", port), ("refused frames", refused)] {
        text += &line(title, counts);
    }
    // A station with a VNIC may have no stack.
    if !stack.is_empty() {
        for (title, counts) in
            [("stack", stack), ("programs", programs), ("refused of what it sent to itself", loopback)]
        {
            text += &line(title, counts);
        }
    }
    for (socket, counts) in sockets {
        text += &line(socket, counts);
    }
    text += &packages.as_ref().map_or(String::new(), |counts| line("packages by the LAN", counts));
    if let Some(tcp) = tcp {
        text += &format!("TCP {}\n", tcp.state());
        text += &line("packages by TCP", &tcp.counters);
        text += &line("packages by TCP, lost", &tcp.lost);
        text += &line("packages by TCP, lost at the router", &tcp.lost_at_router);
    }
    match vnic {
        None => {}
        Some(VnicCounted { unknown: Some(why), .. }) => text += &format!("VNIC: not known: {why}\n"),
        Some(VnicCounted { counters, lost, filter, .. }) => {
            for (title, counts) in
                [("VNIC", counters), ("VNIC, lost", lost), ("VNIC, Linux held back", filter)]
            {
                text += &line(title, counts);
            }
        }
    }
    text
}

fn line(title: &str, counts: &BTreeMap<String, u64>) -> String {
    let happened = counts.iter().filter(|(_, n)| **n > 0);
    let shown: Vec<String> = happened.map(|(name, n)| format!("{name} {}", grouped(*n))).collect();
    match shown.as_slice() {
        [] => format!("{title}: nothing\n"),
        some => format!("{title}: {}\n", some.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(all: &[(&str, u64)]) -> BTreeMap<String, u64> {
        all.iter().map(|&(name, n)| (name.to_owned(), n)).collect()
    }

    #[test]
    fn what_a_vnic_has_lost_is_shown_without_a_stack_and_that_it_does_not_answer_too() {
        let mut shown = CountersShown {
            name: "arm".into(),
            station: counts(&[("frames_sent", 3)]),
            vnic: Some(VnicCounted {
                counters: counts(&[("sent", 3), ("received", 1_000), ("put_off", 0)]),
                lost: counts(&[("too_long", 7)]),
                ..VnicCounted::default()
            }),
            ..CountersShown::default()
        };
        assert_eq!(
            describe(&shown),
            "arm:\nstation: frames_sent 3\nport: nothing\nrefused frames: nothing\n\
             VNIC: received 1 000, sent 3\nVNIC, lost: too_long 7\nVNIC, Linux held back: nothing\n"
        );
        shown.vnic = Some(VnicCounted { unknown: Some("it has ended".into()), ..VnicCounted::default() });
        assert!(describe(&shown).ends_with("\nVNIC: not known: it has ended\n"));
    }
}
