//! A program that is a station itself, and works in step with the cycle in another of its threads. For a station that is another
//! process, see `wait_on_cycle` of `rtnet`.
//!
//! As a master on one end of a wire that leads nowhere, as any user who may have user namespaces:
//!
//! ```text
//! cargo build -p rtmac --example own_station
//! unshare --user --map-root-user --net sh -c '
//!     ip link add rt0 type veth peer name rt1; ip link set rt0 up; ip link set rt1 up
//!     target/debug/examples/own_station rt0'
//! ```
//!
//! On two machines of one segment: `own_station eth1` on the one, `own_station eth1 slave` on the other.

// It is a shell, as rtnet::live is: it sleeps.
#![allow(clippy::disallowed_methods)]

use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_REQUESTS, DEFAULT_MAX_SLOT_ID, DEFAULT_ROUNDS, LatePolicy, MasterConfig,
    RoleConfig, SlaveConfig, SlotConfig, Tdma, TdmaConfig,
};
use rtnet::clock::EmulatedClock;
use rtnet::live::clock::{monotonic, realtime};
use rtnet::live::interface::Interface;
use rtnet::live::{Driver, DriverConfig, GuardMode, Port, TimeBoard};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::MTU;

const CYCLE: Span = Span::from_millis(1);
/// Whoever waits says how long at the most.
const SYNCHRONISED_WITHIN: Duration = Duration::from_secs(10);
const CYCLE_WITHIN: Duration = Duration::from_millis(100);

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let interface = arguments.next().ok_or("which interface? own_station IF [slave]")?;
    let is_slave = arguments.next().is_some_and(|role| role == "slave");
    let stop = Arc::new(AtomicBool::new(false));
    let mut driver = driver(&interface, is_slave, stop.clone())?;
    let time = driver.time();
    let station = std::thread::spawn(move || driver.run());
    let worked = work(&time);
    stop.store(true, Ordering::Relaxed);
    station.join().map_err(|_| "the station panicked")?;
    worked
}

/// Ten cycles of work in step with the network.
fn work(time: &Arc<TimeBoard>) -> Result<(), Box<dyn Error>> {
    let mut waiter = time.waiter();
    waiter.wait_synchronised(SYNCHRONISED_WITHIN)?;
    for _ in 0..10 {
        let cycle = waiter.wait_cycle(CYCLE_WITHIN)?;
        let global = cycle.offset.global(cycle.start).nanos();
        let late = time.now() - cycle.start;
        println!("cycle {}: began at {global} ns of global time, woken {late} later", cycle.number);
    }
    Ok(())
}

/// A station of the network: its master, or a slave with a slot that begins 300 us after the cycle.
fn driver(name: &str, is_slave: bool, stop: Arc<AtomicBool>) -> Result<Driver<Tdma>, Box<dyn Error>> {
    let interface = Interface::find(name)?;
    let clock = EmulatedClock::default();
    let latest = Span::from_micros(50);
    let follow = SlaveConfig { rounds: DEFAULT_ROUNDS, ..SlaveConfig::default() };
    let epoch = Offset::between(Instant::from_nanos(monotonic()), GlobalTime::from_nanos(realtime()));
    let master = MasterConfig {
        cycle: CYCLE,
        sync_latest: latest,
        reply_latest: latest,
        epoch,
        resume: None,
        backup: None,
        backups_from: None,
        max_requests: DEFAULT_MAX_REQUESTS,
        behind_sync: None,
        follow,
    };
    let slot = SlotConfig {
        id: 0,
        offset: Span::from_micros(300),
        phase: 0,
        period: 1,
        size: MTU,
        joint: None,
        latest,
    };
    let tdma = Tdma::new(&TdmaConfig {
        address: interface.address,
        role: if is_slave { RoleConfig::Slave(follow) } else { RoleConfig::Master(master) },
        slots: if is_slave { vec![slot] } else { Vec::new() },
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    })?;
    let spin = DEFAULT_LEAD.nanos() as u64;
    let port = Port::open(&interface, &[], clock, spin, GuardMode::Auto)?;
    let config = DriverConfig { stop, sample_time: false, changed: None };
    Ok(Driver::new(Station::new(tdma, Vec::new()), port, config))
}
