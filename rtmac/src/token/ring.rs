//! A ring: who is in it, in which order, for how long each may send, and what follows from that for time-outs.
//!
//! ```text
//! a visit, from when the token was stamped on arrival:
//! |< gap >|<--------- hold --------->|<- late ->|<- late ->|
//!         data, back to back: it is over here at the latest
//!                                               the token is passed on no later than here; behind that instant the
//!                                               station has lost it, and sends nothing
//! |<----------------------- visit ------------------------>|
//!
//! |< delay >|<-------------- visit --------------->|< delay >|    after so long who passed it on has heard of it
//! ```

use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, MIN_FRAME};

use super::wire::MAX_STATIONS;
use crate::tdma::schedule::Rate;

/// Longest of each of a ring's times: what is longer is no real time any more.
const LONGEST: Span = Span::from_millis(1_000);
/// Clocks run apart by no more than 500 ppm: this part of a time-out.
const CLOCK_PART: i64 = 2_000;
/// So many tokens in succession may be unheard before one that hears nothing takes it to be lost.
const UNHEARD: i64 = 3;
/// The longest frame there is.
pub const LONGEST_FRAME: usize = 1514;

/// What all stations of a ring are configured with, the same for all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RingConfig {
    /// The stations' addresses, in the order in which the token goes round; 1 to 64.
    pub stations: Vec<Address>,
    /// The medium's.
    pub rate: Rate,
    /// How long a station may send each time that the token comes by: time on the air, frames back to back.
    pub hold: Span,
    /// How long each keeps it at the least, so that an idle ring does not take all of the hosts' time.
    pub rest: Span,
    /// How late a host may be, each time that it is to do something, and still make use of the token.
    pub late: Span,
    /// From a station's last look at its clock before it sends a token to the stamp that another's host gives it, at the most.
    pub delay: Span,
    /// Absent stations are invited back, one each so many times that the token went round.
    pub invite_every: u16,
}

/// Why there can be no such ring.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RingRefused {
    /// Nobody in it, or too many.
    #[error("a ring has 1 to {MAX_STATIONS} stations, not {0}")]
    Size(usize),
    /// A station cannot be in it twice.
    #[error("{0} is in the ring twice: name each station once")]
    Twice(Address),
    /// Not the address of one station.
    #[error("{0} names a group of stations, or none: name stations by their own addresses")]
    NoStation(Address),
    /// The station itself is not in it.
    #[error("{0} is not in its own ring: name it where its turn is")]
    NotInIt(Address),
    /// The longest frame would never be sent.
    #[error(
        "a frame of {LONGEST_FRAME} bytes is on the air for {air}, longer than a station holds the token, {hold}: let it hold it longer"
    )]
    TooShort {
        /// What was asked for.
        hold: Span,
        /// What there must be.
        air: Span,
    },
    /// It would still rest when it has to pass the token on.
    #[error("a station rests for {rest}, longer than it holds the token, {hold}: let it rest for less")]
    RestsTooLong {
        /// What was asked for.
        rest: Span,
        /// What there is.
        hold: Span,
    },
    /// A time below zero, or not a real one.
    #[error("{what} of {span} is out of range: it goes from 0 to {LONGEST}")]
    OutOfRange {
        /// Which time.
        what: &'static str,
        /// What was asked for.
        span: Span,
    },
    /// Nobody would ever be invited.
    #[error("absent stations are to be invited every 0 rounds: say 1 or more")]
    NeverInvites,
}

/// A ring that can be, and a station's place in it.
#[derive(Clone, Debug)]
pub struct Ring {
    config: RingConfig,
    index: u8,
    digest: u32,
}

impl RingConfig {
    /// With times for a medium of 100 Mbit/s and hosts that are not made for it.
    pub fn new(stations: Vec<Address>) -> Self {
        Self {
            stations,
            rate: Rate::from_bits_per_second(100_000_000),
            hold: Span::from_micros(500),
            rest: Span::from_micros(250),
            late: Span::from_micros(500),
            delay: Span::from_micros(100),
            invite_every: 16,
        }
    }

