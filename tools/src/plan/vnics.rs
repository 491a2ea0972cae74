//! What is left for what is not real-time.

use rtmac::tdma::NON_RT_SLOT;
use rtnet::wire::ethernet::HEADER_LEN;
use serde::Serialize;
use vnic::tun::fed;
use vnic::{proxy, tunnel};

use super::waits::{serving, turns_per_second};
use crate::cli::VnicMode;
use crate::scenario::{Scenario, StationPlan, VnicPlan};

/// The VNIC of a station.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct VnicRow {
    /// Whose.
    pub station: String,
    /// The slots that take from it, each turn of them that nothing real-time wants.
    pub slots: Vec<u8>,
    /// Turns in a second.
    pub turns_per_second: f64,
    /// The largest packet that it takes, in bytes.
    pub mtu: usize,
    /// What Linux is fed at the most, frames of that size: bytes a second.
    pub bytes_per_second: u64,
}

/// Of all stations that have one and slots for it.
pub(super) fn vnics(scenario: &Scenario) -> Vec<VnicRow> {
    let row = |station: &StationPlan| row(scenario, station, station.vnic.as_ref()?);
    scenario.stations.iter().filter_map(row).collect()
}

fn row(scenario: &Scenario, station: &StationPlan, vnic: &VnicPlan) -> Option<VnicRow> {
    let serving = serving(station, NON_RT_SLOT);
    let size = serving.iter().map(|slot| slot.size).min()?;
    let turns_per_second = turns_per_second(scenario.cycle, &serving);
    let mtu =
        if vnic.proxy { size.min(proxy::MTU) } else { (size + HEADER_LEN - tunnel::HEAD).min(tunnel::MTU) };
    let header = if vnic.mode == VnicMode::Tap { HEADER_LEN } else { 0 };
    Some(VnicRow {
        station: station.name.clone(),
        slots: serving.iter().map(|slot| slot.id).collect(),
        turns_per_second,
        mtu,
        bytes_per_second: fed((turns_per_second * 1e3) as u64, mtu + header),
    })
}
