//! A lab from its begin to its end: set up, wait for all to be locked and settled, measure, report.

use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use rtnet::clock::True;
use rtnet::live::clock::{WallClock, monotonic, realtime};
use rtnet::live::realtime::WarmCore;
use rtnet::live::ring::{CaptureRing, RingConfig};
use rtnet::time::{GlobalTime, Offset, Span};

use super::faults::{Play, only_simulated};
use super::guests::Guests;
use super::launch::Launch;
use super::lead::{WakeUps, lead};
use super::load::{Core, load, too_much};
use super::members::{Member, lost_at_most};
use super::namespace::{Namespace, Segment};
use super::processes::Told;
use super::wires::Wires;
use crate::control::{Directory, Home, Load};
use crate::judge::account::Account;
use crate::judge::analysis::Analysis;
use crate::judge::explain::Records;
use crate::judge::givers::TrueMaster;
use crate::judge::outcome::{self, Outcome, Parts};
use crate::report::capture::{Capture, CaptureFile};
use crate::report::host::HostFacts;
use crate::report::verdict::Interrupted;
use crate::scenario::Scenario;
use crate::station::link::{self, Report};

/// The name of a station's interface in its namespace.
pub const INTERFACE: &str = "rt0";
/// How often frames and reports are looked at.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(10);
/// Cycles between the last look at the stations and the begin of the measurement.
pub(super) const SETTLE_CYCLES: u32 = 50;
/// How long the end of a run, and its first sync, may take.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// After the last cycle, frames are still in the ring for up to its retirement time.
const LINGER: Duration = Duration::from_millis(100);
/// Frames that the kernel stamped before a step of the wall clock may still come out of the ring for so long.
const DISTRUST: Duration = Duration::from_millis(100);
/// A lab without its master ends so much later than it was to, without a sync that says so.
const END_WITHOUT_MASTER: True = 100_000_000;
/// Progress is shown so often on anything that takes longer than this.
const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// A station's port of the bridge.
pub(crate) fn port_name(station: usize) -> String {
    format!("port{station}")
}

/// How to run a scenario.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// Keep the real-time core from idling.
    pub warm_core: bool,
    /// The core of all real-time threads.
    pub core: Core,
    /// Where to write every frame.
    pub pcap: Option<PathBuf>,
    /// Where to write how a lab that stayed has ended.
    pub json: Option<PathBuf>,
    /// Where its stations are to be asked, if they are to be.
    pub home: Option<Home>,
    /// Its caller goes once it is up, and nobody reads its standard error then.
    pub detached: bool,
    /// Where labs say what they take of a core.
    pub directory: Option<Directory>,
    /// Show how it goes on standard error.
    pub progress: bool,
    /// Keep what the pictures of a report show.
    pub pictures: bool,
}

/// A network that has been stood up; dropping it takes it down.
pub struct Lab {
    // Fields are dropped in this order: processes first, then what they live in.
    pub(super) guests: Guests,
    pub(super) members: Vec<Member>,
    pub(super) teller: Sender<Told>,
    told: Receiver<Told>,
    pub(super) launch: Launch,
    ring: CaptureRing,
    /// Frames and blocks that the ring has lost.
    lost: u64,
    wall: WallClock,
    distrusted_until: Option<Instant>,
    distrusted: u64,
    pub(super) capture: Capture,
    pub(super) analysis: Analysis,
    pub(super) records: Records,
    _warm: Option<WarmCore>,
    /// What becomes of frames at the ports of its bridge.
    pub(super) wires: Wires,
    pub(super) segment: Segment,
    pub(super) notes: Vec<String>,
    /// The core of its real-time threads.
    pub(super) cpu: usize,
    /// What they take of it, as a share.
    pub(super) load: f64,
    /// The same, as other labs see it, if they run with SCHED_FIFO.
    pub(super) declared: Option<Load>,
    pub(super) interrupted: Arc<AtomicBool>,
    next_progress: Option<Instant>,
    /// What is still to happen to it.
    pub(super) play: Play,
}

impl Lab {
    /// Waits until all stations are locked and their clocks settled, measures, and takes the network down again.
    pub fn run(mut self, scenario: &Scenario) -> Result<Outcome> {
        self.join(scenario)?;
        self.settle(scenario);
        let host = HostFacts::begin_on(self.cpu);
        self.measure(scenario)?;
        self.end();
        Ok(outcome::of(scenario, self.parts(scenario), host.finish()))
    }

    /// Stands a network up: its medium, its namespaces.
    pub fn set_up(scenario: &Scenario, options: &RunOptions) -> Result<Self> {
        let mut notes = only_simulated(&scenario.conditions);
        let Core { cpu, note } = options.core.clone();
        notes.extend(note);
        let interrupted = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            signal_hook::flag::register(signal, interrupted.clone())?;
        }
        // Of a lab that is kept, one reads what there is so far.
        let capture = match options.home {
            Some(_) => CaptureFile::create,
            None => CaptureFile::replace,
        };
        let capture = Capture::of(options.pcap.as_deref().map(capture).transpose()?);

