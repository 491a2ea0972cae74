//! What a run took place on: no figure of jitter means anything without it.

use std::env::consts::ARCH;
use std::fs;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::others::Others;
pub use super::others::RealTimeThread;

/// `/proc/stat` counts hundredths of a second on every architecture.
const NANOS_IN_A_TICK: u64 = 10_000_000;
/// What a run in virtual time has instead of a kernel.
const VIRTUAL_TIME: &str = "virtual time";

/// The host of a run. `None`, or `unknown`, where the host does not say.
#[derive(Clone, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct HostFacts {
    /// The kernel's release, `6.18.44`.
    pub kernel: String,
    /// The preemption model: `PREEMPT_RT`, `PREEMPT_DYNAMIC (full)`, ...
    pub preemption: String,
    /// The clock source in use, `tsc`.
    pub clock_source: String,
    /// The processor's name.
    pub cpu_model: String,
    /// Processors that are on line.
    pub cpus: u64,
    /// Whether this is a virtual machine.
    pub virtual_machine: Option<bool>,
    /// The driver that puts an idle processor to sleep, `none` if there is none.
    pub idle_driver: Option<String>,
    /// How much of a second real-time threads may run, in microseconds; -1 is without limit.
    pub rt_runtime_us: Option<i64>,
    /// Time in the run that the hypervisor gave to others, all processors together, in clock ticks
    /// (of 10 ms, mostly).
    pub steal_ticks: Option<u64>,
    /// The core of the run's real-time threads, where they have one.
    #[serde(default)]
    pub core: Option<usize>,
    /// The share of that core's time that the hypervisor gave to others, in parts per million.
    #[serde(default)]
    pub core_steal_ppm: Option<u64>,
    /// Real-time threads of others that ran on that core meanwhile, the busiest first.
    #[serde(default)]
    pub other_real_time: Vec<RealTimeThread>,
    /// The version of this program.
    pub rtnet: String,
}

impl HostFacts {
    /// Starts to watch the host; the facts are there at [`HostWatch::finish`].
    pub fn begin() -> HostWatch {
        HostWatch { steal_at_start: steal_now("cpu"), core: None }
    }

    /// The same, and the core of the run's real-time threads: what others took of it.
    pub fn begin_on(core: usize) -> HostWatch {
        HostWatch { core: Some(CoreWatch::begin(core)), ..Self::begin() }
    }

    /// Of a run in virtual time, which no host has any part in.
    pub fn of_virtual_time() -> Self {
        Self { kernel: VIRTUAL_TIME.into(), rtnet: env!("CARGO_PKG_VERSION").into(), ..Self::default() }
    }

    /// Whether it is that.
    pub fn is_virtual_time(&self) -> bool {
        self.kernel == VIRTUAL_TIME
    }
}

/// A run in progress.
#[derive(Debug)]
#[must_use]
pub struct HostWatch {
    steal_at_start: Option<u64>,
    core: Option<CoreWatch>,
}

#[derive(Debug)]
struct CoreWatch {
    core: usize,
    since: Instant,
    steal_at_start: Option<u64>,
    others: Others,
}

impl CoreWatch {
    fn begin(core: usize) -> Self {
        let steal_at_start = steal_now(&format!("cpu{core}"));
        Self { core, since: Instant::now(), steal_at_start, others: Others::watch(core) }
    }

    /// The share of the core's time that was stolen, and what other real-time threads took of it.
    fn shares(&self) -> (Option<u64>, Vec<RealTimeThread>) {
        let passed = self.since.elapsed();
        let stolen = steal_now(&format!("cpu{}", self.core))
            .zip(self.steal_at_start)
            .map(|(end, start)| end.saturating_sub(start).saturating_mul(NANOS_IN_A_TICK));
        let share = |ns: u64| (u128::from(ns) * 1_000_000 / passed.as_nanos().max(1)) as u64;
        (stolen.map(share), self.others.since(passed))
    }
}

