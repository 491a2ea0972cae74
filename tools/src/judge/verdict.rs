//! From what a run has shown to its verdict. Pure: figures, thresholds and the host's facts go in, a word and its reasons come out.
//!
//! ```text
//!   a reason weighs   on a quiet host   on a disturbed one
//!   Wrong             NOT OK            NOT OK           no host can do that
//!   HostMay           NOT OK            INCONCLUSIVE     a host that stops threads can do that, too
//!   Blind             INCONCLUSIVE      INCONCLUSIVE     part of the run was not observed
//!   Short             DEGRADED          INCONCLUSIVE     less came than was asked for, for known causes
//!   none              OK                OK
//! ```
//!
//! The worst decides. An interrupted run is INTERRUPTED, whatever else it has shown; its other reasons follow.
//!
//! A host is disturbed if something that is none of the network's doing took a larger share of the time than a network
//! may miss unless asked otherwise ([`MAX_MISS_PPM`]): a slot falls into such a time with that probability, so that a larger
//! share of misses says nothing of the network. Three measures tell: threads that woke more than a whole cycle late, which no slot or guard band
//! of this cycle could have absorbed; time of the core that the hypervisor gave away; and time of it that other real-time
//! threads took.

use crate::report::host::HostFacts;
use crate::report::text::{grouped, percent};
use crate::report::verdict::{Verdict, Word};
use crate::scenario::MAX_MISS_PPM;

/// A station that misses more of its slots than it uses is no part of the network.
const MOST_PPM: u64 = 500_000;
/// So many stations are named.
const NAMED: usize = 3;

/// How much a reason weighs.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum Weight {
    /// Less came than was asked for, and it is known why.
    Short,
    /// Something was not observed.
    Blind,
    /// It is not as promised, and a host that stops threads can do that.
    HostMay,
    /// It is not as promised.
    Wrong,
}

/// What speaks against a run.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Reason {
    /// How much.
    pub weight: Weight,
    /// In words, without a full stop.
    pub what: String,
}

impl Reason {
    /// This one.
    pub fn new(weight: Weight, what: impl Into<String>) -> Self {
        Self { weight, what: what.into() }
    }
}

/// A station's slots.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Slots {
    /// Whose.
    pub station: String,
    /// Slots in which it was to send.
    pub expected: u64,
    /// Those in which it did.
    pub seen: u64,
    /// Those that it was more than a cycle late for, where that tells of the host: nobody has stopped it on purpose.
    pub woke_late: Option<u64>,
    /// An expectation of the file decides how many it may miss.
    pub is_decided: bool,
}

impl Slots {
    fn missed(&self) -> u64 {
        self.expected.saturating_sub(self.seen)
    }

    fn missed_ppm(&self) -> u64 {
        ppm(self.missed(), self.expected)
    }
}

/// What a run has shown, as far as it decides.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Evidence {
    /// After how long somebody ended it, `3s of 60s`.
    pub interrupted: Option<String>,
    /// Of each station; none of a ring, which has no slots.
    pub slots: Option<Vec<Slots>>,
    /// What else speaks against it.
    pub reasons: Vec<Reason>,
}

/// The verdict. Of a million slots `max_miss_ppm` may be missed, by each station.
pub fn judge(evidence: &Evidence, max_miss_ppm: u32, host: &HostFacts) -> Verdict {
    let slots = evidence.slots.as_deref();
    let mut reasons = evidence.reasons.clone();
    reasons.extend(slots.and_then(unmeasured));
    reasons.extend(slots.into_iter().flat_map(|slots| too_many_missed(slots, max_miss_ppm)));
    let disturbed = disturbances(slots.unwrap_or_default(), host);
    let word = |reason: &Reason| match reason.weight {
        Weight::Wrong => Word::NotOk,
        Weight::HostMay if disturbed.is_empty() => Word::NotOk,
        Weight::Short if disturbed.is_empty() => Word::Degraded,
        Weight::Short | Weight::Blind | Weight::HostMay => Word::Inconclusive,
    };
    // What weighs most is read first; of equal ones the order stays.
    reasons.sort_by_key(|reason| std::cmp::Reverse((word(reason), reason.weight)));
    let worst = reasons.first().map_or(Word::Ok, word);
    let mut words: Vec<String> = reasons.into_iter().map(|reason| reason.what).collect();
    if worst != Word::Ok && !disturbed.is_empty() {
        let why = format!("this host was disturbed: {}", disturbed.join(", "));
        let place = if worst == Word::Inconclusive { 0 } else { words.len() };
        words.insert(place, why);
    }
    match &evidence.interrupted {
        Some(after) => {
            words.insert(0, format!("after {after}"));
            Verdict::new(Word::Interrupted, words)
        }
        None => Verdict::new(worst, words),
    }
}

