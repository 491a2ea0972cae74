//! `rtnet lab down`, `lab status`, `lab exec`.

use std::ffi::OsStr;
use std::io::{self, ErrorKind, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use rtnet::time::Span;

use super::Failure;
use super::account::{account, unwritten};
use super::delivery::Delivery;
use rtnet::live::realtime::avoid;

use crate::cli::{DEFAULT_LAB, LabDownArgs, LabExecArgs, LabRestartArgs, LabStatusArgs};
use crate::control::{self, Directory, Held, LabReply, LabRequest, LabStatus, Place};
use crate::lab;
use crate::lab::guests::Guests;
use crate::lab::processes::END_WITHIN;
use crate::remedy;
use crate::report::verdict::Word;

/// How long a lab that has answered may take to be gone: its stations end one beside the other.
const GONE_WITHIN: Duration = END_WITHIN.saturating_mul(2);
/// How long a station that was restarted is waited for: it ends first. Calibration takes some hundred cycles.
const LOCKED_WITHIN: Duration = END_WITHIN.saturating_mul(2);
/// And so many cycles: twice what 100 calibration rounds take.
const CALIBRATED_WITHIN: u32 = 400;

/// The exit status for a command that is not there, and for one that is and cannot be executed: those of env(1).
const NOT_FOUND: u8 = 127;
const NOT_EXECUTABLE: u8 = 126;

/// Takes labs down.
pub fn down(args: &LabDownArgs) -> Result<u8, Failure> {
    let directory = Directory::of_user().map_err(Failure::Usage)?;
    let labs = if args.all { directory.labs_dead_or_alive() } else { vec![args.name.clone()] };
    let (mut ended, mut errors, mut word) = (Vec::new(), Vec::new(), Word::Ok);
    // One that does not go keeps none of the others.
    for lab in labs {
        match down_one(&directory, &lab) {
            Ok(Some(one)) => ended.push(one),
            // A lab that died left no figures.
            Ok(None) => word = Word::Inconclusive,
            Err(error) => errors.push(error),
        }
    }
    let words = |ended: &[LabStatus]| ended.iter().map(account).collect::<Vec<_>>().join("\n");
    let is_shown = errors.is_empty() || !ended.is_empty();
    let shown = if is_shown { super::print_all(args.json, &ended, words) } else { Ok(()) };
    let mut delivery = Delivery::after(shown);
    delivery.unwritten(ended.iter().flat_map(unwritten));
    unless_any(errors, delivery.end_with(worst(&ended).max(word).exit_status()))
}

/// The status if there is no error, else the last error; all others are printed.
fn unless_any(mut errors: Vec<anyhow::Error>, status: Result<u8, Failure>) -> Result<u8, Failure> {
    let Some(last) = errors.pop() else { return status };
    errors.into_iter().chain(status.err().map(Failure::into_error)).for_each(|error| {
        let _ = writeln!(std::io::stderr(), "rtnet: {error:#}");
    });
    Err(Failure::Usage(last))
}

/// The figures of its end; none if it was dead already, and only its traces were left to remove.
fn down_one(directory: &Directory, lab: &str) -> Result<Option<LabStatus>> {
    match control::ask_lab(directory, lab, LabRequest::Down) {
        Ok(LabReply::Down(status)) => {
            let deadline = Instant::now() + GONE_WITHIN;
            while directory.has(lab) {
                if Instant::now() > deadline {
                    bail!("lab '{lab}' has ended, but process {} stays: end it", status.pid);
                }
                std::thread::sleep(Duration::from_millis(5));
            }
            Ok(Some(*status))
        }
        Ok(LabReply::Refused(why)) => Err(anyhow!("lab '{lab}': {why}")),
        Ok(_) => bail!("lab '{lab}' answers what it was not asked"),
        // Who holds no lock any more is dead: its directory is ours to take, and goes with that.
        Err(error) if directory.has(lab) => match directory.take_lab(lab) {
            Ok(held) => {
                end_dead(lab, &held);
                Ok(None)
            }
            Err(_) => Err(error),
        },
        Err(error) => Err(error),
    }
}

/// Ends what a dead lab has left in its namespaces.
fn end_dead(lab: &str, held: &Held) {
    let was = "it was dead already: what it left is removed, and its figures are lost".to_owned();
    let ended = held.left.iter().flat_map(|note| Guests::of_dead(note).end());
    for line in std::iter::once(was).chain(ended) {
        let _ = writeln!(std::io::stderr(), "rtnet: lab '{lab}': {line}");
    }
}

/// The worst verdict's.
fn worst(labs: &[LabStatus]) -> Word {
    labs.iter().map(|lab| lab.verdict.word).max().unwrap_or_default()
}

/// Shows one lab, or all.
pub fn status(args: &LabStatusArgs) -> Result<u8, Failure> {
    let directory = Directory::of_user().map_err(Failure::Usage)?;
    if let Some(lab) = &args.name {
        let status = control::lab_status(&directory, lab).map_err(Failure::Usage)?;
        super::print(args.json, &status, account).map_err(Failure::Run)?;
        return Ok(status.verdict.exit_status());
    }
    let (mut all, mut errors) = (Vec::new(), Vec::new());
    for lab in directory.labs() {
        match control::lab_status(&directory, &lab) {
            Ok(status) => all.push(status),
            // It has ended since it was listed.
            Err(error) if directory.has(&lab) => errors.push(error),
            Err(_) => {}
        }
    }
    let words = |all: &[LabStatus]| match all {
        [] => "no lab runs\n".to_owned(),
        some => some.iter().map(account).collect::<Vec<_>>().join("\n"),
    };
    super::print_all(args.json, &all, words).map_err(Failure::Run)?;
    unless_any(errors, Ok(worst(&all).exit_status()))
}

/// Puts a new process in the place of a station's, and waits until it is locked again.
pub fn restart(args: &LabRestartArgs) -> Result<u8, Failure> {
    let station = &args.place.station;
    let directory = Directory::of_user().map_err(Failure::Usage)?;
    let lab = lab_of(&directory, &args.place);
    let request = LabRequest::Restart { station: station.clone() };
    super::tdma::by_lab(&lab, request).map_err(Failure::Usage)?;
    let begun = Instant::now();
    loop {
        let status = control::lab_status(&directory, &lab).map_err(Failure::Run)?;
        let member = status.stations.iter().find(|member| member.name == *station);
        let member = member.context("the lab has lost it").map_err(Failure::Run)?;
        match (member.state.as_str(), &member.failed) {
            ("locked", _) if member.restarts > 0 => {
                let after = Span::from_millis(begun.elapsed().as_millis() as i64);
                println!("{lab}/{station} is restarted as process {}, locked after {after}", member.pid);
                return Ok(0);
            }
            ("ended", why) => {
                let why = why.as_deref().unwrap_or("it has ended again");
                return Err(Failure::Run(anyhow!("station '{lab}/{station}': {why}")));
            }
            (state, _) if begun.elapsed() > locked_within(status.cycle_ns) => {
                let within = begun.elapsed().as_secs();
                return Err(Failure::Run(anyhow!(
                    "station '{lab}/{station}' is {state} after {within}s: `rtnet lab status {lab}` tells how it goes on"
                )));
            }
            _ => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// The lab that is meant: the one named, the only one, or the one that is called as labs are by default.
fn lab_of(directory: &Directory, place: &Place) -> String {
    place.lab.clone().or_else(|| directory.only_lab()).unwrap_or_else(|| DEFAULT_LAB.into())
}

/// Long cycles take longer.
fn locked_within(cycle_ns: u64) -> Duration {
    LOCKED_WITHIN.max(Duration::from_nanos(cycle_ns) * CALIBRATED_WITHIN)
}

/// Runs a command beside a station; returns only if it cannot. `files` is the soft limit of descriptors that it is to have.
pub fn exec(args: &LabExecArgs, files: Option<u64>) -> Result<u8, Failure> {
    let (program, arguments) = args.command.split_first().context("no command").map_err(Failure::Usage)?;
    enter(&args.place, args.any_core).map_err(Failure::Usage)?;
    // It gets the limit of descriptors that this process was started with.
    let restored = files.map_or(Ok(()), remedy::restore_files);
    restored.context("the limit of descriptors cannot be set").map_err(Failure::Usage)?;
    Err(not_run(program, &Command::new(program).args(arguments).exec()))
}

/// Why a command could not be executed, with the status that env(1) has for it.
fn not_run(program: &OsStr, error: &io::Error) -> Failure {
    let path = Path::new(program);
    let (status, remedy) = match error.kind() {
        ErrorKind::NotFound if path.components().count() > 1 && path.exists() => {
            (NOT_FOUND, "the interpreter that it names is not there: install that")
        }
        ErrorKind::NotFound => (NOT_FOUND, "it is not installed, or not in PATH"),
        ErrorKind::PermissionDenied if path.is_dir() => (NOT_EXECUTABLE, "it is a directory: name a program"),
        ErrorKind::PermissionDenied => {
            (NOT_EXECUTABLE, "this user may not execute it: see `ls -l` and `chmod +x`")
        }
        _ => (NOT_EXECUTABLE, "it is no program for this machine"),
    };
    let what = path.display();
    Failure::Command(status, anyhow!("{what} cannot be run: {error}: {remedy}"))
}

/// Moves this process into a station's namespaces, and off the core of the lab's real-time threads.
fn enter(place: &Place, on_any_core: bool) -> Result<()> {
    let directory = Directory::of_user()?;
    let lab = lab_of(&directory, place);
    if !on_any_core {
        // What its calls have the kernel do would hold up whoever is real-time there.
        avoid(control::lab_status(&directory, &lab)?.cpu)
            .context("other cores cannot be had (--any-core goes without)")?;
    }
    let place = Place { lab: Some(lab), station: place.station.clone() };
    let pid = control::station_status(&directory, &place)?.pid;
    let noted = place.lab.as_ref().and_then(|lab| directory.noted(lab));
    let mark = noted.iter().flat_map(|note| note.lines()).next().unwrap_or_default().to_owned();
    lab::enter::enter(pid, Path::new(&format!("/proc/{pid}/ns/net")))
        .with_context(|| format!("station '{place}'"))?;
    if let Err(error) = lab::enter::own_sys(&mark) {
        let _ = writeln!(
            std::io::stderr(),
            "rtnet: /sys shows the host's interfaces, not the station's ({error:#}): `ip link` shows those"
        );
    }
    Ok(())
}
