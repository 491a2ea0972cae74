//! The control thread's desk: what the real-time thread left is collected here, and requests are answered.

mod changes;
mod figures;
mod schedule;

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam::queue::ArrayQueue;
use nix::errno::Errno;
use nix::sys::eventfd::EventFd;
use package_router::tcp::client::TcpWatch;
use rtmac::tdma::{NON_RT_SLOT, RoleName, SlaveConfig, TdmaCommand};
use rtmac::token::RingConfig;
use rtnet::api::door::{Attached, Descriptors};
use rtnet::api::handshake::{Answer, Ask};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Cause, SyncState};
use rtnet::live::clock::{monotonic, realtime};
use rtnet::live::{Driver, Errands, NoSockets, Record, Snapshot, TimeBoard};
use rtnet::time::{GlobalTime, Offset, Span};
use rtnet::wire::ethernet::Address;

use super::access::{Access, AccessStatus, Refused};
use super::counts::{counters, of_port, shown};
use super::link::Standing;
use super::misses::Misses;
use super::programs::Programs;
use super::sockets::{Sockets, by_reason};
use super::traffic::TrafficCounts;
use super::vnic::Told;
use super::wire::{Change, LinkState, Wire};
use super::{Options, OwnSlots};
use crate::control::{
    Answers, ClockShown, CountersShown, EchoesShown, Envelope, InterfaceShown, Reply, Request, RingShown,
    StackReply, StackRequest, StationStatus, TcpShown, Traffic, read,
};
use crate::report::figures::GuardName;

pub(super) use changes::{ANSWER_WITHIN, LOOK_EVERY};

/// Why nothing can be told of a VNIC where none was wanted.
const NO_VNIC: &str = "it has no VNIC: start it with --vnic";
/// Why nothing can be told yet.
const NO_NEWS: &str = "the station has only just started: ask again";

/// What the control thread knows of a station, and how it reaches the real-time thread.
pub struct Desk {
    name: String,
    begun: Instant,
    address: String,
    wire: Wire,
    /// How long after its begin a slot may still be used, unless a lab says otherwise.
    latest: Span,
    /// How long before a slot its frame is chosen.
    lead: Span,
    /// How it follows, and answers, unless it is told otherwise.
    follow: SlaveConfig,
    /// The ring that it is in, if it is in one.
    ring: Option<RingConfig>,
    max_requests: usize,
    /// A single station's slots with every change that was carried out; a lab sees to its stations' itself.
    own_slots: Option<OwnSlots>,
    /// Which schedule those are of.
    schedule: u16,
    records: Arc<ArrayQueue<Record>>,
    snapshots: Arc<ArrayQueue<Snapshot<AccessStatus>>>,
    errands: Arc<Errands<TdmaCommand, Refused>>,
    sockets: Arc<Sockets>,
    programs: Option<Programs>,
    /// Its VNIC, or why it has none.
    vnic: Result<Told, String>,
    /// The TCP client of its packages, if it has one.
    tcp: Option<TcpWatch>,
    time: Arc<TimeBoard>,
    counts: Arc<TrafficCounts>,
    newest: Option<Snapshot<AccessStatus>>,
    /// Whether there is a newer one than was last asked for.
    news: bool,
    /// The state in the one that was last asked for.
    told: Option<SyncState>,
    host: Vec<String>,
    guard: GuardName,
    misses: Misses,
    /// Whether the process was continued after it had been stopped.
    continued: Arc<AtomicBool>,
    /// Whether it was so the last time.
    was_continued: bool,
}

impl Answers for Desk {
    fn answer(&mut self, packet: &[u8], traffic: Traffic) -> Vec<u8> {
        Desk::answer(self, packet, traffic)
    }

    fn ask(&mut self, ask: Ask, of: Option<&Attached>) -> (Answer, Option<(Attached, Descriptors)>) {
        let Self { programs, sockets, host, .. } = self;
        match programs {
            Some(programs) => {
                let answered = programs.ask(sockets, ask, of);
                host.extend(programs.news());
                answered
            }
            None => (Answer::refused(Errno::EOPNOTSUPP as i32), None),
        }
    }

    fn time(&self) -> Option<&TimeBoard> {
        Some(&self.time)
    }

    fn leave(&mut self, left: Attached) {
        if let Some(programs) = &mut self.programs {
            programs.leave(left);
        }
    }
}

