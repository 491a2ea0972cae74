//! An impaired wire: programs at a bridge's port that lose, double and change what passes, by chance, and cut the
//! medium in two. For the faults of a lab; no station has any of it.
//!
//! ```text
//!            port of the bridge
//!  station ──► ingress: marks ──► bridge ──► egress of another port: loses, changes, doubles ──► station
//! ```
//!
//! The kernel draws, so that no seed repeats a run. It is all undone when an [`Impairment`] is dropped or its process
//! ends.

mod program;
#[cfg(test)]
mod tests;

use core::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::io;
use std::os::fd::{AsRawFd, OwnedFd};

use zerocopy::FromBytes;

use super::bpf::{self, Hook, Map, Mapping};

const NAME: bpf::Name = *b"rtnet_impair\0\0\0\0";
/// Frames that are kept until they are taken: what is lost in a second of many at one port.
const LOG: usize = 512;
/// So much of each: a Synchronisation, Ethernet header included.
pub const LOGGED: usize = 42;
const LOG_ENTRY: usize = 64;
/// In a mark and a page: that a station is on the other side of a cut.
const OTHER_SIDE: u64 = 0x100;
const MILLION: u64 = 1_000_000;

/// What becomes of frames in one direction of a wire, in a million.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Chances {
    /// RTmac frames that are lost.
    pub lose_control_ppm: u32,
    /// All other frames that are.
    pub lose_data_ppm: u32,
    /// Frames of which a bit is not what it was.
    pub corrupt_ppm: u32,
    /// Frames that come twice.
    pub duplicate_ppm: u32,
}

/// Why a wire cannot be impaired: what was asked of the kernel, and its answer.
#[derive(Debug, thiserror::Error)]
#[error("impaired wire, {step}: {error}")]
pub struct ImpairmentRefused {
    step: &'static str,
    error: io::Error,
}

/// The last step of all: the programs are there.
const ATTACHED: &str = "tcx";

impl ImpairmentRefused {
    /// What to do about it.
    pub fn remedy(&self) -> String {
        let is_gone = self.step == ATTACHED && self.error.raw_os_error() == Some(libc::ENODEV);
        let own = || match is_gone {
            true => "the bridge's port is gone: somebody took it away; run the lab again",
            // That came last of what the programs need.
            false => "it needs tcx: the kernel must be Linux 6.6 or later",
        };
        bpf::remedy(&self.error).unwrap_or_else(|| own().into())
    }
}

/// What became of frames on their way to a station.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Impaired {
    /// RTmac frames that were lost, by its own wire, their sender's, or a cut.
    pub lost_control: u64,
    /// All other frames that were.
    pub lost_data: u64,
    /// Frames of which a bit was changed.
    pub corrupted: u64,
    /// Frames that came twice.
    pub duplicated: u64,
}

/// What the process and the programs of a port share.
#[repr(C)]
#[derive(FromBytes)]
struct Page {
    sends: Thresholds,
    hears: Thresholds,
    side: AtomicU64,
    lost_control: AtomicU64,
    lost_data: AtomicU64,
    corrupted: AtomicU64,
    duplicated: AtomicU64,
    /// Lost frames, and RTmac frames that were changed, that began to be written down...
    begun: AtomicU64,
    /// ... and that were.
    written: AtomicU64,
    log: [[AtomicU8; LOG_ENTRY]; LOG],
}

// SAFETY: atomics only.
unsafe impl bpf::Page for Page {}

/// What a random number of 32 bits is less than if it happens.
#[repr(C)]
#[derive(FromBytes)]
struct Thresholds {
    lose_control: AtomicU64,
    lose_data: AtomicU64,
    corrupt: AtomicU64,
    duplicate: AtomicU64,
}

