//! Networks on one machine: each station a process in a namespace of its own, joined by a bridge, and
//! watched from there.
//!
//! ```text
//!   namespace of a station      namespace of the segment          this process
//!   ┌─────────────┐             ┌──────────────────────┐
//!   │ station  rt0│────veth─────│port0 ┐               │          stations' reports ─► run
//!   └─────────────┘             │      ├ br0 ── ring ──│────────► frames, stamped  ─► judge::analysis
//!   ┌─────────────┐             │port1 ┘               │
//!   │ station  rt0│────veth─────│                      │          judge::explain: every finding has a record
//!   └─────────────┘             └──────────────────────┘
//! ```
//!
//! The namespaces have no names: they go with the last process inside, however it ends.

pub mod enter;
mod facts;
pub(crate) mod faults;
pub(crate) mod guests;
pub(crate) mod join;
mod keep;
pub(crate) mod launch;
pub(crate) mod lead;
pub(crate) mod load;
mod members;
pub mod namespace;
pub mod netlink;
pub(crate) mod processes;
mod returns;
pub(crate) mod run;
mod tally;
mod turns;
mod unplugged;
pub mod userns;
mod verdict;
pub(crate) mod wires;

use crate::remedy;

/// Descriptors of this process that a station takes: its namespace, and its process's input and output.
const FILES_OF_STATION: usize = 3;
/// Those of everything else: the medium, capture, control socket and its clients, and what is open for a moment only.
const FILES_BESIDE: usize = 32;

/// Whether this process may have descriptors for a lab of so many stations.
///
/// # Errors
/// It may not: which limit it is, how many stations it holds, and what to do.
pub fn check_files(stations: usize) -> anyhow::Result<()> {
    remedy::check_files(stations, FILES_OF_STATION, FILES_BESIDE).map_err(anyhow::Error::msg)
}

pub use keep::keep;
pub use load::Core;
pub use processes::this_program;
pub use run::{Lab, RunOptions};
