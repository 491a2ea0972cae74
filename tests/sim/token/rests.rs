//! A ring that is idle: its stations keep the token for a while, and are asked for data meanwhile.

use rtmac::token::RingConfig;
use rtnet::buf::Pool;
use rtnet::time::Span;
use rtnet::wire::ethernet::MIN_FRAME;
use tests::rings::{Habits, Rings, clashes, config, data};
use tests::seeds;
use tests::stacks::address;

const STATIONS: usize = 4;
const REST: Span = Span::from_micros(200);

fn ring(frames: usize) -> Rings {
    let config = RingConfig { rest: REST, ..config(STATIONS) };
    Rings::running(config, |_| Habits { load: (frames, MIN_FRAME), ..Habits::default() }, seeds::one("token"))
}

#[test]
fn an_idle_ring_goes_round_no_faster_than_its_stations_rest() {
    for frames in [0, 1] {
        let mut ring = ring(frames);
        ring.runs_for(20_000_000);
        let passes: Vec<u64> =
            ring.aired().iter().filter(|seen| seen.token.is_some()).map(|seen| seen.at).collect();
        let rest = REST.nanos() as u64;
        assert!(passes.windows(2).all(|pair| pair[1] - pair[0] >= rest), "{frames} frames a visit");
        assert!(passes.len() as u64 >= 20_000_000 / (rest + 30_000), "{}", passes.len());
        assert_eq!((ring.sum(|c| c.claims), ring.sum(|c| c.repeats)), (1, 0));
    }
}

#[test]
fn a_frame_that_comes_while_a_station_rests_wakes_it_and_it_rests_on() {
    let mut ring = ring(0);
    let pool = Pool::new(1);
    for _ in 0..400 {
        ring.runs_for(7_777);
        let frame = data(pool.take().unwrap(), address(9), MIN_FRAME, 7);
        ring.network.inject(&frame);
    }
    ring.runs_for(1_000_000);
    assert_eq!((ring.sum(|c| c.claims), ring.sum(|c| c.repeats), ring.sum(|c| c.overdue)), (1, 0, 0));
}

#[test]
fn a_frame_that_is_queued_while_its_station_rests_leaves_in_that_visit() {
    let mut ring = ring(0);
    let pool = Pool::new(2);
    ring.runs_for(10_000_000);
    let token = ring.aired().iter().rev().find_map(|seen| seen.token.map(|token| (seen.at, token))).unwrap();
    let (passed, to) = (token.0, usize::from(token.1.to));
    ring.network.run_until(passed + 60_000);
    ring.queues_urgent(to, &pool, MIN_FRAME, 9);
    // A program would ring; here the next frame does.
    ring.network.inject(&data(pool.take().unwrap(), address(9), MIN_FRAME, 7));
    ring.take_aired();
    ring.runs_for(1_000_000);
    let aired = ring.aired();
    let sent = aired.iter().position(|seen| seen.mark == 9 && seen.is_data()).expect("it leaves");
    assert!(aired[..sent].iter().all(|seen| seen.token.is_none()), "before the token goes on");
    assert!(clashes(&aired).is_empty());
}
