//! What is asked of the kernel about network devices, and heard from it: rtnetlink(7), synchronous.
//!
//! [`Links`] sets up what a VNIC's device is to be, [`Watch`] hears what becomes of it. Both are of the network namespace of
//! the thread that opened them, whichever thread uses them later. A refusal is an error that names what was wanted, what
//! the kernel said and, where it is known, the remedy.

mod addresses;
mod exchange;
mod link;
mod refused;
mod shaping;
mod watch;

pub use exchange::Exchange;
pub use link::{Link, LinkStatistics, Links};
pub use refused::Refused;
pub use shaping::{Shaping, ShapingStatistics};
pub use watch::{ChangeKind, Heard, LinkChange, Watch};

#[cfg(test)]
pub(crate) mod tests;
