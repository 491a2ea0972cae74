//! Round trips over a medium in namespaces, for `scripts/bench-stack`. Says `ready`, and then answers every line with one
//! of JSON, in nanoseconds:
//!
//! ```text
//! station WAY CORES SECONDS          64 bytes of UDP there and back, between programs in the threads of two stations
//! linux WAY CORES SECONDS            the same by sockperf between two hosts with the kernel's stack, on the same bridge
//! program WAY CORES CORES SECONDS    the same between programs in processes of their own: the stations' cores, and theirs
//! alone CORES SECONDS                a program and its station, which both spin, there and back by loopback
//! hops CORES SECONDS                 four eventfd hops between two processes, there and back twice
//! fragments CORES SECONDS            datagrams of 60 000 bytes in slots: the share of what those allow
//! fragments virtual SIZE             the same in virtual time, in slots of this size
//! ```
//!
//! WAY is `block` (SCHED_FIFO) or `spin` (ordinary scheduling: the kernel would stop who spins for 50 ms of each second);
//! CORES are two, as `0,1`.

// Real time is what is measured.
#![allow(clippy::disallowed_methods)]

mod figures;
mod fragments;
mod hops;
mod lines;
mod linux;
mod processes;
mod programs;
mod stations;

use std::str::FromStr;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use serde_json::Value;
use tools::lab::namespace::{Namespace, Segment};

use lines::{Cores, answer_all, seconds, two};

/// Bytes of a message, as of sockperf's.
const MESSAGE: usize = 64;
/// What a measurement begins with, and does not count.
const WARM_UP: Duration = Duration::from_millis(300);
/// A message that has not come back by then is lost.
const PATIENCE: u64 = 200_000_000;
/// As real-time threads of stations and of programs are.
const STATION_PRIORITY: i32 = 80;
const PROGRAM_PRIORITY: i32 = 70;

/// Whether who waits sleeps.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Way {
    Block,
    Spin,
}

/// The medium: two stations' namespaces, and two of hosts.
struct Network {
    stations: [Namespace; 2],
    hosts: [Namespace; 2],
    _segment: Segment,
}

impl Way {
    fn name(self) -> &'static str {
        if self == Way::Block { "block" } else { "spin" }
    }

    /// The priority of who waits so.
    fn priority(self, priority: i32) -> Option<i32> {
        (self == Way::Block).then_some(priority)
    }
}

impl FromStr for Way {
    type Err = anyhow::Error;
    fn from_str(text: &str) -> Result<Self> {
        [Way::Block, Way::Spin].into_iter().find(|way| way.name() == text).context("block or spin")
    }
}

impl Network {
    fn new() -> Result<Self> {
        let mut segment = Segment::new()?;
        let mut attached = |place: usize, address: [u8; 6]| -> Result<Namespace> {
            let namespace = Namespace::new()?;
            segment.attach(&namespace, &format!("port{place}"), "rt0", address)?;
            Ok(namespace)
        };
        let stations = [attached(0, tests::stacks::address(0).0)?, attached(1, tests::stacks::address(1).0)?];
        let hosts = [attached(2, linux::ADDRESS[0])?, attached(3, linux::ADDRESS[1])?];
        linux::introduce(&hosts)?;
        Ok(Self { stations, hosts, _segment: segment })
    }

    fn answer(&self, line: &str) -> Result<Value> {
        match line.split_whitespace().collect::<Vec<_>>()[..] {
            ["station", way, cores, time] => {
                stations::trips(&self.stations, way.parse()?, two(cores)?, seconds(time)?)
            }
            ["linux", way, cores, time] => {
                linux::trips(&self.hosts, way.parse()?, two(cores)?, seconds(time)?)
            }
            ["program", way, cores, programs, time] => {
                let cores = (two(cores)?, two(programs)?);
                processes::trips(&self.stations, way.parse()?, cores, seconds(time)?)
            }
            ["alone", cores, time] => processes::alone(&self.stations[0], two(cores)?, seconds(time)?),
            ["hops", cores, time] => hops::measure(two(cores)?, seconds(time)?),
            ["fragments", "virtual", size] => fragments::in_virtual_time(size.parse()?),
            ["fragments", cores, time] => fragments::live(&self.stations, two(cores)?, seconds(time)?),
            _ => bail!("'{line}' is nothing that can be measured"),
        }
    }
}

fn main() -> Result<()> {
    let arguments = lines::arguments();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        // What this program starts itself.
        ["pings", path, way, core, time] => {
            println!("{}", processes::pings(path, way.parse()?, core.parse()?, seconds(time)?)?);
            return Ok(());
        }
        ["echoes", path, way, core] => return processes::echoes(path, way.parse()?, core.parse()?),
        ["hops", core] => return hops::answer(core.parse()?),
        [] => {}
        _ => bail!("no arguments: what is to be measured is said on standard input"),
    }
    if !tests::host::is_root("bench trips") {
        return Ok(());
    }
    let network = Network::new()?;
    println!("ready");
    answer_all(|line| network.answer(line))
}
