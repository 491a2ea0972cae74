//! The command line of `rtnet lab`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use rtmac::tdma::schedule::Rate;
use rtnet::ip::route::Network;
use rtnet::time::Span;

use super::VnicMode;
use crate::control::{Place, parse_name};
use crate::scenario::SlotGuard;
use crate::units::{parse_nonnegative_span, parse_positive_span, parse_rate, parse_share};

/// What can be done with a network on this machine.
#[derive(Debug, Subcommand)]
pub enum LabVerb {
    /// Stand a network up, measure it, print a report, and take it down again
    ///
    /// Every station is a process in its own namespace, joined by a bridge. The first is the master.
    /// Each sends one frame per slot to the next station; an observer on the bridge checks that every
    /// frame is in its slot. An ordinary user's lab lives in a user namespace, without SCHED_FIFO. Durations
    /// are written 250us, 1ms, 10s.
    ///
    /// Exit status: 0 OK; 1 NOT OK: something unexplained, payload errors, lost frames, a lost station, or a file that
    /// could not be written; 2 bad usage, bad configuration, or no privileges; 3 INCONCLUSIVE: the host was too disturbed,
    /// or part of the run was not observed; 4 DEGRADED: more was missed than --max-miss, or frames met or left their
    /// slots, all for known causes; 130 INTERRUPTED.
    Run(LabMeasureArgs),
    /// Stand a network up and keep it: it runs until `rtnet lab down`
    ///
    /// Takes the same arguments as `lab run`. With --duration it goes down by itself; what it cannot write then, it says
    /// only with --foreground. Exit status: 0 all its stations are locked; 2 it could not be stood up, and nothing is left
    /// of it; 130 it was interrupted before it was up. With --foreground, once it was up, that of `lab down`; 130
    /// INTERRUPTED before its --duration was over.
    Up(LabUpArgs),
    /// Take a network down, and tell how it went
    ///
    /// Exit status, of several labs the worst: 0 OK; 1 NOT OK, or a file of the lab could not be written; 2 there is no
    /// such lab; 3 INCONCLUSIVE, or it had died, and its figures are lost; 4 DEGRADED; see `lab run`.
    Down(LabDownArgs),
    /// How a network is going, or all of them
    ///
    /// Exit status: as of `lab down`, so far; 2 one of them does not answer.
    Status(LabStatusArgs),
    /// Put a new process in the place of a station's, be it running, stopped or dead
    ///
    /// The others go on. A slave calibrates anew; a master goes on with the grid of cycles that it had. What is
    /// missed meanwhile counts as missed, for the cause `station_down`.
    ///
    /// Exit status: 0 the station is locked again; 1 it is not, within 30 s; 2 there is no such station or lab.
    Restart(LabRestartArgs),
    /// Run a command in the network namespace of a station
    ///
    /// Its /sys shows the interfaces there, in a mount namespace of its own. It ends with the lab, with all that it has
    /// started there: SIGTERM, and SIGKILL a second later.
    ///
    /// Exit status: the command's; 127 it is not found; 126 it cannot be executed; 2 bad usage, or there is no such
    /// station or lab.
    Exec(LabExecArgs),
}

/// Arguments of `lab up`.
#[derive(Debug, Args)]
pub struct LabUpArgs {
    /// What network.
    #[command(flatten)]
    pub run: LabRunArgs,
    /// A name that no other lab on this machine has
    #[arg(long, default_value = DEFAULT_LAB, value_parser = parse_name)]
    pub name: String,
    /// Stay in the foreground; Ctrl-C takes the network down
    #[arg(long)]
    pub foreground: bool,
    /// Let go of standard output and error once the network is up
    #[arg(long, hide = true)]
    pub detached: bool,
}

/// Arguments of `lab down`.
#[derive(Debug, Args)]
pub struct LabDownArgs {
    /// Which
    #[arg(default_value = DEFAULT_LAB, conflicts_with = "all", value_parser = parse_name)]
    pub name: String,
    /// Every one of this user's
    #[arg(long)]
    pub all: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `lab status`.
#[derive(Debug, Args)]
pub struct LabStatusArgs {
    /// Which [default: every one of this user's]
    #[arg(value_parser = parse_name)]
    pub name: Option<String>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `lab restart`.
#[derive(Debug, Args)]
pub struct LabRestartArgs {
    /// Which station; without LAB/ one of the only lab, or of the one named 'lab'
    #[arg(value_name = "[LAB/]STATION")]
    pub place: Place,
}

/// Arguments of `lab exec`.
#[derive(Debug, Args)]
pub struct LabExecArgs {
    /// Which station; without LAB/ one of the only lab, or of the one named 'lab'
    #[arg(value_name = "[LAB/]STATION")]
    pub place: Place,
    /// On any core, also that of the lab's real-time threads, which it may hold up
    #[arg(long)]
    pub any_core: bool,
    /// What to run there, and its arguments
    #[arg(last = true, required = true, value_name = "COMMAND")]
    pub command: Vec<std::ffi::OsString>,
}

/// The lab that is meant when none is named.
pub const DEFAULT_LAB: &str = "lab";

/// Arguments of `lab run`.
#[derive(Debug, Args)]
pub struct LabMeasureArgs {
    /// What network.
    #[command(flatten)]
    pub run: LabRunArgs,
    /// Write the report as one HTML page, too, with plots and the slots of the worst cycles
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
}

/// What network, and what to write of it.
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
    /// Guard band behind each frame, in which, but for the clocks' share at either end, a late frame may start
    /// [default: the rest of the slot]
    #[arg(long, value_parser = parse_nonnegative_span, conflicts_with = "file")]
    pub guard: Option<Span>,
    /// Give every station a VNIC with an address of this network, as 10.1.0.0/24: the master .1, the others .2, .3 ... Slots hold
    /// 1500 bytes then
    #[arg(long, value_name = "NETWORK", conflicts_with = "file")]
    pub vnic: Option<Network>,
    /// What goes through VNICs: tap, Ethernet frames of any type; tun, packets of IP only [default: tap]
    #[arg(long, value_name = "MODE", requires = "vnic", conflicts_with = "file")]
    pub vnic_mode: Option<VnicMode>,
    /// What keeps stations from sending later than their slots allow [default: auto, or what the file says]
    #[arg(long)]
    pub slot_guard: Option<SlotGuard>,
    /// Each station may miss so many of its slots, 0.5% or 50ppm, where no expectation of the file decides; more is DEGRADED
    /// [default: 0.5%, or what the file says]
    #[arg(long, value_name = "SHARE", value_parser = parse_share)]
    pub max_miss: Option<u32>,
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
    /// Write the report as JSON, too; - is standard output, and the report for the screen goes to standard error then
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write every frame on the medium as pcapng; - as for --json: `rtnet lab run -w - | tshark -r -`
    #[arg(short = 'w', long, value_name = "FILE")]
    pub pcap: Option<PathBuf>,
}
