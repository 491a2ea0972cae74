//! Networks in files.
//!
//! ```toml
//! cycle = "1ms"             # required; everything else has a default or is per station
//! rate = "1G"
//! sync_window = "50us"      # default: this; as long as a slot where no station says where its slots are
//! guard = "20us"            # default: what the closest slots leave
//! duration = "10s"
//! seed = 1
//! late = "skip"             # or "send", as RTnet does
//! slot_guard = "auto"       # or "kernel", "user": what keeps stations from sending later
//! servo = "linear"          # or "none", as in RTnet: each sync is the time line
//!
//! [[station]]
//! name = "master"
//! role = "master"           # exactly one; or "slave", or "backup"
//! backup = "100us"          # of a backup: how long after a cycle's start it sends a sync if there is none
//! payload = 64
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

mod conditions;
mod stations;

use std::path::Path;

use rtmac::tdma::schedule::{self, Conflict, Rate};
use rtmac::tdma::{LatePolicy, check_cycle, check_rounds};
use rtnet::sim::Joint;
use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

use conditions::{EventFile, ExpectFile, HostFile, MediumFile, Reader, Sections, Whose, WireFile};
use stations::StationFile;

use super::{
    Conditions, Measure, Scenario, ServoName, SlotGuard, SlotPlan, StationPlan, default_sync_window, divide,
};
use crate::report::figures::Role;
use crate::units::{FileRate, GuardBand, PositiveSpan};

const DEFAULT_RATE: Rate = Rate::from_bits_per_second(1_000_000_000);
const DEFAULT_DURATION: Span = Span::from_millis(10_000);
const DEFAULT_PAYLOAD: usize = 64;
/// Ten times what the worst of quartz clocks do.
const MAX_DRIFT_PPM: f64 = 1_000.0;
/// An hour: more shows nothing that this does not.
const MAX_OFFSET: Span = Span::from_millis(3_600_000);

/// A file that is no network: where, what, and what to do.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It cannot be read.
    #[error("{0}: {1}")]
    Unreadable(String, std::io::Error),
    /// It is not TOML, or has keys or values that mean nothing.
    #[error("{0}: {1}")]
    Toml(String, String),
    /// What it says cannot be.
    #[error("{file}:{line}: {what}")]
    Impossible {
        /// Which file.
        file: String,
        /// Which line, from 1.
        line: usize,
        /// What, and what to do.
        what: String,
    },
}

/// Reads a network from a file.
pub fn load(path: &Path) -> Result<Scenario, FileError> {
    let file = path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|error| FileError::Unreadable(file.clone(), error))?;
    Source { file: &file, text: &text }.parse()
}

