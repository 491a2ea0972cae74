//! No RTmac at all, as when it is unplugged from RTnet: frames leave at once in the order in which they were queued.

use crate::at_once::{AtOnce, Rules};
use crate::buf::Buf;
use crate::counters::Refusal;
use crate::discipline::Claimed;
use crate::queue::Priority;
use crate::wire::ethernet::{EtherType, Header};

/// A station without media access: no slots, no priorities, no tunnel.
pub type Direct = AtOnce<Unplugged>;

/// The rules of [`Direct`].
pub enum Unplugged {}

impl Rules for Unplugged {
    const NAME: &'static str = "direct";

    fn claims(_header: &Header) -> bool {
        false
    }

    fn on_frame(_frame: Buf) -> Claimed {
        Claimed::Refused(Refusal::UnclaimedEtherType)
    }

    /// Who does not speak RTmac sends nothing that looks like it: what is not the attached discipline's deafens RTnet
    /// stations.
    fn may_leave(frame: &[u8]) -> bool {
        Header::parse(frame).is_some_and(|(header, _)| header.ether_type() != EtherType::RTMAC)
    }

    fn level(_asked: Priority) -> Priority {
        Priority::DEFAULT
    }
}

#[cfg(test)]
mod tests;
