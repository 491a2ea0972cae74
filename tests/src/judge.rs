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

/// What was seen.
pub struct Judge {
    layout: Layout,
    grid: Option<(u32, GlobalTime)>,
    last_sync: Option<u32>,
    requests: Vec<(Address, u64, u32)>,
    on_air: Option<(Author, True)>,
    /// Whose calibration that is of.
    calibrates: Option<Address>,
    /// Synchronisations.
    pub syncs: u64,
    /// Calibration requests and replies.
    pub calibration: u64,
    /// Data frames of each station.
    pub data: Vec<u64>,
    /// Actual less scheduled instant of every data frame.
    pub slot_error: Spread,
    /// Actual less scheduled instant of every Synchronisation.
    pub sync_error: Spread,
    /// Frames that began while another was on the air: both.
    pub overlaps: Vec<(Author, Author)>,
    /// Of them, a station's request with a reply to it, in its own slot.
    pub crossed: Vec<(Author, Author)>,
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
            calibrates: None,
            syncs: 0,
            calibration: 0,
            slot_error: Spread::default(),
            sync_error: Spread::default(),
            overlaps: Vec::new(),
            crossed: Vec::new(),
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
        let author = match header.ether_type() {
            EtherType::RTMAC => self.control(aired, header),
            _ => self.payload(aired),
        };
        let Some(author) = author else {
            return self.fault(format!("a frame of no known kind from station {}", aired.from));
        };
        let calibrates = match wire::parse(aired.bytes) {
            Ok(Rtmac::Tdma(Message::Request { .. })) => Some(header.source),
            Ok(Rtmac::Tdma(Message::Reply { .. })) => Some(header.destination),
            _ => None,
        };
        if let Some((before, until)) = self.on_air
            && aired.at < until
        {
            self.overlaps.push((before, author));
            if before.from != author.from && calibrates.is_some() && calibrates == self.calibrates {
                self.crossed.push((before, author));
            }
        }
        if self.on_air.is_none_or(|(_, until)| until < aired.until) {
            (self.on_air, self.calibrates) = (Some((author, aired.until)), calibrates);
        }
    }

    fn control(&mut self, aired: &Aired<'_>, header: &Header) -> Option<Author> {
        let Ok(Rtmac::Tdma(message)) = wire::parse(aired.bytes) else { return None };
        let cycle = match message {
            Message::Sync { cycle, sched, .. } => {
                self.sync(aired, cycle, sched);
                cycle
            }
            Message::Request { xmit, reply_cycle, .. } => {
                self.calibration += 1;
                self.requests.push((header.source, xmit, reply_cycle));
                let cycle = reply_cycle.wrapping_sub(1);
                self.check_slot(aired, Author { from: aired.from, cycle }, header.source);
                cycle
            }
            Message::Reply { request_xmit, .. } => {
                self.calibration += 1;
                let asked = self
                    .requests
                    .iter()
                    .position(|(of, xmit, _)| (*of, *xmit) == (header.destination, request_xmit));
                let Some(asked) = asked else {
                    self.fault(format!("a reply that {} did not ask for", header.destination));
                    return None;
                };
                let (_, _, cycle) = self.requests.swap_remove(asked);
                self.check_slot(aired, Author { from: aired.from, cycle }, header.destination);
                cycle
            }
        };
        Some(Author { from: aired.from, cycle })
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

    /// A frame has to be within `begin` and `length` of some cycle.
    fn check_bounds(&mut self, aired: &Aired<'_>, author: Author, begin: Span, length: Span) {
        let Some((_, start)) = self.grid else { return self.out_of_slot.push(author) };
        let Layout { cycle, tolerance, clock, epoch, .. } = &self.layout;
        let half = cycle.nanos() / 2;
        let since = (epoch.global(clock.local(aired.at)) - (start + begin)).nanos();
        let early = Span::from_nanos((since + half).rem_euclid(cycle.nanos()) - half);
        let end = early + Span::from_nanos((aired.until - aired.at) as i64);
        if early < -*tolerance || end > length + *tolerance {
            self.out_of_slot.push(author);
        }
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
