//! Every scenario of this directory, one situation each, shows what its file expects: with its own seed, with seeds that are drawn
//! from the commit's date, and with every seed that failed once.

use std::path::{Path, PathBuf};

use pcap_file::pcapng::blocks::enhanced_packet::EnhancedPacketOption;
use pcap_file::pcapng::blocks::opt_common::CommonOption;
use pcap_file::pcapng::{Block, PcapNgReader};
use rtnet::time::Span;
use tests::seeds;
use tools::report::figures::MissKind;
use tools::report::histogram::SignedHistogram;
use tools::report::screen;
use tools::scenario::{self, Event, Expectation, Happening, Measure, Place, Relation, Scenario};
use tools::sim::seeds::Subject;
use tools::sim::{self, EXAMPLE, Ended, Options};

use crate::known::{self, Known};

fn directory() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("sim")
}

/// A file of this directory, with a drawn seed.
fn loaded(file: &str) -> Scenario {
    scenario::load(&directory().join(file)).unwrap().with_seed(seeds::one(file))
}

pub fn run(file: &str) -> Ended {
    sim::run(&loaded(file), &Options::default()).unwrap()
}

/// Seeds of each file that are drawn: all files with one seed take 3.4 s of a core, so these take a minute.
const DRAWN: usize = 20;

#[track_caller]
fn check(file: &'static str) {
    let subject = Subject::load(&directory().join(file)).unwrap();
    assert!(subject.rows().iter().any(|row| row.line.is_some()), "{file} expects nothing");
    let known: Vec<Known> = known::all().into_iter().filter(|known| known.file == file).collect();
    let seeds = seeds::asked().unwrap_or_else(|| {
        let kept = known.iter().map(|known| known.seed).chain([subject.own_seed()]);
        let mut seeds: Vec<u64> = kept.chain(seeds::drawn(file, DRAWN)).collect();
        seeds.sort_unstable();
        seeds.dedup();
        seeds
    });
    let run = move |seed| {
        let reasons = subject.run(seed, &Options::default()).reasons;
        known::judge(known.iter().find(|known| known.seed == seed), &reasons)
    };
    seeds::hold(&seeds, run, |seed| format!("rtnet sim run tests/sim/{file} --seed {seed}"));
}

macro_rules! scenarios {
    ($($name:ident)+) => {
        $(#[test]
        fn $name() {
            check(concat!(stringify!($name), ".toml"));
        })+

        #[test]
        fn every_file_here_is_a_test() {
            let entries = std::fs::read_dir(directory()).unwrap();
            let files = entries.map(|entry| entry.unwrap().path()).filter(|path| path.extension().is_some_and(|of| of == "toml"));
            let mut names: Vec<String> = files.map(|path| path.file_stem().unwrap().to_string_lossy().into()).collect();
            names.sort();
            assert_eq!(names, [$(stringify!($name)),+]);
        }
    };
}

scenarios! {
    backups_whose_lines_are_apart_agree_again
    clock_changes_its_rate_at_once
    clocks_step_and_wander
    deaf_backup_outlasts_the_primary
    foreign_frames_change_nothing
    frames_are_lost_doubled_late_and_changed
    hosts_with_outages_explain_every_miss
    late_backups_lose_each_others_syncs
    late_frames_without_a_guard_are_told_of
    masters_clock_is_set_alone
    masters_clock_is_set_back
    parted_network_is_whole_again
    parts_of_a_cut_medium_run_apart
    primary_dies_and_the_backups_take_over
    primary_dies_twenty_times_on_a_lossy_medium
    queued_frames_on_late_hosts_leave_nothing_unexplained
    queued_frames_that_are_lost_are_counted
    station_babbles_on_a_hub
    station_joins_a_running_network
    stopped_stations_are_killed_before_they_tell
    stopped_stations_send_nothing_late
    switch_delays_every_frame
    syncs_are_overtaken
    ten_megabits_on_a_hub
    urgent_frames_overtake_a_backlog
    wires_are_out_and_back
}

#[test]
fn the_example_runs_and_is_as_it_says() {
    let scenario = scenario::Source::new("example.toml", EXAMPLE).parse().unwrap();
    let scenario = scenario.with_seed(seeds::one("example.toml"));
    let ended = sim::run(&scenario, &Options::default()).unwrap();
    assert_eq!(ended.figures.figures.verdict.reasons, Vec::<String>::new());
}

