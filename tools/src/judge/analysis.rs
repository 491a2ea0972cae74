//! What the observer on the bridge makes of the frames: errors, overlaps, gaps. Pure: it is given frames
//! and stamps.

use std::collections::BTreeMap;

use rtmac::tdma::HOLDOVER_CYCLES;
use rtmac::tdma::schedule::Rate;
use rtmac::wire::change::Status;
use rtmac::wire::{self, Message, Rtmac};
use rtnet::clock::{EmulatedClock, True};
use rtnet::time::{GlobalTime, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header};

use super::closely::Closely;
use super::delivery::Passed;
use super::explain::HELD_UP_FOR;
use super::findings::{Author, Finding, FindingKind};
use super::givers::{Givers, TrueMaster};
use super::masters::Masters;
use super::sight::Sight;
use super::timetable::{Timetable, before};
use super::worst::Worst;
use crate::report::histogram::SignedHistogram;
use crate::report::intervals::Intervals;
use crate::scenario::{Scenario, StationPlan};
use crate::station::traffic::Tag;

use believed::{Doubt, Doubted};
use cycles::Grid;
pub use queueing::Queueing;
pub use schedules::Known;
use schedules::Schedules;
pub use strays::Strangers;

/// Findings that are kept one by one; the rest is counted, and counts as unexplained.
const FINDINGS_MAX: usize = 1_000_000;

/// One station, as seen from the medium.
pub struct Seen {
    /// Frames in its slots.
    pub frames: u64,
    /// Actual - scheduled transmit.
    pub slot_error: SignedHistogram,
    /// Which of its frames were on the medium.
    pub passed: Passed,
    /// The largest of those, early or late.
    pub worst_slot_error: Worst,
    /// Its program's frames, by priority.
    pub queueing: BTreeMap<u8, Queueing>,
    /// Its frames outside its slots, of whatever kind.
    pub stray: u64,
    /// In which cycle the first of them was.
    pub strayed: Option<u32>,
    last: BTreeMap<u8, u32>,
    /// The newest cycle with a frame of it, and how many.
    newest: (u32, u64),
    /// From which cycle on it is waited for, and in which it was heard.
    awaited: Option<(u32, Option<u32>)>,
}

/// The analysis of a run.
pub struct Analysis {
    givers: Givers,
    cycle: Span,
    sync_window: Span,
    guard: Span,
    clock_share: Span,
    rate: Rate,
    /// Whose address is which, by station.
    addresses: Vec<Address>,
    /// Whether programs may send in a station's slots, by station.
    has_sockets: Vec<bool>,
    /// Whether what is tunnelled may be, by station.
    has_tunnel: Vec<bool>,
    /// Which slots there are in which cycles.
    pub timetable: Timetable,
    schedules: Schedules,
    window: Option<(u32, u32)>,
    current: Option<u32>,
    /// From the first cycle that was heard of follow all others.
    grid: Option<Grid>,
    /// The last Synchronisation that was seen, or was passed over.
    last_sync: Option<u32>,
    /// Until when the medium is, or either part of it, and by whom.
    busy: [Option<(True, Option<Author>)>; 2],
    /// Who is on the other side of a cut.
    cut_off: Vec<usize>,
    /// The cycle of the newest Synchronisation that slaves can have heard, unless nobody looked since.
    heard: Option<u32>,
    sight: Sight,
    /// What is looked at besides, if the report is to have pictures.
    closely: Option<Box<Closely>>,
    /// Who gave the time when.
    pub masters: Masters,
    /// The frame in the window that ended latest, by how much after its slot's end, or before it.
    pub latest: Worst,
    /// Synchronisations seen in the window.
    pub syncs: u64,
    /// Actual - scheduled transmit of Synchronisations.
    pub sync_slot_error: SignedHistogram,
    /// (t(n) - t(n-1)) - T of neighbouring cycles' Synchronisations.
    pub sync_period: Intervals,
    /// Since when that is measured, if it was seen: the last Synchronisation.
    period_from: Option<(u32, Option<True>)>,
    /// What ought not to be, in the window.
    pub findings: Vec<Finding>,
    /// Findings beyond those that are kept.
    pub findings_dropped: u64,
    /// By station.
    pub stations: Vec<Seen>,
    /// Frames of others, outside the slots of all.
    pub strangers: Strangers,
    /// Synchronisations that are not what they say.
    pub doubted: Doubted,
}

impl Seen {
    /// A frame of it is outside its slots.
    fn strays(&mut self, cycle: u32) {
        self.stray += 1;
        self.strayed.get_or_insert(cycle);
    }
}

