//! One type for ours and the peer, so that both sit in one simulated network.

use rtmac::tdma::{Tdma, TdmaCommand, TdmaStatus};
use rtnet::buf::Buf;
use rtnet::discipline::{
    Channel, Claimed, Discipline, Event, Opportunity, Returned, SendError, Sent, TimeView, Transmission,
};
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::Header;

use crate::peer::{Peer, PeerStatus};

/// Either kind of station.
pub enum Mixed {
    /// Ours.
    Ours(Box<Tdma>),
    /// The independent one.
    Peer(Box<Peer>),
}

/// Either kind of status.
#[derive(Clone, Copy, Debug)]
// Copied where nothing is short of time.
#[allow(clippy::large_enum_variant)]
pub enum MixedStatus {
    /// Ours.
    Ours(TdmaStatus),
    /// The independent one's.
    Peer(PeerStatus),
}

macro_rules! either {
    ($self:ident, $inner:ident => $call:expr) => {
        match $self {
            Mixed::Ours($inner) => $call,
            Mixed::Peer($inner) => $call,
        }
    };
}

impl Discipline for Mixed {
    type Command = TdmaCommand;
    type Refused = String;
    type Status = MixedStatus;

    fn claims(&self, header: &Header) -> bool {
        either!(self, d => d.claims(header))
    }
    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Claimed {
        either!(self, d => d.on_frame(rx, frame))
    }
    fn on_timeout(&mut self, now: Instant) {
        either!(self, d => d.on_timeout(now))
    }
    fn opportunity(&mut self, now: Instant) -> Option<Opportunity> {
        either!(self, d => d.opportunity(now))
    }
    fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        either!(self, d => d.next_transmission(now))
    }
    fn on_sent(&mut self, outcome: Sent) -> Option<Returned> {
        either!(self, d => d.on_sent(outcome))
    }
    fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        either!(self, d => d.enqueue(frame, priority, ch))
    }
    fn is_waiting(&self, channel: Channel) -> bool {
        either!(self, d => d.is_waiting(channel))
    }
    fn put_back(&mut self, frame: Returned) {
        either!(self, d => d.put_back(frame))
    }
    fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        either!(self, d => d.payload_limit(ch))
    }
    fn next_deadline(&self) -> Option<Instant> {
        either!(self, d => d.next_deadline())
    }
    fn time(&self) -> TimeView {
        either!(self, d => d.time())
    }
    fn next_event(&mut self) -> Option<Event> {
        either!(self, d => d.next_event())
    }
    fn command(&mut self, now: Instant, command: &mut TdmaCommand) -> Result<u32, String> {
        match self {
            Mixed::Ours(ours) => ours.command(now, command).map_err(|refused| refused.to_string()),
            Mixed::Peer(peer) => peer.command(now, &mut ()).map_err(str::to_owned),
        }
    }
    fn status(&self) -> MixedStatus {
        match self {
            Mixed::Ours(ours) => MixedStatus::Ours(ours.status()),
            Mixed::Peer(peer) => MixedStatus::Peer(peer.status()),
        }
    }
}
