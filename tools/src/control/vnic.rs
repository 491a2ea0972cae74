//! What is asked and answered of a station's VNIC.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::PoolShown;
use crate::report::document::document;

/// What its VNIC may be told.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum VnicRequest {
    /// How it is.
    Status,
    /// Set the device up, or make it anew.
    Up,
    /// Set the device down.
    Down,
    /// Change it.
    Set(VnicChange),
}

/// What is to be changed; addresses and stations as they are written on a command line.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct VnicChange {
    /// Its MTU at the most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mtu: Option<usize>,
    /// Addresses that it is to have besides.
    #[serde(default)]
    pub add: Vec<String>,
    /// Addresses that it is to have no more.
    #[serde(default)]
    pub remove: Vec<String>,
    /// Stations, and what they are reached for.
    #[serde(default)]
    pub peers: Vec<String>,
}

/// How a VNIC is.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct VnicShown {
    /// Its device's name.
    pub device: String,
    /// `tap` or `tun`.
    pub mode: String,
    /// Whether Linux has the station's own address by it.
    pub proxy: bool,
    /// `up`, `down`, or `gone`: deleted by somebody.
    pub state: String,
    /// Its MTU now; 0 if it is gone.
    pub mtu: usize,
    /// What was asked for, at the most.
    pub mtu_at_most: usize,
    /// What the slot takes of a packet.
    pub slot_takes: usize,
    /// Its Ethernet address; none of packets only, or if it is gone.
    pub mac: Option<String>,
    /// Its addresses.
    pub addresses: Vec<String>,
    /// Which station has which address, where nobody can be asked.
    pub peers: Vec<String>,
    /// What keeps the device from what it is to be, a line each.
    pub remarks: Vec<String>,
    /// So fast Linux may send, bytes of frames in a second; none: nothing holds it back.
    pub bytes_per_second: Option<u64>,
    /// Why that is what slots allowed before, if it is not what they allow now.
    pub held_back_as_before: Option<String>,
    /// Why nothing holds it back.
    pub not_held_back: Option<String>,
    /// What the filters that have held it back have passed on and dropped, and what the one that does keeps.
    pub filter: BTreeMap<String, u64>,
    /// What went through, by name.
    pub counters: BTreeMap<String, u64>,
    /// What was lost, by reason, also those for which nothing was.
    pub lost: BTreeMap<String, u64>,
    /// Its buffers.
    pub pool: PoolShown,
    /// What became of the device that nobody has asked the station for.
    pub news: Option<String>,
}

document!(VnicShown, "vnic", vnic_has_its_schema);

/// What a VNIC counts, among what its station does.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct VnicCounted {
    /// What went through, by name.
    pub counters: BTreeMap<String, u64>,
    /// What was lost, by reason.
    pub lost: BTreeMap<String, u64>,
    /// What the filter that holds Linux back has passed on, dropped, and keeps.
    pub filter: BTreeMap<String, u64>,
    /// Why nothing of that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unknown: Option<String>,
}
