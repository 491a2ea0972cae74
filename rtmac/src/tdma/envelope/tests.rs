use rtnet::sim::Random;

use super::*;

const PERIOD: Span = Span::from_millis(1);

/// Feeds Synchronisations of a master that is slower by `ppb`, each held up by `late` of its number.
fn hear(envelope: &mut Envelope, cycles: core::ops::Range<u32>, ppb: i64, late: impl Fn(u32) -> i64) {
    for cycle in cycles {
        let start = truth(cycle, ppb) + Span::from_nanos(late(cycle));
        let expected = envelope.start_of(cycle).map_or(start, |(expected, _)| expected);
        envelope.note(cycle, start, expected, PERIOD);
    }
}

fn truth(cycle: u32, ppb: i64) -> Instant {
    let ideal = Instant::from_nanos(1 << 40) + PERIOD * i64::from(cycle as i32);
    ideal + Span::from_nanos(i64::from(cycle as i32) * ppb / 1_000)
}

fn error(envelope: &Envelope, cycle: u32, ppb: i64) -> i64 {
    let (start, _) = envelope.start_of(cycle).expect("known by now");
    (start - truth(cycle, ppb)).nanos()
}

#[test]
fn eight_windows_show_the_drift() {
    for ppb in [-100_000, -50_000, 0, 3_000, 100_000] {
        let mut envelope = Envelope::new();
        hear(&mut envelope, 0..511, ppb, |_| 0);
        assert!(envelope.start_of(511).is_none());
        hear(&mut envelope, 511..512, ppb, |_| 0);
        assert!(error(&envelope, 512, ppb).abs() <= 2, "{ppb}");
        hear(&mut envelope, 512..1_000, ppb, |_| 0);
        assert!(error(&envelope, 1_000, ppb).abs() <= 2, "{ppb}");
        assert!(error(&envelope, 2_000, ppb).abs() <= 3, "{ppb}");
    }
}

/// Lower quartile of half a round trip, if either way takes up to 8 us longer.
const DELAY_ON_A_BUSY_HOST: Span = Span::from_nanos(2_828);

#[test]
fn a_young_line_is_as_good_if_the_clocks_are_fast() {
    for seed in 1..=250 {
        let mut random = Random::new(seed);
        let late: Vec<i64> = (0..640).map(|_| random.below(8_000) as i64).collect();
        let off_at = |ppb| {
            let mut envelope = Envelope::new();
            hear(&mut envelope, 0..640, ppb, |cycle| late[cycle as usize]);
            [640, 1_140].map(|cycle| {
                let (off, bound) =
                    (error(&envelope, cycle, ppb), envelope.off_in(cycle, Span::ZERO).unwrap());
                let bound = bound + DELAY_ON_A_BUSY_HOST;
                assert!(
                    off.abs() <= bound.nanos(),
                    "{ppb}, seed {seed}: {off} ns in cycle {cycle}, not {bound}"
                );
                off
            })
        };
        let alike = off_at(0);
        for ppb in [-100_000, 50_000, 100_000] {
            let fast = off_at(ppb);
            let differ = fast[0].abs_diff(alike[0]).max(fast[1].abs_diff(alike[1]));
            assert!(differ < 100, "{ppb}, seed {seed}: {fast:?} ns, and {alike:?} for clocks that run alike");
        }
        for ppb in [-190_000, 190_000] {
            off_at(ppb);
        }
    }
}

#[test]
fn a_host_that_is_busy_for_seconds_moves_nothing() {
    let mut envelope = Envelope::new();
    let late = |cycle: u32| match cycle {
        // Busy: all are late by about as much.
        2_500..4_300 => 5_000 + i64::from(cycle * 7_919 % 4_001),
        // As ever: one in ten in time, for this is no steady host.
        _ if cycle % 10 == 3 => i64::from(cycle % 3) * 20,
        _ => i64::from(cycle * 7_919 % 9_001),
    };
    hear(&mut envelope, 0..1_000, 37_000, late);
    for cycle in 1_000..9_000 {
        hear(&mut envelope, cycle..cycle + 1, 37_000, late);
        let error = error(&envelope, cycle, 37_000);
        assert!((-400..400).contains(&error), "cycle {cycle}: {error}");
    }
}

