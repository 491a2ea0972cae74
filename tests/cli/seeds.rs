//! `rtnet sim run FILE.. --seeds A..B`.

use std::io::Read;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::host::skip;
use crate::{rtnet, schema};

/// Its sync error is over the limit with some seeds: wake-ups are late by chance.
const SOME_FAIL: &str = r#"cycle = "1ms"
duration = "50ms"
[host]
send = "uniform 0us 3us"
[[station]]
name = "master"
role = "master"
[[station]]
name = "arm"
role = "slave"
rounds = 10
[expect]
overlaps = 0
sync_error = "< 800ns"
"#;

const ALL_HOLD: &str = r#"cycle = "1ms"
duration = "50ms"
[[station]]
name = "master"
role = "master"
[[station]]
name = "arm"
role = "slave"
rounds = 10
[expect]
overlaps = 0
"#;

const RING: &str = include_str!("plan.in/ring.toml");

/// A directory with these files, and the command in it.
fn command(files: &[(&str, &str)]) -> (tempfile::TempDir, Command) {
    let dir = tempfile::tempdir().unwrap();
    for (name, text) in files {
        std::fs::write(dir.path().join(name), text).unwrap();
    }
    let mut command = rtnet();
    command.current_dir(dir.path()).args(["sim", "run"]).args(files.iter().map(|(name, _)| name));
    (dir, command)
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

fn read(dir: &Path, name: &str) -> String {
    std::fs::read_to_string(dir.join(name)).unwrap()
}

/// What it printed, without the line that has the time.
fn table(output: &Output) -> String {
    let text = text(&output.stdout);
    text.rsplit_once("\n\n").expect("a line behind the table").0.to_owned()
}

#[test]
fn any_number_of_jobs_gives_the_same_report() {
    let files = [("all hold.toml", ALL_HOLD), ("some_fail.toml", SOME_FAIL), ("ring.toml", RING)];
    let run = |jobs| {
        let (dir, mut command) = command(&files);
        let arguments = ["--seeds", "1..30", "--jobs", jobs, "--json", "s.json", "--junit", "s.xml"];
        let output = command.args(arguments).output().unwrap();
        assert_eq!(
            (output.status.code(), text(&output.stderr)),
            (Some(1), String::new()),
            "no terminal, no progress"
        );
        let (table, json, junit) = (table(&output), read(dir.path(), "s.json"), read(dir.path(), "s.xml"));
        (table, json, junit, text(&output.stdout))
    };
    let (table, json, junit, printed) = run("1");
    let again = run("3");
    assert_eq!((&again.0, &again.1, &again.2), (&table, &json, &junit));

    let report = schema::read(&json);
    assert!(json.starts_with("{\n  \"kind\": \"sim-seeds\",\n  \"version\": 1,\n"), "{json}");
    let of = |name: &str| report["files"].as_array().unwrap().iter().find(|of| of["file"] == name).unwrap();
    let failed = of("some_fail.toml")["failed"].as_u64().unwrap();
    assert!((1..30).contains(&failed), "{json}");
    assert_eq!((&of("all hold.toml")["failed"], &of("ring.toml")["met"]), (&0.into(), &30.into()));
    assert_eq!((&report["runs"], &report["failed"]), (&90.into(), &failed.into()));
    assert!(
        printed.contains("\n90 runs of 3 files in ") && printed.ends_with(&format!(": {failed} FAILED\n"))
    );

    assert!(junit.contains("tests=\"90\""), "{junit}");
    assert_eq!(junit.matches("<testcase ").count(), 90);
    assert_eq!(
        junit.matches("<failure message=\"line 14: expected sync_error &lt; 800ns, found ").count() as u64,
        failed
    );
}

#[test]
fn a_failed_run_is_repeated_by_the_command_that_is_printed() {
    let (dir, mut command) = command(&[("it's.toml", SOME_FAIL)]);
    let output = command.args(["--seeds", "1..30", "--until", "4s"]).output().unwrap();
    let printed = text(&output.stdout);
    let line = printed.lines().find_map(|line| line.strip_prefix("  $ rtnet ")).expect("a command");
    assert!(line.starts_with("sim run 'it'\\''s.toml' --seed ") && line.ends_with(" --until 4s"), "{line}");
    let again = format!("{} {line}", env!("CARGO_BIN_EXE_rtnet"));
    let output = Command::new("sh").arg("-c").arg(again).current_dir(dir.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stdout));
    let reason = printed
        .lines()
        .find_map(|line| line.trim().strip_prefix("line 14: expected sync_error < 800ns, found "));
    let found = format!("line  14: sync_error < 800ns: {}: NOT AS EXPECTED", reason.unwrap());
    assert!(text(&output.stdout).contains(&found), "{found}: {}", text(&output.stdout));
}

#[test]
fn runs_that_all_hold_end_well_and_name_the_worst() {
    let (_dir, mut command) = command(&[("net.toml", ALL_HOLD)]);
    let output = command.args(["--seeds", "7"]).output().unwrap();
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{printed}");
    assert!(
        printed.contains("  line 11: overlaps = 0 ") && printed.contains("\n1 runs of 1 file in "),
        "{printed}"
    );
    assert!(printed.ends_with(": none failed\n"), "{printed}");
}

#[test]
fn an_interrupted_command_shows_what_has_ended() {
    // Some seconds of each run are still to come when it is interrupted.
    let long = ALL_HOLD.replace("50ms", "100000s");
    let (dir, mut command) = command(&[("short.toml", ALL_HOLD), ("long.toml", &long)]);
    command.args(["--seeds", "1..3", "--jobs", "1", "--json", "s.json", "--junit", "s.xml"]);
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_secs(5));
    kill(Pid::from_raw(child.id() as i32), Signal::SIGINT).unwrap();
    let mut printed = String::new();
    child.stdout.take().unwrap().read_to_string(&mut printed).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{printed}");
    // On a slow host fewer than the three runs of the short file may have ended.
    let ended = printed
        .split_once("\nINTERRUPTED: ")
        .and_then(|(_, rest)| rest.split_once(" of 6 runs of 2 files in "));
    let ended: usize = ended.unwrap_or_else(|| panic!("{printed}")).0.parse().unwrap();
    assert!(ended <= 3, "{printed}");
    assert!(read(dir.path(), "s.json").contains("\"interrupted\": true,"));
    assert_eq!(read(dir.path(), "s.xml").matches("<skipped message=\"interrupted\"/>").count(), 6 - ended);
}

#[test]
fn progress_is_shown_on_a_terminal() {
    let (_dir, command) = command(&[("net.toml", &ALL_HOLD.replace("50ms", "20s"))]);
    let line =
        format!("{} sim run net.toml --seeds 1..20 --jobs 1 2>&1 >/dev/null", env!("CARGO_BIN_EXE_rtnet"));
    let mut script = Command::new("script");
    script.args(["-qec", &line, "/dev/null"]).current_dir(command.get_current_dir().unwrap());
    let Ok(output) = script.stdin(Stdio::null()).output() else {
        return skip("progress_is_shown_on_a_terminal", "no `script` to make a terminal");
    };
    let shown = text(&output.stdout);
    assert!(shown.contains(" of 20 runs, 0 failed, ") && shown.ends_with("\r\u{1b}[K"), "{shown:?}");
}