impl Analysis {
    /// An analysis of a scenario whose master has this clock. Nothing counts before [`Analysis::begin`].
    pub fn new(scenario: &Scenario, master: TrueMaster) -> Self {
        let seen = |plan| Seen {
            frames: 0,
            slot_error: SignedHistogram::new(),
            worst_slot_error: Worst::default(),
            queueing: queueing::of_station(plan),
            passed: Passed::default(),
            stray: 0,
            strayed: None,
            last: BTreeMap::new(),
            newest: (0, 0),
            awaited: None,
        };
        Self {
            givers: Givers::of(scenario, master),
            cycle: scenario.cycle,
            sync_window: scenario.sync_window,
            guard: scenario.guard,
            clock_share: scenario.clock_share(),
            rate: scenario.rate,
            addresses: (0..scenario.stations.len()).map(|station| scenario.address(station)).collect(),
            has_sockets: scenario.stations.iter().map(|station| station.ip.is_some()).collect(),
            has_tunnel: scenario.stations.iter().map(StationPlan::has_tunnel).collect(),
            timetable: Timetable::of(scenario),
            schedules: Schedules::default(),
            window: None,
            current: None,
            grid: None,
            last_sync: None,
            busy: [None; 2],
            cut_off: Vec::new(),
            heard: None,
            sight: Sight::default(),
            closely: None,
            masters: Masters::default(),
            latest: Worst::default(),
            syncs: 0,
            sync_slot_error: SignedHistogram::new(),
            sync_period: Intervals::default(),
            period_from: None,
            findings: Vec::new(),
            findings_dropped: 0,
            stations: scenario.stations.iter().map(seen).collect(),
            strangers: Strangers::default(),
            doubted: Doubted::default(),
        }
    }

    /// The clock by which all is judged: of who gives the time.
    pub fn truth(&self) -> &TrueMaster {
        self.givers.truth()
    }

    /// A station begins anew: what it knew of time is gone.
    pub fn begins_anew(&mut self, station: usize) {
        self.givers.begins_anew(station);
    }

    /// What a station took global time for at a true moment.
    pub fn told_time(&mut self, station: usize, at: True, global: GlobalTime) {
        self.givers.told(station, at, global);
    }

    /// A station has another clock from now on.
    pub fn set_clock(&mut self, station: usize, clock: EmulatedClock) {
        self.givers.set_clock(station, clock);
    }

    /// Which station gives the time.
    pub fn giver(&self) -> usize {
        self.givers.now()
    }

    /// Whether the time is of that station's clock, or will be as soon as it is heard again.
    pub fn has_the_time(&self, station: usize) -> bool {
        self.givers.has_the_time(station)
    }

    /// From one cycle's start to the next.
    pub fn cycle(&self) -> Span {
        self.cycle
    }

    /// A station's next frame, of cycle `from` or later, is waited for: see [`Analysis::heard_again`].
    pub fn await_again(&mut self, station: usize, from: u32) {
        self.stations[station].awaited = Some((from, None));
    }

    /// The cycle of the first frame of a station that was waited for.
    pub fn heard_again(&self, station: usize) -> Option<u32> {
        self.stations[station].awaited?.1
    }

    /// A frame on the medium, stamped `at`.
    pub fn frame(&mut self, at: True, bytes: &[u8]) {
        let Some((header, _)) = Header::parse(bytes) else { return };
        let air = self.rate.air_time(bytes.len());
        if header.ether_type() == EtherType::RTMAC {
            let (from, rtmac) = (header.source, wire::parse(bytes).ok());
            if let Some(Rtmac::Tdma(Message::Sync { cycle, sched, .. })) = rtmac {
                let author = Author::sync(self.givers.station(from), cycle);
                if !self.can_have_begun(cycle, at) {
                    self.occupy(at, air, self.cycle_at(at), None);
                    return self.disbelieve(Doubt::CycleAhead, from, at);
                }
                Status::of_sync(bytes).iter().for_each(|status| self.note_schedule(cycle, status));
                self.occupy(at, air, Some(cycle), Some(author));
                self.sync(at, author, (from, sched), air);
            } else if let (Some(Rtmac::Tunnel(..)), Some(author)) = (rtmac, self.turn_of(at, header)) {
                self.occupy(at, air, Some(author.cycle), Some(author));
                self.carried(author, bytes.len(), true);
                self.data(at, None, author, air);
            } else {
                self.occupy(at, air, self.current, None);
                self.judge_rtmac(at, header, rtmac, air);
            }
        } else if let Some((tag, author)) = self.author_of(bytes) {
            if !self.can_have_begun(author.cycle, at) {
                self.occupy(at, air, self.cycle_at(at), None);
                return self.out_of_its_cycle(header.source, at);
            }
            self.occupy(at, air, Some(author.cycle), Some(author));
            self.carried(author, bytes.len(), false);
            self.data(at, Some(tag), author, air);
        } else if let Some(author) = self.turn_of(at, header) {
            self.occupy(at, air, Some(author.cycle), Some(author));
            self.carried(author, bytes.len(), false);
            self.data(at, None, author, air);
        } else {
            // Somebody else's, or nobody's: whom it hits, it hits.
            self.occupy(at, air, self.current, None);
            self.stray(at, header.source, &[header.source], air);
        }
    }

