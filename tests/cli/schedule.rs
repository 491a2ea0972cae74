//! The schedule of a live lab is changed while all its slots are in use.
//!
//! `RTNET_CHANGES` says how often; `scripts/accept plan` asks for more than the default.

use std::path::PathBuf;
use std::process::Output;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::cell::{Cell, json, text, wait_until};
use crate::host::{figure, network};
use crate::rtnet;

fn changes() -> usize {
    std::env::var("RTNET_CHANGES").map_or(20, |changes| changes.parse().expect("RTNET_CHANGES is a number"))
}

/// A lab with two backups, and files beside it.
struct Lab {
    cell: Cell,
    dir: tempfile::TempDir,
}

const FILE: &str = include_str!("backups.toml");

/// The slots of the backups and the slaves in one another's places.
fn turned() -> String {
    let places = ["1100us", "1700us", "2300us", "2900us"];
    let mut text = FILE.to_owned();
    for (i, place) in places.iter().enumerate() {
        text = text.replace(&format!("offset = \"{place}\""), &format!("offset = \"@{}\"", (i + 1) % 4));
    }
    for (i, place) in places.iter().enumerate() {
        text = text.replace(&format!("\"@{i}\""), &format!("\"{place}\""));
    }
    text
}

impl Lab {
    fn up(name: &str) -> Self {
        let cell = Cell::with(name, |_| FILE.into());
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        Lab { cell, dir: tempfile::tempdir().unwrap() }
    }

