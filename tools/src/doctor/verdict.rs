//! From what was measured to what a network on this host would do. Pure: no clock, no system call.
//!
//! ```text
//!            lead               latest
//!   |<-- of such a lab ->|<-- guard band, -->|  less the clocks' share at either end
//!   wake-up due          slot's instant      too late
//!   |-- late wake-up (1) -------------------->   missed if it is later than lead + latest
//!        |-- outage (2) --------------------->   missed if it begins in the lead and ends after latest
//!   sync |<--- outage (3): two syncs ---| ...    the rest of that cycle is silent, one is bridged
//! ```
//!
//! 1. The share of late wake-ups is that of the measured histogram. It holds outages in which a wake-up
//!    falls, too, since a due wake-up waits for their end.
//! 2. A station that has woken spins for `lead`. An outage of length L begins at any time alike, so
//!    that it takes `min(lead, L - latest)` of time at which slots are lost; summed over the outages and
//!    divided by the time watched this is the share of slots lost.
//! 3. Slaves bridge one cycle without a sync. Two in a row are missing after an outage longer than a
//!    cycle (in closed form below), or by chance, the square of the share of late syncs.
//! 4. A host's bad moments come in clusters: blocks of the measurement differ. One standard error of (1)
//!    over the blocks is added, so that a verdict does not live on a lucky one.
//! 5. A bridge delivers a broadcast port by port in its sender's context, so that the sync of n stations
//!    takes (n - 1) times what it takes for one. The master's own slot is missed if that ends too late.
//! 6. Threads that want more of a second than the kernel lets real-time threads have lose the rest.

use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;
use serde::Serialize;

use crate::lab::lead::{WakeUps, lead};
use crate::report::histogram::SignedHistogram;
use crate::scenario::{Scenario, Uniform};

/// How long before its slot the station wakes whose turn is measured.
pub const MEASURED_LEAD: Span = Span::from_micros(50);
/// A network holds a cycle that misses no more: with one slot, and so about one sync, of 200 missing by
/// chance, two in a row, which silence the slaves, come once in 40 000 cycles.
pub const MISSES_ACCEPTED: f64 = 0.005;
/// The host of minutes later is not that of the measurement: the worst of twelve networks tried after a prediction,
/// on a shared virtual machine, missed 4.4 times what was predicted.
const WORSE_HOUR: f64 = 4.5;
/// A few slots of ten thousand are missed by anybody.
const LEAST_NAMED: f64 = 0.0005;
/// Real-time threads should want no more of a core: the kernel throttles them at 95 % of a second by
/// default, for the rest of it, and what an outage delayed has to be made up for within that second.
pub const LOAD_MAX: f64 = 0.80;
/// What a slot costs its core where it could not be measured: a lab of 8 stations at 1 ms takes 52.7 %
/// of a core for 9 turns (the sync's is the ninth) in each cycle.
pub const TURN_UNMEASURED: Span = Span::from_nanos(58_600);
/// The cycles that are tried.
pub const CYCLES: [Span; 6] = [
    Span::from_micros(250),
    Span::from_micros(500),
    Span::from_millis(1),
    Span::from_millis(2),
    Span::from_millis(5),
    Span::from_millis(10),
];
/// And the numbers of stations.
pub const STATIONS: [usize; 5] = [2, 4, 8, 16, 32];
/// The network that the verdict is about.
pub const STATIONS_OF_VERDICT: usize = 8;

/// The share of the sync window in which a sync is still sent, as the master does it.
const SYNC_LATEST: (i64, i64) = (3, 4);
/// As `lab run` without options.
const PAYLOAD: usize = 64;
const RATE: Rate = Rate::from_bits_per_second(1_000_000_000);

/// What was measured of a core, in one state of it.
#[derive(Clone, Copy, Debug)]
pub struct Core<'a> {
    /// Actual - programmed wake-up of a real-time thread, in blocks of equal length.
    pub wakeups: &'a [SignedHistogram],
    /// Lengths of the gaps in which a thread that never sleeps did not run.
    pub outages: &'a SignedHistogram,
    /// For how long that thread was watched; nothing if it was not.
    pub watched: Span,
    /// How long `send` of a broadcast took, and to how many stations, if that was measured.
    pub broadcasts: Option<(&'a SignedHistogram, usize)>,
    /// Processor time of one slot with [`MEASURED_LEAD`]: wake up, drain, spin, send.
    pub turn: Span,
    /// The share of a second that real-time threads may run; 1 is without limit.
    pub real_time_share: f64,
}