#[test]
fn what_is_earlier_than_the_line_proves_it_wrong() {
    let mut envelope = Envelope::new();
    hear(&mut envelope, 0..1_000, 0, |_| 0);
    hear(&mut envelope, 1_000..1_001, 0, |_| -9_900);
    assert!(envelope.start_of(1_001).is_some(), "a stamp's noise");
    hear(&mut envelope, 1_001..1_003, 0, |_| -20_000);
    assert!(envelope.start_of(1_003).is_some(), "so are two of a window");
    hear(&mut envelope, 1_003..1_004, 0, |_| -20_000);
    assert!(envelope.start_of(1_004).is_none());
    hear(&mut envelope, 1_004..1_600, 0, |_| -20_000);
    assert_eq!(error(&envelope, 1_600, 0), -20_000);
}

#[test]
fn a_line_that_was_left_is_forgotten_in_time() {
    let mut envelope = Envelope::new();
    hear(&mut envelope, 0..1_000, 0, |_| 0);
    hear(&mut envelope, 1_000..18_000, 0, |_| 8_000);
    assert_eq!(error(&envelope, 18_000, 0), 8_000);
}

#[test]
fn a_host_that_is_slower_for_seconds_moves_nothing() {
    let mut envelope = Envelope::new();
    let slower = |cycle| [8_000..15_000, 19_000..26_000].iter().any(|seconds| seconds.contains(&cycle));
    let late = |cycle: u32| if slower(cycle) { 5_000 } else { 0 } + i64::from(cycle * 7_919 % 301);
    hear(&mut envelope, 0..1_000, -20_000, late);
    for cycle in 1_000..30_000 {
        hear(&mut envelope, cycle..cycle + 1, -20_000, late);
        let error = error(&envelope, cycle, -20_000);
        assert!((-300..400).contains(&error), "cycle {cycle}: {error}");
    }
}

#[test]
fn what_has_been_clearly_late_for_two_seconds_is_another_line() {
    let mut envelope = Envelope::new();
    hear(&mut envelope, 0..10_000, 0, |_| 0);
    hear(&mut envelope, 10_000..12_000, 0, |_| 11_000);
    assert_eq!(error(&envelope, 12_000, 0), 0);
    hear(&mut envelope, 12_000..12_200, 0, |_| 11_000);
    assert_eq!(error(&envelope, 12_200, 0), 11_000);
}

#[test]
fn cycles_that_take_longer_are_not_remembered_for_longer() {
    let kept_for = |micros| kept(Span::from_micros(micros)) as i64 * WINDOW as i64 * micros / 1_000;
    assert_eq!([100, 1_000, 2_000, 4_000].map(kept_for), [1_638, 16_384, 16_384, 16_384]);
    assert_eq!(kept_for(5_000), 20_480, "64 at the least");
}

#[test]
fn a_delay_that_becomes_known_shifts_all_of_it() {
    let mut envelope = Envelope::new();
    hear(&mut envelope, 0..600, 20_000, |_| 0);
    envelope.lengthen(Span::from_nanos(700));
    assert!((error(&envelope, 600, 20_000) + 700).abs() <= 2);
    hear(&mut envelope, 600..1_000, 20_000, |_| -700);
    assert!((error(&envelope, 1_000, 20_000) + 700).abs() <= 2);
}

#[test]
fn lost_ones_and_the_number_that_starts_over_do_not_matter() {
    let mut envelope = Envelope::new();
    for cycle in (u32::MAX - 500..=u32::MAX).chain(0..500).filter(|cycle| cycle % 7 != 0) {
        envelope.note(cycle, truth(cycle, -40_000), truth(cycle, -40_000), PERIOD);
    }
    assert!(error(&envelope, 500, -40_000).abs() <= 2);
}

#[test]
fn eight_windows_show_the_drift_however_long_cycles_are() {
    for millis in [1, 31, 32, 50, 100, 1_000, 10_000] {
        let (mut envelope, period) = (Envelope::new(), Span::from_millis(millis));
        let needed = (8 * syncs_of_window(period)) as u32;
        let start = |cycle: u32| {
            let gained = Span::from_nanos(i64::from(cycle) * period.nanos() / 50_000);
            Instant::from_nanos(1 << 40) + period * i64::from(cycle) + gained
        };
        for cycle in 0..needed {
            assert!(envelope.start_of(cycle).is_none(), "{millis} ms, cycle {cycle}");
            envelope.note(cycle, start(cycle), start(cycle), period);
        }
        let (at, drift) = envelope.start_of(needed + 10).expect("known by now");
        assert!((at - start(needed + 10)).abs() <= Span::from_nanos(2), "{millis} ms");
        assert_eq!(drift.parts_per_billion(period), 20_000, "{millis} ms");
        assert_eq!(envelope.is_clear(), millis > 1, "{millis} ms: 2 us of half a second are 4 ppm");
    }
}

