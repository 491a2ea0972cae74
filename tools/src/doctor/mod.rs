//! What this host can hold: measured on the core that real-time threads would use, and put into words.
//!
//! ```text
//!   rights, wakeups, outages, hops, wire  --measured-->  verdict (pure)  --predicted-->  screen, JSON
//! ```
//!
//! Whatever cannot be measured is a line with the remedy, and the rest goes on.

mod findings;
pub mod hops;
pub mod outages;
mod progress;
pub mod rights;
pub mod screen;
pub mod verdict;
pub mod wakeups;
pub mod wire;
mod words;

use anyhow::{Result, bail};
use rtnet::live::clock::monotonic;
use rtnet::live::realtime::{allowed_cpus, avoid};
use rtnet::time::Span;

pub use self::findings::{
    Candidate, Findings, Hop, Lateness, OutageFigures, Rate, Recommended, Share, WireFigures,
};
use self::outages::Outages;
use self::progress::Progress;
use self::rights::{Rights, Way};
use self::verdict::Core;
use self::wakeups::Wakeups;
use self::wire::Wire;
use crate::report::histogram::SignedHistogram;
use crate::report::host::HostFacts;

/// Shares of the whole duration, in hundredths. Late wake-ups are rare, and most of the verdict.
const WAKEUPS: i64 = 60;
const OUTAGES: i64 = 25;
const WIRE: i64 = 9;
/// Two of them: to the same core and to another.
const HOP: i64 = 3;
/// Lateness and lengths of outages that are counted.
const LATER_THAN: [Span; 4] =
    [Span::from_micros(50), Span::from_micros(100), Span::from_micros(200), Span::from_micros(500)];
const OUTAGES_FROM: [Span; 3] = [Span::from_micros(50), Span::from_micros(128), Span::from_millis(1)];
/// Readings of the clock that are timed together.
const CLOCK_READINGS: u64 = 100_000;

/// What to examine.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// The core; the last by default.
    pub cpu: Option<usize>,
    /// How long to measure altogether.
    pub duration: Span,
    /// Show on standard error how it goes on.
    pub progress: bool,
}

/// What the measurements left.
struct Measured {
    wakeups: Wakeups,
    outages: Outages,
    wire: Result<Wire, String>,
    hops: Vec<(usize, SignedHistogram)>,
    real_time_share: f64,
}

/// Examines this host, in namespaces that the process may make this way.
///
/// # Errors
/// There is no such core.
pub fn examine(options: &Options, way: &Way) -> Result<Findings> {
    let cpus = allowed_cpus();
    let cpu = options.cpu.or(cpus.last().copied()).unwrap_or(0);
    if !cpus.contains(&cpu) {
        bail!("there is no cpu {cpu} to run on here: choose --cpu from {cpus:?}");
    }
    let timer_slack_ns = nix::sys::prctl::get_timerslack().ok().map(i64::from);
    let rights = Rights::probe(cpu, way);
    // All that is not measured stays off the core; on a machine with no other it cannot.
    let _ = avoid(cpu);
    let other_cpus: Vec<_> = cpus.into_iter().filter(|&other| other != cpu).collect();

    let watch = HostFacts::begin_on(cpu);
    let measured = measure(options, cpu, &other_cpus);
    let host = watch.finish();
    let measured = Measured { real_time_share: real_time_share(host.rt_runtime_us), ..measured };
    let candidates = measured.candidates();
    let recommended = verdict::STATIONS.iter().filter_map(|&n| measured.recommend(&candidates, n)).collect();
    let findings = Findings {
        duration_ns: options.duration.nanos(),
        cpu,
        other_cpus,
        scheduling: if rights.fifo() { "SCHED_FIFO" } else { "ordinary" },
        recommended_by_stations: recommended,
        wakeups: measured.lateness(),
        outages: measured.outage_figures(),
        hops: measured.hops.iter().map(|(to, took)| Hop { to_cpu: *to, took_ns: took.summary() }).collect(),
        wire: measured.wire.as_ref().ok().map(wire_figures),
        clock_gettime_ns: clock_cost(),
        timer_slack_ns,
        rights,
        candidates,
        host,
        // In words, once the figures are there.
        recommended: None,
        verdict: Vec::new(),
        advice: Vec::new(),
        not_measured: Vec::new(),
    };
    Ok(judged(findings, &measured.refused()))
}

/// The same, with what follows from the figures.
fn judged(mut findings: Findings, refused: &[String]) -> Findings {
    let of_verdict = |r: &&Recommended| r.network.stations == verdict::STATIONS_OF_VERDICT;
    findings.recommended = findings.recommended_by_stations.iter().find(of_verdict).copied();
    findings.not_measured = words::not_measured(&findings, refused);
    findings.advice = words::advice(&findings);
    findings.verdict = words::verdict(&findings);
    findings
}

