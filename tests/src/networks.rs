//! Networks in virtual time: a master, its slaves, their slots and clocks, and a judge on the medium.

use std::cell::{Ref, RefCell};
use std::rc::Rc;
use std::sync::Arc;

use rtmac::tdma::schedule::{self, Rate};
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, RoleConfig, SlaveConfig, SlotConfig, Tdma,
    TdmaConfig, TdmaStatus,
};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Discipline, Event, EventKind, SyncState};
use rtnet::sim::{Host, Medium, Member, Network, Random, StationId};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::{Address, HEADER_LEN};

use crate::judge::{Judge, Layout};
use crate::mixed::{Mixed, MixedStatus};
use crate::peer::{Peer, PeerConfig, PeerSlot, PeerStatus};
use crate::traffic::{Tally, TestTraffic};

/// What a network is to be like. Station 0 is the master.
#[derive(Clone, Debug)]
pub struct Plan {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// The Synchronisation's share of it.
    pub sync_window: Span,
    /// The medium.
    pub medium: Medium,
    /// Bytes behind the Ethernet header of every data frame.
    pub payload: usize,
    /// Each station's slot; one of them for every station.
    pub offsets: Vec<Span>,
    /// From a slot's begin to its end.
    pub slot: Span,
    /// How late a slot may be used.
    pub latest: Span,
    /// How far the judge lets a frame leave its slot.
    pub tolerance: Span,
    /// Every station's host.
    pub host: Host,
    /// Each station's drift in parts per billion; the last one for all others.
    pub drift_ppb: Vec<i64>,
    /// Calibration rounds.
    pub rounds: u32,
    /// Stations that are peers.
    pub peers: Vec<StationId>,
    /// Everything random follows from it.
    pub seed: u64,
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

impl Plan {
    /// Slots that divide what the sync window leaves of a cycle of 1 ms evenly, as `lab run` does.
    pub fn evenly(stations: usize) -> Plan {
        let (cycle, sync_window) = (Span::from_millis(1), Span::from_micros(60));
        let (medium, payload) = (Medium::default(), 64);
        let rate = Rate::from_bits_per_second(medium.rate);
        let slot = schedule::divide(cycle, sync_window, rate, stations, payload, None).expect("they fit");
        let guard = slot - rate.air_time(payload + HEADER_LEN);
        Plan {
            cycle,
            sync_window,
            medium,
            payload,
            offsets: (0..stations as i64).map(|i| sync_window + slot * i).collect(),
            slot,
            latest: schedule::latest(guard),
            tolerance: Span::ZERO,
            host: Host::IDEAL,
            drift_ppb: vec![0],
            rounds: 10,
            peers: Vec::new(),
            seed: 1,
        }
    }

    /// Frames of full size, back to back but for `guard`, the last one up to the very end of the cycle.
    pub fn at_the_end(stations: usize, guard: Span) -> Plan {
        let plan = Plan::evenly(stations);
        let payload = 1_500;
        let slot = Span::from_nanos(plan.medium.air_time(payload + HEADER_LEN) as i64) + guard;
        let first = plan.cycle - slot * stations as i64;
        let offsets = (0..stations as i64).map(|i| first + slot * i).collect();
        Plan { payload, offsets, slot, latest: Span::ZERO, ..plan }
    }

    /// The same on hosts like this one; the judge allows what the clocks may be wrong by.
    pub fn on(self, host: Host) -> Plan {
        let air = Span::from_nanos(self.medium.air_time(self.payload + HEADER_LEN) as i64);
        Plan { host, tolerance: schedule::clock_share(self.slot - air), ..self }
    }

    /// Address of a station.
    pub fn address(&self, id: StationId) -> Address {
        Address([2, 0, 0, 0, (id >> 8) as u8, id as u8 + 1])
    }

    /// How many stations.
    pub fn stations(&self) -> usize {
        self.offsets.len()
    }

    /// Builds it: the master starts at once, the others within 10 ms.
    pub fn build(&self) -> Lab {
        let mut lab = self.build_without_slaves();
        let mut random = Random::new(self.seed ^ 0x57a7);
        for _ in 1..self.stations() {
            lab.add_next(random.below(10_000_000));
        }
        lab
    }

