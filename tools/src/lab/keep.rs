//! A lab that stays until it is told to go, and can be asked and changed meanwhile.

mod changes;
mod schedules;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use rtnet::clock::True;
use rtnet::live::clock::monotonic;
use rtnet::time::Span;

use super::guests::Guests;
use super::members::{Member, lost_at_most};
use super::processes::Process;
use super::run::{LOOK_EVERY, Lab, RunOptions};
use super::tally::Tally;
use super::verdict;
use crate::control::{
    Envelope, Home, LabReply, LabRequest, LabStatus, MemberStatus, Server, check_length, read,
};
use crate::judge::delivery::Delivery;
use crate::judge::findings::{Author, Finding};
use crate::report::draft::write_json;
use crate::report::host::{HostFacts, HostWatch};
use crate::report::verdict::Verdict;
use crate::scenario::Scenario;
use crate::station::link::{Order, Standing};
use crate::station::misses::{Miss, WORST};
use crate::station::stack::OwnIp;
use changes::Pending;

/// How often what was found is judged.
const JUDGE_EVERY: Duration = Duration::from_secs(1);
/// A record explains what was found up to so many cycles before it.
const EXPLAINED_WITHIN: i64 = 2;
/// How often to look which stations are stopped.
const LOOK_AT_PROCESSES_EVERY: Duration = Duration::from_millis(100);
/// How often to look what others take of the core, at the most.
const LOOK_AT_HOST_EVERY: Duration = Duration::from_secs(1);
/// How long records are kept.
const RECORDS_KEPT: Duration = Duration::from_secs(600);
/// How long a station that is restarted may take to end before it is killed: its slowest thread looks ten times a
/// second.
const END_WITHIN: Duration = Duration::from_secs(1);
/// A lab is judged for so many cycles, 12 days at 1 ms: half of what cycle numbers tell apart.
const CYCLES_AT_MOST: u32 = 1 << 30;

/// Keeps a lab up. `ready` is called once all its stations are locked; the end's figures are returned.
pub fn keep(
    scenario: Scenario,
    options: &RunOptions,
    at_most: Option<Span>,
    ready: impl FnOnce(&LabStatus) -> Result<()>,
) -> Result<LabStatus> {
    let home = options.home.clone().context("a lab that stays needs a name")?;
    scenario.stations.iter().try_for_each(|station| check_length(&home.station(&station.name)))?;
    let held = home.directory.take_lab(&home.lab)?;
    if let Some(note) = &held.left {
        Guests::of_dead(note)
            .end()
            .iter()
            .for_each(|line| tell(&format!("lab '{}' of before: {line}", home.lab)));
    }
    let mut lab = Lab::set_up(&scenario, options)?;
    held.note(&lab.guests.note())?;
    if !scenario.conditions.events.is_empty() {
        lab.notes.push("a lab that stays plays no [[event]]: `rtnet lab run` does".into());
    }
    if !scenario.conditions.expectations.is_empty() {
        lab.notes.push("a lab that stays checks no [expect]: `rtnet lab run` does".into());
    }
    for note in &lab.notes {
        tell(note);
    }
    lab.join(&scenario)?;
    lab.begin(CYCLES_AT_MOST)?;
    let mut server = Server::bind(&home.socket())?;
    let since = Instant::now();
    let restarting = scenario.stations.iter().map(|_| None).collect();
    let watch = HostFacts::begin_on(lab.cpu);
    let mut keeper = Keeper {
        lab,
        json: options.json.clone(),
        watch,
        host: None,
        scenario,
        home,
        tally: Tally::default(),
        since,
        changes: 0,
        pending: None,
        restarting,
        interrupted: None,
        over: None,
    };
    for note in keeper.refused() {
        tell(&note);
    }
    ready(&keeper.status())?;
    if options.detached {
        keeper.lab.members.iter_mut().for_each(|member| member.order(Order::LeaveErrors));
    }
    let until = at_most.map(|span| since + Duration::from_nanos(span.nanos().max(0) as u64));
    let (mut judged, mut looked) = (Instant::now(), Instant::now());
    while keeper.over.is_none() {
        server.serve(LOOK_EVERY, |packet, _| keeper.answer(packet));
        keeper.take_late_answer();
        keeper.lab.take_in();
        keeper.note_switch();
        keeper.restart_one_that_ended();
        if looked.elapsed() >= LOOK_AT_PROCESSES_EVERY {
            looked = Instant::now();
            keeper.lab.note_stopped();
        }
        if judged.elapsed() >= JUDGE_EVERY {
            judged = Instant::now();
            keeper.judge();
        }
        let interrupted = keeper.lab.interrupted.load(Ordering::Relaxed);
        let is_time_up = until.is_some_and(|until| Instant::now() >= until);
        if keeper.over.is_none() && (interrupted || is_time_up || keeper.lab.analysis.is_complete()) {
            let early = at_most.filter(|_| interrupted && !is_time_up);
            let been = Span::from_millis(since.elapsed().as_millis() as i64);
            keeper.interrupted = early.map(|asked| format!("{been} of {asked}"));
            keeper.end();
        }
    }
    keeper.over.context("a lab ends with its figures")
}

