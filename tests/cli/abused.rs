//! Stations that are stopped, killed and started anew, while everything else goes on.
//!
//! `RTNET_STOPS` says how often each kind of stop happens; `scripts/accept live` asks for more than the default.

use std::time::{Duration, Instant};

use nix::sched::{CloneFlags, setns};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use socket2::Socket;
use tools::lab::netlink::Netlink;

use crate::cell::{Cell, STATIONS, status_of, text, wait_until};
use crate::host::{Standstill, figure, network, skip, stop, until_stopped};
use crate::rtnet;

const MILLIS: [u64; 4] = [1, 5, 50, 500];
/// Of the cell, in milliseconds.
const CYCLE_MS: u64 = 4;
/// What a frame may be late on the wire with the kernel's guard, beyond its slot's end.
const RESIDUAL_NS: i64 = 50_000;

/// How often a station is stopped, all stations together.
fn stops() -> usize {
    std::env::var("RTNET_STOPS").map_or(16, |stops| stops.parse().expect("RTNET_STOPS is a number"))
}

fn signal(pid: Pid, signal: Signal) {
    kill(pid, signal).unwrap();
}

/// Stops a station, for each of the lengths in turn.
fn stop_at_random(pid: Pid, times: usize, seed: u64) {
    let mut random = seed;
    for millis in MILLIS.into_iter().cycle().take(times) {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        std::thread::sleep(Duration::from_micros(20_000 + (random >> 33) % 20_000));
        stop(pid);
        std::thread::sleep(Duration::from_millis(millis));
        signal(pid, Signal::SIGCONT);
    }
}

/// The same between its last look at the clock and a `send`: where it cannot know that it is late.
fn stop_before_send(pid: Pid, times: usize, _: u64) {
    for millis in MILLIS.into_iter().cycle().take(times) {
        std::thread::sleep(Duration::from_millis(30));
        signal(pid, Signal::SIGUSR1);
        until_stopped(pid);
        std::thread::sleep(Duration::from_millis(millis));
        signal(pid, Signal::SIGCONT);
    }
}

/// What came of it.
struct Stopped {
    account: Value,
    /// For how long a core stood still meanwhile.
    still: Duration,
}

/// Stops the slaves, all at a time, and then the master.
fn stopped(guard: &str, stop: fn(Pid, usize, u64)) -> Stopped {
    let watch = Standstill::watch();
    let cell = Cell::with(guard, |text| format!("slot_guard = \"{guard}\"\n{text}"));
    wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
    let pids = STATIONS.map(|name| Pid::from_raw(cell.station(name)["pid"].as_i64().unwrap() as i32));
    let times = stops().div_ceil(STATIONS.len());
    std::thread::scope(|scope| {
        for (seed, &pid) in pids[1..].iter().enumerate() {
            scope.spawn(move || stop(pid, times, seed as u64));
        }
    });
    stop(pids[0], times, 99);
    cell.wait_until_locked();
    std::thread::sleep(Duration::from_millis(200));
    let account = cell.down();
    assert_eq!((&account["unexplained"], &account["frames_lost"]), (&0.into(), &0.into()), "{account:#}");
    let causes = &account["causes"];
    assert_eq!(causes["station_stopped"], Value::Null, "each tells of its own when it goes on: {causes}");
    let told: u64 = ["preempted", "stalled_in_send"].map(|of| causes[of].as_u64().unwrap_or(0)).iter().sum();
    let slept: u64 =
        MILLIS.into_iter().cycle().take(times).map(|millis| (millis / CYCLE_MS).saturating_sub(1)).sum();
    assert!(
        told >= STATIONS.len() as u64 * slept,
        "{told} of {slept} slots that each slept through: {causes}"
    );
    Stopped { account, still: watch.over().longest }
}

/// How much later than its slot's end the latest frame, or Synchronisation, was gone.
fn latest(account: &Value) -> i64 {
    account["latest_frame_ns"].as_i64().unwrap()
}

/// What all stations told of, of one kind.
fn told(account: &Value, kind: &str) -> u64 {
    let stations = account["stations"].as_array().unwrap();
    stations.iter().map(|station| station["events"][kind].as_u64().unwrap_or(0)).sum()
}

/// What the kernel's guard did not let pass.
fn dropped(account: &Value) -> u64 {
    told(account, "guard_dropped") + told(account, "sync_dropped")
}

/// A virtual processor may be taken away behind the guard, before the wire: once, with luck, but not at every stop; and
/// it was seen to stand still for so long. If that was with a sync, all frames of its cycle are late.
fn is_by_the_host(Stopped { account, still }: &Stopped) -> bool {
    account["out_of_slot"].as_u64().unwrap() <= STATIONS.len() as u64
        && latest(account) < still.as_nanos() as i64
}

