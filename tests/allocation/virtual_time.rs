//! Two slaves and their master, driven by hand in virtual time, with the traffic of a lab.

use std::sync::Arc;

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, NewRounds, RoleConfig, SlaveConfig,
    SlotConfig, Tdma, TdmaCommand, TdmaConfig,
};
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Discipline, Opportunity, Sent, Service, SyncState, Transmission};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::Address;
use tests::chance::Case;
use tests::seeds;
use tests::traffic;
use tools::station::traffic::{Flow, FlowPlan, TrafficCounts};

use crate::calls;

const CYCLE: Span = Span::from_millis(1);
const STATIONS: usize = 3;
const LATEST: Span = Span::from_micros(50);

#[test]
fn stations_allocate_nothing_from_their_first_turn_on() {
    let mut network = Network::new();
    let mut changes = changes_of_slots();

    let before = calls();
    network.run(Instant::from_nanos(3_500_000));
    let listening = (network.sent, network.states());
    network.run(Instant::from_nanos(10_000_000));
    let calibrating = network.states();
    network.run(Instant::from_nanos(400_000_000));
    let (locked, sent) = (network.states(), network.sent);
    let now = network.now;
    network.run(now + CYCLE * 1_000);
    let sent_unchanged = network.sent - sent;
    for change in &mut changes {
        let now = network.now;
        network.seats[1].station.discipline_mut().command(now, change).expect("it can be");
        network.run(now + CYCLE * 3);
    }
    let allocations = calls() - before;

    assert_eq!(listening, (0, [SyncState::Locked, SyncState::Waiting, SyncState::Waiting]));
    assert_eq!(calibrating, [SyncState::Locked, SyncState::Calibrating, SyncState::Calibrating]);
    assert_eq!(locked, [SyncState::Locked; STATIONS]);
    assert_eq!(sent_unchanged, 1_000 * (STATIONS as u64 + 1), "they were at work");
    for seat in &network.seats {
        assert!(seat.counts.arrived(None).received >= 1_300, "and checked what they heard");
        assert_eq!(seat.station.refusals().total(), 0);
    }
    assert_eq!(allocations, 0);
}

/// The first slave's slot.
fn slot() -> SlotConfig {
    let offset = Span::from_micros(350);
    SlotConfig { id: 0, offset, phase: 0, period: 1, size: 64, joint: None, latest: LATEST }
}

/// A slot that others are joined to, shrinks, grows, and is alone again; slot 1 comes and goes.
fn changes_of_slots() -> Vec<TdmaCommand> {
    let at = |id, micros| SlotConfig { id, offset: Span::from_micros(micros), ..slot() };
    vec![
        TdmaCommand::set_slot(SlotConfig { joint: Some(0), ..at(2, 200) }),
        TdmaCommand::set_slot(SlotConfig { joint: Some(2), ..at(3, 500) }),
        TdmaCommand::set_slot(SlotConfig { size: 60, ..slot() }),
        TdmaCommand::set_slot(at(1, 700)),
        TdmaCommand::set_slot(slot()),
        TdmaCommand::RemoveSlot(1),
        TdmaCommand::RemoveSlot(2),
    ]
}

#[test]
fn networks_by_chance_allocate_nothing_once_they_run() {
    for seed in seeds::in_a_row("once they run", 50) {
        let case = Case::of(seed);
        let mut lab = case.settled().unwrap_or_else(|why| panic!("seed {seed}: {why}"));
        // The judge writes down what it sees.
        lab.network.observe(|_| ());
        lab.network.medium_mut().lose_control_ppm = 100_000;
        let cycle = case.plan.cycle().nanos() as u64;
        // The simulator's own lists have become as long as they will be.
        lab.network.run_until(lab.network.now() + 1_000 * cycle);
        let mut allocations = || {
            let (before, sent) = (calls(), lab.network.traffic().frames);
            lab.network.run_until(lab.network.now() + 500 * cycle);
            let allocations = calls() - before;
            assert!(lab.network.traffic().frames > sent + 500, "seed {seed}: they were at work");
            allocations
        };
        // The simulator's lists double when more frames are on their way than ever before: a window in which they did is
        // followed by others. A station that allocates in its cycles does so in each window.
        let windows = [(); 3].map(|()| allocations());
        assert!(
            windows.contains(&0) && windows.iter().sum::<u64>() <= SIMULATOR_GROWS,
            "seed {seed}: {windows:?}"
        );
    }
}

/// The simulator keeps one more frame whenever more are on their way or waiting than ever before, of which a station that sleeps
/// has 32 at the most; its lists double then.
const SIMULATOR_GROWS: u64 = 64;

#[test]
fn networks_by_chance_allocate_nothing_while_faults_come_and_go_but_for_frames_that_the_simulator_keeps() {
    let mut most = 0;
    for seed in seeds::in_a_row("faults", 200) {
        let counted = Case::of(seed).calls_while_it_runs(calls);
        most = most.max(counted.unwrap_or_else(|why| panic!("seed {seed}: {why}")));
    }
    assert!(most <= SIMULATOR_GROWS, "{most}");
}

