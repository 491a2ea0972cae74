//! What is made of the frames on a medium and of what its stations told: errors, overlaps, gaps, and whether each has a
//! record. The same for labs and simulations. Pure: it is given frames, stamps and records.
//!
//! ```text
//!   frames, stamped ──► analysis ──findings──┐
//!   stations' records ─► explain ◄───────────┴─► account ─► outcome ─► figures
//! ```

pub mod absences;
pub mod account;
pub mod analysis;
pub mod clocks;
pub mod closely;
pub mod cuts;
pub mod delivery;
pub mod explain;
pub mod findings;
pub mod givers;
pub mod kept;
pub mod masters;
pub mod noteworthy;
pub mod outcome;
mod sight;
mod spells;
pub mod syncs;
pub mod timetable;
pub mod verdict;
pub mod worst;
