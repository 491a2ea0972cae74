//! The account of a run: what was found is judged once everything of its cycle must have been told, and then only
//! counted, so that a run of hours needs no more memory than one of a minute.

use std::collections::BTreeMap;

use rtmac::tdma::line::LINE_GOOD_FOR;
use rtnet::discipline::{Cause, EventKind};
use rtnet::time::Span;

use super::analysis::Analysis;
use super::explain::{Record, Records};
use super::findings::{Finding, FindingKind};
use super::timetable::before;
use crate::report::figures::{Figures, Miss, MissKind};
use crate::scenario::Scenario;

/// For so long a line lasts that nothing confirms: no older record explains anything, but for the newest of each kind.
const EXPLAINS: u32 = 2 * LINE_GOOD_FOR as u32;

/// A run is parted into so many, to tell misses that are usual from those of one bad moment of the host.
pub const PARTS: usize = 20;

/// The records that are listed one by one, and as what, in the order of a report.
const LISTED: [(MissKind, EventKind); 6] = [
    (MissKind::SyncSkipped, EventKind::SyncSkipped),
    (MissKind::StalledInSend, EventKind::StalledInSend),
    (MissKind::StalledInSend, EventKind::ReplyStalled),
    (MissKind::GuardDropped, EventKind::GuardDropped),
    (MissKind::GuardDropped, EventKind::SyncDropped),
    (MissKind::Overrun, EventKind::Overrun),
];

/// What has been judged.
#[derive(Debug, Default)]
pub struct Account {
    /// Found, but something of its cycle may still be told.
    waiting: Vec<Finding>,
    /// The records before this cycle are counted.
    counted_to: Option<u32>,
    /// How many records of each kind each station has told.
    told: BTreeMap<(usize, EventKind), u64>,
    /// By place in `LISTED`: the worst.
    listed: [Vec<Miss>; LISTED.len()],
    /// The worst of what nobody has told of.
    unlisted: Vec<Miss>,
    overlaps: u64,
    out_of_slot: u64,
    syncs_missing: u64,
    /// Why slots were missed.
    causes: BTreeMap<String, u64>,
    /// Why Synchronisations were missing.
    sync_causes: BTreeMap<String, u64>,
    /// Slots missed and frames outside theirs, by part of the run.
    pub missed_in_parts: [u64; PARTS],
    /// Findings that nobody has told of.
    pub unexplained: u64,
    /// In which cycle the first of them was.
    pub first_unexplained: Option<u32>,
    /// The first finding of each kind: of all, and of each station.
    pub firsts: BTreeMap<(FindingKind, Option<usize>), u32>,
}

impl Account {
    /// Of a run of which nothing was judged before its end.
    pub fn of(scenario: &Scenario, analysis: &mut Analysis, records: &Records) -> Self {
        let mut account = Self::default();
        account.close(scenario, analysis, records);
        account
    }

    /// Judges what was found of the cycles before this one, of which nothing more will be told, and forgets what explains
    /// nothing any more. So much of it as counts is in the window.
    pub fn judge(&mut self, scenario: &Scenario, analysis: &mut Analysis, records: &mut Records, to: u32) {
        analysis.look_back_on_all(to);
        self.waiting.append(&mut analysis.take_findings());
        let (judged, waiting) =
            std::mem::take(&mut self.waiting).into_iter().partition(|of| before(of.cycle, to));
        self.waiting = waiting;
        self.part(&judged, analysis);
        self.enter_all(judged, records, scenario);
        self.count(scenario, analysis, records, Some(to));
        records.forget_before(to.wrapping_sub(EXPLAINS));
    }

    /// Judges all that is left, once: nothing more will come.
    pub fn close(&mut self, scenario: &Scenario, analysis: &mut Analysis, records: &Records) {
        self.waiting.append(&mut analysis.take_findings());
        let judged = std::mem::take(&mut self.waiting);
        self.part(&judged, analysis);
        self.enter_all(judged, records, scenario);
        self.unexplained += std::mem::take(&mut analysis.findings_dropped);
        self.count(scenario, analysis, records, None);
    }

    /// How many records of a kind a station has told; all stations, if none is given.
    pub fn told(&self, station: Option<usize>, kind: EventKind) -> u64 {
        match station {
            Some(station) => self.told.get(&(station, kind)).copied().unwrap_or(0),
            None => self.told.iter().filter(|((_, of), _)| *of == kind).map(|(_, n)| n).sum(),
        }
    }

