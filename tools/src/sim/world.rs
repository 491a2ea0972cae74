//! From a scenario to its stations in virtual time.

use std::collections::BTreeMap;
use std::ops::Sub;
use std::sync::Arc;

use anyhow::{Result, anyhow};
use rtmac::tdma::change::ChangeConfig;
use rtmac::tdma::schedule;
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_REQUESTS, DEFAULT_MAX_SLOT_ID, MasterConfig, RoleConfig, SlaveConfig, Tdma,
    TdmaConfig,
};
use rtnet::clock::{EmulatedClock, True};
use rtnet::counters::Refusal;
use rtnet::discipline::Discipline;
use rtnet::sim::{Host, Link, Medium, Member, Network, Wander};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Offset, Span};

use crate::judge::analysis::Analysis;
use crate::judge::givers::{TrueMaster, same_time};
use crate::report::figures::Role;
use crate::scenario::{Conditions, DelayName, Scenario, Wandering, Wire, room_for_replies};
use crate::station::sync_latest;
use crate::station::traffic::{Arrivals, Traffic, TrafficCounts, TrafficPlan};

/// True time when a network begins: no clock of a file is so far behind that it shows less than 0.
pub const UPTIME: True = 7_200_000_000_000;
/// Global time then: an instant of 2026, so that captures look like captures.
pub const EPOCH: GlobalTime = GlobalTime::from_nanos(1_795_000_000_000_000_000);

/// By how much a kernel guard lets a frame be later than it may.
const GUARD_TOLERANCE: Span = Span::from_micros(10);

/// What a station has counted, or how much more than at another time.
#[derive(Clone, Debug, Default)]
pub struct Counted {
    /// Frames that were not what was sent.
    pub payload_errors: i64,
    /// Frames missing between those that it received.
    pub missing: i64,
    /// Events that it could not tell of.
    pub events_lost: i64,
    /// Frames of its program that found no room in their queue, by priority.
    queue_refused: BTreeMap<u8, i64>,
}

impl Sub<&Counted> for Counted {
    type Output = Counted;
    fn sub(mut self, other: &Counted) -> Counted {
        for (priority, n) in &other.queue_refused {
            *self.queue_refused.entry(*priority).or_default() -= n;
        }
        Counted {
            payload_errors: self.payload_errors - other.payload_errors,
            missing: self.missing - other.missing,
            events_lost: self.events_lost - other.events_lost,
            queue_refused: self.queue_refused,
        }
    }
}

/// A network and what its stations count.
pub struct World {
    /// Its stations on their medium.
    pub network: Network<Tdma>,
    /// What each station's traffic counts.
    pub counts: Vec<Arc<TrafficCounts>>,
    /// The time of its master.
    pub truth: TrueMaster,
    /// What all stations know of its schedule, in common: it is as long as there are stations.
    changes: Option<ChangeConfig>,
}

impl World {
    /// All stations; those that are there begin now.
    pub fn new(scenario: &Scenario, is_there: impl Fn(usize) -> bool) -> Result<Self> {
        let master = clock(scenario, 0);
        let truth = TrueMaster { clock: master, epoch: Offset::between(master.local(UPTIME), EPOCH) };
        let counts: Vec<_> = (0..scenario.stations.len()).map(|id| traffic_counts(scenario, id)).collect();
        let changes = scenario.change_config().map(|config| ChangeConfig { is_reserved: false, ..config });
        let station =
            |id: usize| station(scenario, id, (&truth, changes.as_ref()), None, counts[id].clone(), 0);
        let network = network(scenario, is_there, station)?;
        Ok(Self { network, counts, truth, changes })
    }

    /// What a station's process has counted so far.
    pub fn counted(&self, id: usize) -> Counted {
        let station = &self.network.member(id).station;
        Counted::of(station, &self.counts[id], station.discipline().status().events_lost)
    }

    /// Of what comes to each station, what is sent from now on counts, or does not any more.
    pub fn bound_deliveries(&self, scenario: &Scenario, analysis: &Analysis, bound: fn(&Arrivals, u64)) {
        for (id, counts) in self.counts.iter().enumerate() {
            let sender = scenario.sender(id);
            let passed = |of| analysis.stations[sender].passed(of);
            let streams = scenario.streams(sender).filter_map(|of| counts.arrivals(of).zip(passed(of)));
            streams.for_each(|(arrivals, passed)| bound(arrivals, passed.next()));
        }
    }

