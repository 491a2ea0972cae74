//! `rtnet if`.

use std::net::Ipv4Addr;

use anyhow::anyhow;
use rtnet::ip::route::{HostRoute, Interface, Origin, Routes};
use rtnet::wire::ethernet::Address;

use super::Failure;
use super::tdma::found;
use crate::cli::{ShowArgs, Which};
use crate::control::{Directory, InterfaceShown, StackReply, StackRequest, ask_stack};
use crate::report::text::grouped;

/// Shows a station's place in the Internet Protocol.
pub fn interface(args: &ShowArgs) -> Result<u8, Failure> {
    let which = found(&args.which)?;
    let mut shown = of_interface(&which)?;
    shown.silent = shown.silent.map(|why| with_place(&which, &why));
    super::print(which.json, &shown, describe).map_err(Failure::Run)?;
    Ok(0)
}

/// Asks a station about its sockets, addresses and routes.
pub fn asked(which: &Which, request: StackRequest) -> Result<StackReply, Failure> {
    Directory::of_user()
        .and_then(|directory| ask_stack(&directory, &which.place, request))
        .map_err(Failure::Usage)
}

/// The same of its place in the Internet Protocol.
pub fn of_interface(which: &Which) -> Result<InterfaceShown, Failure> {
    match asked(which, StackRequest::Interface)? {
        StackReply::Interface(shown) => Ok(*shown),
        _ => Err(unasked(which)),
    }
}

/// Refuses what a station asks of others and nobody can answer: while it is silent, or of an address that is no one station's.
/// Its own is not asked for on the medium.
pub fn check_asked(which: &Which, own: &InterfaceShown, ip: Ipv4Addr) -> Result<(), Failure> {
    let place = &which.place;
    let interface = Interface { address: Address::default(), ip: own.ip, prefix: own.prefix };
    let one = HostRoute { ip, address: Address::default(), origin: Origin::Static };
    Routes::new(interface, 1, 0).add_host(one).map_err(|error| {
        Failure::Usage(anyhow!("station '{place}': {error}; name one that another station has"))
    })?;
    match &own.silent {
        Some(why) => Err(Failure::Usage(anyhow!("station '{place}': {}", with_place(which, why)))),
        None => Ok(()),
    }
}

/// A station does not know by which name it is asked: commands that it tells of are told with it.
pub fn with_place(which: &Which, text: &str) -> String {
    let verbs = ["route", "tdma", "slot"];
    verbs.iter().fold(text.to_owned(), |text, verb| {
        text.replace(&format!("`rtnet {verb} "), &format!("`rtnet {verb} -S {} ", which.place))
    })
}

/// A station of another version.
pub fn unasked(which: &Which) -> Failure {
    Failure::Run(anyhow!("station '{}' answers what it was not asked", which.place))
}

fn describe(shown: &InterfaceShown) -> String {
    let InterfaceShown { name, interface, address, ip, prefix, broadcast, link, mtu, channels, .. } = shown;
    let InterfaceShown { discipline, silent, counters, .. } = shown;
    let broadcast = broadcast.map_or(String::new(), |broadcast| format!(", broadcast {broadcast}"));
    let mut text =
        format!("{name}: {ip}/{prefix}{broadcast}\non {interface} ({address}, {link}), MTU {mtu}\n");
    text += &silent.as_ref().map_or(String::new(), |why| format!("nothing leaves: {why}\n"));
    for (channel, takes) in channels {
        let which = if discipline == "tdma" { format!("channel {channel}") } else { "every channel".into() };
        text += &format!("{which}: a payload of up to {} bytes\n", takes.payload);
    }
    if channels.is_empty() {
        text += "no slots: nothing leaves until one is defined (`rtnet slot set`)\n";
    }
    let counts: Vec<String> = counters.iter().map(|(name, n)| format!("{name} {}", grouped(*n))).collect();
    text + &format!("counters: {}\n", counts.join(", "))
}
