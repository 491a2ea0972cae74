//! What a search has found, as it is kept in a file, and what a later one says beside it.

use std::path::Path;

use anyhow::{Context, anyhow, ensure};
use serde::{Deserialize, Serialize};

use crate::judge::account::PARTS;
use crate::report::document::{NotRead, document, read};
use crate::report::figures::Figures;
use crate::report::host::HostFacts;
use crate::report::verdict::Word;

/// Two searches on one idle host agree within this: 25 %, two rungs of the ladder.
pub const AGREE_WITHIN: f64 = 1.25;

/// What was searched for.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Asked {
    /// The master included.
    pub stations: usize,
    /// Bytes of each frame behind its Ethernet header.
    pub payload: usize,
    /// The medium's, bits per second.
    pub rate: u64,
    /// Guard band of each slot; none: the rest of the slot.
    pub guard_ns: Option<i64>,
    /// Slots that may be missed, in parts per million.
    pub miss_ppm: u32,
    /// The real-time core is kept from idling.
    pub warm_core: bool,
    /// How long each trial measures.
    pub trial_ns: i64,
    /// How long each proof measures.
    pub proof_ns: i64,
}

/// What a run was for.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// To find out where to search.
    Trial,
    /// To be sure.
    Proof,
}

/// One run.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// From one cycle's start to the next.
    pub cycle_ns: i64,
    /// What it was for.
    pub purpose: Purpose,
    /// Whether the cycle was held; none: the verdict was INCONCLUSIVE, and the run is repeated.
    pub holds: Option<bool>,
    /// Of each slot.
    pub guard_ns: i64,
    /// How long it was measured.
    pub duration_ns: i64,
    /// Frames that were to be in their slots.
    pub slots: u64,
    /// Those of them that were missed or outside their slots.
    pub missed: u64,
    /// What share that was, 0 to 1.
    pub missed_share: f64,
    /// The same of the middle one of the run's parts by what they missed: an outage of the host that falls into one part does
    /// not show, a core that has too much to do does.
    pub usual_share: f64,
    /// Misses without a known cause.
    pub unexplained: u64,
    /// Processor time of all real-time threads, in per cent of one core.
    pub rt_cpu_percent: f64,
    /// What else is to be said of it: why there are no figures, or why its verdict was bad.
    pub note: Option<String>,
}

/// What was found.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Answer {
    /// For what.
    pub asked: Asked,
    /// The shortest cycle that is proven; none, if no cycle that was tried is.
    pub cycle_ns: Option<i64>,
    /// Every run, in order.
    pub runs: Vec<Run>,
    /// On what.
    pub host: HostFacts,
}

document!(Answer, "find-min-cycle", find_min_cycle_has_its_schema);

impl Run {
    /// Of a network that came up, and missed so many slots in each part of the run. A trial is judged by what is usual in it, a
    /// proof by all of it.
    pub fn of(
        purpose: Purpose,
        (cycle_ns, guard_ns): (i64, i64),
        duration_ns: i64,
        (figures, parts): (&Figures, [u64; PARTS]),
        miss_ppm: u32,
    ) -> Self {
        let (slots, missed) = (figures.frames_expected, figures.slots_missed + figures.out_of_slot);
        let mut by_missed = parts;
        by_missed.sort_unstable();
        let share = |missed: u64, of: f64| if slots == 0 { 1.0 } else { missed as f64 / of };
        let missed_share = share(missed, slots as f64);
        let usual_share = share(by_missed[parts.len() / 2], slots as f64 / parts.len() as f64);
        let decides = match purpose {
            Purpose::Trial => usual_share,
            Purpose::Proof => missed_share,
        };
        let verdict = &figures.verdict;
        let is_sound = matches!(verdict.word, Word::Ok | Word::Degraded);
        let holds = match verdict.word {
            // Threads are late on a disturbed host and in a cycle that is too short. So too many misses always decide.
            _ if decides * 1e6 > f64::from(miss_ppm) => Some(false),
            Word::Inconclusive => None,
            _ => Some(is_sound),
        };
        Self {
            cycle_ns,
            purpose,
            holds,
            guard_ns,
            duration_ns,
            slots,
            missed,
            missed_share,
            usual_share,
            unexplained: figures.unexplained,
            rt_cpu_percent: figures.rt_cpu_percent,
            note: (!is_sound).then(|| verdict.reasons.join("; ")),
        }
    }

