//! What a lab's real-time threads take of their core, and what that means beside other labs'.

use anyhow::{Result, ensure};
use rtnet::live::realtime::{allowed_cpus, avoid};
use rtnet::time::Span;

use super::lead::FOLLOWS;
use crate::control::Load;
use crate::scenario::Scenario;

/// The share of a core that real-time threads may take together: the kernel stops SCHED_FIFO for the rest of a second
/// in which it took 95 %, and a cycle that is held up takes more than its share.
const LOAD_AT_MOST: f64 = 0.8;
/// What one frame takes that comes to a station with sockets between its slots: it wakes it.
pub const FRAME: Span = Span::from_micros(15);

/// Wake-ups of a lab's stations in a cycle, on average.
pub struct Turns {
    /// For their own slots and the Synchronisation.
    pub all: f64,
    /// For frames that come to stations with sockets.
    pub heard: f64,
}

impl Turns {
    /// The wake-ups of a scenario.
    pub fn of(scenario: &Scenario) -> Self {
        // The Synchronisation.
        let mut turns = Self { all: 1.0, heard: 0.0 };
        for (id, station) in scenario.stations.iter().enumerate() {
            let own: f64 = station.slots.iter().map(|slot| 1.0 / f64::from(slot.period.max(1))).sum();
            let is_heard = scenario.stations[scenario.receiver(id)].ip.is_some();
            turns.all += own;
            turns.heard += if is_heard { own } else { 0.0 };
        }
        turns
    }
}

/// The share of a core that a scenario's real-time threads take if they wake a `lead` before their slots.
pub fn load(scenario: &Scenario, lead: Span) -> f64 {
    let Turns { all, heard } = Turns::of(scenario);
    let takes = all * (lead + FOLLOWS).nanos() as f64 + heard * FRAME.nanos() as f64;
    takes / scenario.cycle.nanos() as f64
}

/// Why the real-time threads of labs, one of which takes such a share of a core, would be stopped now and then.
pub fn too_much(cpu: usize, load: f64, declared: Option<&Load>) -> Option<String> {
    let together = load + declared.map_or(0.0, Load::of_others);
    (together > LOAD_AT_MOST && is_throttled()).then(|| {
        format!(
            "all real-time threads would take {:.0} % of cpu {cpu}: above {:.0} % the kernel takes 50 ms of every \
             second from SCHED_FIFO",
            together * 100.0,
            LOAD_AT_MOST * 100.0
        )
    })
}

/// Whether the kernel throttles real-time threads.
fn is_throttled() -> bool {
    let runtime = std::fs::read_to_string("/proc/sys/kernel/sched_rt_runtime_us");
    runtime.map_or(true, |runtime| runtime.trim() != "-1")
}

/// The core of a lab's real-time threads. It is chosen once for all labs that a process runs: the choice narrows the cores
/// that the process may run on, so a second one would not find the first.
#[derive(Clone, Debug)]
pub struct Core {
    /// Its number.
    pub(crate) cpu: usize,
    /// Why other threads may run there, too.
    pub(crate) note: Option<String>,
}

impl Core {
    /// The core that is asked for, otherwise the last. From now on the calling thread, and what it starts, stays off it.
    ///
    /// # Errors
    /// The calling thread may not run there.
    pub fn choose(asked: Option<usize>) -> Result<Self> {
        let cpus = allowed_cpus();
        let cpu = asked.or(cpus.last().copied()).unwrap_or(0);
        ensure!(cpus.contains(&cpu), "there is no cpu {cpu} to run on here: choose --cpu from {cpus:?}");
        let note = avoid(cpu).err().map(|error| format!("cpu {cpu} is shared with the observer: {error}"));
        Ok(Self { cpu, note })
    }
}
