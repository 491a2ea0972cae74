//! The course of a [`Case`]: what happens to a network by chance, and what must be true of it all the while.
//!
//! ```text
//!  start ── faults begin and end ── the last ends ── all follow one master ── 60 cycles more
//!  └── no overlap but for a cause ──┘               └── within `settles_within` ──┘ nothing is missing
//! ```

use core::fmt;

use rtmac::tdma::schedule::step_limit;
use rtmac::tdma::{BACKUP_LOOKS_BEFORE, Mastery};
use rtnet::discipline::{Discipline, EventKind, SyncState};
use rtnet::sim::{Host, StationId};
use rtnet::time::Span;

use crate::chance::{Case, LONGEST_HOLD_UP, Trouble};
use crate::judge::Author;
use crate::networks::Lab;

/// A number of cycles that every period divides.
const WATCHED: u64 = 60;
/// All follow one master once they do so for so many cycles: who comes nearer to its line slowly may tremble.
const SETTLED_IN_A_ROW: u64 = 10;
/// Of a case that fails so many of the last events are told.
const EVENTS_TOLD: usize = 40;
/// A frame of a turn is known by its cycle, a request's only by its reply's: that is a period later.
const LONGEST_PERIOD: u32 = 4;

/// What became of a case that went as it must, or of several.
#[derive(Clone, Copy, Debug, Default)]
pub struct Account {
    /// Cycles from the end of the last fault until all followed one master.
    pub settled_after: u64,
    /// And how many there might have been: of several the case that came nearest to it.
    pub settles_within: u64,
    /// Overlaps for which a sender that was held up had told of it.
    pub explained: u64,
    /// Overlaps of a station's request with a reply that was put off, in that station's own slot.
    pub crossed: u64,
    /// Overlaps while two masters gave the time on lines apart.
    pub apart: u64,
    /// Frames on the medium.
    pub frames: u64,
}

impl Account {
    /// Both together.
    pub fn with(self, other: Account) -> Account {
        let nearest =
            if other.settled_after * self.settles_within.max(1) > self.settled_after * other.settles_within {
                other
            } else {
                self
            };
        Account {
            explained: self.explained + other.explained,
            crossed: self.crossed + other.crossed,
            apart: self.apart + other.apart,
            frames: self.frames + other.frames,
            ..nearest
        }
    }
}

impl fmt::Display for Account {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Account { settled_after, settles_within, explained, crossed, apart, frames } = self;
        write!(
            f,
            "{frames} frames, overlaps: held up {explained}, of a request and its reply {crossed}, while two masters were \
             apart {apart}, otherwise 0; settled after {settled_after} of {settles_within} cycles at the most"
        )
    }
}

/// A case on its way.
struct Course<'a> {
    case: &'a Case,
    lab: Lab,
    /// Which member of the network each station is; `None`: it is dead.
    members: Vec<Option<StationId>>,
    /// Who is cut off from the others.
    cut: Vec<StationId>,
    cycle: u64,
    /// Two masters have given the time on lines apart, and not all follow one again.
    apart: bool,
    judged: usize,
    account: Account,
}

impl Case {
    /// Runs it; what is wrong, in words.
    pub fn run(&self) -> Result<Account, String> {
        let mut course = Course::new(self);
        let gone = course.pass_faults().and_then(|()| course.settle()).and_then(|()| course.watch());
        gone.map_err(|why| format!("{why}\n{}", course.describe()))?;
        course.account.frames = course.lab.network.traffic().frames;
        Ok(course.account)
    }

    /// The network once all follow one master after the last fault.
    pub fn settled(&self) -> Result<Lab, String> {
        let mut course = Course::new(self);
        course.pass_faults()?;
        course.settle()?;
        Ok(course.lab)
    }

