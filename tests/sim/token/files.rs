//! Rings in files, as `rtnet sim run` runs them.

use tests::seeds;
use tools::report::html::markup::{count, us};
use tools::ring::{self, RingFigures, page, render};
use tools::scenario::{Network, RingScenario, Source};
use tools::sim::Options;

const RING: &str = r#"
discipline = "token"
rate = "100M"
duration = "2s"
[[station]]
name = "arm"
[[station]]
name = "leg"
payload = 200
[[station]]
name = "eye"
[[station.traffic]]
priority = 3
every = "10ms"
burst = 2
payload = 400
[[station]]
name = "head"
"#;

fn scenario(more: &str) -> RingScenario {
    match Source::new("ring.toml", &format!("{RING}{more}")).parse_any() {
        Ok(Network::Ring(ring)) => ring,
        Ok(Network::Slots(_)) => panic!("it has slots"),
        Err(why) => panic!("{why}"),
    }
}

fn run(more: &str) -> RingFigures {
    ring::run(&scenario(more), &Options::default()).unwrap()
}

fn assert_well(figures: &RingFigures) {
    assert!(figures.verdict.ok, "{}", render(figures, 100));
    assert_eq!((figures.unexplained, figures.payload_errors), (0, 0));
}

#[test]
fn a_ring_of_ideal_hosts_loses_nothing_and_keeps_its_bounds() {
    let figures = run("");
    assert_well(&figures);
    assert_eq!((figures.overlaps, figures.frames_lost, figures.recovery_ns.n), (0, 0, 0));
    // Each rests 250 us in a round, and sends a frame.
    assert!((1_900..=2_000).contains(&figures.rounds), "{}", figures.rounds);
    assert!(figures.frames_seen >= figures.rounds * 4);
    assert!(figures.rotation_ns.max.unwrap() <= figures.bounds.rotation_ns);
    let [queued] = &figures.queueing[..] else { panic!("of one priority") };
    assert_eq!((queued.priority, queued.frames_seen, queued.refused), (3, 400, 0));
    assert!(queued.delay_ns.max.unwrap() <= figures.bounds.access_delay_ns + 50_000, "{queued:?}");
}

#[test]
fn a_station_that_dies_and_returns_costs_no_more_than_the_bound() {
    let figures =
        run("[[event]]\nat = \"500ms\"\nkill = \"leg\"\n[[event]]\nat = \"1s\"\nrestart = \"leg\"\n");
    assert_well(&figures);
    assert_eq!(figures.causes.get("event"), Some(&1), "{:?}", figures.causes);
    assert!(figures.recovery_ns.max.unwrap() <= figures.bounds.recovery_ns);
    assert!(figures.recovery_ns.max.unwrap() > 1_000_000, "it was lost, not given back");
    let [arm, leg, ..] = &figures.per_station[..] else { panic!("four") };
    assert!(figures.invitations > 10, "{}", figures.invitations);
    assert!(leg.visits > 1_000 && leg.visits < arm.visits - 300, "{} of {}", leg.visits, arm.visits);
    assert_ne!(leg.state, "down");
}

#[test]
fn each_that_dies_while_another_babbles_or_is_stopped_is_explained() {
    let events = [
        "kill = \"arm\"\n",
        "stop = \"leg\"\nfor = \"20ms\"\n",
        "stall = \"eye\"\nfor = \"5ms\"\n",
        "babble = { station = \"leg\", every = \"50us\" }\nfor = \"10ms\"\n",
        "unplug = \"eye\"\nfor = \"30ms\"\n",
        "clock = { stations = \"leg\", step = \"-7ms\" }\n",
        "wire = { lose = \"20%\" }\nfor = \"100ms\"\n",
    ];
    let all: Vec<String> = events
        .iter()
        .enumerate()
        .map(|(i, event)| format!("[[event]]\nat = \"{}ms\"\n{event}", 100 + i * 250))
        .collect();
    seeds::each(20, move |seed| {
        let scenario = scenario(&all.concat()).with_seed(seed);
        let figures = ring::run(&scenario, &Options::default()).unwrap();
        assert_well(&figures);
        assert!(figures.recovery_ns.n >= 4, "{}", render(&figures, 100));
        assert!(figures.tokens_claimed > 0 || figures.stations_skipped > 0);
        assert_eq!(figures.per_station[0].state, "down");
    });
}

