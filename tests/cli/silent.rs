//! One station with slots: what its slots take, what it refuses to ask of others, and on which side its name may stand.

use std::process::Output;

use serde_json::Value;

use crate::host::network;
use crate::rtnet;
use crate::station::{Medium, Station};

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

fn refused(arguments: &[&str]) -> String {
    let output = ask(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
    message
}

#[test]
fn a_station_may_be_named_on_either_side_of_what_is_to_be_done() {
    network("a_station_may_be_named_on_either_side_of_what_is_to_be_done", || {
        let (medium, name) = (Medium::new(), format!("sides-{}", std::process::id()));
        let _station = master(&medium, &name);
        for verb in [["route", "list"], ["tdma", "status"], ["slot", "list"]] {
            let [what, how] = verb;
            for arguments in [[what, "-S", &name, how, "--json"], [what, "--json", how, "-S", &name]] {
                let output = said(&arguments);
                assert!(serde_json::from_str::<Value>(&output).is_ok(), "{output}");
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
