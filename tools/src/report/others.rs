//! Real-time threads of other programs on one core: while one of them runs, nothing less urgent does.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::text::percent;

/// SCHED_FIFO, SCHED_RR and SCHED_DEADLINE.
const REAL_TIME: [u64; 3] = [1, 2, 6];
/// Of a core's time: what takes less holds nobody up that could be told from timers and interrupts.
const LEAST_PPM: u64 = 100;

/// One that ran.
#[derive(Clone, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RealTimeThread {
    /// Its name.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// The share of the core's time that it took, in parts per million.
    pub ppm: u64,
}

impl fmt::Display for RealTimeThread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}) {}", self.name, self.pid, percent(self.ppm))
    }
}

/// How long all of them had run when it began.
#[derive(Debug)]
pub(super) struct Others {
    core: usize,
    own: u32,
    at_begin: BTreeMap<u32, u64>,
}

/// What the kernel tells of a thread.
#[derive(Debug, PartialEq, Eq)]
struct Stat {
    name: String,
    parent: u32,
    processor: usize,
    policy: u64,
}

struct Thread {
    name: String,
    pid: u32,
    tid: u32,
    /// Nanoseconds.
    ran: u64,
}

impl Others {
    /// Of this core. Neither this process nor its children, a lab's stations, are others.
    pub fn watch(core: usize) -> Self {
        let own = std::process::id();
        // Whatever runs elsewhere now, or is not real-time yet, may come.
        let at_begin = threads(own, |_| true).into_iter().map(|thread| (thread.tid, thread.ran)).collect();
        Self { core, own, at_begin }
    }

    /// Those that ran since then, so long, the busiest first.
    pub fn since(&self, passed: Duration) -> Vec<RealTimeThread> {
        let share = |thread: Thread| {
            let ran = thread.ran.saturating_sub(self.at_begin.get(&thread.tid).copied().unwrap_or(0));
            // One that is new may have run elsewhere, or before it was real-time: for no longer than this.
            let ran = u128::from(ran).min(passed.as_nanos());
            let ppm = (ran * 1_000_000 / passed.as_nanos().max(1)) as u64;
            RealTimeThread { name: thread.name, pid: thread.pid, ppm }
        };
        let is_one = |stat: &Stat| stat.processor == self.core && REAL_TIME.contains(&stat.policy);
        let mut all: Vec<_> = threads(self.own, is_one).into_iter().map(share).collect();
        all.retain(|thread| thread.ppm >= LEAST_PPM);
        all.sort_by(|a, b| (b.ppm, &a.name, a.pid).cmp(&(a.ppm, &b.name, b.pid)));
        all
    }
}

/// Threads of such a state, but for those of a process and its children.
fn threads(own: u32, is_one: impl Fn(&Stat) -> bool) -> Vec<Thread> {
    let processes = numbers("/proc").into_iter().filter(|&pid| pid != own);
    let all = processes
        .flat_map(|pid| numbers(&format!("/proc/{pid}/task")).into_iter().map(move |tid| (pid, tid)));
    let thread = |(pid, tid): (u32, u32)| {
        let place = format!("/proc/{pid}/task/{tid}");
        let stat = parse(&fs::read_to_string(format!("{place}/stat")).ok()?)?;
        if stat.parent == own || !is_one(&stat) {
            return None;
        }
        let ran = fs::read_to_string(format!("{place}/schedstat")).ok()?;
        let ran = ran.split_ascii_whitespace().next()?.parse().ok()?;
        Some(Thread { name: stat.name, pid, tid, ran })
    };
    all.filter_map(thread).collect()
}

/// The names in a directory that are numbers.
fn numbers(directory: &str) -> Vec<u32> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect()
}

/// `/proc/PID/task/TID/stat`: fields 2, 4, 39 and 41 of proc(5). A name may hold blanks and brackets.
fn parse(stat: &str) -> Option<Stat> {
    let (head, tail) = stat.rsplit_once(')')?;
    let name = head.split_once('(')?.1.to_owned();
    // The first of these is field 3.
    let fields: Vec<&str> = tail.split_ascii_whitespace().collect();
    let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
    let (parent, processor, policy) = (field(4)?, field(39)?, field(41)?);
    Some(Stat { name, parent: parent as u32, processor: processor as usize, policy })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thread_is_read_from_its_fields() {
        let before = (5..39).map(|n| n.to_string()).collect::<Vec<_>>().join(" ");
        let stat = format!("77 (a (b) c) S 12 {before} 3 90 1 0 0\n");
        let expected = Stat { name: "a (b) c".into(), parent: 12, processor: 3, policy: 1 };
        assert_eq!(parse(&stat), Some(expected));
        assert_eq!(parse("77 (short) S 12 1"), None);
    }

    #[test]
    fn ordinary_threads_and_own_ones_are_no_others() {
        let others = Others::watch(0);
        let own = std::process::id();
        assert!(others.since(Duration::from_secs(1)).iter().all(|thread| thread.pid != own));
        let this = parse(&fs::read_to_string("/proc/self/stat").unwrap()).unwrap();
        assert!(!REAL_TIME.contains(&this.policy), "{this:?}");
    }
}
