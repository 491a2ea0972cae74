//! A master and a slave over veth, with the traffic of a lab: their real-time threads allocate nothing from
//! [`Driver::run`] on, while they listen, wait and calibrate as little as once they are locked.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::sys::eventfd::{EfdFlags, EventFd};
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, NewRole, RoleConfig, SlaveConfig,
    SlotConfig, Tdma, TdmaCommand, TdmaConfig,
};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::SyncState;
use rtnet::live::interface::Interface;
use rtnet::live::{Driver, DriverConfig, GuardMode, Port};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType};
use tests::traffic;
use tools::lab::namespace::{Namespace, Segment};
use tools::station::traffic::TrafficCounts;

use crate::calls;

const CYCLE: Span = Span::from_millis(2);
const LATE: Span = Span::from_micros(500);
const CYCLES: u32 = 1_000;
const PATIENCE: Duration = Duration::from_secs(30);
const ADDRESSES: [Address; 2] = [Address([2, 0, 0, 0, 0, 1]), Address([2, 0, 0, 0, 0, 2])];

#[test]
fn real_time_threads_allocate_nothing_after_start() {
    if !tests::as_root("real_time_threads_allocate_nothing_after_start") {
        return;
    }
    let mut segment = Segment::new().unwrap();
    let namespaces = [Namespace::new().unwrap(), Namespace::new().unwrap()];
    let stop = Arc::new(AtomicBool::new(false));
    let (mut snapshots, mut control) = (Vec::new(), Vec::new());
    let heard: [Arc<TrafficCounts>; 2] = Default::default();
    let mut threads = Vec::new();
    for (station, namespace) in namespaces.iter().enumerate() {
        segment.attach(namespace, &format!("port{station}"), "rt0", ADDRESSES[station].0).unwrap();
        let mut driver = driver(station, namespace, stop.clone(), heard[station].clone());
        snapshots.push(driver.snapshots());
        control.push(driver.errands());
        threads.push(std::thread::spawn(move || {
            let before = calls();
            driver.run();
            calls() - before
        }));
    }
    let wait_until = |what: &str, holds: &dyn Fn(SyncState, u32) -> bool| {
        let deadline = Instant::now() + PATIENCE;
        loop {
            // Both are looked at, so that neither queue is left full.
            let seen: Vec<_> = snapshots.iter().filter_map(|snapshots| snapshots.pop()).collect();
            if let Some(slave) = seen.iter().find(|seen| seen.status.delay.is_some())
                && holds(slave.status.state, slave.status.cycle)
            {
                return slave.status;
            }
            assert!(Instant::now() < deadline, "in vain: {what}");
            std::thread::sleep(Duration::from_millis(10));
        }
    };
    let locked = wait_until("locked", &|state, _| state == SyncState::Locked);
    let errands = &control[1];
    for command in every_command() {
        assert!(errands.send(command).is_ok());
        let deadline = Instant::now() + PATIENCE;
        let answer = loop {
            match errands.take() {
                Some(errand) => break errand.result.unwrap(),
                None => assert!(Instant::now() < deadline, "a command has no answer"),
            }
        };
        assert!(answer.is_ok(), "{answer:?}");
    }
    let later = wait_until("cycles pass", &|_, cycle| cycle >= locked.cycle + CYCLES);
    stop.store(true, Ordering::Relaxed);
    let allocations: Vec<u64> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();

    assert!(later.counters.frames_sent > locked.counters.frames_sent, "they were at work");
    assert!(
        heard.iter().all(|counts| counts.usual.received.load(Ordering::Relaxed) > 0),
        "and checked what they heard"
    );
    assert_eq!(allocations, [0, 0]);
}

/// A slot that moves, one that is joined to it, follows, is left behind and goes, and a slave that leaves and joins again.
fn every_command() -> Vec<TdmaCommand> {
    let slot = slot(1);
    let attached = NewRole::attached(role(1)).unwrap();
    vec![
        TdmaCommand::set_slot(SlotConfig { offset: slot.offset + Span::from_micros(50), ..slot }),
        TdmaCommand::set_slot(SlotConfig { id: 2, offset: Span::from_micros(1_900), joint: Some(0), ..slot }),
        TdmaCommand::set_slot(SlotConfig { size: 80, ..slot }),
        TdmaCommand::set_slot(slot),
        TdmaCommand::RemoveSlot(2),
        TdmaCommand::Become(NewRole::detached()),
        TdmaCommand::Become(attached),
    ]
}

fn role(station: usize) -> RoleConfig {
    match station {
        0 => RoleConfig::Master(MasterConfig {
            follow: SlaveConfig { rounds: 0, ..SlaveConfig::default() },
            ..MasterConfig::new(CYCLE, LATE)
        }),
        _ => RoleConfig::Slave(SlaveConfig { rounds: 5, step_limit: Some(LATE), ..SlaveConfig::default() }),
    }
}

fn slot(station: usize) -> SlotConfig {
    let offset = Span::from_micros(600 + 700 * station as i64);
    SlotConfig { id: 0, offset, phase: 0, period: 1, size: 100, joint: None, latest: LATE }
}

fn driver(
    station: usize,
    namespace: &Namespace,
    stop: Arc<AtomicBool>,
    heard: Arc<TrafficCounts>,
) -> Driver<Tdma> {
    let clock = EmulatedClock::default();
    let discipline = Tdma::new(&TdmaConfig {
        address: ADDRESSES[station],
        role: role(station),
        slots: vec![slot(station)],
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    });
    let (neighbour, id) = (1 - station, station as u16);
    let traffic = traffic::of_a_lab((id, ADDRESSES[station]), ADDRESSES[neighbour], neighbour as u16, heard);
    let open = || {
        let interface = Interface::find("rt0").unwrap();
        Port::open(
            &interface,
            &[EtherType::EXPERIMENTAL],
            clock,
            DEFAULT_LEAD.nanos() as u64,
            GuardMode::Auto,
        )
        .unwrap()
    };
    let port = namespace.run(open).unwrap();
    let station = Station::new(discipline.unwrap(), vec![Box::new(traffic)]);
    // Every change of state wakes the control thread.
    let changed = Arc::new(EventFd::from_flags(EfdFlags::EFD_NONBLOCK).unwrap());
    Driver::new(station, port, DriverConfig { stop, sample_time: true, changed: Some(changed) })
}
