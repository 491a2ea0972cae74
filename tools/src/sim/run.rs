//! A run in virtual time from its begin to its end: all join, time passes, things happen, figures.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Result, bail};
use rtmac::tdma::{DEFAULT_LEAD, TdmaStatus};
use rtnet::clock::True;
use rtnet::discipline::Discipline;
use rtnet::time::Span;

use at_end::{AtEnd, is_synchronised};

use super::expect;
use super::figures::{SimFigures, Simulation};
use super::patience;
use super::places::Places;
use super::watch::Watch;
use super::world::{Counted, UPTIME, World};
use crate::judge::absences::Absence;
use crate::judge::account::{Account, PARTS};
use crate::judge::analysis::Analysis;
use crate::judge::closely::envelope::Envelope;
use crate::judge::explain::Records;
use crate::judge::kept::Kept;
use crate::judge::outcome::{self, Outcome, Parts};
use crate::report::capture::{Capture, CaptureFile};
use crate::report::histogram::SignedHistogram;
use crate::report::host::HostFacts;
use crate::report::verdict::Interrupted;
use crate::scenario::{Scenario, acts, over};
use crate::station::traffic::Arrivals;

/// A scenario's first station is its primary master.
const PRIMARY: usize = 0;
/// Cycles between the moment when all are locked and the begin of the measurement.
const SETTLE_CYCLES: u32 = 10;
/// For so many cycles clocks may take to settle once all are locked.
const SETTLE_WITHIN: u64 = 3_000;
/// How many cycles joining may take besides what calibration takes.
const JOIN_WITHIN: u64 = 2_000;
/// A calibration round takes two periods of the slot; so many times that is allowed.
const CALIBRATION_ALLOWANCE: u64 = 3;
/// Cycles in which the frames of the last one are still to come.
const LINGER_CYCLES: u64 = 4;
/// A clock is no slower by more than one of so many parts.
const DRIFT_AT_MOST: u64 = 1_000;
/// So many cycles are judged at a time: going through all that is kept is worth it then.
const JUDGED_AT_ONCE: i32 = 1_000;

/// How to run a scenario.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Where to write every frame.
    pub pcap: Option<PathBuf>,
    /// No longer than this in virtual time, joining included.
    pub until: Option<Span>,
    /// Keep the frames of these cycles as text.
    pub around: Option<(u32, u32)>,
    /// Keep what the pictures of a report show.
    pub pictures: bool,
    /// End, and report what was measured, as soon as this is set.
    pub stop: Arc<AtomicBool>,
}

impl Options {
    /// Whether the run is to end.
    pub(crate) fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// What was asked for does not let a network join, or leaves no time to measure it.
#[derive(Debug, thiserror::Error)]
#[error("{0}: give it a longer --until")]
pub struct Hurried(pub(crate) String);

/// What a run has shown, and the histogram of its slot errors.
pub struct Ended {
    /// The figures.
    pub figures: SimFigures,
    /// |slot error - the station's median| of all stations.
    pub slot_error_abs: SignedHistogram,
    /// The frames that were to be kept as text.
    pub lines: Vec<String>,
    /// What the pictures of a report show.
    pub kept: Kept,
    /// Slots missed and frames outside theirs, by part of the run.
    pub missed_in_parts: [u64; PARTS],
}

/// Runs a scenario from its begin to its end.
pub fn run(scenario: &Scenario, options: &Options) -> Result<Ended> {
    let mut run = Run::new(scenario, options)?;
    run.join()?;
    run.settle();
    run.measure()?;
    run.end()
}

struct Run<'a> {
    scenario: &'a Scenario,
    options: &'a Options,
    world: World,
    watch: Rc<RefCell<Watch>>,
    cycle: u64,
    /// Which stations are there, as far as the scenario says.
    present: Vec<bool>,
    /// Which have been another process before.
    anew: Vec<bool>,
    /// What each had counted when the measurement began, less what processes before this one had counted since.
    before: Vec<Counted>,
    /// What has been judged, up to when in cycles, and how long it takes until all is told.
    account: Account,
    judged_to: u32,
    patience: u32,
    /// When the last event is over.
    over: True,
    /// When somebody was last seen not to be synchronised.
    unlocked: True,
    /// How all were in the last cycles.
    at_end: Vec<AtEnd>,
    /// It was stopped before its time.
    interrupted: bool,
}

