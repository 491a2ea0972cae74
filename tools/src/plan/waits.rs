//! How long what stations send waits for its slots, and what comes back for the other's.

use rtmac::tdma::schedule::{self, Demand, Slot, Turns, load, most_waiting, worst_queueing};
use rtmac::tdma::{NON_RT_SLOT, RT_SLOT, joint};
use rtnet::time::Span;
use serde::Serialize;

use crate::report::text::duration;
use crate::scenario::{Scenario, SlotPlan, StationPlan};
use crate::station::traffic::{BUFFERS_OF_FLOWS, Flow};

/// Of more stations pairs are not looked at: no lab holds so many, and of as many as a simulation does there are 50 million.
pub const PAIRS_AT_MOST: usize = 250;

/// What one queue of a station takes, or one priority of what its program puts into it, and how long that waits.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct WaitRow {
    /// Whose.
    pub station: String,
    /// The slots that take from the queue, the one whose it is first.
    pub slots: Vec<u8>,
    /// Turns in a second.
    pub turns_per_second: f64,
    /// What is queued again and again; none: whatever is the first in the queue.
    pub flow: Option<Flow>,
    /// The share of the turns that this and all that is more urgent want; 0 where nothing is said of it, or where joint
    /// slots meet too seldom to be looked through.
    pub load: f64,
    /// The longest from being queued to when it begins in its slot; none: for ever, or, with a load of 0, not known. Each frame that waits before it, of
    /// which the file says nothing, takes a turn more.
    pub worst_ns: Option<i64>,
    /// The most frames that wait at once, more urgent ones among them; none: more and more, or nothing is said of it.
    pub waiting: Option<u64>,
    /// The longest from one turn to the next.
    pub turn_ns: Option<i64>,
}

/// What questions and answers take together.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RoundTrips {
    /// How long a frame is on its way, there as back: nanoseconds.
    pub way_ns: i64,
    /// Of each two stations that have slots for it; none of more than 250 stations.
    pub pairs: Vec<RoundTrip>,
}

/// The worst from a question's being queued to its answer, where nobody takes time and nothing waits before them.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RoundTrip {
    /// Who asks.
    pub asks: String,
    /// Who answers.
    pub answers: String,
    /// An echo: asked in slot 0, answered in slot 1 or what stands for it.
    pub ping_ns: Option<i64>,
    /// Packages, there and back in slot 0.
    pub packages_ns: Option<i64>,
}

impl RoundTrips {
    pub(super) fn of(scenario: &Scenario, lead: Span) -> Self {
        let way = scenario.conditions.way();
        let mut trips = Self { way_ns: way.nanos(), pairs: Vec::new() };
        if scenario.stations.len() > PAIRS_AT_MOST {
            return trips;
        }
        let turns = |channel: u8| -> Vec<Option<Turns>> {
            scenario.stations.iter().map(|station| turns(scenario.cycle, station, channel)).collect()
        };
        let (rt, non_rt) = (turns(RT_SLOT), turns(NON_RT_SLOT));
        let trip = |asks: &Option<Turns>, answers: &Option<Turns>| {
            let trip = asks.as_ref()?.worst_round_trip(answers.as_ref()?, lead, [way; 2])?;
            Some(trip.nanos())
        };
        let names = || scenario.stations.iter().map(|station| &station.name).enumerate();
        for (a, asks) in names() {
            for (b, answers) in names().filter(|&(b, _)| b != a) {
                let (ping_ns, packages_ns) = (trip(&rt[a], &non_rt[b]), trip(&rt[a], &rt[b]));
                let (asks, answers) = (asks.clone(), answers.clone());
                trips.pairs.push(RoundTrip { asks, answers, ping_ns, packages_ns });
            }
        }
        trips
    }
}

/// Of every queue of every station, and every priority that is put into it.
pub(super) fn waits(scenario: &Scenario, lead: Span) -> Vec<WaitRow> {
    let of =
        |station| queues(station).into_iter().flat_map(move |queue| of_queue(scenario, station, queue, lead));
    scenario.stations.iter().flat_map(of).collect()
}

/// What of it waits for ever, or finds no buffer, in words.
pub(super) fn overloaded(waits: &[WaitRow]) -> Vec<String> {
    waits.iter().filter_map(WaitRow::overloaded).collect()
}

impl WaitRow {
    /// Whether it waits for ever.
    pub fn is_endless(&self) -> bool {
        self.load > 0.0 && self.worst_ns.is_none()
    }