    /// Tells what cannot be.
    pub fn check(&self) -> Result<(), RingRefused> {
        let size = self.stations.len();
        if !(1..=MAX_STATIONS).contains(&size) {
            return Err(RingRefused::Size(size));
        }
        for (n, &station) in self.stations.iter().enumerate() {
            if station.is_group() || station == Address::default() {
                return Err(RingRefused::NoStation(station));
            }
            if self.stations[..n].contains(&station) {
                return Err(RingRefused::Twice(station));
            }
        }
        for (what, span) in
            [("hold", self.hold), ("rest", self.rest), ("late", self.late), ("delay", self.delay)]
        {
            if !(Span::ZERO..=LONGEST).contains(&span) {
                return Err(RingRefused::OutOfRange { what, span });
            }
        }
        let (hold, rest, air) = (self.hold, self.rest, self.rate.air_time(LONGEST_FRAME));
        if hold < air {
            return Err(RingRefused::TooShort { hold, air });
        }
        if rest > hold {
            return Err(RingRefused::RestsTooLong { rest, hold });
        }
        if self.invite_every == 0 {
            return Err(RingRefused::NeverInvites);
        }
        Ok(())
    }

    /// What a token frame itself takes: nobody sends before it is over, wherever in it frames are stamped.
    pub fn gap(&self) -> Span {
        self.rate.air_time(MIN_FRAME)
    }

    /// From a token's arrival to when the last frame of data is over, at the latest.
    pub fn data(&self) -> Span {
        self.gap() + self.hold + self.late
    }

    /// From a token's arrival to when it is passed on at the latest, or lost.
    pub fn visit(&self) -> Span {
        self.data() + self.late
    }

    /// Who has passed the token on, and has heard nothing of it for so long, does not wait any longer.
    pub fn time_out(&self) -> Span {
        with_clocks(self.visit() + self.delay * 2)
    }

    /// Who has heard no token for so long, and for its place in the ring many [`steps`](Self::step) more, claims it.
    pub fn silence(&self) -> Span {
        with_clocks((self.time_out() + self.late) * UNHEARD)
    }

    /// So much later does the next in the ring claim it: it has heard of the claim by then.
    pub fn step(&self) -> Span {
        self.settle() + self.silence() / CLOCK_PART
    }

    /// For so long does who claimed it listen before it sends: another claim has come by then, and who still had a token has
    /// heard of this one.
    pub fn settle(&self) -> Span {
        self.late + self.delay * 2
    }

    /// What all must have the same: FNV-1a, 32 bits, over the number of stations, their addresses in order, and the bit rate,
    /// hold, rest, late, delay (nanoseconds, 8 bytes each) and the rounds between invitations (2 bytes), big-endian.
    pub fn digest(&self) -> u32 {
        let Self { stations, rate, hold, rest, late, delay, invite_every } = self;
        let times = [*hold, *rest, *late, *delay].map(|span| span.nanos().to_be_bytes());
        let addresses = stations.iter().flat_map(|station| station.0);
        let numbers = rate.bits_per_second().to_be_bytes().into_iter().chain(times.into_iter().flatten());
        [stations.len() as u8]
            .into_iter()
            .chain(addresses)
            .chain(numbers)
            .chain(invite_every.to_be_bytes())
            .fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
    }
}

impl Ring {
    /// The ring as the station with this address sees it.
    pub fn new(config: RingConfig, own: Address) -> Result<Self, RingRefused> {
        config.check()?;
        let place = config.stations.iter().position(|&station| station == own);
        let index = place.ok_or(RingRefused::NotInIt(own))? as u8;
        let digest = config.digest();
        Ok(Self { config, index, digest })
    }

