//! Rings of the token discipline in virtual time, with what is on the air.

use std::cell::RefCell;
use std::rc::Rc;

use rtmac::tdma::schedule::Rate;
use rtmac::token::wire::{TOKEN, Token as Message};
use rtmac::token::{Ring, RingConfig, Token};
use rtnet::buf::{Buf, Pool};
use rtnet::clock::EmulatedClock;
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, Opportunity, Outlet, Service};
use rtnet::queue::Priority;
use rtnet::sim::{Host, Medium, Member, Network};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};

use crate::stacks::{BEGIN, address};

/// A ring whose stations send whenever they may.
pub struct Rings {
    /// Its stations, in the order of their places.
    pub network: Network<Token>,
    /// What they are configured with.
    pub config: RingConfig,
    aired: Rc<RefCell<Vec<Seen>>>,
}

/// A frame that was on the air.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// Who sent it.
    pub from: usize,
    /// When it began, in true time.
    pub at: u64,
    /// When the medium was free again.
    pub until: u64,
    /// The token, if it is one.
    pub token: Option<Message>,
    /// Its first byte of content: who queued it says more by that.
    pub mark: u8,
}

/// What a station of [`Rings`] is to have.
#[derive(Clone)]
pub struct Habits {
    /// How it does.
    pub host: Host,
    /// How fast its clock runs.
    pub drift_ppb: i64,
    /// Frames that it queues in each visit, each of so many bytes.
    pub load: (usize, usize),
}

/// Mark of frames that stations queue by themselves.
pub const LOAD: u8 = 1;

impl Default for Habits {
    fn default() -> Self {
        Self { host: Host::IDEAL, drift_ppb: 0, load: (1, MIN_FRAME) }
    }
}

/// Queues so many frames each time that the station holds the token.
struct Load {
    from: Address,
    frames: usize,
    len: usize,
    pool: Pool,
    asked: Option<u32>,
}

impl Service for Load {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::EXPERIMENTAL
    }

    fn on_frame(&mut self, _rx: Option<Instant>, _frame: Buf) -> Result<(), Refusal> {
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        if self.asked.replace(slot.cycle) == Some(slot.cycle) {
            return;
        }
        for _ in 0..self.frames {
            // What did not leave in the visit before has the buffers.
            let Some(frame) = self.pool.take() else { return };
            let _ = out(data(frame, self.from, self.len, LOAD), Priority::DEFAULT, 0);
        }
    }
}

/// Fills a frame of data to all.
pub fn data(mut frame: Buf, from: Address, len: usize, mark: u8) -> Buf {
    let mut bytes = [0; 1514];
    bytes[..6].copy_from_slice(&Address::BROADCAST.0);
    bytes[6..12].copy_from_slice(&from.0);
    bytes[12..14].copy_from_slice(&EtherType::EXPERIMENTAL.0.to_be_bytes());
    bytes[14] = mark;
    frame.fill(&bytes[..len]);
    frame
}

/// Of so many stations, times short enough that a test of many rounds is short: 100 Mbit/s, room for four of the longest
/// frames, no rest.
pub fn config(stations: usize) -> RingConfig {
    let config = RingConfig::new((0..stations).map(address).collect());
    let hold = config.rate.air_time(1514) * 4;
    let (late, delay) = (Span::from_micros(50), Span::from_micros(10));
    RingConfig { hold, late, delay, rest: Span::ZERO, invite_every: 4, ..config }
}

/// A station by itself of a ring of these, on a medium of 1 Gbit/s: it rests long enough for others to be heard.
pub fn in_a_ring(id: usize, of: &[usize]) -> Token {
    let config = quick(of.iter().map(|&id| address(id)).collect());
    Token::new(Ring::new(config, address(id)).expect("it is one"))
}

/// What that is configured with.
pub fn quick(stations: Vec<Address>) -> RingConfig {
    let us = Span::from_micros;
    RingConfig {
        rate: Rate::from_bits_per_second(1_000_000_000),
        hold: us(200),
        rest: us(50),
        late: us(50),
        delay: us(20),
        ..RingConfig::new(stations)
    }
}

/// A station of a ring.
pub fn station(config: &RingConfig, id: usize, load: (usize, usize)) -> Station<Token> {
    let token = Token::new(Ring::new(config.clone(), address(id)).expect("it is one"));
    let (frames, len) = load;
    let load = Load { from: address(id), frames, len, pool: Pool::new(frames.max(1)), asked: None };
    Station::new(token, vec![Box::new(load)])
}

