//! What is kept of a run for the pictures of its report, besides its figures.

use crate::report::histogram::SignedHistogram;

/// What the pictures show.
#[derive(Debug, Default)]
pub struct Kept {
    /// Actual - scheduled transmit, by station.
    pub slot_error: Vec<SignedHistogram>,
}