    /// Within how many cycles of the end of the last fault, from when on nothing is lost or late, all follow one master:
    ///
    /// 0. All are started, within 10 ms, where that is the last that happens.
    /// 1. Somebody gives the time. At the worst a backup has heard one Synchronisation and no more: it waits for a line as
    ///    long as it listens, and then listens.
    /// 2. Of several one is left: a backup steps down in the next cycle; one more each.
    /// 3. The others follow: three Synchronisations, and one that is still of another line.
    /// 4. They calibrate, two periods of the first slot a round, and one that waits for a lost reply before. Who is
    ///    calibrating when requests have come to their limit, or with each master when another begins, starts over: by a
    ///    backup, and by the primary that calibrates with it and returns. Who measures anew is locked meanwhile.
    /// 5. Who followed a line that had drifted from the master's by less than a time step comes to that by what one
    ///    Synchronisation that is late moves a line: a 2400th of the cycle, and a 5000th for drift.
    pub fn settles_within(&self) -> u64 {
        let cycle = self.plan.cycle().nanos() as u64;
        let listens = (50_000_000 / cycle + 1).max(6);
        let stations = &self.plan.scenario.stations;
        let calibrates =
            stations.iter().map(|station| 2 * u64::from(station.slots[0].period * (station.rounds + 1)));
        let drifted = step_limit(self.plan.scenario.guard).nanos() as u64;
        let slews = drifted / (cycle / 2_400 + cycle / 5_000) + SETTLED_IN_A_ROW;
        10_000_000 / cycle + 1 + 2 * listens + 1 + 3 + 4 + 3 * calibrates.max().unwrap_or(0) + slews
    }
}

impl<'a> Course<'a> {
    fn new(case: &'a Case) -> Self {
        let mut lab = case.plan.build();
        let members: Vec<_> = (0..case.plan.stations()).map(Some).collect();
        for (id, host) in case.hosts.iter().enumerate() {
            lab.network.member_mut(id).host = host.clone();
        }
        let account = Account { settles_within: case.settles_within(), ..Account::default() };
        Self { case, lab, members, cut: Vec::new(), cycle: 0, apart: false, judged: 0, account }
    }

    fn pass_faults(&mut self) -> Result<(), String> {
        let last_end = self.case.faults.iter().map(|fault| fault.ends).max().unwrap_or(0);
        for cycle in 0..=last_end {
            self.change(cycle);
            self.pass()?;
        }
        Ok(())
    }

    /// What begins or ends with this cycle.
    fn change(&mut self, cycle: u64) {
        let case = self.case;
        for fault in &case.faults {
            if fault.begins == cycle {
                self.begin(&fault.trouble);
            } else if fault.ends == cycle {
                self.end(&fault.trouble);
            }
        }
    }

    fn begin(&mut self, trouble: &Trouble) {
        let host = |id: &StationId| self.case.hosts[*id].clone();
        match trouble {
            Trouble::Losses(ppm) => self.lose(*ppm),
            Trouble::Outages(id, outage_ppm, longest_outage) => {
                let (outage_ppm, longest_outage) = (*outage_ppm, *longest_outage);
                self.move_to(*id, Host { outage_ppm, longest_outage, ..host(id) });
            }
            Trouble::Stalls(id, stall_ppm, longest_stall) => {
                let (stall_ppm, longest_stall) = (*stall_ppm, *longest_stall);
                self.move_to(*id, Host { stall_ppm, longest_stall, ..host(id) });
            }
            Trouble::Crash(id) => {
                if let Some(member) = self.members[*id].take() {
                    self.lab.network.stop(member);
                }
            }
            Trouble::Cut(stations) => self.cut_off(stations),
        }
    }

    fn end(&mut self, trouble: &Trouble) {
        match trouble {
            Trouble::Losses(_) => self.lose(0),
            Trouble::Outages(id, ..) | Trouble::Stalls(id, ..) => {
                self.move_to(*id, self.case.hosts[*id].clone())
            }
            Trouble::Crash(id) => self.restart(*id),
            Trouble::Cut(_) => self.cut_off(&[]),
        }
    }

