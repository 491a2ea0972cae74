//! The part of it that says what the stations are: their roles, clocks and slots, and what they send.

use std::collections::BTreeSet;

use rtmac::tdma::{DEFAULT_MAX_SLOT_ID, DEFAULT_ROUNDS, MAX_ROUNDS, joint};
use rtnet::time::Span;
use rtnet::wire::ethernet;
use serde::Deserialize;
use toml::Spanned;

use super::conditions::{ExpectFile, HostFile, WanderFile};
use super::vnics::VnicFile;
use super::{DEFAULT_PAYLOAD, FileError, MAX_DRIFT_PPM, MAX_OFFSET, Source, parse_phase};
use crate::control::check_name;
use crate::report::figures::Role;
use crate::scenario::{MAX_STATIONS, MIN_PAYLOAD, SlotPlan, StationPlan, VnicPlan};
use crate::station::stack::OwnIp;
use crate::station::traffic::Flow;
use crate::units::{AnySpan, NonNegativeSpan, PositiveSpan};

/// A program queues frames no more often than any cycle begins, and no more seldom than anything happens.
const SHORTEST: Span = Span::from_micros(1);
const LONGEST: Span = Span::from_millis(3_600_000);
/// Many times what a slot's queue holds.
const MAX_BURST: u32 = 1_000;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StationFile {
    pub name: Spanned<String>,
    pub role: FileRole,
    pub backup: Option<Spanned<PositiveSpan>>,
    pub payload: Option<Spanned<usize>>,
    pub ip: Option<Spanned<String>>,
    pub vnic: Option<Spanned<VnicFile>>,
    pub vnic_proxy: Option<Spanned<bool>>,
    rounds: Option<Spanned<u32>>,
    pub clock: Option<ClockFile>,
    pub host: Option<HostFile>,
    pub expect: Option<ExpectFile>,
    #[serde(default)]
    pub traffic: Vec<Spanned<TrafficFile>>,
    pub slots: Option<Vec<Spanned<SlotFile>>>,
}

#[derive(Clone, Copy, Deserialize, PartialEq)]
#[serde(rename_all = "lowercase")]
pub(super) enum FileRole {
    Master,
    Backup,
    Slave,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ClockFile {
    offset: Option<Spanned<AnySpan>>,
    drift_ppm: Option<Spanned<f64>>,
    pub wander: Option<WanderFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SlotFile {
    pub id: u8,
    offset: NonNegativeSpan,
    phase: Option<Spanned<String>>,
    size: Option<Spanned<usize>>,
    joint: Option<u8>,
}

/// What a station's program sends besides.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TrafficFile {
    pub priority: u8,
    every: PositiveSpan,
    burst: Option<u32>,
    payload: Option<usize>,
    slot: Option<u8>,
    pub expect: Option<ExpectFile>,
}

impl From<FileRole> for Role {
    fn from(role: FileRole) -> Self {
        match role {
            FileRole::Master => Role::Master,
            FileRole::Backup => Role::Backup,
            FileRole::Slave => Role::Slave,
        }
    }
}

/// Bytes behind the Ethernet header of its usual frames.
pub(super) fn payload_of(source: &Source<'_>, said: Option<&Spanned<usize>>) -> Result<usize, FileError> {
    let Some(said) = said else { return Ok(DEFAULT_PAYLOAD) };
    let payload = *said.get_ref();
    let what = || format!("a payload of {payload} bytes: it must be {MIN_PAYLOAD} to {}", ethernet::MTU);
    let is_one = (MIN_PAYLOAD..=ethernet::MTU).contains(&payload);
    is_one.then_some(payload).ok_or_else(|| source.impossible(said.span().start, what()))
}

impl Source<'_> {
    pub(super) fn check_stations(
        &self,
        stations: &[Spanned<StationFile>],
        fewest: usize,
    ) -> Result<(), FileError> {
        let first = stations.first().map_or(0, |entry| entry.span().start);
        let n = stations.len();
        if n < fewest {
            let what =
                format!("there must be {fewest} stations or more, and there are {n}: add a [[station]]");
            return Err(self.impossible(first, what));
        }
        if let Some(beyond) = stations.get(MAX_STATIONS) {
            let what = format!(
                "{n} stations: there must be {fewest} to {MAX_STATIONS}; each takes some 0.2 MB of a simulation's memory"
            );
            return Err(self.impossible(beyond.span().start, what));
        }
        self.check_names(&stations.iter().map(|entry| &entry.get_ref().name).collect::<Vec<_>>())?;
        let mut masters = stations.iter().filter(|entry| entry.get_ref().role == FileRole::Master);
        match (masters.next(), masters.next()) {
            (Some(_), None) => Ok(()),
            (None, _) => Err(self.impossible(first, "no station has the role \"master\": exactly one must")),
            (Some(a), Some(b)) => {
                let names = (a.get_ref().name.get_ref(), b.get_ref().name.get_ref());
                let what =
                    format!("'{}' is a second master beside '{}': exactly one must be", names.1, names.0);
                Err(self.impossible(b.span().start, what))
            }
        }
    }

