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
mod keep;
pub(crate) mod launch;
pub(crate) mod load;
mod members;
pub mod namespace;
pub mod netlink;
pub(crate) mod processes;
mod returns;
pub(crate) mod run;
mod tally;
mod unplugged;
pub mod userns;
mod verdict;
pub(crate) mod wires;

pub use keep::keep;
pub use load::Core;
pub use processes::this_program;
pub use run::{Interrupted, Lab, RunOptions};
