//! `rtnet station --discipline token` and `rtnet token`.

use serde_json::Value;
use std::time::Instant;

use crate::host::network;
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

const RING: &str = "02:00:00:00:00:0a,02:00:00:00:00:0b";

fn start<'a>(namespace: &tools::lab::namespace::Namespace, name: &'a str) -> (Station, &'a str) {
    // A host that runs other tests holds stations up.
    let options = ["--interface", "rt0", "--discipline", "token", "--ring", RING, "--name", name];
    let patient = ["--token-late", "20ms", "--token-hold", "5ms", "--token-rest", "2ms"];
    (Station::start(namespace, &[&options[..], &patient].concat()), name)
}

fn status(name: &str) -> Option<Value> {
    let output = rtnet().args(["token", "-S", name, "status", "--json"]).output().unwrap();
    serde_json::from_slice(&output.stdout).ok()
}

/// Waits until it shows a ring of which this is true.
fn wait_until(name: &str, what: &str, holds: impl Fn(&Value) -> bool) -> Value {
    let begun = Instant::now();
    loop {
        let shown = status(name).filter(|shown| holds(&shown["ring"]));
        if let Some(shown) = shown {
            return shown;
        }
        assert!(begun.elapsed() < PATIENCE, "in vain: {what}");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
}

#[test]
fn two_stations_of_a_ring_show_it_and_one_goes_on_alone_until_the_other_is_back() {
    network("two_stations_of_a_ring_show_it_and_one_goes_on_alone_until_the_other_is_back", || {
        let medium = Medium::new();
        let names = ["a", "b"].map(|side| format!("ring-{side}-{}", std::process::id()));
        let (a, name) = start(&medium.a, &names[0]);
        let (mut b, _) = start(&medium.b, &names[1]);
        let both = |ring: &Value| ring["present"] == serde_json::json!([true, true]);
        let shown = wait_until(name, "both take part", |ring| {
            both(ring) && ring["visits"].as_u64() > Some(100) && ring["rotation_ns"].as_i64() > Some(0)
        });
        assert_eq!((&shown["discipline"], &shown["role"]), (&"token".into(), &"none".into()));
        assert_eq!((&shown["ring"]["place"], &shown["ring"]["stations"][1]), (&0.into(), &RING[18..].into()));
        let words = rtnet().args(["token", "-S", name, "status"]).output().unwrap();
        let words = String::from_utf8(words.stdout).unwrap();
        assert!(words.contains("ring of 2, place 0, 2 of them present"), "{words}");
        assert!(words.contains("worst wait of the most urgent frame "), "{words}");

        b.child.kill().unwrap();
        b.child.wait().unwrap();
        a.wait_for("station_skipped: station 1 of the ring");
        wait_until(name, "it is absent", |ring| ring["present"] == serde_json::json!([true, false]));
        drop(b);
        let (b, _) = start(&medium.b, &names[1]);
        wait_until(name, "it is back", both);
        assert_eq!((a.end(), b.end()), (Some(0), Some(0)));
    });
}

#[test]
fn a_station_without_a_ring_is_told_from_one_in_it() {
    network("a_station_without_a_ring_is_told_from_one_in_it", || {
        let medium = Medium::new();
        let name = format!("alone-{}", std::process::id());
        let station =
            Station::start(&medium.a, &["--interface", "rt0", "--discipline", "nomac", "--name", &name]);
        station.wait_for("Ctrl-C ends it");
        let begun = Instant::now();
        loop {
            let output = rtnet().args(["token", "-S", &name, "status"]).output().unwrap();
            assert_eq!(output.status.code(), Some(2));
            let said = String::from_utf8(output.stderr).unwrap();
            if said.contains("is in no ring, its discipline is 'nomac'") {
                break;
            }
            assert!(begun.elapsed() < PATIENCE, "{said}");
        }
        assert_eq!(station.end(), Some(0));
    });
}
