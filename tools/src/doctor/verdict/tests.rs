use super::*;

const SECOND: Span = Span::from_millis(1_000);
const EIGHT_AT_1_MS: (usize, Span) = (8, Span::from_millis(1));

fn histogram(of: &[(Span, u64)]) -> SignedHistogram {
    let mut histogram = SignedHistogram::new();
    of.iter().for_each(|&(value, count)| histogram.record_n(value.nanos(), count));
    histogram
}

fn core<'a>(wakeups: &'a [SignedHistogram], outages: &'a SignedHistogram) -> Core<'a> {
    let (watched, turn) = (SECOND * 10, Span::from_micros(55));
    Core { wakeups, outages, watched, broadcasts: None, turn, real_time_share: 0.95 }
}

fn us(micros: i64) -> Span {
    Span::from_micros(micros)
}

fn close(found: f64, expected: f64) -> bool {
    (found - expected).abs() <= 1e-3 * expected + 1e-9
}

#[test]
fn a_perfect_host_holds_whatever_its_core_has_time_for() {
    let (wakeups, none) = ([histogram(&[(us(3), 10_000)])], SignedHistogram::new());
    let candidates = candidates(&core(&wakeups, &none));
    assert_eq!(candidates.len(), CYCLES.len() * STATIONS.len(), "all slots fit at 1 Gbit/s");
    let shortest = STATIONS.map(|stations| recommend(&candidates, stations).unwrap());
    assert_eq!(shortest.map(|s| s.cycle_ns / 1_000), [250, 250, 250, 500, 1_000]);
    assert!(shortest.iter().all(|s| s.holds() && s.predicted_miss_share == 0.0), "{shortest:?}");
    assert_eq!(shortest[2].guard_ns, 27_343 - 816, "as a lab of 8 has it");
}

#[test]
fn a_wakeup_misses_its_slot_when_it_is_later_than_lead_and_latest() {
    // The guard band is 110.311 us: less 10 us for the clocks at either end, and with the lead of 3 us and 9 us, 102.311 us.
    let wakeups = [histogram(&[(us(3), 9_900), (us(101), 50), (us(104), 30), (us(5_000), 20)])];
    let none = SignedHistogram::new();
    let (stations, cycle) = EIGHT_AT_1_MS;
    let found = predict(&core(&wakeups, &none), stations, cycle).unwrap();
    assert!(close(found.late_share, 0.005), "{found:?}");
    assert_eq!(found.outage_share, 0.0);
}

#[test]
fn a_noisy_host_needs_a_longer_cycle() {
    let wakeups = [histogram(&[(us(3), 9_800), (us(150), 180), (us(400), 20)])];
    let none = SignedHistogram::new();
    let candidates = candidates(&core(&wakeups, &none));
    let best = recommend(&candidates, 8).unwrap();
    assert_eq!((best.cycle_ns, best.holds()), (2_000_000, true), "235 us are late there: {best:?}");
    assert!(close(best.late_share, 0.002), "{best:?}");
}

#[test]
fn a_hopeless_host_is_told_what_is_best() {
    let wakeups = [histogram(&[(us(3), 90), (us(20_000), 10)])];
    let none = SignedHistogram::new();
    let best = recommend(&candidates(&core(&wakeups, &none)), 8).unwrap();
    assert!(!best.holds() && best.fits(), "{best:?}");
}

#[test]
fn blocks_that_differ_make_the_prediction_more_careful() {
    let (good, bad) = (histogram(&[(us(3), 1_000)]), histogram(&[(us(3), 980), (us(900), 20)]));
    let none = SignedHistogram::new();
    let (stations, cycle) = EIGHT_AT_1_MS;
    let of = |blocks: &[SignedHistogram]| predict(&core(blocks, &none), stations, cycle).unwrap();
    let even = of(&[bad.clone(), bad.clone(), bad.clone(), bad.clone()]);
    assert!(close(even.late_share, 0.02) && even.uncertain_share == 0.0, "{even:?}");
    let uneven = of(&[good.clone(), good.clone(), good, bad]);
    // A standard deviation of 1 % over four blocks is half a per cent of standard error.
    assert!(close(uneven.late_share, 0.005) && close(uneven.uncertain_share, 0.005), "{uneven:?}");
    // By chance, two syncs in a row are late, too: the square of 0.5 %, for seven of eight stations.
    assert!(close(uneven.silent_share, 0.005 * 0.005 * 7.0 / 8.0), "{uneven:?}");
    assert!(!uneven.holds(), "{uneven:?}");
}

