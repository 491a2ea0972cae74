//! The command line of `rtnet sim`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use rtnet::time::Span;

use crate::sim::seeds::Seeds;
use crate::units::{parse_positive_span, parse_share};

/// What can be done with a network in virtual time.
#[derive(Debug, Subcommand)]
pub enum SimVerb {
    /// Run a scenario in virtual time, and print a report as `lab run` does
    ///
    /// The same stations as in a lab, on a simulated medium, hosts and clocks. A scenario is a lab's file, or one
    /// with faults, with what happens when, and with what is expected: `rtnet sim example` prints one that says it
    /// all. One seed is one run, to the byte. With --seeds each file is run with each of these seeds, several at
    /// once; a table shows what was worst, with its seed, and the command that repeats the first run that failed.
    ///
    /// Exit status: 0 OK: all is as expected, or, where nothing is, well; 1 NOT OK: the cycle and the frames around
    /// it are shown, or a file could not be written; 2 bad usage, or a scenario that cannot be; 3 INCONCLUSIVE: nothing was
    /// measured; 4 DEGRADED: more was missed than --max-miss, all for known causes; 130 INTERRUPTED: the report is of
    /// what was measured by then. With --seeds: 0 all runs are OK, 1 some are not, 130 it was interrupted, whatever
    /// had ended by then, which is shown.
    Run(SimRunArgs),
    /// Print a scenario that says what can be said, and runs
    Example,
}

/// Arguments of `sim run`.
#[derive(Debug, Args)]
pub struct SimRunArgs {
    /// The scenario; with --seeds there can be several
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Everything random follows from it [default: what the file says, or 1]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Each station may miss so many of its slots, 0.5% or 50ppm, where no expectation decides; more is DEGRADED
    /// [default: 0.5%, or what the file says]
    #[arg(long, value_name = "SHARE", value_parser = parse_share)]
    pub max_miss: Option<u32>,
    /// Run each FILE with each seed from A to B, both included, or with one, and show what was worst
    #[arg(long, value_name = "A..B", conflicts_with_all = ["seed", "html", "pcap"])]
    pub seeds: Option<Seeds>,
    /// With --seeds: runs at once; all results are the same with any number [default: one for each CPU]
    #[arg(long, value_name = "N", requires = "seeds", value_parser = clap::value_parser!(u16).range(1..=1_024))]
    pub jobs: Option<u16>,
    /// With --seeds: write a test case for each file and seed as JUnit's XML, too
    #[arg(long, value_name = "FILE", requires = "seeds")]
    pub junit: Option<PathBuf>,
    /// End after so much virtual time, joining included, whatever the file says
    #[arg(long, value_parser = parse_positive_span)]
    pub until: Option<Span>,
    /// Write the report as JSON, too; - is standard output, and the report for the screen goes to standard error then
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the report as one HTML page, too, with plots and the slots of the worst cycles
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Write every frame on the medium as pcapng, in virtual time; - as for --json
    #[arg(short = 'w', long, value_name = "FILE")]
    pub pcap: Option<PathBuf>,
}
