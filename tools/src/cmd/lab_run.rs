//! `rtnet lab run`.

use std::path::PathBuf;

use anyhow::{Context, anyhow, ensure};
use rtnet::time::Span;

use super::delivery::Delivery;
use super::{Failure, all_writable, screen_width, tell_of_ring, title};
use crate::cli::{LabMeasureArgs, LabRunArgs};
use crate::control::Directory;
use crate::lab::{self, Core, Lab, RunOptions, userns};
use crate::report::draft::is_standard_output;
use crate::report::html::Sheet;
use crate::report::screen;
use crate::ring;
use crate::scenario::{
    self, MAX_LAB_STATIONS, Network, RingScenario, Scenario, SlotGuard, Uniform, UniformVnic,
};
use crate::sim;

const DEFAULT_SEED: u64 = 1;
/// Runs up to this long show no progress.
const SHORT: Span = Span::from_millis(2_000);
pub(super) const NO_MAX_MISS: &str = "--max-miss is about slots, and a ring has none: leave it out";
/// Cycles that a network takes to come up: calibration, mostly.
const JOINING_CYCLES: i64 = 250;

/// Runs a lab and prints its report; the exit status is that of its verdict.
pub fn lab_run(args: &LabMeasureArgs) -> Result<u8, Failure> {
    let LabMeasureArgs { run: args, html } = args;
    if let Some(ring) = ring_of(args).map_err(Failure::Usage)? {
        return ring_run(args, html.as_ref(), ring);
    }
    let (scenario, mut options) = prepared(args, html.as_ref()).map_err(Failure::Usage)?;
    options.pictures = html.is_some();
    let lab = Lab::set_up(&scenario, &options).map_err(Failure::Usage)?;
    let mut outcome = lab.run(&scenario).map_err(|error| Failure::of_lab(error, Failure::Run))?;
    outcome.add(sim::unmet(&sim::of_lab(&scenario, &outcome.figures)));
    let screen = screen::render(&outcome.figures, screen_width(), &outcome.slot_error_abs);
    let files = [args.json.as_ref(), html.as_ref(), args.pcap.as_ref()];
    let mut delivery = Delivery::begin(&screen, &files);
    delivery.json(args.json.as_ref(), &outcome.figures);
    let sheet = Sheet {
        title: &args.file.as_deref().map_or_else(|| "rtnet lab run".into(), title),
        scenario: &scenario,
        figures: &outcome.figures,
        kept: &outcome.kept,
        simulation: None,
    };
    delivery.text(html.as_ref(), || sheet.page());
    delivery.end(&outcome.figures.verdict)
}

/// The ring of a file, if it is one.
fn ring_of(args: &LabRunArgs) -> anyhow::Result<Option<RingScenario>> {
    let Some(file) = &args.file else { return Ok(None) };
    Ok(match scenario::load_network(file)? {
        Network::Slots(_) => None,
        Network::Ring(ring) => Some(ring),
    })
}

/// The same of a ring.
fn ring_run(args: &LabRunArgs, html: Option<&PathBuf>, ring: RingScenario) -> Result<u8, Failure> {
    let guarded = args.slot_guard.filter(|guard| *guard != SlotGuard::Auto);
    if let Some(guard) = guarded {
        let what = format!("--slot-guard {} is about slots, and a ring has none: leave it out", guard.name());
        return Err(Failure::Usage(anyhow!(what)));
    }
    let RingScenario { ring, network } = ring;
    if args.max_miss.is_some() {
        return Err(Failure::Usage(anyhow!(NO_MAX_MISS)));
    }
    let ring = RingScenario { ring, network: as_said(args, network) };
    let options = ready(args, html, &ring.network).map_err(Failure::Usage)?;
    let figures = ring::run_live(&ring, &options).map_err(|error| Failure::of_lab(error, Failure::Run))?;
    let name = args.file.as_deref().map_or_else(|| "rtnet lab run".into(), title);
    tell_of_ring(&figures, &name, args.json.as_ref(), html, args.pcap.as_ref())
}

/// The network and how to run it; what cannot be is refused before anything is made.
pub fn prepared(args: &LabRunArgs, html: Option<&PathBuf>) -> anyhow::Result<(Scenario, RunOptions)> {
    let mut scenario = scenario(args)?;
    scenario.check_duration()?;
    if let Some(packages) = &mut scenario.packages {
        // A station reads them, whose working directory is another.
        packages.priorities = absolute(packages.priorities.as_ref())?;
        if let Some(router) = &mut packages.router {
            router.keys = absolute(router.keys.as_ref())?;
        }
    }
    let options = ready(args, html, &scenario)?;
    Ok((scenario, options))
}

/// The path of a file, from wherever it is looked at; `-` stays standard output.
pub(super) fn absolute(path: Option<&PathBuf>) -> anyhow::Result<Option<PathBuf>> {
    let Some(path) = path else { return Ok(None) };
    if is_standard_output(path) {
        return Ok(Some(path.clone()));
    }
    let whole = std::path::absolute(path);
    whole.map(Some).with_context(|| format!("{}: its directory is not known", path.display()))
}

/// How to run it, on a host that lets us.
fn ready(args: &LabRunArgs, html: Option<&PathBuf>, scenario: &Scenario) -> anyhow::Result<RunOptions> {
    let n = scenario.stations.len();
    ensure!(
        n <= MAX_LAB_STATIONS,
        "{n} stations: a lab holds at most {MAX_LAB_STATIONS}; `rtnet sim run` holds more"
    );
    lab::check_files(n)?;
    // In a user namespace one is root, and would look elsewhere.
    let directory = Directory::of_user()?;
    userns::gain_namespaces()?;
    all_writable(&[args.json.as_ref(), args.pcap.as_ref(), html], args.file.as_deref())?;
    Ok(RunOptions {
        warm_core: args.warm_core,
        core: Core::choose(args.cpu)?,
        pcap: absolute(args.pcap.as_ref())?,
        json: None,
        home: None,
        detached: false,
        directory: Some(directory),
        // Stations may take a while to be locked, too.
        progress: scenario.duration + scenario.cycle * JOINING_CYCLES > SHORT,
        pictures: false,
    })
}

fn scenario(args: &LabRunArgs) -> anyhow::Result<Scenario> {
    let scenario = match &args.file {
        Some(file) => scenario::load(file)?,
        None => Uniform {
            stations: args.stations,
            cycle: args.cycle,
            duration: scenario::default_duration(args.cycle),
            payload: args.payload,
            rate: args.rate,
            guard: args.guard,
            seed: args.seed.unwrap_or(DEFAULT_SEED),
            vnic: args.vnic.map(|network| UniformVnic { network, mode: args.vnic_mode.unwrap_or_default() }),
        }
        .scenario()?,
    };
    Ok(as_said(args, scenario))
}

/// With what options say of it besides.
fn as_said(args: &LabRunArgs, mut scenario: Scenario) -> Scenario {
    if let Some(duration) = args.duration {
        scenario.duration = duration;
    }
    if let Some(max_miss) = args.max_miss {
        scenario.max_miss_ppm = max_miss;
    }
    if let Some(slot_guard) = args.slot_guard {
        scenario.slot_guard = slot_guard;
    }
    if let Some(seed) = args.seed {
        scenario.seed = seed;
        scenario = scenario.with_random_clocks();
    }
    if args.ideal_clocks { scenario.with_ideal_clocks() } else { scenario }
}
