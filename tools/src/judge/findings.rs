//! What the observer finds on the medium that ought not to be.

use rtnet::time::Span;

/// Something that ought not to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finding {
    /// In which cycle.
    pub cycle: u32,
    /// What.
    pub kind: FindingKind,
    /// Whose frames were involved: who came first, who came then.
    pub authors: [Option<Author>; 2],
    /// By how much.
    pub span: Span,
}

impl Finding {
    /// What one station alone did or left undone.
    pub fn of(author: Author, kind: FindingKind, span: Span) -> Self {
        Self { cycle: author.cycle, kind, authors: [Some(author), None], span }
    }
}

/// Whose frame it is, and of which cycle and slot: the frame that is hit need not be of the cycle of the one that
/// hits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Author {
    /// The station's number.
    pub station: usize,
    /// The cycle in whose slot it was to be.
    pub cycle: u32,
    /// That slot; none: a Synchronisation.
    pub slot: Option<u8>,
}

impl Author {
    /// Of a cycle's Synchronisation, if this station is to send it.
    pub fn sync(station: usize, cycle: u32) -> Self {
        Self { station, cycle, slot: None }
    }
}

/// Kinds of [`Finding`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FindingKind {
    /// Two frames on the air at once, at the medium's rate.
    Overlap,
    /// A frame outside its slot.
    OutOfSlot,
    /// A cycle without a Synchronisation.
    SyncGap,
    /// A slot without its frame.
    SlotMissed,
    /// A slave's frame in a cycle that has no Synchronisation, as the one before has none that would bridge it.
    WithoutSync,
    /// A second frame in a slot, or a second Synchronisation in a cycle.
    Repeated,
}

impl FindingKind {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            FindingKind::Overlap => "overlap",
            FindingKind::OutOfSlot => "frame out of slot",
            FindingKind::SyncGap => "missing sync",
            FindingKind::SlotMissed => "missing frame",
            FindingKind::WithoutSync => "frame without sync",
            FindingKind::Repeated => "repeated frame",
        }
    }
}
