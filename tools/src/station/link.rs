//! What a lab and its stations tell each other: options in one JSON argument, orders and reports as JSON lines.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use rtmac::tdma::{Mastery, RoleName, TdmaStatus};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Cause, Event, EventKind};
use rtnet::live::{Record, Snapshot};
use rtnet::time::{GlobalTime, Offset, Span};
use rtnet::wire::ethernet::Address;
use serde::{Deserialize, Serialize};

use super::access::AccessStatus;
use super::traffic::{Arrived, FlowPlan, TrafficCounts};
use super::wire::LinkState;
use crate::control::ChangesTold;
use crate::judge::findings::Author;

/// The refusal of frames for which there was no buffer to be received into.
pub const PORT_POOL_EMPTY: &str = "port_pool_empty";

/// What a lab adds to a station's own options.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct LabOptions {
    /// The station's number.
    pub station: u16,
    /// The station's name.
    pub name: String,
    /// Where it is to be asked, if it is to be.
    pub control: Option<PathBuf>,
    /// CLOCK_MONOTONIC at which only the clock's offset applies.
    pub anchor: u64,
    /// Lead of the station's clock at the anchor, nanoseconds.
    pub offset_ns: i64,
    /// Rate error of the station's clock.
    pub drift_ppb: i64,
    /// For a master: global time less its clock, modulo 2^64.
    pub epoch: u64,
    /// Where its test traffic goes.
    pub destination: [u8; 6],
    /// Whose test traffic it receives.
    pub from: u16,
    /// Bytes behind the Ethernet header of each frame it sends.
    pub payload: usize,
    /// The same of the frames it receives.
    pub from_payload: usize,
    /// How much a Synchronisation may disagree before it is a time step, nanoseconds.
    pub step_limit_ns: i64,
    /// For a master that comes after another: a cycle of its grid, and that cycle's scheduled start.
    pub resume: Option<(u32, u64)>,
    /// The number of its first frame of test traffic.
    pub first: u64,
    /// What its program sends besides.
    pub flows: FlowPlan,
    /// Whether its lab may hold frames of it up.
    pub may_stall: bool,
    /// What it is told so that it takes part in changes of the schedule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub changes: Option<ChangesTold>,
}

impl LabOptions {
    /// The clock that the station is to have.
    pub fn clock(&self) -> EmulatedClock {
        let offset = Span::from_nanos(self.offset_ns);
        EmulatedClock { anchor: self.anchor, offset, drift_ppb: self.drift_ppb }
    }

    /// The grid that its master is to go on with.
    pub fn resume(&self) -> Option<(u32, GlobalTime)> {
        self.resume.map(|(cycle, sched)| (cycle, GlobalTime::from_nanos(sched)))
    }
}

/// A line to a station: what its lab's scenario does to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// Its next frame is held up for so many nanoseconds behind its last look at the clock.
    Stall(u64),
    /// The lab's caller has gone: nobody reads its standard error any more.
    LeaveErrors,
    /// It has another clock.
    Clock {
        /// CLOCK_MONOTONIC at which only its offset applies.
        anchor: u64,
        /// Its lead at the anchor, nanoseconds.
        offset_ns: i64,
        /// Its rate error.
        drift_ppb: i64,
    },
}

/// A line from a station.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Report {
    /// It is about to run.
    Started {
        /// Whether the kernel enforces its slots.
        guarded: bool,
        /// What the host refused it.
        refused: Vec<String>,
    },
    /// What happened.
    Events(Vec<EventTold>),
    /// Estimates of global time: CLOCK_MONOTONIC, estimate.
    Times(Vec<(u64, u64)>),
    /// How much later than they were to be its last looks at the clock before sends were, nanoseconds.
    Late(Vec<u64>),
    /// Where it stands.
    Standing(Box<Standing>),
    /// Frames can pass at its interface again, or cannot any more.
    Link {
        /// When it was last seen to be still otherwise, CLOCK_MONOTONIC.
        at: u64,
        /// Whether they can.
        carrier: bool,
    },
    /// It cannot go on.
    Failed(String),
}

/// Cycle, slot, kind (its place in [`EventKind::ALL`]), span in nanoseconds, and if something was missed by it, why
/// (its place in [`Cause::ALL`]).
pub type EventTold = (u32, Option<u8>, u8, i64, Option<u8>);

impl Report {
    /// Tells the lab.
    pub fn say(&self) -> anyhow::Result<()> {
        let mut line = serde_json::to_string(self)?;
        line.push('\n');
        let mut out = std::io::stdout().lock();
        out.write_all(line.as_bytes())?;
        Ok(out.flush()?)
    }
}

/// Where a station stands.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Standing {
    /// CLOCK_MONOTONIC.
    pub at: u64,
    /// `waiting`, `calibrating`, `locked`, `holdover` or `lost`; without a cycle `attached`.
    pub state: String,
    /// Whether its time will not become clearer.
    pub settled: bool,
    /// `up`, `no carrier`, `down`, `bridge port` or `other address`: whether frames can pass at its interface.
    pub link: String,
    /// Whether it is a master.
    pub master: bool,
    /// The last cycle that was told of.
    pub cycle: u32,
    /// The calibrated delay, nanoseconds.
    pub delay_ns: Option<i64>,
    /// The master that it made way for.
    pub yielded_to: Option<String>,
    /// Who gives the time as far as it knows: whom it follows, or itself.
    #[serde(default)]
    pub time_by: Option<String>,
    /// Who else does, while it does.
    #[serde(default)]
    pub rival: Option<String>,
    /// Processor time of its real-time thread, nanoseconds.
    pub cpu_ns: u64,
    /// Frames sent in its slots.
    pub frames_sent: u64,
    /// What came of the usual frames of test traffic.
    #[serde(flatten)]
    pub arrived: Arrived,
    /// The same of what the sender's program queues, by priority.
    pub arrived_queued: BTreeMap<u8, Arrived>,
    /// Frames refused, by reason.
    pub refusals: BTreeMap<String, u64>,
    /// Steps of the wall clock.
    pub clock_steps: u64,
    /// Events and records that found their queue full.
    pub lost_records: u64,
    /// Frames of its program that found no room in their queue, by priority.
    pub queue_refused: BTreeMap<u8, u64>,
}

