//! `rtnet sim`.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::anyhow;
use signal_hook::consts::{SIGINT, SIGTERM};

use super::delivery::Delivery;
use super::lab_run::NO_MAX_MISS;
use super::sim_seeds::{only, sim_seeds};
use super::{Failure, all_writable, say, screen_width, tell_of_ring, title};
use crate::cli::SimRunArgs;
use crate::report::html::Sheet;
use crate::report::screen;
use crate::ring;
use crate::scenario::{self, Network, RingScenario, Scenario};
use crate::sim::screen::{self as sim_screen, Around};
use crate::sim::{self, Checked, Ended, Hurried, Options};

/// Prints a scenario that runs.
pub fn example() -> Result<u8, Failure> {
    say(sim::EXAMPLE).map(|()| 0).map_err(Failure::Run)
}

/// Runs a scenario and prints its report; the exit status is that of its verdict.
pub fn sim_run(args: &SimRunArgs) -> Result<u8, Failure> {
    if let Some(seeds) = args.seeds {
        return sim_seeds(args, seeds);
    }
    let file = only(&args.files)?;
    let network = scenario::load_network(file).map_err(|why| Failure::Usage(why.into()))?;
    all_writable(&[args.json.as_ref(), args.pcap.as_ref(), args.html.as_ref()], Some(file))
        .map_err(Failure::Usage)?;
    let pictures = args.html.is_some();
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, stop.clone()).map_err(|error| Failure::Run(error.into()))?;
    }
    let options = Options { pcap: args.pcap.clone(), until: args.until, around: None, pictures, stop };
    let scenario = match network {
        Network::Slots(scenario) => {
            let max_miss_ppm = args.max_miss.unwrap_or(scenario.max_miss_ppm);
            let scenario = Scenario { max_miss_ppm, ..scenario };
            match args.seed {
                Some(seed) => scenario.with_seed(seed),
                None => scenario,
            }
        }
        Network::Ring(ring) => return ring_run((args, file), ring, &options),
    };
    let Ended { figures, slot_error_abs, kept, .. } = sim::run(&scenario, &options).map_err(failure)?;
    let width = screen_width();
    // A run that was interrupted is not repeated.
    let checked = if options.is_stopped() { &[][..] } else { &figures.simulation.expectations };
    let around = frames_around(&scenario, &options, checked).map_err(Failure::Run)?;
    let text = sim_screen::render(&figures, around.as_ref(), width)
        + "\n"
        + &screen::render(&figures.figures, width, &slot_error_abs);
    let (json, html, pcap) = (args.json.as_ref(), args.html.as_ref(), args.pcap.as_ref());
    let mut delivery = Delivery::begin(&text, &[json, html, pcap]);
    delivery.json(json, &figures);
    let sheet = Sheet {
        title: &title(file),
        scenario: &scenario,
        figures: &figures.figures,
        kept: &kept,
        simulation: Some(&figures.simulation),
    };
    delivery.text(html, || sheet.page());
    delivery.end(&figures.figures.verdict)
}

/// Too little time is bad usage: nothing ran that could have shown anything.
fn failure(error: anyhow::Error) -> Failure {
    let otherwise = |error: anyhow::Error| {
        if error.is::<Hurried>() { Failure::Usage(error) } else { Failure::Run(error) }
    };
    Failure::of_lab(error, otherwise)
}

/// The same of a ring.
fn ring_run(
    (args, file): (&SimRunArgs, &Path),
    scenario: RingScenario,
    options: &Options,
) -> Result<u8, Failure> {
    if args.max_miss.is_some() {
        return Err(Failure::Usage(anyhow!(NO_MAX_MISS)));
    }
    let scenario = match args.seed {
        Some(seed) => scenario.with_seed(seed),
        None => scenario,
    };
    let figures = ring::run(&scenario, options).map_err(failure)?;
    let (json, html, pcap) = (args.json.as_ref(), args.html.as_ref(), args.pcap.as_ref());
    tell_of_ring(&figures, &title(file), json, html, pcap)
}

/// The frames around the first place where something was not as expected. The run is repeated for them: it is the same
/// to the byte, and none has to be kept of one in which all is well.
fn frames_around(
    scenario: &Scenario,
    options: &Options,
    checked: &[Checked],
) -> anyhow::Result<Option<Around>> {
    let first = checked.iter().find_map(|checked| Some((checked.line, checked.cycle?)));
    let Some((line, cycle)) = first else { return Ok(None) };
    let around = Some((cycle.saturating_sub(1), cycle.saturating_add(1)));
    let frames =
        sim::run(scenario, &Options { pcap: None, around, pictures: false, ..options.clone() })?.lines;
    Ok(Some(Around { line, cycle, frames }))
}