impl<'a> Run<'a> {
    fn new(scenario: &'a Scenario, options: &'a Options) -> Result<Self> {
        let events = &scenario.conditions.events;
        let later: BTreeSet<&usize> = events.iter().flat_map(|event| event.what.starts()).collect();
        let is_there = |id: usize| !later.contains(&id);
        let mut world = World::new(scenario, is_there)?;
        let names = scenario.stations.iter().map(|station| station.name.clone()).collect();
        let mut watch = Watch::new(Analysis::new(scenario, world.truth), Records::new(scenario), names);
        watch.capture = Capture::of(options.pcap.as_deref().map(CaptureFile::replace).transpose()?);
        watch.around = options.around;
        if options.pictures {
            watch.analysis.look_closely(scenario);
            watch.sync_error_over_time = Some(vec![Envelope::default(); scenario.stations.len()]);
        }
        let watch = Rc::new(RefCell::new(watch));
        let (seen, told, lost) = (watch.clone(), watch.clone(), watch.clone());
        world.network.observe(move |aired| seen.borrow_mut().aired(aired));
        world.network.attend(move |moment, member| told.borrow_mut().attend(moment, member));
        world.network.mourn(move |to, frame, why| lost.borrow_mut().lost(to, frame, why));
        let n = scenario.stations.len();
        Ok(Self {
            scenario,
            options,
            world,
            watch,
            cycle: scenario.cycle.nanos() as u64,
            present: (0..n).map(is_there).collect(),
            anew: vec![false; n],
            before: vec![Counted::default(); n],
            account: Account::default(),
            judged_to: 0,
            patience: patience::cycles(scenario),
            over: 0,
            unlocked: 0,
            at_end: vec![AtEnd::UNSEEN; n],
            interrupted: false,
        })
    }

    fn now(&self) -> True {
        self.world.network.now()
    }

    fn status(&self, id: usize) -> TdmaStatus {
        self.world.network.member(id).station.discipline().status()
    }

    /// Synchronised, and calibrated, as whoever gives the time once the primary is there must be, too. Where a sync is long on
    /// its way, a station bridges the begin of each cycle.
    fn has_joined(&self, id: usize) -> bool {
        let needs_delay = id != PRIMARY && self.present[PRIMARY];
        self.is_synchronised(id) && (!needs_delay || self.status(id).delay.is_some())
    }

    /// Locked, or bridging a cycle.
    fn is_synchronised(&self, id: usize) -> bool {
        is_synchronised(self.world.network.member(id).station.discipline().time().state)
    }

    fn all(&self, are: impl Fn(&Self, usize) -> bool) -> bool {
        (0..self.present.len()).filter(|&id| self.present[id]).all(|id| are(self, id))
    }

    /// Lets a cycle pass; fails if time is up, or the run is stopped.
    fn step(&mut self) -> Result<()> {
        if self.options.is_stopped() {
            let there = (0..self.present.len()).filter(|&id| self.present[id]);
            let (joined, all) = (there.clone().filter(|&id| self.has_joined(id)).count(), there.count());
            bail!(Interrupted(format!("{joined} of {all} stations were locked")));
        }
        let next = self.now() + self.cycle;
        if let Some(until) = self.options.until
            && next > UPTIME + until.nanos() as u64
        {
            bail!(Hurried(format!("the stations were not all locked after {until}")));
        }
        self.world.network.run_until(next);
        Ok(())
    }

    /// Until all are locked that are there.
    fn join(&mut self) -> Result<()> {
        let rounds = self.scenario.stations.iter().map(|station| {
            let period = station.slots.iter().map(|slot| slot.period).max().unwrap_or(1);
            u64::from(station.rounds) * 2 * u64::from(period)
        });
        let allowed = rounds.max().unwrap_or(0) * CALIBRATION_ALLOWANCE + JOIN_WITHIN;
        for _ in 0..allowed {
            // A master that is alone is locked before its first Synchronisation, which nothing begins before.
            if self.all(Self::has_joined) && self.watch.borrow().analysis.grid().is_some() {
                return Ok(());
            }
            self.step()?;
        }
        let late = (0..self.present.len()).find(|&id| self.present[id] && !self.has_joined(id)).unwrap_or(0);
        bail!(
            "station '{}' is not locked to the master after {allowed} cycles ({}): its wire, its host or its clock does \
             not let it; change them only later by an [[event]], if that is meant",
            self.scenario.stations[late].name,
            self.status(late).state.name()
        )
    }

