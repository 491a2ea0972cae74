use super::super::figures::{MissKind, Role, Verdict};
use super::super::host::HostFacts;
use super::super::verdict::Word;
use super::*;

/// Four stations, two of them with a fault.
fn fixed() -> (Figures, SignedHistogram) {
    let mut errors = SignedHistogram::new();
    errors.record_n(9_800, 100);
    errors.record_n(10_000, 109_890);
    errors.record_n(12_500, 10_000);
    errors.record_n(61_000, 9);
    errors.record(1_234_000);
    let deviations = errors.deviation_from(errors.median());
    let mut sync = SignedHistogram::new();
    (-900..=900).for_each(|error| sync.record_n(error, 50));

    let station = |name: &str, role| StationFigures {
        name: name.into(),
        role,
        clock_offset_ns: if role == Role::Master { 0 } else { -1_234_567 },
        clock_drift_ppb: 50_000,
        frames_expected: 30_000,
        frames_seen: 30_000,
        slot_error_ns: errors.summary(),
        slot_error_abs_ns: deviations.summary(),
        sync_error_ns: if role == Role::Master { Summary::default() } else { sync.summary() },
        cpu_percent: 3.04,
        notes: vec!["SCHED_FIFO refused: operation not permitted".into()],
        guard: if role == Role::Master { GuardName::Kernel } else { GuardName::User },
        ..StationFigures::default()
    };
    let mut per_station =
        vec![station("m", Role::Master), station("a", Role::Slave), station("b", Role::Slave)];
    per_station.push(StationFigures {
        frames_seen: 29_998,
        slots_missed: 2,
        overruns: 1,
        refusals: [("queue full".to_owned(), 1200)].into(),
        ..station("a-name-that-is-long", Role::Slave)
    });
    let mut figures = Figures {
        stations: 4,
        cycle_ns: 1_000_000,
        cycles: 30_000,
        syncs_sent: 30_000,
        frames_expected: 120_000,
        frames_seen: 119_998,
        slots_missed: 2,
        overruns: 1,
        unexplained: 1,
        slot_error_ns: errors.summary().with_gaps(2),
        slot_error_abs_ns: deviations.summary().with_gaps(0),
        sync_period_jitter_ns: Summary {
            n: 29_997,
            min: Some(-800),
            max: Some(91_000),
            gaps: Some(1),
            longest_gap_ns: Some(3_001_000),
            ..Summary::default()
        },
        sync_error_ns: sync.summary().with_gaps(2),
        implausible_syncs: [("cycle_ahead".to_owned(), 3)].into(),
        per_station,
        host: HostFacts {
            kernel: "6.18.44".into(),
            preemption: "PREEMPT_DYNAMIC (full)".into(),
            clock_source: "tsc".into(),
            cpu_model: "Processor @ 2.50GHz".into(),
            cpus: 2,
            virtual_machine: Some(true),
            idle_driver: Some("none".into()),
            rt_runtime_us: Some(950_000),
            steal_ticks: Some(12),
            core: Some(3),
            core_steal_ppm: Some(1_200),
            other_real_time: Vec::new(),
            rtnet: "0.1.0".into(),
        },
        verdict: Verdict::new(Word::NotOk, vec!["1 unexplained miss".into()]),
        rt_cpu_percent: 9.96,
        ..Figures::default()
    };
    for (cycle, kind, span_ns) in [(17, MissKind::Overrun, 1_201_000), (20_500, MissKind::Unexplained, 0)] {
        let station = "a-name-that-is-long".into();
        let (cause, found) = match kind {
            MissKind::Unexplained => (String::new(), Some("missing frame".into())),
            _ => ("timer_late".into(), None),
        };
        figures.note_miss(Miss { cycle, station, kind, span_ns, cause, found });
    }
    (figures, deviations)
}

#[test]
fn the_report_of_fixed_figures() {
    let (figures, histogram) = fixed();
    let screen = render(&figures, 80, &histogram);
    println!("{screen}");
    assert_eq!(screen, include_str!("tests.txt"));
}

