//! Virtual time: the same stations on a simulated medium, seeded, identical bytes every run.
//!
//! ```text
//!   Agenda ──next action──► Network ──turn──► Station ──transmission──► Medium ──arrival──► inbox
//! ```

mod agenda;
pub mod capture;
pub mod host;
pub mod latency;
pub mod link;
pub mod medium;
mod network;
mod random;

pub use host::Host;
pub use latency::{Latency, Recorded};
pub use link::Link;
pub use medium::{Aired, Joint, Medium, Traffic};
pub use network::{Loss, Member, Moment, Network, StationId, Wander};
pub use random::Random;
