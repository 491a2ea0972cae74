//! The findings in plain words: what was not measured, what would help, and the verdict.

use rtnet::time::Span;

use super::rights::Right;
use super::verdict::{MISSES_ACCEPTED, Prediction};
use super::{Findings, Lateness, Recommended};

/// A warm core is worth its power if it makes the latest of a thousand wake-ups so many times less late.
const WORTH_WARMING: i64 = 2;

/// A line for each thing that was not measured, with the remedy.
pub fn not_measured(findings: &Findings, refused: &[String]) -> Vec<String> {
    let mut lines = Vec::new();
    if findings.scheduling == "ordinary" {
        let why = findings.rights.process.iter().find(|right| right.name == "SCHED_FIFO");
        let why = why.and_then(|right| right.note.as_deref()).unwrap_or("SCHED_FIFO refused");
        lines.push(format!("wake-ups and outages at real-time priority: {why}"));
    }
    lines.extend(refused.iter().cloned());
    let unknown =
        findings.rights.process.iter().chain(&findings.rights.kernel).filter(|r| r.allowed.is_none());
    lines.extend(
        unknown.map(|Right { name, note, .. }| format!("{name}: {}", note.as_deref().unwrap_or("?"))),
    );
    if findings.other_cpus.is_empty() {
        lines.push("waking a thread on another core: there is only one core to run on".into());
    }
    if let Some(wire) = findings.wire.filter(|wire| wire.stamp_ns.n == 0) {
        lines.push(format!("kernel receive stamps: {} frames came without one", wire.unstamped));
    }
    lines
}

/// What would improve the verdict: only what follows from a figure.
pub fn advice(findings: &Findings) -> Vec<String> {
    let mut lines = Vec::new();
    if findings.scheduling == "ordinary" {
        lines.push(
            "run as root, or raise RLIMIT_RTPRIO (`ulimit -r`): these are figures of ordinary threads".into(),
        );
    }
    // Why not stands with what this process may do.
    if !findings.rights.labs() {
        lines.push("labs need network namespaces, which are not to be had here".into());
    }
    lines.extend(warmth(findings));
    if findings.other_cpus.is_empty() {
        lines.push("another core: observers and stations share the only one here".into());
    }
    lines.extend(outages(findings));
    lines.extend(others(findings));
    let holds = findings.recommended.is_some_and(|recommended| recommended.holds);
    if let (false, [_, ..]) = (holds, &findings.other_cpus[..]) {
        let others = findings.other_cpus.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        lines.push(format!("try another core (--cpu {others}): this one is not good enough"));
    }
    lines
}

/// Real-time threads of other programs that take more of the core than slots may be missed: labs here are INCONCLUSIVE.
fn others(findings: &Findings) -> Option<String> {
    let others = &findings.host.other_real_time;
    let share = others.iter().map(|of| of.ppm).sum::<u64>();
    (share as f64 > MISSES_ACCEPTED * 1e6).then(|| {
        let names: Vec<String> = others.iter().map(ToString::to_string).collect();
        let cpu = findings.cpu;
        format!("keep other real-time threads off cpu {cpu}, or choose another core: {}", names.join(", "))
    })
}

fn warmth(findings: &Findings) -> Option<String> {
    let state = |warm| findings.wakeups.iter().find(|of: &&Lateness| of.warm_core == warm);
    let (cold, warm) = (state(false)?, state(true)?);
    let (p999_cold, p999_warm) = (cold.lateness_ns.p999?, warm.lateness_ns.p999?);
    let figures = format!(
        "99.9 % of the wake-ups are not later than {} when warm, {} when cold",
        rounded(p999_warm),
        rounded(p999_cold)
    );
    let warm_is_told = findings.recommended.is_some_and(|recommended| recommended.warm_core);
    if warm_is_told && p999_cold >= WORTH_WARMING * p999_warm {
        Some(format!("keep the real-time core warm (--warm-core): {figures}"))
    } else if !warm_is_told && p999_warm >= WORTH_WARMING * p999_cold {
        Some(format!("leave the real-time core cold: {figures}"))
    } else {
        None
    }
}