#[test]
fn who_gave_the_time_at_once_is_named_with_the_one_that_was_silent_then() {
    let files =
        [("deaf_backup_outlasts_the_primary", "primary"), ("parted_network_is_whole_again", "backup")];
    for (file, silent) in files {
        let figures = run(&format!("{file}.toml")).figures.figures;
        let rivals = match &figures.rivals[..] {
            [rivals] => rivals,
            // A backup whose line is behind the primary's by then hears it before it gives the time.
            [] if silent == "backup" && figures.rival_cycles == 0 => continue,
            other => panic!("{file}: {other:?}"),
        };
        let mut between = rivals.between.clone();
        between.sort();
        assert_eq!(
            (&between[..], rivals.silent.as_deref()),
            (&["backup", "primary"].map(String::from)[..], Some(silent))
        );
        assert_eq!(rivals.cycles, figures.rival_cycles);
        let named = format!("at once for {} cycle", rivals.cycles);
        let screen = screen::render(&figures, 200, &SignedHistogram::new());
        assert!(
            screen.contains(&named) && screen.contains(&format!("until {silent} was silent")),
            "{screen}"
        );
    }
}

#[test]
fn what_is_expected_counts_besides_what_is_wrong_with_any_run() {
    let mut scenario = loaded("frames_are_lost_doubled_late_and_changed.toml");
    let reasons = |scenario: &_| {
        sim::run(scenario, &Options::default()).unwrap().figures.figures.verdict.reasons.join("; ")
    };
    assert_eq!(reasons(&scenario), "", "the file says what it puts up with");
    scenario.conditions.expectations.retain(|expected| expected.measure == Measure::Overlaps);
    let left_open = reasons(&scenario);
    for what in ["payload errors", "did not receive"] {
        assert!(left_open.contains(what), "{what}: {left_open}");
    }
    scenario.conditions.expectations[0].limit = 1;
    assert!(reasons(&scenario).contains("expected overlaps = 1, found 0"));
}

#[test]
fn one_seed_is_one_run_to_the_byte_and_another_is_another() {
    let directory = tempfile::tempdir().unwrap();
    let scenario = |seed| {
        let mut scenario = scenario::Source::new("example.toml", EXAMPLE).parse().unwrap();
        scenario.duration = Span::from_millis(3_000);
        scenario.with_seed(seed)
    };
    let run = |seed, name: &str| {
        let pcap = directory.path().join(name);
        let options = Options { pcap: Some(pcap.clone()), ..Options::default() };
        let ended = sim::run(&scenario(seed), &options).unwrap();
        (std::fs::read(pcap).unwrap(), serde_json::to_string(&ended.figures).unwrap())
    };
    let (first, second, other) = (run(7, "a"), run(7, "b"), run(8, "c"));
    assert!(first == second && first.0 != other.0);
    assert!(first.0.len() > 500_000, "{}", first.0.len());
}

#[test]
fn a_queued_frame_waits_for_as_long_as_can_be_worked_out_at_the_most() {
    let figures = run("urgent_frames_overtake_a_backlog.toml").figures.figures;
    let longest: Vec<_> = figures.queueing.iter().map(|of| (of.priority, of.delay_ns.max.unwrap())).collect();
    let (lead, cycle) = (50_000, 1_000_000);
    let near = |(priority, longest): (u8, i64), cycles: i64| {
        let worst = lead + cycles * cycle;
        assert!(
            (worst - 4_000..worst + 1_000).contains(&longest),
            "priority {priority}: {longest} of {worst}"
        );
    };
    let [urgent, backlog] = longest[..] else { panic!("{longest:?}") };
    assert_eq!((urgent.0, backlog.0), (3, 20));
    near(urgent, 1);
    near(backlog, 8 + 2);
    assert_eq!(figures.per_station[1].queueing, figures.queueing, "nobody else queues anything");
    let shortest = figures.queueing[0].delay_ns.min.unwrap();
    assert!((lead - 1_000..lead + 3_000).contains(&shortest), "{shortest}: it just came in time");
}

