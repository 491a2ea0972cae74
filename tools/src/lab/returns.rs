//! Stations that leave a running lab, and come back.

use anyhow::Result;
use rtmac::tdma::line::LINE_GOOD_FOR;
use rtnet::clock::True;
use rtnet::discipline::Cause;
use rtnet::live::clock::monotonic;

use super::launch::{Resume, arguments};
use super::processes::Process;
use super::run::{INTERFACE, Lab, port_name};
use super::tally::Tally;
use crate::judge::absences::Absence;
use crate::judge::timetable::before;
use crate::scenario::Scenario;
use crate::station::link::Report;

/// For how long at most the observer and the stations hold back what they have to tell.
const HELD_BACK: True = 2_000_000_000;
/// A thread may be stopped so much sooner than the one that tells of it, which waits for a core.
const STOPPING: True = 100_000_000;
/// Who is locked sends within so many cycles, or misses them.
const SENDS_WITHIN: u32 = 8;

impl Lab {
    /// A station's wire was cut or mended, or its process has ended: what that had to tell of later than its last
    /// words went with it.
    pub(super) fn note_absence(&mut self, station: usize, report: Option<&Report>) {
        let (why, from) = match report {
            Some(&Report::Link { carrier: true, .. }) => {
                if let Some(now) = self.analysis.cycle_at(monotonic()) {
                    self.records.absences.end(station, Absence::NoCarrier, now.wrapping_add(1));
                }
                return;
            }
            Some(&Report::Link { at, carrier: false }) => (Absence::NoCarrier, at),
            Some(_) => return,
            None => {
                let (now, standing) = (monotonic(), self.members[station].standing.as_ref());
                let told = standing.map_or(now, |standing| standing.at);
                // Who is held up before it sends tells how it is, but not what it misses.
                let held_up = self.play.held_up_since(station, now);
                if let Some(now) = self.analysis.cycle_at(now) {
                    self.records.absences.break_off(station, Absence::Stopped, now);
                }
                (Absence::Down, held_up.map_or(told, |since| since.min(told)))
            }
        };
        if let Some(from) = self.analysis.cycle_at(from) {
            self.records.absences.begin(station, why, from);
        }
    }

    /// Who is stopped notices nothing, and has soon missed more than it can tell of when it goes on.
    pub(super) fn note_stopped(&mut self) {
        let at = monotonic();
        let cycles = [at, at.saturating_sub(STOPPING)].map(|at| self.analysis.cycle_at(at));
        let [Some(now), Some(before)] = cycles else { return };
        let stopping = now.wrapping_sub(before);
        for (station, member) in self.members.iter_mut().enumerate() {
            let is_stopped = member.process.as_ref().is_some_and(Process::is_stopped);
            match (is_stopped, member.seen_running.replace(now)) {
                (true, Some(last)) => {
                    self.records.absences.begin(station, Absence::Stopped, last.wrapping_sub(stopping));
                    // It was seen to run then, and not since.
                    member.seen_running = Some(last);
                }
                // It never was.
                (true, None) => self.records.absences.begin(station, Absence::Stopped, now),
                (false, _) => self.records.absences.end(station, Absence::Stopped, now.wrapping_add(1)),
            }
        }
    }