/// Whoever has closed our standard error finds it in `lab status`.
fn tell(note: &str) {
    let _ = writeln!(std::io::stderr(), "rtnet: {note}");
}

fn reply(applied: Result<u32>) -> LabReply {
    applied.map_or_else(|error| LabReply::Refused(format!("{error:#}")), LabReply::Applied)
}

struct Keeper {
    lab: Lab,
    /// With the slots as they are now.
    scenario: Scenario,
    home: Home,
    tally: Tally,
    since: Instant,
    changes: u32,
    /// A change that its station has not answered in time.
    pending: Option<Pending>,
    /// By station, whether it is to be started anew, and since when.
    restarting: Vec<Option<Instant>>,
    /// Where its end is written.
    json: Option<PathBuf>,
    /// What others take of its core, and what that was when it was looked at last.
    watch: HostWatch,
    host: Option<(Instant, HostFacts)>,
    /// After how much of how long it was to stay it was interrupted.
    interrupted: Option<String>,
    /// The figures of the end.
    over: Option<LabStatus>,
}

impl Keeper {
    fn answer(&mut self, packet: &[u8]) -> Vec<u8> {
        let reply = match read(packet) {
            Err(why) => LabReply::Refused(why),
            // What the stations have just told of belongs to it.
            Ok(LabRequest::Status) => {
                self.lab.take_in();
                LabReply::Status(Box::new(self.status()))
            }
            Ok(LabRequest::Down) => {
                self.end();
                LabReply::Down(Box::new(self.over.clone().unwrap_or_else(|| self.status())))
            }
            Ok(LabRequest::SetSlot { station, slot }) => reply(self.try_set(&station, &slot)),
            Ok(LabRequest::RemoveSlot { station, id }) => reply(self.try_remove(&station, id)),
            Ok(LabRequest::Become { station, role }) => reply(self.try_become(&station, role)),
            Ok(LabRequest::Propose { station, schedule, activate }) => {
                reply(self.try_propose(&station, &schedule, activate))
            }
            Ok(LabRequest::Restart { station }) => reply(self.try_restart(&station)),
        };
        Envelope::pack(reply)
    }

    fn judge(&mut self) {
        self.lab.count_absences(&mut self.tally);
        self.tally.judge(self.lab.reported(), &self.lab.records);
        self.find();
        let cycle = Duration::from_nanos(self.scenario.cycle.nanos() as u64);
        let keep = (RECORDS_KEPT.as_nanos() / cycle.as_nanos().max(1)).clamp(1, u128::from(u32::MAX / 2));
        if let Some(current) = self.lab.analysis.current() {
            self.lab.records.forget_before(current.wrapping_sub(keep as u32));
        }
    }

    /// Hands what was found so far to the tally.
    fn find(&mut self) {
        let analysis = &mut self.lab.analysis;
        let explained = self.scenario.cycle * EXPLAINED_WITHIN;
        let until = monotonic().saturating_add_signed(explained.nanos());
        self.tally.find(until, analysis.take_findings(), std::mem::take(&mut analysis.findings_dropped));
    }

    /// Ends the stations and draws the account up.
    fn end(&mut self) {
        if self.over.is_some() {
            return;
        }
        self.lab.note_end_without_master();
        self.lab.analysis.end();
        let at_most = lost_at_most(self.scenario.cycle);
        self.lab.members.iter_mut().for_each(|member| member.stop_counting(at_most));
        // What a member is at its end is "ended"; what it was before is of interest.
        let states: Vec<String> = (0..self.lab.members.len()).map(|station| self.state(station)).collect();
        self.lab.end();
        self.find();
        // No station reports any more.
        self.tally.judge(True::MAX, &self.lab.records);
        let mut status = self.status();
        for (member, state) in
            status.stations.iter_mut().zip(states).filter(|(member, _)| member.failed.is_none())
        {
            member.state = state;
        }
        self.host = None;
        status.verdict = self.verdict(&status);
        // Whoever takes it down is to hear of what cannot be written: nobody else listens.
        let written = self.json.as_deref().map_or(Ok(()), |path| write_json(path, &status));
        status.unwritten = written.err().map(|error| format!("{error:#}")).into_iter().collect();
        self.over = Some(status);
    }

