//! Mailboxes beside what else there is, for `scripts/bench-packages`. Answers every line with one of JSON, in nanoseconds:
//!
//! ```text
//! trips WHAT WAY CORES SECONDS                     64 bytes there and back between two processes, by WHAT
//! steps SUBJECT WAITING CORE SECONDS               push and pop in one thread, so many waiting meanwhile
//! pace SENDERS LOAD CORES                          how often so many must send so that they and who receives take that of a core
//! crowd SENDING AWAKE BOUND PERIOD CORES SECONDS   how long packages of the most urgent of so many senders take;
//!                                                  of none: 3 us of reading the clock by that one
//! ```
//!
//! WHAT is `mailbox`, `bells`, which are what is left of two mailboxes without packages, `mqueue`, or `iceoryx2`, whose program
//! `RTNET_PEER` names; WAY is `block` (SCHED_FIFO) or `spin` (ordinary
//! scheduling: the kernel would stop who spins for 50 ms of each second). CORES are two, as `0,1`. With the arguments
//! `count SUBJECT TIMES` it does that so often and measures nothing: for tools that count instructions.

// Real time is what is measured.
#![allow(clippy::disallowed_methods)]

mod bare;
mod crowd;
mod exchange;
// It counts what is lost, too: nothing is here.
#[allow(dead_code)]
#[path = "../trips/figures.rs"]
mod figures;
#[path = "../trips/lines.rs"]
mod lines;
mod mailboxes;
mod mqueue;
mod process;
mod station;
mod steps;
mod trips;

use anyhow::{Result, bail};
use serde_json::Value;

use lines::{Cores, answer_all, seconds, two};

fn answer(line: &str) -> Result<Value> {
    match line.split_whitespace().collect::<Vec<_>>()[..] {
        ["trips", what, way, cores, time] => trips::measure(what, way.parse()?, two(cores)?, seconds(time)?),
        ["steps", subject, waiting, core, time] => {
            steps::measure(subject, waiting.parse()?, core.parse()?, seconds(time)?)
        }
        ["pace", senders, load, cores] => crowd::pace(senders.parse()?, load.parse()?, two(cores)?),
        ["crowd", sending, awake, bound, period, cores, time] => {
            let plan = crowd::Plan {
                sending: sending.parse()?,
                awake: awake.parse()?,
                bound: bound.parse()?,
                period: period.parse()?,
                time: seconds(time)?,
            };
            crowd::measure(&plan, two(cores)?)
        }
        _ => bail!("'{line}' is nothing that can be measured"),
    }
}

/// What this program starts itself.
fn child(arguments: &[&str]) -> Result<()> {
    match *arguments {
        ["trips", side, what, way, core, time, place] => {
            trips::child(side, what, way.parse()?, core.parse()?, seconds(time)?, place)
        }
        ["sink", core, place] => crowd::sink(core.parse()?, place),
        ["count", subject, times] => steps::count(subject, times.parse()?),
        _ => bail!("no arguments: what is to be measured is said on standard input"),
    }
}

fn main() -> Result<()> {
    let arguments = lines::arguments();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    if !arguments.is_empty() {
        return child(&arguments);
    }
    answer_all(answer)
}
