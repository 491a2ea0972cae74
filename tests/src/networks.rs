//! Networks in virtual time: a master, its slaves, their slots and clocks, and a judge on the medium.

use std::cell::{Ref, RefCell};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use clap::Parser;
use rtmac::tdma::change::ChangeConfig;
use rtmac::tdma::schedule;
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_REQUESTS, DEFAULT_MAX_SLOT_ID, MasterConfig, RoleConfig, Servo, SlaveConfig,
    Tdma, TdmaCommand, TdmaConfig, TdmaStatus,
};
use rtnet::clock::{EmulatedClock, True};
use rtnet::discipline::{Discipline, Event, EventKind, SyncState};
use rtnet::sim::{Host, Medium, Member, Network, Random, StationId};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::{Address, HEADER_LEN};
use tools::cli::{Cli, LabMeasureArgs, LabRunArgs, LabVerb, Verb};
use tools::scenario::{DelayName, Scenario, SlotPlan, StationPlan, Uniform, room_for_replies};
use tools::station::sync_latest;

use crate::judge::{Judge, Layout};
use crate::mixed::{Mixed, MixedStatus};
use crate::peer::{Peer, PeerConfig, PeerSlot, PeerStatus};
use crate::seeds;
use crate::traffic::{Tally, TestTraffic};

/// What a network is to be like. Station 0 is the master.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Cycle, sync window, slots, clocks and calibration rounds: what a lab would stand up.
    pub scenario: Scenario,
    /// The medium, at the scenario's rate.
    pub medium: Medium,
    /// How far the judge lets a frame leave its slot.
    pub tolerance: Span,
    /// Every station's host.
    pub host: Host,
    /// Stations that are peers.
    pub peers: Vec<StationId>,
    /// Who is a backup master, peers or ours, and how long after a cycle's start it takes over.
    pub backups: Vec<(StationId, Span)>,
    /// How ours follow, but for the rounds, the servo and what is a time step, which the scenario has.
    pub follow: SlaveConfig,
    /// How many calibration requests ours answer at a time.
    pub max_requests: usize,
    /// Who follows without a filter, whatever the scenario says.
    pub without_filter: Vec<StationId>,
    /// What cycle it is when station 0 is started; also when it is started anew, later by as much as was between. `None`:
    /// each time a new grid begins.
    pub first_cycle: Option<u32>,
    /// Whether ours take part in changes of the schedule.
    pub changes: bool,
}

/// A network, and what is known of it from outside.
pub struct Lab {
    /// What it is like.
    pub plan: Plan,
    /// The stations on their medium.
    pub network: Network<Mixed>,
    /// Each station's clock.
    pub clocks: Vec<EmulatedClock>,
    /// What happened, by station.
    pub events: Vec<(StationId, Event)>,
    /// What each station's traffic counted.
    pub tallies: Vec<Arc<Tally>>,
    judge: Rc<RefCell<Judge>>,
}

/// When the master's clock shows 0, it is this late in global time.
const EPOCH: GlobalTime = GlobalTime::from_nanos(1_795_000_000_000_000_000);
/// True time when a network begins: no clock is so far behind that it shows less than 0.
const UPTIME: True = 10_000_000_000;

impl Plan {
    /// The network of `lab run --stations N --cycle 1ms`, on hosts that are never late.
    pub fn lab(stations: usize) -> Plan {
        Plan::of(&Plan::lab_options(stations))
    }

    /// What `lab run --stations N --cycle 1ms` is told, with a seed that is drawn from the commit's date.
    pub fn lab_options(stations: usize) -> Uniform {
        let line = format!("rtnet lab run --stations {stations} --cycle 1ms");
        let verb = Cli::parse_from(line.split(' ')).verb;
        let Verb::Lab(LabVerb::Run(LabMeasureArgs { run, .. })) = verb else {
            panic!("{line}");
        };
        let LabRunArgs { cycle, payload, rate, guard, .. } = run;
        Uniform {
            stations,
            cycle,
            duration: Span::from_millis(10_000),
            payload,
            rate,
            guard,
            seed: seeds::one("Plan::lab"),
            vnic: None,
        }
    }

    /// The network that a lab with these options would be.
    pub fn of(options: &Uniform) -> Plan {
        Plan::of_scenario(options.scenario().expect("such a lab can be"))
    }

