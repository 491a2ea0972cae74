//! One live station in the foreground: its options, its real-time thread, its control thread.

pub mod access;
mod claim;
mod counts;
mod desk;
pub mod echoes;
mod failures;
mod halt;
mod limits;
pub mod link;
pub mod misses;
mod own_slots;
pub mod packages;
mod programs;
mod reach;
pub mod sockets;
pub mod stack;
mod teller;
pub mod traffic;
pub mod vnic;
mod wire;

use std::io::BufRead;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ::vnic::tun::put_back;
use anyhow::{Context, Result, anyhow, bail};
use caps::CapSet;
use nix::sys::eventfd::{EfdFlags, EventFd};
use package_router::node::Node;
use rtmac::tdma::change::ChangeConfig;
use rtmac::tdma::{DEFAULT_MAX_REQUESTS, MasterConfig, RoleConfig, SlaveConfig};
use rtmac::token;
use rtnet::api::line::Lines;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::Service;
use rtnet::live::interface::Interface;
use rtnet::live::realtime::{MASTER_PRIORITY, RealTime, SLAVE_PRIORITY};
use rtnet::live::{ClockOrder, Data, Driver, DriverConfig, GuardMode, Port, TimeBoard};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType};

use crate::control::Server;
use crate::daemon;
use crate::metrics::{Bound, Page};
use crate::remedy::explained;
use access::{Access, AccessConfig};
use claim::Claim;
use desk::Desk;
pub use desk::epoch;
use echoes::Asker;
use link::{LabOptions, Order};
pub use own_slots::OwnSlots;
use packages::PackagesOptions;
use programs::Programs;
use reach::{Reach, reach_as_asked, reach_by_interface};
use sockets::Sockets;
use stack::StackOptions;
use teller::Teller;
use traffic::{Traffic, TrafficCounts, TrafficPlan};
use vnic::{Opened, Running, VnicOptions};
use wire::Wire;

/// Part of the sync window in which a Synchronisation may be begun; the rest is for its time on the air.
const SYNC_LATEST_PARTS: (i64, i64) = (3, 4);
/// Stack of the real-time thread: locked in memory, so no larger than needed.
const STACK: usize = 256 * 1024;
/// How often the control thread looks at what the real-time thread left, and another at the interface.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// How often to look whether the loop has taken what it was ordered before.
const LOOK_AT_ORDER_EVERY: Duration = Duration::from_millis(1);

/// What a station is to be.
#[derive(Clone, Debug)]
pub struct Options {
    /// The interface to run on.
    pub interface: String,
    /// A name that no other station on this machine has: under it the station is looked at and changed. If it is not
    /// given, the interface's, as long as nobody else has that.
    pub name: Option<String>,
    /// How it is to share the medium.
    pub access: AccessConfig,
    /// What it is told so that it takes part in changes of the schedule, if it does.
    pub changes: Option<ChangeConfig>,
    /// How long after its begin a slot that is defined later may still be used.
    pub latest: Span,
    /// What changes of its slots are judged by; none in a lab, which judges them itself.
    pub own_slots: Option<OwnSlots>,
    /// Whether to ask for SCHED_FIFO.
    pub fifo: bool,
    /// Whether it never sleeps, where there are no slots to sleep for.
    pub busy: bool,
    /// The core for the real-time thread.
    pub cpu: Option<usize>,
    /// How long before its instant a frame is spun for.
    pub spin: Span,
    /// Whether the kernel is to enforce its slots.
    pub guard: GuardMode,
    /// Whether the kernel's guard is to keep all other programs off the interface.
    pub exclusive: bool,
    /// Its address and its sockets, if it is to have some.
    pub stack: Option<StackOptions>,
    /// Its VNIC, if it is to have one.
    pub vnic: Option<VnicOptions>,
    /// Its packages, if it is to have a broker.
    pub packages: Option<PackagesOptions>,
    /// Where it serves its figures for Prometheus, if it does.
    pub metrics: Option<SocketAddr>,
    /// Set by a lab.
    pub lab: Option<LabOptions>,
}

impl Options {
    /// The clock that the station is to have.
    pub fn clock(&self) -> EmulatedClock {
        self.lab.as_ref().map_or_else(EmulatedClock::default, LabOptions::clock)
    }

    /// How it follows a master, as a slave or when it is none itself.
    fn follow(&self) -> SlaveConfig {
        match self.access.tdma().map(|tdma| tdma.role) {
            Some(RoleConfig::Master(MasterConfig { follow, .. }) | RoleConfig::Slave(follow)) => follow,
            None => SlaveConfig::default(),
        }
    }