    fn overloaded(&self) -> Option<String> {
        let Self { station, slots, turns_per_second: turns, flow, .. } = self;
        let (flow, slot) = (flow.as_ref()?, slots[0]);
        let of = format!("traffic of priority {} of station '{station}'", flow.priority);
        let remedy =
            "send less often, or give the slot more turns: a shorter cycle or period, or a joint slot";
        if self.is_endless() {
            return Some(format!(
                "{of} waits for ever: slot {slot} has {turns:.1} turns a second, and with what is more urgent {:.1} are wanted \
                 ({} every {} of it); {remedy}",
                self.load * turns,
                flow.burst,
                duration(flow.every_ns),
            ));
        }
        let waiting = self.waiting.filter(|&waiting| waiting > BUFFERS_OF_FLOWS as u64)?;
        Some(format!(
            "{of} loses frames: {waiting} may wait at once with what is more urgent, and a station's traffic has {BUFFERS_OF_FLOWS} \
             buffers; {remedy}"
        ))
    }
}

/// The slots whose queues they are: none that is joined to another.
fn queues(station: &StationPlan) -> Vec<u8> {
    let mut own: Vec<u8> =
        station.slots.iter().filter(|slot| slot.joint.is_none()).map(|slot| slot.id).collect();
    own.sort_unstable();
    own
}

fn of_queue(scenario: &Scenario, station: &StationPlan, queue: u8, lead: Span) -> Vec<WaitRow> {
    let serving = serving(station, queue);
    let turns = turns(scenario.cycle, station, queue);
    let between = schedule::longest_between(scenario.cycle, &as_planned(&serving));
    let mut slots: Vec<u8> = serving.iter().map(|slot| slot.id).collect();
    slots.sort_by_key(|&id| (id != queue, id));
    let row = WaitRow {
        station: station.name.clone(),
        slots,
        turns_per_second: turns_per_second(scenario.cycle, &serving),
        flow: None,
        load: 0.0,
        worst_ns: between.map(|between| (between + lead).nanos()),
        waiting: None,
        turn_ns: between.map(Span::nanos),
    };
    let is_in_queue =
        |flow: &&Flow| joint::serving(&station.slots, id, flow.slot).iter().any(|slot| slot.id == queue);
    let flows: Vec<Flow> = station.flows.iter().filter(is_in_queue).copied().collect();
    if flows.is_empty() {
        return vec![row];
    }
    let demand = |flow: &Flow| Demand { every: Span::from_nanos(flow.every_ns as i64), burst: flow.burst };
    let demands: Vec<Demand> = flows.iter().map(demand).collect();
    let of_flow = |place: usize| {
        let (flow, demands) = (Some(flows[place]), &demands[..=place]);
        let Some(turns) = &turns else { return WaitRow { flow, worst_ns: None, ..row.clone() } };
        WaitRow {
            flow,
            load: load(turns, demands),
            worst_ns: worst_queueing(turns, lead, demands).map(Span::nanos),
            waiting: most_waiting(turns, demands),
            ..row.clone()
        }
    };
    (0..flows.len()).map(of_flow).collect()
}

/// The turns of what takes from a channel's queue.
fn turns(cycle: Span, station: &StationPlan, channel: u8) -> Option<Turns> {
    Turns::of(cycle, &as_planned(&serving(station, channel)))
}

/// As the arithmetic takes them, which does not ask whose they are.
fn as_planned(slots: &[&SlotPlan]) -> Vec<Slot> {
    let slot = |&&SlotPlan { id, offset, phase, period, size, .. }: &&SlotPlan| Slot {
        owner: String::new(),
        id,
        offset,
        phase,
        period,
        size,
    };
    slots.iter().map(slot).collect()
}

/// How often these slots have their turns, together.
pub(super) fn turns_per_second(cycle: Span, slots: &[&SlotPlan]) -> f64 {
    let every = |slot: &&SlotPlan| 1e9 / (cycle.nanos() as f64 * f64::from(slot.period.max(1)));
    slots.iter().map(every).sum()
}

/// The slots that take what a channel is given.
pub(super) fn serving(station: &StationPlan, channel: u8) -> Vec<&SlotPlan> {
    joint::serving(&station.slots, id, channel)
}

fn id(slot: &SlotPlan) -> (u8, Option<u8>) {
    (slot.id, slot.joint)
}