    /// Counts, by cause, what is missed while stations are not there, so that one which is away for days costs no
    /// memory: what the observer may still have to tell of is left for later.
    pub(super) fn count_absences(&mut self, tally: &mut Tally) {
        let Some(until) = monotonic().checked_sub(HELD_BACK).and_then(|at| self.analysis.cycle_at(at)) else {
            return;
        };
        let open: Vec<_> = self.records.absences.open().filter(|&(.., from)| before(from, until)).collect();
        for &(station, why, from) in &open {
            tally.add(why.name(), self.analysis.pass_over(station, from, until));
        }
        let giver = self.records.absences.now(self.analysis.giver());
        if let Some((why, from)) = giver.filter(|&(_, from)| before(from, until)) {
            tally.add(why.name(), self.analysis.pass_over_syncs(from, until));
            // Where nobody gives the time nobody sends, and after a while nobody tells of it.
            let lineless = from.wrapping_add(LINE_GOOD_FOR as u32 + 1);
            for other in 1..self.members.len() {
                tally.add(Cause::NoSync.name(), self.analysis.pass_over(other, lineless, until));
            }
        }
        // Who is there has told of what it missed by now. The observer may be behind.
        let seen = self.analysis.current().filter(|&current| before(current, until)).unwrap_or(until);
        for station in (0..self.members.len()).filter(|of| !open.iter().any(|(who, ..)| who == of)) {
            self.analysis.look_back(station, seen);
        }
    }

    /// The moment up to which all running stations have reported what they noticed.
    pub(super) fn reported(&self) -> True {
        let away = [Absence::Down, Absence::Stopped];
        let is_there = |station: usize| !away.iter().any(|&why| self.records.absences.is_open(station, why));
        let there = self.members.iter().enumerate().filter(|(station, of)| !of.silent && is_there(*station));
        let reported = there.filter_map(|(_, member)| member.standing.as_ref().map(|standing| standing.at));
        reported.min().unwrap_or(True::MAX)
    }

    /// Whether its master is there.
    pub(super) fn has_master(&self) -> bool {
        !self.records.absences.open().any(|(station, ..)| station == 0)
    }

    /// A lab that ends without its master ends now, not with the last Synchronisation.
    pub(super) fn note_end_without_master(&mut self) {
        let now = self.analysis.cycle_at(monotonic());
        if let (Some(now), false) = (now, self.has_master()) {
            self.analysis.advance_to(now);
        }
    }

    /// Who was restarted is there again from its first frame on; one that is locked and sends none is there, too.
    pub(super) fn note_returns(&mut self) {
        for (station, member) in self.members.iter().enumerate() {
            if member.silent || !self.records.absences.is_open(station, Absence::Down) {
                continue;
            }
            let locked = member.standing.as_ref().filter(|standing| standing.is_locked());
            let sends_by = locked.map(|standing| standing.cycle.wrapping_add(SENDS_WITHIN));
            // The observer may still hold its first frame back.
            let seen = |&by: &u32| self.analysis.current().is_some_and(|current| before(by, current));
            if let Some(cycle) = self.analysis.heard_again(station).or(sends_by.filter(seen)) {
                self.records.absences.end(station, Absence::Down, cycle);
            }
        }
    }

    /// Starts a station anew whose process has ended. A master goes on with its predecessor's grid.
    pub(super) fn restart(&mut self, scenario: &Scenario, station: usize) -> Result<()> {
        let first = self.analysis.stations[station].beyond();
        let resume = Resume { grid: self.analysis.grid(), first, clock: self.members[station].clock };
        self.analysis.begins_anew(station);
        let arguments = arguments(scenario, station, &self.launch, &resume)?;
        let member = &self.members[station];
        // Somebody may have taken its interface away, or renamed it.
        if member.namespace.netlink()?.link_index(INTERFACE).is_err() {
            // Mostly the port went with it.
            let _ = self.segment.detach(&port_name(station));
            self.segment.attach(
                &member.namespace,
                &port_name(station),
                INTERFACE,
                scenario.address(station).0,
            )?;
            self.wires.mend(&self.segment, station)?;
            self.plug(station)?;
        }
        let process = Process::start(&member.namespace, station, &arguments, self.teller.clone())?;
        self.members[station].restart(process);
        // Of the wire it tells anew.
        self.note_absence(station, Some(&Report::Link { at: 0, carrier: true }));
        if let Some(now) = self.analysis.cycle_at(monotonic()) {
            // Of this cycle there may still be a frame of the process before it.
            self.analysis.await_again(station, now.wrapping_add(1));
        }
        Ok(())
    }
}
