//! The command line of what is about sockets, addresses and routes.

use std::net::Ipv4Addr;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use rtnet::ip::route::Network;
use rtnet::time::Span;
use rtnet::wire::ethernet::MTU;

use super::{Which, WhichOf};
use crate::station::echoes::{ECHO_AT_MOST, ECHO_HEADERS};
use crate::station::stack::{OwnIp, parse_ports};
use crate::units::parse_positive_span;

/// What `station` is told of its stack.
#[derive(Debug, Args)]
#[command(next_help_heading = "Address and sockets")]
pub struct StackArgs {
    /// Its IP address: with one it has sockets, answers echoes, and can be asked for routes. Without a prefix that of the
    /// address's class, as with RTnet: 10.0.0.1 is 10.0.0.1/8
    #[arg(long, value_name = "IP[/PREFIX]")]
    pub ip: Option<OwnIp>,
    /// Where another station is. Can be given several times
    #[arg(long = "route", value_name = "IP=MAC", requires = "ip", value_parser = crate::cmd::route::parse_route)]
    pub route: Vec<crate::control::RouteSaid>,
    /// Where others are: a file with a line for each, `IP MAC` or `NET/PREFIX via IP`, and # before comments
    #[arg(long, value_name = "FILE", requires = "ip")]
    pub routes: Option<PathBuf>,
    /// Sockets at the most [default: 64]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=512))]
    pub sockets: Option<u16>,
    /// Ports that are given to sockets which do not ask for one [default: 1024-1087]
    #[arg(long, value_name = "A-B", requires = "ip", value_parser = parse_ports)]
    pub ports: Option<RangeInclusive<u16>>,
    /// Refuse a datagram in fragments with a wrong checksum, too: RTnet of 2019 and later sends such
    #[arg(long, requires = "ip")]
    pub strict_checksums: bool,
    /// How long the next fragment of a datagram is waited for [default: 1s]
    #[arg(long, value_name = "TIME", requires = "ip", value_parser = parse_positive_span)]
    pub fragment_timeout: Option<Span>,
    /// Host routes at the most [default: 256]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub hosts: Option<u16>,
    /// Network routes at the most [default: 64]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=512))]
    pub networks: Option<u16>,
    /// Buffers of a socket whose program does not say how many [default: 16]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub socket_buffers: Option<u16>,
    /// Buffers for frames that have just come [default: 32]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub receive_buffers: Option<u16>,
    /// Buffers for echoes [default: 8]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub icmp_buffers: Option<u16>,
    /// Buffers for questions of who has which address, and answers [default: 16]
    #[arg(long, value_name = "N", requires = "ip", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub arp_buffers: Option<u16>,
}

/// Arguments of what only shows.
#[derive(Debug, Args)]
pub struct ShowArgs {
    /// Which.
    #[command(flatten)]
    pub which: Which,
}

/// Arguments of `route`.
#[derive(Debug, Args)]
pub struct RouteArgs {
    /// Which.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do with them.
    #[command(subcommand)]
    pub verb: RouteVerb,
}

/// What can be done with a station's routes.
#[derive(Debug, Subcommand)]
pub enum RouteVerb {
    /// Every route, and how it came to be known
    List,
    /// Say where a station is (`IP MAC`), or behind which one a network (`NET/PREFIX via IP`)
    Add {
        /// `10.0.0.7 02:00:00:00:00:07`, or `10.1.0.0/16 via 10.0.0.7`
        #[arg(value_name = "ROUTE", num_args = 2..=3, required = true)]
        route: Vec<String>,
    },
    /// Delete the route to a station or a network
    Del {
        /// Its address, or the network
        #[arg(value_name = "IP|NET/PREFIX")]
        network: Network,
    },
    /// Ask the network who has an address, and wait up to a second for the answer, which becomes a route
    Solicit {
        /// The address
        ip: Ipv4Addr,
    },
    /// Where a packet would go
    Get {
        /// Whom it is for
        ip: Ipv4Addr,
    },
    /// Add all routes of a file, or, if one of them cannot be, none
    Load {
        /// With lines `IP MAC` and `NET/PREFIX via IP`, and # before comments
        file: PathBuf,
    },
}

/// Arguments of `ping`.
#[derive(Debug, Args)]
pub struct PingArgs {
    /// Which.
    #[command(flatten)]
    pub which: Which,
    /// Whom to ask
    pub ip: Ipv4Addr,
    /// How often [default: until Ctrl-C]
    #[arg(short, long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// From one question to the next, but for the cycle that they are spread over
    #[arg(short, long, default_value = "1s", value_parser = parse_positive_span)]
    pub interval: Span,
    /// Bytes behind the header of the echo
    #[arg(short, long, default_value_t = 56, value_name = "B", value_parser = parse_echo)]
    pub size: u16,
    /// How urgent the questions are: 0 first, 30 last
    #[arg(long, default_value_t = 30, value_name = "P", value_parser = clap::value_parser!(u8).range(0..=30))]
    pub priority: u8,
    /// The slot that they leave in
    #[arg(long, default_value_t = 1, value_name = "C")]
    pub channel: u8,
}

/// How much an echo takes along.
fn parse_echo(text: &str) -> Result<u16, String> {
    let size = text.parse().ok().filter(|&size: &u16| usize::from(size) <= ECHO_AT_MOST);
    size.ok_or_else(|| {
        format!(
            "'{text}' is no number from 0 to {ECHO_AT_MOST}: an echo is answered in one frame only, whose {MTU} bytes have \
             {ECHO_HEADERS} of headers"
        )
    })
}