#[test]
fn what_is_lost_of_queued_frames_is_told_by_priority_and_counts_unless_it_is_lost_on_purpose() {
    let mut scenario = loaded("queued_frames_that_are_lost_are_counted.toml");
    scenario.conditions.expectations.clear();
    let run = |scenario: &_| sim::run(scenario, &Options::default()).unwrap().figures.figures;
    let (arm, camera) = (1, 2);
    let figures = run(&scenario);
    assert_eq!(figures.verdict.reasons, Vec::<String>::new(), "its wire loses them");
    for of in &figures.per_station[arm].queueing {
        let (least, most) = (of.frames_seen / 100, of.frames_seen * 3 / 100);
        assert!((least..most).contains(&of.lost) && of.lost_on_purpose == of.lost, "{of:?}");
    }
    let lost: u64 = figures.queueing.iter().map(|of| of.lost).sum();
    let of_camera = &figures.per_station[camera];
    assert!(of_camera.frames_lost > lost + 100, "usual ones, too: {} and {lost}", of_camera.frames_lost);
    assert_eq!(
        (of_camera.lost_on_purpose, figures.frames_lost),
        (of_camera.frames_lost, of_camera.frames_lost)
    );

    // What there is no room for while it is stopped is not lost on purpose.
    scenario.conditions.wires.clear();
    let what = Happening::Stop(vec![camera], Span::from_millis(500));
    let (at, every) = (Span::from_millis(1_000), Span::ZERO);
    scenario.conditions.events = vec![Event { at, times: 1, every, what, place: Place::default() }];
    let figures = run(&scenario);
    assert!(
        figures.queueing.iter().all(|of| of.lost > 50 && of.lost_on_purpose == 0),
        "{:?}",
        figures.queueing
    );
    let reasons = figures.verdict.reasons.join("; ");
    assert!(reasons.starts_with("station 'camera' did not receive"), "{reasons}");
}

#[test]
fn a_capture_tells_of_each_frame_which_cycle_and_slot_it_is_of_and_how_late() {
    let mut scenario = loaded("urgent_frames_overtake_a_backlog.toml");
    scenario.duration = Span::from_millis(100);
    let directory = tempfile::tempdir().unwrap();
    let pcap = directory.path().join("frames.pcapng");
    let ended = sim::run(&scenario, &Options { pcap: Some(pcap.clone()), ..Options::default() }).unwrap();
    let comments = comments(&pcap);
    assert!(comments.len() as u64 > ended.figures.simulation.frames, "all since the begin");
    let first_sync = comments.iter().position(|text| text.ends_with("sync, slot error +0.000us")).unwrap();
    assert!(comments[first_sync + 1..].iter().all(|text| text.starts_with("cycle ")), "{comments:#?}");
    let of = |what: &str| comments.iter().filter(|text| text.contains(what)).collect::<Vec<_>>();
    assert!(of(", request, +").iter().all(|text| text.ends_with("us from its start")));
    let usual = of(", slot 0 of station 2, slot error ");
    assert!(usual.len() > 100, "{comments:#?}");
    // As a dump of a lab, but that which slot a queued frame is in is known here.
    let queued = of(", slot 0 of station 1, priority 20, slot error ");
    assert!(queued.len() > 35, "{queued:#?}");
    let cycle = |text: &&String| text.split([' ', ',']).nth(1).unwrap().parse::<u32>().unwrap();
    let gaps: Vec<u32> = queued.windows(2).map(|two| cycle(&two[1]) - cycle(&two[0])).collect();
    assert!(gaps.iter().all(|&gap| gap > 0) && gaps.contains(&1), "each in a cycle of its own: {gaps:?}");
}

/// The comments of all frames in a capture.
fn comments(pcap: &Path) -> Vec<String> {
    let mut reader = PcapNgReader::new(std::fs::File::open(pcap).unwrap()).unwrap();
    let mut comments = Vec::new();
    while let Some(block) = reader.next_block() {
        let Block::EnhancedPacket(packet) = block.unwrap().0 else { continue };
        let comment = packet.options.iter().find_map(|option| match option {
            EnhancedPacketOption::Common(CommonOption::Comment(text)) => Some(text.to_string()),
            _ => None,
        });
        comments.push(comment.expect("every frame has one"));
    }
    comments
}

