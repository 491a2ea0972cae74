//! Malformed, truncated and hostile frames: counted, never a panic, never a transmission.
//!
//! Each is thrown at a slave in each of its states, a master that listens and a master that is active, in the
//! scenario of the example frames, so that what they say is as plausible as can be. What the station then sends
//! is compared with what it sends without that frame.

mod calibration;
mod frames;
mod packages;
mod stack;
mod traffic;
mod tunnel;

use frames::hostile_frame;
use proptest::prelude::*;
use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MasterConfig, RoleConfig, SlaveConfig, SlotConfig, Tdma,
    TdmaConfig,
};
use rtmac::wire::{self, Message, Rtmac};
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, EventKind, SyncState};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header};
use tests::bench::Bench;
use tests::peer;
use tests::traffic::TestTraffic;
use tests::vectors;

const MASTER: Address = Address([2, 0, 0, 0, 0, 1]);
const SLAVE: Address = Address([2, 0, 0, 0, 0, 3]);
/// The sender of forged frames, which is no station of the network.
const FORGER: Address = Address([2, 0, 0, 0, 0, 0x66]);
const CYCLE: Span = Span::from_millis(1);
/// The hostile frame arrives in this cycle.
const HOSTILE: u32 = 100;
const LAST: u32 = 104;

/// When the hostile frame arrives.
fn moment() -> Instant {
    start(HOSTILE) + Span::from_micros(3)
}

/// Global time of a cycle's start in the scenario of the example frames; also the stations' own clock.
fn start(cycle: u32) -> Instant {
    Instant::from_nanos(1_000_000_000_000) + CYCLE * i64::from(cycle)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Victim {
    Waiting,
    /// It has asked once, and awaits the reply.
    Calibrating,
    Locked,
    /// One Synchronisation is missing so far; its cycle was bridged.
    Holdover,
    /// Three are.
    Lost,
    Listening,
    Active,
}

const VICTIMS: [Victim; 7] = [
    Victim::Waiting,
    Victim::Calibrating,
    Victim::Locked,
    Victim::Holdover,
    Victim::Lost,
    Victim::Listening,
    Victim::Active,
];
/// Calibration rounds of one that calibrates: more than one lie is needed.
const ROUNDS: u32 = 3;

type Sent = Vec<(Instant, Vec<u8>)>;

impl Victim {
    fn address(self) -> Address {
        if matches!(self, Victim::Listening | Victim::Active) { MASTER } else { SLAVE }
    }

    /// Cycles whose Synchronisations it has heard.
    fn heard(self) -> core::ops::Range<u32> {
        match self {
            Victim::Calibrating => HOSTILE - 2..HOSTILE,
            Victim::Locked => HOSTILE - 3..HOSTILE,
            Victim::Holdover => HOSTILE - 4..HOSTILE - 1,
            Victim::Lost => HOSTILE - 6..HOSTILE - 3,
            Victim::Waiting | Victim::Listening | Victim::Active => 0..0,
        }
    }

    /// Whether it goes on hearing its master.
    fn hears_on(self) -> bool {
        matches!(self, Victim::Calibrating | Victim::Locked)
    }

    /// The station just before the hostile frame, with a frame to send in every slot.
    fn set_up(self) -> Bench<Tdma> {
        let latest = Span::from_micros(50);
        let role = match self {
            Victim::Waiting | Victim::Locked | Victim::Holdover | Victim::Lost => {
                RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() })
            }
            Victim::Calibrating => {
                RoleConfig::Slave(SlaveConfig { rounds: ROUNDS, ..SlaveConfig::default() })
            }
            Victim::Listening | Victim::Active => RoleConfig::Master(MasterConfig {
                follow: SlaveConfig { rounds: 0, ..SlaveConfig::default() },
                ..MasterConfig::new(CYCLE, latest)
            }),
        };
        let offset = if self.address() == SLAVE { Span::from_micros(400) } else { Span::from_micros(200) };
        let tdma = Tdma::new(&TdmaConfig {
            address: self.address(),
            role,
            slots: vec![SlotConfig { id: 0, offset, phase: 0, period: 1, size: 64, joint: None, latest }],
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        });
        let traffic = TestTraffic::new(3, self.address(), Address::BROADCAST);
        let station = Station::new(tdma.expect("a sound configuration"), vec![Box::new(traffic)]);
        // A master's cycle 0 begins after three of silence.
        let begin = if self == Victim::Active { start(0) - CYCLE * 3 } else { start(HOSTILE - 1) };
        let mut bench = Bench::new(station, begin);
        self.heard().for_each(|cycle| genuine_sync(&mut bench, cycle));
        bench.advance(start(HOSTILE));
        bench.sent.clear();
        bench
    }

    /// What it does from then on.
    fn carry_on(self, bench: &mut Bench<Tdma>) {
        if self.hears_on() {
            (HOSTILE..=LAST).for_each(|cycle| genuine_sync(bench, cycle));
        }
        bench.advance(start(LAST + 1));
    }

    /// Whether a frame is of the one kind that this slave sends.
    fn may_send(self, frame: &[u8]) -> bool {
        match self {
            Victim::Calibrating => matches!(message(frame), Some(Message::Request { .. })),
            _ => is_test_traffic(frame),
        }
    }

    fn undisturbed(self) -> Sent {
        let mut bench = self.set_up();
        self.carry_on(&mut bench);
        bench.sent
    }
}

