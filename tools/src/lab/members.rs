//! One station of a lab, seen from the lab: what it has told.

use std::collections::BTreeMap;
use std::time::Duration;

use rtnet::clock::{EmulatedClock, True};
use rtnet::discipline::{Cause, Event, EventKind};
use rtnet::live::Record;
use rtnet::live::clock::monotonic;
use rtnet::time::{GlobalTime, Span};

use super::namespace::Namespace;
use super::processes::{END_WITHIN, Process};
use super::unplugged::Unplugged;
use crate::judge::closely::envelope::Envelope;
use crate::judge::delivery::{Delivery, Heard};
use crate::judge::explain::Records;
use crate::judge::findings::Author;
use crate::judge::givers::TrueMaster;
use crate::judge::noteworthy::Noteworthy;
use crate::judge::outcome::{Facts, not_synchronised};
use crate::judge::verdict::{Reason, Weight};
use crate::report::histogram::SignedHistogram;
use crate::station::link::{self, Order, Report, Standing};
use crate::station::misses::Misses;

/// For how long a busy host may keep a station from being synchronised: who is lost for longer is lost.
pub fn lost_at_most(cycle: Span) -> Span {
    Span::from_millis(1_000).max(cycle * 25)
}

/// A station of a lab.
pub struct Member {
    // Dropped before the namespace it lives in.
    pub process: Option<Process>,
    pub namespace: Namespace,
    /// Whether the kernel enforces its slots.
    pub guarded: bool,
    /// What the host refused it.
    pub refused: Vec<String>,
    /// What it told of that a reader of the report should know.
    pub noteworthy: Noteworthy,
    pub standing: Option<Standing>,
    pub standing_at_begin: Option<Standing>,
    pub standing_at_end: Option<Standing>,
    pub lost_at_end: bool,
    pub sync_error: SignedHistogram,
    pub sync_error_over_time: Envelope,
    /// How late it was for its sends.
    pub late: SignedHistogram,
    /// Slots that it was more than a cycle late for, since the begin.
    pub woke_late: u64,
    /// From one cycle's start to the next.
    pub cycle: Span,
    pub failed: Option<String>,
    /// Its process ended before it was told to.
    pub ended: bool,
    /// Nothing more will come from it.
    pub silent: bool,
    pub resident: u64,
    pub cpu_seconds: f64,
    /// Of the whole cycle, what it told of since the begin, by name.
    pub events: BTreeMap<String, u64>,
    /// What it has missed since then.
    pub misses: Misses,
    /// Processes that it has had before this one.
    pub restarts: u32,
    /// Its clock, if its scenario has changed it.
    pub clock: Option<EmulatedClock>,
    /// When its wire was cut.
    pub unplugged: Unplugged,
    /// In which cycle its process was last seen not to be stopped.
    pub seen_running: Option<u32>,
    unsynchronised: Unsynchronised,
    has_joined: bool,
    counting: bool,
    told_to_end: bool,
    /// It was ended because its scenario says so.
    is_meant_to_end: bool,
    /// It was stopped by somebody, so that there was no other way.
    was_killed: bool,
    /// Test traffic that was not what was sent, in those processes.
    former_errors: u64,
}

impl Member {
    pub fn new(namespace: Namespace, cycle: Span) -> Self {
        Self {
            cycle,
            woke_late: 0,
            process: None,
            namespace,
            guarded: false,
            refused: Vec::new(),
            noteworthy: Noteworthy::default(),
            standing: None,
            standing_at_begin: None,
            standing_at_end: None,
            lost_at_end: false,
            sync_error: SignedHistogram::new(),
            sync_error_over_time: Envelope::default(),
            late: SignedHistogram::new(),
            failed: None,
            ended: false,
            silent: false,
            resident: 0,
            cpu_seconds: 0.0,
            events: BTreeMap::new(),
            misses: Misses::default(),
            restarts: 0,
            clock: None,
            unplugged: Unplugged::default(),
            seen_running: None,
            unsynchronised: Unsynchronised::default(),
            has_joined: false,
            counting: false,
            told_to_end: false,
            is_meant_to_end: false,
            was_killed: false,
            former_errors: 0,
        }
    }

