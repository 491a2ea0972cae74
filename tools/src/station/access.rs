//! The ways to share the medium that a station can be started with, as one type.

use anyhow::anyhow;
use rtmac::nomac::NoMac;
use rtmac::tdma::change::ChangeConfig;
use rtmac::tdma::{self, RoleConfig, Tdma, TdmaCommand, TdmaConfig, TdmaStatus};
use rtmac::token::{Ring, RingConfig, Token, TokenStatus};
use rtnet::at_once::{AtOnceStatus, DEFAULT_ASK_EVERY};
use rtnet::buf::{Buf, PoolStatistics};
use rtnet::direct::Direct;
use rtnet::discipline::{
    Channel, Claimed, Discipline, Event, Opportunity, Returned, SendError, Sent, SyncState, TimeView,
    Transmission,
};
use rtnet::queue::Priority;
use rtnet::time::Instant;
use rtnet::wire::ethernet::{Address, Header};

/// What a station is to share the medium by.
#[derive(Clone, Debug)]
pub enum AccessConfig {
    /// Time slots; everything but the address, which is the interface's.
    Tdma(TdmaConfig),
    /// RTmac without slots.
    NoMac,
    /// No RTmac.
    Direct,
    /// A token that goes round this ring.
    Token(RingConfig),
}

impl AccessConfig {
    /// Of one with slots, how they are configured.
    pub fn tdma(&self) -> Option<&TdmaConfig> {
        match self {
            AccessConfig::Tdma(config) => Some(config),
            AccessConfig::NoMac | AccessConfig::Direct | AccessConfig::Token(_) => None,
        }
    }

    /// Of one in a ring, that.
    pub fn ring(&self) -> Option<&RingConfig> {
        match self {
            AccessConfig::Token(ring) => Some(ring),
            AccessConfig::Tdma(_) | AccessConfig::NoMac | AccessConfig::Direct => None,
        }
    }

    /// Whether it is to give the time.
    pub fn is_master(&self) -> bool {
        self.tdma().is_some_and(|tdma| matches!(tdma.role, RoleConfig::Master(_)))
    }
}

/// What it shares the medium by.
pub enum Access {
    /// Time slots.
    Tdma(Box<Tdma>),
    /// RTmac without slots.
    NoMac(NoMac),
    /// No RTmac.
    Direct(Direct),
    /// A token.
    Token(Box<Token>),
}

impl Access {
    /// As configured, on an interface with this address.
    pub fn new(config: &AccessConfig, address: Address) -> anyhow::Result<Self> {
        Ok(match config {
            AccessConfig::Tdma(tdma) => {
                let tdma = Tdma::new(&TdmaConfig { address, ..tdma.clone() });
                Access::Tdma(Box::new(tdma.map_err(|refused| anyhow!(refused))?))
            }
            AccessConfig::NoMac => Access::NoMac(NoMac::new(DEFAULT_ASK_EVERY)),
            AccessConfig::Direct => Access::Direct(Direct::new(DEFAULT_ASK_EVERY)),
            AccessConfig::Token(ring) => {
                Access::Token(Box::new(Token::new(Ring::new(ring.clone(), address)?)))
            }
        })
    }

    /// The same, taking part in changes of the schedule, where there is one.
    pub fn with_changes(self, changes: Option<&ChangeConfig>) -> Self {
        match (self, changes) {
            (Access::Tdma(tdma), Some(changes)) => Access::Tdma(Box::new(tdma.with_changes(changes))),
            (other, _) => other,
        }
    }
}

/// What there is to be seen of it.
#[derive(Clone, Copy, Debug)]
// Copied ten times a second.
#[allow(clippy::large_enum_variant)]
pub enum AccessStatus {
    /// Of time slots.
    Tdma(TdmaStatus),
    /// Of what sends at once, by its name.
    AtOnce(&'static str, AtOnceStatus),
    /// Of a token.
    Token(TokenStatus),
}

impl AccessStatus {
    /// The discipline's name.
    pub fn name(&self) -> &'static str {
        match self {
            AccessStatus::Tdma(_) => "tdma",
            AccessStatus::AtOnce(name, _) => name,
            AccessStatus::Token(_) => "token",
        }
    }

    /// What there is to be seen of slots and cycle, if there are any.
    pub fn tdma(&self) -> Option<&TdmaStatus> {
        match self {
            AccessStatus::Tdma(status) => Some(status),
            AccessStatus::AtOnce(..) | AccessStatus::Token(_) => None,
        }
    }

    /// What there is to be seen of its ring, if it is in one.
    pub fn token(&self) -> Option<&TokenStatus> {
        match self {
            AccessStatus::Token(status) => Some(status),
            AccessStatus::Tdma(_) | AccessStatus::AtOnce(..) => None,
        }
    }

    /// How far it is with the master's time, if there is one.
    pub fn state(&self) -> Option<SyncState> {
        self.tdma().map(|status| status.state)
    }

