//! A protocol of one's own, without IP: `cargo run --example raw_packets -- STATION [ADDRESS]` listens, or sends to an address on
//! the medium (such as `ff:ff:ff:ff:ff:ff`) once a second.

// Programs wait, and measure, by their own clock.
#![allow(clippy::disallowed_methods)]

mod shared;

use std::process::ExitCode;
use std::time::Duration;

use rtnet::api::Station;
use rtnet::socket::{LinkMode, LinkType, Sender};
use rtnet::wire::ethernet::{Address, EtherType};

/// IEEE 802 local experimental 2.
const OWN: EtherType = EtherType(0x88b6);

fn main() -> ExitCode {
    shared::end(run())
}

fn run() -> Result<(), String> {
    let mut args = std::env::args().skip(1);
    let name = args.next().ok_or("usage: raw_packets STATION [ADDRESS]")?;
    let failed = shared::of(&name);
    let open = |station: Station| station.packet(LinkMode::Datagram, LinkType::Only(OWN));
    let socket = Station::named(&name).and_then(open).map_err(&failed)?;
    if let Some(to) = args.next() {
        let to: Address = shared::read(&to, "address on the medium, as ff:ff:ff:ff:ff:ff")?;
        for n in 1.. {
            socket.send_to(format!("number {n}").as_bytes(), to, OWN).map_err(&failed)?;
            std::thread::sleep(Duration::from_secs(1));
        }
    }
    let mut room = [0; 1500];
    loop {
        let received = socket.receive(&mut room).map_err(&failed)?;
        if let Sender::Link(from) = received.from {
            let text = String::from_utf8_lossy(&room[..received.len]);
            println!("{} says: {}", from.address, text.trim_end_matches('\0'));
        }
    }
}
