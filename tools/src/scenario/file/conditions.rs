//! The part of a file that says what a network goes through, and what is expected of it.
//!
//! ```toml
//! [medium]
//! joint = "bridge"          # or "hub": frames that meet destroy each other; or "switch": a queue for each port
//! propagation = "500ns"
//! latency = "2us"           # of a switch, from a frame's end to its begin at the other port
//! queue = 64                # of a switch, frames that wait for a port
//!
//! [host]                    # of all stations; host = { ... } of a [[station]] is its own
//! wake = "exponential 13us" # or "constant T", "uniform T T", "normal MEAN SD", "recorded FILE"
//! late = "recorded lab.json" # from a frame's instant to the last look at the clock, as `lab run --json` recorded it
//! send = "uniform 0us 0.4us"
//! outages = { ppm = 75, longest = "4ms" }
//! stalls = { ppm = 2, longest = "4ms" }
//!
//! [[wire]]
//! stations = ["arm"]        # all, if not given
//! direction = "in"          # or "out"; both, if not given
//! lose = "1%"               # or lose_control, lose_data; and duplicate, corrupt, reorder, each "1%" or "50ppm"
//! reorder_by = "100us"
//! delay = "uniform 0us 5us"
//!
//! [[event]]
//! at = "2s"                 # after the begin of the measurement
//! kill = "master"           # or clock = { stations = "arm", step = "5ms", drift_ppm = 20.0, wander = { ... } };
//!                           # one of: kill, restart, start, stop, stall, clock, cut, unplug, wire, babble, inject
//! times = 20                # and every = "100ms"
//!
//! [expect]
//! overlaps = 0
//! takeover_cycles = "<= 1"  # expect = { ... } of a [[station]] is of that one alone
//! ```

mod events;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use rtnet::sim::{Host, Joint, Latency, Link};
use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

pub use events::EventFile;

use super::{FileError, Source};
use crate::report::recorded;
use crate::scenario::{Conditions, Direction, Expectation, Measure, Wandering, Wire};
use crate::units::{NonNegativeSpan, PositiveSpan, Share, parse_nonnegative_span};

/// How late a frame is that others overtake, unless it is said.
const REORDER_BY: Span = Span::from_micros(100);
const QUEUE: usize = 64;
const WANDER_EVERY: Span = Span::from_millis(100);
/// An hour, as a clock may be off: no time in a scenario is longer.
const LONGEST: Span = Span::from_millis(3_600_000);
/// As much as clocks are off by.
const WANDER_AT_MOST_PPM: f64 = 1_000.0;

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MediumFile {
    joint: Option<JointFile>,
    propagation: Option<NonNegativeSpan>,
    latency: Option<NonNegativeSpan>,
    queue: Option<usize>,
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

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct OutagesFile {
    ppm: u32,
    longest: PositiveSpan,
}

/// How the rate of a clock changes.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WanderFile {
    step_ppm: f64,
    within_ppm: f64,
    every: Option<PositiveSpan>,
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
    reorder_by: Option<PositiveSpan>,
    delay: Option<Spanned<String>>,
}

#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum DirectionFile {
    In,
    Out,
    #[default]
    Both,
}

/// One station, or several.
#[derive(Clone, Deserialize)]
#[serde(untagged, expecting = "a station's name, or a list of names")]
enum Names {
    One(String),
    Several(Vec<String>),
}

/// What is expected: of all, or of a single station.
pub type ExpectFile = BTreeMap<Spanned<String>, Spanned<Figure>>;

/// A count or a time, behind a relation or not.
#[derive(Clone, Deserialize)]
#[serde(untagged, expecting = "a count, or a text like \"<= 2\" or \"< 20us\"")]
pub enum Figure {
    Count(i64),
    Text(String),
}

/// The sections of a file that say all this.
#[derive(Default)]
pub struct Sections {
    pub medium: Option<MediumFile>,
    pub host: Option<HostFile>,
    /// Of single stations, by their number in the file.
    pub hosts: Vec<(usize, HostFile)>,
    pub wanders: Vec<(usize, WanderFile)>,
    pub wires: Vec<WireFile>,
    pub events: Vec<Spanned<EventFile>>,
    /// Of all, of single stations, and of their traffic.
    pub expects: Vec<(Whose, ExpectFile)>,
}

