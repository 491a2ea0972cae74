//! `rtnet package route NAME`: the way that packages for a mailbox go.

use std::net::Ipv4Addr;

use package_router::component::{Error, Way};
use package_router::name::MailboxName;
use package_router::registry::Refused;
use serde::Serialize;

use super::run;
use crate::cmd::Failure;
use crate::control::TcpShown;
use crate::report::document::document;

/// The layer that takes packages for a mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub(super) enum WayName {
    /// A mailbox of this station.
    Mailbox,
    /// Another station.
    Lan,
    /// The TCP router.
    Tcp,
    /// None.
    None,
}

#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct WayShown {
    /// The mailbox.
    pub to: String,
    /// The layer that takes packages for it.
    pub way: WayName,
    /// The process that has the mailbox, if it is here and can be seen.
    pub process: Option<u32>,
    /// The station that has it, by a route.
    pub station: Option<Ipv4Addr>,
    /// That route.
    pub route: Option<String>,
    /// Whether it is of another system than the station, and goes to the TCP router therefore.
    pub other_system: bool,
    /// The connection to the TCP router, if packages go there.
    pub tcp: Option<TcpShown>,
}

document!(WayShown, "package-way", package_way_has_its_schema);

impl WayShown {
    /// The way to a mailbox. `tcp` asks for the station's connection to its router.
    pub fn of(
        to: MailboxName,
        way: Result<Way, Error>,
        tcp: impl FnOnce() -> Result<Option<TcpShown>, Failure>,
    ) -> Result<Self, Failure> {
        let nothing = Self {
            to: to.to_string(),
            way: WayName::None,
            process: None,
            station: None,
            route: None,
            other_system: false,
            tcp: None,
        };
        Ok(match way {
            Ok(Way::Here { process }) => {
                Self { way: WayName::Mailbox, process: (process != 0).then_some(process), ..nothing }
            }
            Ok(Way::Station(route)) => {
                let (station, route) = (Some(route.station), Some(route.to.to_string()));
                Self { way: WayName::Lan, station, route, ..nothing }
            }
            Ok(Way::Tcp { is_of_other_system: other_system }) => {
                Self { way: WayName::Tcp, other_system, tcp: tcp()?, ..nothing }
            }
            Err(Error::Refused(Refused::NoMailbox(_))) => nothing,
            Err(error) => return Err(run(error)),
        })
    }

    pub fn describe(&self) -> String {
        let Self { to, way, process, station, route, other_system, tcp } = self;
        let why = match (way, station, route) {
            (WayName::Mailbox, ..) => {
                let of = process.map_or(String::new(), |process| format!(" of process {process}"));
                format!("mailbox: it is a mailbox of this station{of}")
            }
            (WayName::Lan, Some(station), Some(route)) => {
                format!("LAN: no mailbox of this station, and route {route} leads to {station}")
            }
            (WayName::Tcp, ..) => {
                let why = if *other_system { "it is of another system" } else { "no route leads to another" };
                let state = tcp.as_ref().map_or(String::new(), |tcp| format!("; {}", tcp.state()));
                format!("TCP: no mailbox of this station, and {why}{state}")
            }
            _ => {
                let routes = "no route to another of its system (--package-system)";
                format!("none: no mailbox of this station, {routes}, and no TCP router (--router)")
            }
        };
        format!("{to}: {why}\n")
    }
}
