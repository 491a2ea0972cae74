//! The form of a file whose stations share the medium by a token.
//!
//! ```toml
//! discipline = "token"      # the right to send goes round, in the order of the stations here
//! rate = "100M"
//! token_hold = "500us"      # how long a station may send each time, on the air; default: four of the longest frames
//! token_rest = "250us"      # how long each keeps the token at the least
//! token_late = "500us"      # how late a host may be each time that it is to do something
//! token_delay = "100us"     # how long a token takes to another station at the most
//! token_invite = 16         # a station that is absent is invited, one each so many rounds
//! duration = "10s"
//!
//! [[station]]
//! name = "arm"
//! payload = 64
//! clock = { offset = "120ms", drift_ppm = 12.5 }   # 250 ppm at the most
//! ```
//!
//! Traffic, medium, hosts, wires and events are as in other files; see [`super::conditions`].

use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::conditions::{EventFile, HostFile, MediumFile, Reader, Sections, WireFile};
use super::stations::{ClockFile, TrafficFile, payload_of};
use super::{FileError, Source};
use crate::report::figures::Role;
use crate::scenario::ring::{Network, RingScenario, RingTimes};
use crate::scenario::{DEFAULT_DURATION, DEFAULT_RATE, Happening, StationPlan};
use crate::units::{FileRate, NonNegativeSpan, PositiveSpan};

/// Two clocks may run apart by 500 ppm.
const MAX_DRIFT_PPB: i64 = 250_000;

