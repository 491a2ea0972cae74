//! Whether the stations of a schedule can come up: on hosts and wires that are never late, each round of calibration ends before
//! the next begins, and each sync is heard in time.
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

/// A station that would never be locked, or would be silent in turns of a slot, with the sum that shows it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{what}")]
pub struct Unfit {
    /// Which station.
    pub station: String,
    /// Which slot of it.
    pub slot: u8,
    what: String,
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

    /// The first station that would never be locked, or never heard in time, if there is one.
    pub fn check_fit(&self) -> Result<(), Unfit> {
        self.calibrating().try_for_each(|station| self.check_rounds_end(station))?;
        let follows = |station: &&StationPlan| station.role != Role::Master;
        self.stations.iter().filter(follows).try_for_each(|station| self.check_hears(station))
    }

    /// A round ends before the next begins.
    fn check_rounds_end(&self, station: &StationPlan) -> Result<(), Unfit> {
        let Some(first) = station.slots.iter().min_by_key(|slot| slot.id) else { return Ok(()) };
        let (name, id, air, period) = (&station.name, first.id, air(self.rate), i64::from(first.period));
        let every = self.cycle * period;
        let way = self.waits_for_way(station, first.offset, every);
        let sum = DEFAULT_LEAD + air + way;
        if every >= sum {
            return Ok(());
        }
        let of_way = match way {
            Span::ZERO => String::new(),
            way => format!(" + {way} of its way forth and back that is not free behind the slot"),
        };
        let cycle = Span::from_nanos((sum.nanos() + period - 1) / period);
        let what = format!(
            "'{name}' would never be locked: it calibrates in its slot {id}, every {every}, and a round takes {DEFAULT_LEAD} by \
             which jobs are chosen before their instants + {air} of a request on the air{of_way} = {sum}; a cycle of {cycle} or \
             longer would do"
        );
        Err(Unfit { station: name.clone(), slot: id, what })
    }

    /// A station that has chosen what it sends hears nothing until then: it has the sync of a cycle before it chooses the first
    /// turn of the next, or has sent in that cycle when that sync was there. Else two syncs are missing, and it is silent.
    fn check_hears(&self, station: &StationPlan) -> Result<(), Unfit> {
        let Some(first) = station.slots.iter().min_by_key(|slot| slot.offset) else { return Ok(()) };
        let arrives = self.conditions.way() + air(self.rate);
        let always = station.slots.iter().filter(|slot| slot.period == 1).map(|slot| slot.offset).max();
        let chosen = first.offset + self.cycle - DEFAULT_LEAD;
        if arrives <= chosen.max(always.unwrap_or(chosen)) {
            return Ok(());
        }
        let (name, id, offset, short) = (&station.name, first.id, first.offset, arrives - chosen);
        let what = format!(
            "'{name}' would be silent in its slot {id}: what it sends there is chosen {DEFAULT_LEAD} before it begins at {offset}, and \
             the sync of the cycle before comes {short} later than that, on its way for {arrives} with its time on the air; a cycle \
             of {} or longer would do",
            self.cycle + short
        );
        Err(Unfit { station: name.clone(), slot: id, what })
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
