//! The command `rtnet`, as a library, so that tests use its lab, scenario and report code.

// This crate is shell: it waits and looks at clocks. Protocol code lives elsewhere.
#![allow(clippy::disallowed_methods)]

pub mod cli;
pub mod cmd;
pub mod control;
pub mod daemon;
pub mod doctor;
pub mod judge;
pub mod lab;
pub mod metrics;
pub mod min_cycle;
pub mod observe;
pub mod plan;
pub mod remedy;
pub mod report;
pub mod ring;
pub mod scenario;
pub mod sim;
pub mod station;
pub mod units;
pub mod wakeups;