#[test]
fn what_a_program_queues_allocates_nothing() {
    let flow = Flow { priority: 3, every_ns: 3_000_000, burst: 40, payload: 100, slot: 0 };
    let flows = FlowPlan { flows: vec![flow, Flow { priority: 9, ..flow }], ..FlowPlan::default() };
    let counts = Arc::new(TrafficCounts::of(&flows));
    let address = Address([2, 0, 0, 0, 0, 1]);
    let mut traffic = traffic::of_a_lab((0, address), address, 1, counts.clone()).with_flows(flows);
    let (mut queued, mut waiting) = (0, Vec::with_capacity(100));

    let before = calls();
    for cycle in 0..1_000 {
        let at = u64::from(cycle) * 1_000_000 + 100_000;
        let (begin, scheduled) = (Instant::from_nanos(at), GlobalTime::from_nanos(at));
        let slot = Opportunity { channel: 0, cycle, begin, scheduled, non_rt: None };
        traffic.poll(&slot, &mut |frame, _, _| {
            queued += 1;
            waiting.push(frame);
            Ok(())
        });
        if let Some(frame) = waiting.last_mut() {
            traffic.leaves(&slot, frame);
        }
        waiting.truncate(if cycle % 10 == 0 { 0 } else { 90 });
    }
    let allocations = calls() - before;

    assert!(queued > 5_000, "{queued}");
    assert!(counts.refused().count() == 2, "its pool was empty at times, too");
    assert_eq!(allocations, 0);
}

#[test]
fn measuring_anew_in_more_rounds_than_before_allocates_nothing() {
    let mut network = Network::new();
    network.run(Instant::from_nanos(400_000_000));
    let mut command = TdmaCommand::Calibrate(NewRounds::of(50).expect("more than 20"));

    let before = calls();
    let (now, slave) = (network.now, network.seats[1].station.discipline_mut());
    assert!(slave.command(now, &mut command).is_ok());
    network.run(now + CYCLE * 300);
    let allocations = calls() - before;

    let status = network.seats[1].station.discipline().status();
    let measured = status.calibration.map(|report| report.rounds);
    assert_eq!((status.calibrating, measured, allocations), (None, Some(50), 0));
}

/// Stations that hear each other at once, all on one clock; everything it needs is made beforehand.
struct Network {
    seats: Vec<Seat>,
    now: Instant,
    sent: u64,
}

struct Seat {
    address: Address,
    station: Station<Tdma>,
    counts: Arc<TrafficCounts>,
    chosen: Option<Transmission>,
    pool: Pool,
}

impl Network {
    fn new() -> Self {
        let seats = (0..STATIONS).map(|id| Seat::new(id as u8)).collect();
        Self { seats, now: Instant::default(), sent: 0 }
    }

    fn run(&mut self, until: Instant) {
        while let Some((at, id)) = self.next().filter(|&(at, _)| at <= until) {
            self.now = at.max(self.now);
            match self.seats[id].chosen.take() {
                Some(chosen) => self.send(id, chosen),
                None => self.seats[id].turn(self.now),
            }
        }
        self.now = until;
    }

    fn states(&self) -> [SyncState; STATIONS] {
        core::array::from_fn(|id| self.seats[id].station.discipline().time().state)
    }

    fn next(&self) -> Option<(Instant, usize)> {
        let due = self.seats.iter().enumerate().filter_map(|(id, seat)| Some((seat.due()?, id)));
        due.min()
    }

    fn send(&mut self, id: usize, chosen: Transmission) {
        let Transmission { mut frame, stamp, .. } = chosen;
        if let Some(stamp) = stamp {
            stamp.write(&mut frame, self.now);
        }
        self.sent += 1;
        self.seats[id].station.on_sent(Sent::At(self.now));
        let to = Address(frame[..6].try_into().expect("a frame"));
        for (other, seat) in self.seats.iter_mut().enumerate() {
            if other != id && (to.is_group() || to == seat.address) {
                seat.hear(self.now, &frame);
            }
        }
        self.seats[id].turn(self.now);
    }
}

impl Seat {
    fn new(id: u8) -> Self {
        let stations = STATIONS as u8;
        let address = Address([2, 0, 0, 0, 0, id + 1]);
        let neighbour = Address([2, 0, 0, 0, 0, (id + 1) % stations + 1]);
        let latest = LATEST;
        let epoch = Offset::between(Instant::default(), GlobalTime::from_nanos(1_795_000_000_000_000_000));
        let role = match id {
            0 => RoleConfig::Master(MasterConfig {
                epoch,
                follow: SlaveConfig { rounds: 0, ..SlaveConfig::default() },
                ..MasterConfig::new(CYCLE, latest)
            }),
            _ => RoleConfig::Slave(SlaveConfig { rounds: 20, ..SlaveConfig::default() }),
        };
        let offset = Span::from_micros(100 + 250 * i64::from(id));
        let tdma = Tdma::new(&TdmaConfig {
            address,
            role,
            slots: vec![SlotConfig { offset, ..slot() }],
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        });
        let counts = Arc::new(TrafficCounts::default());
        let from = (id + stations - 1) % stations;
        let traffic = traffic::of_a_lab((id.into(), address), neighbour, from.into(), counts.clone());
        let station = Station::new(tdma.expect("a sound configuration"), vec![Box::new(traffic)]);
        Self { address, station, counts, chosen: None, pool: Pool::new(8) }
    }

    fn due(&self) -> Option<Instant> {
        self.chosen.as_ref().map(|chosen| chosen.at).or_else(|| self.station.next_deadline())
    }

    fn turn(&mut self, now: Instant) {
        self.station.on_timeout(now);
        self.chosen = self.station.next_transmission(now);
        // The shell takes events every turn.
        while self.station.discipline_mut().next_event().is_some() {}
    }

    fn hear(&mut self, rx: Instant, bytes: &[u8]) {
        let mut frame: Buf = self.pool.take().expect("every buffer comes back");
        frame.fill(bytes);
        self.station.on_frame(Some(rx), frame);
    }
}
