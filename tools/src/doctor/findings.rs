//! All that was found out, as the JSON names it.

use serde::Serialize;

use super::rights::Rights;
use super::verdict::Prediction;
use crate::report::document::document;
use crate::report::histogram::Summary;
use crate::report::host::HostFacts;

/// All that was found out. The order of the fields is the order in the JSON; times are in nanoseconds,
/// shares from 0 to 1.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Findings {
    /// How long was measured altogether.
    pub duration_ns: i64,
    /// The core that was examined.
    pub cpu: usize,
    /// Other cores, for observers and all that is not real-time.
    pub other_cpus: Vec<usize>,
    /// `SCHED_FIFO`, or `ordinary` where that is refused.
    pub scheduling: &'static str,
    /// The network for the verdict, 8 stations: the shortest cycle that this host holds, else the best.
    pub recommended: Option<Recommended>,
    /// The same for every number of stations that was tried.
    pub recommended_by_stations: Vec<Recommended>,
    /// The verdict in words, the last line of the screen last.
    pub verdict: Vec<String>,
    /// What would improve it, as far as that follows from the figures.
    pub advice: Vec<String>,
    /// What could not be measured, and the remedy.
    pub not_measured: Vec<String>,
    /// Actual - programmed wake-up, by the core's state.
    pub wakeups: Vec<Lateness>,
    /// When the core did not run a thread that never sleeps.
    pub outages: OutageFigures,
    /// From one thread's waking call to the other's running: same core, other core.
    pub hops: Vec<Hop>,
    /// Sending and stamping.
    pub wire: Option<WireFigures>,
    /// Reading CLOCK_MONOTONIC once.
    pub clock_gettime_ns: f64,
    /// By how much an ordinary thread's sleep may be prolonged.
    pub timer_slack_ns: Option<i64>,
    /// What this process may do, and what the kernel can.
    pub rights: Rights,
    /// The candidates, cold or warm.
    pub candidates: Vec<Candidate>,
    /// The host, with the time stolen while it was measured.
    pub host: HostFacts,
}

document!(Findings, "doctor", doctor_has_its_schema);

/// A network to try.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Recommended {
    /// What is predicted for it.
    #[serde(flatten)]
    pub network: Prediction,
    /// With the core kept warm.
    pub warm_core: bool,
    /// Whether it misses few enough.
    pub holds: bool,
    /// A quarter of this cycle, where the slots fit that.
    pub quarter: Option<Prediction>,
}

/// One network in one state of the core.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Candidate {
    /// With the core kept warm.
    pub warm_core: bool,
    /// Whether it misses few enough and is not throttled.
    pub holds: bool,
    /// What is predicted for it.
    #[serde(flatten)]
    pub network: Prediction,
}

/// Wake-ups in one state of the core.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Lateness {
    /// The core was kept from idling.
    pub warm_core: bool,
    /// Actual - programmed.
    pub lateness_ns: Summary,
    /// Shares of later ones.
    pub later: Vec<Share>,
}

/// The share beyond a limit.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Share {
    /// The limit.
    pub than_ns: i64,
    /// 0 to 1.
    pub share: f64,
}

/// Outages in figures.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct OutageFigures {
    /// How long the core was watched.
    pub watched_ns: i64,
    /// How many there were in a second, by least length.
    pub per_second: Vec<Rate>,
    /// The longest.
    pub longest_ns: i64,
}

/// How often in a second.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Rate {
    /// Of at least this length.
    pub at_least_ns: i64,
    /// On average.
    pub per_second: f64,
}

/// One thread waking another.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Hop {
    /// The core of the woken thread; the waking one is on the examined core.
    pub to_cpu: usize,
    /// From before the waking call to the other thread's running.
    pub took_ns: Summary,
}

/// The wire in figures.
#[derive(Clone, Copy, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct WireFigures {
    /// `send` of 60 bytes.
    pub send_ns: Summary,
    /// `send` of a broadcast to 8 stations.
    pub broadcast_ns: Summary,
    /// The kernel's receive stamp - the clock before `send`.
    pub stamp_ns: Summary,
    /// Frames that came without a stamp.
    pub unstamped: u64,
    /// Processor time of one slot: wake up 50 us before, drain, spin, send, receive.
    pub turn_ns: i64,
}
