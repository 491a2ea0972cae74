//! What is asked and answered of changes of the schedule.

use std::sync::Arc;

use rtmac::tdma::TdmaStatus;
use rtmac::tdma::change::{Activation, Book, ChangeConfig, ChangeStatus};
use rtmac::wire::change::ScheduleId;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;
use serde::{Deserialize, Serialize};

use super::SlotRequest;
use crate::report::document::document;
use crate::scenario::Scenario;

/// What of the schedule may be asked, or done.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ScheduleRequest {
    /// Which is in use, and how far a change is.
    Show,
    /// Propose another to all stations.
    Propose {
        /// All slots of all stations.
        schedule: Box<ScheduleSaid>,
        /// When to use it, once all have acknowledged; not given: when that is said.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        activate: Option<ActivationSaid>,
    },
    /// Use what is proposed once all have acknowledged.
    Activate(ActivationSaid),
    /// Withdraw what is proposed.
    Cancel,
}

/// When a schedule is to be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ActivationSaid {
    /// As soon as can be.
    Soon,
    /// From this cycle on.
    AtCycle(u32),
    /// So many nanoseconds from now, at the next cycle's start.
    In(i64),
}

impl ActivationSaid {
    /// As the discipline takes it, where cycle `now` is running.
    pub fn activation(self, now: u32, period: Option<Span>) -> Activation {
        match (self, period) {
            (ActivationSaid::AtCycle(cycle), _) => Activation::At(cycle),
            (ActivationSaid::In(ns), Some(period)) => {
                let cycles = ns / period.nanos().max(1) + 1;
                Activation::At(now.wrapping_add(cycles.clamp(0, i64::from(i32::MAX)) as u32))
            }
            (ActivationSaid::Soon | ActivationSaid::In(_), _) => Activation::Soon,
        }
    }
}

/// A whole schedule.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleSaid {
    /// From one cycle's start to the next.
    pub cycle_ns: i64,
    /// How long after its begin a slot may still be used.
    pub latest_ns: i64,
    /// In any order.
    pub slots: Vec<SlotOf>,
}

/// A slot, and whose.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct SlotOf {
    /// The station's address; to a lab, its name.
    pub station: String,
    /// Which.
    pub slot: SlotRequest,
}

impl ScheduleSaid {
    /// That of a file, each station by `name`.
    pub fn of(scenario: &Scenario, name: impl Fn(usize) -> String) -> Self {
        let slots = scenario.stations.iter().enumerate().flat_map(|(id, station)| {
            let name = name(id);
            let said = move |slot| SlotOf { station: name.clone(), slot: scenario.slot_config(slot).into() };
            station.slots.iter().map(said)
        });
        Self {
            cycle_ns: scenario.cycle.nanos(),
            latest_ns: scenario.latest().nanos(),
            slots: slots.collect(),
        }
    }

    /// As stations tell each other of it; what cannot be is said.
    pub fn book(&self) -> Result<Book, String> {
        let latest = Span::from_nanos(self.latest_ns);
        let of = |said: &SlotOf| {
            let station: Result<Address, _> = said.station.parse();
            let station = station.map_err(|_| format!("'{}' is no Ethernet address", said.station))?;
            Ok((station, said.slot.config(latest)))
        };
        let slots: Result<Vec<_>, String> = self.slots.iter().map(of).collect();
        Book::of(Span::from_nanos(self.cycle_ns), slots?).map_err(|refused| refused.to_string())
    }
}

/// What a lab tells its stations of changes.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct ChangesTold {
    /// Room for so many slots of a schedule.
    pub capacity: usize,
    /// What all stations are started with; who never gives the time need not know.
    pub first: Option<ScheduleSaid>,
    /// Who may give the time.
    pub masters: Vec<[u8; 6]>,
    /// How long after a Synchronisation a part of a schedule is sent, and how long after that it still may be.
    pub behind_ns: i64,
    /// See `behind_ns`.
    pub late_ns: i64,
}

