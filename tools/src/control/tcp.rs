//! A station's connection to a TCP router, as people and programs see it.

use std::collections::BTreeMap;

use package_router::tcp::client::TcpWatch;
use serde::{Deserialize, Serialize};

/// The TCP client of a station's packages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TcpShown {
    /// The address of its router.
    pub router: String,
    /// Whether it has a connection.
    pub connected: bool,
    /// The end of the last connection, or the failure of the last attempt to open one; none while there is a connection.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_error: Option<String>,
    /// Packages, bytes, connections and mailboxes, by name.
    pub counters: BTreeMap<String, u64>,
    /// Packages and answers that were lost or refused here, by reason.
    pub lost: BTreeMap<String, u64>,
    /// Packages that the router has read and not passed on, by reason: those of its status.
    pub lost_at_router: BTreeMap<String, u64>,
}

impl TcpShown {
    /// Whether it has a connection, in words.
    pub fn state(&self) -> String {
        let why = self.last_error.as_ref().map_or(String::new(), |why| format!(" ({why})"));
        let state = if self.connected { "connected".to_owned() } else { format!("not connected{why}") };
        format!("router {}: {state}", self.router)
    }

    /// As it is now.
    pub fn of(watch: &TcpWatch) -> Self {
        let status = watch.status();
        let (session, local) = (status.session, status.local);
        let counters = [
            ("connections", status.connections),
            ("mailboxes", status.names as u64),
            ("mailboxes_waiting", status.names_waiting as u64),
            ("names_refused", session.names_refused),
            ("packages_out", session.sent),
            ("bytes_out", session.bytes_sent),
            ("packages_in", session.received),
            ("bytes_in", session.bytes_received),
            ("delivered", local.delivered),
            ("waiting", local.waiting),
        ];
        let lost = [
            ("not_connected", local.not_connected),
            ("queue_full", local.queue_full),
            ("not_written", session.lost),
            ("unconfirmed", session.unconfirmed),
            ("answers_lost", session.answers_lost),
            ("nobody_there", local.no_mailbox),
            ("receiver_full", local.full),
            ("too_large", local.too_large),
            ("foreign_senders", local.forged),
        ];
        let named = |all: &[(&str, u64)]| all.iter().map(|(name, n)| ((*name).to_owned(), *n)).collect();
        let at_router: Vec<_> = session.lost_at_router.each().collect();
        Self {
            router: watch.router().to_string(),
            connected: status.is_connected,
            last_error: status.last_error.filter(|_| !status.is_connected),
            counters: named(&counters),
            lost: named(&lost),
            lost_at_router: named(&at_router),
        }
    }
}