    /// A station with its test traffic, whose first frame has this number; a master goes on with a grid, if there is one.
    pub fn station(
        &self,
        scenario: &Scenario,
        id: usize,
        grid: Option<(u32, GlobalTime)>,
        first: u64,
    ) -> Result<Station<Tdma>> {
        station(scenario, id, (&self.truth, self.changes.as_ref()), grid, self.counts[id].clone(), first)
    }
}

impl Counted {
    /// Frames of its program that found no room in their queue, by priority.
    pub fn refused(&self) -> impl Iterator<Item = (u8, u64)> {
        self.queue_refused.iter().map(|(priority, n)| (*priority, (*n).max(0) as u64))
    }

    /// Of a station, its traffic, and how many events it lost.
    pub fn of<D: Discipline>(station: &Station<D>, counts: &TrafficCounts, events_lost: u64) -> Self {
        let queued = counts.arrived_queued().map(|(_, arrived)| arrived.missing);
        let missing = counts.arrived(None).missing + queued.sum::<u64>();
        Self {
            payload_errors: station.refusals().get(Refusal::BadPayload) as i64,
            missing: missing as i64,
            events_lost: events_lost as i64,
            queue_refused: counts.refused().map(|(priority, n)| (priority, n as i64)).collect(),
        }
    }
}

fn station(
    scenario: &Scenario,
    id: usize,
    (truth, changes): (&TrueMaster, Option<&ChangeConfig>),
    grid: Option<(u32, GlobalTime)>,
    counts: Arc<TrafficCounts>,
    first: u64,
) -> Result<Station<Tdma>> {
    let epoch = same_time(truth, &clock(scenario, id));
    let config = discipline(scenario, id, epoch, grid);
    let tdma =
        Tdma::new(&config).map_err(|why| anyhow!("station '{}': {why}", scenario.stations[id].name))?;
    let tdma = match changes {
        Some(changes) => tdma.with_changes(changes),
        None => tdma,
    };
    Ok(Station::new(tdma, vec![Box::new(traffic(scenario, id, counts, first))]))
}

/// Counts for the test traffic of a station.
pub fn traffic_counts(scenario: &Scenario, id: usize) -> Arc<TrafficCounts> {
    Arc::new(TrafficCounts::of(&scenario.flow_plan(id)))
}

/// The test traffic of a station, whose first frame has this number.
pub fn traffic(scenario: &Scenario, id: usize, counts: Arc<TrafficCounts>, first: u64) -> Traffic {
    let sender = scenario.sender(id);
    let plan = TrafficPlan {
        station: id as u16,
        source: scenario.address(id),
        destination: scenario.address(scenario.receiver(id)),
        from: sender as u16,
        payload: scenario.stations[id].payload,
        from_payload: scenario.stations[sender].payload,
        first,
    };
    Traffic::new(plan, counts).with_flows(scenario.flow_plan(id))
}

/// A scenario's stations on their medium, with their hosts, wires and clocks; those that are there begin now.
pub fn network<D: Discipline>(
    scenario: &Scenario,
    is_there: impl Fn(usize) -> bool,
    station: impl Fn(usize) -> Result<Station<D>>,
) -> Result<Network<D>> {
    let conditions = &scenario.conditions;
    let mut medium =
        Medium { rate: scenario.rate.bits_per_second(), joint: conditions.joint, ..Medium::default() };
    if let Some(propagation) = conditions.propagation {
        medium.propagation = propagation;
    }
    let mut network = Network::new(medium, scenario.seed);
    network.run_until(UPTIME);
    let mut hosts = Vec::new();
    for id in 0..scenario.stations.len() {
        let station = station(id)?;
        let (address, clock) = (scenario.address(id), clock(scenario, id));
        let guard = scenario.is_guarded().then_some(GUARD_TOLERANCE);
        let host = shared(&mut hosts, Host { guard, ..conditions.host(id).clone() });
        network.add(Member { address, clock, host, station }, UPTIME);
        if !is_there(id) {
            network.stop(id);
        }
    }
    if !conditions.wires.is_empty() {
        let all: Vec<usize> = (0..scenario.stations.len()).collect();
        set_wires(&mut network, conditions, &all, None);
    }
    for &(id, wandering) in &conditions.wanders {
        network.wander(id, wander(&wandering, clock_drift(scenario, id)));
    }
    Ok(network)
}

