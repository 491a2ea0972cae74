//! The command `rtnet`.

use std::process::ExitCode;

use clap::Parser;
use tools::cli::{Cli, LabVerb, Verb};
use tools::cmd;

fn main() -> ExitCode {
    let done = match &Cli::parse().verb {
        Verb::Lab(LabVerb::Run(args)) => cmd::lab_run::lab_run(args),
        Verb::Station(args) => cmd::station::station(args),
    };
    match done {
        Ok(status) => ExitCode::from(status),
        Err(failure) => {
            eprintln!("rtnet: {:#}", failure.error());
            ExitCode::from(failure.status())
        }
    }
}
