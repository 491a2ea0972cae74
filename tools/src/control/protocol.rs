//! What is asked and answered.

use std::collections::BTreeMap;
use std::path::PathBuf;

use rtmac::tdma::SlotConfig;
use rtnet::time::Span;
use rtnet::wire::ethernet::MTU;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};

use super::clock::ClockShown;
use super::ring::RingShown;
use super::schedule::{ActivationSaid, ScheduleRequest, ScheduleSaid, ScheduleShown};
use super::sockets::{StackReply, StackRequest};
use super::vnic::{VnicRequest, VnicShown};
use crate::judge::masters::Rivals;
use crate::report::document::document;
use crate::report::figures::GuardName;
use crate::report::histogram::Summary;
use crate::report::verdict::Verdict;
use crate::scenario::{DelayName, DelayPolicy, ServoName};
use crate::station::link::Standing;
use crate::station::misses::{Miss, Misses};

/// Changes whenever a request or reply changes its meaning.
pub const VERSION: u16 = 1;

/// What is in a packet.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Envelope<T> {
    /// [`VERSION`] of who made it.
    pub version: u16,
    /// The request or reply itself.
    pub body: T,
}

impl<T: Serialize> Envelope<T> {
    /// A packet of this version.
    pub fn pack(body: T) -> Vec<u8> {
        // Strings, numbers and lists: there is nothing that JSON cannot say.
        serde_json::to_vec(&Envelope { version: VERSION, body }).unwrap_or_default()
    }
}

/// Reads a packet; what is wrong with it is said in a line.
pub fn read<T: DeserializeOwned>(packet: &[u8]) -> Result<T, String> {
    #[derive(Deserialize)]
    struct OnlyVersion {
        version: u16,
    }
    let said =
        serde_json::from_slice::<OnlyVersion>(packet).map_err(|error| format!("unreadable: {error}"))?;
    if said.version != VERSION {
        return Err(format!("version {} is not spoken here, only {VERSION}", said.version));
    }
    let envelope: Envelope<T> =
        serde_json::from_slice(packet).map_err(|error| format!("not understood: {error}"))?;
    Ok(envelope.body)
}

/// What a station may be asked.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Where it stands.
    Status,
    /// Define or change a slot.
    SetSlot(SlotChange),
    /// Remove a slot.
    RemoveSlot(u8),
    /// Be something else in the cycle.
    Become(RoleRequest),
    /// Measure the delay from the master anew.
    Calibrate {
        /// In so many rounds; not given: in as many as the first time.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rounds: Option<u32>,
    },
    /// About its sockets, addresses and routes.
    Stack(StackRequest),
    /// About its VNIC.
    Vnic(VnicRequest),
    /// About the schedule of all stations.
    Schedule(ScheduleRequest),
}

/// What it answers.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    /// Where it stands.
    Status(Box<StationStatus>),
    /// Done; it holds from this cycle on.
    Applied(u32),
    /// Not done, and why.
    Refused(String),
    /// About its sockets, addresses and routes.
    Stack(Box<StackReply>),
    /// How its VNIC is.
    Vnic(Box<VnicShown>),
    /// Where it stands with changes of the schedule.
    Schedule(Box<ScheduleShown>),
}

/// A slot as it is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SlotRequest {
    /// Its id.
    pub id: u8,
    /// Begin, from the cycle's start, nanoseconds.
    pub offset_ns: i64,
    /// Used in cycles with `cycle mod period == phase`; counts from 0.
    pub phase: u32,
    /// See `phase`.
    pub period: u32,
    /// Largest payload behind the Ethernet header.
    pub size: usize,
    /// The slot whose queue it takes from, if not its own.
    pub joint: Option<u8>,
}

impl SlotRequest {
    /// The slot as the discipline takes it.
    pub fn config(&self, latest: Span) -> SlotConfig {
        let &Self { id, offset_ns, phase, period, size, joint } = self;
        SlotConfig { id, offset: Span::from_nanos(offset_ns), phase, period, size, joint, latest }
    }
}

impl From<SlotConfig> for SlotRequest {
    fn from(SlotConfig { id, offset, phase, period, size, joint, .. }: SlotConfig) -> Self {
        Self { id, offset_ns: offset.nanos(), phase, period, size, joint }
    }
}

/// What is to become of a slot: what is not given stays as it is, or is the largest in every cycle with its own queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SlotChange {
    /// Its id.
    pub id: u8,
    /// See [`SlotRequest`].
    pub offset_ns: i64,
    /// See [`SlotRequest`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<u32>,
    /// See [`SlotRequest`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub period: Option<u32>,
    /// See [`SlotRequest`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size: Option<usize>,
    /// See [`SlotRequest`]; `null` is a queue of its own.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    pub joint: Option<Option<u8>>,
}

/// `null`, too, is given.
fn given<'de, D: Deserializer<'de>>(value: D) -> Result<Option<Option<u8>>, D::Error> {
    Option::deserialize(value).map(Some)
}

