//! `rtnet stat`.

use std::collections::BTreeMap;

use super::Failure;
use super::interface::{asked, unasked};
use super::tdma::found;
use crate::cli::ShowArgs;
use crate::control::{CountersShown, StackReply, StackRequest};
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
    let CountersShown { name, station, port, refused, programs, stack, loopback, sockets } = shown;
    let mut text = format!("{name}:\n");
    for (title, counts) in [
        ("station", station),
        ("port", port),
        ("refused frames", refused),
        ("stack", stack),
        ("programs", programs),
        ("refused of what it sent to itself", loopback),
    ] {
        text += &line(title, counts);
    }
    for (socket, counts) in sockets {
        text += &line(socket, counts);
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
