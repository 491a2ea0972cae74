//! Judges what is on the medium: every frame in its sender's slot, every Synchronisation on the grid.

use rtmac::wire::{self, Message, Rtmac};
use rtnet::clock::{EmulatedClock, True};
use rtnet::sim::{Aired, StationId};
use rtnet::time::{GlobalTime, Offset, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header};

use crate::traffic::DataFrame;

/// The schedule as the judge knows it, and the clock it is told on.
#[derive(Clone, Debug)]
pub struct Layout {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// The Synchronisation's share of it.
    pub sync_window: Span,
    /// From a slot's begin to its end.
    pub slot: Span,
    /// How far a frame may leave its bounds.
    pub tolerance: Span,
    /// Begin of each station's slot.
    pub offsets: Vec<Span>,
    /// In every so many cycles that is used.
    pub periods: Vec<u32>,
    /// Each station's address.
    pub addresses: Vec<Address>,
    /// The master's clock.
    pub clock: EmulatedClock,
    /// From the master's clock to global time.
    pub epoch: Offset,
}

/// Which frame it was: whose, of which cycle's turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Author {
    /// Who sent it.
    pub from: StationId,
    /// In whose turn of which cycle.
    pub cycle: u32,
}

/// What kind of frame it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A Synchronisation.
    Sync,
    /// A calibration request of a station.
    Request(Address),
    /// A reply to one.
    Reply {
        /// To whom.
        to: Address,
        /// Who asked, under that address; `None`: nobody did so.
        asked_by: Option<StationId>,
        /// It is neither in the turn that was asked for nor in a slot of its sender's, or nobody has asked for it.
        astray: bool,
    },
    /// Data.
    Data,
}

/// A frame, and what it was.
pub type Frame = (Author, Kind);

/// A request that is not answered.
struct Asked {
    of: Address,
    by: StationId,
    xmit: u64,
    reply_cycle: u32,
    at: True,
}

/// What was seen.
pub struct Judge {
    layout: Layout,
    grid: Option<(u32, GlobalTime)>,
    last_sync: Option<u32>,
    requests: Vec<Asked>,
    on_air: Option<(Frame, True)>,
    /// Synchronisations.
    pub syncs: u64,
    /// Calibration requests and replies.
    pub calibration: u64,
    /// Replies that were late, in a slot of the master's own.
    pub late_replies: u64,
    /// Data frames of each station.
    pub data: Vec<u64>,
    /// Actual less scheduled instant of every data frame.
    pub slot_error: Spread,
    /// Actual less scheduled instant of every Synchronisation.
    pub sync_error: Spread,
    /// Frames that began while another was on the air: both.
    pub overlaps: Vec<(Author, Author)>,
    /// What kinds of frames those were, one for one.
    pub kinds: Vec<(Kind, Kind)>,
    /// Frames that were not wholly within their slot or window.
    pub out_of_slot: Vec<Author>,
    /// Everything that must not be, in words; at most a few.
    pub faults: Vec<String>,
}

/// Smallest, largest, and how many.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Spread {
    /// How many.
    pub n: u64,
    /// The smallest.
    pub min: Span,
    /// The largest.
    pub max: Span,
}

const MAX_FAULTS: usize = 20;

impl Judge {
    /// A judge who has seen nothing.
    pub fn new(layout: Layout) -> Self {
        Self {
            data: vec![0; layout.offsets.len()],
            layout,
            grid: None,
            last_sync: None,
            requests: Vec::new(),
            on_air: None,
            syncs: 0,
            calibration: 0,
            late_replies: 0,
            slot_error: Spread::default(),
            sync_error: Spread::default(),
            overlaps: Vec::new(),
            kinds: Vec::new(),
            out_of_slot: Vec::new(),
            faults: Vec::new(),
        }
    }

    /// Counts from 0 again.
    pub fn start_over(&mut self) {
        let fresh = Judge::new(self.layout.clone());
        let Judge { grid, last_sync, on_air, .. } = *self;
        *self = Judge { grid, last_sync, on_air, requests: core::mem::take(&mut self.requests), ..fresh };
    }

    /// A frame goes on the air.
    pub fn see(&mut self, aired: &Aired<'_>) {
        if wire::is_lethal(aired.bytes) {
            self.fault(format!("a lethal frame from station {}", aired.from));
        }
        let Some((header, _)) = Header::parse(aired.bytes) else { return };
        let frame = match header.ether_type() {
            EtherType::RTMAC => self.control(aired, header),
            _ => self.payload(aired).map(|author| (author, Kind::Data)),
        };
        let Some(frame) = frame else {
            return self.fault(format!("a frame of no known kind from station {}", aired.from));
        };
        if let Some((before, until)) = self.on_air
            && aired.at < until
        {
            self.overlaps.push((before.0, frame.0));
            self.kinds.push((before.1, frame.1));
        }
        if self.on_air.is_none_or(|(_, until)| until < aired.until) {
            self.on_air = Some((frame, aired.until));
        }
    }

    fn control(&mut self, aired: &Aired<'_>, header: &Header) -> Option<Frame> {
        let Ok(Rtmac::Tdma(message)) = wire::parse(aired.bytes) else { return None };
        let author = |cycle| Author { from: aired.from, cycle };
        match message {
            Message::Sync { cycle, sched, .. } => {
                self.sync(aired, cycle, sched);
                Some((author(cycle), Kind::Sync))
            }
            Message::Request { xmit, reply_cycle, .. } => {
                self.calibration += 1;
                self.requests.push(Asked {
                    of: header.source,
                    by: aired.from,
                    xmit,
                    reply_cycle,
                    at: aired.at,
                });
                let author = author(reply_cycle.wrapping_sub(1));
                self.check_slot(aired, author, header.source);
                Some((author, Kind::Request(header.source)))
            }
            Message::Reply { request_xmit, .. } => {
                self.calibration += 1;
                let to = header.destination;
                let asked =
                    self.requests.iter().position(|asked| (asked.of, asked.xmit) == (to, request_xmit));
                let Some(asked) = asked else {
                    self.fault(format!("a reply that {to} did not ask for"));
                    let cycle = self.last_sync.unwrap_or(0);
                    return Some((author(cycle), Kind::Reply { to, asked_by: None, astray: true }));
                };
                let asked = self.requests.swap_remove(asked);
                Some(self.reply(aired, header.source, &asked))
            }
        }
    }

