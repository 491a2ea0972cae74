//! The part of it that says what the medium, the hosts, the wires and the clocks do throughout.

use std::path::Path;
use std::sync::Arc;

use rtnet::sim::{Host, Joint, Latency};
use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

use super::names::Names;
use super::{LONGEST, Reader};
use crate::report::recorded;
use crate::scenario::file::FileError;
use crate::scenario::{Direction, Effects, Wandering, Wire};
use crate::units::{NonNegativeSpan, PositiveSpan, Share, parse_nonnegative_span};

const QUEUE: usize = 64;
/// More memory than any switch has, and full for longer than anybody waits.
const QUEUE_AT_MOST: usize = 100_000;
const WANDER_EVERY: Span = Span::from_millis(100);
/// No station looks at its clock more often, and each step is work for a simulation.
const WANDER_EVERY_AT_LEAST: Span = Span::from_micros(10);
/// As much as clocks are off by.
const WANDER_AT_MOST_PPM: f64 = 1_000.0;
const PPM_AT_MOST: u32 = 1_000_000;

#[derive(Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MediumFile {
    joint: Option<JointFile>,
    pub propagation: Option<Spanned<NonNegativeSpan>>,
    latency: Option<Spanned<NonNegativeSpan>>,
    queue: Option<Spanned<usize>>,
}

impl MediumFile {
    /// Where it says how long a frame is on its way.
    pub fn place_of_way(&self) -> usize {
        let said = self.propagation.as_ref().or(self.latency.as_ref());
        said.map_or(0, |span| span.span().start)
    }
}

#[derive(Clone, Copy, Deserialize, PartialEq)]
#[serde(rename_all = "lowercase")]
enum JointFile {
    Bridge,
    Hub,
    Switch,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostFile {
    wake: Option<Spanned<String>>,
    late: Option<Spanned<String>>,
    send: Option<Spanned<String>>,
    outages: Option<OutagesFile>,
    stalls: Option<OutagesFile>,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct OutagesFile {
    ppm: Spanned<u32>,
    longest: Spanned<PositiveSpan>,
}

/// How the rate of a clock changes.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WanderFile {
    step_ppm: Spanned<f64>,
    within_ppm: Spanned<f64>,
    every: Option<Spanned<PositiveSpan>>,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WireFile {
    stations: Option<Spanned<Names>>,
    #[serde(default)]
    direction: DirectionFile,
    lose: Option<Share>,
    lose_control: Option<Share>,
    lose_data: Option<Share>,
    duplicate: Option<Share>,
    corrupt: Option<Share>,
    reorder: Option<Share>,
    reorder_by: Option<Spanned<PositiveSpan>>,
    delay: Option<Spanned<String>>,
}

impl WireFile {
    /// Whether it says what becomes of a frame, and be it nothing.
    fn says_something(&self) -> bool {
        let shares =
            [self.lose, self.lose_control, self.lose_data, self.duplicate, self.corrupt, self.reorder];
        self.delay.is_some() || shares.iter().any(Option::is_some)
    }
}

#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum DirectionFile {
    In,
    Out,
    #[default]
    Both,
}

impl Reader<'_> {
    pub(super) fn joint(&self, medium: &MediumFile) -> Result<Joint, FileError> {
        let joint = medium.joint.unwrap_or(JointFile::Bridge);
        let (latency, queue) = (medium.latency.as_ref(), medium.queue.as_ref());
        let first = latency.map(Spanned::span).into_iter().chain(queue.map(Spanned::span));
        if let (true, Some(first)) = (joint != JointFile::Switch, first.min_by_key(|span| span.start)) {
            let what = "only a switch has a latency and a queue: say joint = \"switch\", or leave them out";
            return Err(self.source.impossible(first.start, what));
        }
        for span in [&medium.propagation, &medium.latency].into_iter().flatten() {
            self.check_time(span.get_ref().0, span.span().start)?;
        }
        if let Some(queue) = queue.filter(|queue| !(1..=QUEUE_AT_MOST).contains(queue.get_ref())) {
            let what = format!("a queue of {} frames: a port holds 1 to {QUEUE_AT_MOST}", queue.get_ref());
            return Err(self.source.impossible(queue.span().start, what));
        }
        Ok(match joint {
            JointFile::Bridge => Joint::Bridge,
            JointFile::Hub => Joint::Hub,
            JointFile::Switch => Joint::Switch {
                latency: latency.map_or(Span::ZERO, |latency| latency.get_ref().0),
                queue: queue.map_or(QUEUE, |queue| *queue.get_ref()),
            },
        })
    }

    pub(super) fn host(&self, file: &HostFile) -> Result<Host, FileError> {
        let latency = |text: &Option<Spanned<String>>| {
            text.as_ref().map_or(Ok(Latency::NONE), |text| self.latency(text))
        };
        let (outage_ppm, longest_outage) = self.outages(&file.outages)?;
        let (stall_ppm, longest_stall) = self.outages(&file.stalls)?;
        Ok(Host {
            wake: latency(&file.wake)?,
            outage_ppm,
            longest_outage,
            late: latency(&file.late)?,
            send: latency(&file.send)?,
            stall_ppm,
            longest_stall,
            // Of the whole network, by its slot_guard.
            guard: None,
        })
    }