#[test]
fn a_window_of_long_cycles_has_few_syncs_and_at_least_one() {
    let syncs = [1, 31, 32, 50, 100, 1_000, 2_001, 100_000].map(|ms| syncs_of_window(Span::from_millis(ms)));
    assert_eq!(syncs, [64, 64, 62, 40, 20, 2, 1, 1]);
}

#[test]
fn what_is_before_the_line_proves_it_wrong_in_short_windows() {
    for millis in [100, 1_000, 10_000] {
        let (mut envelope, period) = (Envelope::new(), Span::from_millis(millis));
        let mut hear = |cycles: core::ops::Range<u32>, early: i64| {
            for cycle in cycles {
                let ideal = Instant::from_nanos(1 << 40) + period * i64::from(cycle);
                let expected = envelope.start_of(cycle).map_or(ideal, |(expected, _)| expected);
                envelope.note(cycle, ideal - Span::from_nanos(early), expected, period);
            }
            envelope.start_of(1_000).is_some()
        };
        assert!(hear(0..400, 0), "{millis} ms");
        assert!(hear(400..401, 30_000), "{millis} ms: a stamp's noise");
        assert!(hear(401..601, 0), "{millis} ms");
        hear(601..605, 2_000_000);
        let left = envelope.start_of(1_000).map(|(at, _)| at);
        let old = Instant::from_nanos(1 << 40) + period * 1_000;
        assert!(left.is_none_or(|at| old - at > Span::from_micros(1_000)), "{millis} ms: {left:?}");
    }
}

#[test]
fn a_step_before_there_is_a_line_begins_anew() {
    let mut envelope = Envelope::new();
    hear(&mut envelope, 0..300, 0, |_| 0);
    envelope.note(300, truth(300, 0) - Span::from_micros(25), truth(300, 0), PERIOD);
    hear(&mut envelope, 301..811, 0, |_| -25_000);
    assert!(envelope.start_of(811).is_none(), "what was before does not count");
    hear(&mut envelope, 811..812, 0, |_| -25_000);
    assert_eq!(error(&envelope, 812, 0), -25_000);
}

#[test]
fn a_clock_that_changes_its_rate_is_followed() {
    // Cycles until it has been noticed: eight windows, or eight strides, and one that had begun.
    let changes = [
        (0, 30_000, 576),
        (0, -30_000, 0),
        (-60_000, 10_000, 576),
        (0, 12_000, 1_088),
        (4_000, 8_000, 3_648),
    ];
    for (before, after, noticed) in changes {
        let mut envelope = Envelope::new();
        let jitter = |cycle: u32| i64::from(cycle * 7_919 % 1_001);
        hear(&mut envelope, 0..20_480, before, jitter);
        let kink = (truth(20_480, before) - truth(20_480, after)).nanos();
        for cycle in 20_480..28_000 {
            hear(&mut envelope, cycle..cycle + 1, after, |cycle| kink + jitter(cycle));
            if let Some((start, _)) = envelope.start_of(cycle) {
                let error = (start - truth(cycle, after)).nanos() - kink;
                let at_first =
                    if cycle < 20_480 + noticed { (after - before) * i64::from(noticed) / 1_000 } else { 0 };
                let range = -at_first - 1_000..3_000;
                assert!(range.contains(&error), "from {before} to {after}, {cycle}: {error}");
            }
        }
        assert!(envelope.start_of(28_000).is_some());
    }
}

#[test]
fn a_rate_that_changes_is_seen_in_twelve_syncs_anywhere() {
    let period = Span::from_millis(20);
    let at = |cycle: u32, gained: i64| {
        Instant::from_nanos(1 << 40) + period * i64::from(cycle) + Span::from_nanos(gained)
    };
    // Wherever in a window of 64 it changes, by 50 ppm or 150, 1 or 3 us in a cycle.
    for (changes, gains) in (1_280..1_344).flat_map(|changes| [(changes, 1_000), (changes, 3_000)]) {
        let mut envelope = Envelope::new();
        let true_at = |cycle: u32| at(cycle, i64::from(cycle.saturating_sub(changes)) * gains);
        for cycle in 0..changes + 40 {
            let start = true_at(cycle) + Span::from_nanos(i64::from(cycle * 7_919 % 101));
            let expected = envelope.start_of(cycle).map_or(start, |(expected, _)| expected);
            envelope.note(cycle, start, expected, period);
            if let Some((line, _)) = envelope.start_of(cycle) {
                let error = (true_at(cycle) - line).nanos();
                assert!(error < 12 * gains + 200, "from {changes} on, {cycle}: {error}");
                assert!(cycle <= changes + 12 || error < 1_000, "from {changes} on, {cycle}: {error}");
            }
        }
    }
}

