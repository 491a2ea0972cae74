//! How long what a station sends waits for its slots, by what it shows of them.

use rtmac::tdma::joint;
use rtmac::tdma::schedule::{self, Slot};
use rtnet::time::Span;

use crate::control::{SlotShown, StationStatus};

/// The slots that take what a channel is given: those that are joint take from one queue. None: it has no such.
pub fn serving(of: &StationStatus, channel: u8) -> Vec<Slot> {
    let id = |shown: &SlotShown| (shown.slot.id, shown.slot.joint);
    let serving = joint::serving(&of.slots, id, channel).into_iter().map(|shown| shown.slot);
    serving
        .map(|slot| Slot {
            owner: of.name.clone(),
            id: slot.id,
            offset: Span::from_nanos(slot.offset_ns),
            phase: slot.phase,
            period: slot.period,
            size: slot.size,
        })
        .collect()
}

/// How long before a slot a station chooses the frame for it. None: it has no cycle, or does not tell.
pub fn lead(of: &StationStatus) -> Option<Span> {
    of.lead_ns.map(Span::from_nanos)
}

/// How long what a channel is given waits at the worst, if nothing is ahead of it: until it begins in its slot. None where no
/// cycle or lead is known, or no slot is for it.
pub fn worst(of: &StationStatus, channel: u8) -> Option<Span> {
    let cycle = Span::from_nanos(of.period_ns?);
    let lead = lead(of)?;
    schedule::longest_between(cycle, &serving(of, channel)).map(|between| between + lead)
}

/// Slots that it has missed so far, for whatever cause.
pub fn missed(of: &StationStatus) -> u64 {
    of.misses.causes.values().sum()
}