#[test]
fn every_line_fits_the_width() {
    let (mut figures, mut histogram) = fixed();
    let wide = render(&figures, 100, &histogram);
    assert_eq!(wide.matches("a-name-th... slave").count(), 1, "one table suffices");
    for width in [0, 80, 81, 93, 100, 132] {
        assert_fits(&figures, width, &histogram);
    }
    // The worst that can be.
    let mut errors = SignedHistogram::new();
    for exponent in 0..63 {
        errors.record_n(1 << exponent, 1 << 40);
        errors.record_n(-(1 << exponent), 1 << 40);
    }
    histogram.merge(&errors.deviation_from(0));
    figures.frames_expected = u64::MAX;
    figures.verdict.reasons = vec!["x".repeat(200), "a reason of many words ".repeat(20)];
    for station in &mut figures.per_station {
        station.name = "ä".repeat(90);
        station.frames_seen = 1_000_000_000_000;
        station.frames_expected = 1_000_000_000_000;
        station.slot_error_ns = errors.summary();
        station.clock_offset_ns = i64::MIN;
        station.notes.push("n".repeat(300));
    }
    figures.slot_error_ns = errors.summary();
    for width in [80, 100] {
        assert_fits(&figures, width, &histogram);
    }
}

fn assert_fits(figures: &Figures, width: usize, histogram: &SignedHistogram) {
    for line in render(figures, width, histogram).lines() {
        assert!(line.chars().count() <= width.max(WIDTH_MIN), "{line}");
        assert_eq!(line, line.trim_end());
    }
}

#[test]
fn the_last_line_is_the_verdict() {
    let (mut figures, histogram) = fixed();
    let last = |figures: &Figures| render(figures, 80, &histogram).lines().last().unwrap().to_owned();
    assert_eq!(last(&figures), "NOT OK: 1 unexplained miss");
    figures.verdict = Verdict::new(Word::NotOk, vec!["a reason of five words".into(); 8]);
    let first = "NOT OK: a reason of five words; a reason of five words; a ...";
    assert_eq!(last(&figures), format!("{first} (8 reasons, above)"));
    figures.verdict = Verdict::default();
    assert_eq!(last(&figures), "OK: as expected, 119 998 of 120 000 frames seen; 1 unexplained");
    figures.unexplained = 0;
    assert_eq!(last(&figures), "OK: every frame seen in its slot, 119 998 of 120 000; 2 missed");
    (figures.frames_seen, figures.slots_missed) = (120_000, 0);
    assert_eq!(last(&figures), "OK: every frame in its slot, 120 000 of 120 000 seen");
}

#[test]
fn a_run_without_a_frame_can_be_shown() {
    assert_fits(&Figures::default(), 80, &SignedHistogram::new());
}

#[test]
fn numbers_are_short() {
    assert_eq!(
        [0, 999, 1000, 240_000, 1_000_000].map(grouped),
        ["0", "999", "1 000", "240 000", "1 000 000"]
    );
    assert_eq!([-350, 12_345, -1_234_567].map(micros), ["-0.35", "12.3", "-1 235"]);
    assert_eq!([100, 250_000, 1_500_000].map(duration), ["100ns", "250us", "1.5ms"]);
    assert_eq!(
        [0, 333_333_000, 9_949_999_999, 10_000_000_000].map(about),
        ["0ns", "333.333ms", "9.9s", "10s"]
    );
    assert_eq!([0, 5, -12_300, 2_000_000_000].map(signed_time), ["0", "+0.01us", "-12.3us", "+2.00s"]);
}

#[test]
fn what_programs_queued_is_told_by_priority_if_there_is_any() {
    let (mut figures, histogram) = fixed();
    assert!(!render(&figures, 80, &histogram).contains("queueing"));
    let mut delay = SignedHistogram::new();
    (1..=100).for_each(|delayed| delay.record(delayed * 10_000));
    let of = |priority, refused, lost| QueueingFigures {
        priority,
        frames_seen: 100,
        refused,
        delay_ns: delay.summary(),
        lost,
        lost_on_purpose: 0,
    };
    figures.queueing = vec![of(3, 0, 12), of(20, 1_234, 0)];
    let screen = render(&figures, 80, &histogram);
    for line in [
        "queueing in us   n p50 p99   max refused lost",
        "priority 3     100 500 990 1 000       0   12",
        "priority 20    100 500 990 1 000   1 234    0",
        "  queueing           = frame on the wire - queued by its program; those that",
    ] {
        assert!(screen.lines().any(|of| of == line), "{line}\n{screen}");
    }
}
