use super::*;

const FAST: Rate = Rate::from_bits_per_second(100_000_000);

fn slot(owner: &str, offset: i64, phase: u32, period: u32) -> Slot {
    Slot { owner: owner.into(), id: 0, offset: Span::from_micros(offset), phase, period, size: 86 }
}

fn schedule(slots: Vec<Slot>) -> Schedule {
    let (cycle, sync_window) = (Span::from_millis(1), Span::from_micros(50));
    Schedule { cycle, sync_window, rate: FAST, guard: Span::from_micros(20), backups: Vec::new(), slots }
}

#[test]
fn air_time_counts_24_bytes_more_and_at_least_60() {
    assert_eq!(FAST.air_time(100).nanos(), 9_920);
    assert_eq!(FAST.air_time(1), FAST.air_time(60));
    assert_eq!(FAST.air_time(1514).nanos(), 123_040);
    assert_eq!(Rate::from_bits_per_second(3_000_000_000).air_time(60).nanos(), 224);
}

#[test]
fn neighbours_that_touch_do_not_overlap() {
    let end = 100_000 + 9_920 + 20_000;
    let touching = Slot { offset: Span::from_nanos(end), ..slot("b", 0, 0, 1) };
    assert_eq!(schedule(vec![slot("a", 100, 0, 1), touching.clone()]).conflicts(), []);
    let closer = Slot { offset: Span::from_nanos(end - 1), ..touching };
    let found = schedule(vec![closer, slot("a", 100, 0, 1)]).conflicts();
    assert_eq!(found.len(), 1);
    assert_eq!(
        found[0].to_string(),
        "slot 0 of a and slot 0 of b overlap: 100us + frame 9.92us + guard band 20us = 129.92us, but b \
         begins at 129.919us"
    );
}

#[test]
fn slots_share_a_time_when_their_phases_never_meet() {
    let shared = |pa, na, pb, nb| schedule(vec![slot("a", 100, pa, na), slot("b", 100, pb, nb)]).conflicts();
    assert_eq!(shared(0, 2, 1, 2), []);
    assert_eq!(shared(0, 2, 1, 4), []);
    assert_eq!(shared(0, 2, 1, 3).len(), 1, "0 mod 2 and 1 mod 3 meet in cycle 4");
    assert_eq!(shared(0, 2, 2, 4).len(), 1);
}

#[test]
fn a_slot_in_the_sync_window_or_beyond_the_cycle_is_a_conflict() {
    assert!(matches!(schedule(vec![slot("a", 49, 0, 1)]).conflicts()[..], [Conflict::InSyncWindow { .. }]));
    assert_eq!(schedule(vec![slot("a", 970, 0, 1)]).conflicts(), []);
    assert!(matches!(schedule(vec![slot("a", 971, 0, 1)]).conflicts()[..], [Conflict::BeyondCycle { .. }]));
}

#[test]
fn a_cycle_too_short_prints_the_sum() {
    let (cycle, window) = (Span::from_micros(100), Span::from_micros(50));
    let length = divide(cycle, window, FAST, 5, 86, None).unwrap();
    assert_eq!(length, Span::from_micros(10));
    let refused = divide(cycle, window, FAST, 6, 86, None).unwrap_err();
    assert!(
        refused.to_string().contains("50us + 6 x (frame 9.92us + guard band 0ns) = 109.52us"),
        "{refused}"
    );
}

#[test]
fn utilisation_is_the_share_of_time_on_the_air() {
    let with_one = schedule(vec![slot("a", 100, 0, 2)]).utilisation();
    assert!((with_one - (6_720.0 + 9_920.0 / 2.0) / 1e6).abs() < 1e-9);
}

#[test]
fn clocks_have_ten_microseconds_at_either_end_or_a_part_of_what_is_shorter_or_longer() {
    let shares =
        [(8, 20, 5), (8, 40, 10), (8, 118, 10), (8, 120, 10), (8, 240, 20), (32, 200, 40), (32, 100, 25)];
    for (stations, guard, share) in shares {
        let [guard, share] = [guard, share].map(Span::from_micros);
        let found = (clock_share(guard, stations), latest(guard, stations));
        assert_eq!(found, (share, guard - share * 2), "{stations} stations, {guard}");
    }
    assert_eq!((clock_share(Span::ZERO, 8), latest(Span::ZERO, 8)), (Span::ZERO, Span::ZERO));
}

#[test]
fn the_guard_band_covers_drift_over_the_bridged_cycle() {
    let of = Uncertainty {
        drift_ppb: 100_000,
        cycle: Span::from_millis(1),
        holdover: 1,
        lateness: Span::from_micros(3),
        stamp_error: Span::ZERO,
    };
    // 100 ppm over two cycles and the calibration's half, for either neighbour.
    assert_eq!(guard_band(of).nanos(), 2 * (250 + 2) + 3_000);
}

#[test]
fn backups_look_one_after_the_other_and_slots_are_behind_all_of_them() {
    let of = |backups: &[(&str, i64)], slot_at: i64| {
        let backups = backups.iter().map(|&(name, at)| (name.to_owned(), Span::from_micros(at))).collect();
        let found = Schedule { backups, ..schedule(vec![slot("a", slot_at, 0, 1)]) }.conflicts();
        found.iter().map(Conflict::to_string).collect::<Vec<_>>().join("\n")
    };
    assert_eq!(of(&[("x", 140), ("y", 70)], 190), "");
    let early = of(&[("x", 140), ("y", 69)], 190);
    assert!(
        early.starts_with("backup y sends 69us after") && early.contains("let it send 70us after"),
        "{early}"
    );
    let close = of(&[("x", 139), ("y", 70)], 190);
    assert!(close.starts_with("backup x sends 139us") && close.contains("when y may still"), "{close}");
    let before = of(&[("x", 140), ("y", 70)], 189);
    assert!(
        before.starts_with("slot 0 of a begins at 189us, but backup x may send the sync until 190us"),
        "{before}"
    );
}