    /// A new process in the place of one that has ended.
    pub fn restart(&mut self, process: Process) {
        self.former_errors = self.payload_errors();
        self.process = Some(process);
        self.restarts += 1;
        self.unplugged.begin_anew();
        self.unsynchronised = Unsynchronised::default();
        (self.standing, self.standing_at_begin) = (None, None);
        (self.failed, self.ended, self.silent, self.told_to_end) = (None, false, false, false);
        (self.is_meant_to_end, self.has_joined) = (false, false);
    }

    pub fn pid(&self) -> u32 {
        self.process.as_ref().map_or(0, Process::pid)
    }

    /// Whether it has been locked since it was started. Misses after that belong to the measurement.
    pub fn has_joined(&self) -> bool {
        self.has_joined
    }

    /// Whether its process has started, and has not reported.
    pub fn is_starting(&self) -> bool {
        self.process.is_some() && self.standing.is_none()
    }

    /// Steps that it has taken: it reports, and has been locked.
    pub fn steps(&self) -> usize {
        usize::from(self.standing.is_some()) + usize::from(self.has_joined)
    }

    pub fn is_settled(&self) -> bool {
        self.standing.as_ref().is_some_and(|standing| standing.settled)
    }

    pub fn state(&self) -> &str {
        self.standing.as_ref().map_or("not started", |standing| &standing.state)
    }

    /// From here on times and processor time count.
    pub fn begin(&mut self) {
        self.counting = true;
        self.standing_at_begin = self.standing.clone();
        if let Some(process) = &mut self.process {
            process.begin();
        }
    }

    /// Up to here.
    pub fn stop_counting(&mut self, lost_at_most: Span) {
        self.lost_at_end = self.is_lost(lost_at_most);
        self.counting = false;
        self.standing_at_end = self.standing.clone();
        self.cpu_seconds = self.process.as_ref().and_then(Process::cpu_used).unwrap_or(0.0);
    }

    pub fn note_memory(&mut self) {
        self.resident = self.process.as_ref().and_then(Process::resident).unwrap_or(0);
    }

    /// Ends it at once, as its scenario says.
    pub fn kill(&mut self) {
        self.is_meant_to_end = true;
        if let Some(process) = &mut self.process {
            process.kill();
        }
    }

    /// Does to it what its scenario says. Who has ended meanwhile cannot.
    pub fn order(&mut self, order: Order) {
        if let Some(process) = &mut self.process
            && !process.order(order)
        {
            let line = "it was told of more events than it could take: some did not happen";
            if !self.refused.iter().any(|other| other == line) {
                self.refused.push(line.into());
            }
        }
    }

    pub fn tell_to_end(&mut self) {
        self.told_to_end = true;
        if let Some(process) = &mut self.process {
            process.tell_to_end();
        }
    }

    /// Who is stopped cannot do as it is told.
    pub fn end_if_stopped(&mut self) {
        if let Some(process) = &mut self.process
            && process.is_stopped()
        {
            self.was_killed = true;
            process.kill();
        }
    }

    /// It was told to end: whether it did, and well.
    pub fn see_it_end(&mut self) {
        let Some(process) =
            self.process.as_mut().filter(|_| !self.ended && !self.was_killed && !self.is_meant_to_end)
        else {
            return;
        };
        self.failed = process.outcome(if self.silent { END_WITHIN } else { Duration::ZERO }).err();
        self.ended = self.failed.is_some();
    }

    /// Test traffic that was not what was sent, since the begin.
    pub fn payload_errors(&self) -> u64 {
        let count = |standing: &Option<Standing>| {
            standing.as_ref().and_then(|s| s.refusals.get("bad_payload").copied()).unwrap_or(0)
        };
        self.former_errors + count(&self.standing).saturating_sub(count(&self.standing_at_begin))
    }

