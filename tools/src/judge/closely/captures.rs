//! The worst cycles as they were on the medium: all are kept for a while, since what is wrong with one may be found later.

use rtnet::discipline::{Cause, EventKind};
use rtnet::time::Span;

use super::regular::Largest;
use crate::judge::findings::{Author, FindingKind};
use crate::judge::timetable::before;

/// Cycles that are kept for good.
pub const WORST_MAX: usize = 12;
/// Frames of a cycle that are kept: of more a picture shows nothing.
pub const FRAMES_MAX: usize = 512;
/// What is wrong with one cycle, one by one.
const FAULTS_MAX: usize = 64;
/// Frames that are kept for a while, of all cycles together.
const FRAMES_ALL: usize = 16_384;
/// For so many cycles something may be found at the least, and at the most.
const RECENT: (usize, usize) = (16, 2_048);

/// A cycle as it was on the medium.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Captured {
    /// Its number.
    pub cycle: u32,
    /// What was on the air, in the order of time.
    pub frames: Vec<OnAir>,
    /// Frames for which there was no room.
    pub more: u64,
    /// What was wrong.
    pub faults: Vec<Fault>,
}

/// A frame on the air.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnAir {
    /// Whose, if it is a Synchronisation or of a slot: maybe of another cycle.
    pub author: Option<Author>,
    /// Since the cycle's start.
    pub at: Span,
    /// How long it was there.
    pub air: Span,
    /// How much later than it was to be.
    pub error: Option<Span>,
}

/// What was wrong with a cycle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    /// What.
    pub kind: FaultKind,
    /// Whose frames.
    pub authors: [Option<Author>; 2],
    /// By how much.
    pub span: Span,
    /// Why, as its station tells.
    pub cause: Option<Cause>,
}

/// Seen on the medium, or told of by a station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultKind {
    /// Seen.
    Found(FindingKind),
    /// Told.
    Told(EventKind),
}

impl Fault {
    /// Whether it is about this frame or slot.
    pub fn is_of(&self, author: Author) -> bool {
        self.authors.contains(&Some(author))
    }

    /// Whether it is that there was no frame.
    pub fn is_of_nothing(&self) -> bool {
        use EventKind as Event;
        matches!(
            self.kind,
            FaultKind::Found(FindingKind::SlotMissed)
                | FaultKind::Told(Event::Overrun | Event::GuardDropped | Event::SlotSilent)
        )
    }

    /// How bad it is, beside other kinds: what is on the air and ought not to be is worse than what is missing.
    pub fn rank(&self) -> u8 {
        use {EventKind as Event, FindingKind as Found};
        match self.kind {
            FaultKind::Found(Found::Overlap) => 6,
            FaultKind::Found(Found::OutOfSlot) => 5,
            FaultKind::Found(Found::WithoutSync | Found::Repeated) => 4,
            FaultKind::Found(Found::SyncGap) | FaultKind::Told(Event::SyncSkipped | Event::SyncDropped) => 3,
            FaultKind::Found(Found::SlotMissed) => 2,
            FaultKind::Told(Event::StalledInSend | Event::ReplyStalled) => 1,
            FaultKind::Told(_) => 2,
        }
    }
}

impl Captured {
    /// Of the worst kind, by how much, and how much else.
    fn badness(&self) -> (u8, i64, usize) {
        let rank = self.rank();
        let worst = self.faults.iter().filter(|fault| fault.rank() == rank);
        let span = worst.map(|fault| fault.span.nanos().saturating_abs()).max();
        (rank, span.unwrap_or(0), self.faults.len())
    }

    fn rank(&self) -> u8 {
        self.faults.iter().map(Fault::rank).max().unwrap_or(0)
    }

    /// The largest difference between the slot errors of two of its frames.
    pub fn spread(&self) -> Option<Span> {
        let of_slots = self.frames.iter().filter(|frame| {
            frame.author.is_some_and(|author| author.slot.is_some() && author.cycle == self.cycle)
        });
        let errors = || of_slots.clone().filter_map(|frame| frame.error);
        let is_whole = self.more == 0 && errors().nth(1).is_some();
        errors().max().zip(errors().min()).filter(|_| is_whole).map(|(max, min)| max - min)
    }
}