impl Rings {
    /// A ring with these habits, all of whose stations begin at once.
    pub fn new(config: RingConfig, habits: impl Fn(usize) -> Habits, seed: u64) -> Self {
        let propagation = config.delay;
        let rate = config.rate.bits_per_second();
        let mut network = Network::new(Medium { rate, propagation, ..Medium::default() }, seed);
        network.run_until(BEGIN);
        for id in 0..config.stations.len() {
            let Habits { host, drift_ppb, load } = habits(id);
            let clock = EmulatedClock { anchor: BEGIN, offset: Span::from_millis(id as i64 * 77), drift_ppb };
            let station = station(&config, id, load);
            network.add(Member { address: address(id), clock, host: host.into(), station }, BEGIN);
        }
        let aired = Rc::<RefCell<Vec<Seen>>>::default();
        let noted = aired.clone();
        network.observe(move |frame| {
            let header = Header::parse(frame.bytes).map(|(header, _)| header.ether_type());
            let token = (header == Some(TOKEN)).then(|| Message::parse(frame.bytes).expect("it is sound"));
            let (from, at, until) = (frame.from, frame.at, frame.until);
            noted.borrow_mut().push(Seen { from, at, until, token, mark: frame.bytes[14] });
        });
        Self { network, config, aired }
    }

    /// The same that has been running for a while.
    pub fn running(config: RingConfig, habits: impl Fn(usize) -> Habits, seed: u64) -> Self {
        let settles = (config.silence() + config.step() * 64).nanos() as u64;
        let mut ring = Self::new(config, habits, seed);
        ring.runs_for(settles);
        ring.aired.borrow_mut().clear();
        ring
    }

    /// Lets so many nanoseconds pass.
    pub fn runs_for(&mut self, nanos: u64) {
        self.network.run_until(self.network.now() + nanos);
    }

    /// What was on the air so far.
    pub fn aired(&self) -> Vec<Seen> {
        self.aired.borrow().clone()
    }

    /// What was on the air so far, and is forgotten.
    pub fn take_aired(&self) -> Vec<Seen> {
        self.aired.take()
    }

    /// What a station counts.
    pub fn counters(&self, id: usize) -> rtmac::token::Counters {
        self.network.member(id).station.discipline().status().counters
    }

    /// Who takes part, as a station knows.
    pub fn present(&self, id: usize) -> u64 {
        self.network.member(id).station.discipline().status().present
    }

    /// The sum of something that all stations count.
    pub fn sum(&self, of: impl Fn(&rtmac::token::Counters) -> u64) -> u64 {
        (0..self.config.stations.len()).map(|id| of(&self.counters(id))).sum()
    }

    /// Puts a frame with this mark into a station's queue now, before all others.
    pub fn queues_urgent(&mut self, id: usize, pool: &Pool, len: usize, mark: u8) {
        let frame = data(pool.take().expect("there is one"), address(id), len, mark);
        let token = self.network.member_mut(id).station.discipline_mut();
        token.enqueue(frame, Priority::FIRST, 0).expect("it may leave");
    }

    /// A station that is dead begins anew.
    pub fn restarts(&mut self, id: usize, load: (usize, usize)) {
        let station = station(&self.config, id, load);
        self.network.restart(id, station);
    }
}

impl Seen {
    /// Whether it is data.
    pub fn is_data(&self) -> bool {
        self.token.is_none()
    }
}

/// Pairs of frames of different stations that were on the air at once, one of them of data: when.
pub fn clashes(aired: &[Seen]) -> Vec<(Seen, Seen)> {
    let mut clashes = Vec::new();
    let mut latest: Option<Seen> = None;
    for &frame in aired {
        if let Some(before) = latest.filter(|before| before.until > frame.at && before.from != frame.from)
            && (before.is_data() || frame.is_data())
        {
            clashes.push((before, frame));
        }
        if latest.is_none_or(|before| frame.until > before.until) {
            latest = Some(frame);
        }
    }
    clashes
}

/// The longest time within the span during which no data was begun.
pub fn longest_without_data(aired: &[Seen], from: u64, to: u64) -> u64 {
    let begins = aired.iter().filter(|frame| frame.is_data()).map(|frame| frame.at);
    let mut last = from;
    let mut longest = 0;
    for at in begins.filter(|at| (from..=to).contains(at)).chain([to]) {
        longest = longest.max(at - last);
        last = at;
    }
    longest
}