impl Desk {
    pub fn new(
        options: &Options,
        driver: &Driver<Access>,
        address: Address,
        wire: Wire,
        counts: Arc<TrafficCounts>,
    ) -> Self {
        let lab = options.lab.as_ref();
        let named = options.name.as_ref().or(lab.map(|lab| &lab.name));
        Self {
            name: named.unwrap_or(&options.interface).clone(),
            begun: Instant::now(),
            address: address.to_string(),
            wire,
            latest: options.latest,
            lead: options.spin,
            follow: options.follow(),
            ring: options.access.ring().cloned(),
            max_requests: options.max_requests(),
            own_slots: options.own_slots.clone(),
            schedule: 0,
            records: driver.records(),
            snapshots: driver.snapshots(),
            errands: driver.errands(),
            sockets: Arc::new(Sockets::new(driver, options.stack.as_ref().map(|stack| stack.room()))),
            programs: None,
            vnic: Err(NO_VNIC.to_owned()),
            tcp: None,
            time: driver.time(),
            counts,
            newest: None,
            news: false,
            told: None,
            host: Vec::new(),
            guard: GuardName::User,
            misses: Misses::default(),
            continued: continued(),
            was_continued: false,
        }
    }

    /// The same with sockets for programs.
    pub fn with_programs(self, programs: Option<Programs>) -> Self {
        Self { programs, ..self }
    }

    /// Its way to the sockets, for another thread.
    pub fn sockets(&self) -> Arc<Sockets> {
        self.sockets.clone()
    }

    /// The same with a VNIC that was wanted, or with why there is none.
    pub fn with_vnic(self, wanted: Option<Result<Told, String>>) -> Self {
        Self { vnic: wanted.unwrap_or(self.vnic), ..self }
    }

    /// The same with a look at its TCP client, if it has one.
    pub fn with_tcp(self, tcp: Option<TcpWatch>) -> Self {
        Self { tcp, ..self }
    }

    /// Closes some of what programs have left.
    pub fn tidy(&mut self) {
        let Self { programs, sockets, .. } = self;
        if let Some(programs) = programs {
            programs.close_some(sockets);
        }
    }

    /// What the host refused, and whether it guards.
    pub fn note_host(&mut self, refused: &[String], is_guarded: bool) {
        (self.host, self.guard) = (refused.to_vec(), is_guarded.into());
    }

    /// Has a thread look at the interface so often, and write to `waker` when something has become of it.
    pub fn watch_wire(&mut self, every: Duration, waker: Arc<EventFd>) -> io::Result<()> {
        self.wire.look_every(every, waker)
    }

    /// What has become of the interface since the last time.
    pub fn look_at_wire(&mut self) -> Vec<Change> {
        self.wire.look()
    }

    /// Whether something has, since this was last asked.
    pub fn has_news_of_wire(&self) -> bool {
        self.wire.has_news()
    }

    /// Whether frames could pass at the last look.
    pub fn link(&self) -> LinkState {
        self.wire.state()
    }

    /// What was recorded since the last time.
    pub fn records(&mut self) -> Vec<Record> {
        let mut records: Vec<Record> = std::iter::from_fn(|| self.records.pop()).collect();
        // Of what was missed meanwhile some may be told only the next time.
        let now = self.continued.swap(false, Ordering::Relaxed);
        let before = std::mem::replace(&mut self.was_continued, now);
        if now || before {
            records.iter_mut().for_each(blame_who_stopped_it);
        }
        self.misses.note(&records);
        records
    }

    /// The newest snapshot, if there is one since the last time.
    pub fn news(&mut self) -> Option<Snapshot<AccessStatus>> {
        self.look();
        let news = self.newest.filter(|_| std::mem::take(&mut self.news));
        self.told = news.and_then(|news| news.status.state()).or(self.told);
        news
    }

    /// Whether the station's state is another than the last news told.
    pub fn has_another_state(&mut self) -> bool {
        self.look();
        self.newest.is_some_and(|newest| newest.status.state().is_some_and(|state| Some(state) != self.told))
    }

    fn look(&mut self) {
        if let Some(newest) = std::iter::from_fn(|| self.snapshots.pop()).last() {
            self.newest = Some(newest);
            self.news = true;
            self.vnic.iter().for_each(|vnic| vnic.follow(&newest.status));
            self.note_schedule();
        }
    }

