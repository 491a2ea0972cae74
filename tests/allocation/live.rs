//! A master and a slave over veth, with the traffic of a lab, and Linux's through their tunnels: their real-time threads
//! allocate nothing from [`Driver::run`] on, while they listen, wait and calibrate as little as once they are locked.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::sys::eventfd::{EfdFlags, EventFd};
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, NewRole, RoleConfig, SlaveConfig,
    SlotConfig, Tdma, TdmaCommand, TdmaConfig,
};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::SyncState;
use rtnet::live::interface::Interface;
use rtnet::live::realtime::{RealTime, SLAVE_PRIORITY};
use rtnet::live::{Driver, DriverConfig, GuardMode, Port};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType};
use tests::traffic;
use tools::control::{VnicRequest, VnicShown};
use tools::lab::namespace::{Namespace, Segment};
use tools::station::traffic::TrafficCounts;
use tools::station::vnic::{self, Opened, Told, VnicOptions};

use crate::calls;

const CYCLE: Span = Span::from_millis(2);
const LATE: Span = Span::from_micros(500);
const CYCLES: u32 = 1_000;
const PATIENCE: Duration = Duration::from_secs(30);
/// What a tunnel of each must have taken and brought before it is over.
const TUNNELLED: u64 = 200;
/// Of their VNICs.
const LINUXES: [&str; 2] = ["10.1.0.1", "10.1.0.2"];
const ADDRESSES: [Address; 2] = [Address([2, 0, 0, 0, 0, 1]), Address([2, 0, 0, 0, 0, 2])];

#[test]
fn real_time_threads_allocate_nothing_after_start() {
    tests::host::network("real_time_threads_allocate_nothing_after_start", || {
        let mut segment = Segment::new().unwrap();
        let namespaces = [Namespace::new().unwrap(), Namespace::new().unwrap()];
        let stop = Arc::new(AtomicBool::new(false));
        let (mut snapshots, mut control) = (Vec::new(), Vec::new());
        let heard: [Arc<TrafficCounts>; 2] = Default::default();
        let (mut threads, mut others, mut tunnels) = (Vec::new(), Vec::new(), Vec::new());
        let mut vnics = Vec::new();
        for (station, namespace) in namespaces.iter().enumerate() {
            segment.attach(namespace, &format!("port{station}"), "rt0", ADDRESSES[station].0).unwrap();
            let (mut driver, vnic) = driver(station, namespace, stop.clone(), heard[station].clone());
            tunnels.push(vnic.told.clone());
            vnics.push(vnic.start(None).unwrap());
            snapshots.push(driver.snapshots());
            control.push(driver.errands());
            threads.push(std::thread::spawn(move || {
                // As a station's thread that is a process of its own: whatever else the host runs waits for it.
                RealTime { priority: Some(SLAVE_PRIORITY), cpu: None }.apply();
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
        for (station, namespace) in namespaces.iter().enumerate() {
            others.push(linux(station, namespace, stop.clone()));
        }
        let before = gone_through(&tunnels);
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
        let is_carried = || {
            let after = gone_through(&tunnels);
            let carried = before.iter().flatten().zip(after.iter().flatten());
            carried.into_iter().all(|(before, after)| after - before >= TUNNELLED)
        };
        let later = wait_until("cycles pass, and tunnels carry both ways", &|_, cycle| {
            cycle >= locked.cycle + CYCLES && is_carried()
        });
        stop.store(true, Ordering::Relaxed);
        let allocations: Vec<u64> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
        others.into_iter().for_each(|thread| thread.join().unwrap());
        drop(vnics);

        assert!(later.counters.frames_sent > locked.counters.frames_sent, "they were at work");
        assert!(heard.iter().all(|counts| counts.arrived(None).received > 0), "and checked what they heard");
        assert_eq!(allocations, [0, 0]);
    });
}

/// Frames that each tunnel has sent and received.
fn gone_through(tunnels: &[Told]) -> Vec<[u64; 2]> {
    let counters = |told: &Told| {
        let VnicShown { counters, .. } = told.answer(VnicRequest::Status).unwrap();
        ["sent", "received"].map(|name| counters[name])
    };
    tunnels.iter().map(counters).collect()
}

/// Sends to the other's Linux more than slots take, as long as it runs.
fn linux(station: usize, namespace: &Namespace, stop: Arc<AtomicBool>) -> JoinHandle<()> {
    let socket = namespace.run(|| UdpSocket::bind((LINUXES[station], 9)).unwrap()).unwrap();
    std::thread::spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            // What is dropped is not sent again.
            let _ = socket.send_to(&[station as u8; 40], (LINUXES[1 - station], 9));
            std::thread::sleep(Duration::from_millis(1));
        }
    })
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

/// That of the tunnel.
fn non_rt(station: usize) -> SlotConfig {
    let slot = slot(station);
    SlotConfig { id: 1, offset: slot.offset + Span::from_micros(350), ..slot }
}

fn driver(
    station: usize,
    namespace: &Namespace,
    stop: Arc<AtomicBool>,
    heard: Arc<TrafficCounts>,
) -> (Driver<Tdma>, Opened) {
    let clock = EmulatedClock::default();
    let discipline = Tdma::new(&TdmaConfig {
        address: ADDRESSES[station],
        role: role(station),
        slots: vec![slot(station), non_rt(station)],
        max_slot_id: DEFAULT_MAX_SLOT_ID,
        lead: DEFAULT_LEAD,
        late: LatePolicy::Skip,
    });
    let (neighbour, id) = (1 - station, station as u16);
    let traffic = traffic::of_a_lab((id, ADDRESSES[station]), ADDRESSES[neighbour], neighbour as u16, heard);
    let options = VnicOptions::usual(vec![format!("{}/24", LINUXES[station]).parse().unwrap()]);
    let open = || {
        let interface = Interface::find("rt0").unwrap();
        let port = Port::open(
            &interface,
            &[EtherType::EXPERIMENTAL],
            clock,
            DEFAULT_LEAD.nanos() as u64,
            GuardMode::Auto,
        );
        let mut port = port.unwrap();
        let (vnic, tunnel) = vnic::open(&options, (&interface, None), &mut port, true, &stop).unwrap();
        (port, vnic, tunnel)
    };
    let (port, vnic, tunnel) = namespace.run(open).unwrap();
    // The lab's traffic takes every turn that is left.
    let station = Station::new(discipline.unwrap(), vec![tunnel, Box::new(traffic)]);
    // Every change of state wakes the control thread.
    let changed = Arc::new(EventFd::from_flags(EfdFlags::EFD_NONBLOCK).unwrap());
    (Driver::new(station, port, DriverConfig { stop, sample_time: true, changed: Some(changed) }), vnic)
}
