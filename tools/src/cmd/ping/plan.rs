//! What round trips are to take by the schedule, where the command can look at both stations: in a lab.

use rtmac::tdma::schedule::{self, Slot, Wait};
use rtmac::tdma::{DEFAULT_LEAD, NON_RT_SLOT};
use rtnet::time::Span;
use std::net::Ipv4Addr;
use std::time::Duration;

use crate::cli::Which;
use crate::cmd::interface::asked;
use crate::cmd::tdma::{stations, status};
use crate::control::{Place, SlotShown, StackReply, StackRequest, StationStatus};

/// The channel of echoes that are answered.
const ANSWERS: u8 = NON_RT_SLOT;
/// Of a real-time slot.
const RT_SLOT: u8 = 0;

/// What is known of both stations before a round begins.
pub struct Plan {
    /// From one cycle's start to the next: of who asks.
    pub cycle: Option<Duration>,
    /// Which the two are, and the round trip by their slots.
    both: Option<([Which; 2], Wait)>,
    /// What they had missed by then.
    missed: u64,
}

impl Plan {
    /// Of the way from a station to an address, by a slot of that station's.
    pub fn of(which: &Which, to: Ipv4Addr, channel: u8) -> Self {
        let own = status(which).ok();
        let cycle = own.as_ref().and_then(|own| own.period_ns);
        let both = own.and_then(|own| Self::both(which, own, to, channel));
        let mut plan =
            Self { cycle: cycle.map(|ns| Duration::from_nanos(ns.unsigned_abs())), both, missed: 0 };
        plan.missed = plan.missed_so_far();
        plan
    }

    fn both(which: &Which, own: StationStatus, to: Ipv4Addr, channel: u8) -> Option<([Which; 2], Wait)> {
        let StackReply::Way(way) = asked(which, StackRequest::Lookup(to)).ok()? else { return None };
        let (address, lab) = (way.address.filter(|_| way.via.is_none())?, which.place.lab.clone()?);
        let name = stations(&lab)?.into_iter().find(|station| station.address == address)?.name;
        let place = Place { lab: Some(lab), station: name };
        let other = Which { place, json: which.json };
        let theirs = status(&other).ok()?;
        let wait = round_trip(&own, &theirs, channel)?;
        let own = Which { place: which.place.clone(), json: which.json };
        Some(([own, other], wait))
    }

    /// Best and worst by the schedule.
    pub fn wait(&self) -> Option<Wait> {
        self.both.as_ref().map(|(_, wait)| *wait)
    }

    /// Slots that the two have missed since the round began, of which each may add a cycle to a round trip.
    pub fn missed(&self) -> u64 {
        self.missed_so_far().saturating_sub(self.missed)
    }

    fn missed_so_far(&self) -> u64 {
        let both = self.both.iter().flat_map(|(both, _)| both);
        both.filter_map(|which| status(which).ok())
            .map(|status| status.misses.causes.values().sum::<u64>())
            .sum()
    }
}

/// From a question's being asked to the answer, by the slots of both. None where slots are joint: what waits for one
/// leaves in another, too.
fn round_trip(own: &StationStatus, theirs: &StationStatus, channel: u8) -> Option<Wait> {
    let cycle = Span::from_nanos(own.period_ns?);
    let (asks, answers) = (slot(own, channel)?, slot(theirs, ANSWERS)?);
    // As calibration has measured it; who gives the time has not.
    let [own, theirs] = [own, theirs].map(|status| status.standing.delay_ns);
    let way = |first: Option<i64>, other: Option<i64>| Span::from_nanos(first.or(other).unwrap_or(0));
    Some(schedule::round_trip(cycle, &asks, &answers, DEFAULT_LEAD, [way(theirs, own), way(own, theirs)]))
}

/// The only slot that takes what a channel is given.
fn slot(of: &StationStatus, channel: u8) -> Option<Slot> {
    let slots = of.slots.iter().map(|shown: &SlotShown| shown.slot);
    let has = |id: u8| slots.clone().any(|slot| slot.id == id);
    let id = if channel == NON_RT_SLOT && !has(channel) { RT_SLOT } else { channel };
    let queue = |id: u8| slots.clone().find(|slot| slot.id == id).map(|slot| slot.joint.unwrap_or(id));
    let shared = queue(id)?;
    let mut serving = slots.clone().filter(|slot| queue(slot.id) == Some(shared));
    match (serving.next(), serving.next()) {
        (Some(slot), None) => Some(Slot {
            owner: of.name.clone(),
            id: slot.id,
            offset: Span::from_nanos(slot.offset_ns),
            phase: slot.phase,
            period: slot.period,
            size: slot.size,
        }),
        _ => None,
    }
}
