//! The network of a lab's file in virtual time: the stations and the traffic that a lab would start, and the analysis
//! that it would judge their frames by.

use std::cell::{Ref, RefCell};
use std::rc::Rc;
use std::sync::Arc;

use rtmac::tdma::{SlotConfig, TdmaCommand};
use rtnet::discipline::{Discipline, Service, SyncState};
use rtnet::sim::{Host, Member, Network, StationId};
use rtnet::station::Station;
use tools::judge::analysis::Analysis;
use tools::judge::explain::Records;
use tools::judge::findings::{Author, Finding};
use tools::judge::givers::TrueMaster;
use tools::scenario::Source;
use tools::station::traffic::TrafficCounts;

use crate::mixed::Mixed;
use crate::networks::{Plan, epoch};
use crate::seeds;
use crate::traffic::of_a_lab;

/// True time when it begins: no clock is so far behind that it shows less than 0.
const BEGIN: u64 = 10_000_000_000;

/// A network that is watched.
pub struct Observed {
    /// What it is like.
    pub plan: Plan,
    /// Its stations.
    pub network: Network<Mixed>,
    /// What each has received.
    pub received: Vec<Arc<TrafficCounts>>,
    analysis: Rc<RefCell<Analysis>>,
    records: Records,
}

impl Observed {
    /// The network of a file, on such hosts, with the lab's own traffic; its seed is the date's.
    pub fn lab(text: &str, host: Host) -> Self {
        Self::seeded(text, host, seeds::one("Observed::lab"))
    }

    /// The network of a file, drawn by this seed.
    pub fn seeded(text: &str, host: Host, seed: u64) -> Self {
        Self::with(text, (host, seed), |plan, id, counts| {
            let (to, from) = (plan.scenario.receiver(id), plan.scenario.sender(id));
            let traffic = of_a_lab((id as u16, plan.address(id)), plan.address(to), from as u16, counts);
            Box::new(traffic.with_flows(plan.scenario.flow_plan(id)))
        })
    }

    /// The same with another traffic for each station.
    pub fn with(
        text: &str,
        (host, seed): (Host, u64),
        traffic: impl Fn(&Plan, StationId, Arc<TrafficCounts>) -> Box<dyn Service>,
    ) -> Self {
        let scenario = Source::new("lab.toml", text).parse().expect("a network").with_seed(seed);
        let plan = Plan::of_scenario(scenario).on(host.clone());
        let master = TrueMaster { clock: plan.clock(0), epoch: epoch() };
        let analysis = Rc::new(RefCell::new(Analysis::new(&plan.scenario, master)));
        let mut network = Network::new(plan.medium, plan.scenario.seed);
        network.run_until(BEGIN);
        let watching = analysis.clone();
        network.observe(move |aired| watching.borrow_mut().frame(aired.at, aired.bytes));
        let counts = |id| Arc::new(TrafficCounts::of(&plan.scenario.flow_plan(id)));
        let received: Vec<_> = (0..plan.stations()).map(counts).collect();
        for (id, counts) in received.iter().enumerate() {
            let discipline = plan.ours(id, (id == 0).then_some(plan.cycle()));
            let station = Station::new(discipline, vec![traffic(&plan, id, counts.clone())]);
            let (address, clock, host) = (plan.address(id), plan.clock(id), host.clone().into());
            network.add(Member { address, clock, host, station }, BEGIN + id as u64 * 1_000_000);
        }
        let records = Records::new(&plan.scenario);
        Self { plan, network, received, analysis, records }
    }

    /// Lets so many cycles pass, and takes what the stations tell.
    pub fn run_cycles(&mut self, cycles: u64) {
        let cycle = self.plan.cycle().nanos() as u64;
        for _ in 0..cycles {
            self.network.run_until(self.network.now() + cycle);
            for station in 0..self.plan.stations() {
                let discipline = self.network.member_mut(station).station.discipline_mut();
                while let Some(event) = discipline.next_event() {
                    let author = Author { station, cycle: event.cycle, slot: event.slot };
                    self.records.note(author, event.kind, event.span, event.kind.cause());
                }
            }
        }
    }

    /// Waits until all are locked, then counts so many cycles and what is found in them.
    pub fn judge(&mut self, cycles: u32) {
        self.judge_while(cycles, |lab| lab.run_cycles(u64::from(cycles) + 15));
    }

    /// The same while something happens, which takes as many cycles and 15.
    pub fn judge_while(&mut self, cycles: u32, happens: impl FnOnce(&mut Self)) {
        let locked =
            |of: &Self, id| of.network.member(id).station.discipline().time().state == SyncState::Locked;
        for _ in 0..10_000 {
            if (0..self.plan.stations()).all(|id| locked(self, id)) {
                break;
            }
            self.run_cycles(1);
        }
        let current = self.analysis.borrow().current().expect("a master that speaks");
        self.analysis.borrow_mut().begin(current + 10, cycles);
        happens(self);
        assert!(self.analysis.borrow().is_complete(), "somebody was not locked");
        self.analysis.borrow_mut().finish();
    }

    /// Changes a slot of a station of ours, which is expected to be so from the cycle on that the station tells.
    pub fn set_slot(&mut self, station: StationId, slot: SlotConfig) {
        let now = self.network.now();
        let member = self.network.member_mut(station);
        let now = member.clock.local(now);
        let from = member.station.discipline_mut().command(now, &mut TdmaCommand::set_slot(slot));
        let from = from.expect("a slot that can be");
        self.analysis.borrow_mut().timetable.change(station, slot.id, Some(slot.into()), from);
    }

    /// What was seen.
    pub fn analysis(&self) -> Ref<'_, Analysis> {
        self.analysis.borrow()
    }

    /// What was found, and how much of that has no record of its cause.
    pub fn findings(&self) -> (usize, Vec<Finding>) {
        let findings = self.analysis.borrow().findings.clone();
        let unexplained = findings.iter().filter(|finding| self.records.explain(finding).is_none());
        (findings.len(), unexplained.copied().collect())
    }
}
