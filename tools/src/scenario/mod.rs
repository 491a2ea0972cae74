//! What a network is: the stations, their slots, their clocks, and what they go through. Made from command-line options or from a
//! file; one form for labs and simulations.

mod acts;
mod calibration;
mod change;
mod clashes;
mod conditions;
mod expectation;
mod file;
mod follow;
mod places;
mod ring;
mod uniform;
mod wires;

use clap::ValueEnum;
use rtmac::tdma::schedule::{self, Rate, Schedule};
use rtmac::tdma::{LatePolicy, SlotConfig};
use rtnet::live::GuardMode;
use rtnet::sim::Random;
use rtnet::time::Span;
use rtnet::wire::ethernet::{self, Address};
use serde::Deserialize;
use std::path::PathBuf;

use package_router::route::Route;
use package_router::tcp::address::Address as RouterAddress;
use vnic::peers::Prefix;

use crate::cli::VnicMode;
use crate::report::figures::Role;
use crate::station::stack::OwnIp;
use crate::station::traffic::{Flow, FlowPlan};

pub use acts::{Act, Part, acts, over};
pub use calibration::Unfit;
pub use change::{room_for_parts, room_for_replies};
pub use conditions::{Conditions, Event, Happening, Wandering};
pub use expectation::{Expectation, Measure, Relation};
pub use file::{FileError, Place, Source, load, load_network, load_schedule, parse_phase, read_text};
pub use follow::{DelayName, DelayPolicy, ServoName};
pub use ring::{Network, RingScenario, RingTimes};
pub use uniform::{ScenarioError, Uniform, UniformVnic};
pub use wires::{Direction, Effects, Wire};

use uniform::divide;

/// Part of each cycle that belongs to the Synchronisation, unless the cycle is too short for it.
const SYNC_WINDOW: Span = Span::from_micros(50);
/// And at most this part of the cycle.
const SYNC_WINDOW_PARTS: i64 = 8;
/// A sync may begin in the first three quarters of its window, and is on the air in the last.
const SYNC_WINDOW_OF_AIR: i64 = 4;
/// How long a frame may take from a station's last look at the clock to the wire, and how wrong a stamp may be.
pub const STAMP_ERROR: Span = Span::from_nanos(1_500);
/// Default clocks are off by up to this much.
const CLOCK_OFFSET: Span = Span::from_millis(1_000);
/// And drift by up to 50 ppm.
const CLOCK_DRIFT_PPB: i64 = 50_000;
/// Slots that a station may miss of a million where nothing else is said: 0.5 %.
pub const MAX_MISS_PPM: u32 = 5_000;
/// Each takes some 0.2 MB of a simulation: that many are what a usual host has the memory for.
pub const MAX_STATIONS: usize = 10_000;
/// What one host holds as processes and interfaces, by far.
pub const MAX_LAB_STATIONS: usize = 250;
/// Of a medium that nothing else is said of.
pub const DEFAULT_RATE: Rate = Rate::from_bits_per_second(1_000_000_000);
/// How long is measured where nothing else is said, and at least for so many cycles.
const DEFAULT_DURATION: Span = Span::from_millis(10_000);
const DEFAULT_CYCLES: i64 = 10;
/// Smallest payload of test traffic: that of the smallest frame.
pub const MIN_PAYLOAD: usize = ethernet::MIN_FRAME - ethernet::HEADER_LEN;

/// A network.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// The Synchronisation's share of each cycle.
    pub sync_window: Span,
    /// The medium's.
    pub rate: Rate,
    /// Kept free behind each frame.
    pub guard: Span,
    /// How long to measure.
    pub duration: Span,
    /// Everything random follows from it.
    pub seed: u64,
    /// Of a million slots each station may miss so many, where no expectation decides.
    pub max_miss_ppm: u32,
    /// What stations do with a slot that has passed.
    pub late: LatePolicy,
    /// What keeps stations from sending later than that.
    pub slot_guard: SlotGuard,
    /// How syncs become the stations' time lines.
    pub servo: ServoName,
    /// What all calibration rounds say together of the delay; `None`: as the servo has it.
    pub delay: Option<DelayName>,
    /// What its stations' packages are to be, in a lab.
    pub packages: Option<PackagesPlan>,
    /// The first is the master.
    pub stations: Vec<StationPlan>,
    /// What it goes through.
    pub conditions: Conditions,
}

/// A measurement that would see nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a duration of {duration}, and a cycle lasts {cycle}: nothing would be measured; make it {cycle} or longer"
)]
pub struct TooShort {
    duration: Span,
    cycle: Span,
}

