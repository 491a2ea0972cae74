//! Networks by chance: schedules, clocks, hosts and faults, all of which follow from a seed. What is drawn anew is drawn
//! last, or known seeds (`tests/property/seeds.txt`) are other networks.

mod more;

use rtmac::tdma::schedule::{Rate, Uncertainty, guard_band};
use rtmac::tdma::{BACKUP_LOOKS_BEFORE, HOLDOVER_CYCLES, LatePolicy, OnMasterChange};
use rtnet::sim::{Host, Latency, Medium, Random, StationId, Wander};
use rtnet::time::Span;
use rtnet::wire::ethernet::HEADER_LEN;
use tools::report::figures::Role;
use tools::scenario::{Conditions, Scenario, ServoName, SlotGuard, SlotPlan, StationPlan};

use crate::networks::Plan;

/// Clocks are wrong by so much at the most.
const DRIFT_PPB: i64 = 100_000;
/// From the last look at the clock to the wire, where nothing is held up.
const SEND_JITTER: Span = Span::from_micros(1);
/// A host is late, and a frame held up, for so many cycles at the most.
pub const LONGEST_HOLD_UP: i64 = 3;
/// The most that happens to one network.
const MOST_FAULTS: u64 = 4;

/// A network, and what happens to it.
#[derive(Clone, Debug)]
pub struct Case {
    /// All else follows from it.
    pub seed: u64,
    /// The stations; their hosts are in `hosts`.
    pub plan: Plan,
    /// Each station's host while it has no trouble.
    pub hosts: Vec<Host>,
    /// In the order of their begins.
    pub faults: Vec<Fault>,
}

/// Something that happens, and is over.
#[derive(Clone, Debug)]
pub struct Fault {
    /// What.
    pub trouble: Trouble,
    /// The cycle in which it begins, counted from the network's start.
    pub begins: u64,
    /// The first cycle without it.
    pub ends: u64,
}

impl Fault {
    /// Whether it is there in a cycle.
    pub fn is_on(&self, cycle: u64) -> bool {
        (self.begins..self.ends).contains(&cycle)
    }
}

/// What can happen.
#[derive(Clone, Debug)]
pub enum Trouble {
    /// Each receiver fails to hear so many frames in a million.
    Losses(u32),
    /// A station's wake-ups come late: so many in a million, by up to so much.
    Outages(StationId, u32, Span),
    /// A station's frames are held up between its last look at the clock and the wire: so many in a million, by up to so
    /// much.
    Stalls(StationId, u32, Span),
    /// A station dies, and is started anew when it is over.
    Crash(StationId),
    /// These stations and the others do not hear each other.
    Cut(Vec<StationId>),
    /// A station's clock is set, by so much.
    Step(StationId, Span),
    /// A station's clock changes its rate from time to time.
    Wander(StationId, Wander),
    /// What a station sends and hears comes twice: so many frames in a million.
    Doubles(StationId, u32),
    /// A bit is not what it was: in so many frames in a million that a station sends, and that it hears.
    Changes(StationId, u32),
    /// A slave is started anew as a primary, and with it these are cut off from the others, as long as it lasts.
    Primary(StationId, Vec<StationId>),
}

/// A part of the cycle that one slot has, or that several have in turns.
struct Part {
    period: u32,
    /// Station and slot of each phase.
    owners: Vec<(StationId, u8)>,
}

impl Case {
    /// The case of a seed.
    pub fn of(seed: u64) -> Self {
        let (mut random, mut case) = Self::drawn(seed);
        more::configure(&mut random, &mut case.plan, &case.faults);
        more::happen(&mut random, &case.plan, &mut case.faults);
        case
    }

    /// The same as far as it was drawn when the first seeds were found.
    pub fn as_at_first(seed: u64) -> Self {
        Self::drawn(seed).1
    }

    fn drawn(seed: u64) -> (Random, Self) {
        let mut random = Random::new(seed);
        let mut plan = loop {
            if let Some(plan) = plan(&mut random, seed) {
                break plan;
            }
        };
        let host = |_| Host {
            wake: Latency::Exponential(Span::from_nanos(random.between(0, 20_000))),
            send: Latency::Uniform(Span::ZERO, SEND_JITTER),
            ..Host::IDEAL
        };
        let hosts = (0..plan.stations()).map(host).collect();
        let faults = faults(&mut random, &plan);
        // Those of three networks in ten measure the delay from each master anew.
        if random.happens(300_000) {
            plan.follow.on_master_change = OnMasterChange::Repeat;
        }
        (random, Self { seed, plan, hosts, faults })
    }
}

/// What a guard band has to absorb where so many cycles are bridged.
fn uncertainty(cycle: Span, holdover: u32) -> Uncertainty {
    Uncertainty {
        drift_ppb: DRIFT_PPB,
        cycle,
        holdover,
        lateness: Span::ZERO,
        stamp_error: SEND_JITTER + Medium::default().propagation,
    }
}

