//! Virtual time: the same stations on a simulated medium, seeded, identical bytes every run.
//!
//! ```text
//!   Agenda ──next action──► Network ──turn──► Station ──transmission──► Medium ──arrival──► Agenda
//! ```

mod agenda;
pub mod capture;
pub mod host;
pub mod medium;
mod network;
mod random;

pub use host::Host;
pub use medium::{Aired, Medium};
pub use network::{Member, Network, StationId};
pub use random::Random;