#[test]
fn what_no_clock_does_is_no_line() {
    let mut envelope = Envelope::new();
    hear(&mut envelope, 0..2_000, 300_000, |_| 0);
    assert!(envelope.start_of(2_000).is_none());
}

/// A slave's that calibrated in a second: a frame takes 5 us.
fn calibrated(ppb: i64) -> Envelope {
    let mut envelope = Envelope::new();
    let rate = Rate { gains: ppb as f64 / 1e9 + 0.4e-6, unsure: 1e-6 };
    envelope.know(truth(0, 0), rate, Span::from_micros(5), PERIOD);
    envelope
}

#[test]
fn with_a_rate_that_is_known_one_synchronisation_makes_a_line() {
    let mut envelope = calibrated(40_000);
    hear(&mut envelope, 0..1, 40_000, |_| 12_000);
    assert!((error(&envelope, 64, 40_000) - 12_000).abs() <= 50);
    assert!(envelope.is_clear());
    hear(&mut envelope, 1..4, 40_000, |_| 0);
    assert!(error(&envelope, 64, 40_000).abs() <= 50, "it was late");
}

#[test]
fn with_a_rate_that_is_known_a_host_that_is_busy_at_first_or_for_long_moves_little() {
    // Slow at first, quick now and then, in the end slow for good, as long as is remembered.
    let quick =
        |cycle| [2_000..2_500, 5_000..7_000, 9_000..9_300].iter().any(|seconds| seconds.contains(&cycle));
    let late = |cycle: u32| if quick(cycle) { 0 } else { 15_000 } + i64::from(cycle * 7_919 % 901);
    let mut envelope = calibrated(-20_000);
    hear(&mut envelope, 0..2_003, -20_000, late);
    for cycle in 2_003..18_000 {
        hear(&mut envelope, cycle..cycle + 1, -20_000, late);
        let error = error(&envelope, cycle, -20_000);
        assert!((-3_000..5_500).contains(&error), "cycle {cycle}: {error}");
    }
    let drift = envelope.drift().unwrap().parts_per_billion(PERIOD);
    assert!((drift + 20_000).abs() < 600, "surer than it was: {drift}");
}

#[test]
fn with_a_rate_that_is_known_what_is_earlier_moves_the_line_at_once() {
    let mut envelope = calibrated(0);
    hear(&mut envelope, 0..1_000, 0, |_| 15_000);
    hear(&mut envelope, 1_000..1_002, 0, |_| 0);
    assert!(error(&envelope, 1_002, 0) > 14_000, "two of a window are a stamp's noise");
    hear(&mut envelope, 1_002..1_003, 0, |_| 0);
    assert!(error(&envelope, 1_003, 0).abs() < 10);
    assert!(envelope.is_unbroken_since(0));
}

#[test]
fn a_clock_whose_rate_was_known_and_that_changes_it_is_followed() {
    for (before, after) in [(0, 30_000), (0, -30_000), (-40_000, 10_000), (20_000, -10_000)] {
        let mut envelope = calibrated(before);
        let jitter = |cycle: u32| i64::from(cycle * 7_919 % 1_001);
        hear(&mut envelope, 0..10_240, before, jitter);
        let kink = (truth(10_240, before) - truth(10_240, after)).nanos();
        hear(&mut envelope, 10_240..14_000, after, |cycle| kink + jitter(cycle));
        let error = (envelope.start_of(14_000).unwrap().0 - truth(14_000, after)).nanos() - kink;
        assert!((-1_000..3_000).contains(&error), "from {before} to {after}: {error}");
    }
}

#[test]
fn a_line_begun_anew_has_the_rate_that_is_known_and_one_of_other_clocks_has_not() {
    let mut envelope = calibrated(30_000);
    hear(&mut envelope, 0..1_000, 30_000, |_| 0);
    envelope.begin_line();
    hear(&mut envelope, 1_000..1_001, 30_000, |_| 400_000);
    assert!((error(&envelope, 1_064, 30_000) - 400_000).abs() < 50);
    envelope.restart();
    hear(&mut envelope, 1_001..1_065, 30_000, |_| 0);
    assert!(envelope.start_of(1_065).is_none());
}