    /// How many of a million wake-ups, and for how long at most.
    fn outages(&self, file: &Option<OutagesFile>) -> Result<(u32, Span), FileError> {
        let Some(OutagesFile { ppm, longest }) = file else { return Ok((0, Span::ZERO)) };
        let share = *ppm.get_ref();
        if share > PPM_AT_MOST {
            let what = format!("{share} of a million: 0 to {PPM_AT_MOST}");
            return Err(self.source.impossible(ppm.span().start, what));
        }
        self.check_time(longest.get_ref().0, longest.span().start)?;
        Ok((share, longest.get_ref().0))
    }

    /// `exponential 13us`.
    fn latency(&self, text: &Spanned<String>) -> Result<Latency, FileError> {
        let refuse = |what: String| self.source.impossible(text.span().start, what);
        let words = words_of(text.get_ref());
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let times = || {
            let read = words[1..].iter().map(|word| parse_nonnegative_span(word));
            read.collect::<Result<Vec<Span>, _>>().map_err(|error| refuse(error.to_string()))
        };
        match words[..] {
            ["recorded", file] => {
                let beside = Path::new(self.source.file).parent().unwrap_or(Path::new(""));
                let recorded =
                    recorded::load(&beside.join(file)).map_err(|error| refuse(format!("{error:#}")))?;
                return Ok(Latency::Recorded(Arc::new(recorded)));
            }
            ["constant" | "exponential", _] | ["uniform" | "normal", _, _] => {}
            _ => {
                return Err(refuse(format!(
                    "'{}' is no distribution: write \"constant T\", \"uniform T T\", \"exponential MEAN\", \
                     \"normal MEAN SD\" or \"recorded FILE\", as in \"exponential 13us\"",
                    text.get_ref()
                )));
            }
        }
        let times = times()?;
        times.iter().try_for_each(|&span| self.check_time(span, text.span().start))?;
        Ok(match (words[0], &times[..]) {
            ("uniform", &[from, to]) if from <= to => Latency::Uniform(from, to),
            ("uniform", _) => {
                return Err(refuse("the first of the two times must be the shorter one".into()));
            }
            ("exponential", &[mean]) => Latency::Exponential(mean),
            ("normal", &[mean, deviation]) => Latency::Normal(mean, deviation),
            (_, times) => Latency::Constant(times[0]),
        })
    }

    fn check_time(&self, span: Span, at: usize) -> Result<(), FileError> {
        let refuse = || self.source.impossible(at, format!("{span}: nothing takes longer than {LONGEST}"));
        (span <= LONGEST).then_some(()).ok_or_else(refuse)
    }

    pub(super) fn wire(&self, entry: &Spanned<WireFile>) -> Result<Wire, FileError> {
        let file = entry.get_ref();
        let stations = match &file.stations {
            Some(names) => self.stations(names)?,
            None => (0..self.names.len()).collect(),
        };
        if !file.says_something() {
            let what = "a wire that does nothing to a frame: say lose, lose_control, lose_data, duplicate, corrupt, \
                        reorder or delay, as in lose = \"1%\"";
            return Err(self.source.impossible(entry.span().start, what));
        }
        if let Some(by) = &file.reorder_by {
            if file.reorder.is_none() {
                let what =
                    "nothing is reordered by that time: say of how many frames, as in reorder = \"1%\"";
                return Err(self.source.impossible(by.span().start, what));
            }
            self.check_time(by.get_ref().0, by.span().start)?;
        }
        let ppm = |share: Option<Share>| share.map(|share| share.0);
        Ok(Wire {
            stations,
            direction: match file.direction {
                DirectionFile::In => Direction::In,
                DirectionFile::Out => Direction::Out,
                DirectionFile::Both => Direction::Both,
            },
            effects: Effects {
                lose_control_ppm: ppm(file.lose_control.or(file.lose)),
                lose_data_ppm: ppm(file.lose_data.or(file.lose)),
                duplicate_ppm: ppm(file.duplicate),
                corrupt_ppm: ppm(file.corrupt),
                reorder_ppm: ppm(file.reorder),
                reorder_by: file.reorder_by.as_ref().map(|span| span.get_ref().0),
                delay: file.delay.as_ref().map(|text| self.latency(text)).transpose()?,
            },
        })
    }

    pub(super) fn wandering(&self, file: &WanderFile) -> Result<Wandering, FileError> {
        let ppb = |ppm: &Spanned<f64>| {
            let is_sound = (0.0..=WANDER_AT_MOST_PPM).contains(ppm.get_ref());
            let what =
                format!("a clock that wanders by {} ppm: from 0 to {WANDER_AT_MOST_PPM}", ppm.get_ref());
            let refuse = || self.source.impossible(ppm.span().start, what);
            is_sound.then_some((ppm.get_ref() * 1_000.0).round() as i64).ok_or_else(refuse)
        };
        let every = file.every.as_ref().map_or(WANDER_EVERY, |every| every.get_ref().0);
        if let (false, Some(said)) = ((WANDER_EVERY_AT_LEAST..=LONGEST).contains(&every), &file.every) {
            let what = format!(
                "a clock that changes its rate every {every}: every {WANDER_EVERY_AT_LEAST} to {LONGEST}; no station \
                 looks at it more often"
            );
            return Err(self.source.impossible(said.span().start, what));
        }
        Ok(Wandering { every, step_ppb: ppb(&file.step_ppm)?, within_ppb: ppb(&file.within_ppm)? })
    }
}

/// The words of a distribution; a number and its unit, `13 us`, are one.
fn words_of(text: &str) -> Vec<String> {
    let mut words: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match words.last_mut().filter(|before| before.parse::<f64>().is_ok()) {
            Some(number) if word.starts_with(char::is_alphabetic) => number.push_str(word),
            _ => words.push(word.to_owned()),
        }
    }
    words
}