impl Core<'_> {
    /// The lead that a lab chooses for this network here.
    fn lead(&self, network: &Scenario) -> Span {
        let mut wakeups = SignedHistogram::new();
        self.wakeups.iter().for_each(|block| wakeups.merge(block));
        lead(network, WakeUps::of(&wakeups))
    }
}

/// A network, and what it would do.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Prediction {
    /// From one cycle's start to the next.
    pub cycle_ns: i64,
    /// The master included.
    pub stations: usize,
    /// Behind each frame.
    pub guard_ns: i64,
    /// The share of slots that would be missed, 0 to 1.
    pub predicted_miss_share: f64,
    /// And what that may become in a worse hour: what the verdict names.
    pub at_most_miss_share: f64,
    /// Of that: a late wake-up.
    pub late_share: f64,
    /// Of that: one standard error of the late wake-ups, from block to block.
    pub uncertain_share: f64,
    /// Of that: an outage between wake-up and slot.
    pub outage_share: f64,
    /// Of that: no sync twice in a row.
    pub silent_share: f64,
    /// Of that: the master's slot, because of the sync before it.
    pub sync_share: f64,
    /// Of that: real-time throttling.
    pub throttled_share: f64,
    /// What the real-time threads want of their core; 1 is all of it.
    pub load: f64,
}

impl Prediction {
    /// Whether the host holds it: few misses, and no throttling.
    pub fn holds(&self) -> bool {
        self.fits() && self.predicted_miss_share <= MISSES_ACCEPTED
    }

    /// Whether the core has time enough for it.
    pub fn fits(&self) -> bool {
        self.load <= LOAD_MAX
    }
}

/// What stations with a slot each, as `lab run` gives them, would do on this core; none if their slots
/// do not fit the cycle.
pub fn predict(core: &Core<'_>, stations: usize, cycle: Span) -> Option<Prediction> {
    let network = network(stations, cycle)?;
    let (latest, lead) = (network.latest(), core.lead(&network));
    let (late_share, uncertain_share) = late(core.wakeups, lead + latest);
    let outage_share = lost_by(core, |length| (length - latest).max(Span::ZERO).min(lead));
    let slaves = (stations - 1) as f64 / stations as f64;
    let silent_share = slaves * silent_share(core, &network, lead);
    let sync_share = sync_share(core, &network) / stations as f64;
    let turn = core.turn - MEASURED_LEAD + lead;
    let load = (stations + 1) as f64 * turn.nanos() as f64 / cycle.nanos() as f64;
    let throttled_share = if load > core.real_time_share { 1.0 - core.real_time_share } else { 0.0 };
    let all = late_share + uncertain_share + outage_share + silent_share + sync_share + throttled_share;
    Some(Prediction {
        cycle_ns: cycle.nanos(),
        stations,
        guard_ns: network.guard.nanos(),
        predicted_miss_share: all.min(1.0),
        at_most_miss_share: (WORSE_HOUR * all + LEAST_NAMED).min(1.0),
        late_share,
        uncertain_share,
        outage_share,
        silent_share,
        sync_share,
        throttled_share,
        load,
    })
}

/// The predictions for all cycles and numbers of stations whose slots fit.
pub fn candidates(core: &Core<'_>) -> Vec<Prediction> {
    let pairs = CYCLES.iter().flat_map(|&cycle| STATIONS.map(|stations| (stations, cycle)));
    pairs.filter_map(|(stations, cycle)| predict(core, stations, cycle)).collect()
}