    /// From here on not every frame is given, and stamps cannot be compared with those before. What is
    /// missing up to the cycle whose Synchronisation is seen next counts as missed, but is no finding: nobody
    /// looked.
    pub fn lose_sight(&mut self) {
        (self.busy, self.last_sync, self.heard) = ([None; 2], None, None);
        self.period_from = self.period_from.map(|(cycle, _)| (cycle, None));
        if let Some(current) = self.current {
            self.sight.lose(current);
        }
    }

    /// The window has passed: slots without a frame at its end are missed, too.
    pub fn finish(&mut self) {
        let Some((from, _)) = self.window else { return };
        let end = from.wrapping_add(self.cycles());
        if let Some(last) = self.last_sync {
            self.sync_gaps(self.givers.now(), last.wrapping_add(1), end);
        }
        self.end_periods(end);
        for station in 0..self.stations.len() {
            self.look_back(station, end);
        }
        self.findings = self.take_findings();
    }

    /// What was found since the last time, as far as somebody looked.
    pub fn take_findings(&mut self) -> Vec<Finding> {
        let mut taken = std::mem::take(&mut self.findings);
        taken.retain(|finding| self.sight.shows(finding));
        taken
    }

    /// A station sends no more often than so, throughout.
    pub fn sends_every(&self, station: usize) -> Span {
        self.cycle() / self.timetable.ids(station).len().max(1) as i64
    }

    /// Whether what is missing from a cycle is no finding, since nobody looked.
    pub fn was_blind(&self, cycle: u32) -> bool {
        let missing = Finding::of(Author::sync(0, cycle), FindingKind::SyncGap, Span::ZERO);
        !self.sight.shows(&missing)
    }

    /// Frames that a station should have sent in the cycles that were counted. Of the cycle in which a run was
    /// ended early: those that it did send.
    pub fn expected(&self, station: usize) -> u64 {
        let Some((from, _)) = self.window else { return 0 };
        let end = from.wrapping_add(self.cycles());
        let (newest, frames) = self.stations[station].newest;
        let begun = if newest == end { frames } else { 0 };
        self.timetable.count(station, from, end) + begun
    }

    /// The length of a slot, as which a missed one counts.
    pub fn slot_length(&self, station: usize) -> Span {
        self.length(self.timetable.largest(station))
    }

    fn occupy(&mut self, at: True, air: Span, cycle: Option<u32>, who: Option<Author>) {
        if self.closely.is_some() {
            self.look_closely_at(at, air, who);
        }
        let until = at.saturating_add(air.nanos() as u64);
        let part = who.map_or(0, |who| self.part_of(who.station));
        if let Some((busy_until, before)) = self.busy[part]
            && at < busy_until
            && let Some(cycle) = cycle
        {
            let span = Span::from_nanos((busy_until - at) as i64);
            self.find(Finding { cycle, kind: FindingKind::Overlap, authors: [before, who], span });
        }
        if self.busy[part].is_none_or(|(busy_until, _)| until > busy_until) {
            self.busy[part] = Some((until, who));
        }
    }

    /// The medium falls in two, with these stations in the one part, or is whole again.
    pub fn cut_off(&mut self, stations: &[usize]) {
        self.cut_off = stations.to_vec();
        self.masters.is_cut = !stations.is_empty();
    }

    /// In which part of the medium a station is.
    pub fn part_of(&self, station: usize) -> usize {
        usize::from(self.cut_off.contains(&station))
    }