    /// The same of any network.
    pub fn of_scenario(scenario: Scenario) -> Plan {
        let medium = Medium { rate: scenario.rate.bits_per_second(), ..Medium::default() };
        let (tolerance, host) = (Span::ZERO, Host::IDEAL);
        let (peers, backups, follow) = (Vec::new(), Vec::new(), SlaveConfig::default());
        let (max_requests, without_filter, first_cycle) = (DEFAULT_MAX_REQUESTS, Vec::new(), None);
        let changes = false;
        Plan {
            scenario,
            medium,
            tolerance,
            host,
            peers,
            backups,
            follow,
            max_requests,
            without_filter,
            first_cycle,
            changes,
        }
    }

    /// The same with clocks that run at these rates, in parts per billion; how far apart they begin stays.
    pub fn with_drift(mut self, drift_ppb: impl Fn(StationId) -> i64) -> Plan {
        for (id, station) in self.scenario.stations.iter_mut().enumerate() {
            station.clock_drift_ppb = drift_ppb(id);
        }
        self
    }

    /// Largest offset between the grid and that of a master that was away for `cycles`: the largest drift of a station's
    /// clock from the master's in this time.
    pub fn moved_without_master(&self, cycles: u32) -> Span {
        let drifts = self.scenario.stations.iter().map(|station| station.clock_drift_ppb);
        let master = drifts.clone().next().unwrap_or(0);
        let fastest = drifts.map(|drift| (drift - master).abs()).max().unwrap_or(0);
        Span::from_nanos(self.cycle().nanos() * i64::from(cycles) / 1_000_000 * fastest / 1_000 + 1)
    }

    /// The same with so many calibration rounds for each slave.
    pub fn with_rounds(mut self, rounds: u32) -> Plan {
        self.scenario.stations.iter_mut().for_each(|station| station.rounds = rounds);
        self
    }

    /// The same on hosts like this one; the judge allows what the clocks may be wrong by.
    pub fn on(self, host: Host) -> Plan {
        Plan { host, tolerance: self.scenario.clock_share(), ..self }
    }

    /// The same with these backups, whose Synchronisations are between the primary's window of 50 us and the slots.
    pub fn with_backups(mut self, backups: &[(StationId, Span)]) -> Plan {
        self.backups = backups.to_vec();
        self.scenario.sync_window = Span::from_micros(50);
        self
    }

    /// Address of a station.
    pub fn address(&self, id: StationId) -> Address {
        self.scenario.address(id)
    }

    /// How many stations.
    pub fn stations(&self) -> usize {
        self.scenario.stations.len()
    }

    /// From one cycle's start to the next.
    pub fn cycle(&self) -> Span {
        self.scenario.cycle
    }

    /// Calibration rounds of each slave.
    pub fn rounds(&self) -> u64 {
        self.scenario.stations[1].rounds.into()
    }

    /// Builds it: the master starts at once, the others within 10 ms.
    pub fn build(&self) -> Lab {
        let mut lab = self.build_without_slaves();
        let mut random = Random::new(self.scenario.seed ^ 0x57a7);
        for _ in 1..self.stations() {
            lab.add_next(lab.network.now() + random.below(10_000_000));
        }
        lab
    }

    /// Builds it with the master alone; [`Lab::add_next`] adds the others.
    pub fn build_without_slaves(&self) -> Lab {
        let clocks: Vec<EmulatedClock> = (0..self.stations()).map(|id| self.clock(id)).collect();
        let judge = Rc::new(RefCell::new(Judge::new(self.layout(clocks[0]))));
        let mut network = Network::new(self.medium, self.scenario.seed);
        network.run_until(UPTIME);
        let watching = judge.clone();
        network.observe(move |aired| watching.borrow_mut().see(aired));
        let plan = self.clone();
        let mut lab = Lab { plan, network, clocks, events: Vec::new(), tallies: Vec::new(), judge };
        lab.add_next(UPTIME);
        lab
    }

    /// A station's clock.
    pub fn clock(&self, id: StationId) -> EmulatedClock {
        let station = &self.scenario.stations[id];
        let (offset, drift_ppb) = (station.clock_offset, station.clock_drift_ppb);
        EmulatedClock { anchor: UPTIME, offset, drift_ppb }
    }

