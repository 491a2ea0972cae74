//! What becomes of rounds as time goes on.

use super::*;

#[test]
fn a_slave_stays_settled_when_its_rounds_have_become_old() {
    let mut bench = Bench::new(1);
    for cycle in 1..100 {
        bench.hear(cycle, 0).unwrap();
    }
    hear_and_calibrate(&mut bench, 100..20 * 64, 0, 700);
    for windows in 20..700 {
        hear_all(&mut bench, windows * 64..(windows + 1) * 64);
        assert!(bench.slave.is_settled(), "after {windows} windows");
    }
}

#[test]
fn rounds_of_long_ago_are_forgotten_before_cycles_are_numbered_anew() {
    let mut bench = Bench::new(1);
    for cycle in 1..100 {
        bench.hear(cycle, 0).unwrap();
    }
    hear_and_calibrate(&mut bench, 100..20 * 64, 0, 700);
    assert!(bench.slave.calibration().done().is_some());
    hear_all(&mut bench, 20 * 64..(1 << 20) + 20 * 64);
    assert_eq!(bench.slave.calibration().done(), None);
    assert!(bench.slave.is_settled());
}
