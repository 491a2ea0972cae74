//! From what was seen and told to the figures of a report.

use std::collections::BTreeMap;
use std::ops::Range;

use rtnet::discipline::EventKind;
use rtnet::time::Span;

use super::account::{Account, PARTS};
use super::analysis::Analysis;
use super::closely::envelope::Envelope;
use super::delivery::Delivery;
use super::kept::Kept;
use super::verdict::{Evidence, Reason, judge};
use crate::report::figures::{Figures, QueueingFigures, Role, StationFigures};
use crate::report::histogram::SignedHistogram;
use crate::report::host::HostFacts;
use crate::scenario::Scenario;

/// What a run has shown.
pub struct Outcome {
    /// The report's figures.
    pub figures: Figures,
    /// What its verdict follows from.
    evidence: Evidence,
    /// |slot error - the station's median| of all stations.
    pub slot_error_abs: SignedHistogram,
    /// Slots missed and frames outside theirs, by part of the run.
    pub missed_in_parts: [u64; PARTS],
    /// What the pictures of a report show.
    pub kept: Kept,
}

impl Outcome {
    /// Judges it once more, with what else speaks against it.
    pub fn add(&mut self, reasons: impl IntoIterator<Item = Reason>) {
        self.evidence.reasons.extend(reasons);
        self.figures.verdict = judge(&self.evidence, self.figures.max_miss_ppm, &self.figures.host);
    }
}

/// What a run leaves.
pub struct Parts {
    /// By station.
    pub stations: Vec<Facts>,
    /// What was seen.
    pub analysis: Analysis,
    /// What was made of it and of what was told.
    pub account: Account,
    /// How long before their slots stations wake.
    pub lead: Span,
    /// What a reader should know of the whole.
    pub notes: Vec<String>,
    /// Frames that the observer lost.
    pub dropped: u64,
    /// How often the host's clock was seen to jump.
    pub wall_steps: u64,
    /// Frames whose stamps a step of the wall clock made worthless.
    pub distrusted: u64,
    /// Why what was to be captured is not whole.
    pub capture_failed: Option<String>,
    /// Somebody ended it before its time.
    pub interrupted: bool,
    /// It ended before its time for another reason, which is said elsewhere.
    pub ended_early: bool,
}

/// What is known of a station besides what was seen of it.
#[derive(Default)]
pub struct Facts {
    /// Its process, if it has one.
    pub pid: u32,
    /// Whether the kernel enforces its slots.
    pub guarded: bool,
    /// The delay from the master that it has measured.
    pub delay_ns: Option<i64>,
    /// Frames whose payload was not what was sent to it.
    pub payload_errors: u64,
    /// Estimated - true global time.
    pub sync_error: SignedHistogram,
    /// The same over time, for a report with pictures.
    pub sync_error_over_time: Envelope,
    /// How much later than it was to be its last look at the clock before a send was.
    pub late: SignedHistogram,
    /// See [`super::verdict::Slots::woke_late`].
    pub woke_late: Option<u64>,
    /// Resident memory, bytes.
    pub resident: u64,
    /// Processor time of the whole process, seconds.
    pub cpu_seconds: f64,
    /// Share of a core that its real-time thread used.
    pub rt_cpu_share: f64,
    /// Frames missing between those that it received.
    pub sequence_gaps: u64,
    /// What came of each kind of its sender's frames, see [`Scenario::streams`]; of a station that was lost it is not known.
    pub deliveries: BTreeMap<Option<u8>, Delivery>,
    /// What its stack refused, by name of the refusal.
    pub refusals: BTreeMap<String, u64>,
    /// What a reader should know.
    pub notes: Vec<String>,
    /// How often it saw the host's clock jump.
    pub clock_steps: u64,
    /// Events that it could not tell of.
    pub lost_records: u64,
    /// Frames that its program queued and for which there was no room, by priority.
    pub queue_refused: BTreeMap<u8, u64>,
    /// What is wrong with it.
    pub reproach: Option<Reason>,
}

