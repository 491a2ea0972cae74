//! A program in step with the cycle of a station that is another process: `cargo run --example wait_on_cycle -- STATION [OFFSET_US]`
//! wakes ten times, each at a cycle's start, or so many microseconds behind it. A program that is a station itself is
//! `own_station` of `rtmac`.

mod shared;

use std::process::ExitCode;
use std::time::Duration;

use rtnet::api::Station;
use rtnet::live::WaitError;
use rtnet::time::Span;

/// Whoever waits says how long at the most. No cycle is longer.
const WITHIN: Duration = Duration::from_secs(100);
/// How long a station is waited for that is not synchronised, or not any more.
const SYNCHRONISED_WITHIN: Duration = Duration::from_secs(10);

fn main() -> ExitCode {
    shared::end(run())
}

fn run() -> Result<(), String> {
    let mut args = std::env::args().skip(1);
    let name = args.next().ok_or("usage: wait_on_cycle STATION [OFFSET_US]")?;
    let offset = args.next().unwrap_or("0".into());
    let offset = Span::from_micros(shared::read(&offset, "OFFSET_US: write microseconds, as 250")?);
    let time = Station::named(&name).and_then(|station| station.time()).map_err(shared::of(&name))?;
    let failed = |error| format!("station '{name}': {error}");
    let mut waiter = time.waiter();
    let mut woken = 0;
    while woken < 10 {
        let cycle = match waiter.wait_slot(offset, WITHIN) {
            // It has not found its master yet, or a busy host has held up two syncs in a row.
            Err(WaitError::NotSynchronised(_)) => {
                waiter.wait_synchronised(SYNCHRONISED_WITHIN).map_err(failed)?;
                continue;
            }
            cycle => cycle.map_err(failed)?,
        };
        woken += 1;
        let global = cycle.offset.global(cycle.start).nanos();
        let late = time.now() - (cycle.start + offset);
        println!("cycle {}: began at {global} ns of global time, woken {late} late", cycle.number);
    }
    Ok(())
}
