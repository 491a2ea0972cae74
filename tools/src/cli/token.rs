//! The command line of rings: `rtnet token`, and what a station of one is started with.

use clap::{Args, Subcommand};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::WhichOf;
use crate::units::{parse_nonnegative_span, parse_positive_span};

/// Arguments of `token`.
#[derive(Debug, Args)]
pub struct TokenArgs {
    /// Which.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do with it.
    #[command(subcommand)]
    pub verb: TokenVerb,
}

/// What can be done with a station's part in a ring.
#[derive(Debug, Subcommand)]
pub enum TokenVerb {
    /// Where the token is, who takes part, how long a round takes and how long it may, and counters
    Status,
}

/// What a station of a ring is started with, the same at all of them.
#[derive(Clone, Debug, Default, Args)]
#[command(next_help_heading = "Token (--discipline token): the same at all stations of the ring")]
pub struct RingArgs {
    /// The Ethernet addresses of all stations, in the order in which the token goes round, this one's among them
    #[arg(long, value_name = "ADDRESS,ADDRESS,...", value_delimiter = ',')]
    pub ring: Vec<Address>,
    /// How long a station may send each time that the token comes by, counted in time on the air at --rate [default: four of
    /// the longest frames, at least 500us]
    #[arg(long, value_parser = parse_positive_span)]
    pub token_hold: Option<Span>,
    /// How long each keeps the token at the least, so that an idle ring leaves the hosts alone [default: 250us]
    #[arg(long, value_parser = parse_nonnegative_span)]
    pub token_rest: Option<Span>,
    /// How late a host may be each time that it is to do something; one that is later loses its turn [default: 500us]
    #[arg(long, value_parser = parse_nonnegative_span)]
    pub token_late: Option<Span>,
    /// How long a token takes from one station to another at the most [default: 100us]
    #[arg(long, value_parser = parse_nonnegative_span)]
    pub token_delay: Option<Span>,
    /// Invite a station that is absent, one each so many rounds [default: 16]
    #[arg(long, value_name = "ROUNDS")]
    pub token_invite: Option<u16>,
}

impl RingArgs {
    /// The first that was said, by its name.
    pub fn said(&self) -> Option<&'static str> {
        [
            ("--ring", !self.ring.is_empty()),
            ("--token-hold", self.token_hold.is_some()),
            ("--token-rest", self.token_rest.is_some()),
            ("--token-late", self.token_late.is_some()),
            ("--token-delay", self.token_delay.is_some()),
            ("--token-invite", self.token_invite.is_some()),
        ]
        .into_iter()
        .find_map(|(name, is_said)| is_said.then_some(name))
    }
}
