//! The command line of `rtnet router`.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Subcommand};

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

/// Options of a router.
#[derive(Debug, Args)]
pub struct RouterRunArgs {
    /// Its file; options on this line count before what it says
    pub file: Option<PathBuf>,
    /// Where to listen; can be given several times [default: 127.0.0.1:2000]
    #[arg(long, value_name = "ADDRESS:PORT")]
    pub listen: Vec<SocketAddr>,
    /// Listen on addresses that other hosts reach, too: whoever reaches them can register names, and send to all
    #[arg(long)]
    pub insecure: bool,
    /// Serve its figures for Prometheus by HTTP, at /metrics
    #[arg(long, value_name = "ADDRESS:PORT")]
    pub metrics: Option<SocketAddr>,
    /// Its name, for `rtnet router status` [default: router]
    #[arg(long, value_parser = parse_name)]
    pub name: Option<String>,
}

/// Verbs for a router that runs.
#[derive(Debug, Subcommand)]
pub enum RouterVerb {
    /// Its connections, their mailboxes, what waits for each, what was dropped and why, and the last 64 that were closed
    Status {
        /// Which router
        #[arg(default_value = "router", value_parser = parse_name)]
        name: String,
        /// As JSON
        #[arg(long)]
        json: bool,
    },
}