impl HostWatch {
    /// The facts so far, with what others took since [`HostFacts::begin`].
    pub fn finish(&self) -> HostFacts {
        let version = read("/proc/version").unwrap_or_default();
        let cpuinfo = read("/proc/cpuinfo").unwrap_or_default();
        let unknown = || "unknown".to_owned();
        let (core_steal_ppm, other_real_time) = self.core.as_ref().map(CoreWatch::shares).unwrap_or_default();
        let steal_ticks =
            steal_now("cpu").zip(self.steal_at_start).map(|(end, start)| end.saturating_sub(start));
        HostFacts {
            kernel: read("/proc/sys/kernel/osrelease").unwrap_or_else(unknown),
            preemption: preemption(
                &version,
                read("/sys/kernel/realtime").as_deref(),
                read("/sys/kernel/debug/sched/preempt").as_deref(),
            ),
            clock_source: read("/sys/devices/system/clocksource/clocksource0/current_clocksource")
                .unwrap_or_else(unknown),
            cpu_model: cpu_field(&cpuinfo, "model name").unwrap_or(ARCH).to_owned(),
            cpus: cpuinfo.lines().filter(|line| is_field(line, "processor")).count() as u64,
            virtual_machine: is_virtual(&cpuinfo),
            idle_driver: read("/sys/devices/system/cpu/cpuidle/current_driver"),
            rt_runtime_us: read("/proc/sys/kernel/sched_rt_runtime_us").and_then(|text| text.parse().ok()),
            steal_ticks,
            core: self.core.as_ref().map(|watch| watch.core),
            core_steal_ppm,
            other_real_time,
            rtnet: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}

/// The whole of a small file, without the line's end; none if it cannot be read or is empty.
fn read(path: &str) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}

/// Of one core, `cpu1`, or of all together, `cpu`.
fn steal_now(of: &str) -> Option<u64> {
    steal(&read("/proc/stat")?, of)
}

/// The eighth figure of a line, after `cpu user nice system idle iowait irq softirq`.
fn steal(stat: &str, of: &str) -> Option<u64> {
    let mut lines = stat.lines().map(str::split_ascii_whitespace);
    let mut figures = lines.find_map(|mut words| (words.next() == Some(of)).then_some(words))?;
    figures.nth(7)?.parse().ok()
}

/// From `/proc/version`, `/sys/kernel/realtime` and the scheduler's `preempt`, in which the mode in
/// force is in brackets.
fn preemption(version: &str, realtime: Option<&str>, modes: Option<&str>) -> String {
    if realtime == Some("1") {
        return "PREEMPT_RT".to_owned();
    }
    let Some(model) = version.split_ascii_whitespace().find(|word| word.starts_with("PREEMPT")) else {
        return "voluntary or none".to_owned();
    };
    let mode = modes.and_then(|modes| modes.split_once('(')?.1.split_once(')')).map(|(mode, _)| mode);
    match mode {
        Some(mode) => format!("{model} ({mode})"),
        None => model.to_owned(),
    }
}

/// Only x86 lists the hypervisor among the processor's flags.
fn is_virtual(cpuinfo: &str) -> Option<bool> {
    cpu_field(cpuinfo, "flags").map(|flags| flags.split(' ').any(|flag| flag == "hypervisor"))
}

fn cpu_field<'a>(cpuinfo: &'a str, name: &str) -> Option<&'a str> {
    let line = cpuinfo.lines().find(|line| is_field(line, name))?;
    Some(line.split_once(':')?.1.trim())
}

fn is_field(line: &str, name: &str) -> bool {
    line.split_once(':').is_some_and(|(key, _)| key.trim() == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn preemption_is_told_from_three_sources() {
        let dynamic = "Linux version 6.12.1 (gcc 14) #1 SMP PREEMPT_DYNAMIC Mon Jan 1";
        assert_eq!(preemption(dynamic, None, None), "PREEMPT_DYNAMIC");
        assert_eq!(preemption(dynamic, None, Some("none voluntary (full) lazy")), "PREEMPT_DYNAMIC (full)");
        assert_eq!(preemption(dynamic, Some("1"), None), "PREEMPT_RT");
        assert_eq!(preemption("Linux version 6.12.1 #1 SMP PREEMPT_RT @0", None, None), "PREEMPT_RT");
        assert_eq!(preemption("Linux version 5.4.0 #1 SMP Mon Jan 1", None, None), "voluntary or none");
    }

    #[test]
    fn steal_is_the_eighth_figure_of_its_line() {
        let stat = "cpu  63766 0 8119 309701 1047 0 98 4196 0 0\ncpu0 1 2 3\ncpu1 1 2 3 4 5 6 7 8 9\n";
        assert_eq!(
            ["cpu", "cpu0", "cpu1", "cpu11"].map(|of| steal(stat, of)),
            [Some(4196), None, Some(8), None]
        );
        assert_eq!(steal("", "cpu"), None);
    }

    #[test]
    fn a_virtual_machine_is_told_by_its_flag() {
        assert_eq!(is_virtual("flags\t\t: fpu hypervisor lahf_lm\n"), Some(true));
        assert_eq!(is_virtual("vmx flags\t: hypervisor\nflags\t\t: fpu lahf_lm\n"), Some(false));
        assert_eq!(is_virtual("Features\t: fp asimd\n"), None);
    }

    #[test]
    fn this_host_can_be_described() {
        let facts = HostFacts::begin().finish();
        assert!(facts.cpus > 0 && !facts.kernel.is_empty(), "{facts:?}");
    }
}
