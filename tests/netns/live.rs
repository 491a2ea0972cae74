//! Stations on real sockets, each in a namespace of its own, driven by threads of this process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, RoleConfig, SlaveConfig, SlotConfig, Tdma,
    TdmaConfig,
};
use rtmac::token::wire::TOKEN;
use rtnet::clock::{EmulatedClock, True};
use rtnet::discipline::{Discipline, Service};
use rtnet::live::clock::{monotonic, realtime};
use rtnet::live::interface::Interface;
use rtnet::live::realtime::{RealTime, SLAVE_PRIORITY};
use rtnet::live::ring::{CaptureRing, RingConfig};
use rtnet::live::{Driver, DriverConfig, GuardMode, Port, Snapshot, TimeBoard};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Offset, Span};
use rtnet::wire::ethernet::{Address, EtherType};
use tests::traffic::{Tally, TestTraffic};
use tools::lab::namespace::{Namespace, Segment};

pub const CYCLE: Span = Span::from_millis(5);
/// Long enough for a loaded machine, and never waited for in full when all is well.
const PATIENCE: Duration = Duration::from_secs(30);

/// A medium with its stations.
pub struct Medium {
    segment: Segment,
    stations: u8,
}

/// What a station has besides its test traffic.
#[derive(Default)]
pub struct Extras {
    /// What it does between its last look at the clock and each `send`.
    pub hold: Option<fn()>,
    pub service: Option<Box<dyn Service>>,
}

/// A running station; dropping it ends its thread.
pub struct Running<D: Discipline> {
    latest: Option<Snapshot<D::Status>>,
    snapshots: Arc<crossbeam::queue::ArrayQueue<Snapshot<D::Status>>>,
    pub tally: Arc<Tally>,
    pub time: Arc<TimeBoard>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    // The interface goes with it.
    _namespace: Namespace,
}

impl Medium {
    pub fn new() -> Self {
        Self { segment: Segment::new().unwrap(), stations: 0 }
    }

    /// The address of the station that is started so-manieth.
    pub fn address(station: u8) -> Address {
        Address([2, 0, 0, 0, 0, station + 1])
    }

    /// The kernel's own record of all that is on the medium from now on.
    pub fn observe(&self) -> CaptureRing {
        let open = || CaptureRing::open(self.segment.bridge_name(), RingConfig::default()).unwrap();
        self.segment.namespace().run(open).unwrap()
    }

    /// Starts the next station; it sends a frame in each slot to `to`.
    pub fn start<D: Discipline + 'static>(
        &mut self,
        clock: EmulatedClock,
        to: u8,
        discipline: impl FnOnce(Address) -> D,
    ) -> Running<D>
    where
        D::Status: Send,
    {
        self.start_with(clock, to, Extras::default(), discipline)
    }

    /// The same for one that has more than that.
    pub fn start_with<D: Discipline + 'static>(
        &mut self,
        clock: EmulatedClock,
        to: u8,
        extras: Extras,
        discipline: impl FnOnce(Address) -> D,
    ) -> Running<D>
    where
        D::Status: Send,
    {
        let (number, address) = (self.stations, Self::address(self.stations));
        self.stations += 1;
        let namespace = Namespace::new().unwrap();
        self.segment.attach(&namespace, &format!("port{number}"), "rt0", address.0).unwrap();
        let data = [EtherType::EXPERIMENTAL, TOKEN];
        let spin = DEFAULT_LEAD.nanos() as u64;
        let open =
            || Port::open(&Interface::find("rt0").unwrap(), &data, clock, spin, GuardMode::Auto).unwrap();
        let mut port = namespace.run(open).unwrap();
        if let Some(hold) = extras.hold {
            port.hold_before_send(hold);
        }
        let traffic = TestTraffic::new(number.into(), address, Self::address(to));
        let tally = traffic.tally.clone();
        let mut services: Vec<Box<dyn Service>> = vec![Box::new(traffic)];
        services.extend(extras.service);
        let stop = Arc::new(AtomicBool::new(false));
        let config = DriverConfig { stop: stop.clone(), sample_time: false, changed: None };
        let mut driver = Driver::new(Station::new(discipline(address), services), port, config);
        let (snapshots, time) = (driver.snapshots(), driver.time());
        let thread = Some(as_a_station(move || driver.run()));
        Running { latest: None, snapshots, tally, time, stop, thread, _namespace: namespace }
    }
}

