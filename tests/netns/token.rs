//! A ring of the token discipline on a real medium.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use rtmac::token::bound::recovery_bound;
use rtmac::token::wire::Token as Message;
use rtmac::token::{Ring, RingConfig, Token, TokenStatus};
use rtnet::live::clock::realtime;
use rtnet::live::ring::CaptureRing;
use rtnet::time::Span;
use rtnet::wire::ethernet::{EtherType, Header};
use tests::host::{alone, figure};

use crate::live::{Extras, Medium, Running, clock};

const STATIONS: u8 = 4;
/// The last two count what all send.
const COUNTS: [u8; 4] = [3, 3, 3, 2];
const VICTIM: usize = 1;
const FRAMES: u64 = 20;
const PATIENCE: Duration = Duration::from_secs(30);

/// For hosts that hold a station up for 20 ms while they run other tests.
fn ring() -> RingConfig {
    let ms = Span::from_millis;
    RingConfig {
        hold: ms(20),
        rest: ms(20),
        late: ms(20),
        delay: ms(5),
        invite_every: 4,
        ..RingConfig::new((0..STATIONS).map(Medium::address).collect())
    }
}

/// Whether the victim is to die, and when it has: CLOCK_REALTIME, as the kernel stamps frames.
static IS_TO_DIE: AtomicBool = AtomicBool::new(false);
static DIED: AtomicU64 = AtomicU64::new(0);

/// Right before `send`, so with the token: nobody else sends.
fn dies() {
    if IS_TO_DIE.load(Ordering::Relaxed) {
        DIED.store(realtime(), Ordering::Relaxed);
        // A panic that is meant prints nothing.
        std::panic::resume_unwind(Box::new("with the token"));
    }
}

fn start(medium: &mut Medium) -> Vec<Running<Token>> {
    let start = |(station, &to): (usize, &u8)| {
        let clock = clock(Span::from_millis(i64::from(to) * 70), 30_000);
        let hold = (station == VICTIM).then_some(dies as fn());
        let extras = Extras { hold, ..Extras::default() };
        medium.start_with(clock, to, extras, |address| Token::new(Ring::new(ring(), address).unwrap()))
    };
    COUNTS.iter().enumerate().map(start).collect()
}

/// The first frame, of those that the kernel saw from a moment on, of which something is found.
fn first<T>(observer: &mut CaptureRing, from: u64, find: impl Fn(&[u8]) -> Option<T>) -> (u64, T) {
    let (begun, mut found) = (Instant::now(), None);
    while found.is_none() {
        assert!(begun.elapsed() < PATIENCE, "no such frame");
        observer.wait(Duration::from_millis(100)).unwrap();
        observer.drain(|frame| {
            let at = frame.realtime_ns;
            if at >= from && found.is_none() {
                found = find(frame.bytes).map(|what| (at, what));
            }
        });
    }
    found.unwrap()
}

#[test]
fn ring_outlives_the_death_of_its_token_holder() {
    let test = "ring_outlives_the_death_of_its_token_holder";
    alone(test, || {
        IS_TO_DIE.store(false, Ordering::Relaxed);
        let mut medium = Medium::new();
        let mut stations = start(&mut medium);
        let all = |status: &TokenStatus| status.present == 0b1111 && status.visits > 10;
        stations.iter_mut().for_each(|station| {
            station.wait_until("all take part", all);
        });
        stations[3].wait_for_frames(FRAMES);

        let mut observer = medium.observe();
        IS_TO_DIE.store(true, Ordering::Relaxed);
        stations[VICTIM].wait_until_dead();
        let died = DIED.load(Ordering::Relaxed);
        let is_data = |frame: &[u8]| {
            let (header, _) = Header::parse(frame)?;
            (header.ether_type() == EtherType::EXPERIMENTAL).then_some(header.source)
        };
        let (sent, source) = first(&mut observer, died, is_data);
        assert_ne!(source, Medium::address(VICTIM as u8), "it is dead");
        let (took, bound) = (Span::from_nanos((sent - died) as i64), recovery_bound(&ring(), 1, 0));
        figure(test, &format!("{took} until others sent, bound {bound}"));
        assert!(took <= bound, "{took}, and no more than {bound}");

        let without = |frame: &[u8]| Message::parse(frame).ok().filter(|token| token.present == 0b1101);
        let (_, token) = first(&mut observer, died, without);
        assert_eq!(token.size, STATIONS);
        stations[2].wait_for_frames(FRAMES);
    });
}
