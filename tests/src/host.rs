//! Real networks need root, no other network beside them, and a host that runs.
//!
//! A test of a real network decides by what stations, kernels and observers recorded. A test that fails is run again,
//! aloud (`AGAIN ...`), if the host was disturbed meanwhile: [`Still`] is the measure, the constants below are the limits.
//! The last of its attempts counts, whatever the host did.

// A test of a real network waits for it.
#![allow(clippy::disallowed_methods)]

use std::any::Any;
use std::collections::BTreeMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, gettid};
use rtnet::live::realtime::{self, RealTime};
use serde_json::Value;

pub use crate::aloud::{again, figure, skip};

/// The shares of this host's cores that no network has.
static CORES: Cores = Cores { free: Mutex::new(None), given_back: Condvar::new() };
/// Networks that share a core: of three stations in a cycle of 2 ms, or four in 4 ms, each takes some tenth of it, half a millisecond
/// of guard band is room for the turns of the others, and no kernel stops real-time threads that take less than 80 % of a core
/// together.
const SHARES: usize = 4;
/// A network that fails while its host stood still for so long, several cycles, says nothing of the network: not even what
/// is most urgent on a core ran meanwhile. What fails by its own doing fails again.
const STILL: Duration = Duration::from_millis(20);
/// Nor does one whose host stood still for so many parts in a million of the time, a fraction of a cycle at once.
const STILL_PPM: u64 = 5_000;
/// What is later than this has stood still: on a host of one's own what is most urgent wakes in less.
const LATE: Duration = Duration::from_micros(200);
/// How often it is looked: seldom enough that the looks take less of a core than what the verdict takes for a disturbance.
const NAP: Duration = Duration::from_millis(5);
/// What runs under ordinary scheduling, as the test itself and a station's control thread do, has waited for a core for so
/// long: several cycles, and whatever a test waits for before it looks at something.
const WAITED: Duration = Duration::from_millis(20);
const ATTEMPTS: usize = 4;
/// Words of a failed attempt's message in a log.
const WORDS_AT_MOST: usize = 120;
/// Long enough for whatever is sure to come.
const PATIENCE: Duration = Duration::from_secs(60);

/// Whether a run that ended so kept what it promises, as far as its host let it: OK, or, aloud, DEGRADED or INCONCLUSIVE.
/// NOT OK and INTERRUPTED are not.
pub fn is_sound(test: &str, status: Option<i32>, verdict: &Value) -> bool {
    let expected = [("ok", 0), ("inconclusive", 3), ("degraded", 4)];
    let found = expected.iter().find(|(word, _)| verdict["word"] == *word);
    if status != Some(0) {
        figure(test, &format!("{}: {}", verdict["word"], verdict["reasons"]));
    }
    found.is_some_and(|(_, of_word)| status == Some(*of_word))
}

/// Whether network namespaces can be made; if not, says that the test does not run.
pub fn is_root(test: &str) -> bool {
    let root = nix::unistd::geteuid().is_root();
    if !root {
        skip(test, "needs root (CAP_SYS_ADMIN) for network namespaces");
    }
    root
}

/// Runs a test of a network on a core that has no other, and again, aloud, where it failed on a host that was disturbed
/// meanwhile. All that the test starts runs there.
pub fn network(test: &str, body: impl Fn()) {
    on_cores(test, Need::Core, body);
}

/// The same on a core with other networks like it: for slots that are about half a millisecond apart, in cycles of 2 ms and more.
pub fn shared(test: &str, body: impl Fn()) {
    on_cores(test, Need::Share, body);
}

/// The same with all cores, and while no other network runs: for a test of several cores, or with programs that load them.
pub fn alone(test: &str, body: impl Fn()) {
    on_cores(test, Need::All, body);
}

