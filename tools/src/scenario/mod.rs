//! What a network is: the stations, their slots, their clocks, and what they go through. Made from command-line options or from a
//! file; one form for labs and simulations.

mod acts;
mod conditions;
mod expectation;
mod file;
mod follow;

use clap::ValueEnum;
use rtmac::tdma::schedule::{self, Conflict, Rate, Schedule};
use rtmac::tdma::{LatePolicy, Refused, SlotConfig, check_cycle};
use rtnet::live::GuardMode;
use rtnet::sim::Random;
use rtnet::time::Span;
use rtnet::wire::ethernet::{self, Address};
use serde::Deserialize;

use crate::report::figures::Role;
use crate::station::traffic::{Flow, FlowPlan};

pub use acts::{Act, Part, acts, over};
pub use conditions::{Conditions, Direction, Event, Happening, Wandering, Wire};
pub use expectation::{Expectation, Measure, Relation};
pub use file::{FileError, Source, load, parse_phase};
pub use follow::{DelayPolicy, ServoName};

/// Part of each cycle that belongs to the Synchronisation, unless the cycle is too short for it.
const SYNC_WINDOW: Span = Span::from_micros(50);
/// Where a cycle is divided among many stations so much for each: a lab's master delivers its Synchronisation to one port
/// of the bridge after the other, while it sends it.
const SYNC_PER_STATION: Span = Span::from_micros(4);
/// And at most this part of the cycle.
const SYNC_WINDOW_PARTS: i64 = 8;
/// Default clocks are off by up to this much.
const CLOCK_OFFSET: Span = Span::from_millis(1_000);
/// And drift by up to 50 ppm.
const CLOCK_DRIFT_PPB: i64 = 50_000;
/// Nobody simulates more; each has a number of 16 bits in its frames, and in its address.
pub const MAX_STATIONS: usize = 10_000;
/// What one host holds as processes and interfaces, by far.
pub const MAX_LAB_STATIONS: usize = 250;
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
    /// What stations do with a slot that has passed.
    pub late: LatePolicy,
    /// What keeps stations from sending later than that.
    pub slot_guard: SlotGuard,
    /// How syncs become the stations' time lines.
    pub servo: ServoName,
    /// The first is the master.
    pub stations: Vec<StationPlan>,
    /// What it goes through.
    pub conditions: Conditions,
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
    /// Calibration rounds.
    pub rounds: u32,
    /// Its slots.
    pub slots: Vec<SlotPlan>,
    /// What its program sends besides, most urgent first.
    pub flows: Vec<Flow>,
}

