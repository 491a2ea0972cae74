//! The figures of a ring's run, as the JSON report names them. Those that a run with slots has, too, are called the same.

use std::collections::BTreeMap;

use rtmac::token::RingConfig;
use rtmac::token::bound::{access_delay_bound, doubling_bound, recovery_bound, rejoin_bound, rotation_bound};
use rtnet::sim::Joint;
use rtnet::time::Span;
use serde::Serialize;

use super::judge::{Judged, Seat};
use super::verdict::{self, Observed};
use crate::judge::closely::regular::Largest;
use crate::judge::delivery::{Delivery, Passed};
use crate::judge::verdict::Reason;
use crate::report::document::document;
use crate::report::figures::{QueueingFigures, Verdict};
use crate::report::histogram::{SignedHistogram, Summary};
use crate::report::host::HostFacts;
use crate::scenario::RingScenario;

/// Recoveries that are listed: the longest.
const LISTED_MAX: usize = 100;

/// A whole run. Times are integers in nanoseconds.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RingFigures {
    /// `token`.
    pub discipline: &'static str,
    /// In the ring.
    pub stations: u64,
    /// How long was measured.
    pub measured_ns: u64,
    /// How often the token went round: the fewest visits of a station that was there throughout.
    pub rounds: u64,
    /// Frames of data on the medium.
    pub frames_seen: u64,
    /// Frames that were on the medium and did not reach their receiver.
    pub frames_lost: u64,
    /// Those of them that the scenario meant to be lost.
    pub lost_on_purpose: u64,
    /// Frames whose payload was not what the station had sent.
    pub payload_errors: u64,
    /// Times at which two frames were on the air at once, at the medium's rate.
    pub overlaps: u64,
    /// Recoveries and overlaps without a known cause.
    pub unexplained: u64,
    /// Tokens passed on.
    pub tokens_passed: u64,
    /// Tokens that were sent once more, since the next station showed no sign of them.
    pub tokens_repeated: u64,
    /// Tokens that were sent to the one behind, since the next station showed no sign of them.
    pub stations_skipped: u64,
    /// Tokens that were lost, and claimed.
    pub tokens_claimed: u64,
    /// Tokens that were void, since another one stays.
    pub tokens_void: u64,
    /// Tokens that were sent to a station that was absent.
    pub invitations: u64,
    /// How often the token was lost and found again, by cause: all but those that are unexplained.
    pub causes: BTreeMap<String, u64>,
    /// From one time that the token came to a station to the next.
    pub rotation_ns: Summary,
    /// From the begin of a station's usual frame to the end of its next one: so long is a value under way that just missed one.
    pub delivery_ns: Summary,
    /// From the last token before one was lost to the next frame.
    pub recovery_ns: Summary,
    /// What programs queued, by priority: until its frame begins.
    pub queueing: Vec<QueueingFigures>,
    /// How long anything takes at the most.
    pub bounds: Bounds,
    /// The longest recoveries.
    pub recoveries: Vec<RecoveryFigures>,
    /// One entry per station, in the order of the ring.
    pub per_station: Vec<RingStation>,
    /// What to know besides.
    pub notes: Vec<String>,
    /// What the run took place on.
    pub host: HostFacts,
    /// What the run comes to, and why.
    pub verdict: Verdict,
    /// The seed of a run in virtual time.
    pub seed: Option<u64>,
    /// What only the page shows.
    #[serde(skip)]
    pub kept: RingKept,
}

document!(RingFigures, "ring-run", ring_run_has_its_schema);

/// What is kept of a run for its page.
#[derive(Clone, Debug, Default)]
pub struct RingKept {
    /// Rounds, by station.
    pub rotation: Vec<SignedHistogram>,
    /// See [`Seat::delivery_with_a_loss`].
    pub delivery_with_a_loss: Largest,
    /// Payload behind the Ethernet header, and frames, by station.
    pub carried: Vec<(u64, u64)>,
    /// What simulated wires lead to.
    pub joint: Joint,
}

/// `rtmac::token::bound` of this ring.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Bounds {
    /// Of a round, all stations present.
    pub rotation_ns: i64,
    /// Of a round with one absent, which is invited in vain.
    pub rotation_one_absent_ns: i64,
    /// The wait of the most urgent frame, all stations present.
    pub access_delay_ns: i64,
    /// From a station's death, the token with it, to the next frame.
    pub recovery_ns: i64,
    /// While two have a token.
    pub doubling_ns: i64,
    /// Until one that is back has the token again, all others present.
    pub rejoin_ns: i64,
}

