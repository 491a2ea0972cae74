//! The master of a live lab dies, again and again: a backup takes its place, and gives it back.
//!
//! `RTNET_KILLS` says how often; `scripts/accept tdma` asks for more than the default.

use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::cell::{Cell, wait_until};
use crate::host::{figure, shared};

fn kills() -> usize {
    std::env::var("RTNET_KILLS").map_or(3, |kills| kills.parse().expect("RTNET_KILLS is a number"))
}

fn mastery(cell: &Cell, station: &str) -> String {
    cell.station(station)["mastery"].as_str().unwrap_or_default().to_owned()
}

/// Whom a station follows, by name.
fn followed(cell: &Cell, station: &str) -> Option<String> {
    let status = cell.station(station);
    status["names"][status["standing"]["time_by"].as_str()?].as_str().map(str::to_owned)
}

#[test]
fn a_backup_takes_over_in_the_very_cycle_and_the_master_that_returns_goes_on() {
    let test = "a_backup_takes_over_in_the_very_cycle_and_the_master_that_returns_goes_on";
    shared(test, || {
        let cell = Cell::with("backups", |_| include_str!("backups.toml").into());
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        wait_until("the master gives the time", || mastery(&cell, "master") == "active");
        let mut at_once = 0;
        for _ in 0..kills() {
            let count = |name: &str| cell.status()[name].as_u64().unwrap();
            let took_over = || -> u64 {
                let stations = cell.status()["stations"].clone();
                (1..3).filter_map(|k| stations[k]["events"]["took_over"].as_u64()).sum()
            };
            let (missing, before) = (count("syncs_missing"), took_over());
            kill(Pid::from_raw(cell.station("master")["pid"].as_u64().unwrap() as i32), Signal::SIGKILL)
                .unwrap();
            wait_until("a backup gives the time", || {
                took_over() > before
                    && ["backup1", "backup2"].map(|name| mastery(&cell, name)).contains(&"active".into())
            });
            std::thread::sleep(Duration::from_millis(200));
            let by = followed(&cell, "slave1");
            assert!(by.as_ref().is_some_and(|by| by.starts_with("backup")), "{by:?}");
            at_once += usize::from(count("syncs_missing") == missing);
            cell.restart("master");
            wait_until("the master has its place back", || {
                mastery(&cell, "master") == "active" && cell.status()["time_by"] == "master"
            });
        }
        cell.wait_until_locked();
        let account = cell.down();
        figure(test, &format!("{at_once} of {} take-overs in the very cycle", kills()));
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
        assert!(at_once > 0, "not once in the cycle whose sync was missing: {account:#}");
        assert_eq!(account["stations"][0]["restarts"], kills());
    });
}
