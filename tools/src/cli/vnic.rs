//! The command line of what is about the tunnel and its device.

use clap::{Args, Subcommand, ValueEnum};
use serde::Deserialize;
use vnic::peers::{NotAPrefix, Peer, Prefix};
use vnic::proxy;
use vnic::tun::Mode;
use vnic::tunnel::LEAST_MTU;

use super::WhichOf;

/// What `station` is told of its VNIC.
#[derive(Debug, Args)]
#[command(next_help_heading = "Everything else, through the tunnel")]
pub struct VnicArgs {
    /// Give it a VNIC: a network device of Linux, whose frames leave in slot 1, after everything that is real-time. With
    /// addresses or without
    #[arg(long, value_name = "IP/PREFIX", num_args = 0.., value_parser = of_a_device)]
    pub vnic: Option<Vec<Prefix>>,
    /// What goes through it: tap, Ethernet frames of any type, as with RTnet; tun, packets of IP only [default: tap]
    #[arg(long, value_name = "MODE", requires = "vnic")]
    pub vnic_mode: Option<VnicMode>,
    /// Its device's name [default: vnic with the first number that is free]
    #[arg(long, value_name = "NAME", requires = "vnic")]
    pub vnic_name: Option<String>,
    /// Share the station's own address (--ip) with Linux, as RTnet's proxy does: what real-time sockets do not take, as TCP, goes
    /// through it, plainly and by the station's routes, instead of other addresses in a tunnel. With --vnic-mode tun
    #[arg(long, requires = "vnic", conflicts_with_all = ["vnic_peer", "vnic_forward"])]
    pub vnic_proxy: bool,
    /// Its MTU, where slots take more; it follows them. A tunnel's is at most 1496 [default: 1496, a proxy's 1500]
    #[arg(long, value_name = "BYTES", requires = "vnic", value_parser = clap::value_parser!(u16).range(LEAST_MTU as i64..=proxy::MTU as i64))]
    pub vnic_mtu: Option<u16>,
    /// Its buffers, for both directions [default: 32]
    #[arg(long, value_name = "N", requires = "vnic", value_parser = clap::value_parser!(u16).range(1..=4096))]
    pub vnic_buffers: Option<u16>,
    /// Which station has an address, where nobody tells by ARP (IPv6, networks behind a station): 10.2.0.0/24=02:00:00:00:00:03. Can
    /// be given several times. With --vnic-mode tun
    #[arg(long, value_name = "IP[/PREFIX]=MAC", requires = "vnic")]
    pub vnic_peer: Vec<Peer>,
    /// Hosts are behind the device (a bridge): frames keep their source, which RTnet's lose, and those for such hosts are heard.
    /// With --vnic-mode tap
    #[arg(long, requires = "vnic")]
    pub vnic_forward: bool,
}

/// What goes through a VNIC.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VnicMode {
    /// Ethernet frames of any type
    #[default]
    Tap,
    /// Packets of IP
    Tun,
}

impl VnicMode {
    /// As it is written.
    pub fn name(self) -> &'static str {
        match self {
            VnicMode::Tap => "tap",
            VnicMode::Tun => "tun",
        }
    }
}

impl From<VnicMode> for Mode {
    fn from(mode: VnicMode) -> Mode {
        match mode {
            VnicMode::Tap => Mode::Tap,
            VnicMode::Tun => Mode::Tun,
        }
    }
}

/// Arguments of `vnic`.
#[derive(Debug, Args)]
pub struct VnicVerbArgs {
    /// Which.
    #[command(flatten)]
    pub which: WhichOf,
    /// What to do with it.
    #[command(subcommand)]
    pub verb: VnicVerb,
}

/// What can be done with a station's VNIC.
#[derive(Debug, Subcommand)]
pub enum VnicVerb {
    /// Its device, what went through, what was lost, and why
    Status,
    /// Set its device up, or make it anew if somebody has deleted it
    Up,
    /// Set its device down
    Down,
    /// Change it: all that is said, or nothing
    Set {
        /// The MTU, where slots take more: at most 1496, a proxy's 1500
        #[arg(long, value_name = "BYTES", value_parser = clap::value_parser!(u16).range(LEAST_MTU as i64..=proxy::MTU as i64))]
        mtu: Option<u16>,
        /// An address that it is to have. Can be given several times
        #[arg(long, value_name = "IP/PREFIX", value_parser = of_a_device)]
        address: Vec<Prefix>,
        /// An address that it is to have no more. Can be given several times
        #[arg(long, value_name = "IP/PREFIX")]
        no_address: Vec<Prefix>,
        /// Which station has an address (tun). Can be given several times
        #[arg(long, value_name = "IP[/PREFIX]=MAC")]
        peer: Vec<Peer>,
    },
}

/// An address that a device may have, with the length of its network's prefix.
pub fn of_a_device(text: &str) -> Result<Prefix, String> {
    let address: Prefix = text.parse().map_err(|error: NotAPrefix| error.to_string())?;
    if !text.contains('/') {
        let usual = if address.ip.is_ipv4() { 24 } else { 64 };
        return Err(format!("'{text}' reaches no other station: say of which network, as in {text}/{usual}"));
    }
    address.of_a_host().map_err(|error| error.to_string())
}
