//! Labs whose stations have addresses: they know each other, programs attach to them, and echoes take what the schedule says.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::process::{Child, Stdio};
use std::time::Duration;

use rtnet::api::{Station, UdpSocket};
use serde_json::Value;

use crate::cell::{Cell, json, text, wait_until};
use crate::host::{alone, figure, network, skip};
use crate::rtnet;

const LAB: &str = include_str!("addresses.toml");
const MASTER: &str = "10.0.0.1";
const LEG: &str = "10.0.0.7";
const CYCLE: u64 = 1_000_000;
/// What two clocks may be apart, as the specification defines it for slots.
const CLOCKS: u64 = 10_000;
/// On a host that sends so unsteadily nothing can be told of a schedule.
const TOO_UNSTEADY: u64 = CYCLE / 4;

fn lab(what: &str) -> Cell {
    Cell::with(what, |_| LAB.to_owned())
}

/// The same without addresses.
fn plain() -> String {
    LAB.replace("network", "# network").replace("ip =", "# ip =")
}

fn ask(cell: &Cell, verb: &str, station: &str, arguments: &[&str]) -> Value {
    json(rtnet().args([verb, "-S", &cell.place(station), "--json"]).args(arguments))
}

fn ping(cell: &Cell, to: &str) -> Child {
    let mut command = rtnet();
    command.args(["ping", "-S", &cell.place("arm"), "--json", "-c", "50", "-i", "20ms", to]);
    command.stdout(Stdio::piped()).spawn().unwrap()
}

fn came_back(child: Child) -> u64 {
    let output = child.wait_with_output().unwrap();
    let round = crate::schema::read(&output.stdout);
    round["received"].as_u64().unwrap()
}

fn socket(cell: &Cell, station: &str, port: u16) -> UdpSocket {
    let socket = Station::named(&cell.place(station)).and_then(|station| station.udp()).unwrap();
    socket.set_timeout(Some(Duration::from_secs(20)));
    socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port)).unwrap();
    socket
}

#[test]
fn stations_of_a_lab_have_addresses_know_each_other_and_have_sockets_for_programs() {
    network("stations_of_a_lab_have_addresses_know_each_other_and_have_sockets_for_programs", || {
        let cell = lab("addresses");
        let shown = ask(&cell, "if", "leg", &[]);
        assert_eq!((&shown["ip"], &shown["prefix"]), (&LEG.into(), &24.into()), "{shown:#}");
        assert_eq!(
            shown["channels"],
            serde_json::json!({"0": {"payload": 1_500}}),
            "its only slot: {shown:#}"
        );
        let routes = ask(&cell, "route", "arm", &["list"]);
        let hosts = routes["hosts"].as_array().unwrap();
        let hosts: Vec<_> =
            hosts.iter().map(|host| (&host["ip"], &host["address"], &host["origin"])).collect();
        let to = |ip: &str, address: &str| (Value::from(ip), Value::from(address), Value::from("static"));
        let (master, leg) = (to(MASTER, "02:00:00:00:00:01"), to(LEG, "02:00:00:00:00:03"));
        assert_eq!(hosts, [(&master.0, &master.1, &master.2), (&leg.0, &leg.1, &leg.2)]);
        let status = cell.status();
        let ips: Vec<&Value> = status["stations"].as_array().unwrap().iter().map(|of| &of["ip"]).collect();
        assert_eq!(ips, ["10.0.0.1/24", "10.0.0.2/24", "10.0.0.7/24"]);
        let words = rtnet().args(["lab", "status", &cell.name]).output().unwrap();
        let words = text(&words.stdout);
        assert!(
            words.contains(" ip          ") && words.contains(" 02:00:00:00:00:03 10.0.0.7/24 "),
            "{words}"
        );
        // Two who ask at once have each their own answers.
        let both = [MASTER, LEG].map(|to| ping(&cell, to));
        assert_eq!(both.map(came_back), [50, 50]);
        // A frame and, in fragments, more.
        let (here, there) = (socket(&cell, "arm", 36_000), socket(&cell, "leg", 36_001));
        for len in [8, 4_000] {
            let (sent, mut room) = (vec![len as u8; len], [0; 5_000]);
            here.send_to(&sent, SocketAddrV4::new(LEG.parse().unwrap(), 36_001)).unwrap();
            let received = there.receive(&mut room).unwrap();
            assert_eq!(room[..received.len], sent);
        }
        assert!(ask(&cell, "pool", "leg", &[]).as_array().unwrap().len() > 3, "its socket has one");
        drop((here, there));
        // What programs sent was in its slots, and nothing is missed for it that is unexplained.
        let account = cell.down();
        assert_eq!(account["unexplained"], 0, "{account:#}");
    });
}

#[test]
fn a_station_of_a_lab_that_is_started_anew_has_its_address_and_knows_the_others() {
    network("a_station_of_a_lab_that_is_started_anew_has_its_address_and_knows_the_others", || {
        let cell = lab("anew");
        cell.restart("arm");
        assert_eq!(came_back(ping(&cell, MASTER)), 50, "it knows them, and they know it");
    });
}

