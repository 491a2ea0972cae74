//! Networks in files.
//!
//! ```toml
//! discipline = "tdma"       # or "token": see [`ring`]
//! cycle = "1ms"             # required; everything else has a default or is per station
//! rate = "1G"
//! sync_window = "50us"      # default: this; as long as a slot where no station says where its slots are
//! guard = "20us"            # default: what the closest slots leave; "0us" is none at all, which no network holds
//! duration = "10s"          # or ten cycles, if they last longer
//! max_miss = "0.5%"         # each station may miss so many of its slots, where no expectation decides: more is DEGRADED
//! seed = 1
//! late = "skip"             # or "send", as RTnet does
//! slot_guard = "auto"       # or "kernel", "user": what keeps stations from sending later
//! servo = "linear"          # or "none", as in RTnet: each sync is the time line
//! delay = "quartile"        # of all calibration rounds; or "median", or "mean", as in RTnet and with servo = "none"
//! network = "10.0.0.0/24"   # only in a lab: stations have sockets, the master .1, the others .2, .3 ... in their order
//! packages = true           # only in a lab: stations' programs send each other packages
//! package_routes = "routes.toml"          # beside this file: which station has which mailboxes; names are those of this file
//! package_system = 0        # system of all stations: routes lead to its mailboxes only, and packages for others go by TCP
//! package_priorities = "priorities.toml"  # beside this file: how urgent whose packages are
//! router = "10.1.0.1:2000"  # TCP router for packages to mailboxes that are at no station; default: none
//! router_keys = "keys/client"  # directory of a client's keys for TLS, relative to this file; default: without TLS
//! router_body = 4096        # largest body that goes there, up to 262128 bytes; default: this
//! package_times = true      # whether packages to other stations say when they were sent, and left; default: they do
//! vnic_mode = "tap"         # or "tun", packets of IP only: what goes through VNICs, but for proxies, which are always of packets
//!
//! [[station]]
//! name = "master"
//! role = "master"           # exactly one; or "slave", or "backup"
//! backup = "100us"          # of a backup: how long after a cycle's start it sends a sync if there is none
//! payload = 64
//! ip = "10.0.0.7/24"        # only in a lab: an address of its own choice; slots hold 1500 bytes then, if they say no size
//! vnic = "10.1.0.7/24"      # only in a lab: a VNIC with this address, or several, ["10.1.0.7/24", "fd00::7/64"], or none, []
//! vnic_proxy = true         # instead of vnic: Linux shares the address that the station has by network or ip
//! clock = { offset = "120ms", drift_ppm = 12.5 }   # default: random, by the seed
//! slots = [{ id = 0, offset = "50us", phase = "1/2", size = 64 },
//!          { id = 2, offset = "500us", joint = 0 }]          # takes from slot 0's queue; of one size
//!
//! [[station.traffic]]       # what its program sends besides; its usual frame has what slots are left
//! priority = 3              # 0, the most urgent, to 29
//! every = "4ms"             # of global time
//! burst = 2                 # so many at a time
//! payload = 100
//! slot = 0                  # default: its first
//! expect = { queueing_delay = "<= 1050us" }
//! ```
//!
//! What a network goes through, and what is expected of it, stands in sections of its own: see [`conditions`].

mod addresses;
mod checks;
mod conditions;
mod packages;
mod ring;
mod shape;
mod source;
mod stations;
mod vnics;

use std::path::Path;

use rtmac::tdma::{LatePolicy, check_cycle};
use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

use checks::{place_of, widest_guard};
use conditions::{EventFile, ExpectFile, HostFile, MediumFile, Reader, Sections, Whose, WireFile};
use ring::FileDiscipline;
pub use source::{FileError, Place, Source, read_text};
use stations::{FileRole, StationFile};

use super::{
    Conditions, DEFAULT_RATE, DelayName, MAX_MISS_PPM, Network, Scenario, ServoName, SlotGuard,
    default_duration, default_sync_window,
};
use crate::cli::VnicMode;
use crate::report::figures::Role;
use crate::units::{FileRate, GuardBand, PositiveSpan, Share};