    /// Each can be a name, wherever one is used, and no two are the same.
    pub(super) fn check_names(&self, names: &[&Spanned<String>]) -> Result<(), FileError> {
        let mut taken = BTreeSet::new();
        for name in names {
            check_name(name.get_ref()).map_err(|what| self.impossible(name.span().start, what))?;
            if !taken.insert(name.get_ref()) {
                let what = format!("the name '{}' is taken by another station", name.get_ref());
                return Err(self.impossible(name.span().start, what));
            }
        }
        Ok(())
    }

    pub(super) fn station(
        &self,
        entry: &Spanned<StationFile>,
        ip: Option<OwnIp>,
        vnic: Option<VnicPlan>,
    ) -> Result<StationPlan, FileError> {
        let station = entry.get_ref();
        let payload = payload_of(self, station.payload.as_ref())?;
        let flows = station.traffic.iter().filter_map(|flow| flow.get_ref().payload);
        // A slot that says no size has room for all that its station may send.
        let widest =
            if ip.is_some() || vnic.is_some() { ethernet::MTU } else { flows.fold(payload, usize::max) };
        let slots = station.slots.iter().flatten().map(|slot| self.slot(slot, payload, widest));
        let mut slots = slots.collect::<Result<Vec<_>, _>>()?;
        for (i, slot) in slots.iter().enumerate() {
            if slots[..i].iter().any(|other| other.id == slot.id) {
                let at = station.slots.as_ref().map_or(entry.span().start, |slots| slots[i].span().start);
                return Err(self.impossible(at, format!("slot {} is defined twice", slot.id)));
            }
        }
        self.join(&mut slots, station)?;
        if (station.role == FileRole::Backup) != station.backup.is_some() {
            let what = "a backup says when it sends, as in backup = \"100us\", and nobody else does";
            return Err(self.impossible(entry.span().start, what));
        }
        if let Some(rounds) = station.rounds.as_ref().filter(|rounds| *rounds.get_ref() > MAX_ROUNDS) {
            let what = format!("{} calibration rounds: at most {MAX_ROUNDS}", rounds.get_ref());
            return Err(self.impossible(rounds.span().start, what));
        }
        Ok(StationPlan {
            name: station.name.get_ref().clone(),
            role: station.role.into(),
            backup: station.backup.as_ref().map(|backup| backup.get_ref().0),
            clock: station.clock.as_ref().map(|clock| self.clock(clock)).transpose()?,
            clock_offset: Span::ZERO,
            clock_drift_ppb: 0,
            payload,
            ip,
            vnic,
            rounds: station.rounds.as_ref().map_or(DEFAULT_ROUNDS, |rounds| *rounds.get_ref()),
            flows: self.flows(&station.traffic, payload, &slots)?,
            slots,
        })
    }

    /// How far it is ahead, and its rate error in parts per billion.
    pub(super) fn clock(&self, file: &ClockFile) -> Result<(Span, i64), FileError> {
        let drift = file.drift_ppm.as_ref().map_or(Ok(0), |ppm| self.drift(ppm))?;
        let Some(said) = &file.offset else { return Ok((Span::ZERO, drift)) };
        let AnySpan(offset) = *said.get_ref();
        if offset.abs() > MAX_OFFSET {
            let what = format!("a clock off by {offset}: at most {MAX_OFFSET}");
            return Err(self.impossible(said.span().start, what));
        }
        Ok((offset, drift))
    }

    /// A rate error in parts per billion.
    pub(super) fn drift(&self, ppm: &Spanned<f64>) -> Result<i64, FileError> {
        let said = *ppm.get_ref();
        let what = format!("a clock off by {said} ppm: at most {MAX_DRIFT_PPM} ppm");
        let refuse = || self.impossible(ppm.span().start, what);
        (said.abs() <= MAX_DRIFT_PPM).then_some((said * 1_000.0).round() as i64).ok_or_else(refuse)
    }

