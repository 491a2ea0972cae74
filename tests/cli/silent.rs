//! One station with slots: what its slots take, what it refuses to ask of others, and on which side its name may stand.

use std::process::Output;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::host::{shared, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

/// A master with an address, and slots of which the second takes little.
fn master(medium: &Medium, name: &str) -> Station {
    let options =
        ["--interface", "rt0", "--master", "--cycle", "10ms", "--name", name, "--ip", "10.0.0.1/24"];
    let slots = ["--slot", "0=1ms", "--slot", "3=2ms,size=200", "--slot", "5=3ms"];
    let station = Station::start(&medium.a, &[&options[..], &slots].concat());
    station.wait_for("master_active");
    station
}

fn ask(arguments: &[&str]) -> Output {
    rtnet().args(arguments).output().unwrap()
}

fn said(arguments: &[&str]) -> String {
    let output = ask(arguments);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn shown(name: &str) -> Value {
    crate::schema::read(said(&["if", "-S", name, "--json"]))
}

fn refused(arguments: &[&str]) -> String {
    let output = ask(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
    message
}

fn wait_until(name: &str, what: &str, holds: impl Fn(&Value) -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds(&shown(name)) {
        assert!(Instant::now() < deadline, "in vain: {what}: {:#}", shown(name));
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_station_shows_every_slot_that_it_has_and_no_other() {
    shared("a_station_shows_every_slot_that_it_has_and_no_other", || {
        let (medium, name) = (Medium::new(), unique("slots"));
        let _station = master(&medium, &name);
        let takes = |payload: u64| json!({ "payload": payload });
        let all = json!({"0": takes(1500), "3": takes(200), "5": takes(1500)});
        assert_eq!(shown(&name)["channels"], all);
        assert!(said(&["if", "-S", &name]).contains("channel 3: a payload of up to 200 bytes\n"));
        said(&["slot", "-S", &name, "remove", "5"]);
        said(&["slot", "-S", &name, "set", "1=4ms,size=100"]);
        let all = json!({"0": takes(1500), "1": takes(100), "3": takes(200)});
        wait_until(&name, "its slots are others", |shown| shown["channels"] == all);
    });
}

#[test]
fn an_echo_that_does_not_fit_one_frame_is_refused_with_what_does() {
    shared("an_echo_that_does_not_fit_one_frame_is_refused_with_what_does", || {
        let (medium, name) = (Medium::new(), unique("fits"));
        let _station = master(&medium, &name);
        let long = refused(&["ping", "-S", &name, "10.0.0.2", "--channel", "3", "--size", "173"]);
        assert!(
            long.contains(&format!("slot 3 of station '{name}', which takes 200"))
                && long.contains("--size 172 or less"),
            "{long}"
        );
        let fits = ask(&["ping", "-S", &name, "10.0.0.2", "--channel", "3", "--size", "172", "-c", "1"]);
        assert!(
            String::from_utf8(fits.stdout).unwrap().contains("seq=1 was not asked: no route to 10.0.0.2")
        );
        // As slot 0, which takes what is sent in 1.
        said(&["slot", "-S", &name, "set", "0=1ms,size=100"]);
        wait_until(&name, "slot 0 takes 100", |shown| shown["channels"]["0"]["payload"] == 100);
        let long = refused(&["ping", "-S", &name, "10.0.0.2", "--size", "100"]);
        assert!(long.contains("does not fit slot 0") && long.contains("--size 72 or less"), "{long}");
        // To itself it needs no slot.
        said(&["ping", "-S", &name, "10.0.0.1", "--size", "100", "-c", "1"]);
    });
}

#[test]
fn a_detached_station_says_so_instead_of_asking_others_in_vain() {
    shared("a_detached_station_says_so_instead_of_asking_others_in_vain", || {
        let (medium, name) = (Medium::new(), unique("detached"));
        let _station = master(&medium, &name);
        assert!(shown(&name).get("silent").is_none());
        said(&["tdma", "-S", &name, "detach"]);
        wait_until(&name, "it is detached", |shown| shown["silent"].is_string());
        let why = format!(
            "it is detached, and silent until it is told to be slave or master again (`rtnet tdma -S {name} slave`)"
        );
        assert!(said(&["if", "-S", &name]).contains(&format!("nothing leaves: {why}\n")));
        assert!(refused(&["ping", "-S", &name, "10.0.0.2"]).contains(&why));
        assert!(refused(&["route", "-S", &name, "solicit", "10.0.0.2"]).contains(&why));
        said(&["ping", "-S", &name, "10.0.0.1", "-c", "1"]);
    });
}

#[test]
fn a_station_may_be_named_on_either_side_of_what_is_to_be_done() {
    shared("a_station_may_be_named_on_either_side_of_what_is_to_be_done", || {
        let (medium, name) = (Medium::new(), unique("sides"));
        let _station = master(&medium, &name);
        for verb in [["route", "list"], ["tdma", "status"], ["slot", "list"]] {
            let [what, how] = verb;
            for arguments in [[what, "-S", &name, how, "--json"], [what, "--json", how, "-S", &name]] {
                let output = said(&arguments);
                crate::schema::read(&output);
            }
            let nobody = refused(&verb);
            assert!(
                nobody.contains("which station is meant? Say it: -S [LAB/]STATION; there is "),
                "{nobody}"
            );
            assert!(nobody.contains(&name), "{nobody}");
        }
    });
}
