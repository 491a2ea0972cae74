//! One live station in the foreground: its options, its real-time thread, what it tells.

pub mod link;
pub mod traffic;

use std::fs::File;
use std::io::{Read, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use nix::fcntl::{Flock, FlockArg};
use rtmac::tdma::{RoleConfig, Tdma, TdmaConfig, TdmaStatus};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Event, EventKind, Service, SyncState};
use rtnet::live::interface::Interface;
use rtnet::live::realtime::{MASTER_PRIORITY, RealTime, SLAVE_PRIORITY};
use rtnet::live::{Driver, DriverConfig, Port, Record, Snapshot};
use rtnet::station::Station;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType};

use link::{LabOptions, Report, Standing};
use traffic::{Traffic, TrafficCounts, TrafficPlan};

/// Where names of running stations are kept, so that none is taken twice.
const NAMES: &str = "/run/rtnet";
/// Stack of the real-time thread: locked in memory, so no larger than needed.
const STACK: usize = 256 * 1024;
/// How often the control thread looks at what the real-time thread left.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// What a station is to be.
#[derive(Clone, Debug)]
pub struct Options {
    /// The interface to run on.
    pub interface: String,
    /// A name that no other station on this machine has.
    pub name: Option<String>,
    /// Everything of the discipline but the address, which is the interface's.
    pub tdma: TdmaConfig,
    /// The core for the real-time thread.
    pub cpu: Option<usize>,
    /// How long before its instant a frame is spun for.
    pub spin: Span,
    /// Set by a lab.
    pub lab: Option<LabOptions>,
}

/// A station whose sockets are open and whose name is taken.
pub struct Ready {
    driver: Driver<Tdma>,
    realtime: RealTime,
    counts: Arc<TrafficCounts>,
    stop: Arc<AtomicBool>,
    teller: Teller,
    _name: Option<Flock<File>>,
}

/// Makes a station ready to run; fails if it cannot be what it is to be.
pub fn set_up(options: Options) -> Result<Ready> {
    let name = options.name.as_deref().map(take_name).transpose()?;
    let interface = Interface::find(&options.interface)?;
    let stop = Arc::new(AtomicBool::new(false));
    let counts = Arc::new(TrafficCounts::default());
    let driver = driver(&options, &interface, stop.clone(), counts.clone())?;
    stop_when_told(&stop, options.lab.is_some())?;
    let is_master = matches!(options.tdma.role, RoleConfig::Master(_));
    let priority = if is_master { MASTER_PRIORITY } else { SLAVE_PRIORITY };
    let realtime = RealTime { priority, cpu: options.cpu };
    let teller = Teller::new(&options, interface.address);
    Ok(Ready { driver, realtime, counts, stop, teller, _name: name })
}

impl Ready {
    /// Runs until told to stop, or until the station cannot go on.
    pub fn run(mut self) -> Result<()> {
        let (records, snapshots) = (self.driver.records(), self.driver.snapshots());
        let (mut driver, realtime) = (self.driver, self.realtime);
        let (told, refusals) = std::sync::mpsc::channel();
        let builder = std::thread::Builder::new().name("real-time".into()).stack_size(STACK);
        let thread = builder.spawn(move || {
            // The other end waits for exactly this message.
            let _ = told.send(realtime.apply());
            driver.run();
        })?;
        self.teller.started(refusals.recv().context("the real-time thread did not start")?)?;
        loop {
            let ended = thread.is_finished();
            std::thread::sleep(LOOK_EVERY);
            let taken = std::iter::from_fn(|| records.pop()).collect();
            let newest = std::iter::from_fn(|| snapshots.pop()).last();
            if let Some(why) = self.teller.tell(taken, newest, &self.counts)? {
                self.stop.store(true, Ordering::Relaxed);
                bail!(why);
            }
            if ended {
                return thread.join().map_err(|_| anyhow!("the real-time thread panicked"));
            }
        }
    }
}

fn driver(
    options: &Options,
    interface: &Interface,
    stop: Arc<AtomicBool>,
    counts: Arc<TrafficCounts>,
) -> Result<Driver<Tdma>> {
    let tdma = TdmaConfig { address: interface.address, ..options.tdma.clone() };
    let discipline = Tdma::new(&tdma).map_err(|refused| anyhow!(refused))?;
    let mut services: Vec<Box<dyn Service>> = Vec::new();
    let mut data = Vec::new();
    if let Some(lab) = &options.lab {
        let plan = TrafficPlan {
            station: lab.station,
            source: interface.address,
            destination: Address(lab.destination),
            from: lab.from,
            payload: lab.payload,
            from_payload: lab.from_payload,
        };
        services.push(Box::new(Traffic::new(plan, counts)));
        data.push(EtherType::EXPERIMENTAL);
    }
    let clock = options.lab.as_ref().map_or_else(EmulatedClock::default, LabOptions::clock);
    let port =
        Port::open(interface, &data, clock, options.spin.nanos().max(0) as u64).with_context(|| {
            format!("packet sockets on '{}' (run as root, or give CAP_NET_RAW)", interface.name)
        })?;
    let config = DriverConfig { stop, sample_time: options.lab.is_some() };
    Ok(Driver::new(Station::new(discipline, services), port, config))
}