    fn layout(&self, master: EmulatedClock) -> Layout {
        let Scenario { cycle, sync_window, rate, guard, stations, .. } = &self.scenario;
        Layout {
            cycle: *cycle,
            sync_window: *sync_window
                + self.backups.iter().map(|&(_, after)| after).max().unwrap_or(Span::ZERO),
            slot: rate.air_time(stations[0].payload + HEADER_LEN) + *guard,
            tolerance: self.tolerance,
            offsets: stations.iter().map(|station| station.slots[0].offset).collect(),
            periods: stations.iter().map(|station| station.slots[0].period).collect(),
            addresses: (0..self.stations()).map(|id| self.address(id)).collect(),
            clock: master,
            epoch: if self.peers.contains(&0) { Offset::default() } else { epoch() },
        }
    }
}

impl Lab {
    /// Adds the next station of the plan, to start at true time `at`.
    pub fn add_next(&mut self, at: u64) -> StationId {
        let id = self.tallies.len();
        let role = (id == 0).then_some(self.plan.cycle());
        self.add(id, role, at)
    }

    /// Adds a station with the address, clock and slot of station `id` of the plan; with a cycle, as a
    /// master.
    pub fn add(&mut self, id: StationId, master: Option<Span>, at: u64) -> StationId {
        let plan = &self.plan;
        let (to, payload) = (plan.scenario.receiver(id), plan.scenario.stations[id].payload);
        let traffic = TestTraffic::new(id as u16, plan.address(id), plan.address(to));
        let traffic = TestTraffic { payload, ..traffic };
        self.tallies.push(traffic.tally.clone());
        let discipline = if plan.peers.contains(&id) { plan.peer(id, master) } else { plan.ours(id, master) };
        let station = Station::new(discipline, vec![Box::new(traffic)]);
        let (address, clock, host) = (plan.address(id), self.clocks[id], plan.host.clone().into());
        self.network.add(Member { address, clock, host, station }, at)
    }

    /// Lets so many cycles of true time pass, and takes the events.
    pub fn run_cycles(&mut self, cycles: u64) {
        let cycle = self.plan.cycle().nanos() as u64;
        let end = self.network.now() + cycles * cycle;
        while self.network.now() < end {
            self.network.run_until(end.min(self.network.now() + 100 * cycle));
            self.take_events();
        }
    }

    /// Takes what stations tell.
    pub fn take_events(&mut self) {
        for id in 0..self.tallies.len() {
            let discipline = self.network.member_mut(id).station.discipline_mut();
            while let Some(event) = discipline.next_event() {
                self.events.push((id, event));
            }
        }
    }

    /// Runs until all stations are locked, and up to the end of a cycle; panics after 10 000.
    pub fn run_until_locked(&mut self) {
        let all = |lab: &Lab| (0..lab.tallies.len()).all(|id| lab.state(id) == SyncState::Locked);
        for _ in 0..100 {
            self.run_cycles(100);
            if all(self) {
                let almost_a_cycle = self.plan.cycle().nanos() as u64 * 9 / 10;
                return self.network.run_until(self.network.now() + almost_a_cycle);
            }
        }
        panic!("not all stations are locked after 10 000 cycles");
    }

    /// Asks a station for something; from which cycle on it holds, or why not.
    pub fn command(&mut self, id: StationId, mut command: TdmaCommand) -> Result<u32, String> {
        let now = self.clocks[id].local(self.network.now());
        self.network.member_mut(id).station.discipline_mut().command(now, &mut command)
    }

