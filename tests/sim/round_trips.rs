//! What an echo takes follows from the schedule: `schedule::round_trip`; and what a frame takes until it is sent: `worst_wait`.

use std::cell::Cell;
use std::rc::Rc;

use rtmac::tdma::schedule::{self, Rate, Slot, Wait};
use rtmac::tdma::{DEFAULT_LEAD, SlotConfig, Tdma};
use rtnet::clock::True;
use rtnet::sim::Network;
use rtnet::socket::Options;
use rtnet::time::Span;
use rtnet::wire::ethernet::{EtherType, Header, MTU};
use rtnet::wire::{icmpv4, ipv4};
use tests::stacks::{CYCLE, address, cycles, ip, settled, slot, stack};

/// On the medium and back.
const WAYS: [Span; 2] = [Span::from_nanos(500); 2];
/// How often both slots are used: the least common multiple of their periods is one of its parts.
const ALL: u64 = 12;

fn of_schedule(slot: SlotConfig) -> Slot {
    let SlotConfig { id, offset, phase, period, size, .. } = slot;
    Slot { owner: "a station".into(), id, offset, phase, period, size }
}

/// Station 1 asks station 0: how long that takes.
fn trip(network: &mut Network<Tdma>, sequence: u16) -> Span {
    let now = network.now();
    let member = network.member_mut(1);
    let asked = member.clock.local(now);
    let (stack, exit) = member.station.stack_mut().unwrap();
    stack.ask_echo(ip(0), (7, sequence), &[1; 8], Options::default(), exit).unwrap();
    cycles(network, 3 * ALL);
    let (stack, _) = network.member_mut(1).station.stack_mut().unwrap();
    let pong = stack.next_pong().expect("it is answered");
    assert_eq!((pong.sequence, stack.next_pong()), (sequence, None));
    pong.rx.expect("stamps are sound here") - asked
}

/// When station 1 has sent last.
fn last_sent(network: &mut Network<Tdma>) -> Rc<Cell<True>> {
    let last = Rc::<Cell<True>>::default();
    let noted = last.clone();
    network.observe(move |aired| {
        let Some((header, _)) = Header::parse(aired.bytes) else { return };
        if header.source == address(1) && header.ether_type() == EtherType::IPV4 {
            noted.set(aired.at);
        }
    });
    last
}

/// The least and the most that an echo takes that is asked for a nanosecond before each choice of a frame in [`ALL`] cycles,
/// and in the same one.
fn measured(asks: SlotConfig, answers: SlotConfig) -> Wait {
    let mut network =
        settled(vec![(vec![answers], stack(0, Vec::new())), (vec![asks], stack(1, Vec::new()))]);
    let last = last_sent(&mut network);
    trip(&mut network, 0);
    let chosen = last.get() - DEFAULT_LEAD.nanos() as u64;
    let (mut best, mut worst) = (CYCLE * 1_000, Span::ZERO);
    let turns = ALL / u64::from(asks.period);
    for turn in 0..2 * turns {
        // Of as many as there are, each as often as it takes for the one before to be answered.
        let cycle = (turn / 2) * u64::from(asks.period) + (turn + 1) * 4 * ALL;
        network.run_until(chosen + cycle * CYCLE.nanos() as u64 - turn % 2);
        let took = trip(&mut network, turn as u16 + 1);
        (best, worst) = (best.min(took), worst.max(took));
    }
    Wait { best, worst }
}

#[test]
fn the_best_and_the_worst_echo_take_what_the_schedule_says_to_the_nanosecond() {
    let every = |phase: u32, period: u32, micros: i64| SlotConfig { phase, period, ..slot(0, micros) };
    // Cycles of 1 ms, frames chosen 50 us before: by hand, in nanoseconds.
    let cases = [
        // The answer leaves 300 us later, in the same cycle; asked too late, the question waits a cycle more.
        (every(0, 1, 200), every(0, 1, 500), [350_500, 1_350_500]),
        // 40 us are too few for the answer's choice: it leaves a cycle later.
        (every(0, 1, 200), every(0, 1, 240), [1_090_500, 2_090_500]),
        // The answer's slot is before the question's.
        (every(0, 1, 500), every(0, 1, 200), [750_500, 1_750_500]),
        // Answers in every third cycle, questions in any: up to two cycles more.
        (every(0, 1, 200), every(1, 3, 500), [350_500, 3_350_500]),
        // Both in every fourth, the answer in the one before the question's: three cycles later.
        (every(2, 4, 200), every(1, 4, 500), [3_350_500, 7_350_500]),
        // Questions in every fourth cycle, answers in every sixth: one, three or five cycles later.
        (every(0, 4, 200), every(1, 6, 500), [1_350_500, 9_350_500]),
    ];
    for (asks, answers, by_hand) in cases {
        let [one, other] = [asks, answers].map(of_schedule);
        let said = schedule::round_trip(CYCLE, &one, &other, DEFAULT_LEAD, WAYS);
        assert_eq!([said.best, said.worst].map(Span::nanos), by_hand, "{asks:?} {answers:?}");
        let Wait { best, worst } = measured(asks, answers);
        assert_eq!(best - said.best, Span::from_nanos(1), "asked so long before: {asks:?} {answers:?}");
        assert_eq!(worst, said.worst, "asked in the instant of a choice: {asks:?} {answers:?}");
    }
}

