//! What an observer counts: errors per station and slot, periods, gaps, overlaps. Pure.

use std::collections::BTreeMap;

use rtmac::tdma::schedule::Rate;
use rtmac::wire::Message;
use rtnet::clock::True;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType};

use super::decode::What;
use super::numbers::{Following, Follows};
use super::watch::{Sight, When};
use crate::report::histogram::SignedHistogram;
use crate::report::intervals::Intervals;

/// Streams that are told apart; forged addresses may make any number.
const STREAMS_AT_MOST: usize = 1_000;

/// How much earlier than its slot a frame may seem to be, by clocks that are not quite the master's.
const EARLY: Span = Span::from_micros(10);
/// How much later than its slot's begin one that took it may be: later it is another slot's, in which nothing usual is sent.
const LATE: Span = Span::from_micros(200);

/// All that was counted.
#[derive(Debug)]
pub struct Tally {
    rate: Rate,
    /// Frames.
    pub frames: u64,
    /// Frames by kind.
    pub kinds: BTreeMap<&'static str, u64>,
    /// Two frames on the air at once, at the medium's rate.
    pub overlaps: u64,
    /// Cycle numbers without a sync.
    pub sync_gaps: u64,
    /// Syncs whose cycle number does not follow the one before.
    pub syncs_repeated: u64,
    /// Syncs of cycles that cannot have begun yet.
    pub syncs_implausible: u64,
    /// (t(n) - t(n-1)) - T of neighbouring cycles' syncs.
    pub sync_period: Intervals,
    /// Each station's frames of one kind or slot.
    pub streams: BTreeMap<Stream, Seen>,
    /// Frames of streams beyond those that are told apart.
    pub frames_beyond: u64,
    /// Frames that came when there was no line, or no stamp to be trusted.
    pub not_judged: u64,
    busy_until: Option<True>,
}

/// Whose frames, and which.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Stream {
    /// Who sent them.
    pub source: Address,
    /// Which of its frames.
    pub which: Which,
}

/// Which of a station's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Which {
    /// Its syncs.
    Sync,
    /// Test traffic in one slot.
    Slot {
        /// The station's number in its lab.
        station: usize,
        /// The slot's id.
        slot: u8,
    },
    /// What comes with every turn, but does not say when it was to be.
    Foreign(EtherType),
    /// What comes now and then: calibration, tunnel.
    Sporadic(&'static str),
}

/// One stream.
#[derive(Debug, Default)]
pub struct Seen {
    /// Its frames.
    pub frames: u64,
    /// stamp - (scheduled + offset); for a stream that does not say when: stamp - (cycle's start + offset).
    pub times: SignedHistogram,
    /// Where in a cycle its slot begins.
    offset: Option<Span>,
    turns: Turns,
}

/// The cycles in which a stream was seen.
#[derive(Clone, Copy, Debug, Default)]
struct Turns {
    last: Option<u32>,
    /// Of which count of a master, see [`Numbers::counts`](super::numbers::Numbers::counts).
    of: u64,
    count: u64,
    spanned: u64,
    step: u64,
}

impl Tally {
    /// Nothing yet, on a medium of this rate.
    pub fn new(rate: Rate) -> Self {
        Self {
            rate,
            frames: 0,
            kinds: BTreeMap::new(),
            overlaps: 0,
            sync_gaps: 0,
            syncs_repeated: 0,
            syncs_implausible: 0,
            sync_period: Intervals::default(),
            streams: BTreeMap::new(),
            frames_beyond: 0,
            not_judged: 0,
            busy_until: None,
        }
    }

    /// Counts a frame of `wire_len` bytes.
    pub fn frame(&mut self, at: Option<True>, wire_len: usize, sight: &Sight) {
        let what = &sight.decoded.what;
        self.frames += 1;
        *self.kinds.entry(what.kind()).or_default() += 1;
        self.occupy(at, wire_len);
        sight.follows.into_iter().for_each(|of| self.sync(of));
        if sight.when == When::Unknown {
            self.not_judged += 1;
        }
        if let Some(which) = which(what) {
            self.enter(Stream { source: sight.decoded.source, which }, sight);
        }
        if let (What::Data(tag), Some(count)) = (what, sight.count)
            && tag.priority().is_some()
        {
            let which = Which::Slot { station: tag.station(), slot: tag.slot };
            let slot = self.streams.get_mut(&Stream { source: sight.decoded.source, which });
            // The usual frame has not missed this turn.
            slot.into_iter().for_each(|seen| seen.turns.note(tag.cycle(), count));
        }
        if let (What::Other(..) | What::Tunnel(..), When::Place(place), Some(cycle), Some(count)) =
            (what, sight.when, sight.cycle, sight.count)
        {
            self.take_turn(sight.decoded.source, (cycle, count), place);
        }
    }

