//! The command as a person meets it: transcripts, bad input, and labs that are interrupted or killed.

// A test of real processes waits for them.
#![allow(clippy::disallowed_methods)]

mod abused;
mod addresses;
mod ages;
mod agree;
mod backups;
mod calibrate;
mod cell;
mod changes;
mod documents;
mod examples;
mod exec;
mod figures;
mod forged;
mod html;
mod interface;
mod lab;
mod limits;
mod link_attributes;
mod live;
mod manual;
mod min_cycle;
mod never_left;
mod nonsense;
mod observe;
mod observer;
mod packages;
mod private;
mod program_limits;
mod programs;
mod proxy;
mod requests;
mod rights;
mod ring;
mod router;
mod schedule;
mod seeds;
mod silent;
mod soak;
mod socket_options;
mod sockets;
mod station;
mod stays;
mod unwritten;
mod verdicts;
mod vnic;
mod wait_on_cycle;
mod wires;

// Of the other tests, whose package depends on the command's, which cannot depend on it: not all of it is used here.
#[allow(dead_code)]
#[path = "../src/aloud.rs"]
mod aloud;
#[allow(dead_code)]
#[path = "../src/bare.rs"]
mod bare;
#[allow(dead_code)]
#[path = "../src/captures.rs"]
mod captures;
#[path = "../src/host.rs"]
mod host;
#[path = "../src/program.rs"]
mod program;
#[path = "../src/schema.rs"]
mod schema;
#[allow(dead_code)]
#[path = "../src/vectors.rs"]
mod vectors;

use std::path::Path;
use std::process::Command;

/// The command under test.
fn rtnet() -> Command {
    Command::new(env!("CARGO_BIN_EXE_rtnet"))
}

#[test]
fn transcripts() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli");
    trycmd::TestCases::new()
        .register_bin("rtnet", trycmd::schema::Bin::Path(env!("CARGO_BIN_EXE_rtnet").into()))
        .case(here.join("*.trycmd"))
        .run();
}
