//! The command as a person meets it: transcripts, bad input, and labs that are interrupted or killed.

// A test of real processes waits for them.
#![allow(clippy::disallowed_methods)]

mod abused;
mod cell;
mod lab;
mod live;
mod observe;
mod station;

use std::io::Write;
use std::path::Path;
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The command under test.
fn rtnet() -> Command {
    Command::new(env!("CARGO_BIN_EXE_rtnet"))
}

/// Says aloud, past the test harness, that a test did not run.
fn skip(test: &str, why: &str) {
    let _ = writeln!(std::io::stderr(), "SKIP {test}: {why}");
}

/// One network at a time: several would miss slots for each other.
static NETWORK: Mutex<()> = Mutex::new(());

/// The right to make network namespaces and a network in them; if there is none, says so.
fn as_root(test: &str) -> Option<MutexGuard<'static, ()>> {
    if !nix::unistd::geteuid().is_root() {
        skip(test, "needs root (CAP_SYS_ADMIN) for network namespaces");
        return None;
    }
    // A test that failed has taken its network down.
    Some(NETWORK.lock().unwrap_or_else(PoisonError::into_inner))
}

#[test]
fn transcripts() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli");
    trycmd::TestCases::new()
        .register_bin("rtnet", trycmd::schema::Bin::Path(env!("CARGO_BIN_EXE_rtnet").into()))
        .case(here.join("*.trycmd"))
        .run();
}
