//! The command line: the one source of its help.

mod lab;
mod listen;
mod min_cycle;
mod packages;
mod plan;
mod router;
mod schedule;
mod sim;
mod stack;
mod token;
mod vnic;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;

use crate::control::{Place, parse_name};
use crate::scenario::{DelayName, DelayPolicy, ServoName, SlotGuard};
use crate::units::{parse_nonnegative_span, parse_positive_span, parse_rate};

pub use lab::{
    DEFAULT_LAB, LabDownArgs, LabExecArgs, LabMeasureArgs, LabRestartArgs, LabRunArgs, LabStatusArgs,
    LabUpArgs, LabVerb,
};
pub use listen::{DumpArgs, JitterArgs, ListenArgs};
pub use min_cycle::MinCycleArgs;
pub use packages::{
    BenchArgs, MailboxArgs, MailboxVerb, PackageArgs, PackageRouteVerb, PackageVerb, PackageVerbArgs,
    duration,
};
pub use plan::PlanArgs;
pub use router::{RouterArgs, RouterRunArgs, RouterVerb};
pub use schedule::{ScheduleArgs, ScheduleVerb, WhenArgs};
pub use sim::{SimRunArgs, SimVerb};
pub use stack::{PingArgs, RouteArgs, RouteVerb, ShowArgs, StackArgs};
pub use token::{RingArgs, TokenArgs, TokenVerb};
pub use vnic::{VnicArgs, VnicMode, VnicVerb, VnicVerbArgs, of_a_device};

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
    /// Networks in virtual time, from the same files, with faults and with what is expected
    #[command(subcommand)]
    Sim(SimVerb),
    /// Measure what this host can hold: which cycle, how many stations, how many missed slots
    ///
    /// Measures how late threads wake, how often the host holds the core up, what sending costs, and
    /// what this process may do. Ends with a network to try, as its last line: `HOLDS: ...`, or
    /// `DOES NOT HOLD: ...` with the best there is. An ordinary user gets what needs no privilege.
    ///
    /// Exit status: 0 it was measured, whatever the verdict; 1 a file could not be written; 2 bad usage.
    Doctor(DoctorArgs),
    /// Find the shortest cycle that this host holds, by trying, prove it, and keep it for comparison
    ///
    /// Each trial is a lab of its own (as `rtnet lab run --stations N --cycle ...`) with a cycle of the E24 series: 1ms, 910us,
    /// 820us, 750us ... A trial is judged by what is usual in it: the middle one of its 20 parts. The shortest cycle that holds
    /// is then run for longer, and all that is missed counts; if that is too much, longer ones are proven. A run whose verdict is
    /// INCONCLUSIVE is repeated, five times in all.
    ///
    /// Exit status: 0 found, and as good as in --compare's file; 1 none was found, or it is a regression, or a file could not be
    /// written; 2 bad usage, or no privileges; 3 INCONCLUSIVE: the host was too disturbed; 130 it was interrupted.
    FindMinCycle(MinCycleArgs),
    /// Say what a network does before it runs: when who sends, how long frames wait at the worst; or propose one
    ///
    /// Of a file it shows the time table, what guard bands absorb, the worst wait from queue to wire of each slot and priority, the
    /// worst round trips, and what VNICs get. With --stations it prints the file of the network with the shortest cycle instead,
    /// for `rtnet lab run` and `rtnet sim run`. All of it is arithmetic; `rtnet find-min-cycle` tries.
    ///
    /// Exit status: 0 it works, if only on few hosts; 1 it cannot: traffic that wants more turns than there are, a guard band that
    /// clocks take whole, or a --host that misses too many slots;
    /// 2 bad usage, or slots that do not go together, with the sum that shows it.
    Plan(PlanArgs),
    /// Run one station in the foreground, on any Ethernet interface
    ///
    /// It knows only its own slots, and refuses those that overlap each other, or as master its sync window or the
    /// cycle's end; that they keep clear of other stations' slots is for you to see to. It goes on without a carrier,
    /// while the interface is down, and when it is renamed; `rtnet tdma status` shows which.
    ///
    /// Exit status: 0 it was told to end (Ctrl-C, SIGTERM); 1 it cannot go on: its interface is gone, or another
    /// master is active on this medium; 2 bad usage, slots that do not go together, a name that is taken, no such
    /// interface, or no privileges.
    Station(Box<StationArgs>),
    /// Look at a running station, or change its part in the cycle
    Tdma(TdmaArgs),
    /// Look at a running station of a ring: where the token is, and how long it takes to come round
    Token(TokenArgs),
    /// Look at the slots of a running station, or change them
    ///
    /// A change is effective from the next cycle on, and no queued frame is lost unless it does not fit its
    /// slot any more. A slot that is joined to another (ID->ID in the list) takes frames from that one's queue, and
    /// follows when it is made smaller; when it is made larger, it has a queue of its own from then on. In a lab, a slot that overlaps another station's is refused; a station of its own
    /// refuses what overlaps its own slots, or as master its sync window, and trusts that you know the others'.
    Slot(SlotArgs),
    /// Look at the schedule of a running network, or change it: slots of all stations, and the cycle
    ///
    /// The acting master proposes a schedule; every station that has slots acknowledges it, or says why it cannot; all switch in
    /// one cycle. Whoever does not answer stops the change. If the master dies meanwhile, either the old or the new one is in use
    /// everywhere. Stations take part that were started with --extensions, as all of a lab are.
    ///
    /// Exit status: 0; 1 the change was stopped, and all go on as before; 2 bad usage, or a schedule that cannot be.
    Schedule(ScheduleArgs),
    /// Show the address of a running station, what its slots take, and what its interface has counted
    ///
    /// For a station that was started with an address (`rtnet station --ip`), as are `route` and `ping`; `pool` and `stat` are
    /// for one with a VNIC (`rtnet station --vnic`), too.
    If(ShowArgs),
    /// Look at the routes of a running station, or change them
    ///
    /// Nothing is asked of the network unless you do: who has which address is said by hand, or asked for by
    /// hand with `solicit`.
    ///
    /// Exit status: 0; 1 nobody answered, or there is no route; 2 bad usage, or a route that cannot be.
    Route(RouteArgs),
    /// Ask a station for echoes, from a running station, and tell how long they took
    ///
    /// The time of an echo is from when the station was asked until the answer came; how much of it the
    /// question waited for its slot is told, too. Questions come at other moments of the cycle each time,
    /// so that the best and the worst case show; in a lab, what the schedule says of them stands below.
    ///
    /// Exit status: 0; 1 nothing came back, or nothing could be sent, or the station went and not everything came back;
    /// 2 bad usage.
    Ping(PingArgs),
    /// Show the buffers of a running station: how many each of its pools has, and what was lost for want of one
    Pool(ShowArgs),
    /// Show everything that a running station counts, by reason
    Stat(ShowArgs),
    /// Look at the VNIC of a running station, or change it
    ///
    /// A VNIC is a network device of Linux whose frames go through the tunnel: in slot 1, each in a turn that nothing
    /// real-time wants. For a station that was started with one (`rtnet station --vnic`).
    ///
    /// Exit status: 0; 2 bad usage, or the station has no VNIC, or Linux refuses.
    Vnic(VnicVerbArgs),
    /// Look at the mailboxes of a running station: whose they are, what waits in them, what was refused, how long packages took
    ///
    /// Nobody is asked but the station's broker: no component notices. For a station that was started with `--packages`.
    ///
    /// Exit status: 0; 2 bad usage, or the station has no packages.
    Mailbox(MailboxArgs),
    /// Send packages, receive them, ask for answers, and say where mailboxes are that are not here
    ///
    /// As a component of the station does, with a mailbox that is there as long as the command.
    ///
    /// Exit status: 0; 1 nothing came, or a package could not be sent; 2 bad usage, or the station refuses.
    Package(PackageVerbArgs),
    /// Run the TCP router, by which programs on other hosts and in other languages send each other packages; or look at one
    ///
    /// Programs connect by TCP and register the names of their mailboxes; the router passes packages on, the most urgent first.
    /// It runs in the foreground. Packages for a connection that does not read wait up to a limit; beyond it less urgent ones make
    /// room for more urgent ones, all others are refused, and a command that is lost is answered NOT_AVAILABLE.
    ///
    /// Exit status: 0 a signal ended it (Ctrl-C, SIGTERM); 1 it cannot go on; 2 bad usage, an address that is taken, a name that
    /// is taken.
    Router(RouterArgs),
    /// Listen to a network, and tell how its syncs and frames are spread about their instants
    ///
    /// Nothing is sent. Of a lab it listens on the bridge, as the user who owns the lab; on an interface as
    /// root, where a station's own frames are not heard on its own interface. Where cycles begin is learned from
    /// 64 syncs first, for 5 s at most.
    ///
    /// Exit status: 0; 1 no sync was heard, the network went away, or a file could not be written; 2 bad usage, no such
    /// interface or lab, or no privileges.
    Jitter(JitterArgs),
    /// Listen to a network, and show each frame, or write it for Wireshark
    ///
    /// Nothing is sent. A line has the time of day (UTC, the kernel's stamp), who sends to whom, the slot error of
    /// a frame that says when it was scheduled, else @ and its place in the cycle, and what it is. With -w
    /// frames are written instead, each with a comment that says its cycle, slot and slot error. Where cycles
    /// begin is learned from the syncs first, which takes up to half a second.
    ///
    /// Exit status: 0; 1 the network went away, or the file cannot be written; 2 bad usage, no such interface or
    /// lab, or no privileges.
    Dump(DumpArgs),
    /// Print completions for a shell, as in `source <(rtnet completions bash)`
    Completions {
        /// Which shell
        shell: clap_complete::Shell,
    },
    /// Write the manual pages, one for each command
    Man {
        /// Where to: it is made if it does not exist
        #[arg(default_value = ".", value_name = "DIRECTORY")]
        directory: PathBuf,
    },
}