impl<D: Discipline> Running<D> {
    /// What there is to be seen of it.
    pub fn status(&mut self) -> Option<D::Status> {
        self.latest = self.snapshots.pop().or(self.latest.take());
        self.latest.as_ref().map(|snapshot| snapshot.status)
    }

    /// The dates of the snapshots that nobody has looked at.
    pub fn dates(&self) -> Vec<True> {
        std::iter::from_fn(|| self.snapshots.pop()).map(|snapshot| snapshot.at).collect()
    }

    pub fn wait_until(&mut self, what: &str, mut holds: impl FnMut(&D::Status) -> bool) -> D::Status {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.status()
                && holds(&status)
            {
                return status;
            }
            assert!(Instant::now() < deadline, "in vain: {what}");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Waits until what it does before a `send` has ended its thread.
    pub fn wait_until_dead(&mut self) {
        let (deadline, thread) = (Instant::now() + PATIENCE, self.thread.take().expect("it runs"));
        while !thread.is_finished() {
            assert!(Instant::now() < deadline, "it lives on");
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(thread.join().is_err(), "it has ended by itself");
    }

    pub fn wait_for_frames(&self, frames: u64) {
        let (deadline, before) = (Instant::now() + PATIENCE, self.tally.received());
        while self.tally.received() < before + frames {
            assert!(Instant::now() < deadline, "only {} frames received", self.tally.received());
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl<D: Discipline> Drop for Running<D> {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let ended = thread.join();
            assert!(ended.is_ok() || std::thread::panicking(), "a station panicked");
        }
    }
}

/// Runs a station's loop as a station does that is a process of its own: whatever else the host runs waits for it.
pub fn as_a_station(run: impl FnOnce() + Send + 'static) -> JoinHandle<()> {
    std::thread::spawn(move || {
        // Where the host refuses that, a disturbed host is what tests are run again for.
        RealTime { priority: Some(SLAVE_PRIORITY), cpu: None }.apply();
        run();
    })
}

pub fn clock(offset: Span, drift_ppb: i64) -> EmulatedClock {
    EmulatedClock { anchor: monotonic(), offset, drift_ppb }
}

/// Our master on this clock, with one slot.
pub fn our_master(address: Address, clock: &EmulatedClock, offset: Span) -> Tdma {
    master_of(CYCLE, address, clock, offset, 100)
}

/// The same with another cycle, and a slot for frames of another size.
pub fn master_of(cycle: Span, address: Address, clock: &EmulatedClock, offset: Span, size: usize) -> Tdma {
    let epoch = Offset::between(clock.local(monotonic()), GlobalTime::from_nanos(realtime()));
    let late = Span::from_millis(1);
    let follow = SlaveConfig { rounds: 0, ..SlaveConfig::default() };
    let config = MasterConfig { epoch, follow, ..MasterConfig::new(cycle, late) };
    ours(address, offset, size, RoleConfig::Master(config))
}

/// Our slave, with one slot.
pub fn our_slave(address: Address, rounds: u32, offset: Span) -> Tdma {
    // On a machine that runs other tests, a Synchronisation may be held up by more than 50 us.
    let step_limit = Some(Span::from_micros(500));
    ours(
        address,
        offset,
        100,
        RoleConfig::Slave(SlaveConfig { rounds, step_limit, ..SlaveConfig::default() }),
    )
}

fn ours(address: Address, offset: Span, size: usize, role: RoleConfig) -> Tdma {
    let latest = Span::from_micros(500);
    let slot = SlotConfig { id: 0, offset, phase: 0, period: 1, size, joint: None, latest };
    let (max_slot_id, lead, late) = (DEFAULT_MAX_SLOT_ID, DEFAULT_LEAD, LatePolicy::Skip);
    Tdma::new(&TdmaConfig { address, role, slots: vec![slot], max_slot_id, lead, late }).unwrap()
}
