//! The network that command-line options make: stations that divide the cycle evenly.

use rtmac::tdma::schedule::{self, Conflict, Rate};
use rtmac::tdma::{LatePolicy, Refused, check_cycle};
use rtnet::ip::route::Network;
use rtnet::time::Span;
use rtnet::wire::ethernet;
use vnic::peers::Prefix;

use super::places::{self, TooSmall};
use super::{
    Conditions, MAX_MISS_PPM, MAX_STATIONS, MIN_PAYLOAD, SYNC_WINDOW, SYNC_WINDOW_PARTS, Scenario, ServoName,
    SlotGuard, SlotPlan, StationPlan, Unfit, VnicPlan, shortest_sync_window,
};
use crate::cli::VnicMode;
use crate::report::figures::Role;
use crate::station::stack::NotOwnIp;

/// Where a cycle is divided among many stations so much for each: a lab's master delivers its Synchronisation to one port
/// of the bridge after the other, while it sends it.
const SYNC_PER_STATION: Span = Span::from_micros(4);

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
    /// What VNIC every station has, if any.
    pub vnic: Option<UniformVnic>,
}

/// A VNIC for every station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UniformVnic {
    /// Where they have their addresses: the master the first one, the others the next.
    pub network: Network,
    /// What goes through them.
    pub mode: VnicMode,
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
    /// They do without VNICs, perhaps.
    #[error("{0}; with --vnic slots hold {max} bytes, for what is tunnelled", max = ethernet::MTU)]
    ConflictOfVnics(Conflict),
    /// No addresses for all VNICs.
    #[error("{0}: say --vnic {larger}", larger = .0.larger)]
    TooSmall(TooSmall),
    /// No addresses of VNICs.
    #[error("--vnic {0}: {1}")]
    NotOwnIp(Network, NotOwnIp),
    /// No station would take it.
    #[error(transparent)]
    Refused(#[from] Refused),
    /// No slave would come up.
    #[error(transparent)]
    Unfit(#[from] Unfit),
}

impl Uniform {
    /// The network: slots of equal length after the sync window, the master's first. A guard band that is less than
    /// the rest of the slot moves no slot, but makes less of it usable.
    pub fn scenario(&self) -> Result<Scenario, ScenarioError> {
        let &Uniform { stations: n, cycle, duration, payload, rate, guard, seed, vnic } = self;
        if !(2..=MAX_STATIONS).contains(&n) {
            return Err(ScenarioError::Stations(n));
        }
        if !(MIN_PAYLOAD..=ethernet::MTU).contains(&payload) {
            return Err(ScenarioError::Payload(payload));
        }
        check_cycle(cycle)?;
        let vnics = vnic.map_or_else(|| Ok(vec![None; n]), |vnic| vnic.plans(n))?;
        let conflict = if vnic.is_some() { ScenarioError::ConflictOfVnics } else { ScenarioError::Conflict };
        let size = if vnic.is_some() { ethernet::MTU } else { payload };
        let (sync_window, length) = divide(cycle, None, rate, n, size, guard).map_err(conflict)?;
        let air = rate.air_time(size + ethernet::HEADER_LEN);
        let stations = (0..n)
            .zip(vnics)
            .map(|(k, vnic)| StationPlan {
                name: if k == 0 { "master".into() } else { format!("slave{k}") },
                role: if k == 0 { Role::Master } else { Role::Slave },
                backup: None,
                clock: None,
                clock_offset: Span::ZERO,
                clock_drift_ppb: 0,
                payload,
                ip: None,
                vnic,
                rounds: rtmac::tdma::DEFAULT_ROUNDS,
                slots: vec![SlotPlan {
                    id: 0,
                    offset: sync_window + length * k as i64,
                    phase: 0,
                    period: 1,
                    size,
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
            max_miss_ppm: MAX_MISS_PPM,
            late,
            slot_guard,
            servo,
            delay: None,
            packages: None,
            stations,
            conditions,
        };
        scenario.check_fit()?;
        Ok(scenario.with_random_clocks())
    }
}

impl UniformVnic {
    /// Of each station, the master's first.
    fn plans(self, stations: usize) -> Result<Vec<Option<VnicPlan>>, ScenarioError> {
        let Self { network, mode } = self;
        places::check(network, stations).map_err(ScenarioError::TooSmall)?;
        let plan = |place| {
            let own = places::address(network, place).map_err(|why| ScenarioError::NotOwnIp(network, why))?;
            let addresses = vec![Prefix { ip: own.ip.into(), length: own.prefix }];
            Ok(Some(VnicPlan { addresses, mode, proxy: false }))
        };
        (0..stations as u32).map(plan).collect()
    }
}

/// A cycle that is divided evenly among stations, whose frames hold `size` bytes: its sync window, and how long each slot
/// is. A sync is as often late as any frame, and two that are missing silence all: unless a window is asked for, a sync
/// may be as late as a frame.
pub(super) fn divide(
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
    let shortest = shortest_sync_window(rate);
    let most = shortest.max(cycle / SYNC_WINDOW_PARTS);
    let least = SYNC_WINDOW.max(SYNC_PER_STATION * n).clamp(shortest, most);
    let share = sync + (cycle - sync - frame * n) / (n + 1);
    let with =
        |window| schedule::divide(cycle, window, rate, stations, size, guard).map(|length| (window, length));
    let usual = share.max(least).min(most);
    asked.map_or_else(|| with(usual).or_else(|_| with(least)), with)
}

#[cfg(test)]
mod tests {
    use super::super::{CLOCK_DRIFT_PPB, CLOCK_OFFSET, Source};
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
            vnic: None,
        }
    }

    fn with_vnics(stations: usize, network: &str, mode: VnicMode) -> Uniform {
        let vnic = Some(UniformVnic { network: network.parse().unwrap(), mode });
        Uniform { vnic, ..uniform(stations, Span::from_millis(1)) }
    }

    #[test]
    fn vnics_mean_the_same_as_an_option_and_in_a_file() {
        for (mode, line) in [(VnicMode::Tap, ""), (VnicMode::Tun, "vnic_mode = \"tun\"\n")] {
            let names = [("master", "master", 1), ("slave1", "slave", 2), ("slave2", "slave", 3)];
            let stations = names.map(|(name, role, n)| {
                format!("[[station]]\nname = \"{name}\"\nrole = \"{role}\"\nvnic = \"10.1.0.{n}/24\"\n")
            });
            let text = format!("cycle = \"1ms\"\nduration = \"1s\"\n{line}{}", stations.concat());
            let by_file = Source::new("net.toml", &text).parse().unwrap();
            assert_eq!(with_vnics(3, "10.1.0.0/24", mode).scenario().unwrap(), by_file);
        }
    }

    #[test]
    fn vnics_that_cannot_be_are_refused_with_the_remedy() {
        let refused = |uniform: Uniform| uniform.scenario().unwrap_err().to_string();
        assert_eq!(
            refused(with_vnics(4, "10.1.0.0/30", VnicMode::Tap)),
            "10.1.0.0/30 has addresses for 2 stations, and there are 4: say --vnic 10.1.0.0/29"
        );
        let loopback = refused(with_vnics(2, "127.0.0.0/8", VnicMode::Tap));
        assert!(
            loopback.starts_with("--vnic 127.0.0.0/8: '127.0.0.1/8' is a loopback address"),
            "{loopback}"
        );
        let short = Uniform { cycle: Span::from_micros(50), ..with_vnics(4, "10.1.0.0/24", VnicMode::Tap) };
        let short = refused(short);
        assert!(short.ends_with("; with --vnic slots hold 1500 bytes, for what is tunnelled"), "{short}");
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
            let by_file = Source::new("net.toml", &text).parse().unwrap();
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