    /// What its program sends besides, most urgent first.
    pub(super) fn flows(
        &self,
        traffic: &[Spanned<TrafficFile>],
        usual: usize,
        slots: &[SlotPlan],
    ) -> Result<Vec<Flow>, FileError> {
        let flow = |entry: &Spanned<TrafficFile>| self.flow(entry, usual, slots);
        let mut flows = traffic.iter().map(flow).collect::<Result<Vec<_>, _>>()?;
        for (i, flow) in flows.iter().enumerate() {
            if flows[..i].iter().any(|other| other.priority == flow.priority) {
                let what =
                    format!("a second traffic of priority {}: a station has one of each", flow.priority);
                return Err(self.impossible(traffic[i].span().start, what));
            }
        }
        flows.sort_by_key(|flow| flow.priority);
        Ok(flows)
    }

    fn flow(
        &self,
        entry: &Spanned<TrafficFile>,
        usual: usize,
        slots: &[SlotPlan],
    ) -> Result<Flow, FileError> {
        let file = entry.get_ref();
        let refuse = |what: String| Err(self.impossible(entry.span().start, what));
        let (priority, every, last) = (file.priority, file.every.0, Flow::LAST_PRIORITY);
        if priority > last {
            return refuse(format!(
                "priority {priority}: they go from 0, the most urgent, to {last}; behind that come the usual frames"
            ));
        }
        let burst = file.burst.unwrap_or(1);
        if !(SHORTEST..=LONGEST).contains(&every) || !(1..=MAX_BURST).contains(&burst) {
            return refuse(format!(
                "{burst} frames every {every}: 1 to {MAX_BURST} are queued at a time, every {SHORTEST} to {LONGEST}"
            ));
        }
        let payload = file.payload.unwrap_or(usual);
        if !(MIN_PAYLOAD..=ethernet::MTU).contains(&payload) {
            return refuse(format!(
                "a payload of {payload} bytes: it must be {MIN_PAYLOAD} to {}",
                ethernet::MTU
            ));
        }
        let slot = file.slot.unwrap_or(slots.iter().map(|slot| slot.id).min().unwrap_or(0));
        let size = slots.iter().find(|of| of.id == slot).map(|of| of.size);
        // Where the cycle is divided evenly every station has slot 0, as large as need be.
        match size.or((slots.is_empty() && slot == 0).then_some(ethernet::MTU)) {
            None => refuse(format!("the station has no slot {slot}: give it one, or leave out slot")),
            Some(size) if size < payload => refuse(format!(
                "a payload of {payload} does not fit slot {slot}: give that a size of {payload}"
            )),
            Some(_) => Ok(Flow { priority, every_ns: every.nanos().unsigned_abs(), burst, payload, slot }),
        }
    }

    fn slot(&self, entry: &Spanned<SlotFile>, payload: usize, widest: usize) -> Result<SlotPlan, FileError> {
        let slot = entry.get_ref();
        let refuse = |what: String| Err(self.impossible(entry.span().start, what));
        let (phase, period) = slot.phase.as_ref().map_or(Ok((0, 1)), |text| {
            parse_phase(text.get_ref()).map_err(|what| self.impossible(text.span().start, what))
        })?;
        let size = slot.size.as_ref().map_or(widest, |size| *size.get_ref());
        if size < payload || size > ethernet::MTU {
            let at = slot.size.as_ref().map_or(entry.span().start, |size| size.span().start);
            let refuse = |what: String| Err(self.impossible(at, what));
            return refuse(format!("a size of {size} must hold the payload of {payload}, and at most 1500"));
        }
        if slot.id > DEFAULT_MAX_SLOT_ID {
            return refuse(format!("slot {}: ids go from 0 to {DEFAULT_MAX_SLOT_ID}", slot.id));
        }
        Ok(SlotPlan { id: slot.id, offset: slot.offset.0, phase, period, size, joint: slot.joint })
    }

    /// Lets every joint slot take from a queue that there is.
    fn join(&self, slots: &mut [SlotPlan], station: &StationFile) -> Result<(), FileError> {
        let plans = slots.to_vec();
        let get = |id| plans.iter().find(|plan| plan.id == id).map(|plan| plan.config(Span::ZERO));
        for (slot, entry) in slots.iter_mut().zip(station.slots.iter().flatten()) {
            let owner = joint::owner(&slot.config(Span::ZERO), get);
            slot.joint = owner.map_err(|refused| self.impossible(entry.span().start, refused))?;
        }
        Ok(())
    }
}