    /// A reply is in the turn of the asker's slot that follows the request's, or, late, in a slot of its sender's own.
    fn reply(&mut self, aired: &Aired<'_>, source: Address, asked: &Asked) -> Frame {
        let &Layout { cycle, ref addresses, ref periods, .. } = &self.layout;
        let id = addresses.iter().position(|address| *address == asked.of);
        let every = cycle.nanos() * i64::from(id.map_or(1, |id| periods[id]));
        let gone = aired.at.wrapping_sub(asked.at) as i64;
        let is_next = (gone + every / 2).div_euclid(every) == 1;
        // A peer may have asked late, by a turn; and a cycle may have no sync to be known by.
        let is_asked_for = is_next || self.last_sync == Some(asked.reply_cycle);
        let in_time = is_asked_for && id.is_some_and(|id| self.is_in_slot(aired, id));
        let cycle = if in_time { asked.reply_cycle } else { self.last_sync.unwrap_or(asked.reply_cycle) };
        let author = Author { from: aired.from, cycle };
        let strays = self.out_of_slot.len();
        self.check_slot(aired, author, if in_time { asked.of } else { source });
        let astray = !in_time && self.out_of_slot.len() > strays;
        self.late_replies += u64::from(!in_time && !astray);
        (author, Kind::Reply { to: asked.of, asked_by: Some(asked.by), astray })
    }

    fn sync(&mut self, aired: &Aired<'_>, cycle: u32, sched: GlobalTime) {
        self.syncs += 1;
        if let Some((first, start)) = self.grid
            && start + self.layout.cycle * i64::from(cycle.wrapping_sub(first) as i32) != sched
        {
            self.fault(format!("cycle {cycle} is scheduled at {sched:?}, which is not on the grid"));
        }
        if self.last_sync.is_some_and(|last| cycle.wrapping_sub(last) as i32 <= 0) {
            self.fault(format!("cycle {cycle} after cycle {:?}", self.last_sync));
        }
        (self.grid, self.last_sync) = (Some((cycle, sched)), Some(cycle));
        self.sync_error.add(self.late(aired.at, sched));
        self.check_bounds(aired, Author { from: aired.from, cycle }, Span::ZERO, self.layout.sync_window);
    }

    fn payload(&mut self, aired: &Aired<'_>) -> Option<Author> {
        let DataFrame { station, cycle, scheduled, .. } = DataFrame::read(aired.bytes)?;
        let from = usize::from(station);
        let author = Author { from: aired.from, cycle };
        *self.data.get_mut(from)? += 1;
        if let Some((first, start)) = self.grid {
            let start = start + self.layout.cycle * i64::from(cycle.wrapping_sub(first) as i32);
            if (scheduled - start - self.layout.offsets[from]).abs() > Span::ZERO {
                self.fault(format!("station {from} scheduled cycle {cycle} for {:?}", scheduled - start));
            }
        }
        self.slot_error.add(self.late(aired.at, scheduled));
        self.check_slot(aired, author, self.layout.addresses[from]);
        Some(author)
    }

    /// Actual less scheduled, in true time.
    fn late(&self, at: True, scheduled: GlobalTime) -> Span {
        let scheduled = self.layout.clock.truth(self.layout.epoch.local(scheduled));
        Span::from_nanos(at.wrapping_sub(scheduled) as i64)
    }

    fn check_slot(&mut self, aired: &Aired<'_>, author: Author, of: Address) {
        let Layout { slot, offsets, addresses, .. } = &self.layout;
        match addresses.iter().position(|address| *address == of) {
            Some(id) => self.check_bounds(aired, author, offsets[id], *slot),
            None => self.out_of_slot.push(author),
        }
    }

    fn is_in_slot(&self, aired: &Aired<'_>, id: StationId) -> bool {
        self.is_within(aired, self.layout.offsets[id], self.layout.slot)
    }

    /// A frame has to be within `begin` and `length` of some cycle.
    fn check_bounds(&mut self, aired: &Aired<'_>, author: Author, begin: Span, length: Span) {
        if !self.is_within(aired, begin, length) {
            self.out_of_slot.push(author);
        }
    }

    fn is_within(&self, aired: &Aired<'_>, begin: Span, length: Span) -> bool {
        let Some((_, start)) = self.grid else { return false };
        let Layout { cycle, tolerance, clock, epoch, .. } = &self.layout;
        let half = cycle.nanos() / 2;
        let since = (epoch.global(clock.local(aired.at)) - (start + begin)).nanos();
        let early = Span::from_nanos((since + half).rem_euclid(cycle.nanos()) - half);
        let end = early + Span::from_nanos((aired.until - aired.at) as i64);
        early >= -*tolerance && end <= length + *tolerance
    }

    fn fault(&mut self, what: String) {
        if self.faults.len() < MAX_FAULTS {
            self.faults.push(what);
        }
    }
}

impl Spread {
    fn add(&mut self, span: Span) {
        let first = self.n == 0;
        self.min = if first { span } else { self.min.min(span) };
        self.max = if first { span } else { self.max.max(span) };
        self.n += 1;
    }
}
