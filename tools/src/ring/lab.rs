//! A ring on this machine: each station a process in a namespace of its own, joined by a bridge, and watched from there.

mod member;
mod play;

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use rtnet::clock::{EmulatedClock, True};
use rtnet::live::clock::{WallClock, monotonic};
use rtnet::live::realtime::WarmCore;
use rtnet::live::ring::{CaptureRing, RingConfig as CaptureConfig};
use rtnet::time::Span;

use self::member::{Member, arguments};
use self::play::Play;
use super::figures::{self, RingFigures};
use super::judge::Judge;
use super::verdict::Observed;
use crate::control::Load;
use crate::lab::faults::only_simulated;
use crate::lab::guests::Guests;
use crate::lab::join::{START_WITHIN, Steps};
use crate::lab::launch::clock;
use crate::lab::load::too_much;
use crate::lab::namespace::{Namespace, Segment};
use crate::lab::processes::{Process, Told};
use crate::lab::run::{INTERFACE, port_name};
use crate::lab::wires::Wires;
use crate::lab::{Core, RunOptions};
use crate::report::capture::{Capture, CaptureFile};
use crate::report::host::{HostFacts, HostWatch};
use crate::report::text::about;
use crate::report::verdict::Interrupted;
use crate::scenario::RingScenario;
use crate::station::link::{self, Report};

/// How often frames and reports are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(10);
/// Longest time from a step of any station until the next takes part, in addition to what a ring takes to come up; and of the end.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// After the last frame, frames are still in the observer's ring for up to its retirement time.
const LINGER: Duration = Duration::from_millis(100);
/// Frames that the kernel stamped before a step of the wall clock may still come out of it for so long.
const DISTRUST: Duration = Duration::from_millis(100);
/// That a process has ended shows so much later at the most.
const GONE_WITHIN: True = 500_000_000;
/// What a token takes of a station's core: it wakes it, wherever it goes.
const WAKE: Span = Span::from_micros(25);
const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// A ring that has been stood up; dropping it takes it down.
struct Lab<'a> {
    // Fields are dropped in this order: processes first, then what they live in.
    guests: Guests,
    members: Vec<Member>,
    scenario: &'a RingScenario,
    teller: Sender<Told>,
    told: Receiver<Told>,
    ring: CaptureRing,
    wall: WallClock,
    distrusted_until: Option<Instant>,
    capture: Capture,
    judge: Judge,
    _warm: Option<WarmCore>,
    _declared: Option<Load>,
    wires: Wires,
    segment: Segment,
    cpu: usize,
    fifo: bool,
    notes: Vec<String>,
    interrupted: Arc<AtomicBool>,
    next_progress: Option<Instant>,
    play: Play,
}

/// Stands a ring up, waits until all take part, measures, and takes it down again.
pub fn run(scenario: &RingScenario, options: &RunOptions) -> Result<RingFigures> {
    let mut lab = Lab::set_up(scenario, options)?;
    lab.join()?;
    let host = HostFacts::begin_on(lab.cpu);
    let measured = lab.measure()?;
    lab.end();
    Ok(lab.figures(measured, host))
}

