//! The longest datagrams, a fragment in each slot: `cargo run --example big_datagrams -- STATION` receives and checks them, with
//! `ADDRESS:PORT` behind it sends one after the other.

// Programs wait, and measure, by their own clock.
#![allow(clippy::disallowed_methods)]

mod shared;

use std::net::{Ipv4Addr, SocketAddrV4};
use std::process::ExitCode;
use std::time::Duration;

use rtnet::api::Station;

/// The most that UDP carries, and the buffers that it takes in slots of 1500 bytes.
const LONGEST: usize = 65_507;
const BUFFERS: u32 = 45;

fn main() -> ExitCode {
    shared::end(run())
}

fn run() -> Result<(), String> {
    let mut args = std::env::args().skip(1);
    let name = args.next().ok_or("usage: big_datagrams STATION [ADDRESS:PORT]")?;
    let failed = shared::of(&name);
    let socket = Station::named(&name).and_then(|station| station.udp_with(2 * BUFFERS)).map_err(&failed)?;
    let content = |number: u8| (0..LONGEST).map(move |n| number.wrapping_add((n % 251) as u8));
    if let Some(to) = args.next() {
        let to: SocketAddrV4 = shared::read(&to, "ADDRESS:PORT, as 10.0.0.2:37000")?;
        for number in (0..=u8::MAX).cycle() {
            socket.send_to(&content(number).collect::<Vec<_>>(), to).map_err(&failed)?;
            std::thread::sleep(Duration::from_millis(500));
        }
    }
    socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 37_000)).map_err(&failed)?;
    let mut room = vec![0; LONGEST];
    loop {
        let received = socket.receive(&mut room).map_err(&failed)?;
        let is_whole = received.len == LONGEST && content(room[0]).eq(room.iter().copied());
        println!("{} bytes, {}", received.whole, if is_whole { "as they were sent" } else { "CHANGED" });
    }
}
