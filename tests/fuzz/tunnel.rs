//! A tunnel between two that lie: Linux sends any bytes of any length, and so does the medium, while slot 1 shrinks, grows,
//! goes and comes back.

use rtmac::tdma::{
    DEFAULT_LEAD, DEFAULT_MAX_SLOT_ID, LatePolicy, MIN_SIZE, MasterConfig, NON_RT_SLOT, RoleConfig,
    SlaveConfig, SlotConfig, Tdma, TdmaCommand, TdmaConfig,
};
use rtmac::wire::{self, Message, Rtmac};
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, Service, SyncState};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME, MTU};
use tests::bench::Bench;
use tests::vectors::vector;
use vnic::tunnel::{self, Config, FRAME, HEAD, Inner, Loss, Mouth, Tunnel};

use super::engine::{Target, fuzz, in_turn, outcome};
use super::frames;
use super::steps::{self, Step};

const CYCLE: Span = Span::from_millis(1);
const ADDRESS: Address = Address([2, 0, 0, 0, 0, 1]);
/// Turns that empty its queue: as many as it has buffers, and some.
const BUFFERS: usize = 8;
const LAST: u32 = 20;
/// Lengths that lie.
const LENGTHS: [usize; 8] = [0, 13, 14, 1_497, 1_510, 1_511, 1_515, usize::MAX];

#[test]
fn tunnel_takes_any_bytes() {
    fuzz(&Target { name: "tunnel", seeds: seeds(), has_corpus: true, mutate: steps::change, run });
}

fn start(cycle: u32) -> Instant {
    Instant::from_nanos(1_000_000_000_000) + CYCLE * i64::from(cycle)
}

fn slot(id: u8, size: usize) -> SlotConfig {
    let (offset, latest) = (Span::from_micros(200 + 200 * i64::from(id)), Span::from_micros(50));
    SlotConfig { id, offset, phase: 0, period: 1, size, joint: None, latest }
}

/// A master, its tunnel's mouth, and a tunnel of no station's.
struct Run {
    bench: Bench<Tdma>,
    mouth: Mouth,
    lone: (Tunnel, Mouth),
    foreign: Pool,
    cycle: u32,
    /// Of what Linux sent: what was taken, and what was refused.
    sent: [u64; 2],
    read: u64,
    heard: u64,
}

impl Run {
    fn new() -> Self {
        let (latest, follow) = (Span::from_micros(50), SlaveConfig { rounds: 0, ..SlaveConfig::default() });
        let tdma = Tdma::new(&TdmaConfig {
            address: ADDRESS,
            role: RoleConfig::Master(MasterConfig { follow, ..MasterConfig::new(CYCLE, latest) }),
            slots: vec![slot(0, MTU), slot(NON_RT_SLOT, MTU)],
            max_slot_id: DEFAULT_MAX_SLOT_ID,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        });
        let config = Config { buffers: BUFFERS, ..Config::of(ADDRESS) };
        let (tunnel, mouth) = tunnel::new(config);
        let station = Station::new(tdma.expect("a sound configuration"), vec![Box::new(tunnel)]);
        let mut bench = Bench::new(station, start(0) - CYCLE * 3);
        bench.advance(start(1));
        let (lone, foreign) = (tunnel::new(config), Pool::new(1));
        Self { bench, mouth, lone, foreign, cycle: 1, sent: [0; 2], read: 0, heard: 0 }
    }

    fn step(&mut self, step: &Step) -> u64 {
        let Step { kind, argument, bytes } = step;
        match kind % 8 {
            0 => self.send(FRAME, bytes, bytes.len(), false),
            1 => self.send(FRAME, bytes, LENGTHS[usize::from(*argument) % 8], false),
            2 => {
                let lies = argument & 1 == 1;
                let len = if lies { LENGTHS[usize::from(*argument) / 2 % 8] } else { bytes.len() };
                self.send(HEAD, bytes, len, true)
            }
            3 => self.hear(bytes),
            4 => {
                let mut bytes = bytes.clone();
                bytes.iter_mut().skip(12).zip([0x90, 0x21]).for_each(|(byte, of)| *byte = of);
                bytes.iter_mut().skip(16).zip([2, 1 | argument & 0xfe]).for_each(|(byte, of)| *byte = of);
                self.hear(&bytes)
            }
            5 => (0..*argument).map_while(|_| self.read()).count() as u64,
            6 => {
                self.next();
                1
            }
            _ => {
                let size = (MIN_SIZE + usize::from(*argument) * 6).min(MTU);
                let mut command = match argument {
                    0 => TdmaCommand::RemoveSlot(NON_RT_SLOT),
                    1..64 => TdmaCommand::set_slot(slot(0, size)),
                    _ => TdmaCommand::set_slot(slot(NON_RT_SLOT, size)),
                };
                self.bench.station.discipline_mut().command(start(self.cycle), &mut command).is_ok().into()
            }
        }
    }