    /// What has been counted, into a report.
    pub fn report(&self, figures: &mut Figures) {
        figures.overlaps = self.overlaps;
        figures.out_of_slot = self.out_of_slot;
        figures.syncs_missing = self.syncs_missing;
        figures.unexplained = self.unexplained;
        figures.causes = self.causes.clone();
        figures.sync_causes = self.sync_causes.clone();
        let all = self.unlisted.iter().chain(self.listed.iter().flatten());
        all.for_each(|miss| figures.note_miss(miss.clone()));
    }

    /// Counts what was missed by when.
    fn part(&mut self, findings: &[Finding], analysis: &Analysis) {
        let Some((from, cycles)) = analysis.window() else { return };
        let is_missed = |of: &&Finding| matches!(of.kind, FindingKind::SlotMissed | FindingKind::OutOfSlot);
        for finding in findings.iter().filter(is_missed) {
            let place = u64::from(finding.cycle.wrapping_sub(from)) * PARTS as u64 / u64::from(cycles.max(1));
            self.missed_in_parts[(place as usize).min(PARTS - 1)] += 1;
        }
    }

    fn enter_all(&mut self, findings: Vec<Finding>, records: &Records, scenario: &Scenario) {
        findings.iter().for_each(|finding| self.enter(finding, records, scenario));
    }

    /// Counts a finding, and lists it if nobody has told of it.
    fn enter(&mut self, finding: &Finding, records: &Records, scenario: &Scenario) {
        match finding.kind {
            FindingKind::Overlap => self.overlaps += 1,
            FindingKind::OutOfSlot => self.out_of_slot += 1,
            FindingKind::SyncGap => self.syncs_missing += 1,
            _ => {}
        }
        let authors = || finding.authors.iter().flatten();
        for of in [None].into_iter().chain(authors().map(|author| Some(author.station))) {
            self.firsts.entry((finding.kind, of)).or_insert(finding.cycle);
        }
        if let Some(cause) = records.explain(finding) {
            return self.count_cause(finding.kind, cause);
        }
        self.unexplained += 1;
        self.first_unexplained.get_or_insert(finding.cycle);
        let author = authors().next_back();
        let station =
            author.map_or("foreign".into(), |author| scenario.stations[author.station].name.clone());
        let (cycle, span_ns) = (finding.cycle.into(), finding.span.nanos());
        let found = Some(finding.kind.name().into());
        let (kind, cause) = (MissKind::Unexplained, String::new());
        Miss { cycle, station, kind, span_ns, cause, found }.note(&mut self.unlisted);
    }

    fn count_cause(&mut self, kind: FindingKind, cause: &str) {
        let causes = match kind {
            FindingKind::SlotMissed => &mut self.causes,
            FindingKind::SyncGap => &mut self.sync_causes,
            _ => return,
        };
        *causes.entry(cause.into()).or_default() += 1;
    }

    /// Counts the records up to a cycle, or all; of those of the window.
    fn count(&mut self, scenario: &Scenario, analysis: &Analysis, records: &Records, to: Option<u32>) {
        let (from, cycles) = analysis.window_counted();
        let is_new = |of: u32| {
            // Where nobody gives the time the count of cycles stands still until the end.
            let counts = if to.is_some() { analysis.counts(of) } else { of.wrapping_sub(from) < cycles };
            counts
                && self.counted_to.is_none_or(|counted| !before(of, counted))
                && to.is_none_or(|to| before(of, to))
        };
        for (kind, record) in records.all().filter(|(_, record)| is_new(record.cycle)) {
            *self.told.entry((record.station, kind)).or_default() += 1;
            if let Some(place) = LISTED.iter().position(|&(_, event)| event == kind) {
                let cause = record.cause.map_or("", Cause::name);
                miss(scenario, LISTED[place].0, &record, cause).note(&mut self.listed[place]);
            }
        }
        // What nobody saw is missed, too, if its station says so.
        for author in records.slots_missed(|cycle| is_new(cycle) && analysis.was_blind(cycle)) {
            let unseen = Finding::of(author, FindingKind::SlotMissed, Span::ZERO);
            if let Some(cause) = records.explain(&unseen) {
                self.count_cause(unseen.kind, cause);
            }
        }
        self.counted_to = to;
    }
}

fn miss(scenario: &Scenario, kind: MissKind, record: &Record, cause: &str) -> Miss {
    let station = scenario.stations[record.station].name.clone();
    let (cycle, span_ns) = (record.cycle.into(), record.span.nanos());
    Miss { cycle, station, kind, span_ns, cause: cause.into(), found: None }
}

