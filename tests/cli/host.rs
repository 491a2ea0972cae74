//! Real networks need root, no other network beside them, and a host that runs.

use std::any::Any;
use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rtnet::live::realtime::{self, RealTime};
use serde_json::Value;

/// One network at a time: several would miss slots for each other.
static NETWORK: Mutex<()> = Mutex::new(());
/// A network that fails while its host stood still for so long, several cycles, says nothing of the network: not even what
/// is most urgent on a core ran meanwhile. What fails by its own doing fails again.
const STILL: Duration = Duration::from_millis(20);
/// Nor does one whose host stood still for so many parts in a million of the time, a fraction of a cycle at once.
const STILL_PPM: u64 = 5_000;
/// What is later than this has stood still: on a host of one's own what is most urgent wakes in less.
const LATE: Duration = Duration::from_micros(200);
const ATTEMPTS: usize = 4;

/// Says aloud, past the test harness, that a test did not run.
pub fn skip(test: &str, why: &str) {
    // Nothing better can be done about standard error that is closed.
    let _ = writeln!(std::io::stderr(), "SKIP {test}: {why}");
}

/// Says aloud what a test has measured, for `scripts/accept`.
pub fn figure(test: &str, text: &str) {
    // Whoever does not listen misses nothing.
    let _ = writeln!(std::io::stderr(), "FIGURE {test}: {text}");
}

/// Whether what ended so kept what it promises, as far as its host let it: OK, or, aloud, DEGRADED or INCONCLUSIVE. What is
/// NOT OK or INTERRUPTED is not.
pub fn is_sound(test: &str, status: Option<i32>, verdict: &Value) -> bool {
    let expected = [("ok", 0), ("inconclusive", 3), ("degraded", 4)];
    let found = expected.iter().find(|(word, _)| verdict["word"] == *word);
    if status != Some(0) {
        figure(test, &format!("{}: {}", verdict["word"], verdict["reasons"]));
    }
    found.is_some_and(|(_, of_word)| status == Some(*of_word))
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
        let Still { longest, ppm } = watch.over();
        match outcome {
            Ok(()) => return,
            Err(panic) if (longest > STILL || ppm > STILL_PPM) && attempt < ATTEMPTS => {
                let (share, why) = (ppm as f64 / 1e4, first_line(panic.as_ref()));
                let _ = writeln!(
                    std::io::stderr(),
                    "AGAIN {test}: this host stood still for {longest:?}, {share:.1} % of the time in all: {why}"
                );
            }
            Err(panic) => resume_unwind(panic),
        }
    }
}

/// What a test that failed has said first.
fn first_line(panic: &(dyn Any + Send)) -> &str {
    let said = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
    said.and_then(|said| said.lines().next()).unwrap_or_default()
}

/// Runs something while the cores are taken away, each by itself, for up to `longest` at a time, as by a hypervisor.
pub fn held_up<T>(longest: Duration, body: impl FnOnce() -> T) -> T {
    struct Stop<'a>(&'a AtomicBool);
    impl Drop for Stop<'_> {
        fn drop(&mut self) {
            self.0.store(true, Ordering::Relaxed);
        }
    }
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let _stop = Stop(&over);
        for cpu in realtime::allowed_cpus() {
            let over = &over;
            scope.spawn(move || {
                RealTime { priority: Some(99), cpu: Some(cpu) }.apply();
                let mut random = 7 + cpu as u32;
                while !over.load(Ordering::Relaxed) {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    let share = f64::from(random >> 8) / f64::from(1 << 24);
                    let until = Instant::now() + longest.mul_f64(share);
                    while Instant::now() < until {}
                    std::thread::sleep(longest.mul_f64(2.0 + 2.0 * share));
                }
            });
        }
        body()
    })
}

/// Watches for how long a core ran nothing, not even what is most urgent.
pub struct Standstill {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Still>>,
}

/// For how long, and for how much of the time, on the core that stood still for longest.
#[derive(Clone, Copy, Default)]
pub struct Still {
    pub longest: Duration,
    pub ppm: u64,
}

impl Standstill {
    /// On every core, from now on.
    pub fn watch() -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let watch = |cpu| {
            let stopped = stop.clone();
            std::thread::spawn(move || {
                // Where the host refuses that, what is more urgent counts as standstill, too.
                RealTime { priority: Some(99), cpu: Some(cpu) }.apply();
                let nap = Duration::from_millis(1);
                let (begin, mut longest, mut all) = (Instant::now(), Duration::ZERO, Duration::ZERO);
                while !stopped.load(Ordering::Relaxed) {
                    let before = Instant::now();
                    std::thread::sleep(nap);
                    let asleep = before.elapsed();
                    longest = longest.max(asleep);
                    all += asleep.checked_sub(nap + LATE).map_or(Duration::ZERO, |late| late + LATE);
                }
                let ppm = all.as_nanos() as u64 * 1_000_000 / begin.elapsed().as_nanos().max(1) as u64;
                Still { longest, ppm }
            })
        };
        let threads = realtime::allowed_cpus().into_iter().map(watch).collect();
        Self { stop, threads }
    }

    /// What it was, at the end.
    pub fn over(self) -> Still {
        self.stop.store(true, Ordering::Relaxed);
        let all = self.threads.into_iter().map(|thread| thread.join().unwrap_or_default());
        all.fold(Still::default(), |one, other| Still {
            longest: one.longest.max(other.longest),
            ppm: one.ppm.max(other.ppm),
        })
    }
}
