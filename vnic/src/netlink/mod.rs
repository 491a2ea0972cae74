//! What is asked of the kernel about network devices, and heard from it: rtnetlink(7), synchronous.
//!
//! A refusal is an error that names what was wanted, what the kernel said and, where it is known, the remedy.

mod exchange;
mod refused;

pub use exchange::Exchange;
pub use refused::Refused;