fn genuine_sync(bench: &mut Bench<Tdma>, cycle: u32) {
    let mut frame = Pool::new(1).take().expect("a new pool is full");
    let sched = GlobalTime::from_nanos(start(cycle).nanos());
    let late = Span::from_micros(5);
    Message::Sync { cycle, xmit: sched + late, sched }.write(Address::BROADCAST, MASTER, &mut frame);
    bench.frame(start(cycle) + late, &frame);
}

/// A well-formed message of TDMA, in the independent opinion of the peer; anything else has to be
/// refused whatever the station's state.
fn message(frame: &[u8]) -> Option<Message> {
    Header::parse(frame).filter(|(header, _)| header.ether_type() == EtherType::RTMAC)?;
    let parsed = match wire::parse(frame) {
        Ok(Rtmac::Tdma(message)) => Some(message),
        _ => None,
    };
    assert_eq!(parsed.is_some(), peer::understands(frame), "{frame:02x?}");
    parsed
}

fn is_test_traffic(frame: &[u8]) -> bool {
    Header::parse(frame).is_some_and(|(header, _)| header.ether_type() == EtherType::EXPERIMENTAL)
}

/// Runs `times` as many cases as proptest does by itself.
fn cases(times: u32) -> ProptestConfig {
    let own = ProptestConfig::default();
    ProptestConfig { cases: own.cases * times, failure_persistence: None, ..own }
}

fn throw(victim: Victim, undisturbed: &Sent, frame: &[u8]) {
    let mut bench = victim.set_up();
    let before = bench.station.refusals().total();
    bench.frame(moment(), frame);
    let refused = bench.station.refusals().total() - before;
    victim.carry_on(&mut bench);

    let what = || format!("{victim:?}: {frame:02x?}");
    assert!(refused <= 1, "counted once: {}", what());
    assert!(bench.sent.iter().all(|(_, sent)| !wire::is_lethal(sent)), "{}", what());
    let Some(message) = message(frame) else {
        assert!(refused == 1 || is_test_traffic(frame), "counted: {}", what());
        assert_eq!(bench.sent, *undisturbed, "{}", what());
        return;
    };
    let expected_replies = usize::from(victim == Victim::Active && refused == 0);
    let (replies, others): (Sent, Sent) = bench.sent.into_iter().partition(|(_, sent)| is_reply(sent));
    assert!(replies.len() <= expected_replies, "{}", what());
    check_replies(&replies, frame, message);
    let is_sync = matches!(message, Message::Sync { .. });
    match victim {
        Victim::Waiting => assert_eq!(others, [], "{}", what()),
        Victim::Active => assert_eq!(others, *undisturbed, "{}", what()),
        // A reply that it accepts is one sample of several, and no cause to send anything else.
        _ if !is_sync && victim != Victim::Listening => assert_eq!(others, *undisturbed, "{}", what()),
        // It makes way, or takes no notice.
        Victim::Listening => assert!(others.is_empty() || others == *undisturbed, "{}", what()),
        _ if refused == 1 => {
            assert!(others.iter().all(|sent| undisturbed.contains(sent)), "{}", what());
        }
        // A forged Synchronisation that looks like the master's may move a slave's slots a little. A slave that
        // hears no master follows it. That slave may send in three cycles: the Synchronisation's own, the one
        // before if its slot is still to come, and the one after, which is bridged.
        Victim::Calibrating | Victim::Locked => {
            assert!(others.len() <= undisturbed.len(), "{}", what());
            assert!(others.iter().all(|(_, sent)| victim.may_send(sent)), "{}", what());
        }
        Victim::Holdover | Victim::Lost => {
            assert!(others.len() <= undisturbed.len() + 3, "{}", what());
            assert!(others.iter().all(|(_, sent)| victim.may_send(sent)), "{}", what());
        }
    }
}

fn is_reply(frame: &[u8]) -> bool {
    matches!(message(frame), Some(Message::Reply { .. }))
}

