//! `rtnet tdma calibrate`: a slave that is locked measures its delay anew.

use serde_json::Value;

use crate::cell::{self, Cell};
use crate::host::{again, shared, unique};
use crate::rtnet;
use crate::station::{Medium, Station, asked, wait_until};

#[test]
fn a_slave_is_calibrated_anew_when_it_is_asked_to_and_says_what_was_measured() {
    shared("a_slave_is_calibrated_anew_when_it_is_asked_to_and_says_what_was_measured", || {
        let medium = Medium::new();
        let names = ["master", "slave"].map(|role| unique(&format!("anew-{role}")));
        let [master, slave] = &names;
        let _first = Station::master(&medium, master);
        let options =
            ["--interface", "rt0", "--slave", "--rounds", "10", "--slot", "0=1ms", "--holdover", "20"];
        let named = ["--delay", "median", "--name", slave];
        let second = Station::start(&medium.b, &[&options[..], &named].concat());
        second.wait_for("locked, cycle");
        let before =
            wait_until("it has told of it", slave, |status| !status["clock"]["calibration"].is_null());
        assert_eq!(
            (&before["clock"]["calibration"]["rounds"], &before["clock"]["calibrating"]),
            (&10.into(), &Value::Null)
        );
        assert!(before["clock"]["error_bound_ns"].as_i64() > Some(0), "{before:#}");
        let ask = || {
            let rounds = ["tdma", "-S", slave, "calibrate", "--rounds", "25"];
            let asked_for = rtnet().args(rounds).output().unwrap();
            let said = String::from_utf8(asked_for.stdout).unwrap();
            assert!(said.contains(&format!("{slave}: calibrates anew, from cycle ")), "{said}");
        };
        ask();
        let refused = asked(&["tdma", "-S", slave, "calibrate"]).unwrap_err();
        assert!(refused.contains("calibrates already: ask again when that is done"), "{refused}");
        // It gives up where the host lets too few requests be answered.
        for attempt in 1.. {
            let said = second.wait_for("calibrat");
            if said.contains("calibrated_anew") {
                break;
            }
            assert!(said.contains("calibration_timeout") && attempt < 4, "{said}");
            again("calibration_that_was_asked_for", &format!("attempt {attempt}: {said}"));
            ask();
        }
        let after = wait_until("it is done", slave, |status| {
            status["clock"]["calibrating"].is_null() && status["standing"]["state"] == "locked"
        });
        let shown = &after["clock"]["calibration"];
        assert_eq!(shown["rounds"], 25, "{after:#}");
        let ns = |name: &str| shown[name].as_i64().unwrap();
        let ordered = [ns("min_ns"), ns("quartile_ns"), ns("median_ns"), ns("max_ns")];
        assert!(ordered.is_sorted() && ns("spread_ns") == ordered[3] - ordered[0], "{shown:#}");
        let words = rtnet().args(["tdma", "-S", slave, "status"]).output().unwrap();
        let words = String::from_utf8(words.stdout).unwrap();
        for expected in [
            "servo linear, delay by median, holdover 20 cycles, time off by ",
            "25 rounds: min ",
            "(RTnet's)",
        ] {
            assert!(words.contains(expected), "{words}");
        }
        let refused = asked(&["tdma", "-S", master, "calibrate"]).unwrap_err();
        assert!(refused.contains("gives the time itself: only who follows a master calibrates"), "{refused}");
    });
}

#[test]
fn a_lab_knows_why_a_station_that_calibrates_anew_misses_slots() {
    shared("a_lab_knows_why_a_station_that_calibrates_anew_misses_slots", || {
        let cell = Cell::up("anew");
        let place = cell.place("slave1");
        cell::wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        asked(&["tdma", "-S", &place, "calibrate", "--rounds", "50"]).unwrap();
        cell::wait_until("it is done", || {
            let clock = &cell.station("slave1")["clock"];
            clock["calibration"]["rounds"] == 50 && clock["calibrating"].is_null()
        });
        let refused = asked(&["tdma", "-S", &place, "slave", "--holdover", "5"]).unwrap_err();
        assert!(refused.contains("a lab judges its stations by a holdover of 1 cycle"), "{refused}");
        let refused = asked(&["tdma", "-S", &place, "slave", "--servo", "none"]).unwrap_err();
        assert!(
            refused.contains("follow as its file says") && refused.contains("leave --servo out"),
            "{refused}"
        );
        let account = cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
        assert!(account["causes"]["calibrating"].as_u64() >= Some(95), "two of four turns: {account:#}");
    });
}