impl<'a> Lab<'a> {
    fn set_up(scenario: &'a RingScenario, options: &RunOptions) -> Result<Self> {
        let plan = &scenario.network;
        let mut notes = only_simulated(&plan.conditions);
        let Core { cpu, note } = options.core.clone();
        notes.extend(note);
        let load = load(scenario);
        let declared =
            options.directory.as_ref().and_then(|directory| Load::declare(directory, cpu, load).ok());
        let too_much = too_much(cpu, load, declared.as_ref());
        let fifo = too_much.is_none();
        notes.extend(too_much.map(|why| {
            format!("{why}, so they run without it (fewer stations or a longer token_rest gives it back)")
        }));
        let interrupted = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            signal_hook::flag::register(signal, interrupted.clone())?;
        }
        let capture = Capture::of(options.pcap.as_deref().map(CaptureFile::replace).transpose()?);
        let mut segment = Segment::new()?;
        let bridge = segment.bridge_name().to_owned();
        let ring = segment.namespace().run(|| CaptureRing::open(&bridge, CaptureConfig::default()))??;
        let anchor = monotonic();
        let clocks: Vec<EmulatedClock> =
            (0..plan.stations.len()).map(|station| clock(plan, station, anchor)).collect();
        let mut members: Vec<Member> = Vec::new();
        for (station, clock) in clocks.iter().enumerate() {
            let namespace = Namespace::new()?;
            segment.attach(&namespace, &port_name(station), INTERFACE, plan.address(station).0)?;
            members.push(Member::new(namespace, *clock));
        }
        let (wires, unimpaired) = Wires::of(plan, &segment)?;
        notes.extend(unimpaired);
        let warm = match options.warm_core.then(|| WarmCore::start(cpu)) {
            Some(Err(line)) => {
                notes.push(line);
                None
            }
            started => started.and_then(Result::ok),
        };
        let (teller, told) = channel();
        let mut lab = Self {
            guests: Guests::of(members.iter().map(|member| &member.namespace))?,
            members,
            scenario,
            teller,
            told,
            ring,
            wall: WallClock::default(),
            distrusted_until: None,
            capture,
            judge: Judge::new(scenario.ring.clone(), plan, &clocks),
            _warm: warm,
            _declared: declared.filter(|_| fifo),
            wires,
            segment,
            cpu,
            fifo,
            notes,
            interrupted,
            next_progress: options.progress.then(|| Instant::now() + PROGRESS_EVERY),
            play: Play::default(),
        };
        (0..lab.members.len()).try_for_each(|station| lab.start(station, 0))?;
        Ok(lab)
    }

    /// A process for a station, whose first frame has this number.
    fn start(&mut self, station: usize, first: u64) -> Result<()> {
        let Self { scenario, cpu, fifo, teller, .. } = self;
        let member = &mut self.members[station];
        let arguments = arguments(scenario, station, member.clock, (*cpu, *fifo), first)?;
        member.process = Some(Process::start(&member.namespace, station, &arguments, teller.clone())?);
        Ok(())
    }

    /// Waits until every station takes part.
    fn join(&mut self) -> Result<()> {
        let ring = &self.scenario.ring;
        let silent = ring.silence() + ring.step() * ring.stations.len() as i64;
        let comes_up = silent + self.scenario.network.cycle * 20;
        let join_within = ANSWER_WITHIN + Duration::from_nanos(comes_up.nanos() as u64);
        let (begun, mut steps) = (Instant::now(), Steps::default());
        while !(self.judge.all_present() && self.members.iter().all(Member::takes_part)) {
            self.look();
            for (member, plan) in self.members.iter().zip(&self.scenario.network.stations) {
                if let Some(why) = &member.failed {
                    bail!("station '{}': {why}", plan.name);
                }
                if member.silent {
                    bail!(
                        "station '{}' ended before the network was up; its own message is above",
                        plan.name
                    );
                }
            }
            let here = self.members.iter().filter(|member| member.takes_part()).count();
            if self.interrupted.load(Ordering::Relaxed) {
                let all = self.members.len();
                bail!(Interrupted(format!("{here} of {all} stations took part")));
            }
            let pause = steps.pause(self.members.iter().map(Member::steps).sum(), begun.elapsed());
            let is_starting = self.members.iter().any(|member| member.steps() == 0);
            if pause > if is_starting { START_WITHIN } else { join_within } {
                let late = self.members.iter().position(|member| !member.takes_part()).unwrap_or(0);
                bail!(
                    "station '{}' does not take part in the ring in time: a longer token_late gives a busy host more room",
                    self.scenario.network.stations[late].name
                );
            }
            self.show_progress(|| format!("{here} stations take part"));
        }
        Ok(())
    }

    /// Measures for the scenario's duration, or until interrupted or a station is lost: from when until when.
    fn measure(&mut self) -> Result<(True, True)> {
        let plan = &self.scenario.network;
        let begin = monotonic();
        let mut end = begin + plan.duration.nanos() as u64;
        self.judge.count_within(begin, end);
        if !plan.conditions.wires.is_empty() {
            // Which tokens they lose nobody tells.
            self.judge.happens(begin, end);
        }
        self.members.iter_mut().for_each(Member::begin);
        self.play = Play::of(&plan.conditions.events, begin);
        while monotonic() < end {
            self.look();
            self.act()?;
            if self.interrupted.load(Ordering::Relaxed) || self.members.iter().any(Member::is_lost) {
                end = monotonic();
                self.judge.count_within(begin, end);
            }
            let done = monotonic().saturating_sub(begin);
            self.show_progress(|| format!("{} of {}", about(done), plan.duration));
        }
        self.play.note_late(&mut self.notes);
        // An interrupt from here on no longer shortens the run.
        self.interrupted = Arc::new(AtomicBool::new(self.interrupted.load(Ordering::Relaxed)));
        Ok((begin, end))
    }

    /// Ends every station, and takes what it still has to tell.
    fn end(&mut self) {
        let linger = Instant::now() + LINGER;
        while Instant::now() < linger {
            self.look();
        }
        self.notes.extend(self.guests.end());
        self.members.iter_mut().for_each(Member::tell_to_end);
        let deadline = Instant::now() + ANSWER_WITHIN;
        while !self.members.iter().all(|member| member.silent) && Instant::now() < deadline {
            self.members.iter_mut().for_each(Member::end_if_stopped);
            self.look();
        }
        self.members.iter_mut().for_each(Member::see_it_end);
        self.capture.finish();
    }

    /// Waits a little, and takes what frames and reports there are.
    fn look(&mut self) {
        std::thread::sleep(LOOK_EVERY);
        let now = monotonic();
        if !self.wall.sample() {
            self.distrusted_until = Some(Instant::now() + DISTRUST);
            self.judge.happens(now, now + DISTRUST.as_nanos() as u64);
        }
        let trusted = self.distrusted_until.is_none_or(|until| Instant::now() > until);
        let Self { ring, wall, judge, capture, .. } = self;
        ring.drain(|frame| {
            capture.frame(frame.realtime_ns, frame.bytes, None);
            if trusted {
                judge.frame(wall.truth(frame.realtime_ns), frame.bytes);
            }
        });
        capture.show();
        while let Ok((station, report)) = self.told.try_recv() {
            if let Some(Report::Events(events)) = &report {
                for (_, kind, ..) in link::told(station, events) {
                    self.judge.told(station, kind);
                }
            }
            self.members[station].take(report);
            if self.members[station].is_lost() {
                self.judge.happens(now.saturating_sub(GONE_WITHIN), now);
            }
        }
        // What is of a ring is looked up where it is counted.
        self.wires.take_lost(|_, _, _| ());
    }

    fn figures(mut self, (begin, end): (True, True), host: HostWatch) -> RingFigures {
        let plan = &self.scenario.network;
        let dropped = self.ring.dropped().unwrap_or(0) + self.ring.unreadable();
        let known = self.members.iter().zip(&plan.stations).enumerate().map(|(id, (member, station))| {
            let streams = plan.streams(plan.sender(id)).filter(|_| member.can_tell());
            member.known(&station.name, streams, |of| self.wires.meant(id, of).clone())
        });
        let known: Vec<_> = known.collect();
        let judged = self.judge.finish(monotonic());
        let seen = Observed {
            dropped,
            capture_failed: self.capture.failed().map(str::to_owned),
            interrupted: self.interrupted.load(Ordering::Relaxed),
        };
        let mut figures =
            figures::of(self.scenario, judged, &known, (begin, end - begin), &seen, host.finish());
        figures.notes = self.notes;
        figures
    }

    fn show_progress(&mut self, what: impl Fn() -> String) {
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
}

/// The share of a core that the stations' real-time threads take: every token wakes all of them.
fn load(scenario: &RingScenario) -> f64 {
    let (n, visit) = (scenario.ring.stations.len() as f64, scenario.ring.rest.max(WAKE));
    n * WAKE.nanos() as f64 / visit.nanos() as f64
}
