//! A station's clock is set back: what it waited for is far away by then.

use rtnet::discipline::SyncState;
use rtnet::sim::Host;
use rtnet::time::Span;
use tests::networks::Plan;

/// As soon as a station looks at what has come, at the latest after its longest sleep of 100 ms, and has heard it twice.
#[test]
fn a_slave_whose_clock_is_set_back_is_locked_again_after_its_longest_sleep() {
    let mut lab = Plan::lab(3).on(Host::IDEAL).build();
    lab.run_until_locked();
    let clock = lab.clocks[1].stepped(Span::from_millis(-9_000));
    lab.clocks[1] = clock;
    lab.network.set_clock(1, clock);
    lab.run_cycles(110);
    assert_eq!(lab.state(1), SyncState::Locked);
    lab.judge_from_here();
    lab.run_cycles(100);
    assert_eq!(lab.judge().data[1], 100);
    assert!(lab.line_error(1).abs() < Span::from_micros(10), "{}", lab.line_error(1));
    assert_eq!(lab.judge().overlaps, []);
}
