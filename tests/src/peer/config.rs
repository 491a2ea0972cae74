//! What is configured of a peer.

use rtnet::discipline::Channel;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

/// Everything that is configured of a peer.
#[derive(Clone, Debug)]
pub struct PeerConfig {
    /// The interface's address.
    pub address: Address,
    /// The cycle, for a master; a slave follows.
    pub master: Option<Span>,
    /// For a backup master: how long after a cycle's start it looks whether there was a Synchronisation. Its own
    /// slots must lie behind.
    pub backup: Option<Span>,
    /// Calibration rounds.
    pub rounds: u32,
    /// Its slots; the first is the one it calibrates in.
    pub slots: Vec<PeerSlot>,
    /// How long before an instant its frame is chosen.
    pub lead: Span,
}

/// A slot.
#[derive(Clone, Copy, Debug)]
pub struct PeerSlot {
    /// The channel.
    pub id: Channel,
    /// Begin, from the cycle's start.
    pub offset: Span,
    /// Used in cycles with `cycle mod period == phase`.
    pub phase: u32,
    /// See `phase`.
    pub period: u32,
    /// Largest payload behind the Ethernet header.
    pub size: usize,
}