/// Whether the kernel guarded all stations; says so if it was to and did not.
fn guard_is_as_asked(guard: &str, account: &Value, test: &str) -> bool {
    let guarded = account["stations"].as_array().unwrap().iter().all(|station| station["guard"] == "kernel");
    if guard == "auto" && !guarded {
        skip(test, "this host has no kernel guard");
    }
    guarded
}

#[test]
fn stations_that_are_stopped_at_random_leave_nothing_unexplained() {
    network("stations_that_are_stopped_at_random_leave_nothing_unexplained", || {
        for guard in ["auto", "user"] {
            let stopped = stopped(guard, stop_at_random);
            let (account, still) = (&stopped.account, stopped.still);
            let late = latest(account);
            figure(
                "stations_that_are_stopped_at_random",
                &format!(
                    "at random, {guard}: {} stops, latest frame {late} ns after its slot (a core stood still for {still:?})",
                    stops()
                ),
            );
            if guard_is_as_asked(guard, account, "stations_that_are_stopped_at_random") {
                assert!(late <= RESIDUAL_NS || is_by_the_host(&stopped), "{account:#}");
            }
        }
    });
}

#[test]
fn stations_that_are_stopped_before_they_send_are_late_only_without_the_kernel_guard() {
    let test = "stations_that_are_stopped_before_they_send_are_late_only_without_the_kernel_guard";
    network(test, || {
        for guard in ["auto", "user"] {
            let stopped = stopped(guard, stop_before_send);
            let (account, still) = (&stopped.account, stopped.still);
            let (late, dropped, stalled) =
                (latest(account), dropped(account), told(account, "stalled_in_send"));
            figure(
                "stations_that_are_stopped_before_they_send",
                &format!(
                    "before send, {guard}: {} stops, latest frame {late} ns after its slot, {dropped} dropped, {stalled} \
                     stalled (a core stood still for {still:?})",
                    stops()
                ),
            );
            assert!(dropped + stalled >= stops() as u64, "each was told of: {account:#}");
            if guard_is_as_asked(guard, account, "stations_that_are_stopped_before_they_send") {
                assert!(late <= RESIDUAL_NS || is_by_the_host(&stopped), "{account:#}");
                assert!(dropped >= stops() as u64, "{account:#}");
            } else {
                assert!(late > RESIDUAL_NS, "what the guard is for");
            }
        }
    });
}

/// Long enough for what is to be seen within three of them to be seen on a host that stands still for a while.
const LONG_CYCLE: Duration = Duration::from_millis(8);
/// From a cycle's start on, a slave knows that it has no sync after an eighth of it.
const GRACE: Duration = Duration::from_millis(1);

