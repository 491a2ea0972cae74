//! The command line of `rtnet router`.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

use clap::{Args, Subcommand};
use package_router::name::Pattern;
use package_router::tcp::address::is_host_name;

use crate::control::parse_name;

/// Arguments of `router`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct RouterArgs {
    /// A verb for a router that runs.
    #[command(subcommand)]
    pub verb: Option<RouterVerb>,
    /// Options to start one with.
    #[command(flatten)]
    pub run: RouterRunArgs,
}

/// A host, of which a certificate has the name or the address.
fn parse_host(text: &str) -> Result<String, String> {
    match is_host_name(text) || text.parse::<IpAddr>().is_ok() {
        true => Ok(text.to_owned()),
        false => Err(format!("'{text}' is no host: write its name or its address, without a port")),
    }
}

/// An address to listen at.
fn parse_address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        format!("'{text}' is no IP address with a port: write one, as 127.0.0.1:2000 or [::1]:2000")
    })
}

/// Options of a router.
#[derive(Debug, Args)]
pub struct RouterRunArgs {
    /// Its file; options on this line count before what it says
    pub file: Option<PathBuf>,
    /// Where to listen; can be given several times [default: 127.0.0.1:2000]
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_address)]
    pub listen: Vec<SocketAddr>,
    /// Clients come by TLS, with a certificate or a secret: the keys of a router as `rtnet router keys` makes them. For --listen
    #[arg(long, value_name = "DIRECTORY", requires = "listen")]
    pub keys: Option<PathBuf>,
    /// Listen without TLS on addresses that other hosts reach: whoever reaches them can register names, and send to all. --metrics may
    /// be such an address, too
    #[arg(long)]
    pub insecure: bool,
    /// Serve its figures for Prometheus by HTTP, at /metrics
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_address)]
    pub metrics: Option<SocketAddr>,
    /// Its name, for `rtnet router status` [default: router]
    #[arg(long, value_parser = parse_name)]
    pub name: Option<String>,
}

/// Verbs for a router that runs.
#[derive(Debug, Subcommand)]
pub enum RouterVerb {
    /// Connections and their mailboxes, what was dropped and why, and the last 64 connections that were closed
    Status {
        /// Which router
        #[arg(default_value = "router", value_parser = parse_name)]
        name: String,
        /// Show only connections with a mailbox of this pattern, as 0.Camera.*, and only such mailboxes
        #[arg(long, value_name = "PATTERN")]
        mailbox: Option<Pattern>,
        /// Show all: without, the 100 connections for which the most bytes wait, and 16 mailboxes of each
        #[arg(long)]
        all: bool,
        /// As JSON, with all connections and mailboxes
        #[arg(long)]
        json: bool,
    },
    /// Make keys for a router and its clients, in a new directory: an authority, a certificate for each side, and a secret
    ///
    /// DIRECTORY/router is for the router (--keys), DIRECTORY/client for the hosts of clients (`rtnet station --router-keys`). A client
    /// with a certificate needs no secret, and one that knows the secret needs no certificate: leave out what a host is not to
    /// have. Without DIRECTORY/ca.key no more certificates can be made. Certificates are valid until 4096.
    Keys {
        /// The directory, which must not exist
        directory: PathBuf,
        /// A name or address by which clients reach the router; can be given several times [default: localhost, 127.0.0.1, ::1]
        #[arg(long, value_name = "NAME", value_parser = parse_host)]
        host: Vec<String>,
    },
}