/// A reply goes to who asked, when it was asked for.
fn check_replies(replies: &Sent, asked: &[u8], request: Message) {
    for (at, reply) in replies {
        let Message::Request { xmit, reply_cycle, reply_offset } = request else {
            panic!("a reply to {request:?}");
        };
        assert_eq!(reply[..6], asked[6..12]);
        assert_eq!(*at, start(reply_cycle) + Span::from_nanos(reply_offset as i64));
        assert!(matches!(message(reply), Some(Message::Reply { request_xmit, .. }) if request_xmit == xmit));
    }
}

#[test]
fn undisturbed_stations_do_what_the_comparison_takes_for_granted() {
    let cycles = (LAST - HOSTILE + 1) as usize;
    assert_eq!(Victim::Waiting.undisturbed(), []);
    assert_eq!(Victim::Locked.undisturbed().len(), cycles);
    // It has asked in the cycle before, and asks in every other one: between them it is silent for the reply.
    let asked = Victim::Calibrating.undisturbed();
    assert_eq!(asked.len(), cycles / 2);
    assert!(asked.iter().all(|(_, sent)| Victim::Calibrating.may_send(sent)));
    assert_eq!((Victim::Holdover.undisturbed(), Victim::Lost.undisturbed()), (vec![], vec![]));
    assert_eq!(Victim::Active.undisturbed().len(), 2 * cycles, "a Synchronisation and a frame each");
    assert!(!Victim::Listening.undisturbed().is_empty());
    let states = VICTIMS.map(|victim| victim.set_up().station.discipline().time().state);
    use SyncState::{Calibrating, Holdover, Locked, Lost, Waiting};
    assert_eq!(states, [Waiting, Calibrating, Locked, Holdover, Lost, Waiting, Locked]);
}

#[test]
fn the_example_request_is_answered_so_that_forged_ones_would_be() {
    let mut bench = Victim::Active.set_up();
    bench.frame(start(HOSTILE) + Span::from_micros(3), &vectors::vector(2).bytes);
    Victim::Active.carry_on(&mut bench);
    assert_eq!(bench.sent.iter().filter(|(_, sent)| is_reply(sent)).count(), 1);
}

#[test]
fn every_prefix_of_every_example_frame() {
    for victim in VICTIMS {
        let undisturbed = victim.undisturbed();
        for vector in vectors::all() {
            for len in 0..=vector.bytes.len() {
                throw(victim, &undisturbed, &vector.bytes[..len]);
            }
        }
    }
}

#[test]
fn every_example_frame_with_any_one_byte_changed() {
    for victim in VICTIMS {
        let undisturbed = victim.undisturbed();
        for vector in vectors::all() {
            for at in 0..vector.bytes.len() {
                for change in [0x01, 0x80, 0xff] {
                    let mut bytes = vector.bytes.clone();
                    bytes[at] ^= change;
                    throw(victim, &undisturbed, &bytes);
                }
            }
        }
    }
}

/// A Synchronisation received at [`moment`]: by it the cycle begins `later` than on the master's line, and the global time
/// is ahead by `global`.
fn forged_sync(from: Address, cycle: u32, later: Span, global: Span) -> Vec<u8> {
    let mut frame = Pool::new(1).take().expect("a new pool is full");
    let sched = GlobalTime::from_nanos(start(cycle).nanos()) + global;
    let xmit = GlobalTime::from_nanos(moment().nanos()) + global - later;
    Message::Sync { cycle, xmit, sched }.write(Address::BROADCAST, from, &mut frame);
    frame.to_vec()
}

/// Random frames seldom fit a slave's line: all cycles are tried, in steps of 30 us.
#[test]
fn forged_syncs_of_every_cycle_moment_and_global_time() {
    for victim in VICTIMS {
        let undisturbed = victim.undisturbed();
        for from in [MASTER, FORGER] {
            for cycle in HOSTILE - 3..=LAST {
                for later in (-1_050..=1_050).step_by(30).map(Span::from_micros) {
                    for global in [-700, 0, 20, 700].map(Span::from_micros) {
                        throw(victim, &undisturbed, &forged_sync(from, cycle, later, global));
                    }
                }
            }
        }
    }
}

#[test]
fn a_forged_sync_opens_three_cycles_at_most_to_a_lost_slave() {
    let mut bench = Victim::Lost.set_up();
    bench.frame(moment(), &forged_sync(FORGER, HOSTILE + 1, Span::ZERO, Span::ZERO));
    Victim::Lost.carry_on(&mut bench);
    let sent_in: Vec<i64> =
        bench.sent.iter().map(|(at, _)| (*at - start(0)).nanos() / CYCLE.nanos()).collect();
    assert_eq!(sent_in, [HOSTILE, HOSTILE + 1, HOSTILE + 2].map(i64::from));
    assert!(bench.sent.iter().all(|(_, sent)| Victim::Lost.may_send(sent)));
}