/// How long it takes until somebody who looks all the time sees a state.
fn until_seen(socket: &mut Socket, since: Instant, is_seen: impl Fn(&Value) -> bool) -> Duration {
    loop {
        if is_seen(&status_of(socket)) {
            return since.elapsed();
        }
        assert!(since.elapsed() < Duration::from_secs(60), "in vain");
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn pid(cell: &Cell, station: &str) -> Pid {
    Pid::from_raw(cell.station(station)["pid"].as_i64().unwrap() as i32)
}

/// Whether a lab says of all its slaves that they are in a state.
fn slaves_are(state: &str) -> impl Fn(&Value) -> bool {
    move |lab| (1..STATIONS.len()).all(|place| lab["stations"][place]["state"] == state)
}

/// Kills a slave: how long until the lab says so.
fn kill_slave(cell: &Cell, place: usize) -> Duration {
    let mut lab = cell.connect("");
    signal(pid(cell, STATIONS[place]), Signal::SIGKILL);
    until_seen(&mut lab, Instant::now(), |status| status["stations"][place]["state"] == "ended")
}

/// Kills the master: how much longer than it must take until the lab says that all slaves have lost it.
fn kill_master(cell: &Cell) -> Duration {
    let mut slaves = STATIONS[1..].iter().map(|name| cell.connect(name)).collect::<Vec<_>>();
    let mut lab = cell.connect("");
    signal(pid(cell, "master"), Signal::SIGKILL);
    let seen = until_seen(&mut lab, Instant::now(), slaves_are("lost"));
    let sent = |slave: &mut Socket| status_of(slave)["counters"]["frames_sent"].clone();
    let before: Vec<Value> = slaves.iter_mut().map(sent).collect();
    std::thread::sleep(LONG_CYCLE * 5);
    let after: Vec<Value> = slaves.iter_mut().map(sent).collect();
    assert_eq!(before, after, "they are silent");
    // A sync had just been sent: the next is bridged, and the one after it is the loss.
    seen.saturating_sub(LONG_CYCLE * 2 + GRACE)
}

/// Starts the master anew: how long after it gives the time again until the lab says that all slaves are locked, less the
/// cycles whose Synchronisation it tells that the host held up.
fn restart_master(cell: &Cell) -> Duration {
    let mut lab = cell.connect("");
    cell.restart("master");
    let seen = until_seen(&mut lab, Instant::now(), slaves_are("locked"));
    if seen <= LONG_CYCLE * 3 {
        return seen;
    }
    // It counts ten times a second.
    std::thread::sleep(Duration::from_millis(150));
    let skipped = cell.station("master")["counters"]["syncs_skipped"].as_u64().unwrap();
    seen.saturating_sub(LONG_CYCLE * skipped as u32)
}

#[test]
fn killed_stations_are_seen_at_once_and_come_back_beside_the_others() {
    let test = "killed_stations_are_seen_at_once_and_come_back_beside_the_others";
    network(test, || {
        let cell =
            Cell::with("killed", |text| text.replace("4ms", "8ms").replace("rounds = 20", "rounds = 3"));
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        let mut seen = Vec::new();
        let rounds = stops().div_ceil(16);
        for _ in 0..rounds {
            for (place, name) in STATIONS.iter().enumerate().skip(1) {
                seen.push((kill_slave(&cell, place), "slave killed"));
                cell.restart(name);
            }
            seen.push((kill_master(&cell), "master killed"));
            seen.push((restart_master(&cell), "master restarted"));
        }
        seen.sort();
        let cycles = |(took, _): (Duration, _)| took.as_secs_f64() / LONG_CYCLE.as_secs_f64();
        let (median, longest) = (cycles(seen[seen.len() / 2]), cycles(*seen.last().unwrap()));
        figure(
            test,
            &format!(
                "killed: {} changes of state, seen {median:.2} cycles after they could be known of, at most {longest:.2}",
                seen.len()
            ),
        );
        // A lab that looked ten times a second would see half of them after six cycles and more. One alone may be late: whoever
        // tells of it, and this test, wait for a core as the host lets them.
        assert!(median <= 3.0, "{seen:?}");
        cell.wait_until_locked();
        std::thread::sleep(LONG_CYCLE * 3);
        let account = cell.down();
        assert_eq!((&account["unexplained"], &account["frames_lost"]), (&0.into(), &0.into()), "{account:#}");
        let restarts = account["stations"]
            .as_array()
            .unwrap()
            .iter()
            .map(|station| station["restarts"].as_u64().unwrap());
        assert!(restarts.into_iter().all(|n| n == rounds as u64), "{account:#}");
        let causes = &account["causes"];
        assert!(
            causes["station_down"].as_u64() > Some(0) && causes["sync_lost_or_late"].as_u64() > Some(0),
            "{causes}"
        );
    });
}

/// What is done to the interface of a station from outside.
fn to_interface(
    cell: &Cell,
    station: &str,
    act: impl FnOnce(&mut Netlink, u32) -> anyhow::Result<()> + Send,
) {
    to_link(&format!("/proc/{}/ns/net", pid(cell, station)), "rt0", act);
}

/// The same to its port of the bridge: the other end of its wire.
fn to_port(cell: &Cell, place: usize, act: impl FnOnce(&mut Netlink, u32) -> anyhow::Result<()> + Send) {
    let status = cell.status();
    to_link(status["bridge_namespace"].as_str().unwrap(), &format!("port{place}"), act);
}

fn to_link(namespace: &str, link: &str, act: impl FnOnce(&mut Netlink, u32) -> anyhow::Result<()> + Send) {
    let namespace = std::fs::File::open(namespace).unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            setns(&namespace, CloneFlags::CLONE_NEWNET).unwrap();
            let mut netlink = Netlink::open().unwrap();
            let link = netlink.link_index(link).unwrap();
            act(&mut netlink, link).unwrap();
        });
    });
}

