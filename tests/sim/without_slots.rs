//! Stations that send at once: NoMAC, and none of RTmac at all.

use std::cell::RefCell;
use std::ops::RangeInclusive;
use std::rc::Rc;
use std::sync::{Arc, Mutex};

use rtmac::tdma::{DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, RoleConfig, SlaveConfig, Tdma, TdmaConfig};
use rtmac::token::wire::TOKEN;
use rtmac::wire::{self, Message, Rtmac};
use rtnet::buf::{Buf, Pool};
use rtnet::clock::EmulatedClock;
use rtnet::counters::Refusal;
use rtnet::discipline::{Claimed, Discipline, Opportunity, Outlet, SendError, Service};
use rtnet::queue::Priority;
use rtnet::sim::{Host, Medium, Member, Network};
use rtnet::station::Station;
use rtnet::time::{GlobalTime, Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, MIN_FRAME};
use tests::rings;
use tests::seeds;
use tests::traffic::of_a_lab;
use tools::station::access::{Access, AccessConfig, AccessStatus};
use tools::station::traffic::TrafficCounts;

const A: Address = Address([2, 0, 0, 0, 0, 0xa]);
const B: Address = Address([2, 0, 0, 0, 0, 0xb]);
/// Behind any clock's start.
const BEGIN: u64 = 10_000_000_000;
const SECOND: u64 = 1_000_000_000;

fn member(config: &AccessConfig, address: Address, service: Box<dyn Service>) -> Member<Access> {
    let clock = EmulatedClock { anchor: BEGIN, offset: Span::from_millis(700), drift_ppb: 40_000 };
    let station = Station::new(Access::new(config, address).unwrap(), vec![service]);
    Member { address, clock, host: Host::VIRTUAL_MACHINE.into(), station }
}

fn sent(network: &Network<Access>, id: usize) -> u64 {
    let status = network.member(id).station.discipline().status();
    match status {
        AccessStatus::AtOnce(_, of) => assert_eq!((of.send_failed, of.lethal), (0, 0)),
        AccessStatus::Token(of) => assert_eq!(of.counters.send_failed, 0),
        AccessStatus::Tdma(_) => panic!("it has slots"),
    }
    status.frames_sent()
}

#[test]
fn two_stations_without_slots_exchange_a_second_of_frames_and_lose_none() {
    for config in [AccessConfig::NoMac, AccessConfig::Direct] {
        // One each millisecond; a tick that the host slept through has no frame.
        check_exchanged(&config, 900..=1001);
    }
}

#[test]
fn two_stations_in_a_ring_exchange_a_second_of_frames_and_lose_none() {
    // One in each round, of which none is shorter than both rest; a host that is late loses its turn.
    check_exchanged(&AccessConfig::Token(rings::quick(vec![A, B])), 1_000..=10_000);
}

fn check_exchanged(config: &AccessConfig, expected: RangeInclusive<u64>) {
    let mut network = Network::new(Medium::default(), seeds::one("without_slots"));
    let counts: [Arc<TrafficCounts>; 2] = Default::default();
    for (id, (from, to)) in [(A, B), (B, A)].into_iter().enumerate() {
        let traffic = of_a_lab((id as u16, from), to, 1 - id as u16, counts[id].clone());
        network.add(member(config, from, Box::new(traffic)), BEGIN + id as u64 * 300_000);
    }
    network.run_until(BEGIN + SECOND);
    // Frames under way arrive, within 100 ms also where a host stands still.
    let has_all = |network: &Network<Access>, id: usize| {
        let (arrived, sent) = (counts[id].arrived(None), sent(network, 1 - id));
        assert!(arrived.received <= sent, "{} of {sent}", arrived.received);
        arrived.received + arrived.missing + 1 >= sent
    };
    let have_all = (0..200).any(|_| {
        network.run_until(network.now() + 500_000);
        has_all(&network, 0) && has_all(&network, 1)
    });
    assert!(have_all, "not within 100 ms");
    for (id, counts) in counts.iter().enumerate() {
        let from_other = sent(&network, 1 - id);
        assert!(expected.contains(&from_other), "{from_other}");
        let (missing, dropped) = (counts.arrived(None).missing, network.dropped(id));
        assert!(
            missing <= dropped,
            "{missing}: the card of a host that stood still had no room for {dropped}"
        );
        let refusals = network.member(id).station.refusals();
        assert_eq!(refusals.total(), refusals.get(Refusal::TokenStale), "what is no loss of a frame");
    }
}

/// Says what it has to say once, and answers whatever comes.
struct Talk {
    says: Vec<Vec<u8>>,
    pool: Pool,
    refused: Arc<Mutex<Vec<SendError>>>,
}

impl Talk {
    fn new(says: Vec<Vec<u8>>) -> Self {
        Self { says, pool: Pool::new(8), refused: Arc::default() }
    }
}

impl Service for Talk {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::EXPERIMENTAL
    }

    fn on_frame(&mut self, _rx: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        self.says.push(ethernet(Address(frame[6..12].try_into().unwrap()), &frame[12..]));
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        for bytes in self.says.drain(..) {
            let mut frame = self.pool.take().unwrap();
            frame.fill(&bytes);
            if let Err((why, _)) = out(frame, Priority::NON_RT, slot.channel) {
                self.refused.lock().unwrap().push(why);
            }
        }
    }
}

/// A frame from B whose bytes from the EtherType on are these.
fn ethernet(to: Address, rest: &[u8]) -> Vec<u8> {
    let mut frame = [&to.0[..], &B.0, rest].concat();
    frame.resize(frame.len().max(MIN_FRAME), 0);
    frame
}

