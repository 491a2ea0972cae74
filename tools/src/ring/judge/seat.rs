//! What is seen of one station, and what it told.

use std::collections::BTreeMap;

use rtnet::clock::{EmulatedClock, True};
use rtnet::time::{Instant, Span};

use crate::judge::closely::regular::Largest;
use crate::judge::delivery::Passed;
use crate::report::histogram::SignedHistogram;
use crate::station::traffic::Tag;

/// One station, as seen from the medium, and what it told.
pub struct Seat {
    /// Frames of data.
    pub frames: u64,
    /// How often the token came to it, but for invitations.
    pub visits: u64,
    /// From one time that the token came to the next.
    pub rotation: SignedHistogram,
    /// Rounds without a time: it was taken to be absent meanwhile, or a new process began.
    pub rotation_gaps: u64,
    /// From the begin of one usual frame to the end of the next.
    pub delivery: SignedHistogram,
    /// Those without a time: a new process began.
    pub delivery_gaps: u64,
    /// From when its program queued a frame, by its own clock, to its begin on the medium; by priority.
    pub queueing: BTreeMap<u8, SignedHistogram>,
    /// Which of its frames were on the medium: usual ones, and by priority.
    pub passed: BTreeMap<Option<u8>, Passed>,
    /// Those of them that came while their receiver's wire was out.
    pub unheard: BTreeMap<Option<u8>, u64>,
    /// How often it told of something, by name.
    pub told: BTreeMap<&'static str, u64>,
    /// How often that was something by which a token, or a turn, is lost.
    pub late: u64,
    /// How often its token was void since another one stays.
    pub given_up: u64,
    /// Of its frames of data: what is behind the Ethernet header.
    pub octets: u64,
    /// From the begin of one usual frame to the end of the second after it: so long, if the one between is lost.
    pub delivery_with_a_loss: Largest,
    pub(super) clock: EmulatedClock,
    /// When the token came last, and how many times something had been wrong by then.
    pub(super) came: Option<(True, u64)>,
    /// Its last two usual frames, the newest first.
    last: [Option<True>; 2],
    /// When its receiver's wire is out.
    pub(super) in_vain: (True, True),
}

impl Seat {
    pub(super) fn new(clock: EmulatedClock, streams: impl Iterator<Item = Option<u8>>) -> Self {
        Self {
            frames: 0,
            visits: 0,
            rotation: SignedHistogram::new(),
            rotation_gaps: 0,
            delivery: SignedHistogram::new(),
            delivery_gaps: 0,
            queueing: BTreeMap::new(),
            passed: streams.map(|of| (of, Passed::default())).collect(),
            unheard: BTreeMap::new(),
            told: BTreeMap::new(),
            late: 0,
            given_up: 0,
            clock,
            octets: 0,
            delivery_with_a_loss: Largest::default(),
            came: None,
            last: [None; 2],
            in_vain: (0, 0),
        }
    }

    /// A frame of data begins on the medium, with so many octets behind its Ethernet header.
    pub(super) fn frame(&mut self, at: True, air: Span, (tag, octets): (&Tag, usize), counts: bool) {
        if let Some(passed) = self.passed.get_mut(&tag.priority()) {
            passed.note(tag.sequence(), at, counts);
        }
        let before = self.last;
        if tag.priority().is_none() {
            self.last = [Some(at), before[0]];
        }
        if !counts {
            return;
        }
        (self.frames, self.octets) = (self.frames + 1, self.octets + octets as u64);
        if (self.in_vain.0..self.in_vain.1).contains(&at) {
            *self.unheard.entry(tag.priority()).or_default() += 1;
        }
        match tag.priority() {
            None => {
                let since = before.map(|then| then.map(|then| Span::from_nanos((at - then) as i64) + air));
                since[0].into_iter().for_each(|under_way| self.delivery.record(under_way.nanos()));
                since[1].into_iter().for_each(|under_way| self.delivery_with_a_loss.note(under_way));
            }
            Some(priority) => {
                let queued = Instant::from_nanos(tag.scheduled().nanos());
                let waited = self.clock.local(at) - queued;
                // Its clock may have been set meanwhile.
                if waited >= Span::ZERO {
                    self.queueing.entry(priority).or_default().record(waited.nanos());
                }
            }
        }
    }

    /// A new process is in its place.
    pub(super) fn begins_anew(&mut self, counts: bool) {
        self.is_absent(counts);
        self.delivery_gaps += u64::from(counts && self.last[0].is_some());
        self.last = [None; 2];
    }

    /// It is taken to be absent: no round of it goes on.
    pub(super) fn is_absent(&mut self, counts: bool) {
        let was_there = self.came.take().is_some();
        self.rotation_gaps += u64::from(counts && was_there);
    }
}
