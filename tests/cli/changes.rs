//! Changes of a lab that stays, where they are slow, late or quick.

use std::process::Stdio;
use std::time::Duration;

use crate::cell::{Cell, text, wait_until};
use crate::host::{alone, shared};
use crate::rtnet;

/// A station that is stopped is waited for by whoever changes it; meanwhile nobody looks at the medium.
#[test]
fn changes_that_nobody_answers_neither_blind_the_lab_nor_come_later() {
    alone("changes_that_nobody_answers_neither_blind_the_lab_nor_come_later", || {
        use nix::sys::signal::{Signal, kill};
        let cell = Cell::up("unanswered");
        let slave = nix::unistd::Pid::from_raw(cell.station("slave2")["pid"].as_i64().unwrap() as i32);
        let offset = || cell.station("slave2")["slots"][0]["offset_ns"].as_i64().unwrap();
        let (mut before, mut unanswered) = (offset(), 0);
        for turn in 0.. {
            let (text_of, nanos) =
                if turn % 2 == 0 { ("0=2300us", 2_300_000) } else { ("0=1600us", 1_600_000) };
            // Several at once, so that some still wait when the first is given up.
            let ask = || {
                let mut command = rtnet();
                command.args(["slot", "-S", &cell.place("slave2"), "set", text_of]);
                command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
            };
            let asking = [ask(), ask(), ask()];
            std::thread::sleep(Duration::from_micros(500 * (turn % 12 + 2)));
            kill(slave, Signal::SIGSTOP).unwrap();
            let answers = asking.map(|child| child.wait_with_output().unwrap());
            kill(slave, Signal::SIGCONT).unwrap();
            // Long enough for what it finds to be asked of it, and for frames to show where they are sent.
            std::thread::sleep(Duration::from_millis(300));
            wait_until("it is locked again", || cell.station("slave2")["standing"]["state"] == "locked");
            let is_made = answers.iter().any(|answer| answer.status.code() == Some(0));
            let said: String = answers.iter().map(|answer| text(&answer.stderr)).collect();
            let late = said.matches("is told to leave all as it is").count();
            unanswered += late;
            assert!(late <= 1, "while one is not answered there is no other: {said}");
            let is = offset();
            assert!(is == nanos || is == before && !is_made, "{is}, not {nanos}: {said}");
            before = is;
            // It is stopped sooner or later after they are asked for, and mostly before it has answered one.
            if unanswered >= 6 {
                break;
            }
            assert!(turn < 40, "it was stopped in time only {unanswered} times");
        }
        std::thread::sleep(Duration::from_millis(200));
        let account = cell.down();
        // Where lab and station disagreed, none of its frames would have an explanation.
        assert_eq!((&account["unexplained"], &account["not_judged"]), (&0.into(), &0.into()), "{account:#}");
    });
}

/// The second is asked for before the first has its turn.
#[test]
fn of_two_changes_in_a_row_the_second_keeps_what_the_first_said() {
    shared("of_two_changes_in_a_row_the_second_keeps_what_the_first_said", || {
        let cell = Cell::up("in-a-row");
        for turn in 0..10 {
            let phase = format!("3=2650us,phase={}/4,size=100", turn % 4 + 1);
            for set in [&phase[..], "3=2650us"] {
                let set = cell.slot("slave2", &["set", set]);
                assert_eq!(set.status.code(), Some(0), "{}", text(&set.stderr));
            }
            wait_until("both hold", || {
                let slot = &cell.station("slave2")["slots"][1];
                (&slot["phase"], &slot["period"], &slot["size"])
                    == (&(turn % 4).into(), &4.into(), &100.into())
            });
        }
        assert_eq!(cell.down()["unexplained"], 0);
    });
}

/// The lab knows what becomes of a slot because another one changes, and judges by it.
#[test]
fn joint_slots_of_a_running_lab_follow_and_part_and_nothing_is_unexplained() {
    shared("joint_slots_of_a_running_lab_follow_and_part_and_nothing_is_unexplained", || {
        let cell = Cell::with("joint", |file| {
            let joint = r#"{ id = 2, offset = "2500us", size = 200, joint = 0 }"#;
            let file = file.replace(r#""1600us" }"#, &format!(r#""1600us", size = 200 }}, {joint}"#));
            let traffic = r#"traffic = [{ priority = 3, every = "10ms", burst = 2, slot = 2 }]"#;
            file.replace(r#"name = "slave2""#, &format!("name = \"slave2\"\n{traffic}"))
        });
        let slots = || {
            let slots = cell.station("slave2")["slots"].clone();
            [0, 1].map(|n| (slots[n]["size"].as_u64().unwrap(), slots[n]["joint"].as_u64()))
        };
        let set = |change: &str, expected: [(u64, Option<u64>); 2]| {
            let output = cell.slot("slave2", &["set", change]);
            assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
            wait_until(change, || slots() == expected);
            std::thread::sleep(Duration::from_millis(100));
        };
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(100));
        let list = text(&cell.slot("slave2", &["list"]).stdout);
        assert!(list.lines().any(|line| line.starts_with("2->0 ")), "{list}");
        set("0=1600us,size=100", [(100, None), (100, Some(0))]);
        let refused = text(&cell.slot("slave2", &["remove", "0"]).stderr);
        assert!(refused.contains("slot 2 is joined to slot 0"), "{refused}");
        set("0=1600us,size=300", [(300, None), (100, None)]);
        let refused = text(&cell.slot("slave2", &["set", "2=2500us,joint=0"]).stderr);
        assert!(refused.contains("it takes 100 bytes, slot 0 300; give both one size"), "{refused}");
        set("2=2300us,size=300,joint=0", [(300, None), (300, Some(0))]);
        let counters = cell.station("slave2")["counters"].clone();
        assert_eq!(counters["joints_detached"], 1, "{counters}");
        assert_eq!(counters["returned_dropped"].as_u64().unwrap_or(0), 0, "{counters}");
        cell.restart("slave2");
        cell.wait_until_locked();
        assert_eq!(slots(), [(300, None), (300, Some(0))], "started anew as it was");
        std::thread::sleep(Duration::from_millis(300));
        let account = cell.down();
        assert_eq!((&account["unexplained"], &account["frames_lost"]), (&0.into(), &0.into()), "{account:#}");
        let frames = |station: usize| account["stations"][station]["frames_seen"].as_u64().unwrap() as f64;
        // The time to restart the station is not bounded: its slots meanwhile count as missed.
        let down = account["causes"]["station_down"].as_u64().unwrap_or(0) as f64;
        assert!(frames(2) + down > 1.5 * frames(1), "twice in a cycle: {account:#}");
    });
}

/// The remedy is one that a lab of a file has, too.
#[test]
fn a_slot_that_only_the_guard_band_keeps_out_is_refused_with_what_makes_room() {
    shared("a_slot_that_only_the_guard_band_keeps_out_is_refused_with_what_makes_room", || {
        let cell = Cell::up("guarded");
        let refused = cell.slot("slave2", &["set", "0=2900us"]);
        assert_eq!(refused.status.code(), Some(2));
        let why = text(&refused.stderr);
        let remedy = "bring the lab up with a smaller one (`guard` in its file, --guard without a file)";
        assert!(why.contains("guard band 600us") && why.contains(remedy), "{why}");
        cell.down();
    });
}
