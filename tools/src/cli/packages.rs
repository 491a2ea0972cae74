//! The command line of what is about packages and mailboxes.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use package_router::mailbox::LARGEST_BODY;
use package_router::name::{MailboxName, Pattern};
use package_router::tcp::address::Address;
use rtnet::time::Span;

use super::WhichOf;
use crate::units::{parse_nonnegative_span, parse_positive_span};

/// What `station` is told of packages.
#[derive(Debug, Args)]
#[command(next_help_heading = "Packages")]
pub struct PackageArgs {
    /// Let this user's programs send each other packages by the names of mailboxes; with an address (--ip) those of other
    /// stations, too
    #[arg(long)]
    pub packages: bool,
    /// Which station has a mailbox, or all that a pattern means: 0.Pilot.*=10.0.0.3. Can be given several times
    #[arg(long, value_name = "PATTERN=IP", requires_all = ["packages", "ip"], value_parser = crate::cmd::package::parse_route)]
    pub package_route: Vec<(Pattern, std::net::Ipv4Addr)>,
    /// The same for all stations of a system: a file of `[[route]]` with `to` and `station`
    #[arg(long, value_name = "FILE", requires_all = ["packages", "ip"])]
    pub package_routes: Option<PathBuf>,
    /// The system of this station and of all others of its LAN. Routes (--package-route) lead to mailboxes of this system only: packages for
    /// others go to the TCP router [default: 0]
    #[arg(long, value_name = "NUMBER", requires = "packages")]
    pub package_system: Option<u8>,
    /// How urgent whose packages are: a file with a `[class.NAME]` for each that is not as its class says
    #[arg(long, value_name = "FILE", requires = "packages")]
    pub package_priorities: Option<PathBuf>,
    /// Say in what goes to other stations when it was sent, and when it left: its receiver can ask how old a package is, and
    /// where the time went. A UDP option, which who does not know it trims; it never takes another frame. In labs it is on
    /// (`package_times`)
    #[arg(long, requires_all = ["packages", "ip"])]
    pub package_times: bool,
    /// TCP router that takes packages for mailboxes that are neither here nor at another station, and brings packages from there: HOST
    /// or HOST:PORT. It connects again by itself
    #[arg(long, value_name = "HOST:PORT", requires = "packages")]
    pub router: Option<Address>,
    /// The TCP router is reached by TLS: the keys of a client as `rtnet router keys` makes them
    #[arg(long, value_name = "DIRECTORY", requires = "router")]
    pub router_keys: Option<PathBuf>,
    /// Largest body that goes to the TCP router, up to 262128 bytes; memory for it is reserved [default: 4096]
    #[arg(long, value_name = "BYTES", requires = "router", value_parser = clap::value_parser!(u32).range(0..=LARGEST_BODY as i64))]
    pub router_body: Option<u32>,
}

/// Arguments of `mailbox`.
#[derive(Debug, Args)]
pub struct MailboxArgs {
    /// Which station.
    #[command(flatten)]
    pub which: WhichOf,
    /// What of it.
    #[command(subcommand)]
    pub verb: MailboxVerb,
}

/// What can be seen of mailboxes.
#[derive(Debug, Subcommand)]
pub enum MailboxVerb {
    /// Which there are, whose, and how many wait in each
    List,
    /// Everything that is counted of one, or of all: who sends to it, what was refused, how long packages took
    Stat {
        /// As 0.Pilot.0
        name: Option<MailboxName>,
    },
    /// What comes of one, or of all, again and again: in JSON a line with everything each time
    Watch {
        /// As 0.Pilot.0
        name: Option<MailboxName>,
        /// How often
        #[arg(short, long, default_value = "1s", value_parser = parse_positive_span)]
        every: Span,
        /// So many times; without, until it is ended
        #[arg(short, long)]
        count: Option<u64>,
    },
}

/// Arguments of `package`.
#[derive(Debug, Args)]
pub struct PackageVerbArgs {
    /// Which station.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do.
    #[command(subcommand)]
    pub verb: PackageVerb,
}

