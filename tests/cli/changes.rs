//! Changes of a lab that stays, where they are slow, late or quick.

use std::process::Stdio;
use std::time::Duration;

use crate::cell::{Cell, text, wait_until};
use crate::host::network;
use crate::rtnet;

/// A station that is stopped is waited for by whoever changes it; meanwhile nobody looks at the medium.
#[test]
fn changes_that_nobody_answers_neither_blind_the_lab_nor_come_later() {
    network("changes_that_nobody_answers_neither_blind_the_lab_nor_come_later", || {
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
    network("of_two_changes_in_a_row_the_second_keeps_what_the_first_said", || {
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
