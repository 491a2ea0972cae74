//! A ring in virtual time, from its begin to its end.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;
use std::sync::Arc;

use anyhow::{Result, anyhow, bail};
use rtmac::token::bound::rejoin_bound;
use rtmac::token::wire::TOKEN;
use rtmac::token::{Ring, Token, TokenStatus};
use rtnet::clock::True;
use rtnet::discipline::Discipline;
use rtnet::sim::{Aired, Loss, Network, StationId};
use rtnet::station::Station;
use rtnet::time::Span;

use super::figures::{self, Known, RingFigures};
use super::judge::Judge;
use super::verdict::{Observed, no_part};
use crate::judge::delivery::{Delivery, Heard, Meant};
use crate::report::capture::{Capture, CaptureFile};
use crate::report::host::HostFacts;
use crate::report::verdict::Interrupted;
use crate::scenario::{Act, Happening, Part, RingScenario, acts};
use crate::sim::world::{self, Counted, EPOCH, UPTIME};
use crate::sim::{Hurried, Options, faults};
use crate::station::link::PORT_POOL_EMPTY;
use crate::station::traffic::{Arrivals, Tag, TrafficCounts};

/// A station takes part once the token has come so often.
const VISITS: u32 = 3;
/// However slow a ring, nobody waits longer for it to come up.
const JOIN_AT_MOST: Span = Span::from_millis(3_600_000);
/// So long frames of the measurement may be on their way, in rounds.
const LINGER_ROUNDS: i64 = 4;

/// Runs a ring from its begin to its end.
pub fn run(scenario: &RingScenario, options: &Options) -> Result<RingFigures> {
    let mut run = Run::new(scenario, options)?;
    run.join()?;
    run.measure()?;
    run.end()
}

/// What is known of a run.
struct Watch {
    judge: Judge,
    capture: Capture,
    /// Test traffic that was lost on purpose, by receiver.
    meant: Vec<BTreeMap<Option<u8>, Meant>>,
    /// Who is stopped, and has no room for all that comes.
    stopped: Vec<bool>,
}

struct Run<'a> {
    scenario: &'a RingScenario,
    options: &'a Options,
    network: Network<Token>,
    counts: Vec<Arc<TrafficCounts>>,
    watch: Rc<RefCell<Watch>>,
    present: Vec<bool>,
    /// Which have been another process before, or were not there.
    anew: Vec<bool>,
    before: Vec<Counted>,
    /// When the measurement began, and ended.
    measured: (True, True),
    /// It was stopped before its time.
    interrupted: bool,
}

impl Watch {
    fn aired(&mut self, aired: &Aired<'_>) {
        let realtime = EPOCH.nanos() + (aired.at - UPTIME);
        self.capture.frame(realtime, aired.bytes, None);
        self.judge.frame(aired.at, aired.bytes);
    }

    fn lost(&mut self, now: True, to: StationId, frame: &[u8], why: Loss) {
        let is_token = frame.get(12..14) == Some(&TOKEN.0.to_be_bytes());
        if is_token {
            self.judge.happens(now, now);
        } else if let (true, Some((tag, _))) = (why.is_on_purpose() || self.stopped[to], Tag::read(frame)) {
            self.meant[to].entry(tag.priority()).or_default().note(tag.sequence());
        }
    }
}

impl<'a> Run<'a> {
    fn new(scenario: &'a RingScenario, options: &'a Options) -> Result<Self> {
        let plan = &scenario.network;
        let later: BTreeSet<&usize> =
            plan.conditions.events.iter().flat_map(|event| event.what.starts()).collect();
        let is_there = |id: usize| !later.contains(&id);
        let n = plan.stations.len();
        let counts: Vec<_> = (0..n).map(|id| world::traffic_counts(plan, id)).collect();
        let mut network = world::network(plan, is_there, |id| station(scenario, id, counts[id].clone(), 0))?;
        let clocks: Vec<_> = (0..n).map(|id| network.member(id).clock).collect();
        let watch = Watch {
            judge: Judge::new(scenario.ring.clone(), plan, &clocks),
            capture: Capture::of(options.pcap.as_deref().map(CaptureFile::replace).transpose()?),
            meant: vec![BTreeMap::new(); n],
            stopped: vec![false; n],
        };
        let watch = Rc::new(RefCell::new(watch));
        let (seen, told, lost) = (watch.clone(), watch.clone(), watch.clone());
        let latest = Rc::new(std::cell::Cell::new(UPTIME));
        let noted = latest.clone();
        network.observe(move |aired| {
            noted.set(aired.at);
            seen.borrow_mut().aired(aired);
        });
        network.attend(move |moment, member| {
            while let Some(event) = member.station.discipline_mut().next_event() {
                told.borrow_mut().judge.told(moment.id, event.kind);
            }
        });
        network.mourn(move |to, frame, why| lost.borrow_mut().lost(latest.get(), to, frame, why));
        Ok(Self {
            scenario,
            options,
            network,
            counts,
            watch,
            present: (0..n).map(is_there).collect(),
            anew: (0..n).map(|id| !is_there(id)).collect(),
            before: vec![Counted::default(); n],
            measured: (0, 0),
            interrupted: false,
        })
    }

