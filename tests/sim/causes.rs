//! Every missed slot and every missing sync has one cause, and a reader is told of what was measured, no more.

use tools::report::figures::Figures;
use tools::scenario;
use tools::sim::{self, Options};

use crate::scenarios::{parse, run};

/// A master and two slaves of 1 ms to which this happens in 3 s.
fn three(events: &str) -> scenario::Scenario {
    three_for("3s", events)
}

fn three_for(duration: &str, events: &str) -> scenario::Scenario {
    let station =
        |name: &str, role: &str| format!("[[station]]\nname = \"{name}\"\nrole = \"{role}\"\nrounds = 20\n");
    let stations =
        [station("master", "master"), station("slave1", "slave"), station("slave2", "slave")].concat();
    parse(&format!("cycle = \"1ms\"\nduration = \"{duration}\"\n{stations}{events}"))
}

#[track_caller]
fn all_in_the_causes(figures: &Figures) {
    assert_eq!(figures.causes.values().sum::<u64>(), figures.slots_missed, "{:?}", figures.causes);
    assert_eq!(figures.sync_causes.values().sum::<u64>(), figures.syncs_missing, "{:?}", figures.sync_causes);
}

#[test]
fn every_missed_slot_is_in_the_causes_and_every_missing_sync_in_its_own() {
    let figures = |events: &str| sim::run(&three(events), &Options::default()).unwrap().figures.figures;
    let killed = figures("[[event]]\nat = \"500ms\"\nkill = \"slave1\"\n");
    all_in_the_causes(&killed);
    assert_eq!(
        killed.causes.keys().collect::<Vec<_>>(),
        ["station_down"],
        "for longer than a line is good for"
    );
    assert_eq!(killed.slots_missed, 2_500);

    let masters = figures("[[event]]\nat = \"500ms\"\nkill = \"master\"\n");
    all_in_the_causes(&masters);
    let of = |cause: &str| masters.causes[cause];
    assert_eq!((of("station_down"), of("sync_lost_or_late")), (2_500, masters.slots_missed - 2_500));
    assert_eq!(masters.sync_causes["station_down"], masters.syncs_missing);

    let unplugged = figures("[[event]]\nat = \"1s\"\nunplug = \"slave1\"\nfor = \"300ms\"\n");
    all_in_the_causes(&unplugged);
    assert_eq!(
        unplugged.causes.keys().collect::<Vec<_>>(),
        ["no_carrier"],
        "not for the syncs that it did not hear"
    );
    assert!((299..=302).contains(&unplugged.slots_missed), "{}", unplugged.slots_missed);

    let many = run("late_backups_lose_each_others_syncs.toml").figures.figures;
    all_in_the_causes(&many);
    assert!(many.sync_causes["timer_late"] >= 3 && many.causes["station_down"] > 10_000, "{:?}", many.causes);
}

#[test]
fn causes_are_found_also_where_a_run_is_judged_while_it_lasts() {
    let events = r#"
        [[event]]
        at = "6s"
        times = 3
        every = "3s"
        stop = "slave1"
        for = "200ms"
        [[event]]
        at = "6100ms"
        times = 3
        every = "3s"
        restart = "slave1"
        [[event]]
        at = "7s"
        times = 3
        every = "3s"
        clock = { stations = "master", step = "1300ms" }
        [[event]]
        at = "17s"
        kill = "slave2"
    "#;
    let figures = sim::run(&three_for("30s", events), &Options::default()).unwrap().figures.figures;
    all_in_the_causes(&figures);
    assert_eq!(figures.unexplained, 0, "{:#?}", figures.misses);
    let of = |cause: &str| figures.causes[cause];
    assert!(of("station_down") > 9_000 && of("clock_set") > 3 * 1_300, "{:?}", figures.causes);
    // Three times 100 ms, each with 99 to 101 turns.
    assert!((297..=303).contains(&of("station_stopped")), "{:?}", figures.causes);
}

#[test]
fn the_frames_of_a_cycle_without_a_sync_are_shown_under_it() {
    let scenario = three("[[event]]\nat = \"1s\"\nkill = \"master\"\n[expect]\nsyncs_missing = 0\n");
    let ended = sim::run(&scenario, &Options::default()).unwrap();
    let missing = ended.figures.simulation.expectations[0].cycle.expect("the first without a sync");
    let around = Some((missing, missing));
    let lines = sim::run(&scenario, &Options { around, ..Options::default() }).unwrap().lines;
    let of = |line: &&String| line.contains(&format!("slot 0 cycle {missing} "));
    assert_eq!(lines.iter().filter(of).count(), 2, "both slaves bridge it: {lines:#?}");
    assert!(lines.iter().all(|line| line.starts_with(&format!("cycle {missing} "))), "{lines:#?}");
}

#[test]
fn the_screen_says_what_was_measured_and_of_events_only_where_there_were_some() {
    let mut ended = run("ten_megabits_on_a_hub.toml");
    let simulation = &mut ended.figures.simulation;
    assert!(simulation.measured_ns < simulation.virtual_ns, "joining is before");
    (simulation.virtual_ns, simulation.measured_ns) = (16_400_000_000, 12_000_000_000);
    (simulation.relock_cycles, simulation.seed, simulation.frames) = (Some(7_741), 3, 29_013);
    let text = |figures: &_| sim::screen::render(figures, None, 100);
    assert!(
        text(&ended.figures)
            .starts_with("simulated 16.4s with seed 3, and measured 12s of it: 29 013 frames\n")
    );
    let of_events = |figures: &_| text(figures).contains("all synchronised 7741 cycles after the last event");
    ended.figures.simulation.events = 0;
    assert!(!of_events(&ended.figures));
    ended.figures.simulation.events = 1;
    assert!(of_events(&ended.figures));
}
