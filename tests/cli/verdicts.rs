//! What runs come to, from the outside: the word, its reasons, and the exit status.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use tools::report::html::markup::escape;

use crate::rtnet;

/// A simulation of a file, with options: its exit status, its last line, and the verdict of its JSON. The page has the same.
fn simulated(text: &str, options: &[&str]) -> (Option<i32>, String, Value) {
    let place = tempfile::tempdir().unwrap();
    let [file, json, page] = ["net.toml", "net.json", "net.html"].map(|name| place.path().join(name));
    std::fs::write(&file, text).unwrap();
    let mut command = rtnet();
    command.args(["sim", "run"]).arg(&file).arg("--json").arg(&json).arg("--html").arg(&page).args(options);
    let Output { status, stdout, stderr } = command.output().unwrap();
    let report = std::fs::read(json).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&stderr)));
    let verdict = crate::schema::read(&report)["verdict"].clone();
    let last = String::from_utf8(stdout).unwrap().lines().last().unwrap().to_owned();
    let page = std::fs::read_to_string(page).unwrap();
    let word = verdict["word"].as_str().unwrap().replace('_', " ").to_uppercase();
    assert!(last.starts_with(&word) && page.contains(&format!("<strong>{word}</strong>")), "{word}: {last}");
    for reason in verdict["reasons"].as_array().unwrap() {
        assert!(page.contains(&escape(reason.as_str().unwrap())), "{reason}: {page}");
    }
    (status.code(), last, verdict)
}

const ARM: &str = "cycle = \"1ms\"\nduration = \"6s\"\n[[station]]\nname = \"master\"\nrole = \"master\"\n\
                   [[station]]\nname = \"arm\"\nrole = \"slave\"\n";

/// The arm's process ends when so much of the run is over.
fn killed(at: &str) -> String {
    format!("{ARM}[[event]]\nat = \"{at}\"\nkill = \"arm\"\n")
}

#[test]
fn verdict_of_a_quiet_run_is_ok() {
    let (status, last, verdict) = simulated(ARM, &[]);
    assert_eq!((status, &verdict["word"], &verdict["ok"]), (Some(0), &"ok".into(), &true.into()), "{last}");
    assert!(last.starts_with("OK: every frame in its slot, "), "{last}");
}

#[test]
fn verdict_is_not_ok_when_a_station_was_hardly_seen() {
    let (status, last, verdict) = simulated(&killed("10ms"), &[]);
    assert_eq!((status, &verdict["word"]), (Some(1), &"not_ok".into()), "{last}");
    assert!(last.starts_with("NOT OK: station 'arm' was seen "), "{last}");
    for (expected, why) in [
        ("slots_missed = \">= 1\"", "that it misses some allows no number of them"),
        ("frames_seen = \">= 6000\"", "the frames may be the master's"),
    ] {
        let some = format!("{}[expect]\n{expected}\n", killed("10ms"));
        assert_eq!(simulated(&some, &[]).0, Some(1), "{why}");
    }
    let few =
        ARM.to_owned() + "expect = { frames_seen = \">= 5\" }\n[[event]]\nat = \"10ms\"\nkill = \"arm\"\n";
    assert_eq!(simulated(&few, &[]).0, Some(0), "the file says how few are enough");
}

#[test]
fn verdict_is_degraded_when_more_is_missed_than_may_be() {
    let (status, last, verdict) = simulated(&killed("5900ms"), &[]);
    assert_eq!((status, &verdict["word"]), (Some(4), &"degraded".into()), "{last}");
    assert!(last.starts_with("DEGRADED: slots missed: 'arm' 1."), "{last}");
    // An option, the file, and an expectation of the file each say otherwise.
    assert_eq!(simulated(&killed("5900ms"), &["--max-miss", "2%"]).0, Some(0));
    assert_eq!(simulated(&format!("max_miss = \"2%\"\n{}", killed("5900ms")), &[]).0, Some(0));
    assert_eq!(
        simulated(&format!("{}[expect]\nslots_missed = \"<= 110\"\n", killed("5900ms")), &[]).0,
        Some(0)
    );
    let (status, last, _) = simulated(&killed("5900ms"), &["--max-miss", "1%"]);
    assert!(status == Some(4) && last.ends_with("; 1 % may be"), "{last}");
}

