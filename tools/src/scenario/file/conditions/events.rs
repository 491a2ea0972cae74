//! The part of it that says what happens when.

use rtnet::time::Span;
use serde::Deserialize;
use toml::Spanned;

use super::{LONGEST, Names, Reader, WanderFile, WireFile};
use crate::scenario::file::FileError;
use crate::scenario::{Event, Happening};
use crate::units::{AnySpan, NonNegativeSpan, PositiveSpan};

const BABBLE_EVERY: Span = Span::from_micros(100);
/// Any one event; more shows nothing that so many do not.
const TIMES_AT_MOST: u32 = 1_000_000;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EventFile {
    at: NonNegativeSpan,
    times: Option<u32>,
    every: Option<PositiveSpan>,
    #[serde(rename = "for")]
    lasts: Option<PositiveSpan>,
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
    stations: Option<Names>,
    step: Option<AnySpan>,
    drift_ppm: Option<f64>,
    wander: Option<WanderFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BabbleFile {
    station: String,
    every: Option<PositiveSpan>,
}

impl Reader<'_> {
    pub(super) fn event(&self, entry: &Spanned<EventFile>) -> Result<Event, FileError> {
        let event = entry.get_ref();
        let refuse = |what: &str| self.source.impossible(entry.span().start, what);
        let mut all = self.happenings(event, entry.span().start)?;
        let Some((what, lasts)) = all.pop().filter(|_| all.is_empty()) else {
            return Err(refuse(
                "an event is one thing: kill, restart, start, stop, stall, clock, cut, unplug, wire, babble or inject",
            ));
        };
        if lasts != event.lasts.is_some() {
            return Err(refuse(if lasts {
                "this lasts for some time: say how long, as in for = \"50ms\""
            } else {
                "this takes no time: leave out for"
            }));
        }
        let times = event.times.unwrap_or(1);
        if times == 0 || times > TIMES_AT_MOST || (times > 1) != event.every.is_some() {
            return Err(refuse(
                "what happens several times says how often, as in times = 20, every = \"100ms\"",
            ));
        }
        let every = event.every.map_or(Span::ZERO, |every| every.0);
        let lasts = what.lasts();
        if [event.at.0, every, lasts].iter().any(|&span| span > LONGEST)
            || every * i64::from(times - 1) > LONGEST
        {
            return Err(refuse(&format!("nothing lasts, or comes later, than {LONGEST}")));
        }
        if times > 1 && every < lasts {
            return Err(refuse(
                "it would begin again before it is over: say a longer every, or a shorter for",
            ));
        }
        if let Happening::Babble(_, lasts, every) = what
            && lasts.nanos() / every.nanos() > i64::from(TIMES_AT_MOST / times)
        {
            return Err(refuse(&format!(
                "more than {TIMES_AT_MOST} frames: say a longer every, or a shorter for"
            )));
        }
        Ok(Event { at: event.at.0, times, every, what, line: self.source.line(entry.span().start) })
    }

    /// Everything that an event says, and whether each lasts.
    fn happenings(&self, event: &EventFile, at: usize) -> Result<Vec<(Happening, bool)>, FileError> {
        let lasts = event.lasts.map_or(Span::ZERO, |lasts| lasts.0);
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
        if let Some(change) = &event.clock {
            let (place, change) = (change.span().start, change.get_ref());
            let stations = match &change.stations {
                Some(names) => self.numbers(names, place)?,
                None => (0..self.names.len()).collect(),
            };
            let drift = change.drift_ppm.map(|ppm| self.source.drift(ppm, place)).transpose()?;
            let step = change.step.map_or(Span::ZERO, |step| step.0);
            let wander = change.wander.map(|wander| self.wandering(wander, place)).transpose()?;
            if step.abs() > LONGEST || (step == Span::ZERO && drift.is_none() && wander.is_none()) {
                let what = format!(
                    "a clock is set by a step of at most {LONGEST}, a drift_ppm or a wander, or several"
                );
                return Err(self.source.impossible(place, what));
            }
            all.push((Happening::Clock(stations, step, drift, wander), false));
        }
        if let Some(wire) = &event.wire {
            all.push((Happening::Wires(self.wire(wire.get_ref())?, lasts), true));
        }
        if let Some(babble) = &event.babble {
            let BabbleFile { station, every } = babble.get_ref();
            let station = self.number(station, babble.span().start)?;
            all.push((Happening::Babble(station, lasts, every.map_or(BABBLE_EVERY, |every| every.0)), true));
        }
        if let Some(frame) = &event.inject {
            let bytes = hex(frame.get_ref()).map_err(|what| self.source.impossible(at, what))?;
            all.push((Happening::Inject(bytes), false));
        }
        Ok(all)
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