/// Which running station.
#[derive(Debug, Args)]
pub struct Which {
    /// The station: its --name, or, in a lab, LAB/STATION; where there is only one lab, LAB/ can be left out
    #[arg(short = 'S', long = "station", value_name = "[LAB/]STATION")]
    pub place: Place,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// The same, on either side of what is to be done with it. `-S` must be there, too; but clap knows of what can stand on either
/// side only that it need not.
#[derive(Debug, Args)]
pub struct WhichOf {
    /// The station, which has to be named: by its --name, or, in a lab, LAB/STATION; where there is only one lab, LAB/ can be
    /// left out
    #[arg(short = 'S', long = "station", value_name = "[LAB/]STATION", global = true)]
    pub place: Option<Place>,
    /// Print JSON
    #[arg(long, global = true)]
    pub json: bool,
}

/// Arguments of `tdma`.
#[derive(Debug, Args)]
pub struct TdmaArgs {
    /// Which.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do with it.
    #[command(subcommand)]
    pub verb: TdmaVerb,
}

/// What can be done with a station's part in the cycle.
#[derive(Debug, Subcommand)]
pub enum TdmaVerb {
    /// Role, state, slots, counters, and what the host refused
    Status {
        /// Show what was missed, and why: by cause, and the ten longest
        #[arg(long)]
        misses: bool,
    },
    /// Listen for three cycles, then give the time, and wait for that; where another master is heard the station
    /// makes way for it, silent from then on, and the exit status is 1
    Master {
        /// From one cycle's start to the next
        #[arg(long, value_parser = parse_positive_span)]
        cycle: Span,
    },
    /// Follow the master
    Slave {
        /// Calibration rounds; 0: none
        #[arg(long, default_value_t = rtmac::tdma::DEFAULT_ROUNDS, value_name = "N")]
        rounds: u32,
        /// How syncs become its time line [default: as it was started, and so are the others]
        #[arg(long)]
        servo: Option<ServoName>,
        /// What all calibration rounds say together of the delay
        #[arg(long, value_name = "OF")]
        delay: Option<DelayName>,
        /// Cycles without a sync that are bridged; in a lab it is one
        #[arg(long, value_name = "N")]
        holdover: Option<u32>,
        /// What becomes of the measured delay when another master gives the time
        #[arg(long, value_name = "WHAT")]
        on_master_change: Option<DelayPolicy>,
    },
    /// Measure the delay from the master anew, as a slave or a backup that stands by, which stays in the cycle
    ///
    /// Until that is done, its first slot carries data in two of four turns at most, and the delay that is known stays in
    /// use. Nothing is changed if too many requests have no answer: `status` tells how far it is, and what came of it.
    Calibrate {
        /// Rounds, at least 1 [default: as many as the first time]
        #[arg(long, value_name = "N")]
        rounds: Option<u32>,
    },
    /// Take no part in the cycle: silent and deaf until told to be master or slave again
    Detach,
}

/// Arguments of `slot`.
#[derive(Debug, Args)]
pub struct SlotArgs {
    /// Which.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do with them.
    #[command(subcommand)]
    pub verb: SlotVerb,
}

/// What can be done with a station's slots.
#[derive(Debug, Subcommand)]
pub enum SlotVerb {
    /// Every slot, how long a frame waits for it at the worst, how many wait, how many were sent in it
    List,
    /// Define a slot, or change one: what is not given stays as it is
    Set {
        /// Its id and offset; if it is not used in every cycle or takes less than 1500 bytes, phase P of N
        /// cycles and size in bytes; if it takes its frames from the queue of another of the same size, that one's
        /// id (joint=none: from its own again)
        #[arg(value_name = "ID=OFFSET[,phase=P/N][,size=B][,joint=ID]", value_parser = crate::cmd::station::parse_slot)]
        slot: crate::control::SlotChange,
    },
    /// Remove a slot; what is queued in it is dropped and counted, but of slot 1, for which slot 0 sends then, and of
    /// a joint slot. One that others are joined to stays
    Remove {
        /// Its id
        id: u8,
    },
}

/// Arguments of `doctor`.
#[derive(Debug, Args)]
pub struct DoctorArgs {
    /// The core that real-time threads would use [default: the last]
    #[arg(long, value_name = "N")]
    pub cpu: Option<usize>,
    /// How long to measure altogether, at least 1s
    #[arg(long, default_value = "20s", value_parser = parse_measurement)]
    pub duration: Span,
    /// Write all figures as JSON, too
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Enter a user namespace and end: 0 it could be done, 1 not
    #[arg(long, hide = true)]
    pub probe_user_namespace: bool,
}

/// A shorter one sees too few wake-ups to tell anything of the late ones.
fn parse_measurement(text: &str) -> Result<Span, String> {
    let span = parse_positive_span(text).map_err(|error| error.to_string())?;
    let least = Span::from_millis(1_000);
    if span < least {
        Err(format!("'{text}' is too short: at least 1s, or nothing is seen"))
    } else {
        Ok(span)
    }
}

/// Arguments of `station`.
#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("role").args(["master", "slave"]))]
pub struct StationArgs {
    /// The interface to run on
    #[arg(long, value_name = "IF")]
    pub interface: String,
    /// How it shares the medium. Without time slots, `nomac`, `direct` or `token`, nothing that is about roles, cycle and slots
    /// can be said
    #[arg(long, default_value = "tdma")]
    pub discipline: DisciplineName,
    /// Give the time (needs --cycle); with TDMA this or --slave must be said
    #[arg(long, requires = "cycle")]
    pub master: bool,
    /// As a master, be a backup: send the sync only if there is none until so long after a cycle's start. Slots come
    /// later than that, and those of other backups
    #[arg(long, value_name = "OFFSET", requires = "master", value_parser = parse_positive_span)]
    pub backup: Option<Span>,
    /// As a master, know that backups send so long after a cycle's start or later: from one that gives the time, its place
    /// is taken back. Without, a master that finds another ends
    #[arg(long, value_name = "OFFSET", requires = "master", conflicts_with = "backup", value_parser = parse_positive_span)]
    pub backups_from: Option<Span>,
    /// From one cycle's start to the next
    #[arg(long, value_parser = parse_positive_span, conflicts_with = "slave")]
    pub cycle: Option<Span>,
    /// How long after a cycle's start its sync may still be sent [default: 50us, at most 1/8 cycle]
    #[arg(long, value_parser = parse_positive_span, conflicts_with = "slave")]
    pub sync_window: Option<Span>,
    /// Follow the master
    #[arg(long)]
    pub slave: bool,
    /// Calibration rounds, of a master when it follows another; 0: none [default: 100]
    #[arg(long, value_name = "N")]
    pub rounds: Option<u32>,
    /// How syncs become its time line, of a master when it follows another [default: linear]
    #[arg(long)]
    pub servo: Option<ServoName>,
    /// What all calibration rounds say together of the delay [default: quartile; with --servo none mean]
    #[arg(long, value_name = "OF")]
    pub delay: Option<DelayName>,
    /// Cycles without a sync that are bridged before it is silent. How far its time may be off meanwhile,
    /// `rtnet tdma status` tells [default: 1]
    #[arg(long, value_name = "N")]
    pub holdover: Option<u32>,
    /// What becomes of the measured delay when another master gives the time [default: keep]
    #[arg(long, value_name = "WHAT")]
    pub on_master_change: Option<DelayPolicy>,
    /// Calibration requests that a master answers at a time; more are refused, and counted as `reply_backlog`
    #[arg(long, default_value_t = rtmac::tdma::DEFAULT_MAX_REQUESTS, value_name = "N", conflicts_with = "slave")]
    pub max_requests: usize,
    /// A slot: its id and offset, and if it is not used in every cycle or takes less than 1500 bytes,
    /// phase P of N cycles and size in bytes; if it takes its frames from the queue of another of the same size, that
    /// one's id. Can be given several times
    #[arg(long = "slot", value_name = "ID=OFFSET[,phase=P/N][,size=B][,joint=ID]", value_parser = crate::cmd::station::parse_slot)]
    pub slots: Vec<crate::control::SlotChange>,
    /// Take part in changes of the schedule (`rtnet schedule`): all stations of a network, or none. Stations of RTnet know
    /// nothing of it, and would keep their slots
    #[arg(long)]
    pub extensions: bool,
    /// Line rate at which its slots are checked against each other, and a master's against its cycle
    #[arg(long, default_value = "1G", value_parser = parse_rate)]
    pub rate: Rate,
    /// A name that no other station on this machine has; under it `rtnet tdma` and `rtnet slot` find it
    /// [default: the interface's, if no other station has that]
    #[arg(long, value_parser = parse_name)]
    pub name: Option<String>,
    /// Highest slot id
    #[arg(long, default_value_t = rtmac::tdma::DEFAULT_MAX_SLOT_ID, value_name = "ID")]
    pub max_slot_id: u8,
    /// How long after a slot's begin its frame may still be sent
    #[arg(long, default_value = "50us", value_parser = parse_nonnegative_span)]
    pub latest: Span,
    /// What to do with a slot that has passed: skip it, or send late as RTnet does [default: skip]
    #[arg(long)]
    pub late: Option<Late>,
    /// What keeps the station from sending later than that. The kernel's guard drops its late frames at the
    /// interface; it takes root, or CAP_BPF and CAP_NET_ADMIN
    #[arg(long, default_value = "auto")]
    pub slot_guard: SlotGuard,
    /// Let the kernel's guard drop what other programs send on the interface, too, a remote shell's frames among them
    ///
    /// Without it they pass, and are counted as `others_passed`: they may meet any station's frames.
    #[arg(long)]
    pub exclusive: bool,
    /// How long before a slot its frame is chosen and spun for
    #[arg(long, default_value = "50us", value_parser = parse_nonnegative_span)]
    pub lead: Span,
    /// How the real-time thread is scheduled: before all others, or as any other
    #[arg(long, default_value = "fifo")]
    pub scheduling: Scheduling,
    /// The core of the real-time thread [default: any]
    #[arg(long, value_name = "N")]
    pub cpu: Option<usize>,
    /// Serve the counters of `rtnet stat`, and the state of its clock, for Prometheus by HTTP, at /metrics of this loopback
    /// address. Other hosts read it by a reverse proxy or an SSH tunnel
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = crate::metrics::parse_loopback)]
    pub metrics: Option<std::net::SocketAddr>,
    /// The ring that it is in.
    #[command(flatten)]
    pub ring: RingArgs,
    /// Its address and its sockets.
    #[command(flatten)]
    pub stack: StackArgs,
    /// The tunnel, and its device.
    #[command(flatten)]
    pub vnic: VnicArgs,
    /// What its programs send each other.
    #[command(flatten)]
    pub packages: PackageArgs,
    /// What a lab adds, in JSON
    #[arg(long, hide = true)]
    pub lab: Option<String>,
}

/// A way to share the medium.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DisciplineName {
    /// RTmac's time slots, by a master's time
    Tdma,
    /// RTmac without slots: frames leave at once, the most urgent first
    Nomac,
    /// No RTmac: frames leave at once, in the order in which they were queued
    Direct,
    /// The right to send goes round the stations of --ring: no clock has to be synchronised, and there is no master
    Token,
}

/// How a real-time thread is scheduled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Scheduling {
    /// SCHED_FIFO: before everything that is not real-time
    Fifo,
    /// As any other thread
    Other,
    /// As any other thread, and never asleep: it takes a whole core, and round trips do not wait for wake-ups. Without time
    /// slots only
    Busy,
}

/// What to do with a slot that has passed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Late {
    /// Send nothing
    Skip,
    /// Send all the same
    Send,
}
