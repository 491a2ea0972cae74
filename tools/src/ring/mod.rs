//! Networks whose stations share the medium by a token: in virtual time, in a lab, and before either. There are no slots and no
//! cycle, so what is judged is the token itself: how long its rounds take, what becomes of one that is lost, and whether two
//! ever send at once.
//!
//! ```text
//!   file ──► RingScenario ──┬─► sim, lab ──frames, events──► judge ──► figures ──► screen, page, JSON
//!                           └─► plan: the bounds
//! ```

mod figures;
mod judge;
mod lab;
mod page;
pub mod plan;
mod recovery;
mod screen;
mod sim;
mod verdict;

pub use figures::{RingFigures, RingStation};
pub use lab::run as run_live;
pub use page::page;
pub use screen::render;
pub use sim::run;
