//! A host holds its station up while it has the token.

use rtmac::token::bound::{recovery_bound, rotation_bound};
use rtnet::time::Span;
use tests::rings::{Habits, Rings, clashes, config, longest_without_data};
use tests::seeds;

const STATIONS: usize = 4;
const MOMENTS: u64 = 200;

fn ring() -> Rings {
    Rings::running(config(STATIONS), |_| Habits { load: (2, 500), ..Habits::default() }, seeds::one("token"))
}

/// Holds station 1 up for so long at every moment of a round; tells how often it had lost its token.
fn held_up(span: Span) -> u64 {
    let config = config(STATIONS);
    let round = rotation_bound(&config, STATIONS, 0).nanos() as u64;
    let mut overdue = 0;
    for moment in 0..MOMENTS {
        let mut ring = ring();
        ring.runs_for(moment * round / MOMENTS);
        let begun = ring.network.now();
        ring.network.freeze(1, span);
        let until = begun + span.nanos() as u64 + 2 * recovery_bound(&config, 1, 1).nanos() as u64;
        ring.network.run_until(until + 4 * round);
        let aired = ring.aired();
        assert!(clashes(&aired).is_empty(), "{moment}: {:?}", clashes(&aired).first());
        let (longest, bound) = (longest_without_data(&aired, begun, until), recovery_bound(&config, 1, 1));
        assert!(longest <= bound.nanos() as u64, "{moment}: {longest} ns, and no more than {bound}");
        overdue += ring.counters(1).overdue;
        ring.runs_for(rtmac::token::bound::rejoin_bound(&config, 3, 1).nanos() as u64);
        assert_eq!([0, 1, 2, 3].map(|id| ring.present(id)), [0b1111; 4], "{moment}: all are back");
    }
    overdue
}

#[test]
fn a_holder_that_is_held_up_for_less_than_is_configured_loses_nothing() {
    assert_eq!(held_up(config(STATIONS).late), 0);
}

#[test]
fn a_holder_that_is_held_up_for_longer_sends_nothing_late_and_loses_its_token() {
    for span in [Span::from_millis(1), Span::from_millis(4), Span::from_millis(40)] {
        assert!(held_up(span) > 0, "{span}");
    }
}