/// The longest that a frame of full size takes from being handed over to its end: at moments all over as many cycles as anything
/// repeats in, and in the instant of each choice in them and a nanosecond before.
fn longest(slots: &[SlotConfig]) -> Span {
    let answers = (vec![slot(0, 800)], stack(0, Vec::new()));
    let mut network = settled(vec![answers, (slots.to_vec(), stack(1, Vec::new()))]);
    let (ended, begun) = (Rc::<Cell<True>>::default(), Rc::<Cell<True>>::default());
    let noted = (ended.clone(), begun.clone());
    network.observe(move |aired| {
        let Some((header, bytes)) = Header::parse(aired.bytes) else { return };
        match header.ether_type() {
            EtherType::IPV4 if header.source == address(1) => {
                assert_eq!(bytes.len(), MTU);
                noted.0.set(aired.until);
            }
            EtherType::RTMAC if header.source == address(0) => noted.1.set(aired.at),
            _ => {}
        }
    });
    cycles(&mut network, 1);
    let (cycle, begun) = (CYCLE.nanos() as u64, begun.get());
    let choices = slots.iter().flat_map(|slot| {
        let choice = begun + (slot.offset - DEFAULT_LEAD).nanos() as u64;
        (0..ALL).flat_map(move |cycles| [0, 1].map(|before| choice + cycles * cycle - before))
    });
    let others = (0..ALL * cycle).step_by(97_003).map(|after| begun + after);
    let mut longest = Span::ZERO;
    for (n, moment) in choices.chain(others).enumerate() {
        // Each in cycles of its own, and all of them in the same of those that repeat.
        let at = moment + (n as u64 + 1) * 3 * ALL * cycle;
        network.run_until(at);
        let (stack, exit) = network.member_mut(1).station.stack_mut().unwrap();
        let body = [1; MTU - ipv4::HEADER_LEN - icmpv4::HEADER_LEN];
        stack.ask_echo(ip(0), (7, n as u16), &body, Options::default(), exit).unwrap();
        cycles(&mut network, ALL);
        let (stack, _) = network.member_mut(1).station.stack_mut().unwrap();
        assert_eq!(stack.next_pong().map(|pong| pong.sequence), Some(n as u16));
        longest = longest.max(Span::from_nanos((ended.get() - at) as i64));
    }
    longest
}

#[test]
fn a_frame_is_sent_within_its_worst_wait_and_takes_as_long_when_it_comes_right_behind_a_choice() {
    let of = |id: u8, phase: u32, period: u32, micros: i64| SlotConfig { phase, period, ..slot(id, micros) };
    let joint = |slot: SlotConfig| SlotConfig { joint: Some(0), ..slot };
    // Cycles of 1 ms, frames chosen 50 us before, on the air for 12.304 us: by hand, in nanoseconds.
    let cases: [(&[SlotConfig], i64); 5] = [
        (&[of(0, 0, 1, 200)], 1_062_304),
        (&[of(0, 1, 3, 200)], 3_062_304),
        (&[of(0, 0, 1, 200), joint(of(2, 0, 1, 500))], 762_304),
        // At 0.2, 1.2, 1.6, 2.2 ms.
        (&[of(0, 0, 1, 200), joint(of(2, 1, 2, 600))], 1_062_304),
        // In cycles 0, 3, 6, 9 and 2, 6, 10, a little later: the longest time is from 3 to 6.
        (&[of(0, 0, 3, 200), joint(of(2, 2, 4, 600))], 3_062_304),
    ];
    let rate = Rate::from_bits_per_second(1_000_000_000);
    for (slots, by_hand) in cases {
        let serving: Vec<_> = slots.iter().copied().map(of_schedule).collect();
        let said = schedule::worst_wait(CYCLE, &serving, DEFAULT_LEAD, rate).unwrap();
        assert_eq!(said.nanos(), by_hand, "{slots:?}");
        assert_eq!(longest(slots), said, "{slots:?}");
    }
}
