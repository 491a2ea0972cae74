//! A host that is slow for dozens of cycles delivers every Synchronisation late by about as much.

use rtnet::discipline::SyncState;
use rtnet::sim::Random;
use rtnet::time::Span;
use tests::networks::Plan;
use tests::seeds;
use tools::scenario::Uniform;

/// Upper bound of a slave's error.
const NEAR: Span = Span::from_micros(1);

#[test]
fn a_slow_host_moves_no_slave_out_of_its_slot() {
    seeds::each(5, |seed| {
        let mut random = Random::new(seed);
        let plan = Plan { tolerance: NEAR, ..Plan::of(&Uniform { seed, ..Plan::lab_options(4) }) };
        let mut lab = plan.build();
        lab.run_until_locked();
        lab.run_cycles(1_000);
        lab.judge_from_here();
        let usual = lab.network.medium_mut().propagation;
        for _ in 0..20 {
            // Less than a quarter of the cycle, for fewer cycles than a window has.
            let late = Span::from_nanos(random.between(10_000, 240_000));
            lab.network.medium_mut().propagation = late;
            lab.run_cycles(random.between(9, 62) as u64);
            lab.network.medium_mut().propagation = usual;
            lab.run_cycles(random.between(2, 200) as u64);
            for slave in 1..4 {
                assert_eq!(lab.state(slave), SyncState::Locked, "slave {slave} after {late}");
                let error = lab.line_error(slave).abs();
                assert!(error < NEAR, "slave {slave} after {late}: {error}");
            }
        }
        let judge = lab.judge();
        assert_eq!(judge.out_of_slot.first(), None, "and {} more", judge.out_of_slot.len());
        assert!(judge.overlaps.is_empty(), "{:?}", judge.overlaps);
    });
}
