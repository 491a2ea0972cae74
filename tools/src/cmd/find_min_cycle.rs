//! `rtnet find-min-cycle`.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, anyhow, ensure};
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;

use super::delivery::Delivery;
use super::{Failure, all_writable, screen_width};
use crate::cli::MinCycleArgs;
use crate::control::Directory;
use crate::lab::{self, Core, Lab, RunOptions, userns};
use crate::min_cycle::answer::{Answer, Asked, Purpose, Run};
use crate::min_cycle::{ladder, screen, search};
use crate::report::host::HostFacts;
use crate::scenario::{MAX_LAB_STATIONS, Scenario, ScenarioError, Uniform};

const DEFAULT_STATIONS: usize = 8;
const DEFAULT_MISS_PPM: u32 = 1_000;
const DEFAULT_PAYLOAD: usize = 64;
const DEFAULT_RATE: u64 = 1_000_000_000;
const DEFAULT_TRIAL: Span = Span::from_millis(5_000);
const DEFAULT_PROOF: Span = Span::from_millis(30_000);
/// Where a search begins: most hosts hold it.
const START: Span = Span::from_millis(1);
const SEED: u64 = 1;

/// Searches, proves, and reports. The exit status: see [`Answer::exit_status`].
pub fn find_min_cycle(args: &MinCycleArgs) -> Result<u8, Failure> {
    let kept = args.compare.as_deref().map(|path| Ok((path, Answer::load(path)?)));
    let kept = kept.transpose().map_err(Failure::Usage)?;
    let asked = asked(args, kept.as_ref().map(|(_, kept)| &kept.asked)).map_err(Failure::Usage)?;
    let networks = networks(args, &asked).map_err(Failure::Usage)?;
    lab::check_files(asked.stations).map_err(Failure::Usage)?;
    all_writable(&[args.json.as_ref()], None).map_err(Failure::Usage)?;
    // In a user namespace one is root, and would look elsewhere.
    let directory = Directory::of_user().map_err(Failure::Usage)?;
    userns::gain_namespaces().map_err(Failure::Usage)?;
    let options = RunOptions {
        warm_core: asked.warm_core,
        core: Core::choose(args.cpu).map_err(Failure::Usage)?,
        pcap: None,
        json: None,
        home: None,
        detached: false,
        directory: Some(directory),
        progress: false,
        pictures: false,
    };
    let answer = search(asked, &networks, &options)?;
    let mut text = screen::render(&answer, screen_width());
    if let Some((path, kept)) = kept.as_ref().filter(|_| answer.inconclusive().is_none()) {
        text += &(screen::comparison(&answer, kept, &path.display().to_string()) + "\n");
    }
    let mut delivery = Delivery::begin(&text, &[args.json.as_ref()]);
    delivery.json(args.json.as_ref(), &answer);
    delivery.end_with(answer.exit_status(kept.as_ref().map(|(_, kept)| kept)))
}

/// What is searched for: what the options say, else what was kept, else what is usual. Answers to other questions are not
/// compared.
fn asked(args: &MinCycleArgs, kept: Option<&Asked>) -> anyhow::Result<Asked> {
    let length = |kept: Option<i64>, usual| kept.map_or(usual, Span::from_nanos);
    let said = Asked {
        stations: args.stations.or(kept.map(|kept| kept.stations)).unwrap_or(DEFAULT_STATIONS),
        payload: args.payload.or(kept.map(|kept| kept.payload)).unwrap_or(DEFAULT_PAYLOAD),
        rate: args.rate.map(Rate::bits_per_second).or(kept.map(|kept| kept.rate)).unwrap_or(DEFAULT_RATE),
        guard_ns: args.guard.map(Span::nanos).or(kept.and_then(|kept| kept.guard_ns)),
        miss_ppm: args.miss.or(kept.map(|kept| kept.miss_ppm)).unwrap_or(DEFAULT_MISS_PPM),
        warm_core: args.warm_core || kept.is_some_and(|kept| kept.warm_core),
        trial_ns: args.trial.unwrap_or(length(kept.map(|kept| kept.trial_ns), DEFAULT_TRIAL)).nanos(),
        proof_ns: args.proof.unwrap_or(length(kept.map(|kept| kept.proof_ns), DEFAULT_PROOF)).nanos(),
    };
    let n = said.stations;
    ensure!(
        n <= MAX_LAB_STATIONS,
        "{n} stations: a lab, in which cycles are tried, holds at most {MAX_LAB_STATIONS}"
    );
    ensure!(said.rate > 0, "a rate of 0 bits per second is none: say --rate 1G");
    let is_of_that = |kept: &Asked| {
        ensure!(
            *kept == said,
            "--compare is the answer to another question than is asked here ({} stations, {} bytes, trials of {}, ...): \
             leave the other options out, and it is asked again",
            kept.stations,
            kept.payload,
            Span::from_nanos(kept.trial_ns)
        );
        Ok(())
    };
    kept.map_or(Ok(()), is_of_that)?;
    Ok(said)
}