    /// Has a station's process end, if it runs, and another take its place.
    fn try_restart(&mut self, name: &str) -> Result<u32> {
        let station = self.station(name)?;
        ensure!(self.restarting[station].is_none(), "station '{name}' is being restarted already");
        // A new process begins as the lab's file has it, wherever the one before it was.
        self.lab.analysis.timetable.may_return(station);
        let member = &mut self.lab.members[station];
        if !member.ended {
            member.tell_to_end();
        }
        self.restarting[station] = Some(Instant::now());
        Ok(self.lab.analysis.current().unwrap_or_default())
    }

    /// Starts one anew that was to end and has: each takes a while, and the medium has to be looked at. Who does not end
    /// is killed: it is to be gone anyway.
    fn restart_one_that_ended(&mut self) {
        for station in 0..self.restarting.len() {
            let Some(since) = self.restarting[station] else { continue };
            let member = &mut self.lab.members[station];
            if !member.silent {
                if since.elapsed() > END_WITHIN
                    && let Some(process) = &mut member.process
                {
                    process.kill();
                }
                continue;
            }
            self.restarting[station] = None;
            if let Err(error) = self.lab.restart(&self.scenario, station) {
                self.lab.members[station].failed = Some(format!("it cannot be started anew: {error:#}"));
                self.lab.members[station].ended = true;
            }
            return;
        }
    }

    fn station(&self, name: &str) -> Result<usize> {
        self.scenario.stations.iter().position(|plan| plan.name == name).ok_or_else(|| {
            let names: Vec<&str> = self.scenario.stations.iter().map(|plan| plan.name.as_str()).collect();
            anyhow!("there is no station '{name}': there is {}", names.join(", "))
        })
    }

    /// Who does not know which cycle it is cannot say from which on it is different.
    fn must_have_been_locked(&self, station: usize) -> Result<()> {
        let (name, state) = (&self.scenario.stations[station].name, self.state(station));
        let knows = matches!(state.as_str(), "locked" | "holdover" | "lost");
        ensure!(knows, "station '{name}' is {state}: ask again when it is locked");
        Ok(())
    }

    fn state(&self, station: usize) -> String {
        let member = &self.lab.members[station];
        let is_stopped = || member.process.as_ref().is_some_and(Process::is_stopped);
        let is_ending = || member.process.as_ref().is_some_and(Process::is_ending);
        match member {
            _ if self.restarting[station].is_some() => "restarting".into(),
            Member { ended: true, .. } => "ended".into(),
            _ if is_ending() => "ended".into(),
            _ if is_stopped() => "stopped".into(),
            _ if self.lab.analysis.timetable.has_left(station) => "detached".into(),
            Member { standing: Some(Standing { link, state, .. }), .. } if link != "up" => {
                format!("{state}, {link}")
            }
            _ => member.state().into(),
        }
    }

    fn status(&mut self) -> LabStatus {
        let not_judged = self.lab.not_judged();
        let stations: Vec<MemberStatus> = (0..self.lab.members.len()).map(|i| self.member(i)).collect();
        let analysis = &self.lab.analysis;
        let mut status = LabStatus {
            name: self.home.lab.clone(),
            pid: std::process::id(),
            bridge: self.lab.segment.bridge_name().to_owned(),
            bridge_namespace: self.lab.segment.namespace().path(),
            cpu: self.lab.cpu,
            load: self.lab.load,
            notes: [&self.lab.notes[..], &self.refused()[..]].concat(),
            up_seconds: self.since.elapsed().as_secs(),
            cycle_ns: self.scenario.cycle.nanos() as u64,
            cycles: u64::from(analysis.cycles()),
            frames_expected: stations.iter().map(|s| s.frames_seen + s.slots_missed).sum(),
            frames_seen: stations.iter().map(|s| s.frames_seen).sum(),
            slots_missed: stations.iter().map(|s| s.slots_missed).sum(),
            sync_slot_error_ns: analysis.sync_slot_error.summary().with_gaps(self.tally.syncs_missing),
            sync_window_ns: self.scenario.sync_window.nanos(),
            overlaps: self.tally.overlaps,
            out_of_slot: self.tally.out_of_slot,
            syncs_missing: self.tally.syncs_missing,
            schedule_changes: analysis.changes(),
            time_by: self.scenario.stations[analysis.giver()].name.clone(),
            rivals: analysis.masters.rivals(&self.scenario),
            strangers: analysis.strangers.named(),
            implausible_syncs: analysis.doubted.named(),
            latest_frame_ns: analysis.latest.value(),
            unexplained: self.tally.unexplained,
            unexplained_last: self.tally.shown.iter().map(|finding| self.words(finding)).collect(),
            causes: self.tally.causes.clone(),
            worst: self.worst(),
            not_judged,
            frames_lost: stations.iter().map(|s| s.frames_lost).sum(),
            verdict: Verdict::default(),
            unwritten: Vec::new(),
            stations,
        };
        status.verdict = self.verdict(&status);
        status
    }

