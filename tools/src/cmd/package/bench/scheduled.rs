//! What slots say of a way to another station, as far as the command can look at both: the other in a lab only.

use package_router::component::Sender;
use package_router::wire::HEAD_LEN;
use rtmac::tdma::RT_SLOT;
use rtnet::time::Span;
use rtnet::wire::{ipv4, udp};
use serde::Serialize;

use crate::cli::Which;
use crate::cmd::ping::plan::{round_trip, ways, whose};
use crate::cmd::tdma::status;
use crate::cmd::waits::{self, missed, serving};
use crate::control::StationStatus;
use crate::report::histogram::SignedHistogram;

/// Stations tell what they have missed twenty times a second.
const TOLD_WITHIN: std::time::Duration = std::time::Duration::from_millis(100);

/// What is known of the slots of both ways.
#[derive(Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Scheduled {
    /// Of who asks, then of who answers, if that is known.
    pub waits: Vec<Waits>,
    /// All of that together, if both are known: a round trip takes that at the worst, and what mailboxes and programs take.
    pub two_worst_waits_ns: Option<i64>,
    /// How long before a slot the own station chooses the frame for it.
    pub lead_ns: Option<i64>,
    /// What it takes at the least and at the most by where the slots are, if nobody takes any time.
    pub round_trip_ns: Option<[i64; 2]>,
    /// Round trips that took longer than both waits.
    pub longer: u64,
    /// Slots that the stations have missed meanwhile: each may be the reason of one of those, and adds a cycle.
    pub missed: u64,
    #[serde(skip)]
    stations: Vec<Which>,
    /// Of the way there.
    #[serde(skip)]
    turns: Option<Turns>,
}

/// How long a frame waits for its slot at the worst, and is on its way.
#[derive(Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Waits {
    /// The station that sends.
    pub station: String,
    /// Its slot.
    pub slot: u8,
    /// The longest wait for that slot.
    pub worst_wait_ns: i64,
    /// From the slot to the other station.
    pub way_ns: i64,
}

/// How often slots have a turn, and what is the largest body that each of them takes.
#[derive(Debug)]
struct Turns {
    every_ns: f64,
    body: usize,
}

impl Scheduled {
    /// Of where a sender leads, if that is another station and it has slots.
    pub fn of(which: &Which, sender: &Sender) -> Option<Self> {
        let (to, channel) = sender.away()?;
        let own = status(which).ok()?;
        let theirs = whose(which, to);
        let [there, back] = theirs.as_ref().map_or([Span::ZERO; 2], |(_, theirs)| ways(&own, theirs));
        let of = |place: &Which, status: &StationStatus, slot: u8, way: Span| {
            let (station, way_ns) = (place.place.to_string(), way.nanos());
            waits::worst(status, slot).map(|wait| Waits {
                station,
                slot,
                worst_wait_ns: wait.nanos(),
                way_ns,
            })
        };
        let mut waits = vec![of(which, &own, channel, there)?];
        let answers = theirs.as_ref().filter(|(_, theirs)| has_one_queue(theirs));
        waits.extend(answers.and_then(|(place, theirs)| of(place, theirs, RT_SLOT, back)));
        let together = waits.iter().map(|wait| wait.worst_wait_ns + wait.way_ns).sum();
        let trip = answers
            .and_then(|(_, theirs)| round_trip(&own, theirs, [channel, RT_SLOT]))
            .map(|trip| [trip.best.nanos(), trip.worst.nanos()]);
        let turns = Turns::of(&own, channel);
        let mut stations = vec![Which { place: which.place.clone(), json: which.json }];
        stations.extend(theirs.map(|(place, _)| place));
        let two_worst_waits_ns = (waits.len() == 2).then_some(together);
        let (longer, missed) = (0, 0);
        let lead_ns = own.lead_ns;
        let mut of =
            Self { waits, two_worst_waits_ns, lead_ns, round_trip_ns: trip, longer, missed, stations, turns };
        of.missed = of.missed_so_far();
        Some(of)
    }

    /// All is measured: these round trips.
    pub fn end(&mut self, times: &SignedHistogram) {
        let is_longer = |&(time, _): &(i64, u64)| self.two_worst_waits_ns.is_some_and(|both| time > both);
        self.longer = times.iter().filter(is_longer).map(|(_, count)| count).sum();
        std::thread::sleep(TOLD_WITHIN);
        self.missed = self.missed_so_far().saturating_sub(self.missed);
    }

    fn missed_so_far(&self) -> u64 {
        self.stations.iter().filter_map(|which| status(which).ok()).map(|status| missed(&status)).sum()
    }

    /// How many turns for the way there passed in such a time, the first and the last among them; none: a package of that size
    /// takes more than one.
    pub fn turns(&self, size: usize, took_ns: Option<u64>) -> Option<u64> {
        let turns = self.turns.as_ref().filter(|turns| size <= turns.body)?;
        Some((took_ns? as f64 / turns.every_ns).round() as u64 + 1)
    }
}

/// Whether whatever a station sends leaves in slot 0, or in one that is joint with it: which slot the class of who answers has is
/// known to that station alone.
fn has_one_queue(of: &StationStatus) -> bool {
    serving(of, RT_SLOT).len() == of.slots.len()
}

impl Turns {
    fn of(own: &StationStatus, channel: u8) -> Option<Self> {
        let slots = serving(own, channel);
        let size = slots.iter().map(|slot| slot.size).min()?;
        let body = size.saturating_sub(ipv4::HEADER_LEN + udp::HEADER_LEN + HEAD_LEN);
        let a_cycle: f64 = slots.iter().map(|slot| f64::from(slot.period).recip()).sum();
        Some(Self { every_ns: own.period_ns? as f64 / a_cycle, body })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_counted_from_the_first_to_the_last_of_packages_that_take_one() {
        let turns = Some(Turns { every_ns: 500_000.0, body: 1_456 });
        let scheduled = Scheduled {
            waits: Vec::new(),
            two_worst_waits_ns: None,
            lead_ns: None,
            round_trip_ns: None,
            longer: 0,
            missed: 0,
            stations: Vec::new(),
            turns,
        };
        let turns = |size, took| scheduled.turns(size, took);
        assert_eq!(turns(1_456, Some(4_510_000)), Some(10));
        assert_eq!(turns(0, Some(0)), Some(1));
        assert_eq!((turns(1_457, Some(4_500_000)), turns(1, None)), (None, None));
    }
}
