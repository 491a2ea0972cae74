//! The kernel guard: a program at an interface's egress that drops what would leave too late.
//!
//! ```text
//!   station                         kernel
//!   page.begin, page.end ──────────► ┌─────────┐ in time
//!   check, send ───── frame ───────► │ program │ ────────► wire
//!   ENOBUFS, page.late + 1 ◄──────── └─────────┘
//! ```
//!
//! Between a station's last look at the clock and the wire anything may stop it: the guard looks again, in
//! the kernel, where nothing is preempted any more on the way to the wire of a virtual link. (On a network
//! card, the card's own queue is behind it.) A station writes its transmission's window into a page that it
//! shares with the program, which costs no system call. Times are CLOCK_MONOTONIC, nanoseconds.
//!
//! The page begins as zero, and a window is closed after its frame: what is sent outside of any window is
//! dropped, too. That holds for frames with [`MARK`], which sockets of guarded ports set, whoever sends
//! them; all others pass, so that an interface can be shared with ordinary traffic.

mod clsact;
mod program;

use core::sync::atomic::{AtomicU64, Ordering};
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};

use zerocopy::FromBytes;

use super::bpf::{self, assembler};
use super::rights;
use crate::clock::True;

pub use program::MARK;

const NAME: bpf::Name = *b"rtnet_guard\0\0\0\0\0";

/// What stalls after its check by no more than this may leave: 10 us, or a twelfth of a long time...
const STALL: True = 10_000;
const STALL_PARTS: True = 12;
/// ... but no more than this part of a short one.
const STALL_PARTS_AT_MOST: True = 3;

/// How long after its latest begin a frame may still leave that could begin for `time` nanoseconds. It is late, which is
/// told of, but not yet where its neighbour's clock may be wrong by, and a Synchronisation not beyond its window.
pub fn tolerance(time: True) -> True {
    (time / STALL_PARTS).max(STALL).min(time / STALL_PARTS_AT_MOST)
}

/// Whether a port is to have a guard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum GuardMode {
    /// If the host lets it; if not, it goes on and says why.
    #[default]
    Auto,
    /// Not without.
    Kernel,
    /// Without: the last look at the clock before `send` is the last.
    User,
}

/// Why there is no guard: what was asked of the kernel, and its answer.
#[derive(Debug, thiserror::Error)]
#[error("{}: {error}", .step.name())]
pub struct GuardRefused {
    step: Step,
    error: io::Error,
}

/// What is asked of the kernel, in this order, for a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Clock,
    Map,
    Mapping,
    Program,
    Hook,
    Mark,
}

impl Step {
    fn name(self) -> &'static str {
        match self {
            Step::Clock => "CLOCK_MONOTONIC",
            Step::Map => "bpf map",
            Step::Mapping => "bpf map in memory",
            Step::Program => "bpf program",
            Step::Hook => "tcx, clsact",
            Step::Mark => "SO_MARK",
        }
    }
}

impl GuardRefused {
    pub(super) fn new(step: Step, error: io::Error) -> Self {
        Self { step, error }
    }

    /// What to do about it: the same answer means another thing at another step.
    pub fn remedy(&self) -> String {
        let own = || match (self.step, self.error.raw_os_error()) {
            (Step::Hook, Some(libc::ENODEV)) => "the interface is gone: look with `ip link`",
            (Step::Hook, _) => "the interface needs tcx, Linux 6.6, or clsact",
            // A map that can be shared with a process came last of what the program needs.
            _ => "the kernel must be Linux 5.5 or later",
        };
        match self.step {
            Step::Clock => "run it in the host's time namespace".into(),
            Step::Mark => rights::remedy(&["CAP_NET_ADMIN"]),
            _ => bpf::remedy(&self.error).unwrap_or_else(|| own().into()),
        }
    }
}

/// What became of the frames that a guard has seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct GuardCounters {
    /// In their window.
    pub passed: u64,
    /// Dropped: after their window's end, or without a window.
    pub late: u64,
    /// Dropped: before their window's begin.
    pub early: u64,
    /// Of other programs on the interface: dropped if they are kept off, else let pass.
    pub others: u64,
}

/// A guard at an interface, until it is dropped or its process ends. (A clsact filter stays if the process is
/// killed, or has given up CAP_NET_ADMIN: it drops marked frames until the next guard there replaces it.)
pub struct Guard {
    mapping: bpf::Mapping<Page>,
    _hook: Hook,
}