impl SlotChange {
    /// The whole slot. Who knows all changes says what it was before: a status shows it as it is, not as it is to be.
    pub fn over(&self, before: Option<&SlotRequest>) -> SlotRequest {
        let &Self { id, offset_ns, phase, period, size, joint } = self;
        let none = SlotRequest { id, offset_ns, phase: 0, period: 1, size: MTU, joint: None };
        let before = before.unwrap_or(&none);
        SlotRequest {
            phase: phase.unwrap_or(before.phase),
            period: period.unwrap_or(before.period),
            size: size.unwrap_or(before.size),
            joint: joint.unwrap_or(before.joint),
            ..none
        }
    }
}

impl From<SlotRequest> for SlotChange {
    fn from(SlotRequest { id, offset_ns, phase, period, size, joint }: SlotRequest) -> Self {
        let (phase, period, size) = (Some(phase), Some(period), Some(size));
        Self { id, offset_ns, phase, period, size, joint: Some(joint) }
    }
}

/// A role as it is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RoleRequest {
    /// Listen, then give the time, with this cycle in nanoseconds.
    Master {
        /// From one cycle's start to the next.
        cycle_ns: i64,
    },
    /// Follow the master, after so many calibration rounds.
    Slave {
        /// 0: none.
        rounds: u32,
        /// Not given: as the station was started, and so are the others.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        servo: Option<ServoName>,
        /// What all rounds say together of the delay.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        delay: Option<DelayName>,
        /// Cycles without a Synchronisation that are bridged.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        holdover: Option<u32>,
        /// What becomes of the delay with another master.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        on_master_change: Option<DelayPolicy>,
    },
    /// Take no part.
    Detached,
}

/// A station as others see it.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct StationStatus {
    /// Its name.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// The interface it runs on, by the name that it has now.
    pub interface: String,
    /// That interface's address.
    pub address: String,
    /// `up`, `no carrier`, `down`, `bridge port` or `other address`: whether frames can pass there.
    pub link: String,
    /// How it shares the medium: `tdma`, `nomac`, `direct` or `token`.
    pub discipline: String,
    /// `master`, `backup`, `slave` or `detached`; `none` where there is no cycle.
    pub role: String,
    /// What keeps its slots.
    pub guard: GuardName,
    /// Of a master or a backup: `listening`, `following`, `stand-by`, `active` or `yielded`.
    pub mastery: Option<String>,
    /// State, cycle, delay, who gives the time, refused frames.
    pub standing: Standing,
    /// The stations behind the addresses in that, as far as the lab knows them.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub names: BTreeMap<String, String>,
    /// From one cycle's start to the next, once known.
    pub period_ns: Option<i64>,
    /// How long before their slots its frames are chosen; `None`: it has no cycle.
    #[serde(default)]
    pub lead_ns: Option<i64>,
    /// Global time as the station knew it when it was asked, nanoseconds since 1970, if it knows any.
    #[serde(default)]
    pub global_ns: Option<u64>,
    /// By how much the last Synchronisation disagreed with the time line.
    pub deviation_ns: i64,
    /// How fast its clock gains on the master's, in parts per 10^9; `None`: the master's own, or not known yet.
    pub drift_ppb: Option<i64>,
    /// How it follows its master's time, and how well; `None`: it has no cycle.
    pub clock: Option<ClockShown>,
    /// Where the token is; `None`: it is in no ring.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ring: Option<RingShown>,
    /// Its slots, by id.
    pub slots: Vec<SlotShown>,
    /// Everything that its discipline counts, and what became of its interface.
    pub counters: BTreeMap<String, u64>,
    /// What the host refused it.
    pub host: Vec<String>,
    /// What it has missed, and why.
    pub misses: Misses,
    /// Requests by what became of them.
    pub control: BTreeMap<String, u64>,
}

document!(StationStatus, "station-status", station_status_has_its_schema);

/// A slot, and what became of frames in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct SlotShown {
    /// What it is.
    #[serde(flatten)]
    pub slot: SlotRequest,
    /// How long after its begin a transmission may still start, nanoseconds.
    pub latest_ns: i64,
    /// Frames that wait for it.
    pub queued: usize,
    /// Frames sent in it.
    pub sent: u64,
}

/// What a lab may be asked.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum LabRequest {
    /// How it goes.
    Status,
    /// End, and tell how it went.
    Down,
    /// Change a slot of one of its stations.
    SetSlot {
        /// Whose.
        station: String,
        /// What it is to be.
        slot: SlotChange,
    },
    /// Remove a slot of one of its stations.
    RemoveSlot {
        /// Whose.
        station: String,
        /// Which.
        id: u8,
    },
    /// Propose another schedule to all its stations.
    Propose {
        /// Whom to ask for it: the acting master.
        station: String,
        /// Each station by its name.
        schedule: Box<ScheduleSaid>,
        /// When to use it, once all have acknowledged; not given: when that is said.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        activate: Option<ActivationSaid>,
    },
    /// Let a slave leave the cycle, or join it again.
    Become {
        /// Which.
        station: String,
        /// What it is to be.
        role: RoleRequest,
    },
    /// Put a new process in the place of one of its stations'.
    Restart {
        /// Which.
        station: String,
    },
}

