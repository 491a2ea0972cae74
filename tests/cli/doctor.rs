//! `rtnet doctor` from the outside: what it writes, as root and as anybody. It spins at real-time
//! priority, which labs beside it would suffer from: hence this file of its own, whose tests share one run.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::sync::{LazyLock, Mutex, PoisonError};

use serde_json::Value;

#[allow(dead_code)] // marks of other tests
#[path = "../src/aloud.rs"]
mod aloud;
#[path = "../src/program.rs"]
mod program;
#[path = "../src/schema.rs"]
mod schema;

use program::copy_program;

/// This host, examined for a second: the screen and the JSON.
static EXAMINED: LazyLock<(String, Value)> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    examined(Command::new(env!("CARGO_BIN_EXE_rtnet")), &dir.path().join("doctor.json"))
});

/// One at a time: they spin.
static ALONE: Mutex<()> = Mutex::new(());

fn examined(mut doctor: Command, json: &Path) -> (String, Value) {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let output = doctor.args(["doctor", "--duration", "1s", "--json"]).arg(json).output().unwrap();
    let screen = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{screen}{}", String::from_utf8_lossy(&output.stderr));
    (screen, schema::read(fs::read(json).unwrap()))
}

fn share(value: &Value) -> f64 {
    let share = value.as_f64().unwrap();
    assert!((0.0..=1.0).contains(&share), "{share}");
    share
}

#[test]
fn a_host_is_examined_and_told_what_it_holds() {
    let (screen, findings) = &*EXAMINED;
    let last = screen.lines().last().unwrap();
    assert!(last.starts_with("HOLDS: ") || last.starts_with("DOES NOT HOLD: "), "{screen}");
    assert_eq!(findings["verdict"].as_array().unwrap().last().unwrap(), last);
    let recommended = &findings["recommended"];
    assert_eq!(recommended["stations"], 8);
    assert!(recommended["cycle_ns"].as_i64() >= Some(250_000), "{recommended}");
    assert!(recommended["guard_ns"].as_i64() > Some(0), "{recommended}");
    assert!(share(&recommended["predicted_miss_share"]) <= share(&recommended["at_most_miss_share"]));

    let wakeups = findings["wakeups"].as_array().unwrap();
    assert!(!wakeups.is_empty() && wakeups.iter().all(|of| of["lateness_ns"]["n"].as_u64() >= Some(100)));
    assert!(
        wakeups.iter().flat_map(|of| of["later"].as_array().unwrap()).all(|of| share(&of["share"]) >= 0.0)
    );
    let candidates = findings["candidates"].as_array().unwrap();
    assert_eq!(candidates.len(), 30 * wakeups.len(), "6 cycles by 5 numbers of stations, cold and warm");
    for candidate in candidates {
        share(&candidate["predicted_miss_share"]);
        assert!(candidate["load"].as_f64() > Some(0.0), "{candidate}");
    }
    assert!(findings["outages"]["watched_ns"].as_i64() >= Some(100_000_000));
    assert!(findings["clock_gettime_ns"].as_f64() > Some(0.0));
    assert!(!findings["host"]["kernel"].as_str().unwrap().is_empty());
    let rights = findings["rights"]["process"].as_array().unwrap();
    let unexplained = rights.iter().find(|right| right["allowed"] == false && right["note"].is_null());
    assert_eq!(unexplained, None, "a refusal has a reason");
}

#[test]
fn what_is_not_measured_is_a_line_with_the_remedy() {
    let (screen, findings) = &*EXAMINED;
    let lines = findings["not_measured"].as_array().unwrap();
    assert_eq!(
        findings["wire"].is_null(),
        lines.iter().any(|line| line.as_str().unwrap().starts_with("sending"))
    );
    assert_eq!(lines.is_empty(), !screen.contains("not measured: "), "{screen}");
    if !nix::unistd::geteuid().is_root() {
        assert!(screen.contains("run as root"), "{screen}");
    }
}

#[test]
fn an_ordinary_user_is_told_of_a_lab_s_namespaces_what_they_give_and_what_not() {
    let name = "an_ordinary_user_is_told_of_a_lab_s_namespaces_what_they_give_and_what_not";
    let skip = |why: &str| aloud::skip(name, why);
    if !nix::unistd::geteuid().is_root() {
        return skip("needs root, to be somebody else");
    }
    if let Some(why) = tools::lab::userns::forbidden() {
        return skip(why);
    }
    // Neither the binary's folder nor the test's need be open to others.
    let dir = tempfile::tempdir().unwrap();
    let (binary, json) = (dir.path().join("rtnet"), dir.path().join("doctor.json"));
    copy_program(env!("CARGO_BIN_EXE_rtnet"), &binary);
    fs::write(&json, "").unwrap();
    for path in [dir.path(), &json] {
        fs::set_permissions(path, fs::Permissions::from_mode(0o777)).unwrap();
    }
    let mut nobody = Command::new(&binary);
    nobody.uid(65_534).gid(65_534).current_dir("/");
    let (screen, findings) = examined(nobody, &json);
    assert!(!screen.contains("labs need"), "{screen}");
    for wire in ["send_ns", "broadcast_ns", "stamp_ns"] {
        assert!(findings["wire"][wire]["n"].as_u64() > Some(0), "{wire}: {screen}");
    }
    let [process, kernel] = ["process", "kernel"].map(|of| findings["rights"][of].as_array().unwrap());
    for needed in ["packet sockets", "network namespaces", "user namespaces", "bridge", "veth"] {
        let right = process.iter().chain(kernel).find(|right| right["name"] == needed).unwrap();
        assert_eq!(right["allowed"], true, "{right}");
    }
    assert!(screen.contains("- packet sockets: in labs only"), "{screen}");
    let not_measured = findings["not_measured"].as_array().unwrap();
    let known = ["wake-ups and outages at real-time priority: ", "waking a thread on another core: "];
    for line in not_measured.iter().map(|line| line.as_str().unwrap()) {
        assert!(known.iter().any(|known| line.starts_with(known)), "{line}");
    }
}
