//! What is asked and answered of a station's sockets, addresses and routes.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;

use rtnet::buf::PoolStatistics;
use serde::{Deserialize, Serialize};

use super::{TcpShown, VnicCounted};
use crate::report::document::document;

/// What a station with sockets may be asked.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum StackRequest {
    /// Its place in the Internet Protocol.
    Interface,
    /// Its tables.
    Routes,
    /// Add these routes, or change those that are there: in this order, up to the first that cannot be.
    AddRoutes(Vec<RouteSaid>),
    /// Delete the route to a host or a network.
    DeleteRoute(String),
    /// Ask the medium who has an address.
    Solicit(Ipv4Addr),
    /// Where a packet would go, and whether an answer is still waited for.
    Lookup(Ipv4Addr),
    /// Ask for an echo.
    Echo(EchoRequest),
    /// What has come of a round of questions, by its identifier, since this was last asked.
    Echoes(u16),
    /// How many questions of a round have left.
    EchoesLeft(u16),
    /// Its pools.
    Pools,
    /// Everything that it counts.
    Counters,
}

/// What it answers.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StackReply {
    /// As it was asked for.
    Done,
    /// Its place in the Internet Protocol.
    Interface(Box<InterfaceShown>),
    /// Its tables.
    Routes(RoutesShown),
    /// Where a packet would go.
    Way(Way),
    /// The question was handed to the station's thread, at this time of the station's clock, nanoseconds.
    Asked(u64),
    /// What has come of a round of questions.
    Echoes(EchoesShown),
    /// So many questions of a round were chosen for a slot.
    EchoesLeft(u64),
    /// Its pools.
    Pools(Vec<PoolShown>),
    /// Everything that it counts.
    Counters(Box<CountersShown>),
}

/// A route as it is said by hand.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RouteSaid {
    /// To a station on the medium.
    Host {
        /// Its IP address.
        ip: Ipv4Addr,
        /// Its address on the medium.
        address: String,
    },
    /// To a network behind one.
    Network {
        /// As 10.1.0.0/16.
        network: String,
        /// The station's IP address.
        via: Ipv4Addr,
    },
}

/// A station's place in the Internet Protocol.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct InterfaceShown {
    /// The station's name.
    pub name: String,
    /// The interface it runs on.
    pub interface: String,
    /// That interface's address.
    pub address: String,
    /// Its IP address.
    pub ip: Ipv4Addr,
    /// Leading bits that all stations of its network share.
    pub prefix: u8,
    /// The address of all of them.
    pub broadcast: Option<Ipv4Addr>,
    /// `up`, `no carrier`, `down`, `bridge port` or `other address`.
    pub link: String,
    /// Largest payload of a frame.
    pub mtu: usize,
    /// What each of its slots takes, by channel. Where there are no slots all channels are as 0.
    pub channels: BTreeMap<u8, ChannelShown>,
    /// `tdma`, `nomac`, `direct` or `token`.
    #[serde(default)]
    pub discipline: String,
    /// Why nothing leaves at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub silent: Option<String>,
    /// What the interface has counted.
    pub counters: BTreeMap<String, u64>,
}

document!(InterfaceShown, "interface", interface_has_its_schema);

/// What a channel takes.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ChannelShown {
    /// Largest payload behind the Ethernet header.
    pub payload: usize,
}

/// A station's tables.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RoutesShown {
    /// Its own address.
    pub ip: Ipv4Addr,
    /// Leading bits of its network.
    pub prefix: u8,
    /// Stations on the medium.
    pub hosts: Vec<HostShown>,
    /// Host routes at the most.
    pub hosts_at_most: usize,
    /// Networks behind them.
    pub networks: Vec<NetworkShown>,
    /// Network routes at the most.
    pub networks_at_most: usize,
}

document!(RoutesShown, "routes", routes_has_its_schema);

/// A station on the medium.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct HostShown {
    /// Its IP address.
    pub ip: Ipv4Addr,
    /// Its address on the medium.
    pub address: String,
    /// `static`, `solicited` or `learned`.
    pub origin: String,
}