/// What can be done with packages.
#[derive(Debug, Subcommand)]
pub enum PackageVerb {
    /// Send a package
    Send {
        /// To which mailbox, as 0.Pilot.0
        to: MailboxName,
        /// Its body
        #[arg(default_value = "")]
        body: String,
        /// Its type: above 0 a command, else a reply or data
        #[arg(long = "type", default_value_t = 1, allow_negative_numbers = true)]
        kind: i8,
        /// How urgent it is: 255 first [default: as the class of who sends says]
        #[arg(long)]
        priority: Option<u8>,
        /// From a mailbox of this name, which is there that long
        #[arg(long, default_value = "0.0xff.0")]
        from: MailboxName,
    },
    /// Have a mailbox, and show what comes
    Receive {
        /// What it is called
        name: MailboxName,
        /// So many packages; without, until it is ended
        #[arg(short, long)]
        count: Option<u64>,
        /// How long to wait for the next [default: for ever]
        #[arg(short, long, value_parser = parse_positive_span)]
        timeout: Option<Span>,
        /// Answer commands with their body: for `rtnet package ping` and `rtnet package bench`
        #[arg(long)]
        echo: bool,
        /// Show none of them, but at the end how many came
        #[arg(short, long)]
        quiet: bool,
    },
    /// Ask who answers every command (`receive --echo`, or a module): how long that takes
    Ping {
        /// Which mailbox
        to: MailboxName,
        /// So many questions
        #[arg(short, long, default_value_t = 10)]
        count: u64,
        /// How long after the last one
        #[arg(short, long, default_value = "100ms", value_parser = parse_nonnegative_span)]
        interval: Span,
        /// Bytes of their bodies
        #[arg(short, long, default_value_t = 64)]
        size: usize,
        /// How long an answer is waited for
        #[arg(short = 'W', long, default_value = "1s", value_parser = parse_positive_span)]
        timeout: Span,
        /// From a mailbox of this name
        #[arg(long, default_value = "0.0xff.1")]
        from: MailboxName,
    },
    /// Measure the way to who answers every command: how long round trips take, one after the other, or how many packages it takes
    ///
    /// At the other end `rtnet package receive NAME --echo --quiet` answers, or a module; it has to have a way back, to the mailbox of
    /// --from. To another station what its slots and the other's say of it is shown, too: how long a frame waits for
    /// them at the worst, if they can be looked at, as in a lab. In which slot the answer leaves is known only where the other
    /// station has no slots but slot 0 and such that are joint with it: else that wait is not shown. The first question is not
    /// counted: who answers looks for the way back then.
    ///
    /// Exit status: 0; 1 nothing came, or it is not known what did, or a package could not be sent; 2 bad usage, or the station
    /// refuses.
    Bench(BenchArgs),
    /// Which mailboxes are at which other stations, and changes of it; or the way that packages for a mailbox go, and why
    ///
    /// Exit status: 0; 1 no way leads to that mailbox; 2 bad usage, or the station refuses.
    #[command(args_conflicts_with_subcommands = true)]
    Route {
        /// The way to this mailbox
        name: Option<MailboxName>,
        /// What to do [default: show them]
        #[command(subcommand)]
        verb: Option<PackageRouteVerb>,
    },
}

/// Arguments of `package bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Which mailbox
    pub to: MailboxName,
    /// How long
    #[arg(short, long, default_value = "5s", value_parser = parse_positive_span)]
    pub time: Span,
    /// Bytes of their bodies
    #[arg(short, long, default_value_t = 64)]
    pub size: usize,
    /// Send as many packages as the way takes, wait for no answer, and ask at the end how many came: `receive --echo` knows
    #[arg(long)]
    pub stream: bool,
    /// Between an answer and the next question, times spread evenly up to this: with a cycle, questions come at all its moments
    #[arg(short, long, default_value = "0ms", value_parser = parse_nonnegative_span, conflicts_with = "stream")]
    pub pause: Span,
    /// How long an answer is waited for
    #[arg(short = 'W', long, default_value = "1s", value_parser = parse_positive_span)]
    pub timeout: Span,
    /// From a mailbox of this name
    #[arg(long, default_value = "0.0xff.2")]
    pub from: MailboxName,
}

/// What can be done with routes of packages.
#[derive(Debug, Subcommand)]
pub enum PackageRouteVerb {
    /// From now on these mailboxes are there
    Add {
        /// As 0.Pilot.*=10.0.0.3
        #[arg(value_parser = crate::cmd::package::parse_route)]
        route: (Pattern, std::net::Ipv4Addr),
    },
    /// They are not any more
    Delete {
        /// As it is shown
        to: Pattern,
    },
}

/// As the standard library has it.
pub fn duration(span: Span) -> Duration {
    Duration::from_nanos(span.nanos().max(0).unsigned_abs())
}
