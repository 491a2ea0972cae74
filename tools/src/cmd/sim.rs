//! `rtnet sim`.

use super::{Failure, all_writable, say, screen_width, tell_of_ring, title, write_json, write_text};
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

/// Runs a scenario and prints its report; the exit status is 1 if it is not as expected.
pub fn sim_run(args: &SimRunArgs) -> Result<u8, Failure> {
    let network = scenario::load_network(&args.file).map_err(|why| Failure::Usage(why.into()))?;
    all_writable(&[args.json.as_ref(), args.pcap.as_ref(), args.html.as_ref()], Some(&args.file))
        .map_err(Failure::Usage)?;
    let pictures = args.html.is_some();
    let options = Options { pcap: args.pcap.clone(), until: args.until, around: None, pictures };
    let scenario = match network {
        Network::Slots(scenario) => with_seed(scenario, args.seed),
        Network::Ring(ring) => return ring_run(args, ring, &options),
    };
    let Ended { figures, slot_error_abs, kept, .. } = sim::run(&scenario, &options).map_err(failure)?;
    if let Some(path) = &args.json {
        write_json(path, &figures).map_err(Failure::Run)?;
    }
    if let Some(path) = &args.html {
        let sheet = Sheet {
            title: &title(&args.file),
            scenario: &scenario,
            figures: &figures.figures,
            kept: &kept,
            simulation: Some(&figures.simulation),
        };
        write_text(path, &sheet.page()).map_err(Failure::Run)?;
    }
    let width = screen_width();
    let around =
        frames_around(&scenario, &options, &figures.simulation.expectations).map_err(Failure::Run)?;
    let text = sim_screen::render(&figures, around.as_ref(), width)
        + "\n"
        + &screen::render(&figures.figures, width, &slot_error_abs);
    say(&text).map_err(Failure::Run)?;
    Ok(if figures.figures.verdict.ok { 0 } else { 1 })
}

/// Too little time is bad usage: nothing ran that could have shown anything.
fn failure(error: anyhow::Error) -> Failure {
    if error.is::<Hurried>() { Failure::Usage(error) } else { Failure::Run(error) }
}

fn with_seed(scenario: Scenario, seed: Option<u64>) -> Scenario {
    match seed {
        Some(seed) => Scenario { seed, ..scenario }.with_random_clocks(),
        None => scenario,
    }
}

/// The same of a ring.
fn ring_run(args: &SimRunArgs, scenario: RingScenario, options: &Options) -> Result<u8, Failure> {
    let scenario = match args.seed {
        Some(seed) => scenario.with_seed(seed),
        None => scenario,
    };
    let figures = ring::run(&scenario, options).map_err(failure)?;
    tell_of_ring(&figures, &title(&args.file), args.json.as_deref(), args.html.as_deref())
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
