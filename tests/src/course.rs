//! The course of a [`Case`]: what happens to a network by chance, and what must be true of it all the while.
//!
//! ```text
//!  start ── faults begin and end ── the last ends ── all follow one master ── 60 cycles more
//!  └── no overlap but for a cause ──┘               └── within `settles_within` ──┘ nothing is missing
//! ```

mod account;
mod belief;
mod describe;
mod excuse;

use rtmac::tdma::schedule::step_limit;
use rtmac::tdma::{BACKUP_LOOKS_BEFORE, slow_at_most};
use rtnet::sim::{Host, Link, StationId, Wander};
use rtnet::time::Span;

pub use account::Account;
use belief::{Belief, Beliefs};
use excuse::Parted;

use crate::chance::{Case, LONGEST_HOLD_UP, Trouble};
use crate::networks::Lab;

/// A number of cycles that every period divides.
const WATCHED: u64 = 60;
/// All follow one master once they do so for so many cycles: who comes nearer to its line slowly may tremble.
const SETTLED_IN_A_ROW: u64 = 10;
/// A primary that has heard another in so many cycles makes way.
const RIVALS_LAST: u64 = 10;
/// All have been started by then, and had their first turn: nanoseconds.
const ALL_STARTED: u64 = 11_000_000;
/// A station's longest sleep.
const LONGEST_SLEEP: Span = Span::from_millis(100);
/// A clock that does not wander does so again after a time that does not come.
const NEVER: Span = Span::from_millis(10_000_000);

/// A case on its way.
struct Course<'a> {
    case: &'a Case,
    lab: Lab,
    /// Which member of the network each station is; `None`: it is dead.
    members: Vec<Option<StationId>>,
    /// Which station each member is, or was.
    stations: Vec<StationId>,
    /// Who is cut off from the others.
    cut: Vec<StationId>,
    cycle: u64,
    beliefs: Beliefs,
    /// On which line time was given last.
    grid: Option<Belief>,
    parted: Parted,
    /// Who is, or was, another primary.
    second: Option<StationId>,
    judged: usize,
    account: Account,
    /// Counts what memory is asked for.
    counter: Option<fn() -> u64>,
    counted: u64,
}

impl Case {
    /// Runs it; what is wrong, in words.
    pub fn run(&self) -> Result<Account, String> {
        let mut course = Course::new(self);
        let gone = course.pass_faults().and_then(|()| course.settle()).and_then(|()| course.watch());
        let gone = gone.and_then(|()| course.check_excuses());
        gone.map_err(|why| format!("{why}\n{}", course.describe()))?;
        course.account.frames = course.lab.network.traffic().frames;
        Ok(course.account)
    }

