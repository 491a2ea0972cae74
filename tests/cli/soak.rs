//! `scripts/soak` with a script in place of cargo. Each test prescribes the result of every call.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

/// Its nth call behaves as the nth line of `courses` says.
const CARGO: &str = r#"#!/bin/sh
echo "$*" >>"$SOAK_CALLS"
case $(sed -n "$(wc -l <"$SOAK_CALLS")p" "$SOAK_COURSES") in
passes) echo "test a ... ok"; echo "test result: ok. 1 passed; 0 failed;" ;;
again) echo "test a ... AGAIN a::b: this host stood still for 30ms: why"; echo "test result: ok. 1 passed; 0 failed;" ;;
fails) cat <<'END'; exit 101 ;;
     Running sim/main.rs (target/debug/deps/sim-0123456789abcdef)
failures:

---- scenarios::a stdout ----
    a line of what it printed

failures:
    scenarios::a
    scenarios::b

test result: FAILED. 1 passed; 2 failed;
   Doc-tests rtnet

failures:
    rtnet/src/lib.rs - (line 3)

test result: FAILED. 1 passed; 1 failed;
END
killed) cat <<'END'; exit 101 ;;
     Running sim/main.rs (target/debug/deps/sim-0123456789abcdef)
failures:
    scenarios::a

test result: FAILED. 1 passed; 1 failed;
     Running ../tests/cli/main.rs (target/debug/deps/cli-0123456789abcdef)
  process didn't exit successfully: `target/debug/deps/cli-0123456789abcdef` (signal: 9, SIGKILL: kill)
END
broken) echo "error: could not compile"; exit 101 ;;
seed) [ "$RTNET_SEED" = 8 ] || exit 1 ;;
cases) [ "$PROPTEST_CASES" = 2560 ] || exit 1 ;;
busy) # Besides this one, the script has one child for each core.
    [ "$(wc -w </proc/$PPID/task/$PPID/children)" = "$(($(nproc) + 1))" ] || exit 1 ;;
esac
"#;

fn soak(courses: &[&str], arguments: &[&str]) -> (Output, String) {
    let dir = tempfile::tempdir().unwrap();
    let (cargo, told, calls) =
        (dir.path().join("cargo"), dir.path().join("courses"), dir.path().join("calls"));
    std::fs::write(&cargo, CARGO).unwrap();
    std::fs::set_permissions(&cargo, PermissionsExt::from_mode(0o755)).unwrap();
    std::fs::write(&told, courses.join("\n") + "\n").unwrap();
    std::fs::write(&calls, "").unwrap();
    let path = format!("{}:{}", dir.path().display(), std::env::var("PATH").unwrap());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts/soak");
    let mut command = Command::new(script);
    command.args(arguments).env("PATH", path).env("SOAK_CALLS", &calls).env("SOAK_COURSES", &told);
    let output = command.env("RTNET_SOAK_LOGS", dir.path().join("logs")).output().unwrap();
    (output, std::fs::read_to_string(calls).unwrap())
}

fn printed(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn soak_counts_how_often_each_test_fails() {
    let (output, calls) = soak(&["passes", "fails", "broken", "killed"], &["--tests", "4"]);
    assert_eq!(calls, "test --workspace --no-fail-fast\n".repeat(4));
    let text = printed(&output);
    let table = text.split_once(" s: 3 failed\n").expect("the runs that failed").1;
    let expected = "failures  test\n       2  sim: scenarios::a\n       1  cli: killed (signal: 9, SIGKILL: kill)\n       1  \
                    does not build\n       1  rtnet: rtnet/src/lib.rs - (line 3)\n       1  sim: scenarios::b\n";
    assert_eq!((table, output.status.code()), (expected, Some(1)));
}

#[test]
fn soak_ends_well_if_no_test_fails() {
    let (output, _) = soak(&["passes", "again"], &["--tests", "2"]);
    let text = printed(&output);
    assert!(text.contains("2 of 2 runs of `cargo test --workspace --no-fail-fast` in "), "{text}");
    assert!(text.ends_with(" s: 0 failed\n   again  test\n       1  a::b\n"), "{text}");
    assert_eq!(output.status.code(), Some(0));
}

#[test]
fn soak_computes_on_each_core_of_a_busy_host() {
    let (output, calls) = soak(&["busy", "busy"], &["--tests", "2", "--busy"]);
    let text = printed(&output);
    assert_eq!((calls.lines().count(), output.status.code()), (2, Some(0)), "{text}");
    let first = text.lines().next().unwrap();
    let load = first.strip_prefix("busy: ").and_then(|text| text.strip_suffix(" compute")).expect(first);
    for process in load.split(' ') {
        assert!(!Path::new("/proc").join(process).exists(), "{process} ends with it");
    }
}

#[test]
fn soak_runs_networks_with_each_seed() {
    let (output, calls) = soak(&["passes", "seed"], &["--networks", "7..8"]);
    let run = "test --workspace --test sim -- --skip scenarios::";
    assert_eq!(calls, format!("{run}\n{run}\n"));
    let text = printed(&output);
    assert!(text.starts_with("run 7: passed\nrun 8: passed\n2 of 2 runs of `cargo test "), "{text}");
    assert_eq!(output.status.code(), Some(0), "{text}");
}

#[test]
fn soak_gives_properties_more_cases() {
    let (output, calls) = soak(&["cases"], &["--properties", "10"]);
    assert_eq!(calls, "test --workspace --no-fail-fast --lib --test vectors --test hostile\n");
    assert_eq!(output.status.code(), Some(0), "{}", printed(&output));
}

#[test]
fn soak_refuses_nonsense() {
    for arguments in [
        &["--tests"][..],
        &["--tests", "0"],
        &["--tests", "few"],
        &["7"],
        &["--seeds", "1..2", "3"],
        &["--seeds", "1..2", "--busy"],
        &["--networks", "8..7"],
        &["--properties", "0"],
    ] {
        let (output, calls) = soak(&[], arguments);
        assert_eq!((output.status.code(), calls.as_str()), (Some(2), ""), "{arguments:?}");
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(
            said,
            "usage: scripts/soak [--seeds A..B] | scripts/soak --tests N [--busy] | scripts/soak --networks A..B \
             | scripts/soak --properties N\n"
        );
    }
}