#[test]
fn a_station_whose_interface_goes_down_or_away_comes_back_beside_the_others() {
    let test = "a_station_whose_interface_goes_down_or_away_comes_back_beside_the_others";
    network(test, || {
        let cell = Cell::up("wires");
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        let state = |place: usize| cell.status()["stations"][place]["state"].as_str().unwrap().to_owned();
        to_interface(&cell, "slave2", |netlink, interface| netlink.set_down(interface));
        wait_until("it is seen", || state(2) == "lost, down");
        let other = state(1);
        assert!(
            ["locked", "holdover"].contains(&other.as_str()),
            "{other}: the others go on, a busy host may skip a sync"
        );
        to_interface(&cell, "slave2", |netlink, interface| netlink.set_up(interface));
        wait_until("it is locked again", || state(2) == "locked");

        // Where the other end is cut, sending does not fail.
        for place in [1, 0] {
            let cuts = || cell.status()["stations"][place]["cuts"].as_u64();
            let before = cuts();
            to_port(&cell, place, |netlink, port| netlink.set_down(port));
            wait_until("it is seen", || cuts() > before);
            std::thread::sleep(Duration::from_millis(300));
            to_port(&cell, place, |netlink, port| netlink.set_up(port));
            wait_until("all are locked again", || (0..3).all(|place| state(place) == "locked"));
        }

        to_interface(&cell, "slave3", |netlink, interface| netlink.delete_link(interface));
        wait_until("it cannot go on", || state(3) == "ended");
        let failed = cell.status()["stations"][3]["failed"].clone();
        assert!(failed.as_str().unwrap().contains("the interface 'rt0' is gone"), "{failed}");
        cell.restart("slave3");
        let causes = || cell.status()["causes"].clone();
        wait_until("it is judged", || causes()["station_down"].as_u64() > Some(0));
        assert!(causes()["no_carrier"].as_u64() > Some(0), "{}", causes());
        assert_eq!(cell.status()["unexplained"], 0, "{:#}", cell.status());
    });
}

#[test]
fn a_lab_goes_down_whose_stations_are_stopped() {
    network("a_lab_goes_down_whose_stations_are_stopped", || {
        let cell = Cell::up("halted");
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        STATIONS[1..].iter().for_each(|name| stop(pid(&cell, name)));
        std::thread::sleep(Duration::from_millis(300));
        let output = rtnet().args(["lab", "status", &cell.name]).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "so far, too: {}", text(&output.stdout));
        let words = text(&output.stdout);
        assert!(words.lines().any(|line| line.starts_with("NOT OK: ")), "{words}");
        let verdict = cell.status()["verdict"].clone();
        assert_eq!((&verdict["word"], &verdict["ok"]), (&"not_ok".into(), &false.into()), "{verdict}");
        for said in [&words, &verdict["reasons"].to_string()] {
            assert!(said.contains("station 'slave1' is stopped"), "{said}");
        }
        // It ends at all only because nobody waits for them: a lab that stays is told of instead of its account.
        let output = rtnet().args(["lab", "down", &cell.name, "--json"]).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "they are stopped: {}", text(&output.stderr));
        let account = crate::schema::read(&output.stdout);
        assert_eq!(account[0]["unexplained"], 0, "{account:#}");
        assert_eq!(account[0]["stations"][1]["state"], "stopped", "{account:#}");
        let reasons = account[0]["verdict"]["reasons"].to_string();
        assert!(reasons.contains("station 'slave1' is stopped"), "{reasons}");
    });
}

#[test]
fn a_master_that_is_away_for_long_is_missed_by_cause_to_the_end() {
    network("a_master_that_is_away_for_long_is_missed_by_cause_to_the_end", || {
        let cell = Cell::up("away");
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        let master = pid(&cell, "master");
        // For more cycles than slaves keep their line without it.
        stop(master);
        wait_until("it is seen", || cell.status()["stations"][0]["state"] == "stopped");
        std::thread::sleep(Duration::from_millis(4_500));
        signal(master, Signal::SIGCONT);
        cell.wait_until_locked();
        signal(master, Signal::SIGKILL);
        std::thread::sleep(Duration::from_millis(3_500));
        let output = rtnet().args(["lab", "down", &cell.name, "--json"]).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "it was lost");
        let account = crate::schema::read(&output.stdout);
        let account = &account[0];
        assert_eq!(account["unexplained"], 0, "{account:#}");
        // 3.5 s of 4 ms: its syncs, and its frames.
        assert!(account["causes"]["station_down"].as_u64() > Some(2 * 800), "{account:#}");
        // And 8 s of three slaves' frames; a busy host may have kept slaves from noticing in time that there is no sync.
        let causes =
            ["sync_lost_or_late", "timer_late", "preempted"].map(|why| account["causes"][why].as_u64());
        assert!(causes[0] > Some(3 * 900), "{account:#}");
        assert!(causes.iter().flatten().sum::<u64>() > 3 * 1_800, "{account:#}");
        let count = |name: &str| account[name].as_u64().unwrap();
        assert_eq!(count("frames_seen") + count("slots_missed"), count("frames_expected"));
    });
}
