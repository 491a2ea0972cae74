//! The part of it that says what happens when.

use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

use super::names::Names;
use super::{LONGEST, Reader, WanderFile, WireFile};
use crate::scenario::file::FileError;
use crate::scenario::{Event, Happening};
use crate::units::{AnySpan, NonNegativeSpan, PositiveSpan};

const BABBLE_EVERY: Span = Span::from_micros(100);
/// Any one event; more shows nothing that so many do not.
const TIMES_AT_MOST: u32 = 1_000_000;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EventFile {
    at: Spanned<NonNegativeSpan>,
    times: Option<Spanned<u32>>,
    every: Option<Spanned<PositiveSpan>>,
    #[serde(rename = "for")]
    lasts: Option<Spanned<PositiveSpan>>,
    kill: Option<Spanned<Names>>,
    restart: Option<Spanned<Names>>,
    start: Option<Spanned<Names>>,
    stop: Option<Spanned<Names>>,
    stall: Option<Spanned<Names>>,
    clock: Option<Spanned<ClockChange>>,
    cut: Option<Spanned<Names>>,
    unplug: Option<Spanned<Names>>,
    wire: Option<Spanned<WireFile>>,
    babble: Option<Spanned<BabbleFile>>,
    inject: Option<Spanned<String>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ClockChange {
    stations: Option<Spanned<Names>>,
    step: Option<Spanned<AnySpan>>,
    drift_ppm: Option<Spanned<f64>>,
    wander: Option<WanderFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BabbleFile {
    station: Spanned<String>,
    every: Option<PositiveSpan>,
}

impl EventFile {
    fn lasts(&self) -> Span {
        self.lasts.as_ref().map_or(Span::ZERO, |lasts| lasts.get_ref().0)
    }
}

impl Reader<'_> {
    pub(super) fn event(&self, entry: &Spanned<EventFile>) -> Result<Event, FileError> {
        let event = entry.get_ref();
        let refuse = |what: &str| self.source.impossible(entry.span().start, what);
        let mut all = self.happenings(event)?;
        let Some((what, lasts)) = all.pop().filter(|_| all.is_empty()) else {
            return Err(refuse(
                "an event is one thing: kill, restart, start, stop, stall, clock, cut, unplug, wire, babble or inject",
            ));
        };
        match &event.lasts {
            None if lasts => {
                return Err(refuse("this lasts for some time: say how long, as in for = \"50ms\""));
            }
            Some(said) if !lasts => {
                return Err(self.source.impossible(said.span().start, "this takes no time: leave out for"));
            }
            _ => {}
        }
        let times = self.times(entry)?;
        let (at, every) = (event.at.get_ref().0, event.every.as_ref());
        let (every, said) = every.map_or((Span::ZERO, 0), |every| (every.get_ref().0, every.span().start));
        let over = every * i64::from(times - 1);
        let ends = event.lasts.as_ref().map_or(0, |lasts| lasts.span().start);
        for (span, place) in [(at, event.at.span().start), (what.lasts(), ends), (every.max(over), said)] {
            if span > LONGEST {
                let what = format!("{span}: nothing lasts, or comes later, than {LONGEST}");
                return Err(self.source.impossible(place, what));
            }
        }
        if times > 1 && every < what.lasts() {
            let what = "it would begin again before it is over: say a longer every, or a shorter for";
            return Err(self.source.impossible(said, what));
        }
        if let Happening::Babble(_, lasts, every) = what
            && lasts.nanos() / every.nanos() > i64::from(TIMES_AT_MOST / times)
        {
            return Err(refuse(&format!(
                "more than {TIMES_AT_MOST} frames: say a longer every, or a shorter for"
            )));
        }
        Ok(Event { at, times, every, what, place: self.source.place(entry.span().start) })
    }

    /// How often it happens, with how long in between if that is more than once.
    fn times(&self, entry: &Spanned<EventFile>) -> Result<u32, FileError> {
        let EventFile { times: said, every, .. } = entry.get_ref();
        let times = said.as_ref().map_or(1, |times| *times.get_ref());
        let at = said.as_ref().map_or(entry.span().start, |times| times.span().start);
        if !(1..=TIMES_AT_MOST).contains(&times) {
            return Err(self.source.impossible(at, format!("{times} times: 1 to {TIMES_AT_MOST}")));
        }
        match every {
            None if times > 1 => {
                let what = "what happens several times says how often, as in times = 20, every = \"100ms\"";
                Err(self.source.impossible(at, what))
            }
            Some(every) if times == 1 => {
                let what = "what happens once is not repeated: say how many times, as in times = 20, or leave out every";
                Err(self.source.impossible(every.span().start, what))
            }
            _ => Ok(times),
        }
    }

    /// Everything that an event says, and whether each lasts.
    fn happenings(&self, event: &EventFile) -> Result<Vec<(Happening, bool)>, FileError> {
        let lasts = event.lasts();
        let mut all = Vec::new();
        let mut named =
            |names: &Option<Spanned<Names>>, what: fn(Vec<usize>, Span) -> Happening, for_some_time| {
                if let Some(names) = names {
                    all.push((what(self.stations(names)?, lasts), for_some_time));
                }
                Ok::<_, FileError>(())
            };
        named(&event.kill, |stations, _| Happening::Kill(stations), false)?;
        named(&event.restart, |stations, _| Happening::Restart(stations), false)?;
        named(&event.start, |stations, _| Happening::Start(stations), false)?;
        named(&event.stop, Happening::Stop, true)?;
        named(&event.stall, Happening::Stall, true)?;
        named(&event.cut, Happening::Cut, true)?;
        named(&event.unplug, Happening::Unplug, true)?;
        self.check_named(event)?;
        all.extend(event.clock.as_ref().map(|change| Ok((self.clock(change)?, false))).transpose()?);
        if let Some(wire) = &event.wire {
            all.push((Happening::Wires(self.wire(wire)?, lasts), true));
        }
        if let Some(babble) = &event.babble {
            let BabbleFile { station, every } = babble.get_ref();
            let station = self.number(station.get_ref(), station.span().start)?;
            all.push((Happening::Babble(station, lasts, every.map_or(BABBLE_EVERY, |every| every.0)), true));
        }
        if let Some(frame) = &event.inject {
            let bytes =
                hex(frame.get_ref()).map_err(|what| self.source.impossible(frame.span().start, what))?;
            all.push((Happening::Inject(bytes), false));
        }
        Ok(all)
    }

    /// What some things cannot happen to.
    fn check_named(&self, event: &EventFile) -> Result<(), FileError> {
        if let Some(names) = &event.start
            && self.stations(names)?.contains(&self.master)
        {
            let what = format!(
                "'{}' is the master: nothing is measured before all are locked to it, so it is there from the begin; let \
                 it restart, or start others",
                self.names[self.master]
            );
            return Err(self.source.impossible(names.span().start, what));
        }
        if let Some(names) = &event.cut
            && self.stations(names)?.len() == self.names.len()
        {
            let what = "all stations are on one side, and nobody is cut off: leave out those on the other";
            return Err(self.source.impossible(names.span().start, what));
        }
        Ok(())
    }

    fn clock(&self, change: &Spanned<ClockChange>) -> Result<Happening, FileError> {
        let ClockChange { stations, step, drift_ppm, wander } = change.get_ref();
        let stations = stations.as_ref().map(|names| self.stations(names)).transpose()?;
        let drift = drift_ppm.as_ref().map(|ppm| self.source.drift(ppm)).transpose()?;
        let (step, at) = step.as_ref().map_or((Span::ZERO, change.span().start), |step| {
            let AnySpan(span) = *step.get_ref();
            (span, step.span().start)
        });
        let wander = wander.as_ref().map(|wander| self.wandering(wander)).transpose()?;
        if step.abs() > LONGEST || (step == Span::ZERO && drift.is_none() && wander.is_none()) {
            let what =
                format!("a clock is set by a step of at most {LONGEST}, a drift_ppm or a wander, or several");
            return Err(self.source.impossible(at, what));
        }
        let stations = stations.unwrap_or_else(|| (0..self.names.len()).collect());
        Ok(Happening::Clock(stations, step, drift, wander))
    }
}

/// Bytes as pairs of hexadecimal digits, with blanks where one likes.
fn hex(text: &str) -> Result<Vec<u8>, String> {
    let digits: Vec<u8> = text.bytes().filter(|byte| !byte.is_ascii_whitespace()).collect();
    let byte = |pair: &[u8]| {
        let pair = std::str::from_utf8(pair).ok().filter(|pair| pair.len() == 2)?;
        u8::from_str_radix(pair, 16).ok()
    };
    let bytes: Option<Vec<u8>> = digits.chunks(2).map(byte).collect();
    let fits = |bytes: &Vec<u8>| (14..=1_514).contains(&bytes.len());
    bytes.filter(fits).ok_or_else(|| {
        "a frame to inject is 14 to 1514 bytes as hexadecimal digits, from its destination on".to_owned()
    })
}
