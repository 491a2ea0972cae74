//! A program in step with the cycle of a station that is another process: `cargo run --example wait_on_cycle -- STATION [OFFSET_US]`
//! wakes ten times, each at a cycle's start, or so many microseconds behind it. A program that is a station itself is
//! `own_station` of `rtmac`.

use std::error::Error;
use std::time::Duration;

use rtnet::api::Station;
use rtnet::time::Span;

/// Whoever waits says how long at the most. No cycle is longer.
const WITHIN: Duration = Duration::from_secs(100);

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let name = args.next().ok_or("usage: wait_on_cycle STATION [OFFSET_US]")?;
    let offset = Span::from_micros(args.next().map_or(Ok(0), |offset| offset.parse())?);
    let time = Station::named(&name)?.time()?;
    let mut waiter = time.waiter();
    waiter.wait_synchronised(Duration::from_secs(10))?;
    for _ in 0..10 {
        let cycle = waiter.wait_slot(offset, WITHIN)?;
        let global = cycle.offset.global(cycle.start).nanos();
        let late = time.now() - (cycle.start + offset);
        println!("cycle {}: began at {global} ns of global time, woken {late} late", cycle.number);
    }
    Ok(())
}
