//! `rtnet lab run`.

use std::path::PathBuf;

use anyhow::ensure;
use rtnet::time::Span;

use super::{Failure, all_writable, say, screen_width, title, write_json, write_text};
use crate::cli::{LabMeasureArgs, LabRunArgs};
use crate::control::Directory;
use crate::lab::{Lab, RunOptions, userns};
use crate::report::html::Sheet;
use crate::report::screen;
use crate::scenario::{self, MAX_LAB_STATIONS, Scenario, Uniform, UniformVnic};
use crate::sim;

const DEFAULT_DURATION: Span = Span::from_millis(10_000);
const DEFAULT_SEED: u64 = 1;
/// Runs up to this long show no progress.
const SHORT: Span = Span::from_millis(2_000);
/// Cycles that a network takes to come up: calibration, mostly.
const JOINING_CYCLES: i64 = 250;

/// Runs a lab and prints its report; the exit status is 1 if the verdict is bad.
pub fn lab_run(args: &LabMeasureArgs) -> Result<u8, Failure> {
    let LabMeasureArgs { run: args, html } = args;
    let (scenario, mut options) = prepared(args, html.as_ref()).map_err(Failure::Usage)?;
    options.pictures = html.is_some();
    let lab = Lab::set_up(&scenario, &options).map_err(Failure::Usage)?;
    let mut outcome = lab.run(&scenario).map_err(Failure::Run)?;
    let expected = sim::of_lab(&scenario, &outcome.figures);
    sim::add(&mut outcome.figures.verdict, &expected);
    if let Some(path) = &args.json {
        write_json(path, &outcome.figures).map_err(Failure::Run)?;
    }
    if let Some(path) = html {
        let sheet = Sheet {
            title: &args.file.as_deref().map_or_else(|| "rtnet lab run".into(), title),
            scenario: &scenario,
            figures: &outcome.figures,
            kept: &outcome.kept,
            simulation: None,
        };
        write_text(path, &sheet.page()).map_err(Failure::Run)?;
    }
    let screen = screen::render(&outcome.figures, screen_width(), &outcome.slot_error_abs);
    say(&screen).map_err(Failure::Run)?;
    Ok(if outcome.figures.verdict.ok { 0 } else { 1 })
}

/// The network and how to run it; what cannot be is refused before anything is made.
pub fn prepared(args: &LabRunArgs, html: Option<&PathBuf>) -> anyhow::Result<(Scenario, RunOptions)> {
    let scenario = scenario(args)?;
    let n = scenario.stations.len();
    ensure!(
        n <= MAX_LAB_STATIONS,
        "{n} stations: a lab holds at most {MAX_LAB_STATIONS}; `rtnet sim run` holds more"
    );
    let options = RunOptions {
        warm_core: args.warm_core,
        cpu: args.cpu,
        pcap: args.pcap.clone(),
        home: None,
        // In a user namespace one is root, and would look elsewhere.
        directory: Some(Directory::of_user()),
        // Stations may take a while to be locked, too.
        progress: scenario.duration + scenario.cycle * JOINING_CYCLES > SHORT,
        pictures: false,
    };
    userns::gain_namespaces()?;
    all_writable(&[args.json.as_ref(), args.pcap.as_ref(), html], args.file.as_deref())?;
    Ok((scenario, options))
}

fn scenario(args: &LabRunArgs) -> anyhow::Result<Scenario> {
    let mut scenario = match &args.file {
        Some(file) => scenario::load(file)?,
        None => Uniform {
            stations: args.stations,
            cycle: args.cycle,
            duration: DEFAULT_DURATION,
            payload: args.payload,
            rate: args.rate,
            guard: args.guard,
            seed: args.seed.unwrap_or(DEFAULT_SEED),
            vnic: args.vnic.map(|network| UniformVnic { network, mode: args.vnic_mode.unwrap_or_default() }),
        }
        .scenario()?,
    };
    if let Some(duration) = args.duration {
        scenario.duration = duration;
    }
    if let Some(slot_guard) = args.slot_guard {
        scenario.slot_guard = slot_guard;
    }
    if let Some(seed) = args.seed {
        scenario.seed = seed;
        scenario = scenario.with_random_clocks();
    }
    Ok(if args.ideal_clocks { scenario.with_ideal_clocks() } else { scenario })
}
