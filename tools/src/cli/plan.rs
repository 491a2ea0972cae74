//! The command line of `rtnet plan`.

use std::path::PathBuf;

use clap::Args;
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;

use crate::units::{parse_nonnegative_span, parse_positive_span, parse_rate};

/// Arguments of `plan`.
#[derive(Debug, Args)]
pub struct PlanArgs {
    /// The network, as for `lab run` and `sim run`
    #[arg(required_unless_present = "stations", conflicts_with = "stations")]
    pub file: Option<PathBuf>,
    /// Propose a network of so many stations, the master included, with a slot each
    #[arg(long, value_name = "N")]
    pub stations: Option<usize>,
    /// Line rate of the proposed network [default: 1G]
    #[arg(long, value_parser = parse_rate, conflicts_with = "file")]
    pub rate: Option<Rate>,
    /// Bytes of each of its frames behind the Ethernet header [default: 64]
    #[arg(long, value_name = "BYTES", conflicts_with = "file")]
    pub payload: Option<usize>,
    /// Its guard band [default: what --host needs, or what --cycle leaves]
    #[arg(long, value_parser = parse_nonnegative_span, conflicts_with = "file")]
    pub guard: Option<Span>,
    /// Its cycle [default: the shortest that has room for it, in whole microseconds]
    #[arg(long, value_parser = parse_positive_span, conflicts_with = "file")]
    pub cycle: Option<Span>,
    /// What `rtnet doctor --json` has measured of a host: says which guard band it needs, and whether this one is enough
    #[arg(long, value_name = "FILE")]
    pub host: Option<PathBuf>,
    /// Print the plan as JSON
    #[arg(long)]
    pub json: bool,
    /// Draw the time table, too
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
}
