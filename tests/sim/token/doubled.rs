//! There are two tokens.

use rtmac::token::bound::{doubling_bound, recovery_bound};
use rtmac::token::wire::{Kind, Token as Message};
use rtnet::buf::Pool;
use tests::rings::{Habits, Rings, clashes, config, longest_without_data};
use tests::seeds;
use tests::stacks::address;

const STATIONS: usize = 4;
const MOMENTS: u64 = 200;

fn ring() -> Rings {
    Rings::running(config(STATIONS), |_| Habits { load: (4, 1514), ..Habits::default() }, seeds::one("token"))
}

/// The last token that was on the air.
fn last_token(ring: &Rings) -> Message {
    ring.aired().iter().rev().find_map(|seen| seen.token).expect("one goes round")
}

/// Has a station's interface send a token.
fn forges(ring: &mut Rings, token: &Message) {
    let mut frame = Pool::new(1).take().unwrap();
    token.write(address(token.from.into()), &mut frame);
    ring.network.babble(token.from.into(), &frame);
}

#[test]
fn a_second_token_that_does_not_stay_changes_nothing() {
    let mut ring = ring();
    ring.runs_for(20_000_000);
    let token = last_token(&ring);
    ring.take_aired();
    // Some passes ago, and of a claim before.
    for (generation, sequence) in [(token.generation, token.sequence - 2), (token.generation - 1, u32::MAX)] {
        let to = (token.from + 3) % STATIONS as u8;
        forges(&mut ring, &Message { generation, sequence, to, ..token });
        ring.runs_for(20_000_000);
    }
    let aired = ring.aired();
    let clashes: Vec<_> = clashes(&aired).into_iter().filter(|(a, b)| a.is_data() && b.is_data()).collect();
    assert!(clashes.is_empty(), "{:?}", clashes.first());
    assert_eq!((ring.sum(|c| c.given_up), ring.sum(|c| c.repeats), ring.sum(|c| c.claims)), (0, 0, 1));
    let stale = |id| {
        use rtnet::counters::Refusal;
        ring.network.member(id).station.refusals().get(Refusal::TokenStale)
    };
    assert_eq!((0..STATIONS).map(stale).sum::<u64>(), 2 * (STATIONS as u64 - 1));
}

#[test]
fn a_second_token_that_stays_makes_the_first_void_at_once_whenever_it_comes() {
    let config = config(STATIONS);
    let round = (config.visit() + config.delay).nanos() as u64 * STATIONS as u64;
    let mut given_up = 0;
    for moment in 0..MOMENTS {
        let mut ring = ring();
        ring.runs_for(20_000_000 + moment * round / MOMENTS);
        let token = last_token(&ring);
        let begun = ring.network.now();
        ring.take_aired();
        // By one that does not hold the first one, to another that does not.
        let (from, to) = ((token.to + 1) % STATIONS as u8, (token.to + 2) % STATIONS as u8);
        let sequence = token.sequence + 1_000;
        forges(&mut ring, &Message { kind: Kind::Pass, sequence, from, to, ..token });
        ring.runs_for(50_000_000);
        let aired = ring.aired();
        let last_clash = clashes(&aired).iter().map(|(_, second)| second.at).max().unwrap_or(begun);
        let bound = doubling_bound(&config, 0).nanos() as u64;
        assert!(last_clash <= begun + bound, "{moment}: {} ns behind it", last_clash - begun);
        given_up += ring.sum(|c| c.given_up);
        assert_eq!(ring.sum(|c| c.claims), 1, "{moment}");
    }
    assert!(given_up >= MOMENTS / 2, "mostly somebody held the first one: {given_up}");
}

#[test]
fn a_token_that_stays_and_that_nobody_has_is_claimed_within_the_bound() {
    let config = config(STATIONS);
    for from in 0..STATIONS as u8 {
        let mut ring = ring();
        ring.runs_for(20_000_000);
        let token = last_token(&ring);
        let begun = ring.network.now();
        let (generation, kind) = (token.generation + 5, Kind::Claim);
        forges(&mut ring, &Message { kind, generation, from, to: from, ..token });
        let bound = recovery_bound(&config, 1, 1).nanos() as u64;
        let until = begun + 2 * bound;
        ring.network.run_until(until + 10_000_000);
        let longest = longest_without_data(&ring.aired(), begun, until);
        assert!(longest <= bound, "by {from}: {longest} ns, and no more than {bound}");
        assert!(last_token(&ring).generation >= token.generation + 5, "by {from}");
    }
}