#[test]
fn every_version_but_the_one() {
    for victim in VICTIMS {
        let undisturbed = victim.undisturbed();
        for vector in &vectors::all()[..6] {
            let mut bytes = vector.bytes.clone();
            for version in (0..=u8::MAX).filter(|&version| version != wire::RTMAC_VERSION) {
                bytes[16] = version;
                throw(victim, &undisturbed, &bytes);
            }
            bytes[16] = wire::RTMAC_VERSION;
            for version in (0..=u16::MAX).step_by(0x00ff).filter(|&version| version != wire::TDMA_VERSION) {
                bytes[18..20].copy_from_slice(&version.to_be_bytes());
                throw(victim, &undisturbed, &bytes);
            }
        }
    }
}

#[test]
fn lying_lengths_of_what_is_tunnelled_are_nobodys_business() {
    for victim in VICTIMS {
        let undisturbed = victim.undisturbed();
        for (number, at) in [(7, 20), (10, 20), (15, 20), (48, 20), (51, 20)] {
            for length in [0u16, 1, 13, 1_500, 1_514, 0x7fff, u16::MAX] {
                let mut bytes = vectors::vector(number).bytes;
                bytes[at..at + 2].copy_from_slice(&length.to_be_bytes());
                throw(victim, &undisturbed, &bytes);
            }
        }
    }
}

#[test]
fn a_frame_whose_stamp_was_lost_is_counted_and_tells_nothing() {
    for victim in VICTIMS {
        let mut bench = victim.set_up();
        let pool = Pool::new(1);
        for vector in &vectors::all()[..6] {
            let before = (*bench.station.refusals(), bench.station.discipline().time());
            let mut frame = pool.take().expect("the last one came back");
            frame.fill(&vector.bytes);
            bench.station.on_frame(None, frame);
            assert_eq!(bench.station.refusals().get(Refusal::NoStamp), before.0.get(Refusal::NoStamp) + 1);
            assert_eq!(bench.station.discipline().time(), before.1);
        }
    }
}

proptest! {
    #![proptest_config(cases(2))]

    #[test]
    fn any_single_frame(frame in hostile_frame(), victim in prop::sample::select(&VICTIMS[..])) {
        throw(victim, &victim.undisturbed(), &frame);
    }

    #[test]
    fn any_stream_of_frames(
        stream in prop::collection::vec((hostile_frame(), 0i64..300_000), 1..60),
        victim in prop::sample::select(&VICTIMS[..]),
    ) {
        let mut bench = victim.set_up();
        let mut now = start(HOSTILE);
        for (frame, gap) in &stream {
            now += Span::from_nanos(*gap);
            bench.frame(now, frame);
        }
        bench.advance(now + CYCLE * 20);
        prop_assert!(bench.station.refusals().total() <= stream.len() as u64);
        prop_assert!(bench.sent.iter().all(|(_, sent)| !wire::is_lethal(sent)));

        let heard: Vec<Message> = stream.iter().filter_map(|(frame, _)| message(frame)).collect();
        let requests = heard.iter().filter(|heard| matches!(heard, Message::Request { .. })).count();
        let syncs = heard.iter().filter(|heard| matches!(heard, Message::Sync { .. })).count();
        let replies = bench.sent.iter().filter(|(_, sent)| is_reply(sent)).count();
        prop_assert!(replies <= requests);
        // A line takes two Synchronisations that agree.
        prop_assert!(victim != Victim::Waiting || syncs > 1 || bench.sent.is_empty());
        if victim == Victim::Active {
            let told = bench.sent.iter().filter_map(|(at, sent)| match message(sent)? {
                Message::Sync { cycle, sched, .. } => Some((*at, cycle, sched.nanos())),
                _ => None,
            });
            // Who is shouted down for ten cycles makes way, and begins anew when it hears nobody.
            let yielded = std::iter::from_fn(|| bench.station.discipline_mut().next_event())
                .any(|event| event.kind == EventKind::Yielded);
            let told = told.take_while(|(_, cycle, _)| !(yielded && *cycle == 1));
            for (i, (at, cycle, sched)) in told.enumerate() {
                prop_assert_eq!(cycle, HOSTILE + 1 + i as u32, "no number is left out or said twice");
                prop_assert_eq!((at, sched), (start(cycle), start(cycle).nanos()), "the grid does not move");
            }
        }
    }
}
