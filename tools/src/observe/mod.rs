//! Listening to a medium without a part in it: what each frame is, and where it is in the cycle.
//!
//! ```text
//!   ring ─► ear ──► watch ─► line    where cycles begin, by what the syncs say and when they came
//!        (stamps)     │  └─► decode  what a frame is
//!                     ├────► dump    a line, or a packet comment, per frame
//!                     └────► tally ─► figures ─► screen, JSON
//! ```
//!
//! Nothing here sends: the only socket is the capture ring's, which cannot.

pub mod decode;
pub mod ear;
pub mod figures;
pub mod line;
pub mod numbers;
pub mod screen;
pub mod tally;
pub mod watch;