#[test]
fn a_rate_that_no_clock_has_or_that_is_not_sure_is_not_known() {
    for (gains, unsure) in [(0.5, 1e-6), (-0.3e-3, 1e-6), (10e-6, 30e-6)] {
        let mut envelope = Envelope::new();
        envelope.know(truth(0, 0), Rate { gains, unsure }, Span::from_micros(5), PERIOD);
        hear(&mut envelope, 0..64, 0, |_| 0);
        assert!(envelope.start_of(64).is_none() && envelope.slower() == Span::ZERO, "{gains} {unsure}");
    }
}

#[test]
fn a_rate_that_changes_a_little_behind_many_ports_is_found_out_in_time() {
    let mut envelope = Envelope::new();
    envelope.know(truth(0, 0), Rate { gains: 0.0, unsure: 1e-6 }, Span::from_micros(33), PERIOD);
    let jitter = |cycle: u32| i64::from(cycle * 7_919 % 1_001);
    hear(&mut envelope, 0..1_280, 0, jitter);
    let kink = (truth(1_280, 0) - truth(1_280, 8_000)).nanos();
    hear(&mut envelope, 1_280..20_000, 8_000, |cycle| kink + jitter(cycle));
    let error = (envelope.start_of(20_000).unwrap().0 - truth(20_000, 8_000)).nanos() - kink;
    assert!((-1_000..3_000).contains(&error), "{error}");
}

#[test]
fn a_rate_that_a_calibration_was_wrong_about_is_left_the_sooner_the_surer_syncs_show_another() {
    for wrong in [-10e-6, 10e-6] {
        let mut envelope = Envelope::new();
        let rate = Rate { gains: 22e-6 + wrong, unsure: 6.5e-6 };
        envelope.know(truth(0, 0), rate, Span::from_micros(22), PERIOD);
        hear(&mut envelope, 0..3_000, 22_000, |cycle| i64::from(cycle * 7_919 % 1_001));
        for cycle in 3_000..6_000 {
            hear(&mut envelope, cycle..cycle + 1, 22_000, |cycle| i64::from(cycle * 7_919 % 1_001));
            let error = error(&envelope, cycle, 22_000);
            assert!((-1_000..1_000).contains(&error), "{wrong}, cycle {cycle}: {error}");
        }
    }
}

#[test]
fn where_a_rate_is_little_sure_only_what_is_young_counts() {
    // Of every sixteen windows one is in time: too few for an edge to be sure of another rate.
    let late = |cycle: u32| match cycle / 64 {
        window if window.is_multiple_of(16) => 0,
        window => 20_000 + i64::from(window.wrapping_mul(2_654_435_761) >> 13),
    };
    for (ppb, shown) in [(0, 12e-6), (0, -12e-6), (-90_000, -75e-6)] {
        let mut envelope = Envelope::new();
        let rate = Rate { gains: shown, unsure: 15e-6 };
        envelope.know(truth(0, 0), rate, Span::from_micros(5), PERIOD);
        for cycle in 0..8_000 {
            hear(&mut envelope, cycle..cycle + 1, ppb, late);
            let error = error(&envelope, cycle, ppb);
            assert!((-16_000..16_000).contains(&error), "shown {shown}, cycle {cycle}: {error}");
        }
    }
}

#[test]
fn what_comes_later_all_through_a_window_may_be_a_clock_that_was_set_and_a_line_says_so() {
    let mut envelope = calibrated(0);
    let late = |cycle: u32| if (2_000..2_200).contains(&cycle) { 15_000 } else { 0 };
    let off = |envelope: &Envelope, cycle| envelope.off_in(cycle, Span::ZERO).expect("known by now").nanos();
    hear(&mut envelope, 0..2_000, 0, late);
    assert!(off(&envelope, 2_000) < 1_000, "{}", off(&envelope, 2_000));
    hear(&mut envelope, 2_000..2_200, 0, late);
    assert!(error(&envelope, 2_200, 0).abs() < 200, "it may as well be a busy host");
    assert!((14_800..16_000).contains(&off(&envelope, 2_200)), "{}", off(&envelope, 2_200));
    hear(&mut envelope, 2_200..2_400, 0, late);
    assert!(off(&envelope, 2_400) < 1_000, "and was one: {}", off(&envelope, 2_400));
}
