//! Networks in virtual time, from the same files as labs: the same stations, the same judge, the same report, and
//! identical bytes for one seed.
//!
//! ```text
//!   scenario ──► world: rtnet::sim::Network ──frames, moments──► watch ─► judge ─► figures
//!                  ▲                                               │
//!                faults: what happens to it                         └─► expectations
//! ```

mod expect;
pub(crate) mod faults;
mod figures;
mod patience;
mod places;
mod run;
pub mod screen;
pub mod seeds;
mod sight;
mod watch;
pub(crate) mod world;

pub use expect::{Checked, of_lab, unmet};
pub use figures::{SimFigures, Simulation};
pub use run::{Ended, Hurried, Options, run};
pub use world::{World, discipline};

/// A scenario that says what can be said, and runs.
pub const EXAMPLE: &str = include_str!("example.toml");
