//! `rtnet ping` at a station that cannot send: why its questions never left.

use std::process::Stdio;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::host::{shared, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

/// Where nobody answers.
const THERE: &str = "10.0.0.9";
const NOBODY: &str = "02:00:00:00:00:09";
/// Echoes that may wait for a slot at once.
const ROOM: u64 = 8;

/// A station with an address and one slot, which knows a way there.
fn station(medium: &Medium, name: &str, role: &[&str], says: &str) -> Station {
    let options = ["--interface", "rt0", "--name", name, "--ip", "10.0.0.1/24", "--slot", "0=1ms"];
    let station = Station::start(&medium.a, &[&options[..], role].concat());
    station.wait_for(says);
    let deadline = Instant::now() + PATIENCE;
    while !rtnet().args(["route", "-S", name, "add", THERE, NOBODY]).output().unwrap().status.success() {
        assert!(Instant::now() < deadline, "it is there");
        std::thread::sleep(Duration::from_millis(20));
    }
    station
}

fn said(arguments: &[&str]) -> String {
    let output = rtnet().args(arguments).output().unwrap();
    String::from_utf8(output.stdout).unwrap()
}

fn round(name: &str, questions: &str) -> Value {
    crate::schema::read(said(&["ping", "-S", name, "-c", questions, "-i", "20ms", "--json", THERE]))
}

#[test]
fn a_slave_without_a_master_says_that_no_question_left_and_what_is_missing() {
    shared("a_slave_without_a_master_says_that_no_question_left_and_what_is_missing", || {
        let (medium, name) = (Medium::new(), unique("alone"));
        let _station = station(&medium, &name, &["--slave"], "Ctrl-C ends it");
        let words = said(&["ping", "-S", &name, "-c", "10", "-i", "20ms", THERE]);
        let why = format!(
            "it is not synchronised (waiting): start a master, or see whom it hears (`rtnet tdma -S {name} status`)"
        );
        assert!(words.contains("8 sent, 0 came back, 100.0 % lost, 2 were not asked:\n"), "{words}");
        let behind = "the echoes before it wait for a slot still, and no buffer is left";
        assert!(words.contains(&format!("\n  2 times: {behind}: {why}\n")), "{words}");
        let line = format!("\nstation '{name}': 10 of 10 questions never left: {why}\n");
        assert!(words.contains(&line), "{words}");
        // Those of the first round wait still.
        let next = round(&name, "3");
        assert_eq!(
            (&next["never_left"], &next["why_never_left"]),
            (&3.into(), &why.as_str().into()),
            "{next:#}"
        );
    });
}

#[test]
fn a_station_whose_only_slot_was_removed_says_which_is_missing() {
    shared("a_station_whose_only_slot_was_removed_says_which_is_missing", || {
        let (medium, name) = (Medium::new(), unique("slotless"));
        let _station = station(&medium, &name, &["--master", "--cycle", "10ms"], "master_active");
        let sent = round(&name, "3");
        assert_eq!((&sent["lost"], &sent["never_left"]), (&3.into(), &0.into()), "they left: {sent:#}");
        assert!(sent.get("why_never_left").is_none(), "{sent:#}");
        said(&["slot", "-S", &name, "remove", "0"]);
        let words = said(&["ping", "-S", &name, "-c", "3", "-i", "20ms", THERE]);
        let why = "3 times: slot 1 is not defined: define it, or send in another channel\n";
        assert!(words.contains(why), "{words}");
    });
}

#[test]
fn a_station_that_is_detached_midway_says_so_of_the_questions_that_did_not_leave() {
    shared("a_station_that_is_detached_midway_says_so_of_the_questions_that_did_not_leave", || {
        let (medium, name) = (Medium::new(), unique("midway"));
        let _station = station(&medium, &name, &["--master", "--cycle", "10ms"], "master_active");
        let mut command = rtnet();
        command.args(["ping", "-S", &name, "-c", "50", "-i", "100ms", "--json", THERE]);
        let ping = command.stdout(Stdio::piped()).spawn().unwrap();
        let sent = || -> u64 {
            let status: Value = crate::schema::read(said(&["tdma", "-S", &name, "status", "--json"]));
            status["slots"][0]["sent"].as_u64().unwrap()
        };
        let deadline = Instant::now() + PATIENCE;
        while sent() < 3 {
            assert!(Instant::now() < deadline, "questions leave");
            std::thread::sleep(Duration::from_millis(20));
        }
        said(&["tdma", "-S", &name, "detach"]);
        // However long that took: what has left until then has, and nothing does any more.
        let left = sent();
        let round = crate::schema::read(&ping.wait_with_output().unwrap().stdout);
        assert_eq!(sent(), left);
        assert!(left + ROOM < 50, "more are asked than find room, {left} left before");
        assert_eq!(round["never_left"], 50 - left, "as many as find room, and those behind them: {round:#}");
        let why = round["why_never_left"].as_str().unwrap();
        assert!(why.starts_with("it is detached, and silent until it is told to be"), "{why}");
        assert!(why.contains(&format!("`rtnet tdma -S {name} slave`")), "{why}");
    });
}
