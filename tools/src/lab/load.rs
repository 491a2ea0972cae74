//! What a lab's real-time threads take of their core, and what that means beside other labs'.

use anyhow::{Result, ensure};
use rtnet::live::realtime::{allowed_cpus, avoid};
use rtnet::time::Span;

use super::turns::{FOLLOWS, FRAME, Turns};
use crate::control::Load;
use crate::scenario::Scenario;

/// The share of a core that real-time threads may take together: the kernel stops SCHED_FIFO for the rest of a second
/// in which it took 95 %, and a cycle that is held up takes more than its share.
const LOAD_AT_MOST: f64 = 0.8;
/// Stations that calibrate at once even on a core without room.
const CALIBRATING_AT_LEAST: usize = 4;

/// The share of a core that a scenario's real-time threads take if they wake a `lead` before their slots.
pub fn load(scenario: &Scenario, lead: Span) -> f64 {
    let Turns { all, heard } = Turns::of(scenario);
    let takes = all * (lead + FOLLOWS).nanos() as f64 + heard * FRAME.nanos() as f64;
    takes / scenario.cycle.nanos() as f64
}

/// How many stations of a scenario may calibrate at once. A calibration request leaves in place of a frame, its reply wakes the
/// master once more in two cycles. Delays that are measured on a core without room are not those of the lab that is up.
pub fn calibrating_at_once(scenario: &Scenario, lead: Span) -> usize {
    let reply = (lead + FOLLOWS).nanos() as f64 / (2 * scenario.cycle.nanos()) as f64;
    let room = LOAD_AT_MOST - load(scenario, lead);
    ((room / reply) as usize).max(CALIBRATING_AT_LEAST)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    #[test]
    fn few_stations_calibrate_at_once_on_a_core_without_room() {
        let of = |stations: usize, lead_micros: i64| {
            let station = |n: usize| {
                format!(
                    "[[station]]\nname = \"s{n}\"\nrole = \"{}\"\n",
                    if n == 0 { "master" } else { "slave" }
                )
            };
            let text = format!("cycle = \"1ms\"\n{}", (0..stations).map(station).collect::<String>());
            let scenario = Source::new("net.toml", &text).parse().unwrap();
            calibrating_at_once(&scenario, Span::from_micros(lead_micros))
        };
        assert!(of(8, 20) >= 8 && of(16, 20) >= 16, "{} {}", of(8, 20), of(16, 20));
        // 23 turns of 29 us take 0.667 of the core. In the 0.133 that are left, nine replies of 29 us in two cycles.
        assert_eq!(of(22, 20), 9);
        assert_eq!(of(60, 9), CALIBRATING_AT_LEAST, "all the same");
    }
}