/// The same as an equal one that is known, or one more of those.
fn shared(known: &mut Vec<Arc<Host>>, host: Host) -> Arc<Host> {
    let equal = known.iter().find(|other| ***other == host).cloned();
    equal.unwrap_or_else(|| {
        known.push(Arc::new(host));
        known[known.len() - 1].clone()
    })
}

/// What the wires of these stations do from now on: as they do throughout, or as an event says besides.
pub fn set_wires<D: Discipline>(
    network: &mut Network<D>,
    conditions: &Conditions,
    stations: &[usize],
    event: Option<&Wire>,
) {
    for (id, [sends, hears]) in conditions.links(stations, event) {
        let (sends_by, hears_by) = network.wire_mut(id);
        // A wire that is out stays out.
        *sends_by = Link { down: sends_by.down, ..sends };
        *hears_by = Link { down: hears_by.down, ..hears };
    }
}

/// How a clock wanders around a rate error in parts per billion.
pub fn wander(&Wandering { every, step_ppb, within_ppb }: &Wandering, around_ppb: i64) -> Wander {
    Wander { every, step_ppb, within_ppb, around_ppb }
}

/// A station's clock as it begins.
pub fn clock(scenario: &Scenario, id: usize) -> EmulatedClock {
    EmulatedClock {
        anchor: UPTIME,
        offset: scenario.stations[id].clock_offset,
        drift_ppb: clock_drift(scenario, id),
    }
}

fn clock_drift(scenario: &Scenario, id: usize) -> i64 {
    scenario.stations[id].clock_drift_ppb
}

/// A station's discipline, as a lab's station has it.
pub fn discipline(
    scenario: &Scenario,
    id: usize,
    epoch: Offset,
    resume: Option<(u32, GlobalTime)>,
) -> TdmaConfig {
    let plan = &scenario.stations[id];
    let follow = SlaveConfig {
        rounds: plan.rounds,
        step_limit: Some(schedule::step_limit(scenario.guard)),
        servo: scenario.servo.servo(),
        delay_of: scenario.delay.map(DelayName::delay_of),
        ..SlaveConfig::default()
    };
    let role = if plan.role == Role::Slave {
        RoleConfig::Slave(follow)
    } else {
        RoleConfig::Master(MasterConfig {
            cycle: scenario.cycle,
            sync_latest: sync_latest(scenario.sync_window),
            reply_latest: scenario.latest(),
            epoch,
            resume,
            backup: plan.backup,
            backups_from: scenario.stations.iter().filter_map(|station| station.backup).min(),
            max_requests: DEFAULT_MAX_REQUESTS,
            behind_sync: room_for_replies(scenario.sync_window, scenario.rate),
            follow,
        })
    };
    TdmaConfig {
        address: scenario.address(id),
        role,
        slots: plan.slots.iter().map(|slot| scenario.slot_config(slot)).collect(),
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: scenario.late,
    }
}

#[cfg(test)]
mod tests {
    use rtmac::tdma::schedule::Rate;

    use super::*;
    use crate::scenario::Uniform;

    #[test]
    fn stations_share_the_schedule_that_they_begin_with() {
        let uniform = Uniform {
            stations: 5,
            cycle: Span::from_millis(1),
            duration: Span::from_millis(10),
            payload: 64,
            rate: Rate::from_bits_per_second(1_000_000_000),
            guard: None,
            seed: 1,
            vnic: None,
        };
        let world = World::new(&uniform.scenario().unwrap(), |_| true).unwrap();
        let first = world.changes.and_then(|changes| changes.first).expect("it can be changed");
        // One of each station, and this one: with a copy each, a thousand stations take 48 MB for it.
        assert_eq!(Arc::strong_count(&first), 5 + 1);
    }
}