    /// What a program sends takes a turn from its station's usual frame: of the last slot that has begun by then.
    fn take_turn(&mut self, source: Address, (cycle, count): (u32, u64), place: Span) {
        let is_there = |offset: Span| offset <= place + EARLY && place <= offset + LATE;
        let of_source = self.streams.range_mut(Stream { source, which: Which::Sync }..);
        let begun = of_source
            .take_while(|(stream, _)| stream.source == source)
            .filter(|(stream, _)| matches!(stream.which, Which::Slot { .. }))
            .map(|(_, seen)| seen)
            .filter(|seen| seen.offset.is_some_and(is_there) && seen.turns.has(cycle));
        if let Some(seen) = begun.max_by_key(|seen| seen.offset) {
            seen.turns.note(cycle, count);
        }
    }

    fn occupy(&mut self, at: Option<True>, wire_len: usize) {
        let Some(at) = at else {
            self.busy_until = None;
            return;
        };
        let until = at.saturating_add(self.rate.air_time(wire_len).nanos() as u64);
        self.overlaps += u64::from(self.busy_until.is_some_and(|busy| at < busy));
        self.busy_until = Some(self.busy_until.map_or(until, |busy| busy.max(until)));
    }

    fn sync(&mut self, Following { how, times }: Following) {
        match (how, times) {
            (Follows::Anew, _) => {}
            (Follows::Next, Some([actual, nominal])) => self.sync_period.next(actual, nominal),
            (Follows::Next, None) => self.sync_period.gap(None),
            (Follows::Missing(cycles), _) => {
                self.sync_gaps += u64::from(cycles);
                self.sync_period.gap(times.map(|[actual, _]| actual));
            }
            (Follows::Again, _) => self.syncs_repeated += 1,
            (Follows::Implausible, _) => self.syncs_implausible += 1,
        }
    }

    fn enter(&mut self, stream: Stream, sight: &Sight) {
        if self.streams.len() >= STREAMS_AT_MOST && !self.streams.contains_key(&stream) {
            self.frames_beyond += 1;
            return;
        }
        let seen = self.streams.entry(stream).or_default();
        seen.frames += 1;
        if let (Some(cycle), Some(count)) = (sight.cycle, sight.count) {
            seen.turns.note(cycle, count);
        }
        if let When::SlotError(time) | When::Place(time) = sight.when {
            seen.times.record(time.nanos());
        }
        seen.offset = sight.offset.or(seen.offset);
    }
}

impl std::fmt::Display for Which {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Which::Sync => f.write_str("sync"),
            Which::Slot { slot, .. } => write!(f, "slot {slot}"),
            Which::Foreign(ether_type) => write!(f, "{ether_type:?}"),
            Which::Sporadic(kind) => f.write_str(kind),
        }
    }
}

impl Seen {
    /// Turns without a frame between the first and the last, if a turn is as often as the shortest step between
    /// two cycles with one.
    pub fn missed(&self) -> u64 {
        let Turns { count, spanned, step, .. } = self.turns;
        spanned.checked_div(step).map_or(0, |steps| (steps + 1).saturating_sub(count))
    }
}

impl Turns {
    /// Whether this cycle is one of its turns, as far as can be told.
    fn has(&self, cycle: u32) -> bool {
        self.last.is_none_or(|last| self.step == 0 || u64::from(cycle.wrapping_sub(last)) % self.step == 0)
    }

    fn note(&mut self, cycle: u32, of: u64) {
        if self.of != of {
            (self.of, self.last) = (of, None);
        }
        match self.last.map(|last| cycle.wrapping_sub(last) as i32) {
            Some(0) => return,
            Some(step @ 1..) => {
                self.spanned += step as u64;
                self.step = if self.step == 0 { step as u64 } else { self.step.min(step as u64) };
            }
            // One that others have overtaken.
            Some(_) => {
                self.count += 1;
                return;
            }
            None => {}
        }
        self.count += 1;
        self.last = Some(cycle);
    }
}

/// A frame that no station takes belongs to no stream.
fn which(what: &What) -> Option<Which> {
    match what {
        What::Tdma(Message::Sync { .. }) => Some(Which::Sync),
        // When its slot was to begin it does not say.
        What::Data(tag) if tag.priority().is_some() => Some(Which::Sporadic("queued")),
        What::Data(tag) => Some(Which::Slot { station: tag.station(), slot: tag.slot }),
        What::Other(ether_type, _) => Some(Which::Foreign(*ether_type)),
        What::Refused(_) => None,
        what => Some(Which::Sporadic(what.kind())),
    }
}

#[cfg(test)]
pub(super) mod tests;