#[test]
fn whatever_is_not_as_expected_has_the_cycle_in_which_it_was_worst_or_is_said_to_have_none() {
    let failed = |file: &str, measures: &[Measure]| {
        let mut scenario = loaded(file);
        scenario.duration = scenario.duration.min(Span::from_millis(4_000));
        scenario.conditions.events.clear();
        let line = |&measure| Expectation {
            measure,
            station: None,
            priority: None,
            // More than there can be.
            relation: Relation::Equal,
            limit: i64::MAX - 1,
            place: Place::default(),
        };
        scenario.conditions.expectations = measures.iter().map(line).collect();
        let ended = sim::run(&scenario, &Options::default()).unwrap();
        let text = sim::screen::render(&ended.figures, None, 80);
        let checked = ended.figures.simulation.expectations;
        let none =
            text.lines().filter(|line| line.ends_with("NOT AS EXPECTED, in no cycle that could be shown"));
        assert_eq!(none.count(), checked.iter().filter(|of| of.cycle.is_none()).count(), "{text}");
        checked.into_iter().map(|of| of.cycle).collect::<Vec<_>>()
    };
    use Measure::*;
    let lossy = "frames_are_lost_doubled_late_and_changed.toml";
    let shown = [SyncError, SlotError, LatestFrame, SmallestGap, FramesLost, Locked, Masters, RelockCycles];
    let cycles = failed(lossy, &shown);
    assert!(cycles.iter().all(Option::is_some), "{shown:?}: {cycles:?}");
    assert_ne!(cycles[0], cycles[5], "not simply the last one");
    assert_eq!(failed(lossy, &[PayloadErrors, QueueRefused]), [None, None]);
    let queueing = failed("urgent_frames_overtake_a_backlog.toml", &[QueueingDelay, QueueingP99]);
    assert!(queueing.iter().all(Option::is_some), "{queueing:?}");
    let babble = failed("station_babbles_on_a_hub.toml", &[Collisions, Stray]);
    assert_eq!(babble, [None, None], "nobody babbles now");
}

#[test]
fn the_cycle_that_is_shown_is_the_one_of_the_worst_frame() {
    let mut scenario = loaded("late_frames_without_a_guard_are_told_of.toml");
    let expected = &mut scenario.conditions.expectations[0];
    (expected.measure, expected.relation, expected.limit) = (Measure::LatestFrame, Relation::Less, i64::MIN);
    let ended = sim::run(&scenario, &Options::default()).unwrap();
    let worst =
        ended.figures.simulation.expectations.iter().find(|of| of.expected.starts_with("latest_frame"));
    let cycle = worst.unwrap().cycle.unwrap();
    let misses = &ended.figures.figures.misses;
    let of_this = misses.iter().filter(|miss| miss.cycle == u64::from(cycle));
    assert_eq!(of_this.map(|miss| miss.kind).collect::<Vec<_>>(), [MissKind::StalledInSend], "{misses:#?}");
}

#[test]
fn a_run_ends_when_its_time_is_up() {
    let scenario = loaded("ten_megabits_on_a_hub.toml");
    let until = Some(Span::from_millis(10_000));
    let figures = sim::run(&scenario, &Options { until, ..Options::default() }).unwrap().figures;
    assert!(figures.simulation.virtual_ns <= 10_100_000_000, "{}", figures.simulation.virtual_ns);
    assert!((100..900).contains(&figures.figures.cycles), "what came before was joining");
}

#[test]
fn an_expectation_that_does_not_hold_names_its_cycle_and_the_frames_around_it() {
    let mut scenario = loaded("late_frames_without_a_guard_are_told_of.toml");
    let expected = scenario.conditions.expectations.iter_mut().find(|of| of.measure == Measure::OutOfSlot);
    expected.expect("it does").limit = 0;
    let ended = sim::run(&scenario, &Options::default()).unwrap();
    assert!(!ended.figures.figures.verdict.ok);
    let failed = ended.figures.simulation.expectations.into_iter().find(|checked| !checked.holds).unwrap();
    let cycle = failed.cycle.expect("the first frame that was out of its slot");
    let around = Some((cycle, cycle));
    let lines = sim::run(&scenario, &Options { around, ..Options::default() }).unwrap().lines;
    let of_slave2 =
        lines.iter().find(|line| line.contains("slave2: data") && line.contains(&cycle.to_string()));
    assert!(of_slave2.is_some(), "{lines:#?}");
}