/// What all stations know of packages.
#[derive(Clone, Debug, PartialEq)]
pub struct PackagesPlan {
    /// Which station has which mailboxes.
    pub routes: Vec<Route>,
    /// The system of all stations.
    pub system: u8,
    /// Where it stands how urgent whose packages are.
    pub priorities: Option<PathBuf>,
    /// Whether packages to other stations say when they were sent and left.
    pub times: bool,
    /// The TCP router of all stations, if there is one.
    pub router: Option<RouterPlan>,
}

/// The TCP router of all stations.
#[derive(Clone, Debug, PartialEq)]
pub struct RouterPlan {
    /// Where it is.
    pub address: RouterAddress,
    /// The directory of a client's keys; without them the connection is in the clear.
    pub keys: Option<PathBuf>,
    /// Bytes of the largest body that goes there, if the file gives it.
    pub largest_body: Option<u32>,
}

/// One station.
#[derive(Clone, Debug, PartialEq)]
pub struct StationPlan {
    /// Unique in the network.
    pub name: String,
    /// Master, backup or slave.
    pub role: Role,
    /// How long after a cycle's start a backup sends a Synchronisation if there is none.
    pub backup: Option<Span>,
    /// The clock that a file gives it: lead and rate error; otherwise random, by the seed.
    pub clock: Option<(Span, i64)>,
    /// How far its clock is ahead of the host's.
    pub clock_offset: Span,
    /// How much faster its clock runs than the host's, parts per billion.
    pub clock_drift_ppb: i64,
    /// Bytes behind the Ethernet header of each frame that it sends.
    pub payload: usize,
    /// Its address of the Internet Protocol; with one it has sockets, in a lab.
    pub ip: Option<OwnIp>,
    /// Its VNIC, in a lab.
    pub vnic: Option<VnicPlan>,
    /// Calibration rounds.
    pub rounds: u32,
    /// Its slots.
    pub slots: Vec<SlotPlan>,
    /// What its program sends besides, most urgent first.
    pub flows: Vec<Flow>,
}

/// The VNIC of a station.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VnicPlan {
    /// Its addresses; none of a proxy's, which has its station's.
    pub addresses: Vec<Prefix>,
    /// What goes through it.
    pub mode: VnicMode,
    /// Whether Linux shares the station's address by it, instead of a tunnel's end.
    pub proxy: bool,
}

impl StationPlan {
    /// Bytes behind the Ethernet header of the largest frame that it sends.
    pub fn largest_payload(&self) -> usize {
        self.flows.iter().map(|flow| flow.payload).fold(self.payload, usize::max)
    }

    /// Whether what Linux sends by its VNIC is tunnelled: a proxy's packets are as those of sockets.
    pub fn has_tunnel(&self) -> bool {
        self.vnic.as_ref().is_some_and(|vnic| !vnic.proxy)
    }

    /// What its slots hold where nothing else is said: whatever it may send.
    pub fn usual_size(&self) -> usize {
        if self.ip.is_some() || self.vnic.is_some() { ethernet::MTU } else { self.largest_payload() }
    }
}

/// One slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotPlan {
    /// 0 real-time, 1 non-real-time, 2.. the user's.
    pub id: u8,
    /// Begin, from the cycle's start.
    pub offset: Span,
    /// Used in cycles with `cycle mod period == phase`; counts from 0.
    pub phase: u32,
    /// See `phase`.
    pub period: u32,
    /// Largest payload behind the Ethernet header.
    pub size: usize,
    /// The slot whose queue it takes from, if not its own.
    pub joint: Option<u8>,
}

impl SlotPlan {
    /// The slot as the discipline takes it.
    pub fn config(&self, latest: Span) -> SlotConfig {
        let &SlotPlan { id, offset, phase, period, size, joint } = self;
        SlotConfig { id, offset, phase, period, size, joint, latest }
    }

    /// Whether it is used in this cycle.
    pub fn has_turn(&self, cycle: u32) -> bool {
        cycle % self.period == self.phase
    }
}

impl From<SlotConfig> for SlotPlan {
    fn from(SlotConfig { id, offset, phase, period, size, joint, .. }: SlotConfig) -> Self {
        Self { id, offset, phase, period, size, joint }
    }
}

/// What keeps a station from sending after its slot's `latest` instant.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum SlotGuard {
    /// The kernel if it lets us, and a line that says why if not
    #[default]
    Auto,
    /// The kernel, or it does not run
    Kernel,
    /// Only the station's own last look at the clock
    User,
}

impl SlotGuard {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            SlotGuard::Auto => "auto",
            SlotGuard::Kernel => "kernel",
            SlotGuard::User => "user",
        }
    }

    /// As a port takes it.
    pub fn mode(self) -> GuardMode {
        match self {
            SlotGuard::Auto => GuardMode::Auto,
            SlotGuard::Kernel => GuardMode::Kernel,
            SlotGuard::User => GuardMode::User,
        }
    }
}