    fn send(&mut self, at: usize, bytes: &[u8], len: usize, is_packet: bool) -> u64 {
        let Some(mut room) = self.mouth.take() else { return 0 };
        room.room_mut()[at..].iter_mut().zip(bytes).for_each(|(byte, of)| *byte = *of);
        let result = if is_packet {
            let to = Address(bytes.first_chunk().copied().unwrap_or_default());
            let kind = bytes.get(6..8).map_or(0, |kind| u16::from_be_bytes([kind[0], kind[1]]));
            self.mouth.send_packet(room, len, to, EtherType(kind))
        } else {
            self.mouth.send_frame(room, len)
        };
        self.sent[usize::from(result.is_err())] += 1;
        let payload = if is_packet { Some(len) } else { len.checked_sub(HEADER_LEN) };
        let fits = payload.is_some_and(|payload| payload <= self.mouth.mtu());
        assert_eq!(result.is_ok(), fits, "{len} bytes: {result:?}");
        result.map_or_else(|why| 2 + why as u64, |()| 1)
    }

    fn hear(&mut self, bytes: &[u8]) -> u64 {
        let lone = |frame: &mut Pool| {
            let mut buf = frame.take().expect("it came back");
            buf.fill(bytes);
            buf
        };
        let before = self.lone.1.counts().received;
        let result = self.lone.0.on_frame(None, lone(&mut self.foreign));
        assert_eq!(self.foreign.available(), 1, "what is kept was paid for");
        let is_whole = Inner::of(bytes).is_some();
        let room = before < BUFFERS as u64;
        assert_eq!(
            result.err(),
            (!is_whole).then_some(Refusal::Truncated).or((!room).then_some(Refusal::PoolEmpty))
        );

        let refused = self.bench.station.refusals().total();
        let received = self.mouth.counts().received;
        self.bench.frame(start(self.cycle) + Span::from_micros(10), bytes);
        self.heard += 1;
        let (refused, received) =
            (self.bench.station.refusals().total() - refused, self.mouth.counts().received - received);
        let is_tunnelled = matches!(wire::parse(bytes), Ok(Rtmac::Tunnel(..))) && is_rtmac(bytes);
        assert!(refused + received <= 1 && (refused + received == 1 || is_control(bytes)), "{bytes:02x?}");
        assert!(is_tunnelled || received == 0);
        2 * received + refused
    }

    fn read(&mut self) -> Option<()> {
        let frame = self.mouth.received()?;
        let inner = Inner::of(&frame).expect("it was looked at");
        let [addresses, kind, payload] = inner.pieces();
        assert_eq!(
            (addresses.len(), kind, payload),
            (12, &inner.kind().0.to_be_bytes()[..], inner.payload())
        );
        assert_eq!(payload.len() + HEAD, frame.len());
        self.read += 1;
        Some(())
    }

    fn next(&mut self) {
        self.cycle += 1;
        self.bench.advance(start(self.cycle));
    }

