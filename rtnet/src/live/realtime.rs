//! Real-time set-up of a thread. Each step that the host refuses costs one clear line, no more.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use nix::sched::{CpuSet, sched_getaffinity, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::unistd::Pid;

use super::rights;

/// Priority of a master's real-time thread: its Synchronisation goes before every slot.
pub const MASTER_PRIORITY: i32 = 90;
/// Priority of a slave's real-time thread.
pub const SLAVE_PRIORITY: i32 = 80;
/// Bytes of stack touched beforehand, so that the loop never faults one in.
const PREFAULT: usize = 64 * 1024;

/// What a real-time thread asks of its host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RealTime {
    /// SCHED_FIFO priority, 1 to 99; none: ordinary scheduling.
    pub priority: Option<i32>,
    /// The core to stay on; all real-time threads of one machine belong on one.
    pub cpu: Option<usize>,
}

impl RealTime {
    /// Sets the calling thread up; returns a line for each step that was refused: what, why, and what
    /// it costs.
    pub fn apply(&self) -> Vec<String> {
        let mut refused = Vec::new();
        if let Some(cpu) = self.cpu
            && let Err(error) = pin(cpu)
        {
            refused.push(format!("cpu {cpu}: {error}: the thread runs on any core, and wakes later"));
        }
        // Whatever the priority: a lab's stations, and its observer, have the same to say.
        if let Some(priority) = self.priority
            && let Err(error) = set_scheduler(libc::SCHED_FIFO, priority)
        {
            // In a user namespace no capability helps.
            let remedy = rights::remedy(&["CAP_SYS_NICE"]);
            refused.push(format!(
                "SCHED_FIFO: {error}: ordinary scheduling, slots are missed under load ({remedy}; or raise RLIMIT_RTPRIO, \
                 `ulimit -r`)"
            ));
        }
        if let Err(error) = mlockall(MlockAllFlags::MCL_CURRENT) {
            refused.push(format!(
                "mlockall: {error}: pages may be swapped out (raise RLIMIT_MEMLOCK, `ulimit -l`)"
            ));
        }
        if let Err(error) = nix::sys::prctl::set_timerslack(1) {
            refused.push(format!("timer slack: {error}: sleeps may take 50 us longer"));
        }
        prefault();
        refused
    }
}

/// Keeps a core from idling, as long as it lives: a halted virtual processor wakes 5 to 12 times later.
/// It runs at SCHED_IDLE, so that everything else on the core goes before it.
pub struct WarmCore {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl WarmCore {
    /// Warms this core. A refusal is a line to show.
    pub fn start(cpu: usize) -> Result<Self, String> {
        let stop = Arc::new(AtomicBool::new(false));
        let (told, asked) = std::sync::mpsc::channel();
        let stopped = stop.clone();
        let run = move || {
            let ready = pin(cpu).and_then(|()| set_scheduler(libc::SCHED_IDLE, 0));
            let refused = ready.is_err();
            // The other end waits for exactly this message.
            let _ = told.send(ready);
            while !refused && !stopped.load(Ordering::Relaxed) {
                core::hint::spin_loop();
            }
        };
        let thread = std::thread::Builder::new().name("warm-core".into()).spawn(run);
        let cold = |why: String| format!("warm core {cpu}: {why}: the core idles between slots");
        let thread = thread.map_err(|error| cold(error.to_string()))?;
        match asked.recv() {
            Ok(Ok(())) => Ok(Self { stop, thread: Some(thread) }),
            Ok(Err(error)) => Err(cold(error.to_string())),
            Err(_) => Err(cold("its thread ended".into())),
        }
    }
}

impl Drop for WarmCore {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that only spins cannot have panicked.
            let _ = thread.join();
        }
    }
}

/// Ties the calling thread to a core.
pub fn pin(cpu: usize) -> nix::Result<()> {
    let mut set = CpuSet::new();
    set.set(cpu)?;
    sched_setaffinity(Pid::from_raw(0), &set)
}

/// The cores that the calling thread may run on.
pub fn allowed_cpus() -> Vec<usize> {
    let set = sched_getaffinity(Pid::from_raw(0)).unwrap_or_default();
    (0..CpuSet::count()).filter(|&cpu| set.is_set(cpu).unwrap_or(false)).collect()
}

/// Keeps the calling thread, and what it starts from now on, off a core; on a machine with no other it
/// stays where it is.
pub fn avoid(cpu: usize) -> nix::Result<()> {
    let mut set = CpuSet::new();
    let others: Vec<_> = allowed_cpus().into_iter().filter(|&other| other != cpu).collect();
    others.iter().try_for_each(|&other| set.set(other))?;
    if others.is_empty() { Ok(()) } else { sched_setaffinity(Pid::from_raw(0), &set) }
}

fn set_scheduler(policy: i32, priority: i32) -> nix::Result<()> {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: `parameters` is valid and outlives the call; 0 is the calling thread.
    nix::errno::Errno::result(unsafe { libc::sched_setscheduler(0, policy, &parameters) }).map(drop)
}

#[inline(never)]
fn prefault() {
    let mut stack = [0u8; PREFAULT];
    std::hint::black_box(&mut stack);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_host_refuses_is_one_line_each() {
        let lines = std::thread::spawn(|| RealTime { priority: Some(1_000), cpu: Some(1_000) }.apply())
            .join()
            .unwrap();
        assert!(lines.iter().any(|line| line.starts_with("cpu 1000: ")), "{lines:?}");
        assert!(lines.iter().any(|line| line.starts_with("SCHED_FIFO: ")), "{lines:?}");
        assert!(lines.iter().all(|line| !line.contains('\n')));
    }

    #[test]
    fn a_core_is_warm_until_dropped() {
        match WarmCore::start(0) {
            Ok(warm) => drop(warm),
            Err(line) => assert!(line.starts_with("warm core 0: "), "{line}"),
        }
        assert!(WarmCore::start(1_000).is_err());
    }
}