/// Of what something is expected: of which station, and of its traffic of which priority; of all, if not said.
#[derive(Clone, Copy, Default)]
pub struct Whose {
    pub station: Option<usize>,
    pub priority: Option<u8>,
}

impl Whose {
    /// Whether that has such a figure.
    fn has(self, measure: Measure) -> bool {
        match self {
            Whose { priority: Some(_), .. } => measure.is_of_traffic(),
            Whose { station: Some(_), .. } => measure.is_of_stations(),
            _ => true,
        }
    }

    /// As in "nothing of a station is called".
    fn words(self) -> &'static str {
        match self {
            Whose { priority: Some(_), .. } => "of traffic ",
            Whose { station: Some(_), .. } => "of a station ",
            _ => "",
        }
    }
}

/// Reads them; stations are numbered as in the file.
pub struct Reader<'a> {
    pub source: Source<'a>,
    pub names: Vec<&'a str>,
}

impl Reader<'_> {
    pub fn conditions(&self, sections: Sections) -> Result<Conditions, FileError> {
        let (hosts, wanders) = (sections.hosts.iter(), sections.wanders.iter());
        let medium = sections.medium.unwrap_or_default();
        Ok(Conditions {
            joint: self.joint(&medium)?,
            propagation: medium.propagation.map(|span| span.0),
            host: sections.host.as_ref().map_or(Ok(Host::IDEAL), |file| self.host(file))?,
            hosts: hosts.map(|(id, file)| Ok((*id, self.host(file)?))).collect::<Result<_, FileError>>()?,
            wanders: wanders
                .map(|(id, file)| Ok((*id, self.wandering(*file, self.place("wander"))?)))
                .collect::<Result<_, FileError>>()?,
            wires: sections.wires.iter().map(|wire| self.wire(wire)).collect::<Result<_, _>>()?,
            events: sections.events.iter().map(|event| self.event(event)).collect::<Result<_, _>>()?,
            expectations: self.expectations(&sections.expects)?,
        })
    }

    fn joint(&self, medium: &MediumFile) -> Result<Joint, FileError> {
        let joint = medium.joint.unwrap_or(JointFile::Bridge);
        if joint != JointFile::Switch && (medium.latency.is_some() || medium.queue.is_some()) {
            let what = "only a switch has a latency and a queue: say joint = \"switch\", or leave them out";
            return Err(self.source.impossible(self.place("[medium]"), what));
        }
        Ok(match joint {
            JointFile::Bridge => Joint::Bridge,
            JointFile::Hub => Joint::Hub,
            JointFile::Switch => Joint::Switch {
                latency: medium.latency.map_or(Span::ZERO, |latency| latency.0),
                queue: medium.queue.unwrap_or(QUEUE),
            },
        })
    }

    fn host(&self, file: &HostFile) -> Result<Host, FileError> {
        let latency = |text: &Option<Spanned<String>>| {
            text.as_ref().map_or(Ok(Latency::NONE), |text| self.latency(text))
        };
        let (outages, stalls) = (file.outages, file.stalls);
        Ok(Host {
            wake: latency(&file.wake)?,
            outage_ppm: outages.map_or(0, |outages| outages.ppm),
            longest_outage: outages.map_or(Span::ZERO, |outages| outages.longest.0),
            late: latency(&file.late)?,
            send: latency(&file.send)?,
            stall_ppm: stalls.map_or(0, |stalls| stalls.ppm),
            longest_stall: stalls.map_or(Span::ZERO, |stalls| stalls.longest.0),
            // Of the whole network, by its slot_guard.
            guard: None,
        })
    }

    /// `exponential 13us`.
    fn latency(&self, text: &Spanned<String>) -> Result<Latency, FileError> {
        let refuse = |what: String| self.source.impossible(text.span().start, what);
        let words: Vec<&str> = text.get_ref().split_whitespace().collect();
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
        if times.iter().any(|&span| span > LONGEST) {
            return Err(refuse(format!("nothing takes longer than {LONGEST}")));
        }
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

    fn wire(&self, file: &WireFile) -> Result<Wire, FileError> {
        let ppm = |share: Option<Share>| share.map_or(0, |share| share.0);
        let lose = |of: Option<Share>| ppm(of.or(file.lose));
        let stations = match &file.stations {
            Some(names) => self.stations(names)?,
            None => (0..self.names.len()).collect(),
        };
        Ok(Wire {
            stations,
            direction: match file.direction {
                DirectionFile::In => Direction::In,
                DirectionFile::Out => Direction::Out,
                DirectionFile::Both => Direction::Both,
            },
            link: Link {
                lose_control_ppm: lose(file.lose_control),
                lose_data_ppm: lose(file.lose_data),
                duplicate_ppm: ppm(file.duplicate),
                corrupt_ppm: ppm(file.corrupt),
                reorder_ppm: ppm(file.reorder),
                reorder_by: file.reorder_by.map_or(REORDER_BY, |span| span.0),
                delay: file.delay.as_ref().map_or(Ok(Latency::NONE), |text| self.latency(text))?,
                down: false,
            },
        })
    }

    fn expectations(&self, files: &[(Whose, ExpectFile)]) -> Result<Vec<Expectation>, FileError> {
        let lines = files.iter().flat_map(|(whose, file)| file.iter().map(move |line| (*whose, line)));
        let read = lines.map(|(whose, (name, figure))| self.expectation(name.get_ref(), figure, whose));
        let mut all = read.collect::<Result<Vec<_>, _>>()?;
        all.sort_by_key(|expected| expected.line);
        Ok(all)
    }

    fn expectation(
        &self,
        name: &str,
        figure: &Spanned<Figure>,
        whose: Whose,
    ) -> Result<Expectation, FileError> {
        let at = figure.span().start;
        let refuse = |what: String| self.source.impossible(at, what);
        let Some(measure) = Measure::by_name(name).filter(|&measure| whose.has(measure)) else {
            let names = Measure::ALL.iter().filter(|(of, _)| whose.has(*of));
            let names: Vec<_> = names.map(|&(_, name)| name).collect();
            let of = whose.words();
            return Err(refuse(format!("nothing {of}is called '{name}': expect {}", names.join(", "))));
        };
        let text = match figure.get_ref() {
            Figure::Count(count) => count.to_string(),
            Figure::Text(text) => text.clone(),
        };
        let (relation, limit) = Expectation::parse(measure, &text).map_err(refuse)?;
        let (Whose { station, priority }, line) = (whose, self.source.line(at));
        Ok(Expectation { measure, station, priority, relation, limit, line })
    }

    fn stations(&self, names: &Spanned<Names>) -> Result<Vec<usize>, FileError> {
        self.numbers(names.get_ref(), names.span().start)
    }

    /// Each once.
    fn numbers(&self, names: &Names, at: usize) -> Result<Vec<usize>, FileError> {
        let names = match names {
            Names::One(name) => std::slice::from_ref(name),
            Names::Several(names) => names,
        };
        if names.is_empty() {
            return Err(self.source.impossible(at, "no station is named: name one, or several"));
        }
        let mut numbers = names.iter().map(|name| self.number(name, at)).collect::<Result<Vec<_>, _>>()?;
        numbers.sort_unstable();
        numbers.dedup();
        Ok(numbers)
    }

    fn number(&self, name: &str, at: usize) -> Result<usize, FileError> {
        let number = self.names.iter().position(|of| *of == name);
        number.ok_or_else(|| {
            let what = format!("there is no station '{name}': there are {}", self.names.join(", "));
            self.source.impossible(at, what)
        })
    }

    fn wandering(&self, file: WanderFile, at: usize) -> Result<Wandering, FileError> {
        let ppb = |ppm: f64| {
            let is_sound = (0.0..=WANDER_AT_MOST_PPM).contains(&ppm);
            let what = || format!("a clock that wanders by {ppm} ppm: from 0 to {WANDER_AT_MOST_PPM}");
            is_sound
                .then_some((ppm * 1_000.0).round() as i64)
                .ok_or_else(|| self.source.impossible(at, what()))
        };
        let every = file.every.map_or(WANDER_EVERY, |every| every.0);
        Ok(Wandering { every, step_ppb: ppb(file.step_ppm)?, within_ppb: ppb(file.within_ppm)? })
    }

    /// Where a section begins.
    fn place(&self, section: &str) -> usize {
        self.source.text.find(section).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests;
