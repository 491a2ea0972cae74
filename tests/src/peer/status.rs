//! What is to be seen of a peer.

use rtnet::time::Span;

/// What a peer counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PeerStatus {
    /// The measured delay, once there is one; 0 for a master that started alone.
    pub delay: Option<Span>,
    /// Synchronisations sent.
    pub syncs_sent: u64,
    /// Calibration requests sent.
    pub requests_sent: u64,
    /// Calibration replies sent.
    pub replies_sent: u64,
    /// Data frames sent.
    pub frames_sent: u64,
    /// Replies discarded because their cycle had passed.
    pub replies_discarded: u64,
}
