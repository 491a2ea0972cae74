//! The token discipline: its frame against a reader of its own, and a station of a ring that hears anything at any time.

use rtmac::token::wire::{Kind, TOKEN, Token as Message};
use rtmac::token::{Ring, RingConfig, Token};
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Claimed, Discipline, Sent, Transmission};
use rtnet::queue::Priority;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};

use super::engine::{Target, fuzz, outcome};
use super::steps::{self, Step};
use super::{frames, mutate};

const STATIONS: u8 = 4;
const OWN: u8 = 1;

fn address(place: u8) -> Address {
    Address([2, 0, 0, 0, 0, place + 1])
}

fn config() -> RingConfig {
    RingConfig::new((0..STATIONS).map(address).collect())
}

/// Tokens of the ring: some passes, a claim, and some with a station that is absent.
fn tokens() -> Vec<Vec<u8>> {
    let token = Message {
        kind: Kind::Pass,
        size: STATIONS,
        digest: config().digest(),
        generation: 1,
        sequence: 0,
        from: 0,
        to: OWN,
        since: 0,
        invite: 0,
        present: 0b1111,
    };
    let pool = Pool::new(1);
    let bytes = |token: Message| {
        let mut frame = pool.take().expect("there is one");
        token.write(address(token.from), &mut frame);
        frame.to_vec()
    };
    [
        token,
        Message { sequence: 1, from: 1, to: 2, ..token },
        Message { sequence: 2, from: 2, to: 3, since: 700, ..token },
        Message { sequence: 3, from: 3, to: 1, present: 0b1110, ..token },
        Message { kind: Kind::Claim, generation: 2, from: 3, to: 3, ..token },
    ]
    .map(bytes)
    .to_vec()
}

#[test]
fn a_token_takes_any_bytes() {
    let seeds = tokens().into_iter().chain(frames::all().into_iter().take(8)).collect();
    fuzz(&Target {
        name: "token",
        seeds,
        has_corpus: false,
        mutate: mutate::bytes,
        run: |bytes| vec![token(bytes)],
    });
}

fn token(bytes: &[u8]) -> u64 {
    let ours = Message::parse(bytes);
    assert_eq!(ours.as_ref().err().copied(), refused_by_another(bytes));
    match ours {
        Ok(token) => {
            let mut frame = Pool::new(1).take().expect("a new pool is full");
            token.write(Address(bytes[6..12].try_into().expect("six")), &mut frame);
            assert_eq!(frame[14..35], bytes[14..35], "written as it was read");
            assert_eq!(frame[36..44], bytes[36..44]);
            outcome([1, token.kind as u64, u64::from(token.present.count_ones())])
        }
        Err(reason) => outcome([0, reason as u64]),
    }
}

/// The table of the specification, read once more.
fn refused_by_another(bytes: &[u8]) -> Option<Refusal> {
    if bytes.len() < 14 {
        return Some(Refusal::Runt);
    }
    if bytes.len() < 44 {
        return Some(Refusal::Truncated);
    }
    if bytes[14..16] != [1, 0] {
        return Some(Refusal::TokenVersion);
    }
    if ![1, 2].contains(&bytes[16]) {
        return Some(Refusal::TokenKind);
    }
    let [size, from, to, invite] = [17, 30, 31, 34].map(|at| bytes[at]);
    let present: Vec<bool> = (0..64).map(|place| bytes[43 - place / 8] & (1 << (place % 8)) != 0).collect();
    let is_in = |place: u8| place < size;
    let is_there = |place: u8| present.get(usize::from(place)) == Some(&true);
    let is_sound = (1..=64).contains(&size)
        && [from, to, invite].into_iter().all(is_in)
        && present[usize::from(size.min(64))..].iter().all(|is_there| !is_there)
        && is_there(from)
        && is_there(to)
        && (bytes[16] == 1 || from == to);
    (!is_sound).then_some(Refusal::TokenFields)
}

#[test]
fn a_station_of_a_ring_takes_anything_at_any_time() {
    let step = |kind, argument, bytes: Vec<u8>| Step { kind, argument, bytes };
    let heard =
        tokens().into_iter().flat_map(|token| [step(0, 0, token), step(1, 1, vec![]), step(2, 0, vec![])]);
    let waits = (0..12).flat_map(|n| [step(3, 0, vec![]), step(2, n % 4, vec![])]);
    let seeds = vec![
        steps::write(&heard.collect::<Vec<_>>()),
        steps::write(&waits.collect::<Vec<_>>()),
        steps::write(&[step(1, 9, vec![]), step(0, 0, tokens()[0].clone()), step(2, 1, vec![])]),
    ];
    fuzz(&Target { name: "token_station", seeds, has_corpus: false, mutate: steps::change, run: station });
}

