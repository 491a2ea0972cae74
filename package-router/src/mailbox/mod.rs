//! Mailboxes: bounded, the most urgent package first, and no sender waits, whatever the owner or another sender does.
//!
//! ```text
//!   sender A ─ own segment ─► lane 0 ┐
//!   sender B ─ own segment ─► lane 1 ├─ merged by priority ─► the owner
//!            ◄─ returned slots ──────┘   in the owner's segment
//! ```
//!
//! Every word has one writer. A sender writes packages into slots of a segment of its own, and says which; the owner says in its
//! own which it has read. So there is no lock that somebody could die with, and what a mad sender writes there costs nobody else
//! a package or a microsecond. All here is pure: segments are words, and `now` is told.

mod inbox;
mod layout;
mod news;
mod package;
mod refused;
mod sender;
mod shape;
mod statistics;
mod urgency;
mod word;

pub use inbox::{Inbox, Taken};
pub use layout::{Layout, of_owner, of_sender};
pub use package::{Body, Package, TooSmall};
pub use sender::{Begun, LaneSender, Origin, SendError, Slot, Stamps};
pub use shape::{LARGEST_BODY, MOST_BYTES, MOST_SENDERS, MOST_SLOTS, Shape, ShapeError, WhenFull};
pub use statistics::Latencies;
pub use word::{Segment, Word};

#[cfg(test)]
mod tests;