    fn file(&self, name: &str, content: &str) -> PathBuf {
        let path = self.dir.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    fn schedule(&self, station: &str, arguments: &[&str]) -> Output {
        rtnet().args(["schedule", "-S", &self.cell.place(station)]).args(arguments).output().unwrap()
    }

    fn shown(&self, station: &str) -> Value {
        json(rtnet().args(["schedule", "-S", &self.cell.place(station), "--json", "show"]))
    }

    fn offset(&self, station: &str) -> i64 {
        self.cell.station(station)["slots"][0]["offset_ns"].as_i64().unwrap()
    }
}

#[test]
fn the_schedule_changes_a_hundred_times_under_load_and_no_frame_is_lost() {
    let test = "the_schedule_changes_a_hundred_times_under_load_and_no_frame_is_lost";
    network(test, || {
        let lab = Lab::up("changed");
        let files = [lab.file("b.toml", &turned()), lab.file("a.toml", FILE)];
        let (mut made, mut stopped) = (0, 0);
        while made < changes() {
            let output = lab.schedule("master", &["propose", files[made % 2].to_str().unwrap(), "--now"]);
            let said = text(&output.stderr);
            match output.status.code() {
                Some(0) => made += 1,
                // A host may be late for so long that a backup takes over, or hold a station up: all stay with the old one.
                Some(1) if said.contains("is stopped") => stopped += 1,
                _ => {
                    stopped += 1;
                    wait_until("the master gives the time", || {
                        lab.cell.station("master")["mastery"] == "active"
                    });
                }
            }
            assert!(stopped <= changes(), "stopped {stopped} times, made {made} times: {said}");
            let expected = if made % 2 == 0 { 1_100_000 } else { 1_700_000 };
            wait_until("it is in use", || lab.offset("backup1") == expected);
        }
        let shown = lab.shown("slave2");
        assert!(shown["switched"].as_u64() >= Some(made as u64), "{shown:#}");
        std::thread::sleep(std::time::Duration::from_millis(300));
        let account = lab.cell.down();
        figure(test, &format!("{made} changes, {stopped} stopped"));
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
        assert_eq!(account["frames_lost"], 0, "{account:#}");
    });
}

#[test]
fn a_station_that_does_not_answer_stops_the_change_and_is_named() {
    network("a_station_that_does_not_answer_stops_the_change_and_is_named", || {
        let lab = Lab::up("silent-one");
        let file = lab.file("b.toml", &turned());
        let address = lab.cell.station("slave2")["address"].as_str().unwrap().to_owned();
        let tdma = |verb: &str| {
            let place = lab.cell.place("slave2");
            let output = rtnet().args(["tdma", "-S", &place, verb]).output().unwrap();
            assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        };
        tdma("detach");
        let output = lab.schedule("master", &["propose", file.to_str().unwrap(), "--now"]);
        tdma("slave");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(&address) && said.contains("did not acknowledge"), "{said}");
        assert!(said.contains("all go on as before"), "{said}");
        assert_eq!(lab.offset("backup1"), 1_100_000);
        lab.cell.wait_until_locked();
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn what_cannot_be_is_refused_with_the_reason_and_nothing_changes() {
    network("what_cannot_be_is_refused_with_the_reason_and_nothing_changes", || {
        let lab = Lab::up("refused");
        let propose = |station: &str, content: &str, when: &[&str]| {
            let file = lab.file("x.toml", content);
            let mut arguments = vec!["propose", file.to_str().unwrap()];
            arguments.extend(when);
            let output = lab.schedule(station, &arguments);
            (output.status.code(), text(&output.stderr))
        };
        let (code, why) = propose("master", &turned().replace("\"2300us\"", "\"1750us\""), &["--now"]);
        assert!(code == Some(2) && why.contains("overlap"), "{why}");
        let (code, why) = propose("master", &turned().replace("\"4ms\"", "\"5ms\""), &["--now"]);
        assert!(code == Some(2) && why.contains("a lab is judged by one cycle"), "{why}");
        let (code, why) = propose("slave1", &turned(), &["--now"]);
        assert!(code == Some(2) && why.contains("ask the acting master"), "{why}");
        let (code, why) = propose("master", &turned(), &["--at-cycle", "5"]);
        assert!(code == Some(2) && why.contains("cycles ahead"), "{why}");
        for verb in ["activate", "cancel"] {
            let output = lab.schedule("master", &[verb]);
            assert!(text(&output.stderr).contains("no schedule is proposed"), "{}", text(&output.stderr));
        }
        assert!(lab.shown("master")["in_use"] == 0 && lab.shown("slave1")["state"] == "idle");
        lab.cell.down();
    });
}

#[test]
fn a_schedule_waits_until_it_is_activated_or_cancelled_and_a_slot_does_not_change_meanwhile() {
    let test = "a_schedule_waits_until_it_is_activated_or_cancelled_and_a_slot_does_not_change_meanwhile";
    network(test, || {
        let lab = Lab::up("waits");
        let file = lab.file("b.toml", &turned());
        let propose = || lab.schedule("master", &["propose", file.to_str().unwrap()]);
        let output = propose();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(
            text(&output.stdout).contains("4 of 4 stations have acknowledged"),
            "{}",
            text(&output.stdout)
        );
        let set = lab.cell.slot("slave2", &["set", "0=3ms"]);
        assert!(text(&set.stderr).contains("a change of the schedule is under way"), "{}", text(&set.stderr));
        let cancelled = lab.schedule("master", &["cancel"]);
        assert_eq!(cancelled.status.code(), Some(0), "{}", text(&cancelled.stderr));
        assert_eq!(lab.offset("slave1"), 2_300_000);
        assert_eq!(propose().status.code(), Some(0));
        let activated = lab.schedule("master", &["activate", "--in", "500ms"]);
        assert_eq!(activated.status.code(), Some(0), "{}", text(&activated.stderr));
        wait_until("all have switched", || {
            ["master", "backup1", "backup2", "slave1", "slave2"]
                .iter()
                .all(|station| lab.shown(station)["in_use"] == 2)
        });
        assert_eq!(lab.offset("slave1"), 2_900_000);
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn a_master_that_is_killed_and_returns_follows_the_schedule_that_is_in_use() {
    network("a_master_that_is_killed_and_returns_follows_the_schedule_that_is_in_use", || {
        let lab = Lab::up("returns");
        let file = lab.file("b.toml", &turned());
        let output = lab.schedule("master", &["propose", file.to_str().unwrap(), "--now"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        kill(Pid::from_raw(lab.cell.station("master")["pid"].as_i64().unwrap() as i32), Signal::SIGKILL)
            .unwrap();
        wait_until("a backup gives the time", || lab.cell.status()["time_by"] != "master");
        std::thread::sleep(std::time::Duration::from_millis(200));
        lab.cell.restart("master");
        wait_until("the master has its place back", || {
            lab.cell.station("master")["mastery"] == "active" && lab.cell.status()["time_by"] == "master"
        });
        lab.cell.wait_until_locked();
        assert_eq!(lab.shown("master")["in_use"], lab.shown("slave1")["in_use"]);
        assert_eq!(lab.offset("slave1"), 2_900_000);
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}
