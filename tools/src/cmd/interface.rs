//! `rtnet if`.

use anyhow::anyhow;

use super::Failure;
use super::tdma::found;
use crate::cli::{ShowArgs, Which};
use crate::control::{Directory, InterfaceShown, StackReply, StackRequest, ask_stack};
use crate::report::text::grouped;

/// Shows a station's place in the Internet Protocol.
pub fn interface(args: &ShowArgs) -> Result<u8, Failure> {
    let which = found(&args.which)?;
    let shown = match asked(&which, StackRequest::Interface)? {
        StackReply::Interface(shown) => *shown,
        _ => return Err(unasked(&which)),
    };
    super::print(which.json, &shown, describe).map_err(Failure::Run)?;
    Ok(0)
}

/// Asks a station about its sockets, addresses and routes.
pub fn asked(which: &Which, request: StackRequest) -> Result<StackReply, Failure> {
    ask_stack(&Directory::of_user(), &which.place, request).map_err(Failure::Usage)
}

/// A station of another version.
pub fn unasked(which: &Which) -> Failure {
    Failure::Run(anyhow!("station '{}' answers what it was not asked", which.place))
}

fn describe(shown: &InterfaceShown) -> String {
    let InterfaceShown { name, interface, address, ip, prefix, broadcast, link, mtu, channels, counters } =
        shown;
    let broadcast = broadcast.map_or(String::new(), |broadcast| format!(", broadcast {broadcast}"));
    let mut text =
        format!("{name}: {ip}/{prefix}{broadcast}\non {interface} ({address}, {link}), MTU {mtu}\n");
    for (channel, takes) in channels {
        text += &match (takes.payload, &takes.refused) {
            (Some(payload), _) => format!("channel {channel}: a payload of up to {payload} bytes\n"),
            (None, why) => format!("channel {channel}: {}\n", why.as_deref().unwrap_or("nothing")),
        };
    }
    let counts: Vec<String> = counters.iter().map(|(name, n)| format!("{name} {}", grouped(*n))).collect();
    text + &format!("counters: {}\n", counts.join(", "))
}