#[test]
fn holding_comes_first_then_a_short_cycle_and_else_few_misses() {
    let (good, bad) = ([histogram(&[(us(3), 100)])], [histogram(&[(us(3), 90), (us(20_000), 10)])]);
    let worse = [histogram(&[(us(3), 80), (us(20_000), 20)])];
    let none = SignedHistogram::new();
    let of = |wakeups: &[SignedHistogram], cycle| predict(&core(wakeups, &none), 8, cycle).unwrap();
    let [holds, slow] = [us(1_000), us(10_000)].map(|cycle| of(&good, cycle));
    assert!(better(&holds, &slow) && !better(&slow, &holds) && !better(&holds, &holds));
    let [fails, fails_more] = [of(&bad, us(1_000)), of(&worse, us(1_000))];
    assert!(better(&slow, &fails) && !better(&fails, &slow) && better(&fails, &fails_more));
}

#[test]
fn an_outage_between_wakeup_and_slot_costs_its_share_of_time() {
    let wakeups = [histogram(&[(us(3), 10_000)])];
    let (stations, cycle) = EIGHT_AT_1_MS;
    let share = |outages: &[(Span, u64)]| {
        let outages = histogram(outages);
        predict(&core(&wakeups, &outages), stations, cycle).unwrap().outage_share
    };
    assert_eq!(share(&[(us(90), 1_000)]), 0.0, "over before it is too late, wherever it begins");
    // 101 us less 90.311 us; a bin of the histogram is up to 101 ns wide.
    assert!((share(&[(us(101), 100)]) - 10.689e-6 * 10.0).abs() < 0.102e-6 * 10.0);
    assert!(close(share(&[(us(900), 100)]), 12e-6 * 10.0), "never more than the lead");
}

#[test]
fn an_outage_over_two_syncs_silences_the_rest_of_the_cycle() {
    let wakeups = [histogram(&[(us(3), 10_000)])];
    let (stations, cycle) = EIGHT_AT_1_MS;
    let silent = |length| {
        let outages = histogram(&[(us(length), 10)]);
        predict(&core(&wakeups, &outages), stations, cycle).unwrap().silent_share
    };
    assert_eq!(silent(1_083), 0.0, "the second sync is in time");
    // Ten long ones in ten seconds: each silences 1 ms / 2, less what the sync may be late.
    let whole = 500e-6 - (83.333e-6 - 83.333e-6 * 83.333e-6 / 2e-3);
    assert!(close(silent(5_000), whole * 7.0 / 8.0), "{} {whole}", silent(5_000));
    // By trying all phases, a microsecond apart.
    let tried: i64 = (0..1_000).filter(|&end| end > 83 && 1_500 >= 1_000 + end).map(|end| 1_000 - end).sum();
    let mean = tried as f64 / 1_000.0 * 1e-6 * 7.0 / 8.0;
    assert!((silent(1_500) - mean).abs() < 2e-6, "{} {mean}", silent(1_500));
}

#[test]
fn a_sync_to_many_stations_takes_the_master_its_own_slot() {
    let (wakeups, none) = ([histogram(&[(us(3), 100)])], SignedHistogram::new());
    // 7.4 us a station: 229 us for 31 slaves, 111 us for 15. At 5 ms and 2 ms there are 227 and 194 us.
    let took = histogram(&[(us(58), 90), (us(59), 10)]);
    let core = Core { broadcasts: Some((&took, 8)), ..core(&wakeups, &none) };
    let share = |stations, cycle| predict(&core, stations, cycle).unwrap().sync_share;
    assert!(close(share(32, us(5_000)), 0.1 / 32.0), "59 us are 229 us: {}", share(32, us(5_000)));
    assert_eq!(share(16, us(2_000)), 0.0);
}

#[test]
fn what_would_be_throttled_is_not_recommended() {
    let (wakeups, none) = ([histogram(&[(us(3), 10_000)])], SignedHistogram::new());
    let core = Core { turn: us(75), ..core(&wakeups, &none) };
    let found = predict(&core, 8, us(250)).unwrap();
    // 25 us and the lead, 9 us less than a ninth of three quarters of the cycle.
    assert!(close(found.load, 9.0 * 36.833 / 250.0) && !found.fits() && !found.holds(), "{found:?}");
    assert!(close(found.throttled_share, 0.05), "{found:?}");
    let unlimited = Core { real_time_share: 1.0, ..core };
    let found = predict(&unlimited, 8, us(250)).unwrap();
    assert!(found.throttled_share == 0.0 && !found.fits(), "there is no time for anything else");
}

#[test]
fn without_any_measurement_nothing_is_missed_and_nothing_divided_by_zero() {
    let none = SignedHistogram::new();
    let core = Core { watched: Span::ZERO, ..core(&[], &none) };
    assert!(candidates(&core).iter().all(|c| c.predicted_miss_share.is_finite()));
    assert_eq!(recommend(&[], 8), None);
}