fn outages(findings: &Findings) -> Option<String> {
    // Those of a millisecond take a slot or more away, whatever the schedule.
    let long = findings.outages.per_second.iter().find(|rate| rate.at_least_ns >= 1_000_000)?;
    if long.per_second <= 0.0 {
        return None;
    }
    let seen = format!(
        "this core stands still for a millisecond and more {:.1} times a second, for {} at the longest",
        long.per_second,
        rounded(findings.outages.longest_ns)
    );
    Some(if findings.scheduling == "ordinary" {
        format!("{seen}: other threads do that, or the host")
    } else if findings.host.virtual_machine == Some(true) {
        format!(
            "{seen}: that is the virtual machine's host, nothing here can avoid it: no virtual machine, or a \
                 core of its own from the hypervisor"
        )
    } else {
        format!("{seen}: firmware or interrupts; look for them with the kernel's hwlat and osnoise tracers")
    })
}

/// The verdict, the line that says it all last.
pub fn verdict(findings: &Findings) -> Vec<String> {
    let Some(best) = &findings.recommended else {
        return vec!["NOT TOLD: nothing could be measured".into()];
    };
    let others = findings.recommended_by_stations.iter().filter(|other| *other != best && other.holds);
    let mut lines: Vec<_> = others.map(|other| sentence(other, "")).collect();
    let mut last = sentence(best, &quarter(best));
    if findings.scheduling == "ordinary" {
        last.push_str(" (told from ordinary threads)");
    }
    lines.push(if best.holds { format!("HOLDS: {last}") } else { format!("DOES NOT HOLD: {last}") });
    lines
}

/// `with this core warm, 8 stations at a cycle of 1ms (guard band 110us) would miss about 0.3 % of their slots, ...`
fn sentence(of: &Recommended, and: &str) -> String {
    let Recommended { network, warm_core, holds, .. } = of;
    let state = if *warm_core { "warm" } else { "cold" };
    let how = if *holds { "" } else { " at best" };
    format!(
        "with this core {state}, {} stations at a cycle of {} (guard band {}) would miss about {} of their slots{how}, \
         in a worse hour at most {}, at {:.0} % of the core{and}",
        network.stations,
        Span::from_nanos(network.cycle_ns),
        rounded(network.guard_ns),
        percent(network.predicted_miss_share),
        percent(network.at_most_miss_share),
        100.0 * network.load,
    )
}

fn quarter(of: &Recommended) -> String {
    match &of.quarter {
        None => "; a quarter of that cycle has no room for their slots".into(),
        Some(short) if short.throttled_share > 0.0 => format!(
            "; a quarter of that cycle would want {:.0} % of it, be throttled, and miss {:.0} % or more",
            100.0 * short.load,
            100.0 * short.predicted_miss_share
        ),
        Some(short) if !short.fits() => {
            format!(
                "; a quarter of that cycle would want {:.0} % of it, which is too much",
                100.0 * short.load
            )
        }
        Some(short) => {
            format!("; a quarter of that cycle would miss about {}", percent(short.predicted_miss_share))
        }
    }
}

/// Which share is accepted, for the table's caption.
pub fn accepted() -> String {
    percent(MISSES_ACCEPTED)
}

/// A cell of the table: the share missed, or that the core has no time for it.
pub fn cell(network: &Prediction, holds: bool) -> String {
    match (network.fits(), holds) {
        (false, _) => format!("({:.0} %)", 100.0 * network.load),
        (true, true) => format!("{:.2}*", 100.0 * network.predicted_miss_share),
        (true, false) => format!("{:.2}", 100.0 * network.predicted_miss_share),
    }
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    if percent < 0.01 { "0.01 % or less".into() } else { format!("{percent:.2} %") }
}

/// A time without more digits than it deserves: `117us`, `2.4ms`.
pub fn rounded(ns: i64) -> String {
    match ns {
        0..10_000 => format!("{:.1}us", ns as f64 / 1e3),
        10_000..1_000_000 => format!("{}us", ns / 1_000),
        _ => format!("{:.1}ms", ns as f64 / 1e6),
    }
}

#[cfg(test)]
mod tests {
    use super::super::rights::{self, Rights};
    use super::*;
    use crate::report::host::{HostFacts, RealTimeThread};

    fn network(cycle_us: i64, share: f64, load: f64) -> Prediction {
        Prediction {
            cycle_ns: cycle_us * 1_000,
            stations: 8,
            guard_ns: 117_934,
            predicted_miss_share: share,
            at_most_miss_share: 3.0 * share,
            late_share: share,
            uncertain_share: 0.0,
            outage_share: 0.0,
            silent_share: 0.0,
            sync_share: 0.0,
            throttled_share: 0.0,
            load,
        }
    }