#[test]
fn an_echo_that_does_not_fit_the_slot_of_who_would_answer_is_refused() {
    network("an_echo_that_does_not_fit_the_slot_of_who_would_answer_is_refused", || {
        let cell = lab("answers");
        let offset = cell.station("leg")["slots"][0]["offset_ns"].as_u64().unwrap();
        assert!(cell.slot("leg", &["set", &format!("0={offset}ns,size=100")]).status.success());
        wait_until("its slot is smaller", || cell.station("leg")["slots"][0]["size"] == 100);
        let output = rtnet()
            .args(["ping", "-S", &cell.place("arm"), "--size", "73", "-c", "1", LEG])
            .output()
            .unwrap();
        let why = text(&output.stderr);
        let whose = format!("slot 0 of station '{}', which takes 100", cell.place("leg"));
        assert_eq!(output.status.code(), Some(2), "{why}");
        assert!(why.contains(&whose) && why.contains("ask with --size 72 or less"), "{why}");
        cell.down();
    });
}

#[test]
fn a_lab_without_addresses_has_no_sockets() {
    network("a_lab_without_addresses_has_no_sockets", || {
        let cell = Cell::with("plain", |_| plain());
        let output = rtnet().args(["ping", "-S", &cell.place("arm"), MASTER]).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        assert!(
            text(&output.stderr).contains("it has no sockets and no address"),
            "{}",
            text(&output.stderr)
        );
        cell.down();
    });
}

#[test]
fn echoes_in_a_lab_take_what_the_schedule_says() {
    let test = "echoes_in_a_lab_take_what_the_schedule_says";
    alone(test, || {
        let cell = lab("schedule");
        let round = ask(&cell, "ping", "arm", &["-c", "1000", "-i", "2ms", MASTER]);
        let (schedule, rest) = (&round["schedule"], &round["rest_ns"]["p50"]);
        let of = |name: &str| schedule[name].as_u64().unwrap_or_else(|| panic!("{name}: {schedule:#}"));
        let (best, worst, lead, jitter) = (of("best_ns"), of("worst_ns"), of("lead_ns"), of("jitter_ns"));
        let (quicker, longer, missed) = (of("quicker"), of("longer"), of("slots_missed"));
        let mut trips: Vec<u64> = round["answers"].as_array().unwrap().iter().flat_map(trip).collect();
        trips.sort_unstable();
        let n = trips.len() as u64;
        let (p1, p99) = (trips[trips.len() / 100], trips[trips.len() * 99 / 100]);
        let [says, took, unsteady] =
            [(best, worst), (p1, p99), (lead, jitter)].map(|(a, b)| (a / 1_000, b / 1_000));
        figure(
            test,
            &format!(
                "{n} echoes: the schedule says {} to {} us, or up to {} us less; 98 of 100 took {} to {} us, with a jitter of \
                 {} us; {quicker} were quicker and {longer} took longer, while {missed} slots were missed",
                says.0, says.1, unsteady.0, took.0, took.1, unsteady.1
            ),
        );
        // Whatever the host does: a slot is a cycle away at the most, and what it misses comes later. While a station is held
        // up some cannot be asked, and are told of.
        assert_eq!(worst - best, CYCLE);
        let failed: u64 = round["failures"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
        // The host itself may drop a few.
        assert!(n + failed >= 990, "{n} came back: {schedule:#} {}", round["failures"]);
        if jitter > TOO_UNSTEADY {
            return skip(test, &format!("this host sends too unsteadily, by {} us", unsteady.1));
        }
        let rest = rest.as_u64().unwrap();
        assert!(
            rest.abs_diff(best - lead) <= jitter + CLOCKS,
            "the way, and the other's slot: {rest} {schedule:#}"
        );
        // One of 20 may be beside the jitter, by what that is.
        assert!(quicker <= n / 20 && longer <= n / 20 + missed, "{schedule:#}");
        // Echoes are asked evenly over the cycle, so the 1 % quantile lies a hundredth of it from its end. An echo whose slot
        // was missed takes a cycle longer: each moves the quantile by one place at most.
        let step = CYCLE / 100 + CYCLE * missed / n;
        assert!(p1 <= best + step + jitter, "the best case comes: {p1} {schedule:#}");
        assert!(p99 + lead + step + jitter >= worst, "and the worst: {p99} {schedule:#}");
        cell.down();
    });
}

#[test]
fn a_simulation_says_that_addresses_are_only_in_a_lab() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("addresses.toml");
    let note = "only in a lab (rtnet lab up), and not here: network and ip";
    for (with, is_noted) in
        [(LAB.to_owned(), true), (LAB.replace("network", "# network"), true), (plain(), false)]
    {
        std::fs::write(&file, format!("duration = \"100ms\"\n{with}")).unwrap();
        let output = rtnet().args(["sim", "run"]).arg(&file).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        // Lines are as wide as a screen.
        let words = text(&output.stdout).split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(words.contains(note), is_noted, "{words}");
    }
}

fn trip(answer: &Value) -> Option<u64> {
    answer["round_trip_ns"].as_u64()
}
