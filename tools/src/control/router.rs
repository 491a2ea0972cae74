//! Requests to a TCP router, and its replies.

use std::collections::BTreeMap;

use package_router::name::{MailboxName, Pattern};
use package_router::tcp::router::{ClientStatus, Closed, Counters, LinkStatus, Rates, Status};
use serde::{Deserialize, Serialize};

use crate::report::document::document;

/// Nanoseconds of a millisecond, in which the router counts.
const MS: u64 = 1_000_000;

/// A request to a router.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RouterRequest {
    /// How it is.
    Status,
    /// The same, with the connections only that have a mailbox of this pattern.
    StatusOf(String),
}

/// Its reply.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RouterReply {
    /// How it is.
    Status(Box<RouterShown>),
    /// Not done, and why.
    Refused(String),
}

/// A router as people see it.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RouterShown {
    /// Its name.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// Where it listens.
    pub listen: Vec<String>,
    /// Nanoseconds since its start.
    pub up_ns: u64,
    /// Open connections.
    pub connections: usize,
    /// Mailboxes of all of them.
    pub names: usize,
    /// Packages that wait for all of them.
    pub waiting: usize,
    /// Counters since its start, by name.
    pub counters: BTreeMap<String, u64>,
    /// Connections that were closed since its start, by reason.
    #[serde(default)]
    pub endings: BTreeMap<String, u64>,
    /// The error of its file, if that was read again and has one: the rules before are in force.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rules_error: Option<String>,
    /// Rates of all connections; none before the first are measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rates: Option<RatesShown>,
    /// Its links to routers of other systems.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub links: Vec<LinkShown>,
    /// The open connections, or those that were asked for; those with the most bytes waiting first.
    pub clients: Vec<ClientShown>,
    /// The last 64 connections that were closed, the newest first.
    pub closed: Vec<ClosedShown>,
}

document!(RouterShown, "router-status", 2, router_status_schema_is_kept);

/// Packages and bytes a second, rounded up: the mean of the router's last round of 5 s.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RatesShown {
    /// Packages that came and were passed on.
    pub packages_in_per_s: u64,
    /// Their bytes.
    pub bytes_in_per_s: u64,
    /// Packages that were queued for their receivers.
    pub packages_out_per_s: u64,
    /// Their bytes.
    pub bytes_out_per_s: u64,
}

/// A link to the router of another system.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct LinkShown {
    /// That router.
    pub router: String,
    /// The systems that are reached by it; none: all that no other link names.
    pub systems: Vec<u8>,
    /// Whether it is open.
    pub open: bool,
    /// The failure of the last attempt to open it, or its end; while it is open, what keeps packages from it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_error: Option<String>,
}

/// An open connection.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ClientShown {
    /// Where it comes from.
    pub peer: String,
    /// Nanoseconds since it was opened, to the millisecond.
    pub open_ns: u64,
    /// How many mailboxes it has.
    pub names: usize,
    /// Their names, or the names that were asked for.
    pub mailboxes: Vec<String>,
    /// Its part: `client`, `router of system N`, or `link`.
    pub role: String,
    /// Whether it is asked for signs of life.
    pub watchdog: bool,
    /// Packages that wait for it.
    pub waiting: usize,
    /// Their bytes.
    pub waiting_bytes: usize,
    /// Nanoseconds that the oldest of them has waited, to the millisecond.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oldest_ns: Option<u64>,
    /// Its counters that are not 0.
    pub counters: BTreeMap<String, u64>,
    /// Its rates; none before the first are measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rates: Option<RatesShown>,
}

/// A connection that was closed.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ClosedShown {
    /// Where it came from.
    pub peer: String,
    /// Why it was closed.
    pub why: String,
    /// Nanoseconds ago, to the millisecond.
    pub ago_ns: u64,
    /// For how many nanoseconds it was open, to the millisecond.
    pub open_ns: u64,
    /// How many mailboxes it had.
    pub names: usize,
    /// Their names.
    pub mailboxes: Vec<String>,
    /// Its counters that are not 0.
    pub counters: BTreeMap<String, u64>,
}

impl RouterShown {
    /// A router's status as people see it, `up_ms` milliseconds after its start, with the connections that have such a mailbox.
    pub fn of(name: &str, listen: &[String], up_ms: u64, status: &Status, mailbox: Option<&Pattern>) -> Self {
        let is_wanted = |name: &MailboxName| mailbox.is_none_or(|pattern| pattern.matches(*name));
        let has_one = |client: &&ClientStatus| mailbox.is_none() || client.names.iter().any(is_wanted);
        let mut clients: Vec<&ClientStatus> = status.clients.iter().filter(has_one).collect();
        clients.sort_by_key(|client| std::cmp::Reverse(client.waiting_bytes));
        Self {
            name: name.into(),
            pid: std::process::id(),
            listen: listen.to_vec(),
            up_ns: up_ms * MS,
            connections: status.clients.len(),
            names: status.clients.iter().map(|client| client.names.len()).sum(),
            waiting: status.clients.iter().map(|client| client.waiting).sum(),
            counters: status.counters.each().map(|(name, count)| (name.to_owned(), count)).collect(),
            endings: status.endings.iter().map(|(reason, count)| ((*reason).to_owned(), *count)).collect(),
            rules_error: status.rules_error.clone(),
            rates: status.rates.map(RatesShown::of),
            links: status.links.iter().map(LinkShown::of).collect(),
            clients: clients.into_iter().map(|client| ClientShown::of(client, is_wanted)).collect(),
            closed: status.closed.iter().map(|closed| ClosedShown::of(closed, up_ms)).collect(),
        }
    }
}

impl RatesShown {
    fn of(rates: Rates) -> Self {
        let Rates { packages_in, bytes_in, packages_out, bytes_out } = rates;
        Self {
            packages_in_per_s: packages_in,
            bytes_in_per_s: bytes_in,
            packages_out_per_s: packages_out,
            bytes_out_per_s: bytes_out,
        }
    }
}

impl LinkShown {
    fn of(link: &LinkStatus) -> Self {
        let LinkStatus { router, systems, is_open, last_error } = link.clone();
        Self { router, systems, open: is_open, last_error }
    }
}

impl ClientShown {
    fn of(client: &ClientStatus, is_wanted: impl Fn(&MailboxName) -> bool) -> Self {
        Self {
            peer: client.peer.to_string(),
            open_ns: client.open_for * MS,
            names: client.names.len(),
            mailboxes: client.names.iter().filter(|name| is_wanted(name)).map(ToString::to_string).collect(),
            role: client.role.clone(),
            watchdog: client.watchdog,
            waiting: client.waiting,
            waiting_bytes: client.waiting_bytes,
            oldest_ns: client.oldest.map(|oldest| oldest * MS),
            counters: counted(&client.counters),
            rates: client.rates.map(RatesShown::of),
        }
    }
}

impl ClosedShown {
    fn of(closed: &Closed, now_ms: u64) -> Self {
        Self {
            peer: closed.peer.to_string(),
            why: closed.why.to_string(),
            ago_ns: now_ms.saturating_sub(closed.at) * MS,
            open_ns: closed.open_for * MS,
            names: closed.names.len(),
            mailboxes: closed.names.iter().map(ToString::to_string).collect(),
            counters: counted(&closed.counters),
        }
    }
}

fn counted(counters: &Counters) -> BTreeMap<String, u64> {
    counters.each().filter(|(_, count)| *count > 0).map(|(name, count)| (name.to_owned(), count)).collect()
}
