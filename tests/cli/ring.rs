//! `rtnet station --discipline token` and `rtnet token`.

use serde_json::Value;
use std::time::Instant;

use crate::host::{figure, network, unique};
use crate::station::{Medium, PATIENCE, Station};
use crate::{rtnet, schema};

const RING: &str = "02:00:00:00:00:0a,02:00:00:00:00:0b";

fn start<'a>(namespace: &tools::lab::namespace::Namespace, name: &'a str) -> (Station, &'a str) {
    // A host that runs other tests holds stations up.
    let options = ["--interface", "rt0", "--discipline", "token", "--ring", RING, "--name", name];
    let patient = ["--token-late", "20ms", "--token-hold", "5ms", "--token-rest", "2ms"];
    (Station::start(namespace, &[&options[..], &patient].concat()), name)
}

fn status(name: &str) -> Option<Value> {
    let output = rtnet().args(["token", "-S", name, "status", "--json"]).output().unwrap();
    (!output.stdout.is_empty()).then(|| crate::schema::read(&output.stdout))
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
        let names = ["a", "b"].map(|side| unique(&format!("ring-{side}")));
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
        let name = unique("alone");
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

/// Four stations for hosts that hold one up for 20 ms while they run other tests.
const LAB: &str = "discipline = \"token\"\nrate = \"1G\"\ntoken_hold = \"2ms\"\ntoken_rest = \"1ms\"\ntoken_late = \"20ms\"\ntoken_delay = \"5ms\"\n\
                   token_invite = 4\nduration = \"2s\"\n[[station]]\nname = \"arm\"\n[[station]]\nname = \"leg\"\n[[station]]\nname = \"eye\"\n\
                   [[station.traffic]]\npriority = 3\nevery = \"20ms\"\n[[station]]\nname = \"head\"\n";

/// Runs a lab of this file: its report, what it printed, and its page.
fn lab(more: &str) -> (Value, String, String) {
    let place = tempfile::tempdir().unwrap();
    let file = |name: &str| place.path().join(name);
    std::fs::write(file("ring.toml"), format!("{LAB}{more}")).unwrap();
    let mut command = rtnet();
    command.args(["lab", "run"]).arg(file("ring.toml")).arg("--json").arg(file("ring.json"));
    let output = command.arg("--html").arg(file("ring.html")).output().unwrap();
    let words = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{words}{}", String::from_utf8_lossy(&output.stderr));
    let report = schema::read(std::fs::read(file("ring.json")).unwrap());
    (report, words, std::fs::read_to_string(file("ring.html")).unwrap())
}

#[test]
fn a_lab_of_a_ring_loses_no_frame_and_reports_its_rounds() {
    let name = "a_lab_of_a_ring_loses_no_frame_and_reports_its_rounds";
    network(name, || {
        let (report, words, page) = lab("");
        assert_eq!((&report["discipline"], &report["stations"]), (&"token".into(), &4.into()));
        assert_eq!((&report["frames_lost"], &report["unexplained"]), (&0.into(), &0.into()));
        let number = |value: &Value| value.as_i64().unwrap();
        // All rest for 1 ms in a round.
        assert!((50..=500).contains(&number(&report["rounds"])), "{words}");
        assert!(number(&report["rotation_ns"]["p50"]) >= 4_000_000, "{words}");
        assert!(number(&report["queueing"][0]["frames_seen"]) >= 90, "{words}");
        assert!(words.contains("no slots, no cycle, no master"), "{words}");
        assert!(page.contains("there is no slot error, no picture of cycles"));
    });
}

#[test]
fn a_lab_of_a_ring_recovers_from_the_death_of_a_station_within_the_bound_and_takes_it_back() {
    let name = "a_lab_of_a_ring_recovers_from_the_death_of_a_station_within_the_bound_and_takes_it_back";
    network(name, || {
        let events = "[[event]]\nat = \"500ms\"\nkill = \"leg\"\n[[event]]\nat = \"1s\"\nrestart = \"leg\"\n\
                      [[event]]\nat = \"1500ms\"\nunplug = \"head\"\nfor = \"100ms\"\n";
        let number = |value: &Value| value.as_i64().unwrap();
        let (report, words, _) = lab(events);
        assert!(report["causes"]["event"].as_i64() >= Some(1), "{words}");
        let (longest, bound) =
            (number(&report["recovery_ns"]["max"]), number(&report["bounds"]["recovery_ns"]));
        figure(name, &format!("{longest} ns until others sent, bound {bound} ns"));
        assert!(longest > 1_000_000 && longest <= bound, "{words}");
        assert_eq!(report["unexplained"], 0, "{words}");
        let leg = &report["per_station"][1];
        assert_ne!(leg["state"], "down", "{words}");
        let visits = |station: usize| number(&report["per_station"][station]["visits"]);
        assert!(visits(1) > 20 && visits(1) < visits(0), "{words}");
    });
}
