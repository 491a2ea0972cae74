//! `rtnet find-min-cycle` on hosts in virtual time: what happened to a host meanwhile changes no answer by more than a quarter.

use std::convert::Infallible;

use rtmac::tdma::schedule::Rate;
use rtnet::sim::{Host, Latency};
use rtnet::time::Span;
use tests::seeds;
use tools::min_cycle::answer::{AGREE_WITHIN, Purpose, Run};
use tools::min_cycle::{ladder, search};
use tools::scenario::Uniform;
use tools::sim::{self, Options};

const LONGEST: Span = Span::from_millis(10);
const START: Span = Span::from_millis(1);
const TRIAL: Span = Span::from_millis(5_000);
const PROOF: Span = Span::from_millis(30_000);
const MISS_PPM: u32 = 1_000;

/// The shortest cycle that eight stations hold on such a host, as one seed has it.
fn searched(host: &Host, seed: u64) -> Option<Span> {
    let cycles: Vec<Span> = ladder::up_to(LONGEST);
    let start = cycles.partition_point(|&cycle| cycle < START);
    let mut runs = 0;
    let run = |rung: usize, purpose| {
        runs += 1;
        let duration = if purpose == Purpose::Trial { TRIAL } else { PROOF };
        Ok::<_, Infallible>(run(host, cycles[rung], duration, seed * 100 + runs, purpose))
    };
    let Ok((found, _)) = search::search((cycles.len(), start), run);
    found.map(|rung| cycles[rung])
}

fn run(host: &Host, cycle: Span, duration: Span, seed: u64, purpose: Purpose) -> Run {
    let rate = Rate::from_bits_per_second(1_000_000_000);
    let uniform = Uniform { stations: 8, cycle, duration, payload: 64, rate, guard: None, seed, vnic: None };
    let what = |guard: Span| (cycle.nanos(), guard.nanos());
    let mut scenario = match uniform.scenario() {
        Ok(scenario) => scenario,
        Err(refused) => {
            return Run::without(purpose, what(Span::ZERO), duration.nanos(), refused.to_string());
        }
    };
    scenario.conditions.host = host.clone();
    let what = what(scenario.guard);
    match sim::run(&scenario, &Options::default()) {
        Ok(ended) => {
            let missed = (&ended.figures.figures, ended.missed_in_parts);
            Run::of(purpose, what, duration.nanos(), missed, MISS_PPM)
        }
        Err(why) => Run::without(purpose, what, duration.nanos(), why.to_string()),
    }
}

/// An idle host: its wake-ups are late now and then, and a hypervisor takes a core for a while now and then.
fn idle(mean_us: i64, outage_ppm: u32) -> Host {
    Host {
        wake: Latency::Exponential(Span::from_micros(mean_us)),
        outage_ppm,
        longest_outage: Span::from_millis(1),
        ..Host::IDEAL
    }
}

#[test]
fn searches_on_one_idle_host_agree_within_a_quarter() {
    for host in [idle(10, 0), idle(20, 300)] {
        let found: Vec<Span> = seeds::drawn("searches", 3)
            .into_iter()
            .map(|seed| searched(&host, seed).expect("it holds some cycle"))
            .collect();
        let (least, most) = (found.iter().min().unwrap(), found.iter().max().unwrap());
        assert!(most.nanos() as f64 <= least.nanos() as f64 * AGREE_WITHIN, "{host:?}: {found:?}");
        assert!(*least > ladder::SHORTEST && *most < LONGEST, "{found:?}");
    }
}
