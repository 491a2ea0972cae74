//! The command line: the one source of its help.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;

use crate::units::{parse_nonnegative_span, parse_positive_span, parse_rate};

/// Real-time Ethernet in software: RTnet's TDMA on a stock kernel, without special hardware.
#[derive(Debug, Parser)]
#[command(name = "rtnet", version, max_term_width = 100)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub verb: Verb,
}

/// What the command can do.
#[derive(Debug, Subcommand)]
pub enum Verb {
    /// Networks on this machine, each station in a network namespace of its own
    #[command(subcommand)]
    Lab(LabVerb),
    /// Run one station in the foreground, on any Ethernet interface
    Station(Box<StationArgs>),
}

/// What can be done with a network on this machine.
#[derive(Debug, Subcommand)]
pub enum LabVerb {
    /// Stand a network up, measure it, print a report, and take it down again
    ///
    /// Every station is a process in its own namespace, joined by a bridge. The first is the master.
    /// Each sends one frame per slot to the next station; an observer on the bridge checks that every
    /// frame is in its slot. Needs root. Durations are written 250us, 1ms, 10s.
    ///
    /// Exit status: 0 all is well; 1 something unexplained, payload errors, lost frames or a lost station;
    /// 2 bad usage, bad configuration, or no privileges.
    Run(LabRunArgs),
}

/// Arguments of `lab run`.
#[derive(Debug, Args)]
pub struct LabRunArgs {
    /// Take the network from this file instead of from options
    pub file: Option<PathBuf>,
    /// How many stations, the master included
    #[arg(long, default_value_t = 4, conflicts_with = "file")]
    pub stations: usize,
    /// From one cycle's start to the next
    #[arg(long, default_value = "1ms", value_parser = parse_positive_span, conflicts_with = "file")]
    pub cycle: Span,
    /// How long to measure [default: 10s, or what the file says]
    #[arg(long, value_parser = parse_positive_span)]
    pub duration: Option<Span>,
    /// Bytes of each frame behind its Ethernet header
    #[arg(long, default_value_t = 64, value_name = "BYTES", conflicts_with = "file")]
    pub payload: usize,
    /// Line rate at which slots and overlaps are computed
    #[arg(long, default_value = "1G", value_parser = parse_rate, conflicts_with = "file")]
    pub rate: Rate,
    /// Least guard band behind each frame [default: the rest of the slot]
    #[arg(long, value_parser = parse_nonnegative_span, conflicts_with = "file")]
    pub guard: Option<Span>,
    /// Seed of the stations' clocks, which are off by up to 1 s and 50 ppm [default: 1]
    #[arg(long)]
    pub seed: Option<u64>,
    /// Give every station the host's own clock
    #[arg(long)]
    pub ideal_clocks: bool,
    /// Keep the real-time core from idling: steadier, at the price of its power
    #[arg(long)]
    pub warm_core: bool,
    /// The core of all real-time threads [default: the last]
    #[arg(long, value_name = "N")]
    pub cpu: Option<usize>,
    /// Write the report as JSON, too
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write every frame on the medium as pcapng
    #[arg(long, value_name = "FILE")]
    pub pcap: Option<PathBuf>,
}

/// Arguments of `station`.
#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("role").required(true).args(["master", "slave"]))]
pub struct StationArgs {
    /// The interface to run on
    #[arg(long, value_name = "IF")]
    pub interface: String,
    /// Give the time (needs --cycle)
    #[arg(long, requires = "cycle", conflicts_with = "rounds")]
    pub master: bool,
    /// From one cycle's start to the next
    #[arg(long, value_parser = parse_positive_span, conflicts_with = "slave")]
    pub cycle: Option<Span>,
    /// How long after a cycle's start its sync may still be sent [default: 50us, at most 1/8 cycle]
    #[arg(long, value_parser = parse_positive_span, conflicts_with = "slave")]
    pub sync_window: Option<Span>,
    /// Follow the master
    #[arg(long)]
    pub slave: bool,
    /// Calibration rounds; 0: none
    #[arg(long, default_value_t = rtmac::tdma::DEFAULT_ROUNDS, value_name = "N")]
    pub rounds: u32,
    /// A slot: its id and offset, and if it is not used in every cycle or takes less than 1500 bytes,
    /// phase P of N cycles and size in bytes. Can be given several times
    #[arg(long = "slot", value_name = "ID=OFFSET[,phase=P/N][,size=B]", value_parser = crate::cmd::station::parse_slot)]
    pub slots: Vec<crate::cmd::station::SlotArg>,
    /// A name that no other station on this machine has
    #[arg(long)]
    pub name: Option<String>,
    /// Highest slot id
    #[arg(long, default_value_t = rtmac::tdma::DEFAULT_MAX_SLOT_ID, value_name = "ID")]
    pub max_slot_id: u8,
    /// How long after a slot's begin its frame may still be sent
    #[arg(long, default_value = "50us", value_parser = parse_nonnegative_span)]
    pub latest: Span,
    /// What to do with a slot that has passed: skip it, or send late as RTnet does
    #[arg(long, default_value = "skip")]
    pub late: Late,
    /// How long before a slot its frame is chosen and spun for
    #[arg(long, default_value = "50us", value_parser = parse_nonnegative_span)]
    pub lead: Span,
    /// The core of the real-time thread [default: any]
    #[arg(long, value_name = "N")]
    pub cpu: Option<usize>,
    /// What a lab adds, in JSON
    #[arg(long, hide = true)]
    pub lab: Option<String>,
}

/// What to do with a slot that has passed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Late {
    /// Send nothing
    Skip,
    /// Send all the same
    Send,
}