    /// Calibration requests that it answers at a time as a master.
    fn max_requests(&self) -> usize {
        match self.access.tdma().map(|tdma| tdma.role) {
            Some(RoleConfig::Master(MasterConfig { max_requests, .. })) => max_requests,
            Some(RoleConfig::Slave(_)) | None => DEFAULT_MAX_REQUESTS,
        }
    }
}

/// How long after a cycle's start its Synchronisation may still be begun.
pub fn sync_latest(window: Span) -> Span {
    window * SYNC_LATEST_PARTS.0 / SYNC_LATEST_PARTS.1
}

/// A station whose sockets are open and whose name is taken.
pub struct Ready {
    driver: Driver<Access>,
    realtime: RealTime,
    guarded: bool,
    guard_refused: Option<String>,
    vnic: Option<Opened>,
    vnic_refused: Option<String>,
    counts: Arc<TrafficCounts>,
    stop: Arc<AtomicBool>,
    in_lab: bool,
    /// By its command line.
    is_master: bool,
    teller: Teller,
    desk: Desk,
    /// Of programs, at the most.
    sockets: Option<usize>,
    reach: Reach,
    packages: Option<PackagesOptions>,
    metrics: Option<Bound>,
    /// Wakes the control thread.
    changed: Arc<EventFd>,
    /// Gone when the station is.
    _claim: Claim,
}

/// Makes a station ready to run; fails if it cannot be what it is to be.
pub fn set_up(options: Options) -> Result<Ready> {
    // Whoever is told to end from now on leaves nothing behind.
    let stop = Arc::new(AtomicBool::new(false));
    stop_at_signals(&stop, options.lab.is_some())?;
    limits::raise_files();
    let asked = reach_as_asked(&options)?;
    let interface = Interface::find(&options.interface)?;
    let claim = Claim::of(&interface, options.name.as_deref().unwrap_or(&interface.name))?;
    let metrics = options.metrics.map(Bound::at).transpose()?;
    let flows = options.lab.as_ref().map(|lab| &lab.flows);
    let counts = Arc::new(flows.map(TrafficCounts::of).unwrap_or_default());
    let mut port = port(&options, &interface)?;
    let bells = port.bells();
    let programs =
        options.stack.as_ref().map(|stack| Programs::new(stack.socket_buffers.into(), &bells)).transpose()?;
    halt::arm(&mut port, options.lab.as_ref().is_some_and(|lab| lab.may_stall))?;
    // Who may not run a station leaves no directory of names behind.
    let mut reach = asked.unwrap_or_else(|| reach_by_interface(&options.interface));
    let (guarded, guard_refused) = (port.is_guarded(), port.guard_refused().map(str::to_owned));
    let changed = Arc::new(EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC)?);
    if let Some(server) = &mut reach.server {
        server.wake_by(changed.clone());
    }
    let config = DriverConfig {
        stop: stop.clone(),
        sample_time: options.lab.is_some(),
        changed: Some(changed.clone()),
    };
    let asker = programs.as_ref().map(|programs| programs.echoes.asker());
    let has_slots = options.access.tdma().is_some();
    // A lab's namespaces go with it.
    let notes = options.lab.is_none().then(vnic::notes).flatten();
    if let Some(notes) = &notes {
        put_back(&interface, notes);
    }
    let opened = options.vnic.as_ref();
    let opened = opened.map(|vnic| vnic::open(vnic, (&interface, notes), &mut port, has_slots, &stop));
    let (vnic, tunnel, vnic_refused) = match opened {
        Some(Ok((vnic, tunnel))) => (Some(vnic), Some(tunnel), None),
        Some(Err(why)) => (None, None, Some(why)),
        None => (None, None, None),
    };
    let driver = driver(&options, &interface, port, config, counts.clone(), asker, tunnel)?;
    let in_lab = options.lab.is_some();
    let is_master = options.access.is_master();
    let priority = if is_master { MASTER_PRIORITY } else { SLAVE_PRIORITY };
    let realtime = RealTime { priority: options.fifo.then_some(priority), cpu: options.cpu };
    let wire = Wire::open(&interface, driver.mtu())?;
    let desk = Desk::new(&options, &driver, interface.address, wire, counts.clone())
        .with_programs(programs)
        .with_vnic(
            vnic.as_ref().map(|vnic| vnic.told.clone()).map(Ok).or_else(|| vnic_refused.clone().map(Err)),
        );
    let teller = Teller::new(&options, interface.address, guarded);
    Ok(Ready {
        driver,
        realtime,
        guarded,
        guard_refused,
        vnic,
        vnic_refused,
        counts,
        stop,
        in_lab,
        is_master,
        teller,
        desk,
        sockets: options.stack.as_ref().map(|stack| stack.room().sockets),
        reach,
        packages: options.packages,
        metrics,
        changed,
        _claim: claim,
    })
}