fn on_cores(test: &str, need: Need, body: impl Fn()) {
    if !is_root(test) {
        return;
    }
    // A test that failed has taken its network down.
    let _cores = CORES.take(need);
    let attempt = || {
        let watch = Standstill::watch();
        let outcome = catch_unwind(AssertUnwindSafe(&body));
        (outcome, watch.over())
    };
    attempts(attempt, |why| again(test, why));
}

/// A name with this beginning that no other station or lab of the tests has.
pub fn unique(what: &str) -> String {
    static COUNT: AtomicUsize = AtomicUsize::new(1);
    format!("{what}-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed))
}

/// The cores that a test needs.
#[derive(Clone, Copy)]
enum Need {
    Share,
    Core,
    All,
}

/// The cores of this host.
struct Cores {
    /// The free shares of each core; `None` before the first is taken.
    free: Mutex<Option<BTreeMap<usize, usize>>>,
    given_back: Condvar,
}

/// Cores that the calling thread is kept to, with all that it starts, until this is dropped.
struct Taken<'a> {
    of: &'a Cores,
    cores: Vec<usize>,
    /// Taken of each.
    shares: usize,
    /// Where it might run before.
    allowed: Vec<usize>,
}

impl Need {
    /// The cores that have it free.
    fn found(self, free: &BTreeMap<usize, usize>) -> Option<Vec<usize>> {
        let mut whole = free.iter().filter(|&(_, &shares)| shares == SHARES).map(|(&core, _)| core);
        // A core that is shared is filled first, so that others stay whole.
        let shared = || free.iter().filter(|&(_, &shares)| shares > 0).min_by_key(|&(_, &shares)| shares);
        match self {
            Self::Share => shared().map(|(&core, _)| vec![core]),
            Self::Core => whole.next().map(|core| vec![core]),
            Self::All => Some(whole.collect()).filter(|cores: &Vec<_>| cores.len() == free.len()),
        }
    }
}

impl Cores {
    /// Waits until the cores that are needed are free.
    fn take(&self, need: Need) -> Taken<'_> {
        let allowed = realtime::allowed_cpus();
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let all = || allowed.iter().map(|&core| (core, SHARES)).collect();
            let known = free.get_or_insert_with(all);
            if let Some(cores) = need.found(known) {
                let shares = if matches!(need, Need::Share) { 1 } else { SHARES };
                cores.iter().for_each(|core| *known.entry(*core).or_default() -= shares);
                keep_to(&cores);
                return Taken { of: self, cores, shares, allowed };
            }
            free = self.given_back.wait(free).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Drop for Taken<'_> {
    fn drop(&mut self) {
        keep_to(&self.allowed);
        let mut free = self.of.free.lock().unwrap_or_else(PoisonError::into_inner);
        let known = free.get_or_insert_default();
        self.cores.iter().for_each(|core| *known.entry(*core).or_default() += self.shares);
        self.of.given_back.notify_all();
    }
}

/// Keeps the calling thread, and what it starts from now on, to these cores.
fn keep_to(cores: &[usize]) {
    let mut set = CpuSet::new();
    cores.iter().for_each(|&core| set.set(core).expect("it is allowed"));
    sched_setaffinity(Pid::from_raw(0), &set).expect("they are allowed");
}

/// Does something until it does not panic, or panics on a host that was not disturbed, or for the last time; says why it does
/// it again.
fn attempts(attempt: impl Fn() -> (std::thread::Result<()>, Still), again: impl Fn(&str)) {
    for number in 1..=ATTEMPTS {
        match attempt() {
            (Ok(()), _) => return,
            (Err(panic), still) if still.is_disturbed() && number < ATTEMPTS => {
                let why = one_line(panic.as_ref());
                again(&format!("{still}: {why}"));
            }
            (Err(panic), _) => resume_unwind(panic),
        }
    }
}