/// One that was lost, and found again.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RecoveryFigures {
    /// How long after the begin of the measurement.
    pub at_ns: u64,
    /// How long it took.
    pub took_ns: i64,
    /// How long that may be.
    pub bound_ns: i64,
    /// Whom the tokens were for that nobody passed on.
    pub stations: Vec<String>,
    /// `event`, `late_host`, `doubled`, `unexplained`.
    pub cause: &'static str,
}

/// One station's part in a run.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RingStation {
    /// Its name.
    pub name: String,
    /// Its address.
    pub mac: String,
    /// How far its clock is set off from the host's.
    pub clock_offset_ns: i64,
    /// How much faster its clock runs than the host's, in 10^-9.
    pub clock_drift_ppb: i64,
    /// What it was at the end: `listening`, `holding`, ...; `down` if it was not there.
    pub state: String,
    /// Frames of it seen on the medium.
    pub frames_seen: u64,
    /// How often the token came to it.
    pub visits: u64,
    /// From one of these to the next.
    pub rotation_ns: Summary,
    /// See [`RingFigures::delivery_ns`].
    pub delivery_ns: Summary,
    /// Frames for it that were on the medium and that it did not receive.
    pub frames_lost: u64,
    /// Those of them that the scenario meant to be lost.
    pub lost_on_purpose: u64,
    /// What it received that was not what was sent.
    pub payload_errors: u64,
    /// What it told of, by name.
    pub told: BTreeMap<&'static str, u64>,
    /// What its stack refused, by name of the refusal.
    pub refusals: BTreeMap<String, u64>,
    /// What a reader should know.
    pub notes: Vec<String>,
}

/// What is known of a station besides what was seen of it.
#[derive(Clone, Debug, Default)]
pub struct Known {
    /// See [`RingStation::state`].
    pub state: String,
    /// It was there all the while.
    pub throughout: bool,
    /// What came to it of the one before: usual frames, and by priority.
    pub deliveries: BTreeMap<Option<u8>, Delivery>,
    /// See [`RingStation::payload_errors`].
    pub payload_errors: u64,
    /// See [`RingStation::refusals`].
    pub refusals: BTreeMap<String, u64>,
    /// Frames of its program that found no room, by priority.
    pub queue_refused: BTreeMap<u8, u64>,
    /// See [`RingStation::notes`].
    pub notes: Vec<String>,
    /// What speaks against the run.
    pub reproach: Option<Reason>,
}

impl RingKept {
    fn of(seats: &[Seat], joint: Joint) -> Self {
        let largest = |all: Largest, seat: &Seat| all.and(seat.delivery_with_a_loss);
        Self {
            rotation: seats.iter().map(|seat| seat.rotation.clone()).collect(),
            delivery_with_a_loss: seats.iter().fold(Largest::default(), largest),
            carried: seats.iter().map(|seat| (seat.octets, seat.frames)).collect(),
            joint,
        }
    }
}

impl Bounds {
    /// Of a ring.
    pub fn of(ring: &RingConfig) -> Self {
        let all = ring.stations.len();
        let others = all.saturating_sub(1);
        Self {
            rotation_ns: rotation_bound(ring, all, 0).nanos(),
            rotation_one_absent_ns: rotation_bound(ring, others, 1).nanos(),
            access_delay_ns: access_delay_bound(ring, all, 0).nanos(),
            recovery_ns: recovery_bound(ring, 1, 0).nanos(),
            doubling_ns: doubling_bound(ring, 0).nanos(),
            rejoin_ns: rejoin_bound(ring, others, 1).nanos(),
        }
    }
}

/// What a run has shown: measured for so long from `begin` on.
pub fn of(
    scenario: &RingScenario,
    judged: Judged,
    known: &[Known],
    (begin, measured_ns): (u64, u64),
    seen: &Observed,
    host: HostFacts,
) -> RingFigures {
    let RingScenario { ring, network } = scenario;
    let stations = judged.seats.iter().zip(known).enumerate();
    let per_station: Vec<RingStation> =
        stations.map(|(id, (seat, known))| station(scenario, id, (seat, known), &judged)).collect();
    let throughout = judged.seats.iter().zip(known).filter(|(_, known)| known.throughout);
    let mut recovery_ns = SignedHistogram::new();
    let found = judged.recoveries.len() - usize::from(judged.is_lost);
    judged.recoveries[..found].iter().for_each(|recovery| recovery_ns.record(recovery.took().nanos()));
    let sum = |of: fn(&RingStation) -> u64| per_station.iter().map(of).sum();
    let mut figures = RingFigures {
        discipline: "token",
        stations: network.stations.len() as u64,
        measured_ns,
        rounds: throughout.map(|(seat, _)| seat.visits).min().unwrap_or(0),
        frames_seen: sum(|of| of.frames_seen),
        frames_lost: sum(|of| of.frames_lost),
        lost_on_purpose: sum(|of| of.lost_on_purpose),
        payload_errors: sum(|of| of.payload_errors),
        overlaps: judged.overlaps,
        unexplained: judged.unexplained,
        tokens_passed: judged.tokens.passed,
        tokens_repeated: judged.tokens.repeated,
        stations_skipped: judged.tokens.skipped,
        tokens_claimed: judged.tokens.claimed,
        tokens_void: judged.tokens.void,
        invitations: judged.tokens.invitations,
        causes: judged.causes.clone(),
        rotation_ns: merged(judged.seats.iter().map(|seat| (&seat.rotation, seat.rotation_gaps))),
        delivery_ns: merged(judged.seats.iter().map(|seat| (&seat.delivery, seat.delivery_gaps))),
        recovery_ns: recovery_ns.summary().with_gaps(judged.is_lost.into()),
        queueing: queueing(&judged.seats, known),
        bounds: Bounds::of(ring),
        recoveries: recoveries(scenario, &judged, begin),
        per_station,
        notes: Vec::new(),
        host,
        verdict: Verdict::default(),
        seed: None,
        kept: RingKept::of(&judged.seats, network.conditions.joint),
    };
    figures.verdict = verdict::of(scenario, &judged, known, seen, &figures);
    figures
}