impl Thresholds {
    fn set(&self, chances: &Chances) {
        let set = |to: &AtomicU64, ppm: u32| {
            to.store((u64::from(ppm) << 32) / MILLION, Ordering::Relaxed);
        };
        set(&self.lose_control, chances.lose_control_ppm);
        set(&self.lose_data, chances.lose_data_ppm);
        set(&self.corrupt, chances.corrupt_ppm);
        set(&self.duplicate, chances.duplicate_ppm);
    }
}

/// The wire behind a port of a bridge. At first it does nothing to any frame.
pub struct Impairment {
    map: Map<Page>,
    mapping: Mapping<Page>,
    /// Of what was written down, so many were taken.
    taken: u64,
    hooks: [OwnedFd; 2],
}

impl Impairment {
    /// Attaches to a port in the calling thread's namespace. Of a cut, and of what senders' wires do, every port of the
    /// bridge must know. Needs CAP_BPF and CAP_NET_ADMIN, and Linux 6.6.
    pub fn attach(port: u32) -> Result<Self, ImpairmentRefused> {
        let map = Map::create(NAME).map_err(refused("bpf map"))?;
        let mapping = Mapping::new(&map).map_err(refused("bpf map in memory"))?;
        let hooks = hooks(&map, port)?;
        Ok(Self { map, mapping, taken: 0, hooks })
    }

    /// Attaches to the port that is in the place of the one before: what happens to frames, what was counted, and what
    /// was written down, stays as it is.
    pub fn attach_anew(&mut self, port: u32) -> Result<(), ImpairmentRefused> {
        self.hooks = hooks(&self.map, port)?;
        Ok(())
    }

    /// What becomes of what the station sends, from now on: the same for all who hear it, but which bit is changed.
    pub fn sends(&self, chances: &Chances) {
        self.mapping.page().sends.set(chances);
    }

    /// What becomes of what it hears, besides.
    pub fn hears(&self, chances: &Chances) {
        self.mapping.page().hears.set(chances);
    }

    /// Puts the station on the other side of a cut, or back: it hears those of its side only.
    pub fn cut_off(&self, is_cut_off: bool) {
        self.mapping.page().side.store(if is_cut_off { OTHER_SIDE } else { 0 }, Ordering::Relaxed);
    }

    /// What was counted so far.
    pub fn counts(&self) -> Impaired {
        let Page { lost_control, lost_data, corrupted, duplicated, .. } = self.mapping.page();
        let counts = [lost_control, lost_data, corrupted, duplicated];
        let [lost_control, lost_data, corrupted, duplicated] = counts.map(|of| of.load(Ordering::Relaxed));
        Impaired { lost_control, lost_data, corrupted, duplicated }
    }

    /// Hands over the beginning of each frame that was lost since the last time, and of each RTmac frame that was changed, as
    /// it was: of more than half a thousand the newest.
    pub fn take_lost(&mut self, mut to: impl FnMut([u8; LOGGED])) {
        let page = self.mapping.page();
        let written = page.written.load(Ordering::Acquire);
        // One that is being written now comes with the next.
        if page.begun.load(Ordering::Acquire) != written {
            return;
        }
        // The next one may be on its way to the place of the oldest.
        for number in self.taken.max(written.saturating_sub(LOG as u64 - 1))..written {
            let entry = &page.log[number as usize % LOG];
            to(core::array::from_fn(|byte| entry[byte].load(Ordering::Relaxed)));
        }
        self.taken = written;
    }
}

/// Both programs at a port, with one map.
fn hooks(map: &Map<Page>, port: u32) -> Result<[OwnedFd; 2], ImpairmentRefused> {
    let map = map.as_raw_fd();
    let hook = |program: Vec<_>, hook| {
        let program = bpf::load(&program, NAME).map_err(refused("bpf program"))?;
        bpf::attach(&program, port, hook).map_err(refused(ATTACHED))
    };
    Ok([hook(program::sends(map), Hook::Ingress)?, hook(program::hears(map), Hook::Egress)?])
}

fn refused(step: &'static str) -> impl Fn(io::Error) -> ImpairmentRefused {
    move |error| ImpairmentRefused { step, error }
}