/// A name is a lock that the kernel gives up with the process.
fn take_name(name: &str) -> Result<Flock<File>> {
    if name.is_empty() || !name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b)) {
        bail!("'{name}' is no name for a station: use letters, digits, '-', '_' and '.'");
    }
    std::fs::create_dir_all(NAMES).with_context(|| format!("{NAMES} cannot be made"))?;
    let path = PathBuf::from(NAMES).join(format!("{name}.lock"));
    let mut file = File::options().read(true).write(true).create(true).truncate(false).open(&path);
    let mut holder = String::new();
    if let Ok(file) = &mut file {
        // Only for the message below.
        let _ = file.read_to_string(&mut holder);
    }
    let file = file.with_context(|| format!("{} cannot be opened", path.display()))?;
    let mut lock = Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|_| {
        let holder = holder.trim();
        anyhow!("the name '{name}' is taken by process {holder}: choose another --name, or stop that one")
    })?;
    lock.set_len(0)?;
    std::io::Seek::rewind(&mut *lock)?;
    writeln!(lock, "{}", std::process::id())?;
    Ok(lock)
}

/// A lab closes our input when it ends or dies; a person presses Ctrl-C.
fn stop_when_told(stop: &Arc<AtomicBool>, in_lab: bool) -> Result<()> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    signal_hook::flag::register(SIGTERM, stop.clone())?;
    if !in_lab {
        signal_hook::flag::register(SIGINT, stop.clone())?;
        return Ok(());
    }
    // Ctrl-C goes to the whole group; the lab decides when its stations end.
    signal_hook::flag::register(SIGINT, Arc::new(AtomicBool::new(false)))?;
    let stop = stop.clone();
    std::thread::Builder::new().name("lab".into()).stack_size(STACK / 2).spawn(move || {
        let mut byte = [0];
        while !matches!(std::io::stdin().read(&mut byte), Ok(0) | Err(_)) {}
        stop.store(true, Ordering::Relaxed);
    })?;
    Ok(())
}

/// Tells the lab in JSON lines, or a person in sentences.
enum Teller {
    Lab,
    Person { name: String, state: SyncState, last: Option<Box<TdmaStatus>> },
}

impl Teller {
    fn new(options: &Options, address: Address) -> Self {
        match options.lab {
            Some(_) => Teller::Lab,
            None => {
                let name = options.name.clone().unwrap_or_else(|| options.interface.clone());
                print(&format!("{name}: on {} ({address}); Ctrl-C ends it", options.interface));
                Teller::Person { name, state: SyncState::Waiting, last: None }
            }
        }
    }

    fn started(&self, refused: Vec<String>) -> Result<()> {
        match self {
            Teller::Lab => say(&Report::Started(refused)),
            Teller::Person { name, .. } => {
                refused.iter().for_each(|line| eprintln!("{name}: {line}"));
                Ok(())
            }
        }
    }

    /// Tells what is new; a reason to end, if there is one.
    fn tell(
        &mut self,
        records: Vec<Record>,
        snapshot: Option<Snapshot<TdmaStatus>>,
        counts: &TrafficCounts,
    ) -> Result<Option<String>> {
        let yielded = snapshot.and_then(|snapshot| snapshot.status.yielded_to).map(|other| {
            format!(
                "another master ({other}) is active on this medium: stop it, or run this station as --slave"
            )
        });
        match self {
            Teller::Lab => {
                link::reports(records.into_iter()).iter().try_for_each(say)?;
                if let Some(snapshot) = snapshot {
                    say(&Report::Standing(Box::new(Standing::of(&snapshot, counts))))?;
                }
                if let Some(why) = &yielded {
                    say(&Report::Failed(why.clone()))?;
                }
            }
            Teller::Person { name, state, last } => {
                for record in records {
                    if let Record::Event(event) = record
                        && event.kind != EventKind::SlotSilent
                    {
                        print(&format!("{name}: cycle {}: {}", event.cycle, event_line(&event)));
                    }
                }
                if let Some(Snapshot { status, .. }) = snapshot {
                    if status.state != *state {
                        *state = status.state;
                        print(&format!("{name}: {}", standing_line(&status)));
                    }
                    *last = Some(Box::new(status));
                }
            }
        }
        Ok(yielded)
    }
}

impl Drop for Teller {
    fn drop(&mut self) {
        if let Teller::Person { name, last: Some(status), .. } = self {
            let counters = &status.counters;
            print(&format!(
                "{name}: ended in cycle {} ({}): {} syncs sent, {} skipped, {} received; {} frames sent, {} \
                 overruns, {} stalled in send",
                status.cycle,
                status.state.name(),
                counters.syncs_sent,
                counters.syncs_skipped,
                counters.syncs_received,
                counters.frames_sent,
                counters.overruns,
                counters.stalled_in_send,
            ));
        }
    }
}

/// A line for a person; one who does not listen any more misses nothing.
fn print(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn event_line(event: &Event) -> String {
    let name = event.kind.name();
    match event.kind {
        EventKind::SendFailed => {
            format!("{name}: {}", std::io::Error::from_raw_os_error(event.span.nanos() as i32))
        }
        EventKind::SlotBeyondCycle => {
            format!("{name}: a slot begins {} after the master's cycle ends; change its --slot", event.span)
        }
        _ => format!("{name} ({})", event.span),
    }
}

fn standing_line(status: &TdmaStatus) -> String {
    let period = status.period.map_or("unknown".into(), |period| period.to_string());
    let delay = status.delay.map_or("not measured".into(), |delay| delay.to_string());
    format!("{}, cycle {} of {period}, delay {delay}", status.state.name(), status.cycle)
}

fn say(report: &Report) -> Result<()> {
    let mut line = serde_json::to_string(report)?;
    line.push('\n');
    let mut out = std::io::stdout().lock();
    out.write_all(line.as_bytes())?;
    Ok(out.flush()?)
}