    /// What it is configured with.
    pub fn config(&self) -> &RingConfig {
        &self.config
    }
    /// The station's place, from 0 on.
    pub fn index(&self) -> u8 {
        self.index
    }
    /// How many there are.
    pub fn size(&self) -> u8 {
        self.config.stations.len() as u8
    }
    /// See [`RingConfig::digest`].
    pub fn digest(&self) -> u32 {
        self.digest
    }
    /// The address at a place.
    pub fn address(&self, place: u8) -> Option<Address> {
        self.config.stations.get(usize::from(place)).copied()
    }
    /// For how long it has to be silent for this station to claim the token.
    pub fn claims_after(&self) -> Span {
        self.config.silence() + self.config.step() * i64::from(self.index)
    }
}

/// So much, as a clock shows that is too fast, rounded up.
fn with_clocks(span: Span) -> Span {
    span + span / CLOCK_PART + Span::from_nanos(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stations(n: u8) -> Vec<Address> {
        (1..=n).map(|last| Address([2, 0, 0, 0, 0, last])).collect()
    }

    #[test]
    fn what_is_no_ring_is_refused_with_the_remedy() {
        let usual = RingConfig::new(stations(4));
        assert_eq!(usual.check(), Ok(()));
        let us = Span::from_micros;
        for (config, said) in [
            (RingConfig { stations: stations(0), ..usual.clone() }, "1 to 64 stations, not 0"),
            (RingConfig { stations: stations(65), ..usual.clone() }, "1 to 64 stations, not 65"),
            (
                RingConfig { stations: [stations(2), stations(1)].concat(), ..usual.clone() },
                "twice: name each",
            ),
            (RingConfig { stations: vec![Address::BROADCAST], ..usual.clone() }, "a group of stations"),
            (RingConfig { stations: vec![Address::default()], ..usual.clone() }, "or none"),
            (RingConfig { hold: us(123), ..usual.clone() }, "123.04us, longer than a station holds"),
            (RingConfig { rest: us(501), ..usual.clone() }, "let it rest for less"),
            (RingConfig { late: us(-1), ..usual.clone() }, "late of -1us is out of range"),
            (RingConfig { delay: us(1_000_001), ..usual.clone() }, "from 0 to 1s"),
            (RingConfig { invite_every: 0, ..usual.clone() }, "say 1 or more"),
        ] {
            let refused = config.check().unwrap_err().to_string();
            assert!(refused.contains(said), "{refused}");
        }
        let stranger = Address([2, 0, 0, 0, 0, 9]);
        assert_eq!(Ring::new(usual, stranger).unwrap_err(), RingRefused::NotInIt(stranger));
    }

    #[test]
    fn whatever_differs_the_digest_does() {
        let usual = RingConfig::new(stations(4));
        let ns = Span::from_nanos(1);
        let mut turned = stations(4);
        turned.rotate_left(1);
        let others = [
            RingConfig { stations: stations(3), ..usual.clone() },
            RingConfig { stations: turned, ..usual.clone() },
            RingConfig { rate: Rate::from_bits_per_second(1_000_000_000), ..usual.clone() },
            RingConfig { hold: usual.hold + ns, ..usual.clone() },
            RingConfig { rest: usual.rest + ns, ..usual.clone() },
            RingConfig { late: usual.late + ns, ..usual.clone() },
            RingConfig { delay: usual.delay + ns, ..usual.clone() },
            RingConfig { invite_every: 17, ..usual.clone() },
        ];
        let mut digests: Vec<_> = others.iter().chain([&usual]).map(RingConfig::digest).collect();
        assert_eq!(digests[8], 0xd6b9_b9a8, "as SPECIFICATION.md has it");
        digests.sort_unstable();
        digests.dedup();
        assert_eq!(digests.len(), others.len() + 1);
    }

    #[test]
    fn the_longest_ring_still_counts_in_nanoseconds() {
        let longest =
            RingConfig { hold: LONGEST, late: LONGEST, delay: LONGEST, ..RingConfig::new(stations(64)) };
        let ring = Ring::new(longest, stations(64)[63]).unwrap();
        assert!(ring.claims_after() > Span::from_millis(200_000), "{}", ring.claims_after());
    }
}