/// The text of a file, and its name for messages.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// What to call it.
    pub file: &'a str,
    /// What it says.
    pub text: &'a str,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NetworkFile {
    cycle: Spanned<PositiveSpan>,
    rate: Option<FileRate>,
    sync_window: Option<PositiveSpan>,
    guard: Option<GuardBand>,
    duration: Option<PositiveSpan>,
    seed: Option<u64>,
    late: Option<Late>,
    slot_guard: Option<SlotGuard>,
    servo: Option<ServoName>,
    station: Vec<Spanned<StationFile>>,
    medium: Option<MediumFile>,
    host: Option<HostFile>,
    #[serde(default)]
    wire: Vec<WireFile>,
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
        let mut network: NetworkFile = toml::from_str(self.text)
            .map_err(|error| FileError::Toml(self.file.into(), error.to_string()))?;
        let cycle = network.cycle.get_ref().0;
        check_cycle(cycle).map_err(|refused| self.impossible(network.cycle.span().start, refused))?;
        let rate = network.rate.map_or(DEFAULT_RATE, |rate| rate.0);
        self.check_stations(&network.station)?;
        let without =
            |entry: &&Spanned<StationFile>| entry.get_ref().slots.as_ref().is_none_or(Vec::is_empty);
        let divided = network.station.iter().all(|entry| without(&entry));
        let sync_window = network.sync_window.map(|window| window.0);
        let mut stations = Vec::new();
        for entry in &network.station {
            stations.push(self.station(entry)?);
        }
        let asked = network.guard.map(|guard| guard.0);
        let mut scenario = Scenario {
            cycle,
            sync_window: sync_window.unwrap_or(default_sync_window(cycle)),
            rate,
            guard: asked.unwrap_or(Span::ZERO),
            duration: network.duration.map_or(DEFAULT_DURATION, |duration| duration.0),
            seed: network.seed.unwrap_or(1),
            late: if matches!(network.late, Some(Late::Send)) { LatePolicy::Send } else { LatePolicy::Skip },
            slot_guard: network.slot_guard.unwrap_or_default(),
            servo: network.servo.unwrap_or_default(),
            stations,
            conditions: self.conditions(&mut network)?,
        };
        self.check_events(&scenario)?;
        if divided {
            self.divide(&mut scenario, sync_window, asked)?;
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
    fn conditions(self, network: &mut NetworkFile) -> Result<Conditions, FileError> {
        let mut sections = Sections {
            medium: network.medium.take(),
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
            sections.wanders.extend(clock.as_ref().and_then(|clock| clock.wander).map(|wander| (id, wander)));
        }
        let names = network.station.iter().map(|entry| entry.get_ref().name.get_ref().as_str()).collect();
        Reader { source: self, names }.conditions(sections)
    }

    /// What happens does so while somebody measures, and no end of one event is the end of another; what is expected can
    /// be.
    fn check_events(self, scenario: &Scenario) -> Result<(), FileError> {
        let Conditions { events, expectations, joint, .. } = &scenario.conditions;
        let refuse =
            |line: usize, what: String| Err(FileError::Impossible { file: self.file.into(), line, what });
        for (place, event) in events.iter().enumerate() {
            if event.is_over() >= scenario.duration {
                let (over, duration) = (event.is_over(), scenario.duration);
                return refuse(
                    event.line,
                    format!("over after {over}, and the measurement lasts {duration}: make that longer"),
                );
            }
            for before in &events[..place] {
                if let Some(kind) = event.clashes_with(before) {
                    let what = format!(
                        "at once with the {kind} of line {}: when one of them is over, so is the other; part them",
                        before.line
                    );
                    return refuse(event.line, what);
                }
            }
        }
        for expected in expectations {
            let is_measured = match expected.measure {
                Measure::Collisions => *joint == Joint::Hub,
                Measure::QueueFull => matches!(joint, Joint::Switch { .. }),
                _ => true,
            };
            if !is_measured {
                let name = expected.measure.name();
                return refuse(expected.line, format!("{name}: this medium has none; see joint of [medium]"));
            }
        }
        Ok(())
    }

    /// A rate error in parts per billion.
    fn drift(self, ppm: f64, at: usize) -> Result<i64, FileError> {
        let refuse = || self.impossible(at, format!("a clock off by {ppm} ppm: at most {MAX_DRIFT_PPM} ppm"));
        (ppm.abs() <= MAX_DRIFT_PPM).then_some((ppm * 1_000.0).round() as i64).ok_or_else(refuse)
    }

    /// No station says where its slots are: the cycle is divided evenly, in the order of the file.
    fn divide(
        &self,
        scenario: &mut Scenario,
        window: Option<Span>,
        guard: Option<Span>,
    ) -> Result<(), FileError> {
        let size =
            scenario.stations.iter().map(StationPlan::largest_payload).max().unwrap_or(DEFAULT_PAYLOAD);
        let Scenario { cycle, rate, .. } = *scenario;
        // Slots begin when the last backup may send no more; a window that is longer than need be is in its way.
        let last = scenario.stations.iter().filter_map(|station| station.backup).max();
        let window = window.or(last.map(|_| scenario.sync_window));
        let last = last.unwrap_or(Span::ZERO);
        let (start, length) = divide(cycle - last, window, rate, scenario.stations.len(), size, guard)
            .map_err(|conflict| self.impossible(0, conflict))?;
        scenario.sync_window = start;
        for (k, station) in scenario.stations.iter_mut().enumerate() {
            let offset = last + start + length * k as i64;
            let size = station.largest_payload();
            station.slots = vec![SlotPlan { id: 0, offset, phase: 0, period: 1, size, joint: None }];
        }
        Ok(())
    }

    fn check_calibration(&self, network: &NetworkFile, scenario: &Scenario) -> Result<(), FileError> {
        // A master that returns to its backups calibrates, too.
        let has_backups = scenario.stations.iter().any(|station| station.backup.is_some());
        let follows = |station: &&StationPlan| station.role != Role::Master || has_backups;
        for slave in scenario.stations.iter().filter(follows) {
            let slots = || slave.slots.iter().map(|slot| (slot.id, slot.period));
            check_rounds(slave.rounds, slots()).map_err(|refused| {
                let first = slots().min().map_or(0, |(id, _)| id);
                self.impossible(place_of_slot(network, &slave.name, first), refused)
            })?;
        }
        Ok(())
    }

    fn impossible(&self, at: usize, what: impl ToString) -> FileError {
        FileError::Impossible { file: self.file.into(), line: self.line(at), what: what.to_string() }
    }

    /// The line of a place in the text, from 1.
    fn line(&self, at: usize) -> usize {
        self.text[..at.min(self.text.len())].matches('\n').count() + 1
    }
}

/// Where the slot stands that a conflict names last.
fn place_of(network: &NetworkFile, conflict: &Conflict) -> usize {
    match conflict {
        Conflict::Overlap { b, b_id, .. } => place_of_slot(network, b, *b_id),
        Conflict::InSyncWindow { owner, id, .. }
        | Conflict::BeyondCycle { owner, id, .. }
        | Conflict::BeforeBackup { owner, id, .. } => place_of_slot(network, owner, *id),
        Conflict::BackupTooEarly { owner, .. } => place_of_slot(network, owner, u8::MAX),
        Conflict::DoesNotFit { .. } => 0,
    }
}

/// Where a slot stands, or else its station.
fn place_of_slot(network: &NetworkFile, owner: &str, id: u8) -> usize {
    let station = network.station.iter().find(|entry| entry.get_ref().name.get_ref() == owner);
    let slots = station.and_then(|entry| entry.get_ref().slots.as_ref());
    let slot = slots.and_then(|slots| slots.iter().find(|slot| slot.get_ref().id == id));
    slot.map(|slot| slot.span().start).or(station.map(|entry| entry.span().start)).unwrap_or(0)
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

/// What the closest slots, or the last and the cycle's end, leave free behind a frame.
fn widest_guard(scenario: &Scenario) -> Span {
    let schedule = scenario.schedule();
    let fits = |guard: Span| schedule::Schedule { guard, ..schedule.clone() }.conflicts().is_empty();
    // The largest that fits, by halving the interval: conflicts only grow with the guard band.
    let (mut low, mut high) = (0, scenario.cycle.nanos());
    while high - low > 1 {
        let middle = (low + high) / 2;
        if fits(Span::from_nanos(middle)) { low = middle } else { high = middle }
    }
    Span::from_nanos(low)
}

#[cfg(test)]
mod tests;