    fn status(&self, id: usize) -> TokenStatus {
        self.network.member(id).station.discipline().status()
    }

    /// All that are there take part, as each of them knows.
    fn all_take_part(&self) -> bool {
        let there = (0..self.present.len()).filter(|&id| self.present[id]);
        let all: u64 = there.clone().map(|id| 1 << id).sum();
        there.map(|id| self.status(id)).all(|of| of.present & all == all && of.visits >= VISITS)
    }

    fn join(&mut self) -> Result<()> {
        let RingScenario { ring, network } = self.scenario;
        let n = network.stations.len();
        let silent = ring.silence() + ring.step() * n as i64;
        let allowed = silent + rejoin_bound(ring, n, n) + network.cycle * i64::from(VISITS + 10);
        let allowed = allowed.min(JOIN_AT_MOST);
        let deadline = UPTIME + allowed.nanos() as u64;
        while !self.all_take_part() {
            if self.options.is_stopped() {
                let there = (0..n).filter(|&id| self.present[id]);
                let here = there.clone().filter(|&id| self.status(id).visits >= VISITS).count();
                bail!(Interrupted(format!("{here} of {} stations took part", there.count())));
            }
            let next = self.network.now() + network.cycle.nanos() as u64;
            if let Some(until) = self.options.until
                && next > UPTIME + until.nanos() as u64
            {
                bail!(Hurried(format!("the stations did not all take part after {until}")));
            }
            if next > deadline {
                let takes_part = |id: &usize| !self.present[*id] || self.status(*id).visits >= VISITS;
                let late = (0..n).find(|id| !takes_part(id)).unwrap_or(0);
                bail!(
                    "station '{}' does not take part in the ring after {allowed}: its wire or its host does not let it; a longer \
                     token_late, or token_delay, gives a host more time",
                    network.stations[late].name
                );
            }
            self.network.run_until(next);
        }
        Ok(())
    }

    fn measure(&mut self) -> Result<()> {
        let plan = &self.scenario.network;
        let begin = self.network.now();
        let mut end = begin + plan.duration.nanos() as u64;
        let linger = plan.cycle.nanos() as u64 * LINGER_ROUNDS as u64;
        if let Some(until) = self.options.until {
            end = end.min((UPTIME + until.nanos() as u64).saturating_sub(linger));
        }
        if end <= begin {
            bail!(Hurried("there is no time to measure once all stations take part".into()));
        }
        self.watch.borrow_mut().judge.begin();
        self.bound_deliveries(Arrivals::count_from);
        self.network.start_over();
        self.before = (0..self.present.len()).map(|id| self.counted(id)).collect();
        for act in acts(&plan.conditions.events, begin).into_iter().take_while(|act| act.at <= end) {
            self.pass_until(act.at);
            if self.interrupted {
                break;
            }
            self.act(&act)?;
        }
        self.pass_until(end);
        end = end.min(self.network.now());
        self.watch.borrow_mut().judge.end();
        self.bound_deliveries(Arrivals::count_until);
        self.measured = (begin, end);
        // What was sent last is still on its way.
        self.network.run_until(end + linger);
        Ok(())
    }

    /// Lets time pass, unless the run is stopped.
    fn pass_until(&mut self, until: True) {
        while self.network.now() < until && !self.interrupted {
            let next = self.network.now() + self.scenario.network.cycle.nanos() as u64;
            self.network.run_until(next.min(until));
            self.interrupted = self.options.is_stopped();
        }
    }

    fn counted(&self, id: usize) -> Counted {
        let station = &self.network.member(id).station;
        Counted::of(station, &self.counts[id], self.status(id).counters.events_lost)
    }

    /// Of what comes to each station, what is sent from now on counts, or does not any more.
    fn bound_deliveries(&self, bound: fn(&Arrivals, u64)) {
        let (watch, plan) = (self.watch.borrow(), &self.scenario.network);
        for (id, counts) in self.counts.iter().enumerate() {
            let sender = plan.sender(id);
            for of in plan.streams(sender) {
                if let (Some(arrivals), Some(passed)) = (counts.arrivals(of), watch.judge.passed(sender, of))
                {
                    bound(arrivals, passed.next());
                }
            }
        }
    }