    /// Test traffic missing between frames that it received, since the begin.
    pub fn sequence_gaps(&self) -> u64 {
        let count = |standing: &Option<Standing>| standing.as_ref().map_or(0, Standing::missing);
        count(&self.standing_at_end).saturating_sub(count(&self.standing_at_begin))
    }

    /// Frames of its program that found no room in their queue, by priority, since the begin.
    fn queue_refused(&self) -> BTreeMap<u8, u64> {
        let Some(end) = &self.standing_at_end else { return BTreeMap::new() };
        let before = |priority: &u8| self.standing_at_begin.as_ref()?.queue_refused.get(priority).copied();
        let since = |(priority, n): (&u8, &u64)| (*priority, n.saturating_sub(before(priority).unwrap_or(0)));
        end.queue_refused.iter().map(since).collect()
    }

    /// Test traffic that it has heard since the begin: usual frames, or of a priority.
    pub fn heard(&self, of: Option<u8>) -> Heard {
        let arrived = |standing: &Option<Standing>| {
            standing.as_ref().map(|standing| standing.arrived(of)).unwrap_or_default()
        };
        let before = arrived(&self.standing_at_begin);
        let next = if before.received > 0 { before.first + before.received + before.missing } else { 0 };
        Heard::of(arrived(&self.standing), self.restarts > 0).within(next..u64::MAX, before.received)
    }

    /// Whether it can tell what it has heard.
    pub fn can_tell(&self) -> bool {
        !self.ended && !self.is_meant_to_end
    }

    /// Whether it has not been synchronised for longer than that, or was not when it counted last.
    pub fn is_lost(&self, at_most: Span) -> bool {
        if !self.counting {
            return self.lost_at_end;
        }
        let Some(standing) = &self.standing else { return true };
        !standing.master && self.unsynchronised.is_longer_than(at_most, standing.at)
    }

    /// Share of one core that the real-time thread used while it was measured.
    pub fn rt_cpu_share(&self) -> f64 {
        let (Some(begin), Some(end)) = (&self.standing_at_begin, &self.standing_at_end) else { return 0.0 };
        let (used, passed) = (end.cpu_ns.saturating_sub(begin.cpu_ns), end.at.saturating_sub(begin.at));
        if passed == 0 { 0.0 } else { used as f64 / passed as f64 }
    }

    /// What the report says of it, if it was judged to the end, and of what came to it, and became of the frames for it.
    pub fn facts(
        &self,
        name: &str,
        is_judged: bool,
        deliveries: BTreeMap<Option<u8>, Delivery>,
        of_wire: Option<String>,
    ) -> Facts {
        let standing = self.standing.as_ref();
        Facts {
            pid: self.pid(),
            guarded: self.guarded,
            delay_ns: standing.and_then(|standing| standing.delay_ns),
            payload_errors: self.payload_errors(),
            sync_error: self.sync_error.clone(),
            sync_error_over_time: self.sync_error_over_time.clone(),
            late: self.late.clone(),
            woke_late: Some(self.woke_late),
            resident: self.resident,
            cpu_seconds: self.cpu_seconds,
            rt_cpu_share: self.rt_cpu_share(),
            sequence_gaps: self.sequence_gaps(),
            deliveries,
            refusals: standing.map(|standing| standing.refusals.clone()).unwrap_or_default(),
            notes: self.refused.iter().cloned().chain(self.noteworthy.lines()).chain(of_wire).collect(),
            clock_steps: standing.map_or(0, |standing| standing.clock_steps),
            lost_records: standing.map_or(0, |standing| standing.lost_records),
            queue_refused: self.queue_refused(),
            reproach: self.reproach(name, is_judged),
        }
    }