/// The figures.
pub fn of(scenario: &Scenario, parts: Parts, host: HostFacts) -> Outcome {
    let Parts { stations, analysis, account, .. } = &parts;
    let own = |kind| account.told(None, kind);
    let mut figures = Figures {
        stations: stations.len() as u64,
        cycle_ns: scenario.cycle.nanos() as u64,
        lead_ns: parts.lead.nanos(),
        last_moment_ns: scenario.latest().nanos(),
        cycles: u64::from(analysis.cycles()),
        syncs_sent: analysis.syncs,
        syncs_skipped: own(EventKind::SyncSkipped) + own(EventKind::SyncDropped),
        overruns: own(EventKind::Overrun),
        stalled_in_send: own(EventKind::StalledInSend) + own(EventKind::ReplyStalled),
        guard_drops: own(EventKind::GuardDropped) + own(EventKind::SyncDropped),
        latest_frame_ns: analysis.latest.value(),
        sync_period_jitter_ns: analysis.sync_period.summary(),
        host,
        max_miss_ppm: scenario.max_miss_ppm,
        rt_cpu_percent: stations.iter().map(|station| station.rt_cpu_share).sum::<f64>() * 100.0,
        clock_steps: parts.wall_steps + stations.iter().map(|station| station.clock_steps).sum::<u64>(),
        capture_dropped: parts.dropped,
        takeovers: analysis.masters.takeovers_all,
        takeover_cycles: analysis.masters.takeover_cycles,
        rival_cycles: analysis.masters.rival_cycles,
        masters_seen: analysis.masters.takeovers.clone(),
        rivals: analysis.masters.rivals(scenario),
        strangers: analysis.strangers.named(),
        implausible_syncs: analysis.doubted.named(),
        ..Figures::default()
    };
    let mut all = Histograms::new();
    for station in 0..stations.len() {
        let one = station_figures(scenario, &parts, station, &mut all);
        figures.frames_expected += one.frames_expected;
        figures.frames_seen += one.frames_seen;
        figures.slots_missed += one.slots_missed;
        figures.payload_errors += one.payload_errors;
        figures.frames_lost += one.frames_lost;
        figures.lost_on_purpose += one.lost_on_purpose;
        figures.per_station.push(one);
    }
    // Who gives the time throughout has no estimate of it.
    let untold = figures.per_station.iter().filter_map(|station| station.sync_error_ns.gaps).sum();
    figures.slot_error_ns = all.slot_error.summary().with_gaps(figures.slots_missed);
    figures.slot_error_abs_ns = all.slot_error_abs.summary().with_gaps(0);
    figures.sync_error_ns = all.sync_error.summary().with_gaps(untold);
    figures.wake_latency = wake_latency(&parts.stations);
    figures.queueing = queueing(scenario, &parts, 0..stations.len());
    figures.sync_error_abs_ns = all.sync_error.deviation_from(0).summary().with_gaps(untold);
    account.report(&mut figures);
    let evidence = reasons::evidence(scenario, &parts, &figures);
    let missed_in_parts = account.missed_in_parts;
    let slot_error_abs = all.slot_error_abs;
    let mut outcome = Outcome { figures, evidence, slot_error_abs, missed_in_parts, kept: kept(parts) };
    outcome.add([]);
    outcome
}

/// What is left for the pictures of a report.
fn kept(parts: Parts) -> Kept {
    let Parts { stations, mut analysis, .. } = parts;
    let begin = analysis.begin_of_window().unwrap_or_default();
    let (cycles, regular) = analysis.take_closely().unwrap_or_default();
    Kept {
        slot_error: analysis.stations.into_iter().map(|seen| seen.slot_error).collect(),
        cycles,
        regular,
        sync_error: stations.into_iter().map(|facts| facts.sync_error_over_time).collect(),
        begin,
    }
}

/// Of all stations, as hosts of simulations take it: ranges of nanoseconds, and how many there were.
fn wake_latency(stations: &[Facts]) -> Vec<(u64, u64, u64)> {
    let mut all = SignedHistogram::new();
    stations.iter().for_each(|station| all.merge(&station.late));
    all.iter().map(|(late, n)| (late.unsigned_abs(), late.unsigned_abs(), n)).collect()
}

/// Over all stations.
struct Histograms {
    slot_error: SignedHistogram,
    slot_error_abs: SignedHistogram,
    sync_error: SignedHistogram,
}

impl Histograms {
    fn new() -> Self {
        let (slot_error, slot_error_abs) = (SignedHistogram::new(), SignedHistogram::new());
        Self { slot_error, slot_error_abs, sync_error: SignedHistogram::new() }
    }
}