impl Scenario {
    /// The same with another seed, and the clocks that follow from it.
    pub fn with_seed(self, seed: u64) -> Self {
        Self { seed, ..self }.with_random_clocks()
    }

    /// Gives every station the clock that its file says, or one off by up to a second and 50 ppm, by the
    /// seed.
    pub fn with_random_clocks(mut self) -> Self {
        let mut random = Random::new(self.seed);
        for station in &mut self.stations {
            let offset = Span::from_nanos(random.between(-CLOCK_OFFSET.nanos(), CLOCK_OFFSET.nanos()));
            let drift = random.between(-CLOCK_DRIFT_PPB, CLOCK_DRIFT_PPB);
            (station.clock_offset, station.clock_drift_ppb) = station.clock.unwrap_or((offset, drift));
        }
        self
    }

    /// Gives every station the host's own clock.
    pub fn with_ideal_clocks(mut self) -> Self {
        for station in &mut self.stations {
            (station.clock_offset, station.clock_drift_ppb) = (Span::ZERO, 0);
        }
        self
    }

    /// Whether a whole cycle is measured.
    pub fn check_duration(&self) -> Result<(), TooShort> {
        let &Self { duration, cycle, .. } = self;
        if duration < cycle { Err(TooShort { duration, cycle }) } else { Ok(()) }
    }

    /// The slots of all stations.
    pub fn schedule(&self) -> Schedule {
        let slots = self.stations.iter().flat_map(|station| {
            station.slots.iter().map(|slot| schedule::Slot {
                owner: station.name.clone(),
                id: slot.id,
                offset: slot.offset,
                phase: slot.phase,
                period: slot.period,
                size: slot.size,
            })
        });
        let backups =
            self.stations.iter().filter_map(|station| Some((station.name.clone(), station.backup?)));
        let Scenario { cycle, sync_window, rate, guard, .. } = *self;
        Schedule { cycle, sync_window, rate, guard, backups: backups.collect(), slots: slots.collect() }
    }

    /// Whether a kernel that can guard its stations' slots does.
    pub fn is_guarded(&self) -> bool {
        self.slot_guard != SlotGuard::User
    }

    /// A station's address.
    pub fn address(&self, station: usize) -> Address {
        let [high, low] = (station as u16 + 1).to_be_bytes();
        Address([0x02, 0, 0, 0, high, low])
    }

    /// Where a station sends its frames: to the next.
    pub fn receiver(&self, station: usize) -> usize {
        (station + 1) % self.stations.len()
    }

    /// Whose frames a station receives: the one's before it.
    pub fn sender(&self, station: usize) -> usize {
        (station + self.stations.len() - 1) % self.stations.len()
    }

    /// What a station's program sends besides, and what comes to it of that kind.
    pub fn flow_plan(&self, station: usize) -> FlowPlan {
        FlowPlan {
            flows: self.stations[station].flows.clone(),
            from: self.stations[self.sender(station)].flows.clone(),
        }
    }

    /// What kinds of test traffic a station sends, each with numbers of its own: its usual frames, and by priority what
    /// its program queues.
    pub fn streams(&self, station: usize) -> impl Iterator<Item = Option<u8>> {
        [None].into_iter().chain(self.stations[station].flows.iter().map(|flow| Some(flow.priority)))
    }

    /// How long after its begin a slot may still be used.
    pub fn latest(&self) -> Span {
        schedule::latest(self.guard, self.stations.len())
    }

    /// How much of the guard band is for clocks, at either end.
    pub fn clock_share(&self) -> Span {
        schedule::clock_share(self.guard, self.stations.len())
    }

    /// The slot as the discipline takes it.
    pub fn slot_config(&self, slot: &SlotPlan) -> SlotConfig {
        slot.config(self.latest())
    }
}

/// How long is measured where nothing else is said.
pub fn default_duration(cycle: Span) -> Span {
    DEFAULT_DURATION.max(cycle * DEFAULT_CYCLES)
}

/// Where slots are given: 50 us, or an eighth of a short cycle. On a slow medium, where a sync takes long, so much that one
/// that begins as late as it may ends in it, if the cycle has the room; in any, what a sync needs that is not late.
pub fn default_sync_window(cycle: Span, rate: Rate) -> Span {
    let air = rate.air_time(ethernet::MIN_FRAME);
    SYNC_WINDOW.max(air * SYNC_WINDOW_OF_AIR).min(cycle / SYNC_WINDOW_PARTS).max(shortest_sync_window(rate))
}

/// A sync has left the air when it is over.
fn shortest_sync_window(rate: Rate) -> Span {
    rate.air_time(ethernet::MIN_FRAME) + STAMP_ERROR
}
