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
//! [[wire]]                  # of two, the later one counts for what it says
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
//! out_of_slot = [">= 1", "<= 8"]    # both have to hold
//! takeover_cycles = "<= 1"  # expect = { ... } of a [[station]] is of that one alone
//! ```

mod events;
mod medium;
mod names;

use std::collections::BTreeMap;

use rtnet::sim::Host;
use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

pub use events::EventFile;
pub use medium::{HostFile, MediumFile, WanderFile, WireFile};

use super::{FileError, Source};
use crate::scenario::{Conditions, Expectation, Measure};

/// An hour, as a clock may be off: no time in a scenario is longer.
const LONGEST: Span = Span::from_millis(3_600_000);

/// What is expected: of all, or of a single station.
pub type ExpectFile = BTreeMap<Spanned<String>, Spanned<Figure>>;

/// A count or a time, behind a relation or not; or several, which all have to hold.
#[derive(Clone, Deserialize)]
#[serde(untagged, expecting = "a count, a text like \"<= 2\" or \"< 20us\", or a list of them")]
pub enum Figure {
    Count(i64),
    Text(String),
    All(Vec<Figure>),
}

impl Figure {
    /// Each of them, as a text.
    fn texts(&self) -> Vec<String> {
        match self {
            Figure::Count(count) => vec![count.to_string()],
            Figure::Text(text) => vec![text.clone()],
            Figure::All(all) => all.iter().flat_map(Figure::texts).collect(),
        }
    }
}

/// The sections of a file that say all this.
#[derive(Default)]
pub struct Sections {
    pub medium: Option<MediumFile>,
    pub host: Option<HostFile>,
    /// Of single stations, by their number in the file.
    pub hosts: Vec<(usize, HostFile)>,
    pub wanders: Vec<(usize, WanderFile)>,
    pub wires: Vec<Spanned<WireFile>>,
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
    pub source: &'a Source<'a>,
    pub names: Vec<&'a str>,
    /// Which of them gives the time.
    pub master: usize,
}

impl Reader<'_> {
    pub fn conditions(&self, sections: Sections) -> Result<Conditions, FileError> {
        let (hosts, wanders) = (sections.hosts.iter(), sections.wanders.iter());
        let medium = sections.medium.unwrap_or_default();
        Ok(Conditions {
            joint: self.joint(&medium)?,
            propagation: medium.propagation.as_ref().map(|span| span.get_ref().0),
            host: sections.host.as_ref().map_or(Ok(Host::IDEAL), |file| self.host(file))?,
            hosts: hosts.map(|(id, file)| Ok((*id, self.host(file)?))).collect::<Result<_, FileError>>()?,
            wanders: wanders
                .map(|(id, file)| Ok((*id, self.wandering(file)?)))
                .collect::<Result<_, FileError>>()?,
            wires: sections.wires.iter().map(|wire| self.wire(wire)).collect::<Result<_, _>>()?,
            events: sections.events.iter().map(|event| self.event(event)).collect::<Result<_, _>>()?,
            expectations: self.expectations(&sections.expects)?,
        })
    }

    fn expectations(&self, files: &[(Whose, ExpectFile)]) -> Result<Vec<Expectation>, FileError> {
        let lines = files.iter().flat_map(|(whose, file)| file.iter().map(move |line| (*whose, line)));
        let read = lines.map(|(whose, (name, figure))| self.expected(name, figure, whose));
        let mut all = read.collect::<Result<Vec<_>, _>>()?.concat();
        all.sort_by_key(|expected| expected.place);
        Ok(all)
    }

    fn expected(
        &self,
        named: &Spanned<String>,
        figure: &Spanned<Figure>,
        whose: Whose,
    ) -> Result<Vec<Expectation>, FileError> {
        let at = figure.span().start;
        let refuse = |what: String| self.source.impossible(at, what);
        let name = named.get_ref().as_str();
        let Some(measure) = Measure::by_name(name).filter(|&measure| whose.has(measure)) else {
            let names = Measure::ALL.iter().filter(|(of, _)| whose.has(*of));
            let names: Vec<_> = names.map(|&(_, name)| name).collect();
            let of = whose.words();
            let what = format!("nothing {of}is called '{name}': expect {}", names.join(", "));
            return Err(self.source.impossible(named.span().start, what));
        };
        let texts = figure.get_ref().texts();
        if texts.is_empty() {
            return Err(refuse(format!(
                "an empty list expects nothing of {name}: write for example [\">= 1\", \"<= 9\"]"
            )));
        }
        let (Whose { station, priority }, place) = (whose, self.source.place(at));
        let read = texts.iter().map(|text| {
            let (relation, limit) = Expectation::parse(measure, text).map_err(refuse)?;
            Ok(Expectation { measure, station, priority, relation, limit, place })
        });
        read.collect()
    }
}

#[cfg(test)]
mod tests;
