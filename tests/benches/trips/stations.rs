//! Stations in threads of this process, each in its namespace.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow};
use rtmac::nomac::NoMac;
use rtmac::tdma::DEFAULT_LEAD;
use rtnet::api::door::Door;
use rtnet::api::line::Lines;
use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::Discipline;
use rtnet::live::interface::Interface;
use rtnet::live::realtime::RealTime;
use rtnet::live::{Data, Driver, DriverConfig, GuardMode, Port};
use rtnet::socket::Program;
use rtnet::station::Station;
use serde_json::Value;
use tempfile::TempDir;
use tests::stacks;
use tools::lab::namespace::Namespace;

use crate::figures::Times;
use crate::processes::Gate;
use crate::programs::{Echo, PORT, Ping};
use crate::{Cores, STATION_PRIORITY, WARM_UP, Way};

/// A station that runs until it is dropped.
pub struct Running {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    gate: Option<Gate>,
    _scratch: TempDir,
}

/// Where and how one is to run.
pub struct Plan<'a> {
    pub namespace: &'a Namespace,
    pub number: usize,
    pub core: usize,
    pub way: Way,
    /// Whether programs of other processes may have sockets of it. All are alike but for that.
    pub is_open: bool,
}

impl Running {
    /// One without slots.
    pub fn without_slots(plan: Plan<'_>, programs: Vec<Box<dyn Program>>) -> Result<Self> {
        Self::start(plan, NoMac::new(DEFAULT_ASK_EVERY), programs, GuardMode::User)
    }

    pub fn start<D: Discipline + 'static>(
        plan: Plan<'_>,
        discipline: D,
        mut programs: Vec<Box<dyn Program>>,
        guard: GuardMode,
    ) -> Result<Self> {
        let spin = DEFAULT_LEAD.nanos() as u64;
        let clock = EmulatedClock::default();
        let open =
            || -> Result<Port> { Ok(Port::open(&Interface::find("rt0")?, Data::All, clock, spin, guard)?) };
        let port = plan.namespace.run(open)??;
        let door = Door::new(port.bells());
        if plan.is_open {
            programs.push(Box::new(Lines::new(4)));
        }
        let stack = stacks::stack(plan.number, programs);
        let station = Station::new(discipline, Vec::new()).with_stack(stack);
        let stop = Arc::new(AtomicBool::new(false));
        let config = DriverConfig { stop: stop.clone(), sample_time: false, changed: None };
        let mut driver = Driver::new(station, port, config).spinning(plan.way == Way::Spin);
        let scratch = TempDir::new()?;
        let path = scratch.path().join("station.sock");
        let gate = plan.is_open.then(|| Gate::open(path, door, driver.visits())).transpose()?;
        let realtime = RealTime { priority: plan.way.priority(STATION_PRIORITY), cpu: Some(plan.core) };
        let thread = std::thread::spawn(move || {
            realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
            driver.run();
        });
        Ok(Self { stop, thread: Some(thread), gate, _scratch: scratch })
    }

    /// Where programs attach.
    pub fn path(&self) -> Result<&Path> {
        self.gate.as_ref().map(Gate::path).ok_or_else(|| anyhow!("no sockets for other processes"))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        drop(self.gate.take());
        self.stop.store(true, Ordering::Relaxed);
        // It cannot be made up for here.
        self.thread.take().into_iter().for_each(|thread| drop(thread.join()));
    }
}

/// There and back between programs in the threads of two stations.
pub fn trips(homes: &[Namespace; 2], way: Way, cores: Cores, time: Duration) -> Result<Value> {
    let times = Arc::new(Mutex::new(Times::new()));
    let plan = |number| Plan { namespace: &homes[number], number, core: cores[number], way, is_open: false };
    let _answers = Running::without_slots(plan(1), vec![Echo::new()])?;
    let asks = Running::without_slots(plan(0), vec![Ping::new(stacks::at(1, PORT), times.clone())])?;
    std::thread::sleep(WARM_UP);
    times.lock().unwrap_or_else(PoisonError::into_inner).clear();
    std::thread::sleep(time);
    drop(asks);
    Ok(times.lock().unwrap_or_else(PoisonError::into_inner).figures())
}