const DEFAULT_PAYLOAD: usize = 64;
/// Ten times what the worst of quartz clocks do.
const MAX_DRIFT_PPM: f64 = 1_000.0;
/// An hour: more shows nothing that this does not.
const MAX_OFFSET: Span = Span::from_millis(3_600_000);

/// Reads a network of time slots from a file.
pub fn load(path: &Path) -> Result<Scenario, FileError> {
    read(path, |source| source.parse())
}

/// Reads a schedule from a file, for a network that runs: it may be of one station.
pub fn load_schedule(path: &Path) -> Result<Scenario, FileError> {
    read(path, |source| source.parse_schedule())
}

/// Reads a network from a file, by whatever its stations share the medium.
pub fn load_network(path: &Path) -> Result<Network, FileError> {
    read(path, |source| source.parse_any())
}

fn read<T>(path: &Path, parse: impl Fn(Source<'_>) -> Result<T, FileError>) -> Result<T, FileError> {
    let file = path.display().to_string();
    let text = read_text(path).map_err(|error| FileError::Unreadable(file.clone(), error))?;
    parse(Source::new(&file, &text))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NetworkFile {
    /// What is no ring is of time slots: looked at before.
    #[serde(rename = "discipline")]
    _discipline: Option<FileDiscipline>,
    cycle: Spanned<PositiveSpan>,
    rate: Option<FileRate>,
    sync_window: Option<Spanned<PositiveSpan>>,
    guard: Option<GuardBand>,
    duration: Option<Spanned<PositiveSpan>>,
    seed: Option<u64>,
    max_miss: Option<Share>,
    late: Option<Late>,
    slot_guard: Option<SlotGuard>,
    servo: Option<ServoName>,
    delay: Option<DelayName>,
    network: Option<Spanned<String>>,
    vnic_mode: Option<Spanned<VnicMode>>,
    packages: Option<bool>,
    package_routes: Option<Spanned<String>>,
    package_system: Option<Spanned<u8>>,
    package_priorities: Option<Spanned<String>>,
    package_times: Option<Spanned<bool>>,
    router: Option<Spanned<String>>,
    router_keys: Option<Spanned<String>>,
    router_body: Option<Spanned<u32>>,
    station: Vec<Spanned<StationFile>>,
    medium: Option<MediumFile>,
    host: Option<HostFile>,
    #[serde(default)]
    wire: Vec<Spanned<WireFile>>,
    #[serde(default)]
    event: Vec<Spanned<EventFile>>,
    expect: Option<ExpectFile>,
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Late {
    Skip,
    Send,
}

impl Source<'_> {
    /// Reads the network.
    pub fn parse(self) -> Result<Scenario, FileError> {
        // Whoever is alone measures nothing.
        self.parse_of(2)
    }

    /// A schedule for a network that runs.
    pub fn parse_schedule(self) -> Result<Scenario, FileError> {
        self.parse_of(1)
    }

    fn parse_of(self, fewest: usize) -> Result<Scenario, FileError> {
        self.check_has_slots()?;
        let tables = toml::de::Deserializer::from(self.tables()?);
        let mut network = NetworkFile::deserialize(tables).map_err(|error| self.no_toml(&error))?;
        let cycle = network.cycle.get_ref().0;
        check_cycle(cycle).map_err(|refused| self.impossible(network.cycle.span().start, refused))?;
        let rate = network.rate.map_or(DEFAULT_RATE, |rate| rate.0);
        self.check_stations(&network.station, fewest)?;
        let without =
            |entry: &&Spanned<StationFile>| entry.get_ref().slots.as_ref().is_none_or(Vec::is_empty);
        let divided = network.station.iter().all(|entry| without(&entry));
        let sync_window = network.sync_window.as_ref().map(|window| window.get_ref().0);
        let (mode, addresses) = (network.vnic_mode.as_ref(), self.addresses(&network)?);
        let of_each = network.station.iter().zip(&addresses);
        let vnics = of_each.map(|(entry, ip)| self.vnic(entry.get_ref(), *ip, mode));
        let vnics: Vec<_> = vnics.collect::<Result<_, _>>()?;
        self.check_vnics(&network.station, &vnics, mode)?;
        let mut stations = Vec::new();
        for ((entry, ip), vnic) in network.station.iter().zip(addresses).zip(vnics) {
            stations.push(self.station(entry, ip, vnic)?);
        }
        let asked = network.guard.map(|guard| guard.0);
        let mut scenario = Scenario {
            cycle,
            sync_window: sync_window.unwrap_or(default_sync_window(cycle, rate)),
            rate,
            guard: asked.unwrap_or(Span::ZERO),
            duration: network
                .duration
                .as_ref()
                .map_or(default_duration(cycle), |duration| duration.get_ref().0),
            seed: network.seed.unwrap_or(1),
            max_miss_ppm: network.max_miss.map_or(MAX_MISS_PPM, |share| share.0),
            late: if matches!(network.late, Some(Late::Send)) { LatePolicy::Send } else { LatePolicy::Skip },
            slot_guard: network.slot_guard.unwrap_or_default(),
            servo: network.servo.unwrap_or_default(),
            delay: network.delay,
            packages: self.packages(&network, &stations)?,
            stations,
            conditions: self.conditions(&mut network)?,
        };
        let duration = network.duration.as_ref().map_or(0, |duration| duration.span().start);
        scenario.check_duration().map_err(|short| self.impossible(duration, short))?;
        self.check_events(&scenario)?;
        self.check_syncs(&network, &scenario)?;
        if divided {
            self.divide(&network, &mut scenario)?;
        } else if let Some(first) = network.station.iter().find(without) {
            let what = "this station has no slots, while others have: give all of them slots, or none";
            return Err(self.impossible(first.span().start, what));
        }
        if let Some(conflict) = scenario.schedule().conflicts().first() {
            return Err(self.impossible(place_of(&network, conflict), conflict));
        }
        self.check_calibration(&network, &scenario)?;
        if asked.is_none() {
            scenario.guard = widest_guard(&scenario);
        }
        scenario = scenario.with_random_clocks();
        // The master comes first, as in a network without a file.
        let master = scenario.stations.iter().position(|station| station.role == Role::Master).unwrap_or(0);
        scenario.stations[..=master].rotate_right(1);
        scenario.conditions.renumber(|station| match station {
            first if first == master => 0,
            before if before < master => before + 1,
            behind => behind,
        });
        Ok(scenario)
    }

    /// What the network goes through; stations are numbered as in the file.
    fn conditions(&self, network: &mut NetworkFile) -> Result<Conditions, FileError> {
        let mut sections = Sections {
            medium: network.medium.clone(),
            host: network.host.take(),
            wires: std::mem::take(&mut network.wire),
            events: std::mem::take(&mut network.event),
            expects: network.expect.take().map(|expect| (Whose::default(), expect)).into_iter().collect(),
            ..Sections::default()
        };
        for (id, entry) in network.station.iter().enumerate() {
            let StationFile { host, clock, expect, traffic, .. } = entry.get_ref();
            let whose = Whose { station: Some(id), priority: None };
            sections.expects.extend(expect.clone().map(|expect| (whose, expect)));
            for flow in traffic.iter().map(Spanned::get_ref) {
                let whose = Whose { priority: Some(flow.priority), ..whose };
                sections.expects.extend(flow.expect.clone().map(|expect| (whose, expect)));
            }
            sections.hosts.extend(host.clone().map(|host| (id, host)));
            sections
                .wanders
                .extend(clock.as_ref().and_then(|clock| clock.wander.clone()).map(|wander| (id, wander)));
        }
        let names = network.station.iter().map(|entry| entry.get_ref().name.get_ref().as_str()).collect();
        let gives_time = |entry: &Spanned<StationFile>| entry.get_ref().role == FileRole::Master;
        let master = network.station.iter().position(gives_time).unwrap_or(0);
        Reader { source: self, names, master }.conditions(sections)
    }
}

/// `P/N`: phase P, from 1, of a period of N cycles.
pub fn parse_phase(text: &str) -> Result<(u32, u32), String> {
    let numbers =
        text.split_once('/').and_then(|(p, n)| Some((p.parse::<u32>().ok()?, n.parse::<u32>().ok()?)));
    match numbers {
        Some((phase, period)) if (1..=period).contains(&phase) => Ok((phase - 1, period)),
        _ => Err(format!("'{text}' is no phase: write P/N with P from 1 to N, as in 1/2")),
    }
}

#[cfg(test)]
mod tests;