    /// What it comes to. The host is looked at anew once in a while only: all its threads are counted then.
    fn verdict(&mut self, status: &LabStatus) -> Verdict {
        let is_new = |(at, _): &(Instant, HostFacts)| at.elapsed() < LOOK_AT_HOST_EVERY;
        let known = self.host.take().filter(is_new);
        let (_, host) = self.host.insert(known.unwrap_or_else(|| (Instant::now(), self.watch.finish())));
        let woke_late = |(id, member): (usize, &Member)| {
            (!self.lab.records.absences.was_stopped(id)).then_some(member.woke_late)
        };
        let woke_late: Vec<_> = self.lab.members.iter().enumerate().map(woke_late).collect();
        let failed = self.lab.capture.failed();
        let interrupted = self.interrupted.as_deref();
        verdict::of(status, &woke_late, failed, interrupted, self.scenario.max_miss_ppm, host)
    }

    /// What the host refused the stations, once each.
    fn refused(&self) -> Vec<String> {
        let mut refused: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for (member, plan) in self.lab.members.iter().zip(&self.scenario.stations) {
            member.refused.iter().for_each(|line| refused.entry(line).or_default().push(&plan.name));
        }
        let all = self.lab.members.len();
        let lines = refused.into_iter().map(|(line, names)| match names.len() {
            n if n == all => format!("{line} (all stations)"),
            _ => format!("{line} ({})", names.join(", ")),
        });
        lines.collect()
    }

    /// The longest of what all stations have missed.
    fn worst(&self) -> Vec<(String, Miss)> {
        let stations = self.lab.members.iter().zip(&self.scenario.stations);
        let all = stations.flat_map(|(member, plan)| {
            member.misses.worst.iter().map(|miss| (plan.name.clone(), miss.clone()))
        });
        let mut all: Vec<_> = all.collect();
        all.sort_by_key(|(_, miss)| Reverse(miss.late_ns));
        all.truncate(WORST);
        all
    }

    fn words(&self, finding: &Finding) -> String {
        let who = |author: Author| self.scenario.stations[author.station].name.clone();
        let who: Vec<String> = finding.authors.iter().flatten().copied().map(who).collect();
        let who = if who.is_empty() { "foreign".to_owned() } else { who.join(", ") };
        format!("cycle {}: {} of {} ({})", finding.cycle, finding.kind.name(), who, finding.span)
    }

    fn member(&self, station: usize) -> MemberStatus {
        let (plan, member) = (&self.scenario.stations[station], &self.lab.members[station]);
        let seen = &self.lab.analysis.stations[station];
        let slots_missed = self.lab.analysis.expected(station).saturating_sub(seen.frames);
        // How much a receiver has heard is known only once it has told of its end.
        let sender = self.scenario.sender(station);
        let lost_of = |of| {
            let passed = self.lab.analysis.stations[sender].passed(of)?;
            let Delivery { heard, meant } = self.lab.delivery(&self.scenario, station, of);
            Some(passed.lost(&heard) - passed.meant(&heard, &meant))
        };
        let has_told = member.silent && !member.ended;
        let lost = self.scenario.streams(sender).filter(|_| has_told).filter_map(lost_of).sum();
        MemberStatus {
            name: plan.name.clone(),
            role: plan.role.to_string(),
            state: self.state(station),
            pid: member.pid(),
            address: self.scenario.address(station).to_string(),
            ip: plan.ip.map(|OwnIp { ip, prefix }| format!("{ip}/{prefix}")),
            frames_seen: seen.frames,
            slots_missed,
            stray: seen.stray,
            payload_errors: member.payload_errors(),
            frames_lost: lost,
            slot_error_ns: seen.slot_error.summary().with_gaps(slots_missed),
            slot_length_ns: self.lab.analysis.slot_length(station).nanos(),
            guard: member.guarded.into(),
            events: member.events.clone(),
            restarts: member.restarts,
            cuts: member.unplugged.count(),
            lost_records: member.standing.as_ref().map_or(0, |standing| standing.lost_records),
            lost: member.is_lost(lost_at_most(self.scenario.cycle)),
            failed: member.failed.clone(),
            refusals: member.standing.as_ref().map(|standing| standing.refusals.clone()).unwrap_or_default(),
        }
    }
}