    /// Of one that did not.
    pub fn without(
        purpose: Purpose,
        (cycle_ns, guard_ns): (i64, i64),
        duration_ns: i64,
        why: String,
    ) -> Self {
        Self {
            cycle_ns,
            purpose,
            holds: Some(false),
            guard_ns,
            duration_ns,
            slots: 0,
            missed: 0,
            missed_share: 1.0,
            usual_share: 1.0,
            unexplained: 0,
            rt_cpu_percent: 0.0,
            note: Some(why),
        }
    }
}

/// How a cycle compares with one that was kept.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Compared {
    /// As far as two searches agree.
    AsGood,
    /// Shorter by more than that.
    Better,
    /// Longer by more than that, or none is held.
    Regression,
}

impl Answer {
    /// What was kept in a file.
    pub fn load(path: &Path) -> anyhow::Result<Self> {
        let name = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("{name} cannot be read"))?;
        let kept: Self = read(&text).map_err(|error: NotRead| {
            let what = match &error {
                NotRead::Json(why) if why.is_data() => "is not whole",
                NotRead::Json(_) => "is not JSON",
                NotRead::Another { .. } => "is not an answer of this version",
            };
            anyhow!("{name} {what}: {error}: keep an answer with `rtnet find-min-cycle --json`")
        })?;
        ensure!(
            kept.inconclusive().is_none(),
            "{name} is of a search that was INCONCLUSIVE, and has nothing to compare with: search again with `rtnet \
             find-min-cycle --json`"
        );
        Ok(kept)
    }

    /// The run whose attempts all decided nothing, which ended the search; `None` if the search has an answer.
    pub fn inconclusive(&self) -> Option<&Run> {
        self.runs.last().filter(|run| run.holds.is_none())
    }

    /// Beside one that was kept.
    pub fn compared_with(&self, kept: &Self) -> Compared {
        let factor = match (self.cycle_ns, kept.cycle_ns) {
            (Some(now), Some(kept)) => now as f64 / kept as f64,
            (None, Some(_)) => f64::INFINITY,
            (Some(_), None) => 0.0,
            (None, None) => 1.0,
        };
        match factor {
            longer if longer > AGREE_WITHIN => Compared::Regression,
            shorter if shorter * AGREE_WITHIN < 1.0 => Compared::Better,
            _ => Compared::AsGood,
        }
    }

    /// 0: found. 1: no cycle is held, or only a longer one than was kept. 3: the search is INCONCLUSIVE.
    pub fn exit_status(&self, kept: Option<&Self>) -> u8 {
        if self.inconclusive().is_some() {
            return Word::Inconclusive.exit_status();
        }
        let is_longer = kept.is_some_and(|kept| self.compared_with(kept) == Compared::Regression);
        u8::from(self.cycle_ns.is_none() || is_longer)
    }

    /// The run that proved the answer.
    pub fn proof(&self) -> Option<&Run> {
        let proves = |run: &&Run| {
            run.purpose == Purpose::Proof && run.holds == Some(true) && self.cycle_ns == Some(run.cycle_ns)
        };
        self.runs.iter().rfind(proves)
    }

    /// The longest cycle below the answer that was not held.
    pub fn next_shorter(&self) -> Option<&Run> {
        let shorter =
            self.runs.iter().filter(|run| Some(run.cycle_ns) < self.cycle_ns && run.holds == Some(false));
        shorter.max_by_key(|run| run.cycle_ns)
    }

    /// The trial of the shortest cycle that held, if what is proven is longer by more than searches differ, or nothing is:
    /// then not what a cycle has room for decided, but outages of the host, which come and go.
    pub fn decided_by_outages(&self) -> Option<&Run> {
        let held = self.runs.iter().filter(|run| run.purpose == Purpose::Trial && run.holds == Some(true));
        let shortest = held.min_by_key(|run| run.cycle_ns)?;
        let proven = self.cycle_ns.map_or(f64::INFINITY, |ns| ns as f64);
        (proven > shortest.cycle_ns as f64 * AGREE_WITHIN).then_some(shortest)
    }
}

#[cfg(test)]
mod tests;