    /// Until the clocks of all are as near the master's as they come, but not for ever.
    fn settle(&mut self) {
        for _ in 0..SETTLE_WITHIN {
            if self.all(|run, id| run.status(id).settled) || self.step().is_err() {
                break;
            }
        }
    }

    fn measure(&mut self) -> Result<()> {
        let Scenario { duration, cycle, .. } = *self.scenario;
        let cycles = (duration.nanos() / cycle.nanos()).clamp(1, i64::from(i32::MAX)) as u32;
        let (begin, cycles) = self.begin(cycles)?;
        let mut end = begin + u64::from(cycles) * self.cycle;
        self.over = begin + over(&self.scenario.conditions.events).nanos() as u64;
        let mut acts = acts(&self.scenario.conditions.events, begin).into_iter().peekable();
        while self.now() < end {
            self.interrupted = self.options.is_stopped();
            if self.interrupted {
                break;
            }
            let next = (self.now() + self.cycle).min(end);
            while let Some(act) = acts.next_if(|act| act.at <= next) {
                self.pass_until(act.at);
                end += self.set_back_by(&act);
                self.act(&act)?;
            }
            self.pass_until(next);
            self.look();
            self.judge();
        }
        // Cycles are as long as the clock of who gives the time has them: by a slow one the last is over later.
        if self.options.until.is_none() && !self.interrupted {
            let over = self.watch.borrow().analysis.end_of_window().unwrap_or(end);
            self.pass_until(over.min(end + (end - begin) / DRIFT_AT_MOST + self.cycle));
        }
        self.watch.borrow_mut().counting = false;
        self.world.bound_deliveries(self.scenario, &self.watch.borrow().analysis, Arrivals::count_until);
        // What was sent in the last cycle is still on its way, and who is held up has not told of it.
        for _ in 0..LINGER_CYCLES.max(patience::untold(self.scenario)) {
            self.look_at_end();
            self.pass_until(self.now() + self.cycle);
        }
        self.look_at_end();
        Ok(())
    }

    /// From here on, for so many cycles or as many as there is time for, all counts: when the first of them begins, and how
    /// many.
    fn begin(&mut self, cycles: u32) -> Result<(True, u32)> {
        let mut watch = self.watch.borrow_mut();
        // Whoever gives the time may have been silent for a while.
        let current = watch.analysis.cycle_at(self.now());
        let first = current.map(|current| current.wrapping_add(SETTLE_CYCLES));
        let Some((first, begin)) = first.and_then(|first| Some((first, watch.analysis.begin_of(first)?)))
        else {
            bail!("no Synchronisation was seen")
        };
        let cycles = match self.options.until {
            None => cycles,
            Some(until) => {
                let end = UPTIME + until.nanos() as u64;
                let again: True = acts(&self.scenario.conditions.events, begin)
                    .iter()
                    .map(|act| self.may_set_back_by(act))
                    .sum();
                let room = end.saturating_sub(begin + again) / self.cycle;
                u64::from(cycles).min(room.saturating_sub(LINGER_CYCLES)) as u32
            }
        };
        if cycles == 0 {
            // Only an end that was asked for takes all of them.
            bail!(Hurried("there is no time to measure once all stations are locked".into()));
        }
        watch.analysis.begin(first, cycles);
        self.judged_to = first;
        drop(watch);
        // Everything of the cycle before is over, and nothing of the first has begun.
        self.pass_until(begin.saturating_sub(self.cycle / 20));
        let mut watch = self.watch.borrow_mut();
        for id in (0..self.present.len()).filter(|&id| !self.present[id]) {
            watch.records.absences.begin(id, Absence::Down, first.wrapping_sub(SETTLE_CYCLES));
        }
        watch.counting = true;
        self.world.bound_deliveries(self.scenario, &watch.analysis, Arrivals::count_from);
        self.world.network.start_over();
        self.before = (0..self.present.len()).map(|id| self.world.counted(id)).collect();
        Ok((begin, cycles))
    }