/// The cycles of the last while, and the worst of all.
#[derive(Debug)]
pub struct Captures {
    /// By number, modulo how many there are.
    recent: Vec<Option<Captured>>,
    worst: Vec<Captured>,
    ordinary: Option<Captured>,
    faulty: u64,
    spread: Largest,
    /// The cycle that was begun last.
    newest: u32,
}

/// What is kept at the end.
#[derive(Debug)]
pub struct Finished {
    /// The worst cycles, worst first.
    pub worst: Vec<Captured>,
    /// The fullest in which nothing was wrong, the first of those.
    pub ordinary: Option<Captured>,
    /// In how many something was.
    pub faulty: u64,
    /// Of each cycle, the largest difference between the slot errors of two of its frames.
    pub spread: Largest,
}

impl Captures {
    /// Of a network with so many slots.
    pub fn of(slots: usize) -> Self {
        let recent = (FRAMES_ALL / (slots + 1)).clamp(RECENT.0, RECENT.1);
        Self {
            recent: vec![None; recent],
            worst: Vec::new(),
            ordinary: None,
            faulty: 0,
            spread: Largest::default(),
            newest: 0,
        }
    }

    /// A frame is on the air in a cycle.
    pub fn frame(&mut self, cycle: u32, frame: OnAir) {
        if let Some(captured) = self.cycle(cycle) {
            if captured.frames.len() < FRAMES_MAX { captured.frames.push(frame) } else { captured.more += 1 }
        }
    }

    /// Something is wrong with a cycle.
    pub fn fault(&mut self, cycle: u32, fault: Fault) {
        if let Some(captured) = self.cycle(cycle)
            && captured.faults.len() < FAULTS_MAX
        {
            captured.faults.push(fault);
        }
    }

    /// One of the last while; none if it is longer ago.
    fn cycle(&mut self, cycle: u32) -> Option<&mut Captured> {
        let place = cycle as usize % self.recent.len();
        let is_newer = self.recent[place].as_ref().is_none_or(|there| before(there.cycle, cycle));
        if is_newer {
            // What it had room for is used again.
            let mut frames = Vec::new();
            if let Some(over) = self.recent[place].take() {
                self.over(&over);
                frames = over.frames;
                frames.clear();
            }
            self.recent[place] = Some(Captured { cycle, frames, ..Captured::default() });
            self.newest = cycle;
        }
        self.recent[place].as_mut().filter(|there| there.cycle == cycle)
    }

    /// Nothing more of it will be found.
    fn over(&mut self, captured: &Captured) {
        if let Some(spread) = captured.spread() {
            self.spread.note(spread);
        }
        if captured.faults.is_empty() {
            let fullest = self.ordinary.as_ref().map_or(0, |ordinary| ordinary.frames.len());
            if captured.more == 0 && captured.frames.len() > fullest {
                self.ordinary = Some(captured.clone());
            }
            return;
        }
        self.faulty += 1;
        let place = self.worst.partition_point(|other| other.badness() >= captured.badness());
        if self.worst.len() < WORST_MAX {
            return self.worst.insert(place, captured.clone());
        }
        // As with a report's misses: out falls the least bad of the kind that has the most, so that no kind hides another.
        let kinds = self.worst.chunk_by(|one, next| one.rank() == next.rank());
        let ends = kinds.scan(0, |end, kind| {
            *end += kind.len();
            Some((kind.len() + usize::from(kind[0].rank() == captured.rank()), *end, kind[0].rank()))
        });
        let (_, end, rank) = ends.max_by_key(|&(n, end, _)| (n, end)).expect("a full list");
        if rank == captured.rank() && self.worst[end - 1].badness() >= captured.badness() {
            return;
        }
        self.worst.remove(end - 1);
        self.worst.insert(if place >= end { place - 1 } else { place }, captured.clone());
    }

    /// What is kept of all: nothing more will be found.
    pub fn finish(mut self) -> Finished {
        let (n, newest) = (self.recent.len(), self.newest as usize);
        for place in (1..=n).map(|i| (newest + i) % n) {
            if let Some(over) = self.recent[place].take() {
                self.over(&over);
            }
        }
        let Self { mut worst, mut ordinary, faulty, spread, .. } = self;
        worst.iter_mut().chain(&mut ordinary).for_each(|of| of.frames.sort_by_key(|frame| frame.at.nanos()));
        Finished { worst, ordinary, faulty, spread }
    }
}

#[cfg(test)]
mod tests;
