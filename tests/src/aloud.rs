//! Lines that tests print past their harness, for people, `scripts/accept` and `scripts/soak`.

use std::io::Write;

/// Says aloud, past the test harness, that a test did not run.
pub fn skip(test: &str, why: &str) {
    aloud(&format!("SKIP {test}: {why}\n"));
}

/// Says aloud what a test has measured, for `scripts/accept`.
pub fn figure(test: &str, text: &str) {
    aloud(&format!("FIGURE {test}: {text}\n"));
}

/// Says aloud that something is tried again, and why: `scripts/soak` counts it.
pub fn again(test: &str, why: &str) {
    aloud(&format!("AGAIN {test}: {why}\n"));
}

/// In one write: the harness writes its lines meanwhile, and those are read by programs, too.
fn aloud(line: &str) {
    // Nothing better can be done about standard error that is closed.
    let _ = std::io::stderr().write_all(line.as_bytes());
}