impl StationPlan {
    /// Bytes behind the Ethernet header of the largest frame that it sends.
    pub fn largest_payload(&self) -> usize {
        self.flows.iter().map(|flow| flow.payload).fold(self.payload, usize::max)
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

/// What `lab run` without a file is told.
#[derive(Clone, Debug, PartialEq)]
pub struct Uniform {
    /// How many, the master included.
    pub stations: usize,
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// How long to measure.
    pub duration: Span,
    /// Bytes behind the Ethernet header of each frame.
    pub payload: usize,
    /// The medium's.
    pub rate: Rate,
    /// Guard band of each slot; the rest of the slot if not given.
    pub guard: Option<Span>,
    /// Everything random follows from it.
    pub seed: u64,
}

/// Why a network cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScenarioError {
    /// Too few or too many.
    #[error("{0} stations: there must be 2 to {MAX_STATIONS}")]
    Stations(usize),
    /// Too small or too large for a frame.
    #[error("a payload of {0} bytes: it must be {MIN_PAYLOAD} to {max}", max = ethernet::MTU)]
    Payload(usize),
    /// The slots do not go together.
    #[error("{0}")]
    Conflict(Conflict),
    /// No station would take it.
    #[error(transparent)]
    Refused(#[from] Refused),
}

impl Uniform {
    /// The network: slots of equal length after the sync window, the master's first. A guard band that is less than
    /// the rest of the slot moves no slot, but makes less of it usable.
    pub fn scenario(&self) -> Result<Scenario, ScenarioError> {
        let &Uniform { stations: n, cycle, duration, payload, rate, guard, seed } = self;
        if !(2..=MAX_STATIONS).contains(&n) {
            return Err(ScenarioError::Stations(n));
        }
        if !(MIN_PAYLOAD..=ethernet::MTU).contains(&payload) {
            return Err(ScenarioError::Payload(payload));
        }
        check_cycle(cycle)?;
        let (sync_window, length) =
            divide(cycle, None, rate, n, payload, guard).map_err(ScenarioError::Conflict)?;
        let air = rate.air_time(payload + ethernet::HEADER_LEN);
        let stations = (0..n)
            .map(|k| StationPlan {
                name: if k == 0 { "master".into() } else { format!("slave{k}") },
                role: if k == 0 { Role::Master } else { Role::Slave },
                backup: None,
                clock: None,
                clock_offset: Span::ZERO,
                clock_drift_ppb: 0,
                payload,
                rounds: rtmac::tdma::DEFAULT_ROUNDS,
                slots: vec![SlotPlan {
                    id: 0,
                    offset: sync_window + length * k as i64,
                    phase: 0,
                    period: 1,
                    size: payload,
                    joint: None,
                }],
                flows: Vec::new(),
            })
            .collect();
        let guard = guard.unwrap_or(length - air);
        let (late, slot_guard, servo) = (LatePolicy::Skip, SlotGuard::Auto, ServoName::Linear);
        let conditions = Conditions::default();
        let scenario = Scenario {
            cycle,
            sync_window,
            rate,
            guard,
            duration,
            seed,
            late,
            slot_guard,
            servo,
            stations,
            conditions,
        };
        Ok(scenario.with_random_clocks())
    }
}

impl Scenario {
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
        let StationPlan { slots, flows, .. } = &self.stations[station];
        FlowPlan {
            flows: flows.clone(),
            joint: slots.iter().filter_map(|slot| Some((slot.id, slot.joint?))).collect(),
            from: self.stations[self.sender(station)].flows.clone(),
        }
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

/// Where slots are given: 50 us, or an eighth of a short cycle.
pub fn default_sync_window(cycle: Span) -> Span {
    SYNC_WINDOW.min(cycle / SYNC_WINDOW_PARTS)
}

/// A cycle that is divided evenly among stations, whose frames hold `size` bytes: its sync window, and how long each slot
/// is. A sync is as often late as any frame, and two that are missing silence all: unless a window is asked for, a sync
/// may be as late as a frame.
fn divide(
    cycle: Span,
    asked: Option<Span>,
    rate: Rate,
    stations: usize,
    size: usize,
    guard: Option<Span>,
) -> Result<(Span, Span), Conflict> {
    let n = stations as i64;
    let [sync, frame] =
        [ethernet::MIN_FRAME, size + ethernet::HEADER_LEN].map(|length| rate.air_time(length));
    let least = SYNC_WINDOW.max(SYNC_PER_STATION * n).min(cycle / SYNC_WINDOW_PARTS);
    let share = sync + (cycle - sync - frame * n) / (n + 1);
    let with =
        |window| schedule::divide(cycle, window, rate, stations, size, guard).map(|length| (window, length));
    let usual = share.max(least).min(cycle / SYNC_WINDOW_PARTS);
    asked.map_or_else(|| with(usual).or_else(|_| with(least)), with)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uniform(stations: usize, cycle: Span) -> Uniform {
        Uniform {
            stations,
            cycle,
            duration: Span::from_millis(1_000),
            payload: 64,
            rate: Rate::from_bits_per_second(1_000_000_000),
            guard: None,
            seed: 1,
        }
    }

    #[test]
    fn a_sync_has_as_much_time_as_a_slot_and_more_with_many_stations() {
        let window = |stations, cycle| uniform(stations, cycle).scenario().unwrap().sync_window;
        assert_eq!(window(8, Span::from_millis(1)).nanos(), 110_983, "a sync is shorter than a frame");
        assert_eq!(window(20, Span::from_millis(1)), Span::from_micros(80), "4 us for each");
        assert_eq!(window(2, Span::from_millis(1)), Span::from_micros(125), "an eighth at the most");
        assert_eq!(window(32, Span::from_micros(800)), Span::from_micros(100), "an eighth of a short cycle");
    }

    #[test]
    fn a_sync_takes_no_room_from_long_frames() {
        let rate = Rate::from_bits_per_second(100_000_000);
        for n in [2, 5, 6, 7] {
            let long =
                Uniform { payload: 1_500, rate, ..uniform(n, Span::from_millis(1)) }.scenario().unwrap();
            let for_the_sync = long.sync_window - rate.air_time(60);
            let capped = long.sync_window == Span::from_micros(125) && for_the_sync < long.guard;
            let as_ever = long.sync_window == SYNC_WINDOW;
            let even = (for_the_sync - long.guard).abs() < Span::from_nanos(n as i64);
            assert!(capped || as_ever || even, "{n}: {for_the_sync}, {}", long.guard);
        }
    }

    #[test]
    fn stations_divide_the_cycle_evenly_and_do_not_conflict() {
        let scenario = uniform(8, Span::from_millis(1)).scenario().unwrap();
        assert_eq!(scenario.schedule().conflicts(), []);
        let offsets: Vec<_> = scenario.stations.iter().map(|s| s.slots[0].offset.nanos()).collect();
        assert_eq!(offsets[..3], [110_983, 222_110, 333_237]);
        assert_eq!(scenario.guard.nanos(), 111_127 - 816);
    }

    #[test]
    fn a_guard_band_means_the_same_as_an_option_and_in_a_file() {
        let names = [("master", "master"), ("slave1", "slave"), ("slave2", "slave")];
        let stations =
            names.map(|(name, role)| format!("[[station]]\nname = \"{name}\"\nrole = \"{role}\"\n"));
        for guard in [None, Some(Span::ZERO), Some(Span::from_micros(20))] {
            let line = guard.map_or(String::new(), |guard| format!("guard = \"{guard}\"\n"));
            let text = format!("cycle = \"1ms\"\nduration = \"1s\"\n{line}{}", stations.concat());
            let by_file = Source { file: "net.toml", text: &text }.parse().unwrap();
            let by_options = Uniform { guard, ..uniform(3, Span::from_millis(1)) }.scenario().unwrap();
            assert_eq!(by_options, by_file);
            assert_eq!(by_options.latest(), schedule::latest(by_options.guard, 3));
        }
    }

    #[test]
    fn a_guard_band_less_than_the_rest_moves_no_slot_and_one_too_large_is_refused() {
        let with = |guard| Uniform { guard, ..uniform(8, Span::from_millis(1)) }.scenario();
        let rest = Span::from_nanos(111_127 - 816);
        let (whole, small) = (with(None).unwrap(), with(Some(Span::from_micros(20))).unwrap());
        assert_eq!(small.stations, whole.stations);
        assert_eq!((small.guard, small.latest()), (Span::from_micros(20), Span::from_micros(10)));
        assert_eq!(small.schedule().conflicts(), []);
        assert_eq!(with(Some(rest)), Ok(whole));
        let most = Span::from_nanos(118_750 - 816);
        assert_eq!(with(Some(most)).unwrap().sync_window, SYNC_WINDOW, "no room for more");
        let error = with(Some(most + Span::from_nanos(1))).unwrap_err().to_string();
        assert!(error.contains("frame 816ns + guard band 117.935us) = 1.000008ms"), "{error}");
    }

    #[test]
    fn clocks_follow_from_the_seed() {
        let clocks = |seed| {
            let scenario = Uniform { seed, ..uniform(4, Span::from_millis(1)) }.scenario().unwrap();
            scenario.stations.iter().map(|s| (s.clock_offset, s.clock_drift_ppb)).collect::<Vec<_>>()
        };
        assert_eq!(clocks(1), clocks(1));
        assert_ne!(clocks(1), clocks(2));
        assert!(clocks(1).iter().all(|(o, d)| o.abs() <= CLOCK_OFFSET && d.abs() <= CLOCK_DRIFT_PPB));
    }

    #[test]
    fn a_cycle_too_short_is_refused_with_the_sum() {
        let error = uniform(8, Span::from_micros(5)).scenario().unwrap_err().to_string();
        assert!(error.contains("8 slots do not fit a cycle of 5us"), "{error}");
    }

    #[test]
    fn a_cycle_that_no_slave_follows_is_refused() {
        for cycle in [Span::from_millis(100_001), Span::from_nanos(999)] {
            let error = uniform(2, cycle).scenario().unwrap_err().to_string();
            assert_eq!(error, format!("a cycle of {cycle}: no slave follows one outside 1us to 100s"));
        }
        assert!(uniform(2, Span::from_millis(100_000)).scenario().is_ok());
    }
}