#[derive(Clone, Copy, Deserialize, PartialEq)]
#[serde(rename_all = "lowercase")]
pub(super) enum FileDiscipline {
    Tdma,
    Token,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RingFile {
    discipline: Spanned<FileDiscipline>,
    rate: Option<FileRate>,
    token_hold: Option<PositiveSpan>,
    token_rest: Option<NonNegativeSpan>,
    token_late: Option<NonNegativeSpan>,
    token_delay: Option<NonNegativeSpan>,
    token_invite: Option<u16>,
    duration: Option<PositiveSpan>,
    seed: Option<u64>,
    station: Vec<Spanned<RingStationFile>>,
    medium: Option<MediumFile>,
    host: Option<HostFile>,
    #[serde(default)]
    wire: Vec<Spanned<WireFile>>,
    #[serde(default)]
    event: Vec<Spanned<EventFile>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RingStationFile {
    name: Spanned<String>,
    payload: Option<Spanned<usize>>,
    clock: Option<Spanned<ClockFile>>,
    host: Option<HostFile>,
    #[serde(default)]
    traffic: Vec<Spanned<TrafficFile>>,
}

const NO_CYCLE: &str = "a ring has no cycle and no slots: the token comes by as often as its stations pass it on; leave it out, \
                        and say token_hold and token_rest";
const NO_SLOTS: &str = "a ring has no slots: leave it out; token_late says how late a host may be, token_hold how long it may send";
const NO_MASTER: &str = "nobody gives the time in a ring, and no clock follows another: leave it out";
const NO_SOCKETS: &str = "stations of a ring in a lab have no sockets and no VNICs: leave it out, or start single ones by \
                          rtnet station --discipline token";
const NO_EXPECTATIONS: &str =
    "what is expected of a ring is that it keeps its bounds, which the verdict tells: leave it out";
const NO_CONTROL: &str = "tokens are no control frames of RTmac, and lost as data is: say lose, or lose_data";
const NO_CUT: &str = "the parts of a ring that is cut have a token each, which this report does not tell apart: unplug stations";

/// What other files say and these do not, where, and what to do.
const NOT_OF_RINGS: &[(&str, &[&str], &str)] = &[
    ("", &["cycle"], NO_CYCLE),
    ("", &["sync_window", "guard", "late", "slot_guard", "max_miss"], NO_SLOTS),
    ("", &["servo", "delay"], NO_MASTER),
    (
        "",
        &[
            "network",
            "vnic_mode",
            "packages",
            "package_routes",
            "package_system",
            "package_priorities",
            "package_times",
            "router",
            "router_keys",
            "router_body",
        ],
        NO_SOCKETS,
    ),
    ("", &["expect"], NO_EXPECTATIONS),
    ("station", &["role", "backup", "rounds"], NO_MASTER),
    ("station", &["slots"], NO_SLOTS),
    ("station", &["ip", "vnic", "vnic_proxy"], NO_SOCKETS),
    ("station", &["expect"], NO_EXPECTATIONS),
    ("station.traffic", &["slot"], NO_SLOTS),
    ("station.traffic", &["expect"], NO_EXPECTATIONS),
    ("wire", &["lose_control"], NO_CONTROL),
    ("event.wire", &["lose_control"], NO_CONTROL),
    ("event", &["cut"], NO_CUT),
];

impl Source<'_> {
    /// Reads a network, by whatever its stations share the medium.
    pub fn parse_any(self) -> Result<Network, FileError> {
        let tables = self.tables()?;
        if place_of_ring(tables.get_ref()).is_none() {
            return self.parse().map(Network::Slots);
        }
        self.check_is_of_rings(tables.get_ref(), "")?;
        let file = RingFile::deserialize(toml::de::Deserializer::from(tables));
        self.ring(file.map_err(|error| self.no_toml(&error))?).map(Network::Ring)
    }

    /// Refuses a ring where only time slots will do.
    pub(super) fn check_has_slots(&self) -> Result<(), FileError> {
        let tables = self.tables()?;
        let Some(at) = place_of_ring(tables.get_ref()) else { return Ok(()) };
        let what = "a ring, which `rtnet sim run`, `rtnet lab run` and `rtnet plan` take: this goes with time slots only";
        Err(self.impossible(at, what))
    }

    /// Refuses what does not go with a ring, in a table and in all below.
    fn check_is_of_rings(&self, table: &DeTable<'_>, path: &str) -> Result<(), FileError> {
        for (key, value) in table.iter() {
            let name: &str = key.get_ref();
            let refused = NOT_OF_RINGS.iter().find(|(of, names, _)| *of == path && names.contains(&name));
            if let Some((_, _, why)) = refused {
                return Err(self.impossible(key.span().start, format!("{name}: {why}")));
            }
            let below = if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
            match value.get_ref() {
                DeValue::Table(table) => self.check_is_of_rings(table, &below)?,
                DeValue::Array(items) => {
                    for item in items.iter() {
                        if let DeValue::Table(table) = item.get_ref() {
                            self.check_is_of_rings(table, &below)?;
                        }
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn ring(&self, mut file: RingFile) -> Result<RingScenario, FileError> {
        let first = file.discipline.span().start;
        let names: Vec<_> = file.station.iter().map(|entry| &entry.get_ref().name).collect();
        self.check_names(&names)?;
        if file.station.len() < 2 {
            return Err(self.impossible(first, "a ring of fewer than 2 stations: nothing would be measured"));
        }
        let stations = file.station.iter().map(|entry| self.ring_station(entry));
        let stations = stations.collect::<Result<Vec<_>, _>>()?;
        let mut sections = Sections {
            medium: file.medium.take(),
            host: file.host.take(),
            wires: std::mem::take(&mut file.wire),
            events: std::mem::take(&mut file.event),
            ..Sections::default()
        };
        for (id, entry) in file.station.iter().enumerate() {
            let RingStationFile { host, clock, .. } = entry.get_ref();
            sections.hosts.extend(host.clone().map(|host| (id, host)));
            let wander = clock.as_ref().and_then(|clock| clock.get_ref().wander.clone());
            sections.wanders.extend(wander.map(|wander| (id, wander)));
        }
        let names = file.station.iter().map(|entry| entry.get_ref().name.get_ref().as_str()).collect();
        // There is none: whoever it is, it is there from the begin.
        let conditions = Reader { source: self, names, master: usize::MAX }.conditions(sections)?;
        let times = RingTimes {
            hold: file.token_hold.map(|span| span.0),
            rest: file.token_rest.map(|span| span.0),
            late: file.token_late.map(|span| span.0),
            delay: file.token_delay.map(|span| span.0),
            invite: file.token_invite,
        };
        let rate = file.rate.map_or(DEFAULT_RATE, |rate| rate.0);
        let duration = file.duration.map_or(DEFAULT_DURATION, |duration| duration.0);
        let run = (duration, file.seed.unwrap_or(1));
        let ring = RingScenario::new(times, rate, run, stations, conditions);
        let ring = ring.map_err(|why| self.impossible(first, why))?;
        self.check_events(&ring.network)?;
        self.check_ring_clocks(&ring)?;
        let seed = ring.network.seed;
        Ok(ring.with_seed(seed))
    }

    fn ring_station(&self, entry: &Spanned<RingStationFile>) -> Result<StationPlan, FileError> {
        let station = entry.get_ref();
        let payload = payload_of(self, station.payload.as_ref())?;
        let clock = station.clock.as_ref().map(|said| Ok((self.clock(said.get_ref())?, said.span().start)));
        let clock = clock.transpose()?;
        if let Some(((_, drift), at)) = clock.filter(|((_, drift), _)| drift.abs() > MAX_DRIFT_PPB) {
            return Err(self.impossible(at, too_fast(drift)));
        }
        Ok(StationPlan {
            name: station.name.get_ref().clone(),
            role: Role::default(),
            backup: None,
            clock: clock.map(|(clock, _)| clock),
            clock_offset: Span::ZERO,
            clock_drift_ppb: 0,
            payload,
            ip: None,
            vnic: None,
            rounds: 0,
            slots: Vec::new(),
            flows: self.flows(&station.traffic, payload, &[])?,
        })
    }

    /// No clock runs faster, or slower, than time-outs allow, whatever happens to it.
    fn check_ring_clocks(&self, ring: &RingScenario) -> Result<(), FileError> {
        for event in &ring.network.conditions.events {
            if let Happening::Clock(_, _, Some(drift), _) = event.what
                && drift.abs() > MAX_DRIFT_PPB
            {
                return Err(self.refused(event.place, too_fast(drift)));
            }
        }
        Ok(())
    }
}

/// Where it is said that there is a token.
fn place_of_ring(table: &DeTable<'_>) -> Option<usize> {
    let (_, value) = table.iter().find(|(key, _)| key.get_ref() == "discipline")?;
    (value.get_ref().as_str() == Some("token")).then_some(value.span().start)
}

fn too_fast(drift_ppb: i64) -> String {
    let most = MAX_DRIFT_PPB / 1_000;
    format!(
        "a clock off by {} ppm: time-outs of a ring allow {most} ppm for each; say {most} or less",
        drift_ppb as f64 / 1e3
    )
}

#[cfg(test)]
mod tests;