    /// How often memory is asked for or given back, as `calls` counts it, while the network runs: from when all are started,
    /// through all faults, until all follow one master. What is done to it is not counted, nor who looks on.
    pub fn calls_while_it_runs(&self, calls: fn() -> u64) -> Result<u64, String> {
        let mut course = Course::new(self);
        course.lab.network.observe(|_| ());
        course.counter = Some(calls);
        course.pass_faults()?;
        course.settle()?;
        Ok(course.counted)
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
    /// 3. The others follow: as many Synchronisations as make a line that is later by less than a quarter of the cycle.
    /// 4. They calibrate, two periods of the first slot a round, and one that waits for a lost reply before. Who is
    ///    calibrating when requests have come to their limit, or with each master when another begins, starts over: by a
    ///    backup, and by the primary that calibrates with it and returns. Who measures anew is locked meanwhile.
    /// 5. Who followed a line that had drifted from the master's by less than a time step comes to that by what one
    ///    Synchronisation that is late moves a line: a 2400th of the cycle, and a 5000th for drift.
    /// 6. Of two primaries one has heard the other in ten cycles at the most, and makes way.
    /// 7. Whose clock is set back wakes after its longest sleep; who gives the time, when its clock shows again what it waits
    ///    for.
    pub fn settles_within(&self) -> u64 {
        let cycle = self.plan.cycle().nanos() as u64;
        let listens = (50_000_000 / cycle + 1).max(6);
        let stations = &self.plan.scenario.stations;
        let calibrates =
            stations.iter().map(|station| 2 * u64::from(station.slots[0].period * (station.rounds + 1)));
        let drifted = step_limit(self.plan.scenario.guard).nanos() as u64;
        let slews = drifted / (cycle / 2_400 + cycle / 5_000) + SETTLED_IN_A_ROW;
        let is_primary = |trouble: &Trouble| matches!(trouble, Trouble::Primary(..));
        let rivals = if self.faults.iter().any(|f| is_primary(&f.trouble)) { RIVALS_LAST } else { 0 };
        rivals
            + self.set_back() / cycle
            + 10_000_000 / cycle
            + 1
            + 2 * listens
            + 1
            + u64::from(slow_at_most(self.plan.cycle()))
            + 4
            + 3 * calibrates.max().unwrap_or(0)
            + slews
    }
}

impl Case {
    /// For how long somebody may wait because a clock was set back.
    fn set_back(&self) -> u64 {
        let may_give_time = |id| id == 0 || self.plan.backups.iter().any(|&(of, _)| of == id);
        let waits = self.faults.iter().filter_map(|fault| match fault.trouble {
            Trouble::Step(id, by) if may_give_time(id) => Some((-by).max(LONGEST_SLEEP)),
            Trouble::Step(..) => Some(LONGEST_SLEEP),
            _ => None,
        });
        waits.max().map_or(0, |wait| wait.nanos() as u64)
    }
}

impl<'a> Course<'a> {
    fn new(case: &'a Case) -> Self {
        let mut lab = case.plan.build();
        let members: Vec<_> = (0..case.plan.stations()).map(Some).collect();
        for (id, host) in case.hosts.iter().enumerate() {
            lab.network.member_mut(id).host = host.clone().into();
        }
        let (settles_within, apart_within) = (case.settles_within(), case.apart_within());
        let account = Account { settles_within, apart_within, ..Account::default() };
        let share = case.plan.scenario.clock_share().min(BACKUP_LOOKS_BEFORE);
        Self {
            case,
            lab,
            stations: (0..members.len()).collect(),
            beliefs: Beliefs::new(members.len(), share),
            members,
            cut: Vec::new(),
            cycle: 0,
            grid: None,
            parted: Parted::default(),
            second: None,
            judged: 0,
            account,
            counter: None,
            counted: 0,
        }
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
            Trouble::Crash(id) => self.stop(*id),
            Trouble::Cut(stations) => self.cut_off(stations),
            Trouble::Step(id, by) => self.set_clock(*id, *by),
            Trouble::Wander(id, wander) => self.wander(*id, *wander),
            Trouble::Doubles(id, duplicate_ppm) => {
                self.wire(*id, &Link { duplicate_ppm: *duplicate_ppm, ..Link::default() });
            }
            Trouble::Changes(id, corrupt_ppm) => {
                self.wire(*id, &Link { corrupt_ppm: *corrupt_ppm, ..Link::default() });
            }
            Trouble::Primary(id, part) => {
                self.stop(*id);
                self.cut_off(part);
                self.start(*id, true);
                self.second = Some(*id);
            }
        }
    }

    fn end(&mut self, trouble: &Trouble) {
        match trouble {
            Trouble::Losses(_) => self.lose(0),
            Trouble::Outages(id, ..) | Trouble::Stalls(id, ..) => {
                self.move_to(*id, self.case.hosts[*id].clone())
            }
            Trouble::Crash(id) => self.restart(*id),
            Trouble::Cut(_) | Trouble::Primary(..) => self.cut_off(&[]),
            Trouble::Step(..) => {}
            Trouble::Wander(id, wander) => {
                let around_ppb = self.members[*id]
                    .map_or(wander.around_ppb, |member| self.lab.network.member(member).clock.drift_ppb);
                self.wander(*id, Wander { every: NEVER, step_ppb: 0, within_ppb: 0, around_ppb });
            }
            Trouble::Doubles(id, _) | Trouble::Changes(id, _) => self.wire(*id, &Link::default()),
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
            self.lab.network.member_mut(member).host = host.into();
        }
    }

