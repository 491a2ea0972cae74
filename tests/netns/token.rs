//! A ring of the token discipline on a real medium.

use std::time::{Duration, Instant};

use rtmac::token::bound::recovery_bound;
use rtmac::token::wire::{TOKEN, Token as Message};
use rtmac::token::{Ring, RingConfig, Token};
use rtnet::time::Span;
use tests::bare::Bare;

use crate::live::{Medium, Running, as_root, clock};

const STATIONS: u8 = 4;
/// The last two count what all send.
const COUNTS: [u8; 4] = [3, 3, 3, 2];
const VICTIM: u8 = 1;
const FRAMES: u64 = 20;
const PATIENCE: Duration = Duration::from_secs(30);

/// For hosts that hold a station up for 20 ms while they run other tests.
fn ring() -> RingConfig {
    let ms = Span::from_millis;
    RingConfig {
        hold: ms(20),
        // So long is whoever has it sure to have it.
        rest: ms(20),
        late: ms(20),
        delay: ms(5),
        invite_every: 4,
        ..RingConfig::new((0..STATIONS).map(Medium::address).collect())
    }
}

fn start(medium: &mut Medium) -> Vec<Running<Token>> {
    COUNTS
        .iter()
        .map(|&to| {
            let clock = clock(Span::from_millis(i64::from(to) * 70), 30_000);
            medium.start(clock, to, |address| Token::new(Ring::new(ring(), address).unwrap()))
        })
        .collect()
}

/// The next token that is heard of which this is true.
fn hears(listener: &Bare, mut is_it: impl FnMut(&Message) -> bool) -> Message {
    let (begun, mut frame) = (Instant::now(), [0; 1514]);
    loop {
        match listener.receive(&mut frame) {
            Some(len) => {
                let token = Message::parse(&frame[..len]).expect("stations send sound ones");
                if is_it(&token) {
                    return token;
                }
            }
            None => {
                assert!(begun.elapsed() < PATIENCE, "no such token");
                std::thread::sleep(Duration::from_micros(100));
            }
        }
    }
}

#[test]
fn a_ring_over_veth_outlives_its_holder_within_the_bound() {
    if !as_root("a_ring_over_veth_outlives_its_holder_within_the_bound") {
        return;
    }
    let mut medium = Medium::new();
    let mut stations = start(&mut medium);
    let (listener, _namespace) = medium.listen(TOKEN);
    let all = |status: &rtmac::token::TokenStatus| status.present == 0b1111 && status.visits > 10;
    stations.iter_mut().for_each(|station| {
        station.wait_until("all take part", all);
    });
    stations[3].wait_for_frames(FRAMES);

    hears(&listener, |token| token.to == VICTIM && token.from != VICTIM);
    // Its interface goes with it, which takes longer.
    let died = Instant::now();
    drop(stations.remove(VICTIM.into()));
    let received = |stations: &[Running<Token>]| stations[1].tally.received() + stations[2].tally.received();
    let (bound, before) = (recovery_bound(&ring(), 1, 0), received(&stations));
    while received(&stations) == before {
        assert!(died.elapsed() < PATIENCE, "nobody sends any more");
        std::thread::sleep(Duration::from_micros(100));
    }
    let took = died.elapsed();
    println!("FIGURE token_holder_dies_live: {} us until others sent, bound {bound}", took.as_micros());
    let time_out = ring().time_out();
    assert!(took.as_nanos() as i64 > time_out.nanos(), "{took:?}: the token has not died with it");
    assert!(took.as_nanos() as i64 <= bound.nanos(), "{took:?}, and no more than {bound}");
    let without = hears(&listener, |token| token.present == 0b1101);
    assert_eq!(without.size, STATIONS);
    stations[2].wait_for_frames(FRAMES);
}
