//! Whatever reads what others wrote, against as much nonsense as fits some seconds.
//!
//! ```text
//! seeds, corpus/TARGET ──► mutate ──► run ──┬─► something new came of it: the next mutations begin with it, too
//!            ▲                              ├─► nothing new
//!            └──────────────────────────────┴─► a panic: shortened, shown, to be added to the corpus
//! ```
//!
//! `RTNET_FUZZ_SECONDS=60` runs each target so long (default: 2), `RTNET_FUZZ_SEED=7` another course,
//! `RTNET_FUZZ_INPUT=HEX` that input alone; `scripts/fuzz` says so for one target.

// It runs for so long.
#![allow(clippy::disallowed_methods)]

mod addresses;
mod engine;
mod frames;
mod lines;
mod mutate;
mod packages;
mod parsers;
mod rings;
mod sockets;
mod stack;
mod station;
mod steps;
mod texts;
mod token;
mod tunnel;
