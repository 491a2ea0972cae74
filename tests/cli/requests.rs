//! What running stations are asked: what they tell, what they refuse, and how long that takes at the most.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::host::{shared, stop, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station, asked, status, wait_until};

/// Waits until it can be asked.
fn runs(station: &Station, name: &str) {
    station.wait_for("Ctrl-C ends it");
    let deadline = Instant::now() + PATIENCE;
    while asked(&["tdma", "-S", name, "status"]).is_err() {
        assert!(Instant::now() < deadline, "it never answers");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn master_and_slave_tell_the_same_global_time_when_they_are_asked() {
    shared("master_and_slave_tell_the_same_global_time_when_they_are_asked", || {
        let medium = Medium::new();
        let names = ["time-master", "time-slave"];
        let (_master, _slave) = (Station::master(&medium, names[0]), Station::slave(&medium, names[1]));
        let begun = SystemTime::now();
        let told = names.map(|name| status(name)["global_ns"].as_u64().unwrap());
        let since_1970 = |time: SystemTime| time.duration_since(UNIX_EPOCH).unwrap().as_nanos() as u64;
        let asked = since_1970(begun)..since_1970(SystemTime::now());
        // The master's clock began with this machine's; the slave is off by what its calibration is.
        let slack = 100_000_000;
        for told in told {
            assert!(asked.start - slack < told && told < asked.end + slack, "{told} within {asked:?}");
        }
        let output = rtnet().args(["tdma", "-S", names[1], "status"]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(text.lines().any(|line| line.starts_with("global time 1")), "{text}");
    });
}

#[test]
fn no_request_to_a_station_waits_for_ever() {
    shared("no_request_to_a_station_waits_for_ever", || {
        let medium = Medium::new();
        let name = unique("alone");
        let options = ["--interface", "rt0", "--slave", "--slot", "0=1ms", "--lead", "70us", "--name", &name];
        let slave = Station::start(&medium.b, &options);
        runs(&slave, &name);
        assert_eq!(status(&name)["global_ns"], Value::Null, "nobody has told it the time");
        assert_eq!(status(&name)["lead_ns"], 70_000);
        // Without a master nothing can be calibrated: RTnet's configuring calls would block for good.
        asked(&["slot", "-S", &name, "set", "0=2ms"]).unwrap();
        asked(&["tdma", "-S", &name, "detach"]).unwrap();
        asked(&["tdma", "-S", &name, "slave", "--rounds", "10"]).unwrap();

        // Nor does it help to ask who is stopped.
        let process = Pid::from_raw(slave.child.id() as i32);
        stop(process);
        let requests = [
            vec!["tdma", "-S", &name, "status"],
            vec!["tdma", "-S", &name, "master", "--cycle", "5ms"],
            vec!["tdma", "-S", &name, "slave"],
            vec!["slot", "-S", &name, "set", "0=3ms"],
            vec!["slot", "-S", &name, "remove", "0"],
            vec!["slot", "-S", &name, "list"],
        ];
        let begun = Instant::now();
        let refused = std::thread::scope(|scope| {
            let asking: Vec<_> = requests.iter().map(|request| scope.spawn(|| asked(request))).collect();
            asking.into_iter().map(|asking| asking.join().unwrap()).collect::<Vec<_>>()
        });
        let took = begun.elapsed();
        kill(process, Signal::SIGCONT).unwrap();
        for (refused, request) in refused.iter().zip(&requests) {
            let message = refused.as_ref().unwrap_err();
            assert!(message.contains("has not answered in time"), "{request:?}: {message}");
        }
        assert!(took < PATIENCE, "{took:?}");
        let now = wait_until("it goes on", &name, |status| status["standing"]["state"] == "waiting");
        assert_eq!(now["slots"][0]["offset_ns"], 2_000_000, "what was given up was not done later");
    });
}

#[test]
fn a_station_without_slots_says_so_and_refuses_what_is_about_them() {
    shared("a_station_without_slots_says_so_and_refuses_what_is_about_them", || {
        let medium = Medium::new();
        for discipline in ["nomac", "direct"] {
            let name = unique(discipline);
            let options = ["--interface", "rt0", "--discipline", discipline, "--name", &name];
            let station = Station::start(&medium.a, &options);
            runs(&station, &name);
            let shown = status(&name);
            assert_eq!((&shown["discipline"], &shown["role"]), (&discipline.into(), &"none".into()));
            assert_eq!(shown["standing"]["state"], "attached");
            let output = rtnet().args(["tdma", "-S", &name, "status"]).output().unwrap();
            let text = String::from_utf8(output.stdout).unwrap();
            assert!(text.starts_with(&format!("{name}: {discipline}, attached\non rt0 (")), "{text}");
            for request in [
                &["tdma", "-S", &name, "master", "--cycle", "5ms"][..],
                &["tdma", "-S", &name, "slave"],
                &["tdma", "-S", &name, "detach"],
                &["slot", "-S", &name, "set", "0=1ms"],
                &["slot", "-S", &name, "remove", "0"],
            ] {
                let message = asked(request).unwrap_err();
                let expected = format!("its discipline is '{discipline}', which has no cycle");
                assert!(message.contains(&expected) && message.contains("--discipline tdma"), "{message}");
            }
            assert_eq!(station.end(), Some(0));
        }
    });
}
