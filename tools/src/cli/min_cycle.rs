//! The command line of `rtnet find-min-cycle`.

use std::path::PathBuf;

use clap::Args;
use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;

use crate::units::{parse_nonnegative_span, parse_positive_span, parse_rate, parse_share};

/// Arguments of `find-min-cycle`. What a kept answer was asked, too, is none if it was not said.
#[derive(Debug, Args)]
pub struct MinCycleArgs {
    /// How many stations, the master included [default: 8, or as in --compare's file, and so are the others]
    #[arg(long, value_name = "N")]
    pub stations: Option<usize>,
    /// How many of the slots may be missed, or their frames be outside them [default: 0.1%]
    #[arg(long, value_name = "SHARE", value_parser = parse_share)]
    pub miss: Option<u32>,
    /// Bytes of each frame behind its Ethernet header [default: 64]
    #[arg(long, value_name = "BYTES")]
    pub payload: Option<usize>,
    /// Line rate at which slots are computed [default: 1G]
    #[arg(long, value_parser = parse_rate)]
    pub rate: Option<Rate>,
    /// Guard band behind each frame [default: the rest of the slot]
    #[arg(long, value_parser = parse_nonnegative_span)]
    pub guard: Option<Span>,
    /// Keep the real-time core from idling: steadier, at the price of its power
    #[arg(long)]
    pub warm_core: bool,
    /// The core of all real-time threads [default: the last]
    #[arg(long, value_name = "N")]
    pub cpu: Option<usize>,
    /// The longest cycle to try
    #[arg(long, default_value = "10ms", value_parser = parse_positive_span)]
    pub longest: Span,
    /// How long each trial measures [default: 5s]
    #[arg(long, value_parser = parse_positive_span)]
    pub trial: Option<Span>,
    /// How long the proof measures [default: 30s]
    #[arg(long, value_parser = parse_positive_span)]
    pub proof: Option<Span>,
    /// Keep the answer in this file, for a later --compare
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Search for what this file was the answer to, and compare: an answer that is longer by more than 25 % is a regression
    #[arg(long, value_name = "FILE")]
    pub compare: Option<PathBuf>,
}
