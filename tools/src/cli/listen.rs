//! The command line of what only listens.

use std::path::PathBuf;

use clap::Args;
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;

use super::DEFAULT_LAB;
use crate::control::parse_name;
use crate::observe::ear::Spot;
use crate::units::{parse_positive_span, parse_rate};

/// Where to listen.
#[derive(Debug, Args)]
pub struct ListenArgs {
    /// On this interface of this network namespace
    #[arg(long, value_name = "IF", conflicts_with = "lab")]
    pub interface: Option<String>,
    /// On the bridge of this lab [default: the lab named 'lab']
    #[arg(long, value_name = "NAME", value_parser = parse_name)]
    pub lab: Option<String>,
}

impl ListenArgs {
    /// The one place that is meant.
    pub fn spot(&self) -> Spot {
        match &self.interface {
            Some(interface) => Spot::Interface(interface.clone()),
            None => Spot::Lab(self.lab.clone().unwrap_or_else(|| DEFAULT_LAB.into())),
        }
    }
}

/// Arguments of `jitter`.
#[derive(Debug, Args)]
pub struct JitterArgs {
    /// Where.
    #[command(flatten)]
    pub at: ListenArgs,
    /// How long
    #[arg(long, default_value = "10s", value_parser = parse_positive_span)]
    pub duration: Span,
    /// Line rate at which overlaps are computed
    #[arg(long, default_value = "1G", value_parser = parse_rate)]
    pub rate: Rate,
    /// Write the figures as JSON, too; - is standard output, and what is for the screen goes to standard error then
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Arguments of `dump`.
#[derive(Debug, Args)]
pub struct DumpArgs {
    /// Where.
    #[command(flatten)]
    pub at: ListenArgs,
    /// Write the frames into this file, as pcapng, instead of showing them; - is standard output
    #[arg(short, long, value_name = "FILE.pcapng")]
    pub write: Option<PathBuf>,
    /// End after so many frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// End after so long [default: go on until Ctrl-C]
    #[arg(long, value_parser = parse_positive_span)]
    pub duration: Option<Span>,
}