    #[test]
    fn a_network_is_told_in_a_sentence() {
        let of = |quarter| {
            let network = network(1_000, 0.0031, 0.527);
            Recommended { network, warm_core: true, holds: true, quarter }
        };
        let throttled = Prediction { throttled_share: 0.05, ..network(250, 0.06, 2.1) };
        let short = of(Some(throttled));
        assert_eq!(
            sentence(&short, &quarter(&short)),
            "with this core warm, 8 stations at a cycle of 1ms (guard band 117us) would miss about 0.31 % of their \
             slots, in a worse hour at most 0.93 %, at 53 % of the core; a quarter of that cycle would want 210 % of \
             it, be throttled, and miss 6 % or more"
        );
        assert!(quarter(&of(Some(network(250, 0.0123, 0.9)))).ends_with("90 % of it, which is too much"));
        assert!(quarter(&of(Some(network(250, 0.0123, 0.7)))).ends_with("would miss about 1.23 %"));
        assert!(quarter(&of(None)).contains("no room"));
    }

    fn findings(scheduling: &'static str, share: f64, holds: bool) -> Findings {
        let network = network(1_000, share, 0.527);
        let recommended = Recommended { network, warm_core: false, holds, quarter: None };
        let labs = Right { name: rights::NETWORK_NAMESPACES, allowed: Some(true), note: None };
        Findings {
            rights: Rights { process: vec![labs], kernel: Vec::new() },
            scheduling,
            other_cpus: vec![0],
            recommended: Some(recommended),
            recommended_by_stations: vec![recommended],
            ..Findings::default()
        }
    }

    #[test]
    fn without_privileges_there_is_a_verdict_and_a_remedy() {
        let mut ordinary = findings("ordinary", 0.1, false);
        let note = "EPERM: run as root, or raise RLIMIT_RTPRIO".to_owned();
        ordinary.rights.process.push(Right { name: "SCHED_FIFO", allowed: Some(false), note: Some(note) });
        let lines = not_measured(&ordinary, &["sending and stamps: run as root".into()]);
        assert_eq!(
            lines,
            [
                "wake-ups and outages at real-time priority: EPERM: run as root, or raise RLIMIT_RTPRIO",
                "sending and stamps: run as root"
            ]
        );
        let told = advice(&ordinary);
        assert!(told[0].starts_with("run as root"));
        assert!(!told.iter().any(|line| line.contains("labs")), "they can be had: {told:?}");
        let no_labs = Findings { rights: Rights::default(), ..ordinary.clone() };
        assert!(advice(&no_labs)[1].starts_with("labs need network namespaces"));
        let last = verdict(&ordinary).pop().unwrap();
        assert!(
            last.starts_with("DOES NOT HOLD: ") && last.ends_with("(told from ordinary threads)"),
            "{last}"
        );
    }

    #[test]
    fn advice_follows_from_figures_only() {
        let good = findings("SCHED_FIFO", 0.001, true);
        assert_eq!(advice(&good), [""; 0], "nothing was seen that could be better");
        assert_eq!(not_measured(&good, &[]), [""; 0]);
        let alone = Findings { other_cpus: Vec::new(), ..good.clone() };
        assert!(advice(&alone)[0].starts_with("another core"));
        let poor = findings("SCHED_FIFO", 0.1, false);
        assert_eq!(advice(&poor), ["try another core (--cpu 0): this one is not good enough"]);
        let beside = |ppm| {
            let other = RealTimeThread { name: "jackd".into(), pid: 7, ppm };
            let host = HostFacts { other_real_time: vec![other], ..HostFacts::default() };
            advice(&Findings { host, ..good.clone() })
        };
        assert_eq!(beside(5_000), [""; 0], "no more than may be missed");
        let told = "keep other real-time threads off cpu 0, or choose another core: jackd (7) 2 %";
        assert_eq!(beside(20_000), [told]);
        let nothing = Findings { recommended: None, ..good };
        assert_eq!(verdict(&nothing), ["NOT TOLD: nothing could be measured"]);
    }

    #[test]
    fn a_cell_says_share_or_load() {
        assert_eq!(cell(&network(1_000, 0.003, 0.5), true), "0.30*");
        assert_eq!(cell(&network(1_000, 0.03, 0.5), false), "3.00");
        assert_eq!(cell(&network(250, 0.03, 2.1), false), "(210 %)");
        assert_eq!(percent(0.0), "0.01 % or less");
    }
}