    fn reproach(&self, name: &str, is_judged: bool) -> Option<Reason> {
        let wrong = |what| Some(Reason::new(Weight::Wrong, what));
        if let Some(why) = &self.failed {
            wrong(format!("station '{name}' failed: {why}"))
        } else if self.ended {
            let remedy = "its last words, if any, are above; run the lab again";
            wrong(format!("station '{name}' (process {}) was lost: {remedy}", self.pid()))
        } else {
            let is_lost = is_judged && self.lost_at_end && !self.is_meant_to_end;
            is_lost.then(|| not_synchronised(name))
        }
    }

    /// Takes a line, or the end.
    pub fn take(
        &mut self,
        station: usize,
        report: Option<Report>,
        records: &mut Records,
        master: &TrueMaster,
    ) {
        match report {
            None => {
                self.ended = !self.told_to_end && !self.is_meant_to_end;
                self.silent = true;
            }
            Some(Report::Started { guarded, refused }) => (self.guarded, self.refused) = (guarded, refused),
            Some(Report::Failed(why)) => self.failed = Some(why),
            Some(Report::Standing(standing)) => {
                self.unsynchronised.note(&standing.state, standing.at);
                self.has_joined |= standing.is_locked();
                self.standing = Some(*standing);
            }
            Some(Report::Events(events)) => {
                for (author, kind, span, cause) in link::told(station, &events) {
                    records.note(author, kind, span, cause);
                    let Author { cycle, slot, .. } = author;
                    self.remember(Event { cycle, kind, slot, span }, cause);
                }
            }
            Some(Report::Times(times)) if self.counting && station != 0 => {
                for (at, global) in times {
                    let error = GlobalTime::from_nanos(global) - master.global(at);
                    self.sync_error.record(error.nanos());
                    self.sync_error_over_time.note(at, error.nanos());
                }
            }
            Some(Report::Link { at, carrier }) => self.unplugged.note(carrier, at, monotonic()),
            Some(Report::Late(all)) if self.counting => {
                all.into_iter().for_each(|late| self.late.record(late.try_into().unwrap_or(i64::MAX)));
            }
            Some(Report::Times(_) | Report::Late(_)) => {}
        }
    }

    /// What a reader of the report should know.
    fn remember(&mut self, event: Event, cause: Option<Cause>) {
        let Event { cycle, kind, slot, span } = event;
        if self.counting {
            let is_late =
                [EventKind::Overrun, EventKind::GuardDropped, EventKind::StalledInSend].contains(&kind);
            self.woke_late += u64::from(is_late && slot.is_some() && span > self.cycle);
            *self.events.entry(kind.name().into()).or_default() += 1;
            self.misses.note(&[Record::Event(event, cause)]);
        }
        self.noteworthy.note(kind, cycle);
    }
}

/// Since when a station has not been synchronised: it reports each change of state, with its time.
#[derive(Clone, Copy, Debug, Default)]
struct Unsynchronised {
    since: Option<True>,
}

impl Unsynchronised {
    /// The station reports its state at a time.
    fn note(&mut self, state: &str, at: True) {
        // Locked, or bridging one cycle.
        let is_synchronised = matches!(state, "locked" | "holdover");
        self.since = self.since.or(Some(at)).filter(|_| !is_synchronised);
    }

    /// Whether it was so for longer than `span`, at the time of its last report.
    fn is_longer_than(&self, span: Span, reported: True) -> bool {
        self.since.is_some_and(|since| reported.saturating_sub(since) > span.nanos() as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_station_is_lost_by_the_time_it_reports_to_be_lost() {
        let mut station = Unsynchronised::default();
        let mut after = |state, millis: u64| {
            station.note(state, millis * 1_000_000);
            station.is_longer_than(Span::from_millis(75), millis * 1_000_000)
        };
        assert!(!after("locked", 1_000));
        // The report before is 100 ms old, and the station has lost the master only now.
        assert!(!after("lost", 1_100));
        assert!(!after("lost", 1_175));
        assert!(after("lost", 1_176));
        assert!(!after("holdover", 1_200) && !after("waiting", 1_300));
        assert!(after("calibrating", 1_376));
    }
}