impl Ready {
    /// Where threads of this process read the time and wait for cycles, as long as the station runs.
    pub fn time(&self) -> Arc<TimeBoard> {
        self.driver.time()
    }

    /// Runs until told to stop, or until the station cannot go on.
    pub fn run(mut self) -> Result<()> {
        let clocks = self.in_lab.then(|| self.driver.clock_order());
        // Before this thread gives up what that one needs. However the station ends, its device is gone before it is.
        let vnic = match self.vnic.map(|vnic| vnic.start(self.realtime.cpu)).transpose() {
            Ok(vnic) => vnic,
            Err(why) => {
                self.desk = self.desk.with_vnic(Some(Err(why.clone())));
                self.vnic_refused = Some(why);
                None
            }
        };
        let real_time_core = self.realtime.cpu;
        let (thread, mut refused) = start(self.driver, self.realtime)?;
        refused.extend(self.guard_refused);
        refused.extend(self.vnic_refused);
        refused.extend(self.reach.refused);
        self.sockets.into_iter().for_each(limits::raise_locked);
        // What this thread may still do is what those that it starts may do. The other one may have said the same.
        refused.extend(drop_capabilities().filter(|line| !refused.contains(line)));
        if let Some(clocks) = clocks {
            obey_lab(&self.stop, clocks)?;
        }
        let has_sockets = self.sockets.is_some();
        let packages = start_packages(
            self.packages,
            self.reach.server.as_ref(),
            has_sockets.then(|| self.desk.sockets()),
            real_time_core,
        )?;
        self.desk = self.desk.with_tcp(packages.as_ref().and_then(Node::tcp));
        self.desk.watch_wire(LOOK_EVERY, self.changed)?;
        self.desk.note_host(&refused, self.guarded);
        self.teller.started(self.guarded, refused)?;
        let page = self.metrics.map(|bound| serve_figures(bound, &self.teller)).transpose()?;
        let mut told = Instant::now();
        loop {
            let ended = thread.is_finished();
            match &mut self.reach.server {
                Some(server) => server.serve_all(LOOK_EVERY, &mut self.desk),
                None => std::thread::sleep(LOOK_EVERY),
            }
            self.desk.tidy();
            page.iter().for_each(|page| page.write(|| self.desk.figures()));
            // However many ask, a lab is told at its own pace, but of another state at once.
            let is_other = self.desk.has_another_state() || self.desk.has_news_of_wire();
            if told.elapsed() < LOOK_EVERY && !ended && !is_other {
                continue;
            }
            told = Instant::now();
            let changes = self.desk.look_at_wire();
            let (newest, link) = (self.desk.news(), self.desk.link());
            // Who was made a master by command stays, and says whom it makes way for.
            let yielded =
                self.teller.tell(self.desk.records(), newest, &self.counts, link)?.filter(|_| self.is_master);
            if let Some(why) = self.teller.tell_of_wire(&changes)?.or(yielded) {
                self.stop.store(true, Ordering::Relaxed);
                bail!(why);
            }
            if ended {
                // Nobody waits for a mailbox of a station that is gone.
                drop(packages);
                return self::ended(thread, vnic);
            }
        }
    }
}

/// Serves the page that the control thread writes; from a thread without capabilities, as this one has none any more.
fn serve_figures(bound: Bound, teller: &Teller) -> Result<Arc<Page>> {
    let page = Arc::new(Page::default());
    let of_reader = page.clone();
    teller.tell_of_figures(bound.serve(move || of_reader.read())?);
    Ok(page)
}

/// What a station ends with whose real-time thread has. Its device is gone before it is.
fn ended(thread: JoinHandle<()>, vnic: Option<Running>) -> Result<()> {
    drop(vnic);
    thread.join().map_err(|_| anyhow!("the real-time thread panicked"))
}

/// Starts the broker of who wants one, and can be found.
fn start_packages(
    options: Option<PackagesOptions>,
    server: Option<&Server>,
    sockets: Option<Arc<Sockets>>,
    not_on: Option<usize>,
) -> Result<Option<Node>> {
    let Some((options, server)) = options.zip(server) else { return Ok(None) };
    packages::start(options, server.path(), sockets, not_on).map(Some)
}

/// Starts the real-time thread; with what the host refused it.
fn start(mut driver: Driver<Access>, realtime: RealTime) -> Result<(JoinHandle<()>, Vec<String>)> {
    let (told, refusals) = std::sync::mpsc::channel();
    let builder = std::thread::Builder::new().name("real-time".into()).stack_size(STACK);
    let thread = builder.spawn(move || {
        let mut refused = realtime.apply();
        refused.extend(drop_capabilities());
        // The other end waits for exactly this message.
        let _ = told.send(refused);
        driver.run();
    });
    let thread = thread.map_err(explained).context("the real-time thread cannot start")?;
    Ok((thread, refusals.recv().context("the real-time thread did not start")?))
}

