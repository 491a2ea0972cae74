//! Round trips to who echoes: `cargo run --example rtt -- STATION ADDRESS:PORT [COUNT]`, beside `udp_echo` on the station with
//! that address.

// Programs wait, and measure, by their own clock.
#![allow(clippy::disallowed_methods)]

mod shared;

use std::io::ErrorKind;
use std::net::SocketAddrV4;
use std::num::NonZeroU64;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use rtnet::api::Station;

fn main() -> ExitCode {
    shared::end(run())
}

fn run() -> Result<(), String> {
    let mut args = std::env::args().skip(1);
    let usage = "usage: rtt STATION ADDRESS:PORT [COUNT]";
    let name = args.next().ok_or(usage)?;
    let to: SocketAddrV4 = shared::read(&args.next().ok_or(usage)?, "ADDRESS:PORT, as 10.0.0.2:36000")?;
    let count = args.next().unwrap_or("1000".into());
    let count = shared::read::<NonZeroU64>(&count, "COUNT of round trips: write 1 or more")?.get();
    let failed = shared::of(&name);
    let socket = Station::named(&name).and_then(|station| station.udp()).map_err(&failed)?;
    socket.set_timeout(Some(Duration::from_secs(1)));
    let mut took = Vec::new();
    for n in 0..count {
        let begun = Instant::now();
        socket.send_to(&n.to_be_bytes(), to).map_err(&failed)?;
        let mut answer = [0; 8];
        loop {
            match socket.receive(&mut answer) {
                // One that comes after its time is not this one's.
                Ok(received) if received.len == 8 && u64::from_be_bytes(answer) == n => {
                    took.push(begun.elapsed());
                    break;
                }
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::TimedOut => break,
                Err(error) => return Err(failed(error)),
            }
        }
    }
    took.sort_unstable();
    let lost = count - took.len() as u64;
    match (took.first(), took.last()) {
        (Some(least), Some(most)) => {
            let (p50, p99) = (took[took.len() / 2], took[took.len() * 99 / 100]);
            println!(
                "{count} round trips, {lost} lost: min {least:?}, p50 {p50:?}, p99 {p99:?}, max {most:?}"
            );
            Ok(())
        }
        _ => Err(format!("{count} round trips, all lost: is `udp_echo` running at {to}?")),
    }
}
