//! All verbs that take a file refuse a network that cannot be in the same words, with its place.

use std::process::Output;

use crate::rtnet;

const VERBS: [&[&str]; 4] = [&["plan"], &["sim", "run"], &["lab", "run"], &["lab", "up"]];

/// Two stations in a cycle, with a line more.
fn network(cycle: &str, more: &str, slave: &str) -> String {
    format!(
        "cycle = \"{cycle}\"\n{more}\n[[station]]\nname = \"m\"\nrole = \"master\"\n[[station]]\nname = \"{slave}\"\nrole = \
         \"slave\"\n"
    )
}

/// Each verb's answer to a file, without the way to it.
fn answers(text: &str) -> Vec<(Option<i32>, String)> {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("net.toml"), text).unwrap();
    let answer = |verb: &&[&str]| {
        let Output { status, stderr, .. } =
            rtnet().current_dir(&dir).args(*verb).arg("net.toml").output().unwrap();
        (status.code(), String::from_utf8(stderr).unwrap())
    };
    VERBS.iter().map(answer).collect()
}

#[track_caller]
fn assert_all_refuse(text: &str, expected: &str) {
    let answers = answers(text);
    let (status, message) = &answers[0];
    assert!(*status == Some(2) && message.starts_with(&format!("rtnet: net.toml:{expected}")), "{message}");
    assert!(answers.iter().all(|answer| *answer == answers[0]), "{answers:?}");
}

#[test]
fn verbs_refuse_a_name_with_its_place() {
    for name in ["left arm", "", "a/b", "..", "-a", "m\u{f6}tor", "a.sock", &"x".repeat(33)] {
        assert_all_refuse(&network("5ms", "", name), &format!("7:8: '{name}' is no name: use letters"));
    }
    assert_all_refuse(&network("5ms", "", "m"), "7:8: the name 'm' is taken by another station");
}

#[test]
fn verbs_refuse_a_cycle_in_which_no_slave_locks() {
    let sum = "6:1: 'a' would never be locked: it calibrates in its slot 0, every 48us, and a round takes 50us by which jobs are \
               chosen before their instants + 672ns of a request on the air = 50.672us; a cycle of 50.672us or longer would do";
    assert_all_refuse(&network("48us", "", "a"), sum);
    let far = "sync_window = \"5us\"\n[medium]\npropagation = \"20us\"";
    assert_all_refuse(&network("51us", far, "a"), "8:1: 'a' would never be locked");
    let early = network("47us", "sync_window = \"4us\"\n[medium]\npropagation = \"6us\"", "a")
        .replace("\"master\"", "\"master\"\nslots = [{ id = 0, offset = \"30us\" }]")
        .replace("\"slave\"", "\"slave\"\nrounds = 0\nslots = [{ id = 0, offset = \"5us\" }]");
    let silent = "13:10: 'a' would be silent in its slot 0: what it sends there is chosen 50us before it begins at 5us";
    assert_all_refuse(&early, silent);
    assert_all_refuse(&network("999ns", "", "a"), "1:9: a cycle of 999ns: no slave follows one outside");
}

#[test]
fn verbs_refuse_a_duration_without_a_cycle() {
    let expected =
        "2:12: a duration of 999us, and a cycle lasts 1ms: nothing would be measured; make it 1ms or longer";
    assert_all_refuse(&network("1ms", "duration = \"999us\"", "a"), expected);
    for verb in ["run", "up"] {
        let output = rtnet().args(["lab", verb, "--duration", "1ns"]).output().unwrap();
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(message.contains("a duration of 1ns, and a cycle lasts 1ms"), "{message}");
        assert_eq!(output.status.code(), Some(2));
    }
    let trial = rtnet().args(["find-min-cycle", "--trial", "5ms"]).output().unwrap();
    let message = String::from_utf8(trial.stderr).unwrap();
    assert!(
        message.contains("a duration of 5ms, and a cycle lasts 10ms") && message.contains("--trial"),
        "{message}"
    );
}

#[test]
fn options_read_both_letters_of_micro() {
    for mu in ['\u{b5}', '\u{3bc}'] {
        let args = [format!("--cycle=500{mu}s"), format!("--guard=20 {mu}s")];
        let output = rtnet().args(["plan", "--stations", "2"]).args(args).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(text.contains("cycle = \"500us\"") && text.contains("guard = \"20us\""), "{text}");
    }
}