    /// What the judge has seen.
    pub fn judge(&self) -> Ref<'_, Judge> {
        self.judge.borrow()
    }

    /// Forgets what the judge has counted so far, not where the grid is.
    pub fn judge_from_here(&mut self) {
        self.judge.borrow_mut().start_over();
        self.events.clear();
    }

    /// How far a station is with the master's time.
    pub fn state(&self, id: StationId) -> SyncState {
        self.network.member(id).station.discipline().time().state
    }

    /// Status of a station that is ours.
    pub fn status(&self, id: StationId) -> TdmaStatus {
        match self.network.member(id).station.discipline().status() {
            MixedStatus::Ours(status) => status,
            MixedStatus::Peer(_) => panic!("station {id} is a peer"),
        }
    }

    /// Status of a station that is a peer.
    pub fn peer_status(&self, id: StationId) -> PeerStatus {
        match self.network.member(id).station.discipline().status() {
            MixedStatus::Peer(status) => status,
            MixedStatus::Ours(_) => panic!("station {id} is no peer"),
        }
    }

    /// By how much a station's last slot began later than the master's clock had it, in true time, host aside.
    pub fn line_error(&self, id: StationId) -> Span {
        let tally = &self.tallies[id];
        let begin = Instant::from_nanos(tally.begin.load(Relaxed));
        let scheduled = GlobalTime::from_nanos(tally.scheduled.load(Relaxed));
        let [here, there] = [(id, begin), (0, epoch().local(scheduled))];
        let truth = |(id, at): (StationId, Instant)| Instant::from_nanos(self.clocks[id].truth(at));
        truth(here) - truth(there)
    }

    /// Cycles in which something of this kind happened at a station.
    pub fn cycles_with(&self, id: StationId, kind: EventKind) -> Vec<u32> {
        let of_it = self.events.iter().filter(|(of, event)| *of == id && event.kind == kind);
        of_it.map(|(_, event)| event.cycle).collect()
    }
}

impl Plan {
    /// As `rtnet station` is told by a lab; with a cycle, a master.
    pub fn ours(&self, id: StationId, master: Option<Span>) -> Mixed {
        let scenario = &self.scenario;
        let slots = scenario.stations[id].slots.iter().map(|slot| scenario.slot_config(slot));
        let rounds = scenario.stations[id].rounds;
        let step_limit = Some(schedule::step_limit(scenario.guard));
        let servo = if self.without_filter.contains(&id) { Servo::None } else { scenario.servo.servo() };
        let delay_of = scenario.delay.map(DelayName::delay_of).or(self.follow.delay_of);
        let follow = SlaveConfig { rounds, step_limit, servo, delay_of, ..self.follow };
        let begins = |cycle| (cycle, epoch().global(self.clock(id).local(UPTIME)));
        let role = match master.or(self.backup(id).map(|_| self.cycle())) {
            Some(cycle) => RoleConfig::Master(MasterConfig {
                cycle,
                sync_latest: sync_latest(scenario.sync_window),
                reply_latest: scenario.latest(),
                epoch: epoch(),
                resume: self.first_cycle.filter(|_| id == 0).map(begins),
                backup: self.backup(id),
                backups_from: self.backups.iter().map(|&(_, after)| after).min(),
                max_requests: self.max_requests,
                behind_sync: room_for_replies(scenario.sync_window, scenario.rate),
                follow,
            }),
            None => RoleConfig::Slave(follow),
        };
        let tdma = Tdma::new(&TdmaConfig {
            address: self.address(id),
            role,
            slots: slots.collect(),
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: scenario.late,
        });
        let tdma = tdma.expect("the plan is sound");
        Mixed::Ours(Box::new(if self.changes { tdma.with_changes(&self.change_config()) } else { tdma }))
    }

    /// What ours are told of the schedule: peers know of no changes, and are not in it.
    pub fn change_config(&self) -> ChangeConfig {
        let mut ours = self.scenario.clone();
        for &id in &self.peers {
            ours.stations[id].slots.clear();
        }
        let config = ours.change_config().expect("there is room behind the Synchronisations");
        let masters = self.backups.iter().map(|&(id, _)| id).chain([0]).map(|id| self.address(id));
        ChangeConfig { masters: masters.collect(), ..config }
    }

    fn backup(&self, id: StationId) -> Option<Span> {
        self.backups.iter().find(|(backup, _)| *backup == id).map(|&(_, after)| after)
    }

    fn peer(&self, id: StationId, master: Option<Span>) -> Mixed {
        let StationPlan { rounds, slots, .. } = &self.scenario.stations[id];
        let backup = self.backup(id);
        Mixed::Peer(Box::new(Peer::new(PeerConfig {
            address: self.address(id),
            master: master.or(backup.map(|_| self.cycle())),
            backup,
            rounds: *rounds,
            slots: slots.iter().map(peer_slot).collect(),
            lead: DEFAULT_LEAD,
        })))
    }
}

fn peer_slot(slot: &SlotPlan) -> PeerSlot {
    let &SlotPlan { id, offset, phase, period, size, .. } = slot;
    PeerSlot { id, offset, phase, period, size }
}

/// From the master's clock to global time.
pub fn epoch() -> Offset {
    Offset::between(Instant::default(), EPOCH)
}