    /// Something happens, or is over.
    fn act(&mut self, act: &Act) -> Result<()> {
        let plan = &self.scenario.network;
        let what = &plan.conditions.events[act.event].what;
        if act.part == Part::Begin {
            let until = act.at + what.lasts().nanos() as u64;
            self.watch.borrow_mut().judge.happens(act.at, until);
        }
        match what {
            Happening::Kill(stations) => {
                for &id in stations {
                    self.network.stop(id);
                    (self.present[id], self.anew[id]) = (false, true);
                }
            }
            Happening::Restart(stations) | Happening::Start(stations) => {
                for &id in stations {
                    self.restart(id)?;
                }
            }
            Happening::Stop(stations, _) => {
                for &id in stations {
                    self.watch.borrow_mut().stopped[id] = act.part == Part::Begin;
                }
            }
            _ => {}
        }
        faults::act(&mut self.network, plan, what, act.part);
        if let Happening::Clock(stations, ..) = what {
            for &id in stations {
                let clock = self.network.member(id).clock;
                self.watch.borrow_mut().judge.set_clock(id, clock);
            }
        }
        Ok(())
    }

    /// A new process in the place of a station's.
    fn restart(&mut self, id: usize) -> Result<()> {
        (self.present[id], self.anew[id]) = (true, true);
        self.watch.borrow_mut().judge.begins_anew(id);
        let first = self.watch.borrow().judge.beyond(id);
        // What the process before has counted goes on from 0 in this one.
        self.before[id] = std::mem::take(&mut self.before[id]) - &self.counted(id);
        self.counts[id] = world::traffic_counts(&self.scenario.network, id);
        let station = station(self.scenario, id, self.counts[id].clone(), first)?;
        self.network.restart(id, station);
        Ok(())
    }

    fn end(mut self) -> Result<RingFigures> {
        let known: Vec<Known> = (0..self.present.len()).map(|id| self.known(id)).collect();
        let now = self.network.now();
        self.network.forget_watchers();
        let mut watch = Rc::into_inner(self.watch).expect("nobody watches any more").into_inner();
        watch.capture.finish();
        let (begin, end) = self.measured;
        let judged = watch.judge.finish(now);
        let capture_failed = watch.capture.failed().map(str::to_owned);
        let seen = Observed { capture_failed, interrupted: self.interrupted, ..Observed::default() };
        let host = HostFacts::of_virtual_time();
        let figures = figures::of(self.scenario, judged, &known, (begin, end - begin), &seen, host);
        Ok(RingFigures { seed: Some(self.scenario.network.seed), ..figures })
    }

    fn known(&self, id: usize) -> Known {
        let (plan, counts) = (&self.scenario.network, &self.counts[id]);
        let counted = self.counted(id) - &self.before[id];
        let refusals = self.network.member(id).station.refusals();
        let refusals = refusals.nonzero().map(|(why, n)| (why.name(), n));
        let no_room = Some((PORT_POOL_EMPTY, self.network.dropped(id))).filter(|&(_, n)| n > 0);
        let watch = self.watch.borrow();
        let delivery = |of| {
            let (numbers, others) = counts.counted(of);
            let heard = Heard::of(counts.arrived(of), self.anew[id]).within(numbers, others);
            (of, Delivery { heard, meant: watch.meant[id].get(&of).cloned().unwrap_or_default() })
        };
        // What a process that was ended would have heard since, nobody knows.
        let streams = plan.streams(plan.sender(id)).filter(|_| self.present[id]);
        let status = self.status(id);
        let takes_part = status.visits > 0;
        let name = &plan.stations[id].name;
        Known {
            state: if self.present[id] { status.state.name() } else { "down" }.into(),
            throughout: self.present[id] && !self.anew[id],
            deliveries: streams.map(delivery).collect(),
            payload_errors: counted.payload_errors.max(0) as u64,
            refusals: refusals.chain(no_room).map(|(why, n)| (why.to_owned(), n)).collect(),
            queue_refused: counted.refused().collect(),
            notes: Vec::new(),
            reproach: (self.present[id] && !takes_part).then(|| no_part(name)),
        }
    }
}

/// A station of the ring, with its test traffic, whose first frame has this number.
fn station(
    scenario: &RingScenario,
    id: usize,
    counts: Arc<TrafficCounts>,
    first: u64,
) -> Result<Station<Token>> {
    let plan = &scenario.network;
    let ring = Ring::new(scenario.ring.clone(), plan.address(id));
    let ring = ring.map_err(|why| anyhow!("station '{}': {why}", plan.stations[id].name))?;
    Ok(Station::new(Token::new(ring), vec![Box::new(world::traffic(plan, id, counts, first))]))
}