/// A port that hears the test traffic, in a lab, and everything for who has sockets.
fn port(options: &Options, interface: &Interface) -> Result<Port> {
    let data = match &options.lab {
        _ if options.stack.is_some() => Data::All,
        lab => Data::Only(match (&options.access, lab) {
            (AccessConfig::Token(_), Some(_)) => &[token::wire::TOKEN, EtherType::EXPERIMENTAL],
            (AccessConfig::Token(_), None) => &[token::wire::TOKEN],
            (_, Some(_)) => &[EtherType::EXPERIMENTAL],
            (_, None) => &[],
        }),
    };
    let spin = options.spin.nanos().max(0) as u64;
    let mut port = Port::open(interface, data, options.clock(), spin, options.guard)?;
    if let Some(stack) = &options.stack {
        port = port.with_receive_buffers(stack.receive_buffers);
    }
    if options.exclusive {
        port.keep_others_off();
    }
    Ok(port)
}

fn driver(
    options: &Options,
    interface: &Interface,
    port: Port,
    config: DriverConfig,
    counts: Arc<TrafficCounts>,
    asker: Option<Asker>,
    tunnel: Option<Box<dyn Service>>,
) -> Result<Driver<Access>> {
    let discipline = Access::new(&options.access, interface.address)?.with_changes(options.changes.as_ref());
    // What it has goes before test traffic, which is there to fill slots.
    let mut services: Vec<Box<dyn Service>> = tunnel.into_iter().collect();
    if let Some(lab) = &options.lab {
        let plan = TrafficPlan {
            station: lab.station,
            source: interface.address,
            destination: Address(lab.destination),
            from: lab.from,
            payload: lab.payload,
            from_payload: lab.from_payload,
            first: lab.first,
        };
        services.push(Box::new(Traffic::new(plan, counts).with_flows(lab.flows.clone())));
    }
    let mut station = Station::new(discipline, services);
    if let Some(stack) = &options.stack {
        station = station.with_stack(stack.stack(interface.address, asker, options.packages.as_ref())?);
    }
    let mut driver = Driver::new(station, port, config).spinning(options.busy);
    if options.stack.as_ref().is_some_and(|stack| stack.package_times) {
        let time = driver.time();
        let sockets = driver.station_mut().stack_mut();
        let lines = sockets.and_then(|(stack, _)| stack.program_mut::<Lines>());
        lines.into_iter().for_each(|lines| lines.tell_times(time.clone()));
    }
    Ok(driver)
}

/// Once its sockets are open and its thread is set up, a station needs no capability any more. A line if the kernel
/// does not let go of them.
pub fn drop_capabilities() -> Option<String> {
    let sets = [CapSet::Ambient, CapSet::Effective, CapSet::Permitted, CapSet::Inheritable];
    let dropped = sets.into_iter().try_for_each(|set| caps::clear(None, set));
    dropped.err().map(|error| format!("capabilities: {error}: the station keeps all that it was given"))
}

/// A person presses Ctrl-C, which goes to the whole group: of a lab's stations the lab decides when they end.
fn stop_at_signals(stop: &Arc<AtomicBool>, in_lab: bool) -> Result<()> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    signal_hook::flag::register(SIGTERM, stop.clone())?;
    let interrupted = if in_lab { Arc::default() } else { stop.clone() };
    signal_hook::flag::register(SIGINT, interrupted)?;
    Ok(())
}

/// A lab closes our input when it ends or dies, and has its orders there.
fn obey_lab(stop: &Arc<AtomicBool>, clocks: Arc<ClockOrder>) -> Result<()> {
    let stop = stop.clone();
    std::thread::Builder::new().name("lab".into()).stack_size(STACK / 2).spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            // A lab is this very program: it says nothing else.
            match serde_json::from_str(&line) {
                Ok(Order::Stall(nanos)) => halt::stall_next(nanos),
                // Without /dev/null it leads where nobody reads.
                Ok(Order::LeaveErrors) => drop(daemon::leave_errors()),
                Ok(Order::Clock { anchor, offset_ns, drift_ppb }) => {
                    let offset = Span::from_nanos(offset_ns);
                    set_clock(&clocks, &stop, &EmulatedClock { anchor, offset, drift_ppb });
                }
                Err(_) => {}
            }
        }
        stop.store(true, Ordering::Relaxed);
    })?;
    Ok(())
}

/// The loop takes a clock once in a turn, as long as it runs.
fn set_clock(clocks: &ClockOrder, stop: &AtomicBool, clock: &EmulatedClock) {
    while !clocks.give(clock) && !stop.load(Ordering::Relaxed) {
        std::thread::sleep(LOOK_AT_ORDER_EVERY);
    }
}
