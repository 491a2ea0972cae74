//! What was measured of a way, as people see it.

use std::fmt::Write as _;

use serde::Serialize;

use super::scheduled::{Scheduled, Waits};
use crate::cli::BenchArgs;
use crate::report::document::document;
use crate::report::histogram::Summary;
use crate::report::text::{about, grouped, micros, micros_or_dash};

/// What questions showed.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Trips {
    /// The mailbox that was asked.
    pub to: String,
    /// Length of a body.
    pub bytes: usize,
    /// Questions.
    pub asked: u64,
    /// Answers.
    pub came: u64,
    /// Questions without an answer.
    pub lost: u64,
    /// From the first question to the last answer.
    pub took_ns: u64,
    /// From asking until the answer came.
    pub round_trip_ns: Summary,
    /// The longest, longest first: what else happened then may be known.
    pub longest: Vec<Long>,
    /// To another station, what its slots and the own ones say.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scheduled: Option<Scheduled>,
}

document!(Trips, "package-round-trips", package_round_trips_has_its_schema);

/// A round trip, and when it was asked for, by CLOCK_MONOTONIC.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Long {
    /// How long it took.
    pub took_ns: u64,
    /// When it was asked for, by CLOCK_MONOTONIC.
    pub asked_at_ns: u64,
}

/// What came of as many packages as the way takes.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Stream {
    /// The mailbox.
    pub to: String,
    /// Length of a body.
    pub bytes: usize,
    /// Packages sent.
    pub sent: u64,
    /// How long they were sent for.
    pub sent_for_ns: u64,
    /// Tries that found the mailbox full.
    pub full: u64,
    /// Tries for which the own station had not sent enough of what was before.
    pub no_buffers: u64,
    /// Whether the own station took all of it: else nobody was asked how many came.
    pub all_left: bool,
    /// None: who has the mailbox does not count, or was not asked.
    pub came: Option<u64>,
    /// Packages that did not come.
    pub lost: Option<u64>,
    /// From the first that came to the last.
    pub took_ns: Option<u64>,
    /// How many turns of the own slots passed from the first to the last, if a package takes one.
    pub turns: Option<u64>,
    /// To another station: what the slots of both say.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scheduled: Option<Scheduled>,
}

document!(Stream, "package-stream", package_stream_has_its_schema);

impl Trips {
    pub fn describe(&self) -> String {
        let Self { to, bytes, asked, came, lost, took_ns, round_trip_ns: trip, scheduled, .. } = self;
        let mut text = format!(
            "{to}: {} asked in {} with {bytes} bytes, {} answered, {} lost\n",
            grouped(*asked),
            about(*took_ns),
            grouped(*came),
            grouped(*lost)
        );
        if *came > 0 {
            let [min, p50, p99, p999, p9999, max] =
                [trip.min, trip.p50, trip.p99, trip.p999, trip.p9999, trip.max].map(micros_or_dash);
            let _ = writeln!(
                text,
                "round trip: min {min}, p50 {p50}, p99 {p99}, p99.9 {p999}, p99.99 {p9999}, max {max} us; n {}, {} more without",
                grouped(trip.n),
                grouped(trip.gaps.unwrap_or(0))
            );
        }
        text + &scheduled.as_ref().map_or(String::new(), Scheduled::describe)
    }
}

impl Stream {
    pub fn of(args: &BenchArgs) -> Self {
        Self {
            to: args.to.to_string(),
            bytes: args.size,
            sent: 0,
            sent_for_ns: 0,
            full: 0,
            no_buffers: 0,
            all_left: false,
            came: None,
            lost: None,
            took_ns: None,
            turns: None,
            scheduled: None,
        }
    }