/// A network that can be; `None` where what was drawn does not fit its cycle.
fn plan(random: &mut Random, seed: u64) -> Option<Plan> {
    let stations = random.between(2, 8) as usize;
    let cycle = Span::from_micros(random.between(500, 10_000));
    let rate = Rate::from_bits_per_second(if random.happens(500_000) { 100_000_000 } else { 1_000_000_000 });
    let payload = random.between(46, 300) as usize;
    let sync_window = Span::from_micros(random.between(40, cycle.nanos() / 8_000));
    let backups = backups(random, stations, sync_window);
    let begin = backups.last().map_or(Span::ZERO, |&(_, after)| after) + sync_window;

    let parts = parts(random, stations);
    let air = rate.air_time(payload + HEADER_LEN);
    let room = (cycle - begin) / parts.len() as i64 - air;
    // The clocks have a quarter of it at either end, at the most.
    let least = guard_band(uncertainty(cycle, HOLDOVER_CYCLES as u32)) * 2;
    if room < least {
        return None;
    }
    let guard = Span::from_nanos(random.between(least.nanos(), room.nanos()));
    let spare = cycle - begin - (air + guard) * parts.len() as i64;
    let stations = (0..stations).map(|id| station(random, id, payload, &backups)).collect();
    let mut scenario = Scenario {
        max_miss_ppm: tools::scenario::MAX_MISS_PPM,
        cycle,
        sync_window,
        rate,
        guard,
        duration: Span::ZERO,
        seed,
        late: LatePolicy::Skip,
        slot_guard: SlotGuard::User,
        servo: ServoName::Linear,
        delay: None,
        packages: None,
        stations,
        conditions: Conditions::default(),
    };
    place(random, &mut scenario, &parts, begin, spare);
    assert_eq!(scenario.schedule().conflicts(), [], "seed {seed}");
    let medium = Medium { rate: rate.bits_per_second(), ..Medium::default() };
    let (tolerance, host) = (scenario.clock_share(), Host::IDEAL);
    Some(Plan { medium, tolerance, host, backups, ..Plan::of_scenario(scenario) })
}

/// None, one or two, each later than the one before may still send.
fn backups(random: &mut Random, stations: usize, sync_window: Span) -> Vec<(StationId, Span)> {
    let mut after = Span::ZERO;
    let number = random.below(3).min(stations as u64 - 1);
    let looks = |id| {
        after = after + sync_window + BACKUP_LOOKS_BEFORE + Span::from_micros(random.between(1, 20));
        (id as StationId, after)
    };
    (1..=number).map(looks).collect()
}

fn station(random: &mut Random, id: StationId, payload: usize, backups: &[(StationId, Span)]) -> StationPlan {
    let backup = backups.iter().find(|&&(of, _)| of == id).map(|&(_, after)| after);
    StationPlan {
        name: format!("station{id}"),
        role: match (id, backup) {
            (0, _) => Role::Master,
            (_, Some(_)) => Role::Backup,
            (_, None) => Role::Slave,
        },
        backup,
        clock: None,
        clock_offset: Span::from_nanos(random.between(-1_000_000_000, 1_000_000_000)),
        clock_drift_ppb: random.between(-DRIFT_PPB, DRIFT_PPB),
        payload,
        ip: None,
        vnic: None,
        // Of fewer than four the lower quartile is the lowest: one reply that is held up would count.
        rounds: if random.happens(100_000) { 0 } else { random.between(4, 8) as u32 },
        slots: Vec::new(),
        flows: Vec::new(),
    }
}

/// Every station has a slot 0, some a slot 2; some have a part of the cycle in turns.
fn parts(random: &mut Random, stations: usize) -> Vec<Part> {
    let mut parts: Vec<Part> = Vec::new();
    for id in 0..stations {
        let shared = parts.last_mut().filter(|part| part.owners.len() < part.period as usize);
        match shared.filter(|_| random.happens(700_000)) {
            Some(part) => part.owners.push((id, 0)),
            None => {
                let period = [1, 1, 1, 2, 3, 4][random.below(6) as usize];
                parts.push(Part { period, owners: vec![(id, 0)] });
            }
        }
    }
    for id in 0..stations {
        if random.happens(200_000) {
            parts.push(Part { period: random.between(1, 4) as u32, owners: vec![(id, 2)] });
        }
    }
    for last in (1..parts.len()).rev() {
        parts.swap(last, random.below(last as u64 + 1) as usize);
    }
    parts
}

/// Puts the parts behind each other, with what is to spare between them.
fn place(random: &mut Random, scenario: &mut Scenario, parts: &[Part], begin: Span, mut spare: Span) {
    let mut offset = begin;
    for &Part { period, ref owners } in parts {
        let gap = Span::from_nanos(random.between(0, spare.nanos()));
        (offset, spare) = (offset + gap, spare - gap);
        for (phase, &(station, id)) in owners.iter().enumerate() {
            let station = &mut scenario.stations[station];
            station.slots.push(SlotPlan {
                id,
                offset,
                phase: phase as u32,
                period,
                size: station.payload,
                joint: None,
            });
        }
        let size = scenario.stations[0].payload;
        offset = offset + scenario.rate.air_time(size + HEADER_LEN) + scenario.guard;
    }
    scenario.stations.iter_mut().for_each(|station| station.slots.sort_by_key(|slot| slot.id));
}

fn faults(random: &mut Random, plan: &Plan) -> Vec<Fault> {
    let mut begins = 0;
    let number = random.below(MOST_FAULTS + 1);
    let fault = |_| {
        begins += random.between(1, 150) as u64;
        // Now and then longer than slaves keep a line.
        let longest = if random.happens(50_000) { 1_500 } else { 100 };
        let ends = begins + random.between(1, longest) as u64;
        Fault { trouble: trouble(random, plan), begins, ends }
    };
    (0..number).map(fault).collect()
}

fn trouble(random: &mut Random, plan: &Plan) -> Trouble {
    let stations = plan.stations() as u64;
    let some = random.below(stations) as StationId;
    let long = Span::from_nanos(random.between(0, plan.cycle().nanos() * LONGEST_HOLD_UP));
    match random.below(6) {
        0 => Trouble::Losses(random.between(1_000, 300_000) as u32),
        1 => Trouble::Outages(some, random.between(1_000, 200_000) as u32, long),
        2 => Trouble::Stalls(some, random.between(1_000, 50_000) as u32, long),
        3 => Trouble::Crash(0),
        4 => Trouble::Crash(some),
        _ => Trouble::Cut((0..plan.stations()).filter(|_| random.happens(500_000)).collect()),
    }
}