    /// Answers a request.
    pub fn answer(&mut self, packet: &[u8], traffic: Traffic) -> Vec<u8> {
        let reply = match read(packet) {
            Err(why) => Reply::Refused(why),
            Ok(Request::Status) => self.status(traffic),
            Ok(Request::SetSlot(change)) => self.set_slot(&change),
            Ok(Request::RemoveSlot(id)) => {
                self.change(TdmaCommand::RemoveSlot(id), |own, _| Ok(own.without(id)))
            }
            Ok(Request::Become(role)) => match self.role(role) {
                Ok(new) => self.take_role(role, new),
                Err(refused) => Reply::Refused(refused.to_string()),
            },
            Ok(Request::Calibrate { rounds }) => self.calibrate(rounds),
            Ok(Request::Stack(request)) => {
                self.of_sockets(request).map_or_else(Reply::Refused, |reply| Reply::Stack(Box::new(reply)))
            }
            Ok(Request::Schedule(request)) => self.schedule(request),
            Ok(Request::Vnic(request)) => {
                let answered = self.vnic.clone().and_then(|vnic| vnic.answer(request));
                answered.map_or_else(Reply::Refused, |shown| Reply::Vnic(Box::new(shown)))
            }
        };
        Envelope::pack(reply)
    }

    /// What the stack says, and what is known here of what is below it.
    fn of_sockets(&mut self, request: StackRequest) -> Result<StackReply, String> {
        self.look();
        match request {
            StackRequest::Interface => {
                let (name, interface) = (self.name.clone(), self.wire.name().into());
                let newest = self.newest.as_ref().ok_or(NO_NEWS)?;
                let (link, mtu) = (self.link().name().into(), self.wire.mtu());
                let counters = of_port(&newest.port);
                let own = self.sockets.interface(&channels(newest))?;
                let (discipline, silent) = (newest.status.name().into(), silent(&newest.status));
                let shown =
                    InterfaceShown { name, interface, link, mtu, counters, discipline, silent, ..own };
                Ok(StackReply::Interface(Box::new(shown)))
            }
            StackRequest::Counters => {
                let own = self.counted()?;
                let newest = self.newest.as_ref().ok_or(NO_NEWS)?;
                Ok(StackReply::Counters(Box::new(self.with_those_below(own, newest))))
            }
            StackRequest::Pools => {
                let newest = self.newest.as_ref().ok_or(NO_NEWS)?;
                let mut pools = self.sockets.pools_below(newest.port.socket_full, newest.status.pool());
                if self.sockets.are_there() || self.vnic.is_err() {
                    pools.extend(self.sockets.pools()?);
                }
                pools.extend(self.vnic.iter().map(Told::pool));
                Ok(StackReply::Pools(pools))
            }
            StackRequest::Echo(echo) => {
                let Self { programs, time, .. } = self;
                let asked = with_sockets(programs)?.echoes.ask(echo, || time.now())?;
                Ok(StackReply::Asked(asked.nanos()))
            }
            StackRequest::Echoes(round) => {
                let silent = self.newest.as_ref().and_then(|newest| held_back(&newest.status));
                let news = with_sockets(&mut self.programs)?.echoes.of(round);
                Ok(StackReply::Echoes(EchoesShown { silent, ..news }))
            }
            other => self.sockets.answer(other),
        }
    }

    /// The counters above the discipline. Without sockets, a VNIC and a TCP client the error names what to start it with.
    fn counted(&self) -> Result<CountersShown, String> {
        let has_others = self.vnic.is_ok() || self.tcp.is_some();
        let own = match has_others && !self.sockets.are_there() {
            true => CountersShown::default(),
            false => self.sockets.counters()?,
        };
        Ok(self.with_those_beside(own))
    }

    /// The stack's counters, and those of the VNIC and the TCP client, if there are any.
    fn with_those_beside(&self, own: CountersShown) -> CountersShown {
        let vnic = self.vnic.as_ref().ok().map(Told::counted);
        CountersShown { vnic, tcp: self.tcp.as_ref().map(TcpShown::of), ..own }
    }

    /// The counters above the discipline, and those of the discipline, the port and refused frames.
    fn with_those_below(&self, above: CountersShown, newest: &Snapshot<AccessStatus>) -> CountersShown {
        let (mut station, refused) = (counters(&newest.status, &self.wire), by_reason(&newest.refusals));
        station.insert("stale".to_owned(), newest.stale);
        CountersShown { name: self.name.clone(), station, port: of_port(&newest.port), refused, ..above }
    }

