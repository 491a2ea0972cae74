//! What round trips are to take by the schedule, where the command can look at both stations: in a lab.

use anyhow::anyhow;
use rtmac::tdma::schedule::{self, Slot, Wait};
use rtmac::tdma::{NON_RT_SLOT, RT_SLOT};
use rtnet::time::Span;
use std::net::Ipv4Addr;
use std::time::Duration;

use crate::cli::{PingArgs, Which};
use crate::cmd::Failure;
use crate::cmd::interface::{asked, check_asked};
use crate::cmd::tdma::{stations, status};
use crate::cmd::waits::{lead, missed, serving};
use crate::control::{InterfaceShown, Place, StackReply, StackRequest, StationStatus};
use crate::station::echoes::ECHO_HEADERS;

/// The channel of echoes that are answered.
const ANSWERS: u8 = NON_RT_SLOT;

/// What is known of both stations before a round begins.
pub struct Plan {
    /// From one cycle's start to the next: of who asks.
    pub cycle: Option<Duration>,
    /// How long before their slots frames are chosen there.
    pub lead: Span,
    /// Which the two are, and the round trip by their slots.
    both: Option<([Which; 2], Wait)>,
    /// The other station, its slot for answers, and what that takes.
    answers: Option<(String, u8, usize)>,
    /// What they had missed by then.
    missed: u64,
}

impl Plan {
    /// Of the way from a station to an address, by a slot of that station's.
    pub fn of(which: &Which, to: Ipv4Addr, channel: u8) -> Self {
        let own = status(which).ok();
        let cycle = own.as_ref().and_then(|own| own.period_ns);
        let cycle = cycle.map(|ns| Duration::from_nanos(ns.unsigned_abs()));
        let lead = own.as_ref().and_then(lead).unwrap_or(Span::ZERO);
        let mut plan = Self { cycle, lead, both: None, answers: None, missed: 0 };
        let Some((other, theirs)) = whose(which, to) else { return plan };
        plan.answers = slot(&theirs, ANSWERS).map(|slot| (other.place.to_string(), slot.id, slot.size));
        let wait = own.and_then(|own| round_trip(&own, &theirs, [channel, ANSWERS]));
        let own = Which { place: which.place.clone(), json: which.json };
        plan.both = wait.map(|wait| ([own, other], wait));
        plan.missed = plan.missed_so_far();
        plan
    }

    /// Refuses questions of which none could be answered.
    pub fn check(&self, which: &Which, args: &PingArgs, own: &InterfaceShown) -> Result<(), Failure> {
        if args.ip == own.ip || args.ip.is_loopback() {
            return Ok(());
        }
        check_asked(which, own, args.ip)?;
        // What is sent in 1 where that is no slot goes by slot 0, and without slots all channels are alike.
        let is_like_0 = own.discipline != "tdma"
            || args.channel == NON_RT_SLOT && !own.channels.contains_key(&NON_RT_SLOT);
        let channel = if is_like_0 { RT_SLOT } else { args.channel };
        // Of one that is not defined the station tells.
        let takes = own.channels.get(&channel).map(|takes| takes.payload);
        let asks = takes.map(|takes| (which.place.to_string(), channel, takes));
        for (station, slot, takes) in asks.iter().chain(&self.answers) {
            let (size, fits) = (args.size, takes.saturating_sub(ECHO_HEADERS));
            if usize::from(size) > fits {
                return Err(Failure::Usage(anyhow!(
                    "an echo of {size} bytes and {ECHO_HEADERS} of headers does not fit slot {slot} of station '{station}', \
                     which takes {takes}, and echoes are answered in one frame only: ask with --size {fits} or less"
                )));
            }
        }
        Ok(())
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
        both.filter_map(|which| status(which).ok()).map(|status| missed(&status)).sum()
    }
}

/// Who has an address, in a lab, and how it stands.
pub(in crate::cmd) fn whose(which: &Which, to: Ipv4Addr) -> Option<(Which, StationStatus)> {
    let StackReply::Way(way) = asked(which, StackRequest::Lookup(to)).ok()? else { return None };
    let (address, lab) = (way.address.filter(|_| way.via.is_none())?, which.place.lab.clone()?);
    let name = stations(&lab)?.into_iter().find(|station| station.address == address)?.name;
    let place = Place { lab: Some(lab), station: name };
    let other = Which { place, json: which.json };
    let theirs = status(&other).ok()?;
    Some((other, theirs))
}

/// From a question's being asked to the answer, by the slots of both for these channels. None where slots are joint: what waits for
/// one leaves in another, too; or where the two do not choose frames by the same lead.
pub(in crate::cmd) fn round_trip(
    own: &StationStatus,
    theirs: &StationStatus,
    [asks, answers]: [u8; 2],
) -> Option<Wait> {
    let cycle = Span::from_nanos(own.period_ns?);
    let (asks, answers) = (slot(own, asks)?, slot(theirs, answers)?);
    let lead = lead(own).filter(|own| lead(theirs) == Some(*own))?;
    Some(schedule::round_trip(cycle, &asks, &answers, lead, ways(own, theirs)))
}

/// How long a frame is on its way, there and back: as calibration has measured it; who gives the time has not.
pub(in crate::cmd) fn ways(own: &StationStatus, theirs: &StationStatus) -> [Span; 2] {
    let [own, theirs] = [own, theirs].map(|status| status.standing.delay_ns);
    let way = |first: Option<i64>, other: Option<i64>| Span::from_nanos(first.or(other).unwrap_or(0));
    [way(theirs, own), way(own, theirs)]
}

/// The only slot that takes what a channel is given.
fn slot(of: &StationStatus, channel: u8) -> Option<Slot> {
    <[Slot; 1]>::try_from(serving(of, channel)).ok().map(|[slot]| slot)
}