/// The shortest cycle that so many stations hold, else the one with the fewest misses of those that
/// the core has time for.
pub fn recommend(candidates: &[Prediction], stations: usize) -> Option<Prediction> {
    let mut fitting: Vec<_> = candidates.iter().filter(|c| c.stations == stations && c.fits()).collect();
    fitting.sort_by_key(|candidate| candidate.cycle_ns);
    let fewest = |a: &&&Prediction, b: &&&Prediction| {
        a.predicted_miss_share.total_cmp(&b.predicted_miss_share).then(a.cycle_ns.cmp(&b.cycle_ns))
    };
    fitting.iter().find(|c| c.holds()).or_else(|| fitting.iter().min_by(fewest)).map(|&&best| best)
}

/// The mean share of wake-ups above `limit` over the blocks, and its standard error.
fn late(blocks: &[SignedHistogram], limit: Span) -> (f64, f64) {
    let shares: Vec<f64> = blocks.iter().map(|block| share_later(block, limit)).collect();
    let n = shares.len() as f64;
    let mean = shares.iter().sum::<f64>() / n.max(1.0);
    let squares: f64 = shares.iter().map(|share| (share - mean).powi(2)).sum();
    let error = if shares.len() < 2 { 0.0 } else { (squares / (n - 1.0) / n).sqrt() };
    (mean, error)
}

/// Whether `a` is the better answer: it holds and `b` does not; of two that hold, it has the shorter
/// cycle, of two that do not, fewer misses.
pub fn better(a: &Prediction, b: &Prediction) -> bool {
    match (a.holds(), b.holds()) {
        (true, true) => a.cycle_ns < b.cycle_ns,
        (false, false) => a.predicted_miss_share < b.predicted_miss_share,
        (holds, _) => holds,
    }
}

/// The share of values above `limit`.
pub fn share_later(histogram: &SignedHistogram, limit: Span) -> f64 {
    if histogram.is_empty() {
        return 0.0;
    }
    let later = histogram.iter().filter(|&(value, _)| value > limit.nanos());
    later.map(|(_, count)| count).sum::<u64>() as f64 / histogram.len() as f64
}

fn network(stations: usize, cycle: Span) -> Option<Scenario> {
    let duration = Span::from_millis(1_000);
    let (payload, rate) = (PAYLOAD, RATE);
    Uniform { stations, cycle, duration, payload, rate, guard: None, seed: 1, vnic: None }.scenario().ok()
}

/// The share of time in which a slave has woken in time but must be silent: the last sync and the one
/// before are missing.
///
/// An outage that ends r after a cycle's start has held up that cycle's sync if r > s (s is how late a
/// sync may be), and the one before if it is longer than C + r. From its end on, C - r of that cycle is
/// silent. All r from 0 to C are alike, hence the mean over them.
fn silent_share(core: &Core<'_>, network: &Scenario, lead: Span) -> f64 {
    let cycle = network.cycle;
    let sync_latest = network.sync_window * SYNC_LATEST.0 / SYNC_LATEST.1;
    let by_chance = late(core.wakeups, lead + sync_latest).0.powi(2);
    let by_outages = lost_by(core, |length| {
        let (from, to) = (sync_latest.nanos() as f64, (length - cycle).min(cycle).nanos() as f64);
        let whole = cycle.nanos() as f64;
        let silent = |r: f64| r - r * r / (2.0 * whole);
        if to > from { Span::from_nanos((silent(to) - silent(from)) as i64) } else { Span::ZERO }
    });
    by_chance + by_outages
}

/// The share of cycles in which the sync is still being sent when the master's slot, the first after the
/// sync window, is already too late.
fn sync_share(core: &Core<'_>, network: &Scenario) -> f64 {
    let Some((took, listeners)) = core.broadcasts else { return 0.0 };
    let slaves = (network.stations.len() - 1) as i64;
    let room = network.sync_window + network.latest();
    share_later(took, room * listeners as i64 / slaves)
}

/// The share of time lost by all outages together, of which each loses what `of` says of its length.
fn lost_by(core: &Core<'_>, of: impl Fn(Span) -> Span) -> f64 {
    if core.watched <= Span::ZERO {
        return 0.0;
    }
    let lost =
        core.outages.iter().map(|(length, count)| of(Span::from_nanos(length)).nanos() as f64 * count as f64);
    lost.sum::<f64>() / core.watched.nanos() as f64
}

#[cfg(test)]
mod tests;