/// The message of a failed test in one line, for logs.
fn one_line(panic: &(dyn Any + Send)) -> String {
    let said = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
    said.unwrap_or_default().split_whitespace().take(WORDS_AT_MOST).collect::<Vec<_>>().join(" ")
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

/// Watches for how long cores ran nothing, not even what is most urgent, and how long ordinary threads waited for one.
pub struct Standstill {
    stop: Arc<AtomicBool>,
    urgent: Vec<JoinHandle<Late>>,
    ordinary: Vec<JoinHandle<Late>>,
}

/// How a host was disturbed: on the core where it was the longest, and for the most of the time.
#[derive(Clone, Copy, Default)]
pub struct Still {
    /// For so long at once a core ran not even what is most urgent.
    pub longest: Duration,
    /// For so many parts in a million of the time it did not.
    pub ppm: u64,
    /// An ordinary thread waited for so long to be run.
    pub waited: Duration,
}

/// How late a thread woke, at the most and for how much of the time.
#[derive(Clone, Copy, Default)]
struct Late {
    longest: Duration,
    ppm: u64,
}

impl Late {
    fn or(self, other: Self) -> Self {
        Self { longest: self.longest.max(other.longest), ppm: self.ppm.max(other.ppm) }
    }
}

impl Still {
    /// Whether a test that failed meanwhile says nothing of what it tests.
    fn is_disturbed(&self) -> bool {
        self.longest > STILL || self.ppm > STILL_PPM || self.waited > WAITED
    }
}

impl fmt::Display for Still {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Still { longest, ppm, waited } = self;
        let share = *ppm as f64 / 1e4;
        write!(
            f,
            "this host stood still for {longest:?}, {share:.1} % of the time in all, and let ordinary threads wait for \
             {waited:?}"
        )
    }
}

impl Standstill {
    /// On every core, from now on.
    pub fn watch() -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let watch = |priority: Option<i32>| {
            let each = |cpu| {
                let stopped = stop.clone();
                std::thread::spawn(move || naps(priority, cpu, &stopped))
            };
            realtime::allowed_cpus().into_iter().map(each).collect()
        };
        let (urgent, ordinary) = (watch(Some(99)), watch(None));
        Self { stop, urgent, ordinary }
    }

    /// What it was, at the end.
    pub fn over(self) -> Still {
        self.stop.store(true, Ordering::Relaxed);
        let all = |threads: Vec<JoinHandle<Late>>| {
            let each = threads.into_iter().map(|thread| thread.join().unwrap_or_default());
            each.fold(Late::default(), Late::or)
        };
        let (Late { longest, ppm }, ordinary) = (all(self.urgent), all(self.ordinary));
        Still { longest, ppm, waited: ordinary.longest }
    }
}

/// Sleeps again and again, until it is stopped: how late it woke.
fn naps(priority: Option<i32>, cpu: usize, stop: &AtomicBool) -> Late {
    // Where the host refuses a priority, what is more urgent counts as standstill, too.
    RealTime { priority, cpu: Some(cpu) }.apply();
    let (begin, mut longest, mut all) = (Instant::now(), Duration::ZERO, Duration::ZERO);
    while !stop.load(Ordering::Relaxed) {
        let before = Instant::now();
        std::thread::sleep(NAP);
        let asleep = before.elapsed();
        longest = longest.max(asleep);
        all += asleep.checked_sub(NAP + LATE).map_or(Duration::ZERO, |late| late + LATE);
    }
    let ppm = all.as_nanos() as u64 * 1_000_000 / begin.elapsed().as_nanos().max(1) as u64;
    Late { longest, ppm }
}

/// Which thread this is, for [`until_asleep`].
pub fn this_thread() -> Pid {
    gettid()
}

/// Waits until a thread of this process waits for something.
pub fn until_asleep(thread: Pid) {
    until_in_state('S', Path::new(&format!("/proc/self/task/{thread}")));
}

/// Stops a process, and waits until none of its threads runs any more.
pub fn stop(process: Pid) {
    kill(process, Signal::SIGSTOP).expect("it is there");
    until_stopped(process);
}

/// Waits until none of a process's threads runs any more: it is stopped.
pub fn until_stopped(process: Pid) {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).expect("it is there");
    threads.for_each(|thread| until_in_state('T', &thread.expect("it is there").path()));
}