/// What the station and the program share.
#[repr(C)]
#[derive(FromBytes)]
struct Page {
    begin: AtomicU64,
    end: AtomicU64,
    passed: AtomicU64,
    late: AtomicU64,
    early: AtomicU64,
    others: AtomicU64,
    /// What becomes of others' frames, as the program returns it.
    verdict: AtomicU64,
}

// SAFETY: atomics only.
unsafe impl bpf::Page for Page {}

/// What holds the program in place.
enum Hook {
    Tcx { _link: OwnedFd },
    Clsact { _filter: clsact::Filter },
}

type Attach = fn(&OwnedFd, u32) -> io::Result<Hook>;

impl Guard {
    /// Attaches a guard to an interface of the calling thread's namespace. Needs CAP_BPF and CAP_NET_ADMIN.
    pub fn attach(interface: u32) -> Result<Self, GuardRefused> {
        Self::attach_by(
            |program, interface| tcx(program, interface).or_else(|_| clsact(program, interface)),
            interface,
        )
    }

    fn attach_by(hook: Attach, interface: u32) -> Result<Self, GuardRefused> {
        let refused = |step| move |error| GuardRefused::new(step, error);
        the_kernels_clock().map_err(refused(Step::Clock))?;
        let map = bpf::Map::<Page>::create(NAME).map_err(refused(Step::Map))?;
        let mapping = bpf::Mapping::new(&map).map_err(refused(Step::Mapping))?;
        mapping.page().verdict.store(assembler::NEXT as u64, Ordering::Relaxed);
        let program = program::assemble(map.as_raw_fd());
        let program = bpf::load(&program, NAME).map_err(refused(Step::Program))?;
        let hook = hook(&program, interface).map_err(refused(Step::Hook))?;
        Ok(Self { mapping, _hook: hook })
    }

    /// From here on no frame of other programs leaves this interface.
    pub fn keep_others_off(&self) {
        self.mapping.page().verdict.store(assembler::DROP as u64, Ordering::Relaxed);
    }

    /// From here on a frame may leave from `begin` to `end`.
    #[inline]
    pub fn open(&self, begin: True, end: True) {
        // The program runs in this thread's own `send`: no order beyond the program's is needed.
        self.mapping.page().begin.store(begin, Ordering::Relaxed);
        self.mapping.page().end.store(end, Ordering::Relaxed);
    }

    /// From here on no frame may leave.
    #[inline]
    pub fn close(&self) {
        self.mapping.page().end.store(0, Ordering::Relaxed);
    }

    /// How many frames were dropped so far, for whatever reason.
    #[inline]
    pub fn drops(&self) -> u64 {
        let GuardCounters { late, early, .. } = self.counters();
        late + early
    }

    /// What was counted so far. Asks nobody.
    #[inline]
    pub fn counters(&self) -> GuardCounters {
        let Page { passed, late, early, others, .. } = self.mapping.page();
        let counts = [passed, late, early, others].map(|counter| counter.load(Ordering::Relaxed));
        let [passed, late, early, others] = counts;
        GuardCounters { passed, late, early, others }
    }
}

fn tcx(program: &OwnedFd, interface: u32) -> io::Result<Hook> {
    Ok(Hook::Tcx { _link: bpf::attach(program, interface, bpf::Hook::Egress)? })
}

fn clsact(program: &OwnedFd, interface: u32) -> io::Result<Hook> {
    Ok(Hook::Clsact { _filter: clsact::Filter::attach(program, interface)? })
}

/// A time namespace may have set CLOCK_MONOTONIC off: the program, which reads the kernel's own, would drop
/// everything.
fn the_kernels_clock() -> io::Result<()> {
    // Without time namespaces there is no such file.
    let offsets = std::fs::read_to_string("/proc/self/timens_offsets").unwrap_or_default();
    if is_set_off(&offsets) {
        return Err(io::Error::new(io::ErrorKind::Unsupported, "set off by a time namespace"));
    }
    Ok(())
}

/// Lines of clock, seconds, nanoseconds.
fn is_set_off(offsets: &str) -> bool {
    let monotonic = offsets.lines().filter_map(|line| line.strip_prefix("monotonic"));
    monotonic.flat_map(str::split_whitespace).any(|offset| offset != "0")
}

#[cfg(test)]
mod tests;
