//! The command line of `rtnet schedule`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::WhichOf;
use crate::control::ActivationSaid;
use crate::units::parse_positive_span;

/// Arguments of `schedule`.
#[derive(Debug, Args)]
pub struct ScheduleArgs {
    /// Which.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do with it.
    #[command(subcommand)]
    pub verb: ScheduleVerb,
}

/// What can be done with the schedule of a running network.
#[derive(Debug, Subcommand)]
pub enum ScheduleVerb {
    /// Which schedule is in use, and how far a change of it is
    Show,
    /// Propose the slots and the cycle of a file to all stations, and wait until all have acknowledged; with --now, --at-cycle or
    /// --in, until it is in use
    ///
    /// The file is a lab's; its stations are the lab's by name. Of stations that were started one by one, --address says which is
    /// which. A station that cannot take its slots, or does not answer, stops the change: all go on as before, and the line says
    /// which and why.
    Propose {
        /// A lab's file, of which slots and cycle are taken
        file: PathBuf,
        /// The Ethernet address of a station of the file; outside of labs, of each that has slots
        #[arg(long = "address", value_name = "NAME=ADDRESS", value_parser = parse_named)]
        addresses: Vec<(String, Address)>,
        /// When to use it.
        #[command(flatten)]
        when: WhenArgs,
    },
    /// Use what is proposed, as soon as can be or when it is said, and wait until it is in use
    Activate {
        /// When.
        #[command(flatten)]
        when: WhenArgs,
    },
    /// Withdraw what is proposed: as long as not all who may give the time have confirmed it
    Cancel,
}

/// When a schedule is to be used.
#[derive(Clone, Copy, Debug, Args)]
#[group(multiple = false)]
pub struct WhenArgs {
    /// As soon as all know of it
    #[arg(long)]
    pub now: bool,
    /// From this cycle on
    #[arg(long, value_name = "N")]
    pub at_cycle: Option<u32>,
    /// So much later than now
    #[arg(long = "in", value_name = "TIME", value_parser = parse_positive_span)]
    pub within: Option<Span>,
}

/// Reads `NAME=ADDRESS`.
fn parse_named(text: &str) -> Result<(String, Address), String> {
    let (name, address) = text.split_once('=').ok_or("write NAME=ADDRESS, as slave1=02:00:00:00:00:0b")?;
    Ok((name.to_owned(), address.parse().map_err(|why| format!("{why}"))?))
}

impl WhenArgs {
    /// What was said, if anything.
    pub fn said(&self) -> Option<ActivationSaid> {
        let at = self.at_cycle.map(ActivationSaid::AtCycle);
        let within = self.within.map(|span| ActivationSaid::In(span.nanos()));
        at.or(within).or(self.now.then_some(ActivationSaid::Soon))
    }
}