    /// Builds it with the master alone; [`Lab::add_next`] adds the others.
    pub fn build_without_slaves(&self) -> Lab {
        let mut random = Random::new(self.seed);
        let drift = |i: usize| self.drift_ppb.get(i).or(self.drift_ppb.last()).copied().unwrap_or(0);
        let clocks: Vec<EmulatedClock> = (0..self.stations())
            .map(|i| {
                let offset = Span::from_nanos(random.between(0, 999_999_999));
                EmulatedClock { anchor: 0, offset, drift_ppb: drift(i) }
            })
            .collect();
        let judge = Rc::new(RefCell::new(Judge::new(Layout {
            cycle: self.cycle,
            sync_window: self.sync_window,
            slot: self.slot,
            tolerance: self.tolerance,
            offsets: self.offsets.clone(),
            addresses: (0..self.stations()).map(|id| self.address(id)).collect(),
            clock: clocks[0],
            epoch: if self.peers.contains(&0) { Offset::default() } else { epoch() },
        })));
        let mut network = Network::new(self.medium, self.seed);
        let watching = judge.clone();
        network.observe(move |aired| watching.borrow_mut().see(aired));
        let plan = self.clone();
        let mut lab = Lab { plan, network, clocks, events: Vec::new(), tallies: Vec::new(), judge };
        lab.add_next(0);
        lab
    }
}

impl Lab {
    /// Adds the next station of the plan, to start at true time `at`.
    pub fn add_next(&mut self, at: u64) -> StationId {
        let id = self.tallies.len();
        let role = (id == 0).then_some(self.plan.cycle);
        self.add(id, role, at)
    }

    /// Adds a station with the address, clock and slot of station `id` of the plan; with a cycle, as a
    /// master.
    pub fn add(&mut self, id: StationId, master: Option<Span>, at: u64) -> StationId {
        let plan = &self.plan;
        let to = plan.address((id + 1) % plan.stations());
        let traffic =
            TestTraffic { payload: plan.payload, ..TestTraffic::new(id as u16, plan.address(id), to) };
        self.tallies.push(traffic.tally.clone());
        let discipline = if plan.peers.contains(&id) { plan.peer(id, master) } else { plan.ours(id, master) };
        let station = Station::new(discipline, vec![Box::new(traffic)]);
        let (address, clock, host) = (plan.address(id), self.clocks[id], plan.host);
        self.network.add(Member { address, clock, host, station }, at)
    }

    /// Lets so many cycles of true time pass, and takes the events.
    pub fn run_cycles(&mut self, cycles: u64) {
        let cycle = self.plan.cycle.nanos() as u64;
        let end = self.network.now() + cycles * cycle;
        while self.network.now() < end {
            self.network.run_until(end.min(self.network.now() + 100 * cycle));
            for id in 0..self.tallies.len() {
                let discipline = self.network.member_mut(id).station.discipline_mut();
                while let Some(event) = discipline.next_event() {
                    self.events.push((id, event));
                }
            }
        }
    }

    /// Runs until all stations are locked, and up to the end of a cycle; panics after 10 000.
    pub fn run_until_locked(&mut self) {
        let all = |lab: &Lab| (0..lab.tallies.len()).all(|id| lab.state(id) == SyncState::Locked);
        for _ in 0..100 {
            self.run_cycles(100);
            if all(self) {
                let almost_a_cycle = self.plan.cycle.nanos() as u64 * 9 / 10;
                return self.network.run_until(self.network.now() + almost_a_cycle);
            }
        }
        panic!("not all stations are locked after 10 000 cycles");
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

    /// Cycles in which something of this kind happened at a station.
    pub fn cycles_with(&self, id: StationId, kind: EventKind) -> Vec<u32> {
        let of_it = self.events.iter().filter(|(of, event)| *of == id && event.kind == kind);
        of_it.map(|(_, event)| event.cycle).collect()
    }
}

impl Plan {
    fn ours(&self, id: StationId, master: Option<Span>) -> Mixed {
        let slot = SlotConfig {
            id: 0,
            offset: self.offsets[id],
            phase: 0,
            period: 1,
            size: self.payload,
            latest: self.latest,
        };
        let role = match master {
            Some(cycle) => RoleConfig::Master(MasterConfig {
                cycle,
                sync_latest: self.sync_window / 2,
                reply_latest: self.latest,
                epoch: epoch(),
                resume: None,
            }),
            None => RoleConfig::Slave(SlaveConfig { rounds: self.rounds, step_limit: None }),
        };
        let tdma = Tdma::new(&TdmaConfig {
            address: self.address(id),
            role,
            slots: vec![slot],
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        });
        Mixed::Ours(Box::new(tdma.expect("the plan is sound")))
    }

    fn peer(&self, id: StationId, master: Option<Span>) -> Mixed {
        let slot = PeerSlot { id: 0, offset: self.offsets[id], phase: 0, period: 1, size: self.payload };
        Mixed::Peer(Box::new(Peer::new(PeerConfig {
            address: self.address(id),
            master,
            rounds: self.rounds,
            slots: vec![slot],
            lead: DEFAULT_LEAD,
        })))
    }
}

fn epoch() -> Offset {
    Offset::between(Instant::default(), EPOCH)
}