/// A network behind a station.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct NetworkShown {
    /// As 10.1.0.0/16.
    pub network: String,
    /// The station's IP address.
    pub via: Ipv4Addr,
}

/// Where a packet would go.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Way {
    /// Where to.
    pub ip: Ipv4Addr,
    /// Of the next station on the medium; `loopback`: this one itself; none: there is no route.
    pub address: Option<String>,
    /// The gateway, if it is not on the medium itself.
    pub via: Option<Ipv4Addr>,
    /// Whether it was asked for, and no answer has come.
    pub is_awaited: bool,
}

document!(Way, "way", way_has_its_schema);

/// An echo as it is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct EchoRequest {
    /// Whom.
    pub to: Ipv4Addr,
    /// Which round of questions.
    pub identifier: u16,
    /// Which question.
    pub sequence: u16,
    /// Bytes behind the header of the echo.
    pub size: usize,
    /// How urgent its frame is.
    pub priority: u8,
    /// The slot that it leaves in.
    pub channel: u8,
}

/// What has come of a round of questions.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
pub struct EchoesShown {
    /// Echoes.
    pub came: Vec<EchoShown>,
    /// Questions that could not leave.
    pub failed: Vec<EchoFailed>,
    /// Why nothing leaves now, be it for a moment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub silent: Option<String>,
}

/// A question that could not leave.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct EchoFailed {
    /// Which.
    pub sequence: u16,
    /// Why.
    pub why: String,
    /// Whether it is for those before it, which have not left and keep all the buffers.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_behind: bool,
}

/// An echo that has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct EchoShown {
    /// From whom.
    pub from: Ipv4Addr,
    /// See [`EchoRequest`].
    pub sequence: u16,
    /// See [`EchoRequest`].
    pub size: usize,
    /// When it came, nanoseconds of the station's clock, unless its stamp could not be trusted.
    pub came: Option<u64>,
    /// When its question left.
    pub left: Option<u64>,
}

/// A pool.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PoolShown {
    /// Whose.
    pub pool: String,
    /// Buffers that it owns.
    pub capacity: usize,
    /// Those that are there now.
    pub free: usize,
    /// The fewest that ever were.
    pub least: usize,
    /// How often none was there.
    pub exhausted: u64,
    /// What was lost for that; of the `receive` pool's, for which frames wait in the kernel, what found no room there.
    pub dropped: u64,
}

document!(PoolShown, "pool", pool_has_its_schema);

impl PoolShown {
    /// A pool of this name, with what was lost for want of its buffers.
    pub fn new(pool: String, statistics: PoolStatistics, dropped: u64) -> Self {
        let PoolStatistics { capacity, free, least, exhausted } = statistics;
        Self { pool, capacity, free, least, exhausted, dropped }
    }
}

/// Everything that a station counts, by where and by name.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct CountersShown {
    /// The station's name.
    pub name: String,
    /// Of its discipline, of what that gave back to whoever had made it, and of its interface.
    pub station: BTreeMap<String, u64>,
    /// Of its port.
    pub port: BTreeMap<String, u64>,
    /// Frames refused, by reason.
    pub refused: BTreeMap<String, u64>,
    /// Of the sockets that programs of other processes have.
    #[serde(default)]
    pub programs: BTreeMap<String, u64>,
    /// Of its stack.
    pub stack: BTreeMap<String, u64>,
    /// What it sent to itself and did not take, by reason.
    pub loopback: BTreeMap<String, u64>,
    /// Of its sockets.
    pub sockets: BTreeMap<String, BTreeMap<String, u64>>,
    /// The connection of its packages to a TCP router, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tcp: Option<TcpShown>,
    /// Of packages that came by the LAN, if they may.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub packages: Option<BTreeMap<String, u64>>,
    /// Of its VNIC, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vnic: Option<VnicCounted>,
}

document!(CountersShown, "counters", counters_has_its_schema);