    pub fn describe(&self) -> String {
        let Self { to, bytes, sent, sent_for_ns, full, no_buffers, .. } = self;
        let mut text = format!(
            "{to}: {} packages of {bytes} bytes sent in {}; tries for which there was no room: mailbox full {}, no buffers {}\n",
            grouped(*sent),
            about(*sent_for_ns),
            grouped(*full),
            grouped(*no_buffers)
        );
        match (self.came, self.lost) {
            (Some(came), Some(lost)) => {
                let _ = write!(text, "{} came, {} were lost", grouped(came), grouped(lost));
                if let Some(took) = self.took_ns.filter(|&took| took > 0 && came > 1) {
                    let rate = (came - 1) as f64 / took as f64;
                    let (rate, megabytes) = (rate * 1e9, rate * *bytes as f64 * 1e3);
                    let _ = write!(text, "; {} a second, {megabytes:.2} MB/s", grouped(rate as u64));
                }
                text.push('\n');
                if let Some(turns) = self.turns.filter(|_| came > 0) {
                    let share = 100.0 * came as f64 / turns as f64;
                    let _ = writeln!(
                        text,
                        "meanwhile {} turns of this station passed: {share:.2} % of them had one",
                        grouped(turns)
                    );
                }
            }
            _ if !self.all_left => text += "not all of them have left: it is not known how many came\n",
            _ => {
                text +=
                    "who has that mailbox does not say how many came: `rtnet package receive --echo` does\n"
            }
        }
        if let Some(scheduled) = &self.scheduled {
            text += &scheduled.missed();
        }
        text
    }
}

impl Scheduled {
    fn describe(&self) -> String {
        let wait = |wait: &Waits| {
            let Waits { station, slot, worst_wait_ns, way_ns } = wait;
            let way = if *way_ns > 0 { format!(" and {} on its way", time(*way_ns)) } else { String::new() };
            format!("{} for slot {slot} of {station}{way}", time(*worst_wait_ns))
        };
        let mut text =
            format!("worst waits: {}", self.waits.iter().map(wait).collect::<Vec<_>>().join(", then "));
        match self.two_worst_waits_ns {
            Some(both) => text += &format!(": {} together", time(both)),
            None => {
                text += "; that of the answer is not known here: `rtnet package bench --help` says when it is"
            }
        }
        text.push('\n');
        if let (Some([best, worst]), Some(lead)) = (self.round_trip_ns, self.lead_ns) {
            let (best, worst, lead) = (time(best), time(worst), time(lead));
            text += &format!(
                "by where the slots are: {best} to {worst}, if nobody takes any time and frames are chosen {lead} before\n"
            );
        }
        if self.two_worst_waits_ns.is_some() {
            text += &format!("{} took longer than those waits together\n", grouped(self.longer));
        }
        text + &self.missed()
    }

    fn missed(&self) -> String {
        format!("slots missed meanwhile, each of which may add a cycle: {}\n", grouped(self.missed))
    }
}

fn time(ns: i64) -> String {
    format!("{} us", micros(ns))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn round_trips_and_streams_are_told_in_words_and_what_is_not_known_is_left_out() {
        let trip = json!({
            "n": 2, "min": 1_000, "p50": 1_250, "p99": 20_000, "p999": 3_000_000, "p9999": 3_000_000, "max": 3_000_000, "sd": 1, "gaps": 1,
        });
        let mut trips = Trips {
            to: "Camera(0/0)".into(),
            bytes: 64,
            asked: 3,
            came: 2,
            lost: 1,
            took_ns: 5_040_000_000,
            round_trip_ns: serde_json::from_value(trip).unwrap(),
            longest: Vec::new(),
            scheduled: None,
        };
        let words = "Camera(0/0): 3 asked in 5s with 64 bytes, 2 answered, 1 lost\n\
                     round trip: min 1.00, p50 1.25, p99 20.0, p99.9 3 000, p99.99 3 000, max 3 000 us; n 2, 1 more without\n";
        assert_eq!(trips.describe(), words);
        trips.came = 0;
        assert_eq!(trips.describe().lines().count(), 1);
        let mut stream = Stream {
            to: "Camera(0/0)".into(),
            bytes: 1_456,
            sent: 1_001,
            sent_for_ns: 1_000_000_000,
            full: 0,
            no_buffers: 7,
            all_left: true,
            came: Some(1_001),
            lost: Some(0),
            took_ns: Some(1_000_000_000),
            turns: Some(1_025),
            scheduled: None,
        };
        let words = "Camera(0/0): 1 001 packages of 1456 bytes sent in 1s; tries for which there was no room: mailbox full 0, no \
                     buffers 7\n1 001 came, 0 were lost; 1 000 a second, 1.46 MB/s\n\
                     meanwhile 1 025 turns of this station passed: 97.66 % of them had one\n";
        assert_eq!(stream.describe(), words);
        (stream.came, stream.turns) = (None, None);
        assert!(stream.describe().ends_with("`rtnet package receive --echo` does\n"));
        stream.all_left = false;
        assert!(stream.describe().ends_with("it is not known how many came\n"));
    }
}