fn station_figures(
    scenario: &Scenario,
    parts: &Parts,
    station: usize,
    all: &mut Histograms,
) -> StationFigures {
    let (plan, facts) = (&scenario.stations[station], &parts.stations[station]);
    let seen = &parts.analysis.stations[station];
    let expected = parts.analysis.expected(station);
    let missed = expected.saturating_sub(seen.frames);
    let mut slot_error_abs = seen.slot_error.deviation_from(seen.slot_error.median());
    // A missed slot is not without error: it counts as a whole slot.
    slot_error_abs.record_n(parts.analysis.slot_length(station).nanos(), missed);
    all.slot_error.merge(&seen.slot_error);
    all.slot_error_abs.merge(&slot_error_abs);
    all.sync_error.merge(&facts.sync_error);
    let own = |kind| parts.account.told(Some(station), kind);
    let lost: Vec<Lost> = lost(scenario, parts, station).collect();
    let mut notes = facts.notes.clone();
    if station == 0 {
        notes.extend(parts.notes.clone());
    }
    StationFigures {
        name: plan.name.clone(),
        role: plan.role,
        mac: scenario.address(station).to_string(),
        pid: facts.pid,
        clock_offset_ns: plan.clock_offset.nanos(),
        clock_drift_ppb: plan.clock_drift_ppb,
        calibration_delay_ns: facts.delay_ns.filter(|_| plan.role != Role::Master),
        frames_expected: expected,
        frames_seen: seen.frames,
        slots_missed: missed,
        stray: seen.stray,
        overruns: own(EventKind::Overrun),
        stalled_in_send: own(EventKind::StalledInSend) + own(EventKind::ReplyStalled),
        guard: facts.guarded.into(),
        guard_drops: own(EventKind::GuardDropped) + own(EventKind::SyncDropped),
        payload_errors: facts.payload_errors,
        slot_error_ns: seen.slot_error.summary().with_gaps(missed),
        slot_error_abs_ns: slot_error_abs.summary().with_gaps(0),
        sync_error_ns: match plan.role {
            Role::Master => facts.sync_error.summary(),
            _ => facts.sync_error.summary().with_gaps(missed),
        },
        rss_bytes: facts.resident,
        cpu_percent: percent(facts.cpu_seconds, parts.analysis.cycles(), scenario),
        sequence_gaps: facts.sequence_gaps,
        frames_lost: lost.iter().map(|lost| lost.frames).sum(),
        lost_on_purpose: lost.iter().map(|lost| lost.on_purpose).sum(),
        refusals: facts.refusals.clone(),
        notes,
        queueing: queueing(scenario, parts, station..station + 1),
    }
}

/// What the programs of these stations queued, by priority.
fn queueing(scenario: &Scenario, parts: &Parts, stations: Range<usize>) -> Vec<QueueingFigures> {
    let mut delays: BTreeMap<u8, SignedHistogram> = BTreeMap::new();
    for (&priority, seen) in parts.analysis.stations[stations.clone()].iter().flat_map(|seen| &seen.queueing)
    {
        delays.entry(priority).or_default().merge(&seen.delay);
    }
    let facts = &parts.stations[stations.clone()];
    let refused = |priority: &u8| facts.iter().filter_map(|facts| facts.queue_refused.get(priority)).sum();
    let lost: Vec<Lost> =
        stations.flat_map(|station| lost(scenario, parts, scenario.receiver(station))).collect();
    let figures = |(&priority, delay): (&u8, &SignedHistogram)| {
        let lost = || lost.iter().filter(|lost| lost.of == Some(priority));
        QueueingFigures {
            priority,
            frames_seen: delay.len(),
            refused: refused(&priority),
            delay_ns: delay.summary().with_gaps(refused(&priority)),
            lost: lost().map(|lost| lost.frames).sum(),
            lost_on_purpose: lost().map(|lost| lost.on_purpose).sum(),
        }
    };
    delays.iter().map(figures).collect()
}

/// Frames of one kind that were on the medium and did not reach their receiver.
struct Lost {
    /// Of a priority that programs queue; none: the usual frames.
    of: Option<u8>,
    frames: u64,
    on_purpose: u64,
}

/// What a station did not receive of what its sender had on the medium, for each kind of frames. What a lost station heard
/// last is not known.
fn lost(scenario: &Scenario, parts: &Parts, station: usize) -> impl Iterator<Item = Lost> {
    let sender = &parts.analysis.stations[scenario.sender(station)];
    parts.stations[station].deliveries.iter().filter_map(|(&of, delivery)| {
        let passed = sender.passed(of)?;
        let Delivery { heard, meant } = delivery;
        Some(Lost { of, frames: passed.lost(heard), on_purpose: passed.meant(heard, meant) })
    })
}

fn percent(cpu_seconds: f64, cycles: u32, scenario: &Scenario) -> f64 {
    let measured = f64::from(cycles) * scenario.cycle.nanos() as f64 / 1e9;
    if measured > 0.0 { cpu_seconds / measured * 100.0 } else { 0.0 }
}

mod reasons;

pub(crate) use reasons::{counted, not_synchronised};