fn merged<'a>(histograms: impl Iterator<Item = (&'a SignedHistogram, u64)>) -> Summary {
    let (mut all, mut gaps) = (SignedHistogram::new(), 0);
    for (one, without) in histograms {
        all.merge(one);
        gaps += without;
    }
    all.summary().with_gaps(gaps)
}

fn station(
    scenario: &RingScenario,
    id: usize,
    (seat, known): (&Seat, &Known),
    judged: &Judged,
) -> RingStation {
    let (network, plan) = (&scenario.network, &scenario.network.stations[id]);
    let sender = &judged.seats[network.sender(id)];
    let of = |(of, delivery): (&Option<u8>, &Delivery)| {
        let passed: &Passed = sender.passed.get(of)?;
        let unheard = sender.unheard.get(of).copied().unwrap_or(0);
        let meant = delivery.meant.clone().and_any(unheard);
        Some((passed.lost(&delivery.heard), passed.meant(&delivery.heard, &meant)))
    };
    let lost = known.deliveries.iter().filter_map(of);
    let (frames_lost, lost_on_purpose) = lost.fold((0, 0), |(a, b), (lost, meant)| (a + lost, b + meant));
    RingStation {
        name: plan.name.clone(),
        mac: network.address(id).to_string(),
        clock_offset_ns: plan.clock_offset.nanos(),
        clock_drift_ppb: plan.clock_drift_ppb,
        state: known.state.clone(),
        frames_seen: seat.frames,
        visits: seat.visits,
        rotation_ns: seat.rotation.summary().with_gaps(seat.rotation_gaps),
        delivery_ns: seat.delivery.summary().with_gaps(seat.delivery_gaps),
        frames_lost,
        lost_on_purpose,
        payload_errors: known.payload_errors,
        told: seat.told.clone(),
        refusals: known.refusals.clone(),
        notes: known.notes.clone(),
    }
}

fn queueing(seats: &[Seat], known: &[Known]) -> Vec<QueueingFigures> {
    let mut by_priority: BTreeMap<u8, SignedHistogram> = BTreeMap::new();
    for (priority, waited) in seats.iter().flat_map(|seat| &seat.queueing) {
        by_priority.entry(*priority).or_default().merge(waited);
    }
    let refused = |priority: &u8| known.iter().filter_map(|of| of.queue_refused.get(priority)).sum();
    let figures = |(priority, waited): (u8, SignedHistogram)| QueueingFigures {
        priority,
        frames_seen: waited.len(),
        refused: refused(&priority),
        delay_ns: waited.summary().with_gaps(refused(&priority)),
        ..QueueingFigures::default()
    };
    by_priority.into_iter().map(figures).collect()
}

fn recoveries(scenario: &RingScenario, judged: &Judged, begin: u64) -> Vec<RecoveryFigures> {
    let name = |&id: &usize| scenario.network.stations[id].name.clone();
    let figures = judged.recoveries.iter().map(|of| RecoveryFigures {
        at_ns: of.began.saturating_sub(begin),
        took_ns: of.took().nanos(),
        bound_ns: of.bound(&scenario.ring).nanos(),
        stations: of.victims.iter().map(name).collect(),
        cause: of.cause,
    });
    let mut all: Vec<_> = figures.collect();
    all.sort_by_key(|of| (of.cause != "unexplained", -of.took_ns, of.at_ns));
    all.truncate(LISTED_MAX);
    all
}

/// A time in nanoseconds, in words.
pub(super) fn span(ns: i64) -> String {
    Span::from_nanos(ns).to_string()
}
