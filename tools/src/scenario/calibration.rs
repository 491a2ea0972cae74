//! Whether the stations of a schedule can calibrate: on hosts and wires that are never late, each round ends before the next
//! begins.
//!
//! ```text
//! turn of the slot      k                        k + 1                     k + 2
//! slave                 request .                .   reply .               request
//! master                     '-> request         reply '
//!                       | way + air + way |      chosen a lead before its instant, as is every job
//! ```
//!
//! A station that has chosen a job does no other before it. So the slave has the reply before it chooses its next request, and
//! the master has the request before it chooses what comes behind the reply.

use rtmac::tdma::DEFAULT_LEAD;
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;
use rtnet::wire::ethernet;

use super::{Scenario, StationPlan};
use crate::report::figures::Role;

/// A station that would never be locked, with the sum of one round.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "'{station}' would never be locked: it calibrates in its slot {slot}, every {every}, and a round takes {DEFAULT_LEAD} by which \
     jobs are chosen before their instants + {air} of a request on the air{way} = {sum}; a cycle of {cycle} or longer would do"
)]
pub struct NeverCalibrated {
    /// Which station.
    pub station: String,
    /// Its first slot.
    pub slot: u8,
    /// From one of its turns to the next.
    every: Span,
    /// How long a round takes.
    sum: Span,
    air: Span,
    way: Way,
    /// The shortest cycle that would do.
    cycle: Span,
}

/// What the wire adds to a round.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Way(Span);

impl std::fmt::Display for Way {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            Span::ZERO => Ok(()),
            way => write!(f, " + {way} of its way forth and back that is not free behind the slot"),
        }
    }
}

/// How long a request is on the air, and its reply.
pub fn air(rate: Rate) -> Span {
    rate.air_time(ethernet::MIN_FRAME)
}

impl Scenario {
    /// Stations that calibrate: those that follow, and with backups the master, when it returns.
    pub(super) fn calibrating(&self) -> impl Iterator<Item = &StationPlan> {
        let has_backups = self.stations.iter().any(|station| station.backup.is_some());
        let follows = move |station: &&StationPlan| station.role != Role::Master || has_backups;
        self.stations.iter().filter(move |station| follows(station) && station.rounds > 0)
    }

    /// The first station that would never be locked, if there is one.
    pub fn check_calibration(&self) -> Result<(), NeverCalibrated> {
        let air = air(self.rate);
        for station in self.calibrating() {
            let Some(first) = station.slots.iter().min_by_key(|slot| slot.id) else { continue };
            let period = i64::from(first.period);
            let every = self.cycle * period;
            let way = self.waits_for_way(station, first.offset, every);
            let sum = DEFAULT_LEAD + air + way;
            if every < sum {
                let (station, slot) = (station.name.clone(), first.id);
                let cycle = Span::from_nanos((sum.nanos() + period - 1) / period);
                return Err(NeverCalibrated { station, slot, every, sum, air, way: Way(way), cycle });
            }
        }
        Ok(())
    }

    /// How much longer a round takes, for the master may have chosen what comes behind its reply while the request is on its
    /// way. It has not if it does something else meanwhile.
    fn waits_for_way(&self, station: &StationPlan, offset: Span, every: Span) -> Span {
        let back = self.conditions.way() * 2;
        let cycle = self.cycle.nanos();
        let masters = || self.stations.iter().filter(|other| other.role == Role::Master);
        let certain = masters().flat_map(|master| &master.slots).filter(|slot| slot.period == 1);
        let certain = std::iter::once(Span::ZERO).chain(certain.map(|slot| slot.offset));
        let idle = every - back - air(self.rate);
        if certain.map(|at| (offset - at).nanos().rem_euclid(cycle)).any(|before| before <= idle.nanos()) {
            return Span::ZERO;
        }
        let replies = self.calibrating().filter(|other| other.name != station.name);
        let replies = replies.filter_map(|other| other.slots.iter().min_by_key(|slot| slot.id));
        let jobs = masters().flat_map(|master| &master.slots).chain(replies).map(|slot| slot.offset);
        let jobs = std::iter::once(Span::ZERO).chain(jobs);
        let behind = jobs.map(|at| (at - offset).nanos().rem_euclid(cycle)).filter(|behind| *behind > 0);
        let free = Span::from_nanos(behind.min().unwrap_or(cycle));
        (back - free).max(Span::ZERO)
    }
}