impl Standing {
    /// A snapshot in a form to be told.
    pub fn of(snapshot: &Snapshot<AccessStatus>, traffic: &TrafficCounts, link: LinkState) -> Self {
        let status = &snapshot.status;
        let tdma = status.tdma();
        let address = |of: fn(&TdmaStatus) -> Option<Address>| tdma.and_then(of).map(|of| of.to_string());
        let port = [
            ("port_oversize", snapshot.port.oversize),
            ("port_not_cut", snapshot.port.not_cut),
            (PORT_POOL_EMPTY, snapshot.port.pool_empty),
            ("port_socket_full", snapshot.port.socket_full),
            ("others_passed", snapshot.port.others_passed),
            ("others_kept_off", snapshot.port.others_kept_off),
        ];
        let port = port.into_iter().filter(|&(_, n)| n > 0).map(|(reason, n)| (reason.to_owned(), n));
        let refusals =
            snapshot.refusals.nonzero().map(|(reason, n)| (reason.name().to_owned(), n)).chain(port);
        Self {
            at: snapshot.at,
            state: status.state_name().into(),
            settled: tdma.is_some_and(|tdma| tdma.settled),
            link: link.name().into(),
            master: tdma
                .is_some_and(|tdma| tdma.role == RoleName::Master || tdma.mastery == Some(Mastery::Active)),
            cycle: status.cycle(),
            delay_ns: tdma.and_then(|tdma| tdma.delay).map(Span::nanos),
            yielded_to: address(|tdma| tdma.yielded_to),
            time_by: address(|tdma| tdma.time_by),
            rival: address(|tdma| tdma.rival),
            cpu_ns: snapshot.cpu,
            frames_sent: status.frames_sent(),
            arrived: traffic.arrived(None),
            arrived_queued: traffic.arrived_queued().collect(),
            refusals: refusals.collect(),
            clock_steps: snapshot.port.clock_steps,
            lost_records: snapshot.records_lost + status.events_lost(),
            queue_refused: traffic.refused().collect(),
        }
    }

    /// What came of the frames with this priority, or of the usual ones.
    pub fn arrived(&self, of: Option<u8>) -> Arrived {
        of.map_or(self.arrived, |priority| self.arrived_queued.get(&priority).copied().unwrap_or_default())
    }

    /// Test traffic missing between frames that were received.
    pub fn missing(&self) -> u64 {
        self.arrived.missing + self.arrived_queued.values().map(|arrived| arrived.missing).sum::<u64>()
    }

    /// Synchronised and calibrated.
    pub fn is_locked(&self) -> bool {
        self.state == "locked" && (self.master || self.delay_ns.is_some())
    }
}

/// Sorts records into the lines that tell of them.
pub fn reports(records: impl Iterator<Item = Record>) -> Vec<Report> {
    let (mut events, mut times, mut late) = (Vec::new(), Vec::new(), Vec::new());
    for record in records {
        match record {
            Record::Event(Event { cycle, kind, slot, span }, cause) => {
                events.push((cycle, slot, number(kind), span.nanos(), cause.map(|cause| cause as u8)));
            }
            Record::Time(at, global) => times.push((at, global.nanos())),
            Record::Late(by) => late.push(by),
        }
    }
    let mut lines = Vec::new();
    if !events.is_empty() {
        lines.push(Report::Events(events));
    }
    if !times.is_empty() {
        lines.push(Report::Times(times));
    }
    if !late.is_empty() {
        lines.push(Report::Late(late));
    }
    lines
}

/// What a station has told: of which slot or cycle, what, by how much, and why. Not what only a later version knows.
pub fn told(
    station: usize,
    events: &[EventTold],
) -> impl Iterator<Item = (Author, EventKind, Span, Option<Cause>)> {
    events.iter().filter_map(move |&(cycle, slot, of, span, why)| {
        Some((Author { station, cycle, slot }, kind(of)?, Span::from_nanos(span), why.and_then(cause)))
    })
}

/// The kind of event with this number.
pub fn kind(number: u8) -> Option<EventKind> {
    EventKind::ALL.get(usize::from(number)).copied()
}

/// The cause with this number.
pub fn cause(number: u8) -> Option<Cause> {
    Cause::ALL.get(usize::from(number)).copied()
}

fn number(kind: EventKind) -> u8 {
    EventKind::ALL.iter().position(|&other| other == kind).unwrap_or(usize::MAX) as u8
}

/// An offset from its number.
pub fn offset(nanos: u64) -> Offset {
    Offset::between(Default::default(), GlobalTime::from_nanos(nanos))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_event_arrives_as_itself() {
        assert!(EventKind::ALL.iter().all(|&of| kind(number(of)) == Some(of)));
        assert_eq!(kind(200), None);
        assert!(Cause::ALL.iter().all(|&of| cause(of as u8) == Some(of)));
    }

    #[test]
    fn a_report_is_one_line_and_reads_back() {
        let report = Report::Events(vec![(7, Some(0), 1, -3, Some(2))]);
        let line = serde_json::to_string(&report).unwrap();
        assert!(!line.contains('\n'));
        assert_eq!(serde_json::from_str::<Report>(&line).unwrap(), report);
    }
}