/// Steps: 0 a frame is heard, 1 a frame is queued, 2 it is awake and sends, 3 it waits for its deadline.
fn station(input: &[u8]) -> Vec<u64> {
    let (pool, mut now) = (Pool::new(64), Instant::from_nanos(10_000_000_000));
    let mut token = Token::new(Ring::new(config(), address(OWN)).expect("it is one"));
    let visit = config().visit();
    let mut outcomes = Vec::new();
    token.on_timeout(now);
    for Step { kind, argument, bytes } in steps::read(input) {
        match kind % 4 {
            0 => {
                let Some(mut frame) = pool.take() else { continue };
                frame.fill(&bytes);
                let Some((header, _)) = Header::parse(&frame) else { continue };
                if !token.claims(header) {
                    continue;
                }
                let stamp = (argument < 200).then(|| now - Span::from_micros(i64::from(argument)));
                outcomes.push(match token.on_frame(stamp, frame) {
                    Claimed::Kept => outcome([10]),
                    Claimed::Tunnel(_) => outcome([11]),
                    Claimed::Refused(why) => outcome([12, why as u64]),
                });
            }
            1 => {
                let Some(mut frame) = pool.take() else { continue };
                frame.fill(&[argument; MIN_FRAME]);
                frame[12..14].copy_from_slice(&EtherType::EXPERIMENTAL.0.to_be_bytes());
                let priority = Priority::new(argument % 32).expect("a level");
                token.enqueue(frame, priority, 0).expect("it may leave");
            }
            kind => {
                now = match (kind, token.next_deadline()) {
                    (3, Some(deadline)) => deadline.max(now),
                    _ => now + Span::from_micros(i64::from(argument)),
                };
                token.on_timeout(now);
                outcomes.extend(turn(&mut token, &mut now, argument, visit));
            }
        }
        outcomes.push(outcome([20, token.status().state as u64]));
        while token.next_event().is_some() {}
    }
    let tokens_out = token.status().pool;
    assert_eq!(tokens_out.free, tokens_out.capacity, "all tokens are at home");
    drop(token);
    assert_eq!(pool.available(), pool.capacity(), "and all frames");
    outcomes
}

/// Some turns of a loop, each of which ends.
fn turn(token: &mut Token, now: &mut Instant, argument: u8, visit: Span) -> Vec<u64> {
    let mut outcomes = Vec::new();
    for _ in 0..8 {
        let Some(chosen) = next_as_a_station_does(token, *now, &mut outcomes) else { return outcomes };
        assert!(chosen.at >= *now && chosen.latest <= *now + visit, "no later than the token may be here");
        let (header, _) = Header::parse(&chosen.frame).expect("it has one");
        let is_token = header.ether_type() == TOKEN;
        if is_token {
            let message = Message::parse(&chosen.frame).expect("it is sound");
            assert_eq!((message.from, header.source), (OWN, address(OWN)));
        }
        *now = if [2, 3].contains(&(argument % 5)) { *now + visit } else { chosen.at };
        let sent = match argument % 5 {
            0 | 1 => Sent::At(*now),
            2 => Sent::StalledUntil(*now),
            3 => Sent::Late(*now, chosen.frame),
            _ => Sent::Failed(100, chosen.frame),
        };
        outcomes.push(outcome([40, u64::from(is_token), u64::from(argument % 5)]));
        if let Some(returned) = token.on_sent(sent) {
            token.put_back(returned);
        }
        token.on_timeout(*now);
    }
    outcomes
}

fn next_as_a_station_does(token: &mut Token, now: Instant, outcomes: &mut Vec<u64>) -> Option<Transmission> {
    let mut asked = 0;
    while token.opportunity(now).is_some() {
        asked += 1;
        assert_eq!(asked, 1, "a turn without an end");
        outcomes.push(outcome([30]));
        let chosen = token.next_transmission(now);
        if chosen.is_some() {
            return chosen;
        }
    }
    token.next_transmission(now)
}
