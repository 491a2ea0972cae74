//! Requests to what runs, and scenarios in files.

use std::fmt::Debug;
use std::path::Path;

use serde_json::{Value, json};
use tools::control::{Envelope, LabRequest, Reply, Request, read};
use tools::report::figures::Role;
use tools::ring::plan::RingPlan;
use tools::scenario::{Network, RingScenario, Source};

use super::engine::{Target, fuzz, outcome};
use super::mutate;

#[test]
fn control_takes_any_request() {
    let of_station = [
        json!("status"),
        json!({"set_slot": {"id": 2, "offset_ns": 100_000, "phase": 0, "period": 1, "size": 128, "joint": null}}),
        json!({"set_slot": {"id": 255, "offset_ns": -1}}),
        json!({"remove_slot": 2}),
        json!({"become": {"master": {"cycle_ns": 1_000_000}}}),
        json!({"become": {"slave": {"rounds": 3, "servo": "none", "holdover": 20, "on_master_change": "repeat"}}}),
        json!({"become": "detached"}),
        json!({"calibrate": {"rounds": 10}}),
        json!({"refused": "no"}),
        json!({"applied": 7}),
    ];
    let of_sockets = [
        json!("interface"),
        json!("routes"),
        json!({"add_routes": [
            {"host": {"ip": "10.0.0.7", "address": "02:00:00:00:00:07"}},
            {"network": {"network": "10.1.0.0/16", "via": "10.0.0.7"}},
        ]}),
        json!({"delete_route": "10.1.0.0/16"}),
        json!({"solicit": "10.0.0.7"}),
        json!({"lookup": "10.0.0.7"}),
        json!({"echo": {
            "to": "10.0.0.7", "identifier": 7, "sequence": 1, "size": 56, "priority": 30, "channel": 1,
        }}),
        json!({"echoes": 7}),
        json!("pools"),
        json!("counters"),
    ];
    let packet = |body: Value| json!({"version": 1, "body": body}).to_string().into_bytes();
    let of_sockets = of_sockets.map(|request| packet(json!({"stack": request})));
    for request in &of_sockets {
        assert!(matches!(read::<Request>(request), Ok(Request::Stack(_))), "{request:?}");
    }
    let mutate = |random: &mut _, input: &mut Vec<u8>, other: &[u8]| mutate::text(random, input, other);
    fuzz(&Target {
        name: "control",
        seeds: of_station.map(packet).into_iter().chain(of_sockets).collect(),
        has_corpus: true,
        mutate,
        run: |text| control(text).to_vec(),
    });
}

fn control(packet: &[u8]) -> [u64; 3] {
    let request = read::<Request>(packet);
    if let Ok(request) = &request {
        assert_eq!(read::<Request>(&Envelope::pack(request.clone())).as_ref(), Ok(request));
    }
    let of_lab = read::<LabRequest>(packet);
    if let Ok(request) = &of_lab {
        assert_eq!(read::<LabRequest>(&Envelope::pack(request.clone())).as_ref(), Ok(request));
    }
    [said(&request), said(&of_lab), said(&read::<Reply>(packet))]
}

/// Which of all answers: its variant, or why not, without the figures in it.
fn said(result: &Result<impl Debug, String>) -> u64 {
    let text = match result {
        Ok(read) => format!("{read:?}"),
        Err(error) => {
            assert!(!error.is_empty());
            error.clone()
        }
    };
    outcome(text.bytes().take(24).filter(|byte| !byte.is_ascii_digit()).map(u64::from))
}

#[test]
fn scenario_takes_any_text() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut seeds = Vec::new();
    for folder in ["sim", "cli", "cli/plan.in", "cli/bad_input.in", "../tools/src/sim"] {
        let entries = std::fs::read_dir(root.join(folder)).expect("a directory");
        let mut paths: Vec<_> = entries.map(|entry| entry.expect("a directory entry").path()).collect();
        paths.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
        paths.sort();
        seeds.extend(paths.iter().map(|path| std::fs::read(path).expect("a file")));
    }
    assert!(seeds.len() > 30, "only {} scenarios", seeds.len());
    fuzz(&Target {
        name: "scenario",
        seeds,
        has_corpus: false,
        mutate: mutate::text,
        run: |text| vec![scenario(text)],
    });
}

fn scenario(bytes: &[u8]) -> u64 {
    let text = String::from_utf8_lossy(bytes);
    match Source::new("a.toml", &text).parse_any() {
        Err(error) => {
            let said = error.to_string();
            assert!(said.starts_with("a.toml:"), "{said}");
            let printable = |c: char| c == '\n' || !c.is_control();
            assert!(said.chars().count() < 1_000 && said.chars().all(printable), "{said:?}");
            // Places and figures are no other kind of mistake.
            let what = said.lines().next().unwrap_or_default().bytes().filter(u8::is_ascii_alphabetic);
            outcome(what.take(40).map(u64::from))
        }
        Ok(Network::Ring(RingScenario { ring, network })) => {
            assert_eq!((ring.check(), ring.stations.len()), (Ok(()), network.stations.len()));
            let plan = RingPlan::of(&RingScenario { ring, network });
            outcome([u64::MAX - 1, plan.stations.len() as u64, plan.refused.len() as u64])
        }
        Ok(Network::Slots(scenario)) => {
            let masters = scenario.stations.iter().filter(|station| station.role == Role::Master).count();
            assert_eq!((masters, scenario.stations[0].role), (1, Role::Master));
            assert!(scenario.schedule().conflicts().is_empty(), "what conflicts is refused");
            assert!(scenario.stations.iter().all(|station| !station.slots.is_empty()));
            let flows = scenario.stations.iter().map(|station| station.flows.len()).sum::<usize>();
            outcome([u64::MAX, scenario.stations.len() as u64, flows as u64])
        }
    }
}
