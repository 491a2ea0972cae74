//! What a status tells of a station's time: how it follows its master, and what calibration has shown.

use rtmac::tdma::{CalibrationReport, DelayOf, Servo, TdmaStatus};
use rtnet::time::Span;
use serde::{Deserialize, Serialize};

/// How a station follows its master's time, and how well.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ClockShown {
    /// `none` or `linear`; `None`: it follows nobody.
    pub servo: Option<String>,
    /// What all calibration rounds say together of the delay: `quartile`, `median` or `mean`; `None`: it follows nobody.
    pub delay_of: Option<String>,
    /// Cycles without a Synchronisation that are bridged.
    pub holdover_cycles: u32,
    /// Cycles since the last Synchronisation that was followed.
    pub missing_syncs: u32,
    /// By how much cycles may start earlier or later than the station believes, nanoseconds; `None`: it follows nobody,
    /// or has measured no delay.
    pub error_bound_ns: Option<i64>,
    /// Of a calibration under way.
    pub calibrating: Option<Progress>,
    /// What the last one has shown, or the first so far.
    pub calibration: Option<CalibrationShown>,
}

/// How far a calibration is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Progress {
    /// Rounds that were measured.
    pub measured: u32,
    /// Of so many.
    pub of: u32,
}

/// What the rounds of a calibration have shown. Each is half of what its two frames were on their way, nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct CalibrationShown {
    /// How many were measured.
    pub rounds: u32,
    /// The shortest.
    pub min_ns: i64,
    /// The longest.
    pub max_ns: i64,
    /// From the shortest to the longest.
    pub spread_ns: i64,
    /// The arithmetic mean, which RTnet takes for the delay.
    pub mean_ns: i64,
    /// The lower quartile; once all were measured.
    pub quartile_ns: Option<i64>,
    /// The median; once all were measured.
    pub median_ns: Option<i64>,
    /// Rounds longer than twice the median; once all were measured.
    pub outliers: Option<u32>,
}

impl From<&TdmaStatus> for ClockShown {
    fn from(status: &TdmaStatus) -> Self {
        Self {
            servo: status.servo.map(Servo::name).map(str::to_owned),
            delay_of: status.delay_of.map(DelayOf::name).map(str::to_owned),
            holdover_cycles: status.holdover,
            missing_syncs: status.missing,
            error_bound_ns: status.error_bound.map(Span::nanos),
            calibrating: status.calibrating.map(|(measured, of)| Progress { measured, of }),
            calibration: status.calibration.as_ref().map(CalibrationShown::from),
        }
    }
}

impl From<&CalibrationReport> for CalibrationShown {
    fn from(report: &CalibrationReport) -> Self {
        let whole = report.whole.as_ref();
        Self {
            rounds: report.rounds,
            min_ns: report.min.nanos(),
            max_ns: report.max.nanos(),
            spread_ns: report.spread().nanos(),
            mean_ns: report.mean.nanos(),
            quartile_ns: whole.map(|whole| whole.quartile.nanos()),
            median_ns: whole.map(|whole| whole.median.nanos()),
            outliers: whole.map(|whole| whole.outliers),
        }
    }
}

impl ClockShown {
    /// In lines, `measures_anew` if a delay is known.
    pub fn describe(&self, measures_anew: bool) -> String {
        let Some(servo) = &self.servo else { return String::new() };
        let cycles = |n: u32| format!("{n} cycle{}", if n == 1 { "" } else { "s" });
        let off = self.error_bound_ns.map_or("off by nobody knows how much".into(), |ns| {
            format!("off by {} at most", Span::from_nanos(ns))
        });
        let delay = self.delay_of.as_ref().map_or(String::new(), |of| format!(", delay by {of}"));
        let missing = match self.missing_syncs {
            0 => String::new(),
            n => format!(", {n} syncs missing"),
        };
        let mut text =
            format!("servo {servo}{delay}, holdover {}, time {off}{missing}\n", cycles(self.holdover_cycles));
        if let Some(Progress { measured, of }) = self.calibrating {
            let anew = if measures_anew { " anew" } else { "" };
            text += &format!("calibrates{anew}: {measured} of {of} rounds\n");
        }
        text + &self.calibration.map_or(String::new(), |shown| shown.describe())
    }
}

impl CalibrationShown {
    fn describe(&self) -> String {
        let span = |ns: i64| Span::from_nanos(ns).to_string();
        let named =
            |name: &str, ns: Option<i64>| ns.map(|ns| format!(", {name} {}", span(ns))).unwrap_or_default();
        let outliers =
            self.outliers.map(|n| format!("; {n} longer than twice the median")).unwrap_or_default();
        format!(
            "{} rounds: min {}{}{}, mean {} (RTnet's), max {}, spread {}{outliers}\n",
            self.rounds,
            span(self.min_ns),
            named("quartile", self.quartile_ns),
            named("median", self.median_ns),
            span(self.mean_ns),
            span(self.max_ns),
            span(self.spread_ns),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DONE: CalibrationShown = CalibrationShown {
        rounds: 100,
        min_ns: 4_900,
        max_ns: 400_000,
        spread_ns: 395_100,
        mean_ns: 9_100,
        quartile_ns: Some(5_000),
        median_ns: Some(5_100),
        outliers: Some(1),
    };

    fn clock(calibrating: Option<Progress>, calibration: CalibrationShown) -> ClockShown {
        ClockShown {
            servo: Some("linear".into()),
            delay_of: Some("median".into()),
            holdover_cycles: 20,
            missing_syncs: 3,
            error_bound_ns: Some(7_250),
            calibrating,
            calibration: Some(calibration),
        }
    }

    #[test]
    fn a_clock_in_holdover_says_how_far_it_may_be_off_and_what_calibration_showed() {
        assert_eq!(
            clock(None, DONE).describe(false),
            "servo linear, delay by median, holdover 20 cycles, time off by 7.25us at most, 3 syncs missing\n\
             100 rounds: min 4.9us, quartile 5us, median 5.1us, mean 9.1us (RTnet's), max 400us, spread 395.1us; \
             1 longer than twice the median\n"
        );
    }

    #[test]
    fn a_calibration_under_way_shows_the_rounds_so_far() {
        let so_far =
            CalibrationShown { rounds: 37, quartile_ns: None, median_ns: None, outliers: None, ..DONE };
        let text = clock(Some(Progress { measured: 37, of: 100 }), so_far).describe(false);
        let [_, progress, rounds] = text.lines().collect::<Vec<_>>()[..] else { panic!("{text}") };
        assert_eq!(progress, "calibrates: 37 of 100 rounds");
        assert_eq!(rounds, "37 rounds: min 4.9us, mean 9.1us (RTnet's), max 400us, spread 395.1us");
        let text = clock(Some(Progress { measured: 0, of: 10 }), DONE).describe(true);
        assert!(text.contains("\ncalibrates anew: 0 of 10 rounds\n100 rounds: "), "{text}");
    }
}