#[test]
fn verdict_is_not_ok_when_frames_collide_that_no_file_allows() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli/html.toml");
    let text = std::fs::read_to_string(file).unwrap();
    let (before, _) = text.split_once("[expect]").unwrap();
    let (status, last, verdict) = simulated(before, &[]);
    assert_eq!((status, &verdict["word"]), (Some(1), &"not_ok".into()), "{last}");
    let reasons = verdict["reasons"].to_string();
    assert!(reasons.contains(" overlaps") && reasons.contains(" frames out of slot"), "{reasons}");
    assert_eq!(simulated(&text, &[]).0, Some(0), "the file allows it");
    let some = format!("{before}[expect]\noverlaps = \">= 1\"\nout_of_slot = \">= 1\"\n");
    assert_eq!(simulated(&some, &[]).0, Some(1), "that there are some allows no number of them");
}

const RING: &str =
    "discipline = \"token\"\nduration = \"100ms\"\n[[station]]\nname = \"a\"\n[[station]]\nname = \"b\"\n";

/// Ctrl-C in the middle of an hour of virtual time: the report is of what was measured by then.
#[test]
fn an_interrupted_simulation_reports_what_it_has_measured() {
    let hour = |text: &str| text.replace("6s", "3600s").replace("100ms", "3600s");
    for text in [hour(ARM), hour(RING)] {
        let place = tempfile::tempdir().unwrap();
        let [file, json] = ["net.toml", "net.json"].map(|name| place.path().join(name));
        std::fs::write(&file, text).unwrap();
        let interrupted = |seconds: u32| {
            let mut command = Command::new("timeout");
            command.args(["--preserve-status", "-s", "INT", &seconds.to_string()]);
            command.args([env!("CARGO_BIN_EXE_rtnet"), "sim", "run"]).arg(&file).arg("--json").arg(&json);
            command.output().unwrap()
        };
        // On a busy host the stations have not joined after a second.
        let early =
            |output: &Output| output.stderr.starts_with(b"rtnet: INTERRUPTED before anything was measured: ");
        let output = [1, 2, 4, 8, 16].into_iter().map(interrupted).find(|output| !early(output)).unwrap();
        let screen = String::from_utf8(output.stdout).unwrap();
        let last = screen.lines().last().unwrap_or_default();
        assert_eq!(output.status.code(), Some(130), "{screen}{}", String::from_utf8_lossy(&output.stderr));
        assert!(last.starts_with("INTERRUPTED after ") && last.contains(" of 3600s"), "{last}");
        let report = crate::schema::read(std::fs::read(&json).unwrap());
        assert_eq!(report["verdict"]["word"], "interrupted", "{last}");
        let seen = report["frames_seen"].as_u64().unwrap();
        assert!(seen > 0, "{screen}");
    }
}

#[test]
fn a_ring_has_no_slots_to_miss() {
    let ring = RING;
    let (status, last, verdict) = simulated(ring, &[]);
    assert_eq!((status, &verdict["word"]), (Some(0), &"ok".into()), "{last}");
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("ring.toml");
    for (text, options, why) in [
        (ring.to_owned(), &["--max-miss", "1%"][..], "--max-miss is about slots, and a ring has none"),
        (format!("max_miss = \"1%\"\n{ring}"), &[], "max_miss: a ring has no slots"),
    ] {
        std::fs::write(&file, text).unwrap();
        let output = rtnet().args(["sim", "run"]).arg(&file).args(options).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && said.contains(why), "{said}");
    }
}