    fn status(&mut self, traffic: Traffic) -> Reply {
        self.look();
        let Some(newest) = &self.newest else {
            return Reply::Refused(NO_NEWS.into());
        };
        let status = &newest.status;
        let tdma = status.tdma();
        Reply::Status(Box::new(StationStatus {
            name: self.name.clone(),
            pid: std::process::id(),
            interface: self.wire.name().into(),
            address: self.address.clone(),
            discipline: status.name().into(),
            role: tdma.map_or("none", |tdma| tdma.role.name()).into(),
            link: self.link().name().into(),
            guard: self.guard,
            mastery: tdma.and_then(|tdma| tdma.mastery).map(|mastery| mastery.name().into()),
            standing: Standing::of(newest, &self.counts, self.link()),
            names: BTreeMap::new(),
            period_ns: tdma.and_then(|tdma| tdma.period).map(Span::nanos),
            lead_ns: tdma.map(|_| self.lead.nanos()),
            global_ns: self.time.global_now().map(|(global, _)| global.nanos()),
            deviation_ns: tdma.map_or(0, |tdma| tdma.deviation.nanos()),
            drift_ppb: tdma.and_then(|tdma| tdma.drift_ppb),
            clock: tdma.map(ClockShown::from),
            ring: status.token().zip(self.ring.as_ref()).map(|(token, ring)| RingShown::of(token, ring)),
            slots: tdma.iter().flat_map(|tdma| tdma.slots.iter().flatten()).map(shown).collect(),
            counters: counters(status, &self.wire),
            host: self.host.clone(),
            misses: self.misses.clone(),
            control: traffic.named(),
        }))
    }
}

/// Those that may be of a slot: what is sent in 1 where that is none goes by slot 0. Without slots all are alike: the first.
fn channels(newest: &Snapshot<AccessStatus>) -> Vec<u8> {
    let Some(tdma) = newest.status.tdma() else { return vec![0] };
    // Not all may be in what is seen of it, but the lowest are.
    let has_non_rt = tdma.slots.iter().flatten().any(|slot| slot.config.id == NON_RT_SLOT);
    (0..=u8::MAX).filter(|&channel| channel != NON_RT_SLOT || has_non_rt).collect()
}

/// Why nothing of a station's leaves, whatever its slots take.
fn silent(status: &AccessStatus) -> Option<String> {
    let is_detached = status.tdma().is_some_and(|tdma| tdma.role == RoleName::Detached);
    let why = "it is detached, and silent until it is told to be slave or master again (`rtnet tdma slave`)";
    is_detached.then(|| why.into())
}

/// Why nothing of a station's leaves now, though it may a moment later.
fn held_back(status: &AccessStatus) -> Option<String> {
    let tdma = status.tdma()?;
    let state = tdma.state.name();
    let unsynchronised = |what| format!("it is not synchronised ({state}): {what} (`rtnet tdma status`)");
    silent(status).or_else(|| match tdma.state {
        SyncState::Calibrating => Some(unsynchronised("wait until it is locked, or see how far it is")),
        SyncState::Waiting | SyncState::Lost if tdma.role == RoleName::Slave => {
            Some(unsynchronised("start a master, or see whom it hears"))
        }
        SyncState::Waiting | SyncState::Lost => Some(unsynchronised("wait, or see how it goes on")),
        SyncState::Locked | SyncState::Holdover => {
            let has_none = tdma.slots.iter().flatten().next().is_none();
            has_none.then(|| "it has no slots: define one (`rtnet slot set`)".into())
        }
    })
}

/// Who was stopped was woken late, but by no timer.
fn blame_who_stopped_it(record: &mut Record) {
    if let Record::Event(_, Some(cause @ Cause::TimerLate)) = record {
        *cause = Cause::Preempted;
    }
}

/// A flag that is set when this process is continued.
fn continued() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    // Where the handler cannot be set, a station that was stopped only names another cause.
    let _ = signal_hook::flag::register(signal_hook::consts::SIGCONT, flag.clone());
    flag
}

/// Global time is the wall clock's once, at the start, and from then on the station's clock's.
pub fn epoch(clock: &EmulatedClock) -> Offset {
    Offset::between(clock.local(monotonic()), GlobalTime::from_nanos(realtime()))
}

/// Of a station that has some.
fn with_sockets(programs: &mut Option<Programs>) -> Result<&mut Programs, String> {
    programs.as_mut().ok_or_else(|| NoSockets.to_string())
}