impl ChangesTold {
    /// For a station of a lab; `None`: its schedule cannot be changed.
    pub fn of(scenario: &Scenario, gives_time: bool) -> Option<Self> {
        let ChangeConfig { capacity, behind, latest, .. } = scenario.change_config()?;
        let first = gives_time.then(|| ScheduleSaid::of(scenario, |id| scenario.address(id).to_string()));
        let masters = if gives_time { scenario.masters() } else { Vec::new() };
        let masters = masters.into_iter().map(|Address(bytes)| bytes).collect();
        Some(Self { capacity, first, masters, behind_ns: behind.nanos(), late_ns: latest.nanos() })
    }

    /// As the discipline takes it.
    pub fn config(&self) -> Result<ChangeConfig, String> {
        Ok(ChangeConfig {
            capacity: self.capacity,
            is_reserved: true,
            first: self.first.as_ref().map(ScheduleSaid::book).transpose()?.map(Arc::new),
            masters: self.masters.iter().copied().map(Address).collect(),
            behind: Span::from_nanos(self.behind_ns),
            latest: Span::from_nanos(self.late_ns),
        })
    }
}

/// Where a station stands with changes of the schedule.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ScheduleShown {
    /// The station.
    pub station: String,
    /// The cycle that it was in.
    pub cycle: u32,
    /// From one cycle's start to the next, once known.
    pub period_ns: Option<i64>,
    /// The number of the schedule whose slots it uses; 0: what it was started with.
    pub in_use: u16,
    /// Its own slots of that.
    pub slots: Vec<SlotRequest>,
    /// What the acting master says is in use; none: it says nothing, or has not been heard.
    pub oper: Option<u16>,
    /// The one that is proposed, or was last.
    pub admin: Option<u16>,
    /// `idle`, `proposed`, `committed`, `sealed`, `switched`, `cancelled` or `unsure`.
    pub state: String,
    /// From which cycle on that is, or is to be.
    pub activation: Option<u32>,
    /// Whether this station gives the time, and so decides.
    pub acts: bool,
    /// Stations that were asked.
    pub asked: u32,
    /// Those that have acknowledged.
    pub acknowledged: u32,
    /// Those that may give the time, and those of them that have confirmed the activation cycle.
    pub masters: u32,
    /// See `masters`.
    pub confirmed: u32,
    /// The first that is waited for.
    pub waits_for: Option<String>,
    /// Why this station stopped the last change.
    pub stopped: Option<String>,
    /// Changes that this station has made.
    pub switched: u64,
    /// Frames about them.
    pub answers_sent: u64,
    /// See `answers_sent`.
    pub parts_sent: u64,
    /// See `answers_sent`.
    pub parts_received: u64,
}

document!(ScheduleShown, "schedule", schedule_has_its_schema);

impl ScheduleShown {
    /// Of a station that takes part in changes.
    pub fn of(station: &str, tdma: &TdmaStatus, status: &ChangeStatus) -> Self {
        let ChangeStatus { in_use, told, acts, heard, asked, acknowledged, confirmed, masters, .. } = *status;
        let number = |id: ScheduleId| heard.then_some(id.number);
        Self {
            station: station.to_owned(),
            cycle: tdma.cycle,
            period_ns: tdma.period.map(Span::nanos),
            in_use: in_use.number,
            slots: tdma.slots.iter().flatten().map(|slot| slot.config.into()).collect(),
            oper: number(told.oper),
            admin: number(told.admin).filter(|&number| number > 0),
            state: if told.is_sure { told.state.name() } else { "unsure" }.into(),
            activation: number(told.admin).filter(|&number| number > 0).map(|_| told.activation),
            acts,
            asked,
            acknowledged,
            masters,
            confirmed,
            waits_for: status.waits_for.map(|station| station.to_string()),
            stopped: status.stopped.map(|why| why.to_string()),
            switched: status.switched,
            answers_sent: status.answers_sent,
            parts_sent: status.parts_sent,
            parts_received: status.parts_received,
        }
    }
}
