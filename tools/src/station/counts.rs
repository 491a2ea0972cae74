//! What a station counts, by name.

use std::collections::BTreeMap;

use rtmac::tdma::{SlotStatus, TdmaStatus};
use rtmac::token::TokenStatus;
use rtnet::at_once::AtOnceStatus;
use rtnet::live::PortCounters;

use super::access::AccessStatus;
use super::wire::Wire;
use crate::control::SlotShown;

/// A slot, and what became of frames in it.
pub fn shown(slot: &SlotStatus) -> SlotShown {
    let config = slot.config;
    SlotShown { slot: config.into(), latest_ns: config.latest.nanos(), queued: slot.queued, sent: slot.sent }
}

/// Of its discipline, and of its interface.
pub fn counters(status: &AccessStatus, wire: &Wire) -> BTreeMap<String, u64> {
    let mut counters = match status {
        AccessStatus::Tdma(status) => of_tdma(status),
        AccessStatus::AtOnce(_, status) => of_at_once(status),
        AccessStatus::Token(status) => of_token(status),
    };
    counters.extend(wire.counters().into_iter().map(|(name, n)| (name.to_owned(), n)));
    counters
}

/// Of its port.
pub fn of_port(port: &PortCounters) -> BTreeMap<String, u64> {
    let all = [
        ("received", port.received),
        ("oversize", port.oversize),
        ("uncut", port.uncut),
        ("not_cut", port.not_cut),
        ("pool_empty", port.pool_empty),
        ("socket_full", port.socket_full),
        ("clock_steps", port.clock_steps),
        ("others_passed", port.others_passed),
        ("others_kept_off", port.others_kept_off),
    ];
    all.into_iter().map(|(name, n)| (name.to_owned(), n)).collect()
}

fn of_at_once(status: &AtOnceStatus) -> BTreeMap<String, u64> {
    let all = [
        ("frames_sent", status.frames_sent),
        ("send_failed", status.send_failed),
        ("lethal", status.lethal),
        ("queued", status.queued as u64),
    ];
    all.into_iter().map(|(name, n)| (name.to_owned(), n)).collect()
}

fn of_token(status: &TokenStatus) -> BTreeMap<String, u64> {
    let queued = ("queued", status.queued as u64);
    let all = status.counters.named().into_iter().chain([queued]);
    all.map(|(name, n)| (name.to_owned(), n)).collect()
}

fn of_tdma(status: &TdmaStatus) -> BTreeMap<String, u64> {
    let all =
        status.counters.named().into_iter().chain([("calibration_repeats", status.calibration_repeats)]);
    // A master sends syncs and replies, the others do not: what cannot be is not shown.
    let of_masters = ["syncs_sent", "syncs_skipped", "replies_sent", "replies_late", "replies_given_up"];
    let shown = |name: &str| status.mastery.is_some() || !of_masters.contains(&name);
    all.filter(|(name, n)| *n > 0 || shown(name)).map(|(name, n)| (name.to_owned(), n)).collect()
}