        let mut segment = Segment::new()?;
        let bridge = segment.bridge_name().to_owned();
        let ring = segment.namespace().run(|| CaptureRing::open(&bridge, RingConfig::default()))??;
        let anchor = monotonic();
        let mut members: Vec<Member> = Vec::new();
        for station in 0..scenario.stations.len() {
            let namespace = Namespace::new()?;
            segment.attach(&namespace, &port_name(station), INTERFACE, scenario.address(station).0)?;
            members.push(Member::new(namespace, scenario.cycle));
        }
        let (wires, unimpaired) = Wires::of(scenario, &segment)?;
        notes.extend(unimpaired);
        let clock = super::launch::clock(scenario, 0, anchor);
        let epoch = Offset::between(clock.local(anchor), GlobalTime::from_nanos(realtime()));
        let master = TrueMaster { clock, epoch };
        let mut analysis = Analysis::new(scenario, master);
        if options.pictures {
            analysis.look_closely(scenario);
        }
        let warm = match options.warm_core.then(|| WarmCore::start(cpu)) {
            Some(Err(line)) => {
                notes.push(line);
                None
            }
            started => started.and_then(Result::ok),
        };
        let lead = lead(scenario, WakeUps::measure(cpu));
        let load = load(scenario, lead);
        let declared =
            options.directory.as_ref().map(|directory| Load::declare(directory, cpu, load)).transpose();
        let declared = declared.unwrap_or_else(|error| {
            notes.push(format!("other labs do not see what this one takes of cpu {cpu}: {error:#}"));
            None
        });
        let too_much = too_much(cpu, load, declared.as_ref());
        let fifo = too_much.is_none();
        // The kernel throttles SCHED_FIFO only: a lab without it declares no load.
        let declared = declared.filter(|_| fifo);
        notes.extend(too_much.map(|why| {
            format!("{why}, so they run without it (fewer stations or a longer --cycle gives it back)")
        }));
        let (teller, told) = channel();
        let launch = Launch { anchor, epoch, cpu, lead, fifo, home: options.home.clone() };
        Ok(Self {
            guests: Guests::of(members.iter().map(|member| &member.namespace))?,
            members,
            teller,
            told,
            launch,
            ring,
            lost: 0,
            wall: WallClock::default(),
            distrusted_until: None,
            distrusted: 0,
            capture,
            analysis,
            records: Records::new(scenario),
            _warm: warm,
            wires,
            segment,
            notes,
            cpu,
            load,
            declared,
            interrupted,
            play: Play::default(),
            next_progress: options.progress.then(|| Instant::now() + PROGRESS_EVERY),
        })
    }

    /// Measures for the scenario's duration, or until interrupted or a station is lost.
    fn measure(&mut self, scenario: &Scenario) -> Result<()> {
        let cycles =
            (scenario.duration.nanos() / scenario.cycle.nanos()).clamp(1, i64::from(i32::MAX)) as u32;
        let begin = self.begin(cycles)?;
        self.prepare(scenario, begin);
        let end = begin + scenario.duration.nanos() as u64 + END_WITHOUT_MASTER;
        let allowed = Duration::from_nanos(scenario.duration.nanos() as u64) * 2 + ANSWER_WITHIN;
        let deadline = Instant::now() + allowed;
        while !self.analysis.is_complete() && (self.has_master() || monotonic() < end) {
            self.look();
            self.play(scenario)?;
            let ended = self.members.iter().any(|member| member.ended);
            if ended || self.interrupted.load(Ordering::Relaxed) || Instant::now() > deadline {
                break;
            }
            let done = self.analysis.cycles();
            let findings = self.analysis.findings.len();
            self.show_progress(|| format!("cycle {done} of {cycles}, {findings} misses"));
        }
        // An interrupt from here on no longer shortens the run.
        self.interrupted = Arc::new(AtomicBool::new(self.interrupted.load(Ordering::Relaxed)));
        self.note_late_events();
        self.note_end_without_master();
        self.analysis.end();
        for member in &mut self.members {
            member.stop_counting(
                lost_at_most(scenario.cycle).min(Span::from_nanos(scenario.duration.nanos() / 4)),
            );
        }
        Ok(())
    }

    /// From here on, for so many cycles, all counts: when the first of them begins.
    pub(super) fn begin(&mut self, cycles: u32) -> Result<True> {
        let (current, start) = self.see_sync()?;
        self.analysis.begin(current.wrapping_add(SETTLE_CYCLES), cycles);
        self.members.iter_mut().for_each(Member::begin);
        Ok(self.analysis.truth().truth(start + self.analysis.cycle() * i64::from(SETTLE_CYCLES)))
    }

    /// Waits for the first sync: a frame is in the ring for up to its retirement time, and stations that do not calibrate
    /// are locked sooner.
    fn see_sync(&mut self) -> Result<(u32, GlobalTime)> {
        let deadline = Instant::now() + ANSWER_WITHIN;
        loop {
            if let Some(grid) = self.analysis.grid() {
                return Ok(grid);
            }
            if self.interrupted.load(Ordering::Relaxed) {
                bail!(Interrupted("no sync was seen yet".into()));
            }
            ensure!(
                Instant::now() < deadline,
                "stations are locked, but no sync was seen on their bridge for {ANSWER_WITHIN:?}"
            );
            self.look();
        }
    }

    /// Ends every station, and takes what it still has to tell.
    pub(super) fn end(&mut self) {
        let linger = Instant::now() + LINGER;
        while Instant::now() < linger {
            self.look();
        }
        self.notes.extend(self.guests.end());
        for member in &mut self.members {
            member.note_memory();
            member.tell_to_end();
        }
        let deadline = Instant::now() + ANSWER_WITHIN;
        while !self.members.iter().all(|member| member.silent) && Instant::now() < deadline {
            self.members.iter_mut().for_each(Member::end_if_stopped);
            self.look();
        }
        self.members.iter_mut().for_each(Member::see_it_end);
        self.analysis.finish();
        self.capture.finish();
    }

    /// Waits a little, and takes what frames and reports there are.
    pub(super) fn look(&mut self) {
        std::thread::sleep(LOOK_EVERY);
        self.take_in();
    }

    /// Takes what frames and reports there are.
    pub(super) fn take_in(&mut self) {
        if !self.wall.sample() {
            self.distrusted_until = Some(Instant::now() + DISTRUST);
            self.analysis.lose_sight();
        }
        let trusted = self.distrusted_until.is_none_or(|until| Instant::now() > until);
        let Self { ring, wall, analysis, records, capture, distrusted, .. } = self;
        ring.drain(|frame| {
            capture.frame(frame.realtime_ns, frame.bytes, None);
            records.note_frame(frame.bytes);
            if frame.after_loss {
                analysis.lose_sight();
            }
            if trusted {
                analysis.frame(wall.truth(frame.realtime_ns), frame.bytes);
            } else {
                *distrusted += 1;
            }
        });
        capture.show();
        let lost = ring.dropped().map_or(self.lost, |dropped| dropped + ring.unreadable());
        if lost > self.lost {
            // The ring may be full still: what it loses from here on has no frame behind it yet.
            self.lost = lost;
            self.analysis.lose_sight();
        }
        while let Ok((station, report)) = self.told.try_recv() {
            self.note_absence(station, report.as_ref());
            if let Some(Report::Times(times)) = &report {
                let times = times.iter().map(|&(at, global)| (at, GlobalTime::from_nanos(global)));
                times.for_each(|(at, global)| self.analysis.told_time(station, at, global));
            }
            if let Some(Report::Events(events)) = &report {
                for (author, kind, span, cause) in link::told(station, events) {
                    self.analysis.told(author, kind, span, cause);
                }
            }
            self.members[station].take(station, report, &mut self.records, self.analysis.truth());
        }
        self.take_lost();
        self.note_returns();
    }

    /// Takes what the wires have lost.
    pub(super) fn take_lost(&mut self) {
        let Self { wires, records, .. } = self;
        wires.take_lost(|station, sync, is_cut| records.note_sync_lost(station, sync, is_cut));
    }

    /// Frames of which nothing is known: lost by the observer, or stamped while the wall clock was set.
    pub(super) fn not_judged(&self) -> u64 {
        self.lost + self.distrusted
    }

    pub(super) fn show_progress(&mut self, what: impl Fn() -> String) {
        if let Some(next) = &mut self.next_progress
            && Instant::now() >= *next
        {
            *next += PROGRESS_EVERY;
            // Whoever started it and hears nothing any more has gone, and cannot end it later.
            if writeln!(std::io::stderr(), "rtnet: {}", what()).is_err() {
                self.interrupted.store(true, Ordering::Relaxed);
            }
        }
    }

    fn parts(mut self, scenario: &Scenario) -> Parts {
        let interrupted = self.interrupted.load(Ordering::Relaxed);
        let is_judged = !interrupted && self.analysis.cycles() > 0;
        Parts {
            stations: self.facts(scenario, is_judged),
            dropped: self.lost,
            // A lost station ends the run, and says so itself.
            interrupted,
            ended_early: self.members.iter().any(|member| member.ended),
            wall_steps: self.wall.steps(),
            distrusted: self.distrusted,
            capture_failed: self.capture.failed().map(str::to_owned),
            account: Account::of(scenario, &mut self.analysis, &self.records),
            lead: self.launch.lead,
            analysis: self.analysis,
            notes: self.notes,
        }
    }
}