    fn pass_until(&mut self, until: True) {
        self.world.network.run_until(until.max(self.now()));
    }

    /// Once a cycle: who is back, and who is not locked.
    fn look(&mut self) {
        let all_locked = self.all(Self::is_synchronised);
        let mut watch = self.watch.borrow_mut();
        let Watch { analysis, records, .. } = &mut *watch;
        for id in (0..self.present.len()).filter(|&id| self.present[id]) {
            if let (true, Some(cycle)) =
                (records.absences.is_open(id, Absence::Down), analysis.heard_again(id))
            {
                records.absences.end(id, Absence::Down, cycle);
            }
        }
        if !all_locked {
            self.unlocked = self.world.network.now();
        }
    }

    /// Once in a while: what was found so long ago that all of it must have been told.
    fn judge(&mut self) {
        let Watch { analysis, records, .. } = &mut *self.watch.borrow_mut();
        let Some(now) = analysis.cycle_at(self.world.network.now()) else { return };
        let is_time = |to: u32| (to.wrapping_sub(self.judged_to) as i32) >= JUDGED_AT_ONCE;
        if is_time(now.wrapping_sub(self.patience)) {
            let to = patience::judged_to(records, now, self.patience);
            if is_time(to) {
                self.account.judge(self.scenario, analysis, records, to);
                self.judged_to = to;
            }
        }
    }

    fn end(mut self) -> Result<Ended> {
        let facts = (0..self.present.len()).map(|id| self.facts(id)).collect();
        let stations = (0..self.present.len()).map(|id| self.station(id)).collect();
        let relock = self.relock_cycles();
        let (now, traffic) = (self.now(), *self.world.network.traffic());
        // Its observers go with it.
        self.world.network.forget_watchers();
        let watch = Rc::into_inner(self.watch).expect("nobody watches any more").into_inner();
        let (mut account, scenario) = (self.account, self.scenario);
        let Watch { mut analysis, records, mut capture, lines, seen, .. } = watch;
        capture.finish();
        if let Some(current) = analysis.cycle_at(now) {
            analysis.advance_to(current);
        }
        analysis.finish();
        let unlocked = analysis.cycle_at(self.unlocked.max(self.over));
        account.close(scenario, &mut analysis, &records);
        let places = Places::of(&analysis, &account, seen, unlocked);
        let parts = Parts {
            stations: facts,
            analysis,
            account,
            lead: DEFAULT_LEAD,
            notes: facts::only_in_labs(scenario),
            dropped: 0,
            wall_steps: 0,
            distrusted: 0,
            capture_failed: capture.failed().map(str::to_owned),
            interrupted: self.interrupted,
            ended_early: self.options.until.is_some(),
        };
        let mut outcome = outcome::of(self.scenario, parts, HostFacts::of_virtual_time());
        let figures = &outcome.figures;
        let simulation = Simulation {
            seed: self.scenario.seed,
            virtual_ns: now - UPTIME,
            measured_ns: figures.cycles * figures.cycle_ns,
            events: self.scenario.conditions.events.len() as u64,
            frames: traffic.frames,
            smallest_gap_ns: traffic.smallest_gap.map(Span::nanos),
            collisions: traffic.collided,
            queue_full: traffic.queue_full,
            longest_queue: traffic.longest_queue as u64,
            lost: traffic.lost,
            duplicated: traffic.duplicated,
            corrupted: traffic.corrupted,
            reordered: traffic.reordered,
            relock_cycles: relock,
            stations,
            expectations: Vec::new(),
        };
        let mut figures = SimFigures { figures: figures.clone(), simulation };
        figures.simulation.expectations = expect::check(self.scenario, &figures, &places);
        outcome.add(expect::unmet(&figures.simulation.expectations));
        let Outcome { figures: judged, slot_error_abs, kept, missed_in_parts, .. } = outcome;
        figures.figures.verdict = judged.verdict;
        Ok(Ended { figures, slot_error_abs, lines, kept, missed_in_parts })
    }
}

mod at_end;
mod events;
mod facts;
#[cfg(test)]
mod tests;