    /// The state in reports. RTnet shows a station with NoMAC as attached.
    pub fn state_name(&self) -> &'static str {
        match self {
            AccessStatus::Tdma(status) => status.state.name(),
            AccessStatus::AtOnce(..) => "attached",
            AccessStatus::Token(status) => status.state.name(),
        }
    }

    /// The last cycle that was told of; what stands for it where there is none.
    pub fn cycle(&self) -> u32 {
        match self {
            AccessStatus::Tdma(status) => status.cycle,
            AccessStatus::AtOnce(_, status) => status.ticks,
            AccessStatus::Token(status) => status.visits,
        }
    }

    /// How the pool of its own frames fares, if it has any.
    pub fn pool(&self) -> Option<PoolStatistics> {
        self.tdma().map(|status| status.control).or(self.token().map(|status| status.pool))
    }

    /// Frames of data that were sent.
    pub fn frames_sent(&self) -> u64 {
        match self {
            AccessStatus::Tdma(status) => status.counters.frames_sent,
            AccessStatus::AtOnce(_, status) => status.frames_sent,
            AccessStatus::Token(status) => status.counters.frames_sent,
        }
    }

    /// Events that found the log full.
    pub fn events_lost(&self) -> u64 {
        match self {
            AccessStatus::Tdma(status) => status.events_lost,
            AccessStatus::AtOnce(_, status) => status.events_lost,
            AccessStatus::Token(status) => status.counters.events_lost,
        }
    }
}

/// Why a change was not made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The slots or the role cannot be.
    #[error(transparent)]
    Tdma(#[from] tdma::Refused),
    /// There is no cycle.
    #[error(
        "its discipline is '{0}', which has no cycle, no roles and no slots: start it with --discipline tdma"
    )]
    NoCycle(&'static str),
}

macro_rules! any {
    ($self:ident, $inner:ident => $call:expr) => {
        match $self {
            Access::Tdma($inner) => $call,
            Access::NoMac($inner) => $call,
            Access::Direct($inner) => $call,
            Access::Token($inner) => $call,
        }
    };
}

impl Discipline for Access {
    type Command = TdmaCommand;
    type Refused = Refused;
    type Status = AccessStatus;

    fn claims(&self, header: &Header) -> bool {
        any!(self, d => d.claims(header))
    }
    fn on_frame(&mut self, rx: Option<Instant>, frame: Buf) -> Claimed {
        any!(self, d => d.on_frame(rx, frame))
    }
    fn on_timeout(&mut self, now: Instant) {
        any!(self, d => d.on_timeout(now))
    }
    fn opportunity(&mut self, now: Instant) -> Option<Opportunity> {
        any!(self, d => d.opportunity(now))
    }
    fn next_transmission(&mut self, now: Instant) -> Option<Transmission> {
        any!(self, d => d.next_transmission(now))
    }
    fn on_sent(&mut self, outcome: Sent) -> Option<Returned> {
        any!(self, d => d.on_sent(outcome))
    }
    fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        any!(self, d => d.enqueue(frame, priority, ch))
    }
    fn is_waiting(&self, channel: Channel) -> bool {
        any!(self, d => d.is_waiting(channel))
    }

    fn has_queued(&self) -> bool {
        any!(self, d => d.has_queued())
    }
    fn tries_again(&self) -> bool {
        any!(self, d => d.tries_again())
    }
    fn put_back(&mut self, frame: Returned) {
        any!(self, d => d.put_back(frame))
    }
    fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        any!(self, d => d.payload_limit(ch))
    }
    fn next_deadline(&self) -> Option<Instant> {
        any!(self, d => d.next_deadline())
    }
    fn wakes_on_frames(&self) -> bool {
        any!(self, d => d.wakes_on_frames())
    }
    fn time(&self) -> TimeView {
        any!(self, d => d.time())
    }
    fn next_event(&mut self) -> Option<Event> {
        any!(self, d => d.next_event())
    }
    fn command(&mut self, now: Instant, command: &mut TdmaCommand) -> Result<u32, Refused> {
        match self {
            Access::Tdma(tdma) => tdma.command(now, command).map_err(Refused::from),
            Access::NoMac(nomac) => Err(Refused::NoCycle(nomac.name())),
            Access::Direct(direct) => Err(Refused::NoCycle(direct.name())),
            Access::Token(_) => Err(Refused::NoCycle("token")),
        }
    }
    fn status(&self) -> AccessStatus {
        match self {
            Access::Tdma(tdma) => AccessStatus::Tdma(tdma.status()),
            Access::NoMac(nomac) => AccessStatus::AtOnce(nomac.name(), nomac.status()),
            Access::Direct(direct) => AccessStatus::AtOnce(direct.name(), direct.status()),
            Access::Token(token) => AccessStatus::Token(token.status()),
        }
    }
}