#[cfg(test)]
mod tests {
    use rtmac::wire::Message;
    use rtnet::buf::Pool;
    use rtnet::clock::EmulatedClock;
    use rtnet::time::{GlobalTime, Offset};
    use rtnet::wire::ethernet::Address;

    use super::*;
    use crate::judge::absences::Absence;
    use crate::judge::findings::Author;
    use crate::judge::givers::TrueMaster;
    use crate::scenario::Source;

    const NETWORK: &str = r#"
cycle = "1ms"
[[station]]
name = "master"
role = "master"
slots = [{ id = 0, offset = "100us" }]
[[station]]
name = "arm"
role = "slave"
slots = [{ id = 0, offset = "500us" }]
"#;
    const CYCLES: u32 = 30_000;

    /// Of a run in which nobody sends in a slot: the arm tells of each, the master of those from cycle 9000 on, but is
    /// stopped before, killed meanwhile, and back. In every thousandth cycle nobody looks, and in others there is no
    /// Synchronisation. And how many records there were at most.
    fn account(judged_every: Option<u32>) -> (Account, usize) {
        let scenario = Source::new("net.toml", NETWORK).parse().unwrap().with_ideal_clocks();
        let master = TrueMaster { clock: EmulatedClock::default(), epoch: Offset::default() };
        let (mut analysis, mut records) = (Analysis::new(&scenario, master), Records::new(&scenario));
        let (mut account, mut most) = (Account::default(), 0);
        analysis.begin(10, CYCLES);
        let mut sync = Pool::new(1).take().unwrap();
        for cycle in 0..=CYCLES + 10 {
            let at = u64::from(cycle) * 1_000_000;
            let sched = GlobalTime::from_nanos(at);
            Message::Sync { cycle, xmit: sched, sched }.write(
                Address::BROADCAST,
                Address::default(),
                &mut sync,
            );
            match cycle % 1_000 {
                500 => records.note(
                    Author::sync(0, cycle),
                    EventKind::SyncSkipped,
                    Span::ZERO,
                    Some(Cause::TimerLate),
                ),
                _ => analysis.frame(at, &sync),
            }
            match cycle {
                4_000 => records.absences.begin(0, Absence::Stopped, cycle),
                4_400 => {
                    records.absences.break_off(0, Absence::Stopped, cycle);
                    records.absences.begin(0, Absence::Down, cycle);
                }
                4_600 => records.absences.end(0, Absence::Down, cycle),
                _ if cycle % 1_000 == 0 => analysis.lose_sight(),
                _ => {}
            }
            for station in (0..2).filter(|&station| station == 1 || cycle >= 9_000) {
                let author = Author { station, cycle, slot: Some(0) };
                records.note(
                    author,
                    EventKind::Overrun,
                    Span::from_nanos(cycle.into()),
                    Some(Cause::TimerLate),
                );
                records.note(author, EventKind::SlotSilent, Span::ZERO, EventKind::SlotSilent.cause());
            }
            if judged_every.is_some_and(|every| cycle >= 500 && cycle.is_multiple_of(every)) {
                account.judge(&scenario, &mut analysis, &mut records, cycle - 500);
            }
            most = most.max(records.all().count());
        }
        analysis.finish();
        account.close(&scenario, &mut analysis, &records);
        (account, most)
    }

    #[test]
    fn what_is_judged_while_a_run_lasts_is_as_at_its_end_and_needs_no_more_memory_the_longer_it_is() {
        let [(at_end, all), (meanwhile, most)] = [None, Some(300)].map(account);
        assert!(all > 100_000 && most <= 4 * (EXPLAINS + 500 + 2 * 300) as usize, "{all} {most}");
        // But for those that are told of by nobody, since the master was not there, and those that nobody saw.
        assert_eq!((meanwhile.unexplained, meanwhile.first_unexplained), (8_990 - 600 - 2 * 7, Some(10)));
        let report = |account: &Account| {
            let mut figures = Figures::default();
            account.report(&mut figures);
            figures
        };
        assert_eq!(report(&meanwhile), report(&at_end));
        assert_eq!((&meanwhile.told, &meanwhile.firsts), (&at_end.told, &at_end.firsts));
        let causes = [("station_down", 200), ("station_stopped", 400), ("timer_late", 2 * CYCLES - 8_990)];
        assert_eq!(meanwhile.causes, causes.map(|(cause, n)| (cause.to_owned(), u64::from(n))).into());
        assert_eq!((meanwhile.syncs_missing, meanwhile.sync_causes["timer_late"]), (30, 30));
    }
}
