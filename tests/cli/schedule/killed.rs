//! The master is killed while the schedule changes, or behind that.

use std::process::Stdio;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::{FILE, Lab, turned};
use crate::cell::wait_until;
use crate::host::shared;
use crate::rtnet;

#[test]
fn a_master_that_is_killed_and_returns_follows_the_schedule_that_is_in_use() {
    shared("a_master_that_is_killed_and_returns_follows_the_schedule_that_is_in_use", || {
        let lab = Lab::up("returns", FILE);
        let file = lab.file("b.toml", &turned());
        lab.goes_well(&[&["propose", file.to_str().unwrap(), "--now"]]);
        kill(Pid::from_raw(lab.cell.station("master")["pid"].as_i64().unwrap() as i32), Signal::SIGKILL)
            .unwrap();
        wait_until("a backup gives the time", || lab.cell.status()["time_by"] != "master");
        std::thread::sleep(Duration::from_millis(200));
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

#[test]
fn a_master_that_is_killed_in_the_middle_of_a_change_leaves_one_schedule_everywhere() {
    shared("a_master_that_is_killed_in_the_middle_of_a_change_leaves_one_schedule_everywhere", || {
        let lab = Lab::up("midway", FILE);
        let files = [lab.file("b.toml", &turned()), lab.file("a.toml", FILE)];
        let others = ["backup1", "backup2", "slave1", "slave2"];
        // That all have confirmed takes a cycle or two only: what it is then is `sealed` mostly.
        for when in ["nothing", "proposed", "committed or sealed", "sealed", "switched"] {
            let state = || lab.shown("slave1")["state"].as_str().unwrap_or_default().to_owned();
            let number = lab.shown("slave1")["in_use"].clone();
            let is_first = lab.offset("slave1") == 2_300_000;
            let file = files[usize::from(!is_first)].to_str().unwrap();
            let mut arguments = vec!["propose", file];
            arguments.extend(if when == "proposed" { &[][..] } else { &["--in", "700ms"] });
            let mut command = rtnet();
            command.args(["schedule", "-S", &lab.cell.place("master")]).args(arguments);
            let mut proposing = (when != "nothing")
                .then(|| command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
            if when != "nothing" {
                wait_until(when, || when.split(" or ").any(|when| state() == when));
            }
            kill(Pid::from_raw(lab.cell.station("master")["pid"].as_i64().unwrap() as i32), Signal::SIGKILL)
                .unwrap();
            if let Some(proposing) = &mut proposing {
                proposing.wait().unwrap();
            }
            wait_until("a backup gives the time", || lab.cell.status()["time_by"] != "master");
            // Longer than anybody is unsure, and than the activation cycle was ahead.
            std::thread::sleep(Duration::from_millis(1_000));
            let in_use = others.map(|station| lab.shown(station)["in_use"].clone());
            assert!(in_use.iter().all(|number| *number == in_use[0]), "killed when {when}: {in_use:?}");
            let places = others.map(|station| lab.offset(station));
            let first = [1_100_000, 1_700_000, 2_300_000, 2_900_000];
            let second = [1_700_000, 2_300_000, 2_900_000, 1_100_000];
            assert!([first, second].contains(&places), "killed when {when}: {places:?}");
            let has_changed = in_use[0] != number;
            match when {
                "nothing" | "proposed" => assert!(!has_changed, "killed when {when}"),
                "sealed" | "switched" => assert!(has_changed, "killed when {when}"),
                // Whoever took over had confirmed it, or had not.
                _ => {}
            }
            lab.cell.restart("master");
            wait_until("the master has its place back", || {
                lab.cell.station("master")["mastery"] == "active" && lab.cell.status()["time_by"] == "master"
            });
            lab.cell.wait_until_locked();
            wait_until("it follows", || lab.shown("master")["in_use"] == in_use[0]);
        }
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}