fn measure(options: &Options, cpu: usize, others: &[usize]) -> Measured {
    let part = |hundredths: i64| options.duration * hundredths / 100;
    let progress = Progress::start(options.progress, options.duration);
    progress.stage("wake-ups, core cold and warm in turns");
    let wakeups = wakeups::measure(cpu, part(WAKEUPS));
    progress.stage("host outages");
    let outages = outages::watch(cpu, part(OUTAGES));
    progress.stage("wake-ups of one thread by another");
    let to = [Some(cpu), others.last().copied()];
    let hops = to.into_iter().flatten().map(|to| (to, hops::measure(cpu, to, part(HOP)))).collect();
    progress.stage("sending");
    let wire = wire::measure(cpu, part(WIRE)).map_err(|error| format!("{error:#}"));
    Measured { wakeups, outages, wire, hops, real_time_share: 1.0 }
}

impl Measured {
    /// The states of the core in which it was measured: warm or not.
    fn states(&self) -> impl Iterator<Item = (bool, &[SignedHistogram])> {
        let warm = self.wakeups.warm.as_ref().ok().map(|warm| (true, &warm[..]));
        [(false, &self.wakeups.cold[..])].into_iter().chain(warm)
    }

    fn core<'a>(&'a self, wakeups: &'a [SignedHistogram]) -> Core<'a> {
        Core {
            wakeups,
            outages: &self.outages.lengths,
            watched: self.outages.watched,
            broadcasts: self.wire.as_ref().ok().map(|wire| (&wire.broadcast, wire::LISTENERS)),
            turn: self.wire.as_ref().map_or(verdict::TURN_UNMEASURED, |wire| wire.turn),
            real_time_share: self.real_time_share,
        }
    }

    fn candidates(&self) -> Vec<Candidate> {
        let all = self.states().flat_map(|(warm_core, wakeups)| {
            let networks = verdict::candidates(&self.core(wakeups)).into_iter();
            networks.map(move |network| Candidate { warm_core, holds: network.holds(), network })
        });
        all.collect()
    }

    /// In the state of the core that holds the shorter cycle; warm if both hold the same.
    fn recommend(&self, candidates: &[Candidate], stations: usize) -> Option<Recommended> {
        let best = |warm_core| {
            let of: Vec<_> =
                candidates.iter().filter(|c| c.warm_core == warm_core).map(|c| c.network).collect();
            verdict::recommend(&of, stations)
        };
        let (warm_core, network) = match (best(true), best(false)) {
            (Some(warm), Some(cold)) if verdict::better(&cold, &warm) => (false, cold),
            (Some(warm), _) => (true, warm),
            (None, cold) => (false, cold?),
        };
        let wakeups = self.states().find(|(warm, _)| *warm == warm_core)?.1;
        let quarter = verdict::predict(&self.core(wakeups), stations, Span::from_nanos(network.cycle_ns / 4));
        Some(Recommended { network, warm_core, holds: network.holds(), quarter })
    }

    fn lateness(&self) -> Vec<Lateness> {
        let of = |(warm_core, blocks): (bool, &[SignedHistogram])| {
            let mut all = SignedHistogram::new();
            blocks.iter().for_each(|block| all.merge(block));
            let share = |than: Span| Share { than_ns: than.nanos(), share: verdict::share_later(&all, than) };
            Lateness { warm_core, lateness_ns: all.summary(), later: LATER_THAN.map(share).to_vec() }
        };
        self.states().map(of).collect()
    }

    fn outage_figures(&self) -> OutageFigures {
        let rate =
            |least: Span| Rate { at_least_ns: least.nanos(), per_second: self.outages.per_second(least) };
        OutageFigures {
            watched_ns: self.outages.watched.nanos(),
            per_second: OUTAGES_FROM.map(rate).to_vec(),
            longest_ns: self.outages.lengths.max(),
        }
    }

    /// What was refused on the way, a line each.
    fn refused(&self) -> Vec<String> {
        let warm = self.wakeups.warm.as_ref().err().cloned();
        let wire = self.wire.as_ref().err().map(|error| format!("sending and stamps: {error}"));
        warm.into_iter().chain(wire).collect()
    }
}

fn wire_figures(wire: &Wire) -> WireFigures {
    WireFigures {
        send_ns: wire.send.summary(),
        broadcast_ns: wire.broadcast.summary(),
        stamp_ns: wire.stamp.summary(),
        unstamped: wire.unstamped,
        turn_ns: wire.turn.nanos(),
    }
}

/// Of a second; the kernel's default period is one.
fn real_time_share(runtime_us: Option<i64>) -> f64 {
    runtime_us.filter(|&us| us >= 0).map_or(1.0, |us| (us as f64 / 1e6).min(1.0))
}

/// Nanoseconds for one reading of the clock.
fn clock_cost() -> f64 {
    let start = monotonic();
    let end = (0..CLOCK_READINGS).fold(start, |_, _| monotonic());
    (end - start) as f64 / CLOCK_READINGS as f64
}