/// A NoMAC station B that says this from [`BEGIN`] on; what is on the air.
fn nomac_says(says: Vec<Vec<u8>>) -> (Network<Access>, Arc<Mutex<Vec<SendError>>>, Heard) {
    station_says(&AccessConfig::NoMac, says)
}

/// The same of one that shares the medium like this; tokens are not noted.
fn station_says(
    config: &AccessConfig,
    says: Vec<Vec<u8>>,
) -> (Network<Access>, Arc<Mutex<Vec<SendError>>>, Heard) {
    let talk = Talk::new(says);
    let refused = talk.refused.clone();
    let mut network = Network::new(Medium::default(), seeds::one("without_slots"));
    let talker = Member { host: Host::IDEAL.into(), ..member(config, B, Box::new(talk)) };
    network.add(talker, BEGIN);
    let heard = Heard::default();
    let noted = heard.clone();
    network.observe(move |aired| {
        if aired.bytes[12..14] != TOKEN.0.to_be_bytes() {
            noted.borrow_mut().push((aired.at, aired.bytes.to_vec()));
        }
    });
    (network, refused, heard)
}

/// A ring of one station.
fn ring_of_b() -> AccessConfig {
    AccessConfig::Token(rings::quick(vec![B]))
}

/// When each frame was on the air, and the frame.
type Heard = Rc<RefCell<Vec<(u64, Vec<u8>)>>>;

#[test]
fn a_frame_that_comes_is_answered_at_once() {
    let (mut network, _, heard) = nomac_says(Vec::new());
    // Between two of the times at which it looks by itself.
    network.run_until(BEGIN + 4_321_000);
    network.inject(&[&B.0, &A.0, &EtherType::EXPERIMENTAL.0.to_be_bytes()[..], &[7; 46]].concat());
    network.run_until(BEGIN + SECOND);
    let heard = heard.borrow();
    let [(asked, _), (answered, answer)] = &heard[..] else { panic!("{heard:?}") };
    assert!(answered - asked < 2_000, "{} ns later", answered - asked);
    assert_eq!(*answer, ethernet(A, &[&[0x88, 0xb5][..], &[7; 46]].concat()));
}

#[test]
fn what_a_nomac_station_tunnels_is_understood_by_a_tdma_station() {
    check_tunnels(&AccessConfig::NoMac);
}

#[test]
fn what_a_station_in_a_ring_tunnels_is_understood_by_a_tdma_station() {
    check_tunnels(&ring_of_b());
}

fn check_tunnels(config: &AccessConfig) {
    // An echo request as a VNIC tunnels it: the type is the inner EtherType, version 2, flag 1.
    let tunnelled = ethernet(A, &[&[0x90, 0x21, 0x08, 0x00, 2, 1][..], &[0x45; 60]].concat());
    let (mut network, refused, heard) = station_says(config, vec![tunnelled.clone()]);
    network.run_until(BEGIN + SECOND);
    assert!(refused.lock().unwrap().is_empty());
    let heard = heard.borrow();
    assert_eq!(heard.iter().map(|(_, frame)| frame).collect::<Vec<_>>(), [&tunnelled]);

    assert_eq!(wire::parse(&heard[0].1), Ok(Rtmac::Tunnel(EtherType(0x0800), &[0x45; 60])));
    let role = RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() });
    let (slots, max_slot_id) = (Vec::new(), DEFAULT_MAX_SLOT_ID);
    let (lead, late) = (DEFAULT_LEAD, LatePolicy::Skip);
    let mut tdma = Tdma::new(&TdmaConfig { address: A, role, slots, max_slot_id, lead, late }).unwrap();
    let mut frame = Pool::new(1).take().unwrap();
    frame.fill(&heard[0].1);
    let Claimed::Tunnel(frame) = tdma.on_frame(Some(Instant::from_nanos(BEGIN)), frame) else {
        panic!("it is a tunnelled frame");
    };
    assert_eq!(frame[..], tunnelled[..]);
}

#[test]
fn a_nomac_station_neither_sends_a_control_frame_nor_follows_one() {
    check_knows_no_master(&AccessConfig::NoMac);
}

#[test]
fn a_station_in_a_ring_neither_sends_a_control_frame_nor_follows_one() {
    check_knows_no_master(&ring_of_b());
}

fn check_knows_no_master(config: &AccessConfig) {
    let control = |kind: u8| ethernet(Address::BROADCAST, &[0x90, 0x21, 0, kind, 2, 0]);
    let (mut network, refused, heard) = station_says(config, [0, 1, 0x42].map(control).to_vec());
    network.run_until(BEGIN + SECOND);
    assert_eq!(*refused.lock().unwrap(), [SendError::Lethal; 3]);
    assert!(heard.borrow().is_empty());

    let time = GlobalTime::from_nanos(SECOND);
    let mut sync = Pool::new(1).take().unwrap();
    Message::Sync { cycle: 1, xmit: time, sched: time }.write(Address::BROADCAST, A, &mut sync);
    network.inject(&sync);
    network.inject(&control(0));
    network.run_until(BEGIN + 2 * SECOND);
    let refusals = network.member(0).station.refusals();
    assert_eq!((refusals.get(Refusal::OtherDiscipline), refusals.get(Refusal::NomacControl)), (1, 1));
    assert_eq!(heard.borrow().len(), 2, "what was injected, and nothing else");
}