/// Where there was nothing to see, nothing follows from having seen it all.
fn unmeasured(slots: &[Slots]) -> Option<Reason> {
    let nothing = slots.iter().all(|of| of.expected == 0);
    nothing.then(|| Reason::new(Weight::Blind, "nothing was measured: 0 of 0 frames"))
}

/// Stations that missed more than they may, in one reason each for those that were hardly there and the others.
fn too_many_missed(slots: &[Slots], max_miss_ppm: u32) -> impl Iterator<Item = Reason> {
    let open = slots.iter().filter(|of| !of.is_decided && of.missed_ppm() > max_miss_ppm.into());
    let (mostly, more): (Vec<&Slots>, Vec<&Slots>) = open.partition(|of| of.missed_ppm() > MOST_PPM);
    let seen = |of: &&Slots| {
        format!("station '{}' was seen {} times of {}", of.station, grouped(of.seen), grouped(of.expected))
    };
    let share = |of: &&Slots| format!("'{}' {}", of.station, percent(of.missed_ppm()));
    let hardly = (!mostly.is_empty()).then(|| Reason::new(Weight::HostMay, named(&mostly, seen)));
    let missed = (!more.is_empty()).then(|| {
        let of = named(&more, share);
        let what = format!("slots missed: {of}; {} may be", percent(max_miss_ppm.into()));
        Reason::new(Weight::Short, what)
    });
    hardly.into_iter().chain(missed)
}

/// The worst by name, and how many more.
fn named(stations: &[&Slots], words: impl Fn(&&Slots) -> String) -> String {
    let mut worst = stations.to_vec();
    worst.sort_by_key(|of| std::cmp::Reverse(of.missed_ppm()));
    let more = worst.len().saturating_sub(NAMED);
    let more = (more > 0).then(|| format!("{more} more stations"));
    worst.iter().take(NAMED).map(words).chain(more).collect::<Vec<_>>().join(", ")
}

/// What took too large a share of the time; see above. In virtual time the host has no part.
fn disturbances(slots: &[Slots], host: &HostFacts) -> Vec<String> {
    if host.is_virtual_time() {
        return Vec::new();
    }
    let witnesses = slots.iter().filter_map(|of| Some((of.woke_late?, of.expected)));
    let (late, of) = witnesses.fold((0, 0), |(late, of), (more, slots)| (late + more, of + slots));
    let is_more = |share: &u64| *share > u64::from(MAX_MISS_PPM);
    let cpu = host.core.map_or("the core".into(), |core| format!("cpu {core}"));
    let woke = Some(ppm(late, of))
        .filter(is_more)
        .map(|share| format!("threads woke more than a cycle late for {} of the slots", percent(share)));
    let stolen =
        host.core_steal_ppm.filter(is_more).map(|share| format!("{} of {cpu} was stolen", percent(share)));
    let share = host.other_real_time.iter().map(|of| of.ppm).sum::<u64>();
    let others = Some(share).filter(is_more).map(|share| {
        let names: Vec<String> = host.other_real_time.iter().take(NAMED).map(|of| of.to_string()).collect();
        format!("other real-time threads took {} of {cpu} ({})", percent(share), names.join(", "))
    });
    [woke, stolen, others].into_iter().flatten().collect()
}

/// Rounded up, so that no miss is none.
fn ppm(part: u64, all: u64) -> u64 {
    (u128::from(part) * 1_000_000).div_ceil(u128::from(all.max(1))) as u64
}

#[cfg(test)]
mod tests;