/// What it answers.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LabReply {
    /// How it goes.
    Status(Box<LabStatus>),
    /// It has ended; its process is about to.
    Down(Box<LabStatus>),
    /// Done; it holds from this cycle on.
    Applied(u32),
    /// Not done, and why.
    Refused(String),
}

/// A lab as others see it.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct LabStatus {
    /// Its name.
    pub name: String,
    /// The process that keeps it.
    pub pid: u32,
    /// The bridge that is its medium, and the network namespace in which that is.
    pub bridge: String,
    /// As a file of that process.
    pub bridge_namespace: PathBuf,
    /// The core of its real-time threads.
    pub cpu: usize,
    /// What they take of it, as a share.
    pub load: f64,
    /// What the host refused it, and what that means.
    pub notes: Vec<String>,
    /// Since all stations were locked, seconds.
    pub up_seconds: u64,
    /// From one cycle's start to the next.
    pub cycle_ns: u64,
    /// Cycles that were watched.
    pub cycles: u64,
    /// Slots in them.
    pub frames_expected: u64,
    /// Frames in their slots.
    pub frames_seen: u64,
    /// Slots without their frame.
    pub slots_missed: u64,
    /// Of Synchronisations: actual - scheduled transmit.
    pub sync_slot_error_ns: Summary,
    /// How long after a cycle's start its Synchronisation may be on the air.
    pub sync_window_ns: i64,
    /// Two frames on the air at once.
    pub overlaps: u64,
    /// Frames outside their slot.
    pub out_of_slot: u64,
    /// Cycles without a Synchronisation.
    pub syncs_missing: u64,
    /// Schedules that all have switched to.
    pub schedule_changes: u64,
    /// Who sent the last one.
    pub time_by: String,
    /// Who gave the time at once, the last times.
    pub rivals: Vec<Rivals>,
    /// Frames outside all slots, of addresses that no station has; of the ninth and later ones together.
    pub strangers: BTreeMap<String, u64>,
    /// Synchronisations that are not what they say, by reason: of a stranger, or of a cycle that cannot have begun or is long
    /// over.
    #[serde(default)]
    pub implausible_syncs: BTreeMap<String, u64>,
    /// Of the frame that left the air latest: how long after its slot's end, or, below zero, before it.
    pub latest_frame_ns: Option<i64>,
    /// Of all that ought not to be, what has no record of its cause.
    pub unexplained: u64,
    /// The newest of that, in words.
    pub unexplained_last: Vec<String>,
    /// The rest, by cause.
    pub causes: BTreeMap<String, u64>,
    /// The longest of that, with whose it is, longest first.
    pub worst: Vec<(String, Miss)>,
    /// Frames that the observer lost, or whose stamps a step of the wall clock made worthless.
    pub not_judged: u64,
    /// Frames on the medium that did not reach their receiver, though they were not to be lost; known at the end only.
    pub frames_lost: u64,
    /// What it comes to so far, and why.
    pub verdict: Verdict,
    /// What could not be written at its end: the file, and the error.
    #[serde(default)]
    pub unwritten: Vec<String>,
    /// Its stations.
    pub stations: Vec<MemberStatus>,
}

document!(LabStatus, "lab-status", lab_status_has_its_schema);

/// One station of a lab.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct MemberStatus {
    /// Its name.
    pub name: String,
    /// `master`, `slave`.
    pub role: String,
    /// `waiting`, `calibrating`, `locked`, `holdover`, `lost`, `detached`; of its process `stopped`, `restarting`, `ended`;
    /// with `, no carrier` or `, down` behind it if its interface is that.
    pub state: String,
    /// Its process.
    pub pid: u32,
    /// Its address.
    pub address: String,
    /// Its IP address, as 10.0.0.1/24, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ip: Option<String>,
    /// Frames in its slots.
    pub frames_seen: u64,
    /// Slots without their frame.
    pub slots_missed: u64,
    /// Frames of it outside its slots, of whatever kind.
    #[serde(default)]
    pub stray: u64,
    /// Test traffic that was not what was sent.
    pub payload_errors: u64,
    /// Frames on the medium that it did not receive, though they were not to be lost; known at the end only.
    pub frames_lost: u64,
    /// Actual - scheduled transmit.
    pub slot_error_ns: Summary,
    /// From a slot's begin to its end.
    pub slot_length_ns: i64,
    /// What enforces its slots.
    pub guard: GuardName,
    /// What it told of, by kind.
    pub events: BTreeMap<String, u64>,
    /// Processes that it has had before this one.
    pub restarts: u32,
    /// How often its wire was cut: frames for it were lost for that.
    pub cuts: u32,
    /// What it could not tell of, because its queues were full.
    pub lost_records: u64,
    /// Whether it has not been synchronised for longer than a moment.
    pub lost: bool,
    /// Why it cannot go on, if it has said so.
    pub failed: Option<String>,
    /// Frames refused, by reason.
    pub refusals: BTreeMap<String, u64>,
}

#[cfg(test)]
mod tests;
