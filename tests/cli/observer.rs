//! The lab's own observer: when it has seen enough to begin, and what it did not see.

use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::cell::{status, text, wait_until};
use crate::host::{shared, stop};
use crate::stays::Pair;
use crate::{rtnet, schema};

/// Longer than the ring keeps frames: 64 blocks of 20 ms.
const LONGER_THAN_THE_RING: Duration = Duration::from_millis(2_500);

#[test]
fn a_lab_without_calibration_waits_for_its_first_sync() {
    const TIMES: usize = 5;
    shared("a_lab_without_calibration_waits_for_its_first_sync", || {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("at_once.toml");
        // The first sync is sent when the slave, which has no slot to measure, has long been ready.
        let slave = "[[station]]\nname = \"slave\"\nrole = \"slave\"\nrounds = 0\n";
        let master = "[[station]]\nname = \"master\"\nrole = \"master\"\n";
        std::fs::write(&file, format!("cycle = \"10ms\"\n{master}{slave}")).unwrap();
        for time in 0..TIMES {
            let pair = Pair::up_by(&format!("at_once{time}"), |name| {
                let mut command = rtnet();
                command.args(["lab", "up", "--name", name]).arg(&file);
                command
            });
            assert!(status(&pair.name)["cycles"].is_u64());
        }
    });
}

#[test]
fn slots_that_the_observer_lost_are_not_judged() {
    shared("slots_that_the_observer_lost_are_not_judged", || {
        let pair = Pair::up("blind");
        wait_until("it is judged", || status(&pair.name)["cycles"].as_u64() > Some(0));
        let keeper = Pid::from_raw(pair.keeper());
        stop(keeper);
        std::thread::sleep(LONGER_THAN_THE_RING);
        kill(keeper, Signal::SIGCONT).unwrap();
        let lost = |of: &serde_json::Value| of["not_judged"].as_u64().unwrap();
        wait_until("it says so", || lost(&status(&pair.name)) > 0);
        let output = rtnet().args(["lab", "down", &pair.name, "--json"]).output().unwrap();
        let account = schema::read(&output.stdout)[0].clone();
        assert_eq!(output.status.code(), Some(3), "{account:#}\n{}", text(&output.stderr));
        assert_eq!(account["unexplained"], 0, "{account:#}");
        // Both stations sent in each of these cycles of 10 ms: the ring kept half of them, and lost the rest.
        assert!(lost(&account) >= 100, "{account:#}");
    });
}
