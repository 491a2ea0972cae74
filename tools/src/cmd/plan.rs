//! `rtnet plan`.

use std::io::Write;

use anyhow::{Result, anyhow, bail};
use rtnet::time::Span;

use super::delivery::Delivery;
use super::{Failure, all_writable, in_words, print, screen_width};
use crate::cli::PlanArgs;
use crate::plan::{Host, Plan, propose, screen, svg};
use crate::ring::plan::{self as ring_plan, RingPlan};
use crate::scenario::{self, DEFAULT_RATE, Network, RingScenario, Uniform};

const DEFAULT_PAYLOAD: usize = 64;
/// As of a file that says nothing else.
const DURATION: Span = Span::from_millis(10_000);
const SEED: u64 = 1;

/// Says what a network does, or proposes one; the exit status is 1 if it cannot work.
pub fn plan(args: &PlanArgs) -> std::result::Result<u8, Failure> {
    let host = args.host.as_deref().map(Host::load).transpose().map_err(Failure::Usage)?;
    let scenario = match network(args, host.as_ref()).map_err(Failure::Usage)? {
        Network::Slots(scenario) => scenario,
        Network::Ring(ring) => return plan_ring(args, &ring),
    };
    all_writable(&[args.svg.as_ref()], args.file.as_deref()).map_err(Failure::Usage)?;
    let plan = Plan::of(&scenario, host.as_ref());
    let text = match args.file {
        None if !args.json => propose::file(&scenario),
        _ => in_words(args.json, &plan, |plan| screen::render(plan, screen_width())).map_err(Failure::Run)?,
    };
    let mut delivery = Delivery::begin(&text, &[args.svg.as_ref()]);
    delivery.text(args.svg.as_ref(), || svg::draw(&plan));
    if args.file.is_none() {
        for why in plan.refused.iter().chain(&plan.warned) {
            // Whoever closed our standard error does not want to read it.
            let _ = writeln!(std::io::stderr(), "rtnet: {why}");
        }
    }
    delivery.end_with(u8::from(!plan.works()))
}

/// Says how long anything takes in a ring; the exit status is 1 if it cannot work.
fn plan_ring(args: &PlanArgs, ring: &RingScenario) -> std::result::Result<u8, Failure> {
    let only_of_slots =
        [("--svg draws slots", args.svg.is_some()), ("--host is about guard bands", args.host.is_some())];
    if let Some((option, _)) = only_of_slots.iter().find(|(_, is_said)| *is_said) {
        return Err(Failure::Usage(anyhow!("{option}, and a ring has none: leave it out")));
    }
    let plan = RingPlan::of(ring);
    print(args.json, &plan, |plan| ring_plan::render(plan, screen_width())).map_err(Failure::Run)?;
    Ok(u8::from(!plan.works()))
}

fn network(args: &PlanArgs, host: Option<&Host>) -> Result<Network> {
    let stations = match (&args.file, args.stations) {
        (Some(file), _) => return Ok(scenario::load_network(file)?),
        (None, Some(stations)) => stations,
        (None, None) => bail!("name a file, or say how many --stations"),
    };
    let guard = match (args.guard, host) {
        (None, Some(host)) if args.cycle.is_none() => Some(host.guard(stations)?),
        (None, None) if args.cycle.is_none() => {
            return Err(anyhow!(
                "how late may a station be? Say --guard 50us, or --host with what `rtnet doctor --json` has measured, or which --cycle \
                 is to be divided"
            ));
        }
        (guard, _) => guard,
    };
    let network = Uniform {
        stations,
        cycle: args.cycle.unwrap_or(Span::ZERO),
        duration: DURATION,
        payload: args.payload.unwrap_or(DEFAULT_PAYLOAD),
        rate: args.rate.unwrap_or(DEFAULT_RATE),
        guard,
        seed: SEED,
        vnic: None,
    };
    let scenario = if args.cycle.is_some() { network.scenario() } else { propose::shortest(&network) };
    Ok(Network::Slots(scenario?))
}
