//! What a lab's real-time threads take of their core, and what that means beside other labs'.

use anyhow::{Result, ensure};
use rtnet::live::realtime::{allowed_cpus, avoid};
use rtnet::time::Span;

use crate::control::Load;
use crate::scenario::Scenario;

/// The share of a core that real-time threads may take together: the kernel stops SCHED_FIFO for the rest of a second
/// in which it took 95 %, and a cycle that is held up takes more than its share.
const LOAD_AT_MOST: f64 = 0.8;
/// What one turn of one slot takes of the core: 50 us of spinning, and waking, draining, sending. Measured:
/// 52 to 56 % for eight stations at 1 ms.
const TURN: Span = Span::from_micros(70);

/// What one frame takes that comes to a station with sockets between its slots: it wakes it.
const FRAME: Span = Span::from_micros(15);

/// The share of a core that a scenario's real-time threads take.
pub fn load(scenario: &Scenario) -> f64 {
    let share = |of: Span, period: u32| {
        of.nanos() as f64 / (scenario.cycle.nanos() as f64 * f64::from(period.max(1)))
    };
    let all = scenario.stations.iter().enumerate();
    let shares = all.flat_map(|(id, station)| {
        let is_heard = scenario.stations[scenario.receiver(id)].ip.is_some();
        let turn = if is_heard { TURN + FRAME } else { TURN };
        station.slots.iter().map(move |slot| share(turn, slot.period))
    });
    shares.sum()
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