    /// All that was sent and received is counted once, and all that is not at home waits to leave or to be read.
    fn check(&self) {
        let (counts, [taken, refused]) = (self.mouth.counts(), self.sent);
        let lost: u64 = counts.losses().map(|(_, n)| n).sum();
        assert!(counts.losses().all(|(why, _)| [Loss::Short, Loss::TooLong].contains(&why)), "{counts:?}");
        let wait = (taken + refused).checked_sub(counts.sent + lost).expect("more than were sent");
        let unread = counts.received.checked_sub(self.read).expect("more than came");
        let home = self.mouth.pool().available() as u64;
        assert_eq!(home + wait + unread, BUFFERS as u64, "{counts:?}");
        assert!(counts.received + self.bench.station.refusals().total() <= self.heard);
        let is_ours = |(_, frame): &&(Instant, Vec<u8>)| is_rtmac(frame) && !is_control(frame);
        let aired: Vec<_> = self.bench.sent.iter().filter(is_ours).collect();
        assert_eq!(aired.len() as u64, counts.sent);
        for (_, frame) in &self.bench.sent {
            assert!(!wire::is_lethal(frame), "{frame:02x?}");
            assert!((MIN_FRAME..=HEADER_LEN + MTU).contains(&frame.len()), "{}", frame.len());
            assert_eq!((&frame[6..12], frame[16]), (&ADDRESS.0[..], 2));
        }
    }
}

fn is_rtmac(frame: &[u8]) -> bool {
    Header::parse(frame).is_some_and(|(header, _)| header.ether_type() == EtherType::RTMAC)
}

/// Whether it is TDMA's.
fn is_control(frame: &[u8]) -> bool {
    let is_message = |parsed| {
        matches!(
            parsed,
            Ok(Rtmac::Tdma(Message::Sync { .. } | Message::Request { .. } | Message::Reply { .. }))
        )
    };
    is_rtmac(frame) && is_message(wire::parse(frame))
}

fn run(input: &[u8]) -> Vec<u64> {
    let mut run = Run::new();
    let mut outcomes = Vec::new();
    for step in steps::read(input) {
        let came = run.step(&step);
        run.check();
        outcomes.push(outcome([u64::from(step.kind % 8), came]));
    }
    while run.read().is_some() {}
    (0..LAST).for_each(|_| run.next());
    run.check();
    let is_sending = run.bench.station.discipline().time().state == SyncState::Locked;
    assert!(!is_sending || run.mouth.pool().available() == BUFFERS, "what Linux sent has left");
    in_turn(&outcomes)
}

fn seeds() -> Vec<Vec<u8>> {
    let step = |kind, argument, bytes: &[u8]| Step { kind, argument, bytes: bytes.to_vec() };
    let (turn, reads) = (step(6, 0, &[]), step(5, 255, &[]));
    let inside: Vec<Vec<u8>> = [7, 8, 9]
        .map(|number| vector(number).bytes)
        .iter()
        .map(|bytes| [&bytes[..12], &bytes[14..16], &bytes[18..]].concat())
        .collect();
    let both = |bytes: &Vec<u8>| [step(0, 0, bytes), step(2, 0, &bytes[14..]), turn.clone(), turn.clone()];
    let mut all = vec![inside.iter().flat_map(both).collect::<Vec<_>>()];
    // Largest frames wait while their slot shrinks, is gone, and is back.
    let largest = step(1, 4, &inside[0]);
    let sizes = [100, 0, 255, 64, 63, 1]
        .map(|size| [largest.clone(), step(7, size, &[]), turn.clone(), turn.clone()]);
    all.push(sizes.concat());
    all.push((0..16).map(|length| step(length / 8 + 1, length, &inside[1])).collect());
    let heard = frames::all();
    let tunnelled = heard.iter().filter(|frame| matches!(wire::parse(frame), Ok(Rtmac::Tunnel(..)))).take(14);
    all.push(tunnelled.map(|frame| step(3, 0, frame)).chain([reads.clone()]).collect());
    all.extend(
        heard[..48]
            .chunks(12)
            .map(|some| some.iter().map(|frame| step(4, 0, frame)).chain([reads.clone()]).collect()),
    );
    all.iter().map(|steps| steps::write(steps)).collect()
}

#[test]
fn the_seeds_of_the_tunnel_go_through_it_in_both_directions() {
    let of = |place: usize| {
        let mut run = Run::new();
        for step in steps::read(&seeds()[place]) {
            run.step(&step);
        }
        run.check();
        (run.mouth.counts(), run.read)
    };
    let (sent, _) = of(0);
    assert_eq!((sent.sent, sent.losses().count()), (6, 0));
    // The largest that fits the slot of 646 bytes, and that of 430, waits while the slot is made smaller.
    assert!(of(1).0.lost(Loss::TooLong) > 0);
    let (heard, read) = of(3);
    assert_eq!((heard.received, read), (BUFFERS as u64, BUFFERS as u64));
}
