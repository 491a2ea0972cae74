//! Real networks need root, no other network beside them, and a host that runs.

use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// One network at a time: several would miss slots for each other.
static NETWORK: Mutex<()> = Mutex::new(());
/// A network that fails while its host stood still for so long, several cycles, says nothing of the network.
const STILL: Duration = Duration::from_millis(50);
const ATTEMPTS: usize = 4;

/// Says aloud, past the test harness, that a test did not run.
pub fn skip(test: &str, why: &str) {
    // Nothing better can be done about standard error that is closed.
    let _ = writeln!(std::io::stderr(), "SKIP {test}: {why}");
}

/// Runs a test of a network, and again, aloud, where it failed on a host that stood still meanwhile.
pub fn network(test: &str, body: impl Fn()) {
    if !nix::unistd::geteuid().is_root() {
        return skip(test, "needs root (CAP_SYS_ADMIN) for network namespaces");
    }
    // A test that failed has taken its network down.
    let _alone = NETWORK.lock().unwrap_or_else(PoisonError::into_inner);
    for attempt in 1..=ATTEMPTS {
        let watch = Standstill::watch();
        let outcome = catch_unwind(AssertUnwindSafe(&body));
        let longest = watch.longest();
        match outcome {
            Ok(()) => return,
            Err(_) if longest > STILL && attempt < ATTEMPTS => {
                let _ = writeln!(std::io::stderr(), "AGAIN {test}: this host stood still for {longest:?}");
            }
            Err(panic) => resume_unwind(panic),
        }
    }
}

/// Watches for how long nothing ran.
struct Standstill {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Duration>,
}

impl Standstill {
    fn watch() -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            let mut longest = Duration::ZERO;
            while !stopped.load(Ordering::Relaxed) {
                let before = Instant::now();
                std::thread::sleep(Duration::from_millis(1));
                longest = longest.max(before.elapsed());
            }
            longest
        });
        Self { stop, thread }
    }

    fn longest(self) -> Duration {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}