    fn stop(&mut self, id: StationId) {
        if let Some(member) = self.members[id].take() {
            // Its clock runs on.
            self.lab.clocks[id] = self.lab.network.member(member).clock;
            self.lab.network.stop(member);
        }
    }

    /// Unless it runs: two crashes of one station may have come together.
    fn restart(&mut self, id: StationId) {
        if self.members[id].is_none() {
            self.start(id, id == 0);
        }
    }

    fn start(&mut self, id: StationId, as_primary: bool) {
        let now = self.lab.network.now();
        let member = self.lab.add(id, as_primary.then_some(self.case.plan.cycle()), now);
        self.members[id] = Some(member);
        self.stations.push(id);
        self.move_to(id, self.case.hosts[id].clone());
        self.cut_off(&self.cut.clone());
    }

    fn set_clock(&mut self, id: StationId, by: Span) {
        match self.members[id] {
            Some(member) => {
                let clock = self.lab.network.member(member).clock.stepped(by);
                self.lab.network.set_clock(member, clock);
            }
            None => self.lab.clocks[id] = self.lab.clocks[id].stepped(by),
        }
        self.parted.set.push(id);
    }

    fn wander(&mut self, id: StationId, wander: Wander) {
        if let Some(member) = self.members[id] {
            self.lab.network.wander(member, wander);
        }
    }

    fn wire(&mut self, id: StationId, link: &Link) {
        if let Some(member) = self.members[id] {
            let (sends_by, hears_by) = self.lab.network.wire_mut(member);
            (*sends_by, *hears_by) = (link.clone(), link.clone());
        }
    }

    /// A cycle.
    fn pass(&mut self) -> Result<(), String> {
        self.look();
        let corrupted = self.lab.network.traffic().corrupted;
        self.run_cycle();
        self.parted.changed |= self.lab.network.traffic().corrupted > corrupted;
        self.look();
        self.cycle += 1;
        self.judge()?;
        if self.has_settled() {
            let changes = |trouble: &Trouble| matches!(trouble, Trouble::Changes(..));
            let faults = &mut self.case.faults.iter();
            let go_on = faults.any(|fault| changes(&fault.trouble) && fault.is_on(self.cycle));
            self.parted = Parted { changed: self.parted.changed && go_on, ..Parted::default() };
        }
        Ok(())
    }

    fn run_cycle(&mut self) {
        let Some(calls) = self.counter else { return self.lab.run_cycles(1) };
        let cycle = self.case.plan.cycle().nanos() as u64;
        let all_run = self.cycle * cycle > ALL_STARTED;
        let before = calls();
        self.lab.network.run_until(self.lab.network.now() + cycle);
        self.counted += if all_run { calls() - before } else { 0 };
        self.lab.take_events();
    }

    /// What all take for the time, and whether it is given on another line than before, or on two.
    fn look(&mut self) {
        self.beliefs.look(&self.lab, &self.members);
        let Some(first) = self.beliefs.masters().next().copied() else { return };
        let before = self.grid.replace(first);
        let goes_on = before.is_none_or(|before| self.beliefs.agree(&first, &before));
        let one = self.beliefs.masters().all(|other| self.beliefs.agree(&first, other));
        self.parted.grids |= !(goes_on && one);
    }

    fn there(&self) -> impl Iterator<Item = (StationId, StationId)> + '_ {
        self.members.iter().enumerate().filter_map(|(id, member)| Some((id, (*member)?)))
    }

    /// Whether all are locked to one master.
    fn has_settled(&self) -> bool {
        let mut masters = self.beliefs.masters();
        let (Some(master), None) = (masters.next(), masters.next()) else { return false };
        let follows = |of: &Belief| of.is_locked_to(master) && self.beliefs.agree(of, master);
        (0..self.members.len()).all(|id| self.beliefs.of(id).is_some_and(follows))
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
        let (before, overlaps) = (self.turns_used(), self.judged);
        for _ in 0..WATCHED {
            self.pass()?;
            if self.judged > overlaps {
                return Err(format!("cycle {}: frames overlap while all are locked", self.cycle));
            }
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
}