    fn cut_off(&mut self, stations: &[StationId]) {
        self.cut = stations.to_vec();
        let there: Vec<_> = stations.iter().filter_map(|&id| self.members[id]).collect();
        self.lab.network.cut_off(&there);
    }

    fn lose(&mut self, ppm: u32) {
        let medium = self.lab.network.medium_mut();
        (medium.lose_control_ppm, medium.lose_data_ppm) = (ppm, ppm);
    }

    fn move_to(&mut self, id: StationId, host: Host) {
        if let Some(member) = self.members[id] {
            self.lab.network.member_mut(member).host = host;
        }
    }

    /// Unless it runs: two crashes of one station may have come together.
    fn restart(&mut self, id: StationId) {
        if self.members[id].is_none() {
            let master = (id == 0).then_some(self.case.plan.cycle());
            let now = self.lab.network.now();
            self.members[id] = Some(self.lab.add(id, master, now));
            self.move_to(id, self.case.hosts[id].clone());
            self.cut_off(&self.cut.clone());
        }
    }

    /// A cycle.
    fn pass(&mut self) -> Result<(), String> {
        self.apart |= self.lines_are_apart();
        self.lab.run_cycles(1);
        self.apart |= self.lines_are_apart();
        self.cycle += 1;
        self.judge()?;
        if self.has_settled() {
            self.apart = false;
        }
        Ok(())
    }

    fn judge(&mut self) -> Result<(), String> {
        let judge = self.lab.judge();
        let new = &judge.overlaps[self.judged..];
        self.judged = judge.overlaps.len();
        for &(a, b) in new {
            if self.apart {
                self.account.apart += 1;
            } else if judge.crossed.contains(&(a, b)) {
                self.account.crossed += 1;
            } else if self.was_held_up(a) || self.was_held_up(b) {
                self.account.explained += 1;
            } else {
                let now = self.cycle;
                return Err(format!("cycle {now}: {a:?} and {b:?} overlap, and nobody was held up"));
            }
        }
        Ok(())
    }

    /// Whether it told that it was, in that turn.
    fn was_held_up(&self, of: Author) -> bool {
        self.lab.events.iter().any(|(id, event)| {
            let stalled = matches!(event.kind, EventKind::StalledInSend | EventKind::ReplyStalled);
            stalled && *id == of.from && event.cycle.abs_diff(of.cycle) <= LONGEST_PERIOD
        })
    }

