//! A slave that calibrates, and replies that are lies.

use proptest::prelude::*;
use rtmac::tdma::Tdma;
use rtmac::wire::Message;
use rtnet::buf::Pool;
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, SyncState};
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;
use tests::bench::Bench;

use super::{
    CYCLE, HOSTILE, MASTER, ROUNDS, SLAVE, Victim, cases, genuine_sync, is_test_traffic, message, moment,
    start, throw,
};

/// Where the slave's slot begins.
const SLOT: Span = Span::from_micros(400);

/// The stamp of the request that is outstanding when the hostile frame arrives: of the cycle before.
pub fn asked() -> Instant {
    start(HOSTILE - 1) + SLOT
}

fn reply(to: Address, request_xmit: u64, reception: u64, xmit: u64) -> Vec<u8> {
    let mut frame = Pool::new(1).take().expect("a new pool is full");
    Message::Reply { request_xmit, reception, xmit }.write(to, MASTER, &mut frame);
    frame.to_vec()
}

/// Whatever the round trip says beyond this is the master's own time.
fn awaited(delay: Span) -> Vec<u8> {
    let round_trip = moment() - asked();
    reply(SLAVE, asked().nanos(), 0, (round_trip - delay * 2).nanos() as u64)
}

fn refusals_after(frame: &[u8]) -> (u64, u64) {
    let mut bench = Victim::Calibrating.set_up();
    bench.frame(moment(), frame);
    let refusals = bench.station.refusals();
    (refusals.get(Refusal::UnexpectedReply), refusals.get(Refusal::ImplausibleReply))
}

#[test]
fn the_awaited_reply_is_accepted_so_that_forged_ones_would_be() {
    assert_eq!(refusals_after(&awaited(Span::from_nanos(700))), (0, 0));
    let mut bench = Victim::Calibrating.set_up();
    for delay in [700, 800] {
        bench.frame(moment(), &awaited(Span::from_nanos(delay)));
    }
    assert_eq!(bench.station.refusals().get(Refusal::UnexpectedReply), 1, "but once");
    assert_eq!(
        refusals_after(&reply(MASTER, asked().nanos(), 0, 0)),
        (1, 0),
        "nor what is for somebody else"
    );
}

#[test]
fn every_prefix_of_the_awaited_reply_and_every_one_byte_changed() {
    let undisturbed = Victim::Calibrating.undisturbed();
    let bytes = awaited(Span::from_nanos(700));
    for len in 0..=bytes.len() {
        throw(Victim::Calibrating, &undisturbed, &bytes[..len]);
    }
    for at in 0..bytes.len() {
        for change in 1..=u8::MAX {
            let mut bytes = bytes.clone();
            bytes[at] ^= change;
            throw(Victim::Calibrating, &undisturbed, &bytes);
        }
    }
}

#[test]
fn stamps_that_give_a_delay_beyond_the_cycle_are_refused() {
    for delay in [CYCLE + Span::from_nanos(1), -CYCLE - Span::from_nanos(1), Span::from_nanos(i64::MAX / 4)] {
        assert_eq!(refusals_after(&awaited(delay)), (0, 1), "{delay}");
    }
    for delay in [CYCLE, -CYCLE] {
        assert_eq!(refusals_after(&awaited(delay)), (0, 0), "{delay}: a slow path, for all it knows");
    }
    for (reception, xmit) in [(0, u64::MAX), (u64::MAX, 0), (u64::MAX / 2, 0), (0, u64::MAX / 2)] {
        refusals_after(&reply(SLAVE, asked().nanos(), reception, xmit));
    }
}

/// The slave's requests that were not answered yet, and when they left.
fn requests(bench: &Bench<Tdma>) -> impl Iterator<Item = (Instant, u64)> + '_ {
    bench.sent.iter().filter_map(|(at, sent)| match message(sent)? {
        Message::Request { xmit, .. } => Some((*at, xmit)),
        _ => None,
    })
}

/// Stamps of a reply: wild ones, and some that are nearly right.
fn lie() -> impl Strategy<Value = (u64, u64)> {
    let near = (0u64..1 << 40, -3_000_000i64..3_000_000);
    let near = near.prop_map(|(reception, more)| (reception, reception.wrapping_add_signed(more)));
    prop_oneof![any::<(u64, u64)>(), near]
}

proptest! {
    #![proptest_config(cases(2))]

    /// Every request is answered, and every answer is a lie: what is believed is at most a cycle, and the slave
    /// still sends at most once a cycle, in the order of the cycles, and nothing but requests before it is locked.
    #[test]
    fn a_slave_that_is_lied_to_in_every_round(lies in prop::collection::vec(lie(), 30)) {
        let mut bench = Victim::Calibrating.set_up();
        let mut answered = 0;
        for (cycle, (reception, xmit)) in (HOSTILE..).zip(lies) {
            genuine_sync(&mut bench, cycle);
            bench.advance(start(cycle) + SLOT);
            let last = requests(&bench).last();
            if let Some((_, request)) = last.filter(|(at, _)| *at == start(cycle - 1) + SLOT) {
                let before = bench.station.refusals().total();
                bench.frame(start(cycle) + SLOT + Span::from_micros(1), &reply(SLAVE, request, reception, xmit));
                answered += u32::from(bench.station.refusals().total() == before);
            }
            bench.advance(start(cycle + 1) - Span::from_micros(1));
        }
        let tdma = bench.station.discipline();
        prop_assert_eq!(tdma.status().delay.is_some(), answered == ROUNDS);
        prop_assert!(tdma.status().delay.is_none_or(|delay| delay.abs() <= CYCLE));
        let locked = tdma.status().delay.is_some();
        prop_assert!(locked || tdma.time().state == SyncState::Calibrating);
        prop_assert!(bench.sent.len() <= 31);
        let data = bench.sent.iter().position(|(_, sent)| is_test_traffic(sent)).unwrap_or(bench.sent.len());
        prop_assert!(locked || data == bench.sent.len(), "no data before it is calibrated");
        prop_assert!(bench.sent[data..].iter().all(|(_, sent)| is_test_traffic(sent)));
        prop_assert!(bench.sent[data..].windows(2).all(|two| two[1].0 - two[0].0 >= CYCLE * 9 / 10));
    }
}
