//! Measures a package router from its clients. One thread of this process runs all clients; the router is another process. A run
//! makes one measurement and prints it as a line of JSON; `scripts/bench-router` starts the runs.
//!
//! ```text
//! router bare PORT                              forwards bytes between each two connections, and does nothing else
//! router trips PROTOCOL PORT SECONDS CLIENTS    64 bytes there and back between two of CLIENTS clients, one after the other
//! router rate PROTOCOL PORT SECONDS PAIRS       64 bytes from PAIRS senders, each to its own receiver
//! router spread PROTOCOL PORT SECONDS PAIRS     the same from each sender to all receivers in turn
//! router idle PROTOCOL PORT PID CLIENTS         memory of a process before and after CLIENTS clients have joined
//! router behind PORT SECONDS                    an answer of the router and an urgent package, behind 10 000 packages that wait
//! router lifesigns PORT ROUNDS                  a question for a sign of life behind them, in ROUNDS rounds of 5 s
//! router answers ROUNDS                         a client's answer to such a question, behind 10 000 packages of both
//! router burden PORT TLS-PORT                   a client that does not read, one that sends a byte a second, 1000 that say nothing, and
//!                                               250 that begin a TLS session and go no further
//! router compare PORT PORT SECONDS PID ..       a router that has these burdens, its process and theirs, with one that has none
//! ```

// A benchmark waits, and reads clocks.
#![allow(clippy::disallowed_methods)]

mod bare;
mod behind;
mod burdens;
mod clients;
mod protocols;

use std::net::SocketAddr;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, Result, bail};

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| word != "--bench").collect();
    match asked(&words.iter().map(String::as_str).collect::<Vec<_>>()) {
        Ok(line) => {
            println!("{line}");
            ExitCode::SUCCESS
        }
        Err(why) => {
            println!("{}", serde_json::json!({ "error": format!("{why:#}") }));
            ExitCode::FAILURE
        }
    }
}

fn asked(words: &[&str]) -> Result<serde_json::Value> {
    let at = |port: &str| {
        Ok::<_, anyhow::Error>(SocketAddr::from(([127, 0, 0, 1], port.parse().context("a port")?)))
    };
    let seconds = |of: &str| Ok::<_, anyhow::Error>(Duration::from_secs_f64(of.parse().context("seconds")?));
    match *words {
        ["bare", port] => bare::forward(at(port)?),
        ["trips", protocol, port, time, clients] => {
            clients::trips(protocols::named(protocol)?, at(port)?, seconds(time)?, clients.parse()?)
        }
        [which @ ("rate" | "spread"), protocol, port, time, pairs] => {
            let protocol = protocols::named(protocol)?;
            clients::rate(protocol, at(port)?, seconds(time)?, pairs.parse()?, which == "spread")
        }
        ["idle", protocol, port, pid, count] => {
            clients::idle(protocols::named(protocol)?, at(port)?, pid.parse()?, count.parse()?)
        }
        ["behind", port, time] => behind::behind(at(port)?, seconds(time)?),
        ["lifesigns", port, rounds] => behind::lifesigns(at(port)?, rounds.parse()?),
        ["answers", rounds] => behind::answers(rounds.parse()?),
        ["burden", port, by_tls] => burdens::burden(at(port)?, at(by_tls)?),
        ["compare", burdened, free, time, ref pids @ ..] => {
            burdens::compare(at(burdened)?, at(free)?, pids, seconds(time)?)
        }
        _ => bail!("what is to be measured? See the head of tests/benches/router/main.rs"),
    }
}
