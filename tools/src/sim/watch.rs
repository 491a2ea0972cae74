//! Who watches a network in virtual time: sees every frame, and hears what every station tells.

use std::collections::BTreeMap;

use rtmac::tdma::Tdma;
use rtmac::wire::Message;
use rtnet::clock::True;
use rtnet::discipline::{Cause, Discipline, SyncState};
use rtnet::sim::{Aired, Loss, Member, Moment, StationId};

use super::places::Seen;
use super::sight::{decoded, sight};
use super::world::{EPOCH, UPTIME};
use crate::judge::absences::Absence;
use crate::judge::analysis::Analysis;
use crate::judge::closely::envelope::Envelope;
use crate::judge::delivery::Meant;
use crate::judge::explain::Records;
use crate::judge::findings::Author;
use crate::judge::noteworthy::Noteworthy;
use crate::observe::decode::{Decoded, What, decode};
use crate::report::capture::Capture;
use crate::report::histogram::SignedHistogram;

/// What is known of a run.
pub struct Watch {
    /// What was seen.
    pub analysis: Analysis,
    /// What was told.
    pub records: Records,
    /// Estimated - true global time, by station.
    pub sync_error: Vec<SignedHistogram>,
    /// The same over time, if the report is to have pictures.
    pub sync_error_over_time: Option<Vec<Envelope>>,
    /// What a reader of the report should know, by station.
    pub noteworthy: Vec<Noteworthy>,
    /// Test traffic that was lost on purpose, by receiver: usual frames, and of each priority.
    pub meant: Vec<BTreeMap<Option<u8>, Meant>>,
    /// Where to write every frame.
    pub capture: Capture,
    /// Frames of these cycles are kept as text.
    pub around: Option<(u32, u32)>,
    /// See `around`.
    pub lines: Vec<String>,
    /// From here on times count.
    pub counting: bool,
    /// What is seen of the network while they do.
    pub seen: Seen,
    /// When the medium is free again.
    free_from: [Option<True>; 2],
    /// When each station has last taken a turn.
    turned: Vec<Option<True>>,
    names: Vec<String>,
}

/// What is early by less than this part of the cycle is shown with the next one.
const EARLY_PARTS: i64 = 8;
/// Frames that are shown around a place.
const LINES_AT_MOST: usize = 100;

impl Watch {
    /// Nothing seen yet.
    pub fn new(analysis: Analysis, records: Records, names: Vec<String>) -> Self {
        Self {
            analysis,
            records,
            sync_error: names.iter().map(|_| SignedHistogram::new()).collect(),
            sync_error_over_time: None,
            noteworthy: vec![Noteworthy::default(); names.len()],
            meant: vec![BTreeMap::new(); names.len()],
            capture: Capture::default(),
            around: None,
            lines: Vec::new(),
            counting: false,
            seen: Seen::of(names.len()),
            free_from: [None; 2],
            turned: vec![None; names.len()],
            names,
        }
    }

    /// A frame goes on the air.
    pub fn aired(&mut self, aired: &Aired<'_>) {
        let realtime = EPOCH.nanos() + (aired.at - UPTIME);
        if self.capture.goes_on() {
            let sight = sight(&self.analysis, aired.at, aired.bytes);
            self.capture.frame(realtime, aired.bytes, Some(&sight.comment()));
        }
        self.analysis.frame(aired.at, aired.bytes);
        self.records.note_frame(aired.bytes);
        self.note_gap(aired);
        self.note_around(aired);
    }

    fn note_gap(&mut self, aired: &Aired<'_>) {
        let free_from = &mut self.free_from[self.analysis.part_of(aired.from)];
        if let (true, Some(free_from), Some(cycle)) =
            (self.counting, *free_from, self.analysis.cycle_at(aired.at))
        {
            self.seen.least_gap.note(free_from.wrapping_sub(aired.at) as i64, cycle);
        }
        *free_from = (*free_from).max(Some(aired.until));
    }