/// The networks that can be tried, the shortest cycle first: cycles that have no room for the slots are none.
fn networks(args: &MinCycleArgs, asked: &Asked) -> anyhow::Result<Vec<Scenario>> {
    let network = |cycle| {
        Uniform {
            stations: asked.stations,
            cycle,
            duration: Span::from_nanos(asked.trial_ns),
            payload: asked.payload,
            rate: Rate::from_bits_per_second(asked.rate),
            guard: asked.guard_ns.map(Span::from_nanos),
            seed: SEED,
            vnic: None,
        }
        .scenario()
    };
    let mut last = None;
    let mut networks = Vec::new();
    for cycle in ladder::up_to(args.longest) {
        match network(cycle) {
            Ok(scenario) => networks.push(scenario),
            Err(refused @ (ScenarioError::Conflict(_) | ScenarioError::Unfit(_))) => last = Some(refused),
            Err(refused) => return Err(refused.into()),
        }
    }
    let why = || match &last {
        Some(refused) => {
            anyhow!("no cycle of up to {} has room: {refused}; or say a longer --longest", args.longest)
        }
        None => anyhow!(
            "--longest {} is shorter than the shortest that is tried, {}",
            args.longest,
            ladder::SHORTEST
        ),
    };
    let longest = networks.last().with_context(why)?;
    let trial = |short| anyhow!("{short} (--trial), or let --longest be shorter");
    longest.check_duration().map_err(trial)?;
    let proof = Scenario { duration: Span::from_nanos(asked.proof_ns), ..longest.clone() };
    proof.check_duration().map_err(|short| anyhow!("{short} (--proof), or let --longest be shorter"))?;
    Ok(networks)
}

fn search(asked: Asked, networks: &[Scenario], options: &RunOptions) -> Result<Answer, Failure> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, interrupted.clone())
            .map_err(|error| Failure::Run(error.into()))?;
    }
    let host = HostFacts::begin();
    let start = networks.partition_point(|network| network.cycle < START);
    let (found, runs) = search::search((networks.len(), start), |rung, purpose| {
        let run = run(&asked, &networks[rung], options, purpose)?;
        if interrupted.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted(anyhow!("INTERRUPTED: there is no answer yet")));
        }
        // Whoever closed our standard error does not want to read it.
        let _ = writeln!(std::io::stderr(), "rtnet: {}", screen::run_line(&run));
        Ok(run)
    })?;
    let cycle_ns = found.map(|rung| networks[rung].cycle.nanos());
    Ok(Answer { asked, cycle_ns, runs, host: host.finish() })
}

/// A network that cannot be stood up on this host at all ends the search; one that does not come up in time does not hold.
fn run(asked: &Asked, network: &Scenario, options: &RunOptions, purpose: Purpose) -> Result<Run, Failure> {
    // How many may be missed is decided here, by what is asked for.
    let mut network = Scenario { max_miss_ppm: 1_000_000, ..network.clone() };
    if purpose == Purpose::Proof {
        network.duration = Span::from_nanos(asked.proof_ns);
    }
    let lab = Lab::set_up(&network, options).map_err(Failure::Usage)?;
    let (what, duration_ns) = ((network.cycle.nanos(), network.guard.nanos()), network.duration.nanos());
    Ok(match lab.run(&network) {
        Ok(outcome) => {
            let missed = (&outcome.figures, outcome.missed_in_parts);
            Run::of(purpose, what, duration_ns, missed, asked.miss_ppm)
        }
        Err(error) => Run::without(purpose, what, duration_ns, format!("{error:#}")),
    })
}