fn until_in_state(state: char, thread: &Path) {
    let deadline = Instant::now() + PATIENCE;
    // Its state is behind its name, which may have spaces: proc(5).
    while !std::fs::read_to_string(thread.join("stat"))
        .is_ok_and(|stat| stat.rsplit(") ").next().unwrap_or("").starts_with(state))
    {
        assert!(Instant::now() < deadline, "{} never comes to state {state}", thread.display());
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    fn still(longest: u64, ppm: u64, waited: u64) -> Still {
        Still { longest: Duration::from_millis(longest), ppm, waited: Duration::from_millis(waited) }
    }

    #[test]
    fn host_is_disturbed_beyond_each_limit() {
        assert!(!still(20, 5_000, 20).is_disturbed());
        assert!([still(21, 0, 0), still(0, 5_001, 0), still(0, 0, 21)].iter().all(Still::is_disturbed));
    }

    #[test]
    fn a_core_is_one_tests_until_it_is_given_back() {
        let cores = Cores { free: Mutex::new(None), given_back: Condvar::new() };
        let allowed = realtime::allowed_cpus();
        let one = cores.take(Need::Core);
        assert_eq!((one.cores.len(), realtime::allowed_cpus()), (1, one.cores.clone()));
        let is_given_back = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let (waits, is_waiting) = std::sync::mpsc::channel();
            let (cores, is_given_back, count) = (&cores, &is_given_back, allowed.len());
            scope.spawn(move || {
                waits.send(this_thread()).unwrap();
                let all = cores.take(Need::All);
                assert!(is_given_back.load(Ordering::Relaxed));
                assert_eq!(all.cores.len(), count);
            });
            until_asleep(is_waiting.recv().unwrap());
            is_given_back.store(true, Ordering::Relaxed);
            drop(one);
        });
        assert_eq!(realtime::allowed_cpus(), allowed, "as before");
    }

    #[test]
    fn shared_cores_are_filled_before_others_are_shared() {
        let of = |shares: &[usize]| shares.iter().copied().enumerate().collect::<BTreeMap<_, _>>();
        let found = |need: Need, shares: &[usize]| need.found(&of(shares));
        assert_eq!(found(Need::Share, &[SHARES, 1]), Some(vec![1]));
        assert_eq!(found(Need::Share, &[SHARES, 0]), Some(vec![0]));
        assert_eq!(found(Need::Share, &[0, 0]), None);
        assert_eq!((found(Need::Core, &[3, SHARES]), found(Need::Core, &[3, 0])), (Some(vec![1]), None));
        assert_eq!((found(Need::All, &[3, SHARES]), found(Need::All, &[SHARES])), (None, Some(vec![0])));
    }

    #[test]
    fn failure_is_tried_again_on_disturbed_hosts_only() {
        // What becomes of a test that fails so often, how often it was run, and how often again, aloud.
        let tried = |failures: usize, still: Still| {
            let (runs, said) = (Cell::new(0), Cell::new(0));
            let attempt = || {
                runs.set(runs.get() + 1);
                let outcome =
                    if runs.get() > failures { Ok(()) } else { Err(Box::new("a reason") as Box<_>) };
                (outcome, still)
            };
            let again = |why: &str| {
                assert!(why.ends_with(": a reason"), "{why}");
                said.set(said.get() + 1);
            };
            let ended = catch_unwind(AssertUnwindSafe(|| attempts(attempt, again)));
            (ended.is_ok(), runs.get(), said.get())
        };
        assert_eq!(tried(0, still(0, 0, 0)), (true, 1, 0));
        assert_eq!(tried(1, still(0, 0, 0)), (false, 1, 0));
        assert_eq!(tried(3, still(21, 0, 0)), (true, 4, 3));
        assert_eq!(tried(4, still(21, 0, 0)), (false, 4, 3));
    }
}