#[test]
fn a_station_that_hardly_had_the_token_makes_a_ring_not_ok() {
    let unplugged = |time| run(&format!("[[event]]\nat = \"100ms\"\nunplug = \"eye\"\nfor = \"{time}\"\n"));
    assert_well(&unplugged("800ms"));
    let line = unplugged("1200ms").verdict.line("well");
    assert!(
        line.starts_with("NOT OK: station 'eye' had the token ") && line.contains(" times of "),
        "{line}"
    );
}

#[test]
fn hosts_that_are_late_lose_their_turns_and_leave_nothing_unexplained() {
    let host = "[host]\nwake = \"exponential 60us\"\noutages = { ppm = 3000, longest = \"4ms\" }\n";
    let figures = run(host);
    assert_well(&figures);
    assert!(figures.causes.get("late_host").is_some_and(|n| *n > 5), "{}", render(&figures, 100));
}

#[test]
fn tokens_that_wires_lose_are_no_secret() {
    let figures = run("[[wire]]\nlose = \"2%\"\n");
    assert_well(&figures);
    assert!(figures.recovery_ns.n > 20 && figures.lost_on_purpose > 20, "{}", render(&figures, 100));
    assert_eq!(figures.frames_lost, figures.lost_on_purpose);
}

#[test]
fn one_seed_is_one_run_of_a_ring_to_the_byte() {
    let json = |seed| {
        let scenario = scenario("[host]\nwake = \"exponential 60us\"\n").with_seed(seed);
        serde_json::to_string(&ring::run(&scenario, &Options::default()).unwrap()).unwrap()
    };
    assert_eq!(json(3), json(3));
    assert_ne!(json(3), json(4));
}

#[test]
fn the_page_of_a_ring_leaves_out_slots_says_so_and_takes_no_name_for_markup() {
    let figures = run("[[event]]\nat = \"500ms\"\nkill = \"leg\"\n");
    let page = page("<ring>.toml", &figures);
    assert!(page.contains("there is no slot error, no picture of cycles"), "{page}");
    assert!(page.contains("&lt;ring&gt;.toml") && !page.contains("<ring>"));
    assert!(!page.contains("http"), "it asks for nothing");
}

#[test]
fn the_page_of_a_ring_has_a_plot_of_its_rounds_and_the_indicators_that_a_ring_has() {
    let figures = run("");
    let html = page("ring.toml", &figures);
    assert_eq!(html.matches("<path class=\"curve ").count(), 4, "a line for each station");
    assert!(
        html.contains("rounds per 20 µs, log scale") && html.contains("were promised where nothing is lost")
    );
    let kept = &figures.kept;
    let octets = |station: usize| figures.kept.carried[station].0;
    let [arm, leg, eye, _] = &figures.per_station[..] else { panic!("four") };
    assert_eq!((octets(0), octets(1)), (arm.frames_seen * 64, leg.frames_seen * 200));
    assert_eq!(octets(2), (eye.frames_seen - 400) * 64 + 400 * 400);
    let two_rounds = figures.rotation_ns.min.unwrap() * 2..figures.bounds.rotation_ns * 2;
    assert!(two_rounds.contains(&kept.delivery_with_a_loss.span.unwrap().nanos()), "{kept:?}");
    let row = |name: &str| {
        html.lines().find(|line| line.contains(name)).unwrap_or_else(|| panic!("{name}")).to_owned()
    };
    assert!(row("Delivery time, max, no frame lost").contains(&us(figures.delivery_ns.max)));
    assert!(row("Redundancy recovery time").contains("no token was lost in this run"));
    assert!(row("Time synchronisation accuracy").contains("nobody gives the time in a ring"));
    assert!(row("Basic network topology").contains("Simulated wires to one bridge"));
    let sum: u64 = kept.carried.iter().map(|(octets, _)| octets).sum();
    let per_second = count(sum * 1_000_000_000 / figures.measured_ns);
    assert!(row("Throughput RTE").contains(&(per_second + " octets/s")), "{sum}");
}