    fn there(&self) -> impl Iterator<Item = (StationId, StationId)> + '_ {
        self.members.iter().enumerate().filter_map(|(id, member)| Some((id, (*member)?)))
    }

    fn masters(&self) -> impl Iterator<Item = (StationId, StationId)> + '_ {
        self.there().filter(|&(_, member)| self.lab.status(member).mastery == Some(Mastery::Active))
    }

    /// By how much a station's cycles begin later than those of the same number of another, in true time.
    fn later(&self, one: (StationId, StationId), other: (StationId, StationId)) -> Span {
        let begun = |(id, member): (StationId, StationId)| {
            let time = self.lab.network.member(member).station.discipline().time();
            (time.cycle, self.lab.clocks[id].truth(time.start) as i64)
        };
        let ((number, begin), (others_number, others_begin)) = (begun(one), begun(other));
        let cycles = i64::from(number.wrapping_sub(others_number) as i32);
        Span::from_nanos(begin - others_begin - cycles * self.case.plan.cycle().nanos())
    }

    /// Whether that is nothing but for the clocks' share of a guard band, and for what lies between one master's sync window
    /// and the next one's.
    fn agree(&self, one: (StationId, StationId), other: (StationId, StationId)) -> bool {
        self.later(one, other).abs() <= self.case.plan.scenario.clock_share().min(BACKUP_LOOKS_BEFORE)
    }

    /// Whether two give the time, on lines that do not agree.
    fn lines_are_apart(&self) -> bool {
        let Some(first) = self.masters().next() else { return false };
        self.masters().any(|other| !self.agree(first, other))
    }

    /// Whether all are locked to one master.
    fn has_settled(&self) -> bool {
        let mut masters = self.masters();
        let (Some(master), None) = (masters.next(), masters.next()) else { return false };
        let follows =
            |of: (StationId, StationId)| self.lab.state(of.1) == SyncState::Locked && self.agree(of, master);
        self.there().count() == self.members.len() && self.there().all(follows)
    }

    /// From now on nothing is lost or late.
    fn settle(&mut self) -> Result<(), String> {
        for id in 0..self.members.len() {
            self.move_to(id, Host { send: self.case.hosts[id].send.clone(), ..Host::IDEAL });
        }
        // Who was woken late, or held up, is back by then.
        for _ in 0..=LONGEST_HOLD_UP {
            self.pass()?;
        }
        let mut in_a_row = 0;
        while in_a_row < SETTLED_IN_A_ROW {
            in_a_row = if self.has_settled() { in_a_row + 1 } else { 0 };
            self.account.settled_after += 1;
            if self.account.settled_after > self.account.settles_within {
                let within = self.account.settles_within;
                return Err(format!("not all follow one master {within} cycles after the last fault"));
            }
            self.pass()?;
        }
        Ok(())
    }

    /// Every slot has its frame.
    fn watch(&mut self) -> Result<(), String> {
        let before = self.turns_used();
        for _ in 0..WATCHED {
            self.pass()?;
            if !self.has_settled() {
                return Err(format!("cycle {}: no longer all follow one master", self.cycle));
            }
        }
        let after = self.turns_used();
        for (id, station) in self.case.plan.scenario.stations.iter().enumerate() {
            let due: u64 = station.slots.iter().map(|slot| WATCHED / u64::from(slot.period)).sum();
            let (sent, ends) = (after[id] - before[id], station.slots.len() as u64);
            if sent.abs_diff(due) > ends {
                return Err(format!("station {id} sent {sent} frames in {WATCHED} cycles, {due} were due"));
            }
        }
        Ok(())
    }

    /// Frames of data that each has sent, and turns that carried none since the delay was measured anew in them.
    fn turns_used(&self) -> Vec<u64> {
        let anew = |member| self.lab.status(member).counters.slots_calibrating;
        self.there().map(|(id, member)| self.lab.judge().data[id] + anew(member)).collect()
    }

    /// What it is, what happened to it, and what the stations told of last.
    fn describe(&self) -> String {
        let scenario = &self.case.plan.scenario;
        let mut text = format!(
            "  cycle {}, sync window {}, guard band {}, backups {:?}, another master's delay: {:?}\n",
            scenario.cycle,
            scenario.sync_window,
            scenario.guard,
            self.case.plan.backups,
            self.case.plan.follow.on_master_change
        );
        for (id, station) in scenario.stations.iter().enumerate() {
            let slots: Vec<_> = station.slots.iter().map(|s| (s.id, s.offset, s.phase, s.period)).collect();
            let (rounds, drift, host) = (station.rounds, station.clock_drift_ppb, &self.case.hosts[id].wake);
            let member = self.members[id];
            text += &format!(
                "  {id}, now {member:?}: {rounds} rounds, {drift} ppb, wakes in {host:?}, {slots:?}\n"
            );
        }
        for fault in &self.case.faults {
            text += &format!("  {fault:?}\n");
        }
        let master = self.masters().next();
        for (id, member) in self.there() {
            let (state, mastery) = (self.lab.state(member), self.lab.status(member).mastery);
            let later = master.map(|master| self.later((id, member), master));
            text += &format!("  {id}: {state:?}, {mastery:?}, later than the master by {later:?}\n");
        }
        let events = &self.lab.events;
        for (member, event) in &events[events.len().saturating_sub(EVENTS_TOLD)..] {
            text += &format!("  {member}: {event:?}\n");
        }
        text
    }
}
