//! Processes in a lab's namespaces that are not its own: what `lab exec` has started there, and what that has.
//!
//! In a running lab they are known by their network namespace. A number of a namespace is used again once that is gone, so
//! that of a lab that was killed they are known by its mark, too: the source of the `/sys` that `lab exec` mounts for them.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};

use super::namespace::Namespace;

/// How long they may take to end by themselves.
const END_WITHIN: Duration = Duration::from_secs(1);
/// How long the kernel may take to end them.
const GONE_WITHIN: Duration = Duration::from_secs(5);
const LOOK_EVERY: Duration = Duration::from_millis(5);
/// Characters of a command line that are shown.
const COMMAND_AT_MOST: usize = 60;
/// Processes that are named.
const NAMED_AT_MOST: usize = 10;
/// Where the kernel makes numbers that are never used twice.
const UUID: &str = "/proc/sys/kernel/random/uuid";

/// Ends what is in a lab's namespaces and not its own.
pub struct Guests {
    namespaces: BTreeSet<u64>,
    mark: String,
    /// A lab that was killed: a number of a namespace is not enough.
    is_dead: bool,
    has_ended: bool,
}

/// Processes, each with its command line.
type Found = BTreeMap<i32, String>;

impl Guests {
    /// The guests of a lab with these stations.
    pub fn of<'a>(namespaces: impl Iterator<Item = &'a Namespace>) -> Result<Self> {
        let namespaces = namespaces.map(Namespace::number).collect::<Result<_>>()?;
        let mark = fs::read_to_string(UUID).with_context(|| format!("{UUID} cannot be read"))?;
        Ok(Self { namespaces, mark: mark.trim().to_owned(), is_dead: false, has_ended: false })
    }

    /// The guests of a lab that was killed, and has left this note.
    pub fn of_dead(note: &str) -> Self {
        let mut lines = note.lines();
        let mark = lines.next().unwrap_or_default().to_owned();
        let namespaces = lines.filter_map(|line| line.parse().ok()).collect();
        Self { namespaces, mark, is_dead: true, has_ended: false }
    }

    /// The note that [`Guests::of_dead`] reads: the mark in the first line, which `lab exec` reads, too.
    pub fn note(&self) -> String {
        let numbers = self.namespaces.iter().map(|number| format!("{number}\n"));
        format!("{}\n{}", self.mark, numbers.collect::<String>())
    }

    /// Ends them; which were ended, and which are left, one line each.
    pub fn end(&mut self) -> Vec<String> {
        self.has_ended = true;
        let mut ended = Found::new();
        let mut left = self.end_with(Signal::TERM, END_WITHIN, &mut ended);
        if !left.is_empty() {
            left = self.end_with(Signal::KILL, GONE_WITHIN, &mut ended);
        }
        ended.retain(|pid, _| !left.contains_key(pid));
        let lines = [
            summary("ended with the lab, in whose namespaces they were: ", &ended),
            summary("still in the lab's namespaces, and not to be ended: end them by hand: ", &left),
        ];
        lines.into_iter().flatten().collect()
    }

    /// Sends each of them this signal once, also those that come meanwhile; those that are left.
    fn end_with(&self, signal: Signal, within: Duration, ended: &mut Found) -> Found {
        let deadline = Instant::now() + within;
        let mut sent = BTreeSet::new();
        loop {
            let here = self.here();
            for (&pid, command) in &here {
                if sent.insert(pid) && self.send(pid, signal) {
                    ended.insert(pid, command.clone());
                }
            }
            if here.is_empty() || Instant::now() > deadline {
                return here;
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }

    /// Sends a signal to a process that is found to be one of them once no other can have its number.
    fn send(&self, pid: i32, signal: Signal) -> bool {
        let Some(process) = Pid::from_raw(pid) else { return false };
        let Ok(process) = pidfd_open(process, PidfdFlags::empty()) else { return false };
        self.is_guest(pid) && pidfd_send_signal(&process, signal).is_ok()
    }

    fn here(&self) -> Found {
        let all = fs::read_dir("/proc").into_iter().flatten().flatten();
        let numbers = all.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
        numbers.filter(|&pid| self.is_guest(pid)).map(|pid| (pid, command(pid))).collect()
    }

    fn is_guest(&self, pid: i32) -> bool {
        let is_there =
            fs::metadata(of(pid, "ns/net")).is_ok_and(|found| self.namespaces.contains(&found.ino()));
        is_there && !is_own(pid) && (!self.is_dead || self.is_marked(pid))
    }

    /// Whether its `/sys` was mounted by `lab exec` for this lab.
    fn is_marked(&self, pid: i32) -> bool {
        let source = format!(" - sysfs {} ", source(&self.mark));
        !self.mark.is_empty()
            && fs::read_to_string(of(pid, "mountinfo")).is_ok_and(|mounts| mounts.contains(&source))
    }
}

impl Drop for Guests {
    /// A lab that failed is not asked.
    fn drop(&mut self) {
        if !self.has_ended && !self.is_dead {
            self.end();
        }
    }
}

/// The source of a `/sys` that is mounted for a lab's guest.
pub fn source(mark: &str) -> String {
    format!("rtnet-{mark}")
}

/// This process, and its stations, which are its children.
fn is_own(pid: i32) -> bool {
    let own = std::process::id();
    let stat = fs::read_to_string(of(pid, "stat")).unwrap_or_default();
    // The name in parentheses may hold anything.
    let parent = stat.rsplit_once(") ").and_then(|(_, rest)| rest.split_whitespace().nth(1)?.parse().ok());
    pid.unsigned_abs() == own || parent == Some(own)
}

fn of(pid: i32, file: &str) -> PathBuf {
    format!("/proc/{pid}/{file}").into()
}

/// The command line, as far as it fits a line.
fn command(pid: i32) -> String {
    let line = fs::read(of(pid, "cmdline")).unwrap_or_default();
    let line = String::from_utf8_lossy(&line).trim_end_matches('\0').replace('\0', " ");
    let line = if line.is_empty() { fs::read_to_string(of(pid, "comm")).unwrap_or_default() } else { line };
    let shown = line.trim_end().chars().map(|c| if c.is_control() { '?' } else { c });
    shown.take(COMMAND_AT_MOST).collect()
}

fn summary(what: &str, guests: &Found) -> Option<String> {
    let named = guests.iter().take(NAMED_AT_MOST).map(|(pid, command)| format!("{pid} ({command})"));
    let named = named.collect::<Vec<_>>().join(", ");
    let more = guests.len().saturating_sub(NAMED_AT_MOST);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let noun = if guests.len() == 1 { "process" } else { "processes" };
    (!guests.is_empty()).then(|| format!("{} {noun} {what}{named}{more}", guests.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn note_of_a_lab_is_read_back() {
        let namespaces = BTreeSet::from([4_026_532_000, 4_026_532_001]);
        let guests = Guests { namespaces, mark: "one".into(), is_dead: false, has_ended: true };
        let dead = Guests::of_dead(&guests.note());
        assert_eq!((&dead.mark, &dead.namespaces), (&guests.mark, &guests.namespaces));
        assert!(dead.is_dead);
    }

    #[test]
    fn note_without_a_mark_ends_nothing() {
        let own = fs::metadata("/proc/self/ns/net").unwrap().ino();
        for note in [String::new(), format!("\n{own}\n"), format!("another\n{own}\n")] {
            assert!(Guests::of_dead(&note).here().is_empty(), "{note:?}");
        }
    }

    #[test]
    fn ended_processes_are_named_up_to_a_count() {
        let guests = |count| (1..=count).map(|pid| (pid, "sleep 7".to_owned())).collect();
        assert_eq!(summary("ended: ", &guests(0)), None);
        assert_eq!(summary("ended: ", &guests(1)).unwrap(), "1 process ended: 1 (sleep 7)");
        let many = summary("ended: ", &guests(12)).unwrap();
        assert!(
            many.starts_with("12 processes ended: 1 (sleep 7), ") && many.ends_with(" and 2 more"),
            "{many}"
        );
    }
}
