//! What is kept of a run for the pictures of its report, besides its figures.

use rtnet::clock::True;

use super::closely::Cycles;
use super::closely::envelope::Envelope;
use super::closely::regular::Regular;
use crate::report::histogram::SignedHistogram;

/// What the pictures show. Where nobody looked closely, cycles and all else but the slot errors are empty.
#[derive(Debug, Default)]
pub struct Kept {
    /// Actual - scheduled transmit, by station.
    pub slot_error: Vec<SignedHistogram>,
    /// Whole cycles.
    pub cycles: Cycles,
    /// How regular frames were.
    pub regular: Regular,
    /// Estimated - true global time, by station.
    pub sync_error: Vec<Envelope>,
    /// When the measurement began.
    pub begin: True,
}