    fn sync(&mut self, at: True, author: Author, (from, sched): (Address, GlobalTime), air: Span) {
        let cycle = author.cycle;
        let gives = self.givers.has(from);
        if !gives {
            self.doubt(Doubt::Stranger, at);
        }
        // Before anything counts, two may have begun at once, of which one makes way.
        if self.grid.is_none() || self.window.is_none() && gives {
            self.grid = Some(Grid::new(cycle, sched, self.cycle));
        }
        self.heard(author.station, cycle);
        self.masters.sync(from, cycle, self.counts(cycle));
        // Who was to send those that are missing.
        let gave_before = self.givers.now();
        let is_newer = self.last_sync.is_none_or(|last| before(last, cycle));
        if is_newer {
            self.givers.heard(from, at);
        }
        let due = self.start_of(cycle).unwrap_or(sched);
        let error = self.error(at, due + self.givers.after(from));
        let is_off = error < -self.clock_share || error > self.sync_window - air;
        // What cycle it is, nobody need tell us.
        let its = if gives { Some(cycle) } else { self.cycle_at(at) };
        if (sched != due || is_off || !gives)
            && let Some(its) = its.filter(|&its| self.counts(its))
        {
            self.strays(from, its);
        }
        if sched != due {
            self.find(Finding::of(author, FindingKind::OutOfSlot, sched - due));
        }
        self.sight.regain(cycle);
        if self.counts(cycle) {
            self.syncs += 1;
            self.sync_slot_error.record(error.nanos());
            self.latest.note((error + air - self.sync_window).nanos(), cycle);
        }
        if is_off {
            self.find(Finding::of(author, FindingKind::OutOfSlot, error));
        }
        if let Some(last) = self.last_sync {
            match cycle.wrapping_sub(last) as i32 {
                1 => {}
                ..=0 => self.find(Finding::of(author, FindingKind::Repeated, Span::ZERO)),
                _ => self.sync_gaps(gave_before, last.wrapping_add(1), cycle),
            }
        }
        // By its sender's own clock, which may have been set back while another gave the time.
        let late = self.givers.global_of(from, at) - due - self.givers.after(from);
        if !is_newer && late >= HELD_UP_FOR {
            self.doubt(Doubt::CycleBehind, at);
        }
        // Whoever follows has had a newer one.
        if is_newer || late < self.sync_window {
            self.heard = Some(cycle);
            self.last_sync = Some(cycle);
            self.note_period(cycle, at);
            self.current = Some(cycle);
        }
    }

    /// A frame of a slot's turn: of test traffic, or of a program's, which says nothing of itself.
    fn data(&mut self, at: True, tag: Option<&Tag>, author: Author, air: Span) {
        let Author { station, cycle, slot } = author;
        self.heard(station, cycle);
        let counts = self.counts(cycle);
        match tag.map(|tag| (tag, tag.priority())) {
            None => {}
            Some((tag, None)) => self.stations[station].passed.note(tag.sequence(), at, counts),
            Some((tag, Some(_))) => self.note_queued(at, tag, author),
        }
        let Some(id) = slot.filter(|_| counts) else { return };
        self.timetable.sent(station, id, cycle);
        let Some(&slot) = self.timetable.at(station, id, cycle).filter(|slot| slot.has_turn(cycle)) else {
            self.stations[station].strays(cycle);
            return self.find(Finding::of(author, FindingKind::OutOfSlot, Span::ZERO));
        };
        // What the frame says of its instant is what its station believes.
        let Some(start) = self.start_of(cycle) else { return };
        let error = self.error(at, start + slot.offset);
        let gives = station == self.giver();
        if !gives && self.heard.is_some_and(|heard| cycle.wrapping_sub(heard) as i32 > HOLDOVER_CYCLES) {
            self.find(Finding::of(author, FindingKind::WithoutSync, Span::ZERO));
        }
        // A frame may begin early by the clocks' share of its neighbour's guard band, and must leave
        // the same share of its own.
        let end = self.length(slot.size);
        self.latest.note((error + air - end).nanos(), cycle);
        if error < -self.clock_share || error + air > end - self.clock_share {
            self.stations[station].strays(cycle);
            self.find(Finding::of(author, FindingKind::OutOfSlot, error));
        }
        let next = self.window.map_or(cycle, |(from, _)| self.next_turn(station, slot.id, from));
        if before(cycle, next) {
            return self.find(Finding::of(author, FindingKind::Repeated, Span::ZERO));
        }
        self.stations[station].last.insert(slot.id, cycle);
        self.slot_gaps(station, slot.id, next, cycle);
        self.look_how_regular((station, slot.id), at, air, next..cycle);
        let seen = &mut self.stations[station];
        seen.frames += 1;
        seen.newest = (cycle, if seen.newest.0 == cycle { seen.newest.1 + 1 } else { 1 });
        seen.slot_error.record(error.nanos());
        seen.worst_slot_error.note(error.nanos().saturating_abs(), cycle);
    }

    /// A frame of a station that may have been waited for.
    fn heard(&mut self, station: usize, cycle: u32) {
        if let Some((from, again @ None)) = &mut self.stations[station].awaited
            && cycle.wrapping_sub(*from) as i32 >= 0
        {
            *again = Some(cycle);
        }
    }

    /// From a slot's begin to the end of its guard band.
    fn length(&self, size: usize) -> Span {
        self.rate.air_time(size + rtnet::wire::ethernet::HEADER_LEN) + self.guard
    }

    fn find(&mut self, finding: Finding) {
        if !self.counts(finding.cycle) {
            return;
        }
        self.find_closely(&finding);
        if self.findings.len() < FINDINGS_MAX {
            self.findings.push(finding);
        } else {
            self.findings_dropped += 1;
        }
    }
}

mod believed;
mod closer;
mod cycles;
mod gaps;
mod queueing;
mod schedules;
mod strays;
#[cfg(test)]
mod tests;
