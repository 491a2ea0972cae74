//! A network whose stations share the medium by a token.

use rtmac::tdma::LatePolicy;
use rtmac::tdma::schedule::Rate;
use rtmac::token::bound::rotation_bound;
use rtmac::token::{LONGEST_FRAME, RingConfig, RingRefused};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::{Conditions, MAX_MISS_PPM, Scenario, ServoName, SlotGuard, StationPlan};

/// A network, by what its stations share the medium.
// There is one at a time.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq)]
pub enum Network {
    /// By time slots.
    Slots(Scenario),
    /// By a token.
    Ring(RingScenario),
}

/// A ring, and what it goes through.
#[derive(Clone, Debug, PartialEq)]
pub struct RingScenario {
    /// What all stations are configured with, in the order of the file.
    pub ring: RingConfig,
    /// The stations, their clocks and traffic, how long to measure, and what happens meanwhile. It has no slots; its cycle
    /// stands for the longest round.
    pub network: Scenario,
}

/// What is said of a ring's times, where anything is.
#[derive(Clone, Copy, Debug, Default)]
pub struct RingTimes {
    /// See [`RingConfig::hold`].
    pub hold: Option<Span>,
    /// See [`RingConfig::rest`].
    pub rest: Option<Span>,
    /// See [`RingConfig::late`].
    pub late: Option<Span>,
    /// See [`RingConfig::delay`].
    pub delay: Option<Span>,
    /// See [`RingConfig::invite_every`].
    pub invite: Option<u16>,
}

impl RingTimes {
    /// The ring of these stations on a medium: what is not said is as usual, but a station may send four of the longest
    /// frames.
    pub fn ring(self, stations: Vec<Address>, rate: Rate) -> RingConfig {
        let usual = RingConfig::new(stations);
        RingConfig {
            rate,
            hold: self.hold.unwrap_or(usual.hold.max(rate.air_time(LONGEST_FRAME) * 4)),
            rest: self.rest.unwrap_or(usual.rest),
            late: self.late.unwrap_or(usual.late),
            delay: self.delay.unwrap_or(usual.delay),
            invite_every: self.invite.unwrap_or(usual.invite_every),
            ..usual
        }
    }
}

impl RingScenario {
    /// Of these stations, each with the address of its place; tells what cannot be.
    pub(super) fn new(
        times: RingTimes,
        rate: Rate,
        (duration, seed): (Span, u64),
        stations: Vec<StationPlan>,
        conditions: Conditions,
    ) -> Result<Self, RingRefused> {
        let mut network = Scenario {
            cycle: Span::ZERO,
            sync_window: Span::ZERO,
            rate,
            guard: Span::ZERO,
            duration,
            seed,
            max_miss_ppm: MAX_MISS_PPM,
            late: LatePolicy::Skip,
            slot_guard: SlotGuard::Auto,
            servo: ServoName::Linear,
            delay: None,
            packages: None,
            stations,
            conditions,
        };
        let addresses = (0..network.stations.len()).map(|place| network.address(place));
        let ring = times.ring(addresses.collect(), rate);
        ring.check()?;
        network.cycle = rotation_bound(&ring, ring.stations.len(), 1);
        Ok(Self { ring, network })
    }

    /// The same with clocks that follow from a seed.
    pub fn with_seed(self, seed: u64) -> Self {
        let network = self.network.with_seed(seed);
        Self { network, ..self }
    }
}