    /// A station has taken its turn.
    pub fn attend(&mut self, moment: &Moment, member: &mut Member<Tdma>) {
        let (station, at) = (moment.id, moment.at);
        self.turned[station] = Some(at);
        let clock = member.clock;
        let tdma = member.station.discipline_mut();
        while let Some(event) = tdma.next_event() {
            let late = event.kind.is_miss().then(|| why_late(moment, event.span.nanos()));
            let author = Author { station, cycle: event.cycle, slot: event.slot };
            let cause = event.kind.cause().or(late);
            self.records.note(author, event.kind, event.span, cause);
            self.analysis.told(author, event.kind, event.span, cause);
            if self.counting {
                self.noteworthy[station].note(event.kind, event.cycle);
            }
        }
        if !moment.sent {
            return;
        }
        let time = tdma.time();
        if matches!(time.state, SyncState::Locked | SyncState::Holdover) {
            let global = time.offset.global(clock.local(at));
            self.analysis.told_time(station, at, global);
            if self.counting && station != 0 {
                let error = global - self.analysis.truth().global(at);
                self.sync_error[station].record(error.nanos());
                if let Some(over_time) = &mut self.sync_error_over_time {
                    over_time[station].note(at, error.nanos());
                }
                self.seen.sync_error[station].note(error.nanos().saturating_abs(), time.cycle);
            }
        }
    }

    /// The medium falls in two in a cycle, with these stations in the one part, or is whole again.
    pub fn cut_off(&mut self, stations: &[StationId], now: u32) {
        self.analysis.cut_off(stations);
        self.records.cuts.note(!stations.is_empty(), now);
    }

    /// A station's process ends in a cycle: with it goes what it had to tell since it last took a turn.
    pub fn ended(&mut self, station: StationId, now: u32) {
        let since = self.turned[station].and_then(|at| self.analysis.cycle_at(at)).unwrap_or(now);
        self.records.absences.break_off(station, Absence::Stopped, now);
        self.records.absences.begin(station, Absence::Down, since);
    }

    /// A frame that was on its way to a station was lost: by its wire, or by what joins all wires.
    pub fn lost(&mut self, to: StationId, frame: &[u8], why: Loss) {
        let (Decoded { what, source, .. }, _) = decoded(&self.analysis, frame);
        if let (true, Some(cycle)) = (self.counting, self.analysis.current()) {
            self.seen.note_lost(to, why, matches!(what, What::Data(_)), cycle);
        }
        match what {
            What::Data(tag) if why.is_on_purpose() => {
                self.meant[to].entry(tag.priority()).or_default().note(tag.sequence());
            }
            What::Tdma(Message::Sync { cycle, .. }) if !is_intact(frame, what, why) => {
                self.records.note_sync_lost(to, (source, cycle), why == Loss::Cut);
            }
            _ => {}
        }
    }

    fn note_around(&mut self, aired: &Aired<'_>) {
        let Some((from, to)) = self.around else { return };
        // What is a little early is of the next cycle, be there a sync of that or not.
        let early = self.analysis.cycle() / EARLY_PARTS;
        let Some((cycle, place)) = self.analysis.place(aired.at + early.nanos() as u64) else { return };
        let what = decoded(&self.analysis, aired.bytes).0.what;
        // One that was held up for cycles is of its own, too.
        let of = what.scheduled().map_or(cycle, |(of, _)| of);
        if ![cycle, of].iter().any(|cycle| (from..=to).contains(cycle)) || self.lines.len() == LINES_AT_MOST {
            return;
        }
        let place = format!("{:+.3}us", (place - early).nanos() as f64 / 1e3);
        let who = self.names.get(aired.from).map_or("foreign", String::as_str);
        let overlaps = if aired.overlaps { "  overlaps" } else { "" };
        self.lines.push(format!("cycle {cycle} {place:>13}  {who}: {what}{overlaps}"));
    }
}

/// Whether what has become of a Synchronisation is nothing to it: only what fills the frame was changed.
fn is_intact(frame: &[u8], what: What, why: Loss) -> bool {
    matches!(why, Loss::Changed(from) if decode(&frame[..from], frame.len()).what == what)
}

/// As a live station's loop tells it: it had woken after the last moment already, or only got to it later.
fn why_late(moment: &Moment, late: i64) -> Cause {
    let last_moment: True = moment.looked.saturating_sub(late.max(0) as u64);
    if moment.woke > last_moment { Cause::TimerLate } else { Cause::Preempted }
}
