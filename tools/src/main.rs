//! The command `rtnet`.

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;
use tools::cli::{Cli, LabVerb, SimVerb, Verb};
use tools::{cmd, remedy};

fn main() -> ExitCode {
    // A lab starts this program as /proc/self/exe, by which `ps` and `top` would call it. It runs under any name.
    let _ = std::fs::write("/proc/self/comm", "rtnet");
    let cli = Cli::parse();
    // Stations, sockets and clients take descriptors, and the usual limit is far below what the host allows.
    let files = remedy::raise_files();
    let done = match &cli.verb {
        Verb::Lab(LabVerb::Run(args)) => cmd::lab_run::lab_run(args),
        Verb::Lab(LabVerb::Up(args)) => cmd::lab_up::lab_up(args),
        Verb::Lab(LabVerb::Down(args)) => cmd::lab::down(args),
        Verb::Lab(LabVerb::Status(args)) => cmd::lab::status(args),
        Verb::Lab(LabVerb::Restart(args)) => cmd::lab::restart(args),
        Verb::Lab(LabVerb::Exec(args)) => cmd::lab::exec(args, files),
        Verb::Sim(SimVerb::Run(args)) => cmd::sim::sim_run(args),
        Verb::Sim(SimVerb::Example) => cmd::sim::example(),
        Verb::Doctor(args) => cmd::doctor::doctor(args),
        Verb::FindMinCycle(args) => cmd::find_min_cycle::find_min_cycle(args),
        Verb::Plan(args) => cmd::plan::plan(args),
        Verb::Station(args) => cmd::station::station(args),
        Verb::Tdma(args) => cmd::tdma::tdma(args),
        Verb::Token(args) => cmd::token::token(args),
        Verb::Slot(args) => cmd::slot::slot(args),
        Verb::Schedule(args) => cmd::schedule::schedule(args),
        Verb::If(args) => cmd::interface::interface(args),
        Verb::Route(args) => cmd::route::route(args),
        Verb::Ping(args) => cmd::ping::ping(args),
        Verb::Pool(args) => cmd::pool::pool(args),
        Verb::Stat(args) => cmd::stat::stat(args),
        Verb::Vnic(args) => cmd::vnic::vnic(args),
        Verb::Mailbox(args) => cmd::package::mailbox(args),
        Verb::Package(args) => cmd::package::package(args),
        Verb::Router(args) => cmd::router::router(args),
        Verb::Completions { shell } => cmd::manual::completions(*shell),
        Verb::Man { directory } => cmd::manual::man(directory),
        Verb::Jitter(args) => cmd::jitter::jitter(args),
        Verb::Dump(args) => cmd::dump::dump(args),
    };
    match done {
        Ok(status) => ExitCode::from(status),
        Err(failure) => {
            // Whoever closed our standard error does not want to read it.
            let _ = writeln!(std::io::stderr(), "rtnet: {:#}", failure.error());
            ExitCode::from(failure.status())
        }
    }
}