/// A network in a file, with a drawn seed.
pub fn parse(text: &str) -> Scenario {
    scenario::Source::new("net.toml", text).parse().unwrap().with_seed(seeds::one("net.toml"))
}

#[track_caller]
fn check_text(text: &str) {
    let ended = sim::run(&parse(text), &Options::default()).unwrap();
    assert_eq!(ended.figures.figures.verdict.reasons, Vec::<String>::new());
}

/// By a clock that is slow the last cycle is over later than cycles of full length are.
#[test]
fn the_frames_of_the_last_cycle_are_waited_for_however_fast_the_masters_clock_is() {
    for ppm in [-900, -40, 900] {
        let station = |(name, role)| {
            format!("[[station]]\nname = \"{name}\"\nrole = \"{role}\"\nclock = {{ drift_ppm = {ppm} }}\n")
        };
        let stations = [("m", "master"), ("a", "slave"), ("b", "slave")].map(station);
        check_text(&format!("cycle = \"1ms\"\nduration = \"9600ms\"\n{}", stations.concat()));
    }
}

#[test]
fn a_station_joins_a_master_that_was_alone() {
    let text = r#"
        cycle = "1ms"
        duration = "1s"
        # Of 1000 cycles 100 pass before it is started, and 10 rounds take 20: with those to find the line fewer than 130.
        max_miss = "13%"
        [[station]]
        name = "master"
        role = "master"
        [[station]]
        name = "arm"
        role = "slave"
        rounds = 10
        [[event]]
        at = "100ms"
        start = "arm"
        [expect]
        locked = 2
        unexplained = 0
    "#;
    check_text(text);
}

#[test]
fn a_slow_medium_with_slots_of_ones_own_has_a_window_for_its_syncs() {
    let text = r#"
        cycle = "10ms"
        rate = "10M"
        duration = "5s"
        [host]
        wake = "exponential 13us"
        [[station]]
        name = "master"
        role = "master"
        slots = [{ id = 0, offset = "1ms" }]
        [[station]]
        name = "arm"
        role = "slave"
        slots = [{ id = 0, offset = "5ms" }]
        [expect]
        out_of_slot = 0
        unexplained = 0
    "#;
    check_text(text);
}

#[test]
fn a_run_that_has_too_little_time_leaves_the_capture_of_another_as_it_was() {
    let directory = tempfile::tempdir().unwrap();
    let pcap = directory.path().join("frames.pcapng");
    std::fs::write(&pcap, "another").unwrap();
    let scenario =
        scenario::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("cli/two_stations.toml")).unwrap();
    let until = Some(Span::from_millis(5));
    let options = Options { pcap: Some(pcap.clone()), until, ..Options::default() };
    let error = sim::run(&scenario, &options).err().unwrap();
    assert!(error.is::<sim::Hurried>(), "{error:#}");
    assert_eq!(error.to_string(), "the stations were not all locked after 5ms: give it a longer --until");
    assert_eq!(std::fs::read_to_string(&pcap).unwrap(), "another");
    assert_eq!(std::fs::read_dir(&directory).unwrap().count(), 1, "nothing is left beside it");
}

#[test]
fn a_clock_that_is_set_back_keeps_no_run_beyond_its_end() {
    let scenario = loaded("masters_clock_is_set_back.toml");
    let ran = |until| {
        let figures = sim::run(&scenario, &Options { until, ..Options::default() }).unwrap().figures;
        (figures.simulation.virtual_ns, figures.figures.unexplained, figures.simulation.measured_ns)
    };
    let (whole, ..) = ran(None);
    let until = Span::from_millis(8_000);
    let (cut, unexplained, measured) = ran(Some(until));
    assert!(whole > 9_000_000_000, "three of its six seconds are counted again: {whole}");
    assert!(
        cut <= until.nanos() as u64 && unexplained == 0 && measured > 0,
        "{cut} {unexplained} {measured}"
    );
}
