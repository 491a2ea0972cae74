//! `rtnet lab up`: stands a network up, and leaves a process behind that keeps it.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::Stdio;

use anyhow::{Context, Result, anyhow, bail};
use rtnet::time::Span;

use super::Failure;
use super::account::{account, unwritten};
use super::delivery::Delivery;
use super::lab_run::{absolute, prepared};
use crate::cli::LabUpArgs;
use crate::control::{Directory, Home, LabStatus};
use crate::daemon;
use crate::lab;
use crate::report::draft::is_standard_output;

/// Stands a lab up.
pub fn lab_up(args: &LabUpArgs) -> Result<u8, Failure> {
    if args.foreground && !args.detached {
        return keep(args);
    }
    let outputs = [("--json", &args.run.json), ("--pcap", &args.run.pcap)];
    let is_output = |(_, path): &(_, &Option<PathBuf>)| path.as_deref().is_some_and(is_standard_output);
    if let Some((option, _)) = outputs.into_iter().find(is_output) {
        let what = "- is standard output, which a lab lets go of once it is up: write to a file, or say --foreground";
        return Err(Failure::Usage(anyhow!("{option} {what}")));
    }
    if args.detached { keep(args) } else { leave_behind().map_err(Failure::Usage) }
}

/// Keeps the lab, in this process.
fn keep(args: &LabUpArgs) -> Result<u8, Failure> {
    if args.detached {
        daemon::begin().map_err(Failure::Usage)?;
    }
    // In a user namespace one is root, and would look elsewhere.
    let directory = Directory::of_user().map_err(Failure::Usage)?;
    let (scenario, mut options) = prepared(&args.run, None).map_err(Failure::Usage)?;
    options.home = Some(Home { directory, lab: args.name.clone() });
    options.json =
        absolute(args.run.json.as_ref().filter(|path| !is_standard_output(path))).map_err(Failure::Usage)?;
    options.detached = args.detached;
    if args.detached {
        daemon::leave_directory().map_err(Failure::Usage)?;
    }
    let mut is_up = false;
    let at_most = args.run.duration;
    let kept = lab::keep(scenario, &options, at_most, |status| {
        is_up = true;
        tell(args, status)
    });
    match kept {
        Ok(status) => {
            let (json, pcap) = (args.run.json.as_ref(), args.run.pcap.as_ref());
            let mut delivery = Delivery::begin(&account(&status), &[json, pcap]);
            delivery.json(json.filter(|path| is_standard_output(path)), &status);
            delivery.unwritten(unwritten(&status));
            delivery.end(&status.verdict)
        }
        Err(error) if is_up => Err(Failure::Run(error)),
        Err(error) => Err(Failure::of_lab(error, Failure::Usage)),
    }
}

fn tell(args: &LabUpArgs, status: &LabStatus) -> Result<()> {
    let (name, stations) = (&status.name, status.stations.len());
    let cycle = Span::from_nanos(status.cycle_ns as i64);
    let line = format!(
        "lab '{name}' is up: {stations} stations, cycle {cycle}; `rtnet lab status {name}` tells how it goes, \
         `rtnet lab down {name}` ends it\n"
    );
    let outputs = [args.run.json.as_deref(), args.run.pcap.as_deref()];
    let told = if outputs.into_iter().flatten().any(is_standard_output) {
        std::io::stderr().write_all(line.as_bytes())
    } else {
        std::io::stdout().write_all(line.as_bytes())
    };
    // In the foreground, whoever does not listen misses nothing that `lab status` would not tell.
    if args.detached {
        told.context("whoever asked for the lab has gone before it was up, so it is taken down")?;
        daemon::leave_output()?;
    }
    Ok(())
}

/// Starts the process that keeps the lab, and waits until the lab is up or cannot be.
fn leave_behind() -> Result<u8> {
    let mut command = lab::this_program();
    // Before what the user has given, which may say that no options come any more.
    command.args(["lab", "up", "--foreground", "--detached"]).args(std::env::args_os().skip(3));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    // It ends with our pipes until it is up, and is on its own then.
    let mut keeper = command.spawn().context("the process that keeps the lab cannot start")?;
    let (Some(output), Some(errors)) = (keeper.stdout.take(), keeper.stderr.take()) else {
        bail!("the process that keeps the lab has no output");
    };
    let relay = std::thread::Builder::new().name("relay".into()).spawn(move || {
        for line in BufReader::new(errors).lines().map_while(Result::ok) {
            let _ = writeln!(std::io::stderr(), "{line}");
        }
    })?;
    let mut line = String::new();
    BufReader::new(output).read_line(&mut line)?;
    if line.is_empty() {
        let status = keeper.wait()?;
        // It has said why; that ends with it.
        let _ = relay.join();
        return Ok(status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(1));
    }
    let _ = std::io::stdout().write_all(line.as_bytes());
    Ok(0)
}
